"""The arrays of a `.npz` or MATLAB `.mat` file, read without running anything that is in it.

Names, types and sizes are looked at before any data is read: objects, cells and structures are refused, and so is more
data than a stated size, packed or not. SciPy reads MATLAB files of versions 4 to 7 in a process of its own, which
damaged ones may crash.
"""

from __future__ import annotations

import contextlib
import math
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from lidardesign.errors import DataError
from lidardesign.run.arrays import check_kind, guarded, read_npz
from lidardesign.run.child import ChildError, ask
from lidardesign.run.inputs import CAPTURE, check_bytes, check_file

# Numpy's types by MATLAB's classes.
NUMBERS = {"double": "f8", "single": "f4", "logical": "?"} | {
    f"{sign}int{8 * size}": f"{sign or 'i'}{size}" for sign in ("", "u") for size in (1, 2, 4, 8)
}
CONVERTER = f"{__name__}:convert"
# A file of the largest size takes some seconds.
PATIENCE_SECONDS = 120.0
# Memory of the process, in times of the largest size: packed data, the same unpacked, the array, and the libraries.
MEMORY_SHARE = 4
MOST_ARRAYS = 1000


def read_matlab(path: Path) -> dict[str, np.ndarray]:
    """All arrays of a file by name, at least two-dimensional, in MATLAB's shapes.

    Raises:
        DataError: It is damaged, too large, or holds other things than full real arrays of numbers.
    """
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "arrays.npz"
        request = {"source": str(path), "target": str(target), "most": CAPTURE.unpacked_bytes}
        try:
            found = ask(CONVERTER, request, PATIENCE_SECONDS, "while it is read")
        except ChildError as error:
            hint = "write it again with save or savemat"
            raise DataError("is not a MATLAB file, or is damaged", where=str(path), hint=hint) from error
        if "refused" in found:
            raise refused(*found["refused"], str(path))
        check_bytes(found["bytes"], CAPTURE, str(path), unpacked=True)
        stored = read_npz(target, CAPTURE)
        return {name: stored[f"array_{number}"] for number, name in enumerate(found["names"])}


def refused(name: str, kind: str, where: str) -> DataError:
    """The error that something in a file is no full array of real numbers."""
    allowed, hint = "full numeric arrays", "save arrays, not structures"
    return DataError(f"{name!r} is a MATLAB {kind}", where=where, allowed=allowed, hint=hint)


def convert(request: dict[str, Any], _: object) -> dict[str, Any]:
    """In that process: write the arrays of a file into another, and say their names and sizes, or what was refused."""
    from scipy.io import loadmat, whosmat

    source, target, most = request["source"], request["target"], request["most"]
    with contextlib.suppress(ImportError, ValueError, OSError):
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (MEMORY_SHARE * max(most, 1 << 29), resource.RLIM_INFINITY))
    listed = whosmat(source)
    for name, _, kind in listed:
        if kind not in NUMBERS:
            return {"refused": [name, kind]}
    size = sum(math.prod(shape) * np.dtype(NUMBERS[kind]).itemsize for _, shape, kind in listed)
    if size <= most:
        read = loadmat(source)
        for name, _, _ in listed:
            if read[name].dtype.kind == "c":
                return {"refused": [name, "complex array"]}
        # numbers may be stored in less space, and in the other byte order
        arrays = [read[name].astype(NUMBERS[kind]) for name, _, kind in listed]
        np.savez(target, **{f"array_{number}": array for number, array in enumerate(arrays)})
    return {"names": [name for name, _, _ in listed], "bytes": size}


SUFFIXES = (".npz", ".mat")


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """All arrays of a file by name, numbers only; MATLAB's come as MATLAB shows them, at least two-dimensional.

    Raises:
        DataError: The file is missing, damaged, too large, or holds something else than arrays of numbers.
    """
    path, where = Path(path), str(path)
    if path.suffix.lower() not in SUFFIXES:
        raise DataError(f"has the suffix {path.suffix!r}", where=where, allowed=", ".join(SUFFIXES))
    if not check_file(path, CAPTURE, hint="check the path"):
        raise DataError("is an empty file", where=where)
    if path.suffix.lower() == ".npz":
        return read_npz(path, CAPTURE)
    # 7.3 is HDF5, what is older has a format of its own
    import h5py

    return guarded(lambda: _read_hdf5(path) if h5py.is_hdf5(path) else read_matlab(path), path, "write it again")


def _read_hdf5(path: Path) -> dict[str, np.ndarray]:
    """MATLAB 7.3: HDF5, with the axes of every array in reverse."""
    import h5py

    with h5py.File(path, "r") as file:
        if len(file) > MOST_ARRAYS:
            raise DataError(f"holds {len(file)} variables", where=str(path), allowed=f"at most {MOST_ARRAYS}")
        links = {name: file.get(name, getlink=True) for name in file if not name.startswith("#")}
        outside = [name for name, link in links.items() if not isinstance(link, h5py.HardLink)]
        if outside:
            raise DataError(f"{outside[0]!r} is a link to another file or place", where=str(path))
        datasets = {name: file[name] for name in links}
        for name, dataset in datasets.items():
            _check_dataset(name, dataset, str(path))
        check_bytes(sum(dataset.nbytes for dataset in datasets.values()), CAPTURE, str(path), unpacked=True)
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
