"""What `mkdocs` does to the pages: the README is the first one, and what lies outside of docs/ is named, not linked."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File

ROOT = Path(__file__).parents[1]
# How the tests treat a block: readers of the page do not see it.
REMARK = re.compile(r"^<!-- (?:run|instead|exits|columns|before):(?:(?!-->).)*-->\n", re.MULTILINE | re.DOTALL)
FILE = re.compile(r"^<!-- file: (\S+) -->\n```(\w+)$", re.MULTILINE)
OUTSIDE = re.compile(r"\[([^\]]+)\]\((?:\.\./)+(?!README\.md)([^)#]+)[^)]*\)")


def on_files(files: Any, config: Any) -> Any:
    """Add the README as the first page."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    inside = re.sub(r"\]\((?!docs/|https?:)([^)#]+)\)", r"](../\1)", text).replace("](docs/", "](")
    files.append(File.generated(config, "index.md", content=inside))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    """Leave remarks for the tests out, show names of files, and name what lies in the repository and is no page."""
    titled = FILE.sub(r'```\2 title="\1"', REMARK.sub("", markdown))
    named = OUTSIDE.sub(lambda link: _named(*link.groups()), titled)
    return named.replace("](../README.md", "](index.md")


def _named(text: str, path: str) -> str:
    return text if path in text else f"{text} (`{path}`)"
