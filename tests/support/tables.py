"""One law over a table: every row is tried in one test, which names all rows that break it."""

from __future__ import annotations

import functools
import inspect
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import pytest


def each_row(names: str | Sequence[str], rows: Iterable[Any], ids: Any = None) -> Callable[[Callable], Callable]:
    """As `pytest.mark.parametrize`, but one test, which fails with the names of all rows that fail.

    Each row has a `tmp_path`, a `capsys` and a `monkeypatch` of its own; other fixtures are shared by all.
    """
    keys = [name.strip() for name in names.split(",")] if isinstance(names, str) else list(names)
    alone = isinstance(names, str) and len(keys) == 1
    table = [row.values if hasattr(row, "marks") else (row,) if alone else tuple(row) for row in rows]
    labels = list(ids) if ids is not None and not callable(ids) else [" ".join(map(_label, row)) for row in table]

    def decorate(test: Callable) -> Callable:
        @functools.wraps(test)
        def over_rows(*args: Any, **fixtures: Any) -> None:
            failures, skipped = [], None
            for number, (row, label) in enumerate(zip(table, labels, strict=True)):
                try:
                    with _own(fixtures, number) as own:
                        test(*args, **own, **dict(zip(keys, row, strict=True)))
                except pytest.skip.Exception as skip:
                    skipped = skip
                except (Exception, pytest.fail.Exception) as error:
                    traceback.print_exc()
                    failures.append((label, error))
            if failures:
                told = "\n".join(f"  {label}: {str(error)[:300]}" for label, error in failures)
                raise AssertionError(f"{len(failures)} of {len(table)} rows fail:\n{told}") from failures[0][1]
            if skipped is not None:
                raise skipped

        kept = [one for name, one in inspect.signature(test).parameters.items() if name not in keys]
        over_rows.__signature__ = inspect.Signature(kept)
        return over_rows

    return decorate


@contextmanager
def _own(fixtures: dict[str, Any], number: int) -> Iterator[dict[str, Any]]:
    own = dict(fixtures)
    if "tmp_path" in own:
        own["tmp_path"] = own["tmp_path"] / f"row{number}"
        own["tmp_path"].mkdir()
    if "capsys" in own:
        own["capsys"].readouterr()
    if "monkeypatch" not in own:
        yield own
        return
    with own["monkeypatch"].context() as own["monkeypatch"]:
        yield own


def _label(value: Any) -> str:
    return getattr(value, "__name__", None) or repr(value)[:60]
