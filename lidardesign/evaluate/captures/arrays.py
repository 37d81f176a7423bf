"""The arrays of a `.npz` or MATLAB `.mat` file, read without running anything that is in it.

Names, types and sizes are looked at before any data is read: objects, cells and structures are refused, and so is more
data than a stated size, packed or not.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from lidardesign.errors import DataError
from lidardesign.evaluate.captures.matlab import NUMBERS, read_matlab, refused
from lidardesign.run.arrays import check_kind, check_size, guarded, read_npz

SUFFIXES = (".npz", ".mat")


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """All arrays of a file by name, numbers only; MATLAB's come as MATLAB shows them, at least two-dimensional.

    Raises:
        DataError: The file is missing, damaged, too large, or holds something else than arrays of numbers.
    """
    path, where = Path(path), str(path)
    if path.suffix.lower() not in SUFFIXES:
        raise DataError(f"has the suffix {path.suffix!r}", where=where, allowed=", ".join(SUFFIXES))
    try:
        size = path.stat().st_size if path.is_file() else None
    except OSError as error:
        raise DataError(f"cannot be read ({error.strerror or error})", where=where) from error
    if size is None:
        raise DataError("no such file", where=where, hint="check the path")
    check_size([size], where, "the file")
    if not size:
        raise DataError("is an empty file", where=where)
    if path.suffix.lower() == ".npz":
        return read_npz(path)
    # 7.3 is HDF5, what is older has a format of its own
    import h5py

    return guarded(lambda: _read_hdf5(path) if h5py.is_hdf5(path) else read_matlab(path), path, "write it again")


def _read_hdf5(path: Path) -> dict[str, np.ndarray]:
    """MATLAB 7.3: HDF5, with the axes of every array in reverse."""
    import h5py

    with h5py.File(path, "r") as file:
        links = {name: file.get(name, getlink=True) for name in file if not name.startswith("#")}
        outside = [name for name, link in links.items() if not isinstance(link, h5py.HardLink)]
        if outside:
            raise DataError(f"{outside[0]!r} is a link to another file or place", where=str(path))
        datasets = {name: file[name] for name in links}
        for name, dataset in datasets.items():
            _check_dataset(name, dataset, str(path))
        check_size((dataset.nbytes for dataset in datasets.values()), str(path))
        return {name: np.asarray(dataset[()]).T for name, dataset in datasets.items()}


def _check_dataset(name: str, dataset: Any, where: str) -> None:
    import h5py

    if not isinstance(dataset, h5py.Dataset):
        raise refused(name, "structure", where)
    if "MATLAB_class" not in dataset.attrs:
        raise DataError(
            f"{name!r} was not written by MATLAB, so the order of its axes is unknown",
            where=where,
            hint="write .npz from Python, or use scipy.io.savemat",
        )
    kind = dataset.attrs["MATLAB_class"]
    kind = kind.decode() if isinstance(kind, bytes) else str(kind)
    if kind not in NUMBERS:
        raise refused(name, kind, where)
    check_kind(dataset.dtype, name, where)
    if dataset.is_virtual or dataset.external:
        raise DataError(f"{name!r} keeps its data in another file", where=where)
