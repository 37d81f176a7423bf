"""The documentation as a site: built without a warning, searched in a browser, and nothing leaves the machine."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from support.browsers import opened_browser

ROOT = Path(__file__).parents[2]
# Whatever a browser loads by itself; links that a reader may follow are none of it.
LOADED = re.compile(r"<(?:script|img|iframe|link)\b[^>]*\b(?:src|href)=\"?(?:https?:)?//", re.IGNORECASE)


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    pytest.importorskip("material", reason="mkdocs-material is not installed (extra: docs)")
    folder = tmp_path_factory.mktemp("site")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)],
        cwd=ROOT, capture_output=True, text=True, check=False, env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "WARNING" not in done.stderr, done.stderr
    return folder


def test_a_page_loads_nothing_from_elsewhere_and_shows_no_remarks_for_tests(site):
    pages = list(site.rglob("*.html"))
    assert len(pages) > 20
    for page in pages:
        text = page.read_text(encoding="utf-8")
        assert not LOADED.search(text), page.name
        assert "<!-- run:" not in text, page.name


@pytest.mark.slow
def test_a_page_that_is_opened_as_a_file_can_be_searched_and_asks_nobody(site):
    with opened_browser() as browser:
        page = browser.new_page()
        asked, errors = [], []
        page.on("request", lambda request: asked.append(request.url))
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.goto((site / "index.html").as_uri())
        page.click(".md-search__input")
        page.keyboard.type("mounts_m")
        # results follow every key: those of the whole word come last
        page.wait_for_selector('.md-search-result__link[href*="constraints.html"]', state="attached")
        assert errors == []
        assert all(url.startswith(("file:", "data:", "about:")) for url in asked), asked
