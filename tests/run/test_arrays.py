"""Tables and archives: what is larger in memory than its file shows is refused before memory is taken."""

from __future__ import annotations

import io
import time
import tracemalloc
import zipfile
from dataclasses import replace

import numpy as np
import pytest

from lidardesign.errors import DataError
from lidardesign.run.arrays import csv_rows, read_npz
from lidardesign.run.inputs import ARRAYS, MOST_COLUMNS, MOST_ROWS, TABLE

TABLES = {
    "commas": "," * 5_000_000,
    "columns": ",".join(f"c{number}" for number in range(MOST_COLUMNS + 1)),
    "rows of nothing": "\n" * (MOST_ROWS + 1),
    "rows of commas": ",\n" * (MOST_ROWS + 1),
    "a quote that is not closed": '"' + "\n" * 10_000_000,
    "a cell of millions of letters": "a,b\n" + '"' + "x" * 5_000_000 + '",1\n',
}


@pytest.mark.parametrize("text", list(TABLES.values()), ids=list(TABLES))
def test_a_table_beyond_measure_is_refused_with_its_line_soon(tmp_path, text):
    (tmp_path / "table.csv").write_text(text)
    started = time.perf_counter()
    with pytest.raises(DataError, match=r"table\.csv:\d+: "):
        csv_rows(tmp_path / "table.csv", TABLE)
    assert time.perf_counter() - started < 30


def test_as_many_columns_and_rows_as_are_stated_are_read(tmp_path):
    (tmp_path / "table.csv").write_text(",".join(["1"] * MOST_COLUMNS) + "\n\n2\n")
    assert [(line, len(cells)) for line, cells in csv_rows(tmp_path / "table.csv", TABLE)] == [
        (1, MOST_COLUMNS),
        (3, 1),
    ]


def bomb(path, count, members=1):
    """An archive of arrays of so many zeros, packed."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for member in range(members):
            with archive.open(f"a{member}.npy", "w") as file:
                header = io.BytesIO()
                np.lib.format.write_array_header_1_0(
                    header, {"shape": (count,), "fortran_order": False, "descr": "|u1"}
                )
                file.write(header.getvalue() + bytes(count))


def test_a_small_archive_of_much_data_is_refused_before_it_is_unpacked(tmp_path):
    bomb(tmp_path / "bomb.npz", 5_000_000, members=3)
    assert (tmp_path / "bomb.npz").stat().st_size < 50_000
    tracemalloc.start()
    with pytest.raises(DataError, match=r"unpacked data take 15 MB(?s:.)*at most 10 MB"):
        read_npz(tmp_path / "bomb.npz", replace(ARRAYS, unpacked_bytes=10_000_000))
    assert tracemalloc.get_traced_memory()[1] < 5_000_000
    tracemalloc.stop()
    assert {len(array) for array in read_npz(tmp_path / "bomb.npz").values()} == {5_000_000}


def test_an_archive_that_lists_very_many_arrays_is_refused_before_its_list_is_read(tmp_path):
    bomb(tmp_path / "many.npz", 1, members=20_000)
    started = time.perf_counter()
    with pytest.raises(DataError, match="too many arrays"):
        read_npz(tmp_path / "many.npz")
    assert time.perf_counter() - started < 1
