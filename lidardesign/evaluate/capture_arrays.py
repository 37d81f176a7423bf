"""The arrays of a `.npz` or MATLAB `.mat` file, read without running anything that is in it.

Names, types and sizes are looked at before any data is read: objects, cells and structures are refused, and so is more
data than a stated size, packed or not.
"""

from __future__ import annotations

import math
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from lidardesign.errors import DataError, LidardesignError

LARGEST_BYTES = 1 << 30
SUFFIXES = (".npz", ".mat")
NUMERIC_KINDS = "buif"
# Bytes of a number of each MATLAB class.
MATLAB_NUMBERS = {
    "double": 8,
    "single": 4,
    "logical": 1,
    **{f"{sign}int{bits}": bits // 8 for sign in ("", "u") for bits in (8, 16, 32, 64)},
}
LARGEST_HEADER_BYTES = 10_000


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
    _check_size(size, "the file", where)
    if not size:
        raise DataError("is an empty file", where=where)
    return _guarded(_reader(path), path)


def _reader(path: Path) -> Callable[[Path], dict[str, np.ndarray]]:
    import h5py

    if path.suffix.lower() == ".npz":
        return _read_npz
    return _read_hdf5 if h5py.is_hdf5(path) else _read_matlab


def _guarded(read: Callable[[Path], dict[str, np.ndarray]], path: Path) -> dict[str, np.ndarray]:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return read(path)
    except LidardesignError:
        raise
    # readers raise anything on garbage: OSError, struct.error, zlib.error, TypeError, IndexError
    except Exception as error:
        reason = (str(error) or "no reason given").splitlines()[0]
        raise DataError(
            f"cannot be read as {path.suffix} ({type(error).__name__}: {reason})",
            where=str(path),
            hint="it may be damaged or cut short: write it again",
        ) from error


def _check_size(size: int, what: str, where: str) -> None:
    if size > LARGEST_BYTES:
        raise DataError(
            f"{what} takes {size / 2**30:.1f} GiB",
            where=where,
            allowed=f"at most {LARGEST_BYTES / 2**30:g} GiB",
            hint="keep fewer bins, fewer pixels or a smaller type, as uint16",
        )


def _check_kind(dtype: np.dtype, name: str, where: str) -> None:
    if dtype.kind == "O":
        raise DataError(
            f"{name!r} holds Python objects", where=where, allowed="arrays of numbers: no file is unpickled"
        )
    if dtype.kind not in NUMERIC_KINDS:
        raise DataError(f"{name!r} is of type {dtype}", where=where, allowed="real numbers")


def _read_npz(path: Path) -> dict[str, np.ndarray]:
    where = str(path)
    if not zipfile.is_zipfile(path):
        raise DataError("is no .npz file, or one cut short", where=where, hint="write it with numpy.savez")
    with zipfile.ZipFile(path) as archive:
        members = archive.infolist()
        _check_size(sum(member.file_size for member in members), "all data", where)
        for member in members:
            _check_member(archive, member, where)
    with np.load(path, allow_pickle=False) as arrays:
        return {name: arrays[name] for name in arrays.files}


def _check_member(archive: zipfile.ZipFile, member: zipfile.ZipInfo, where: str) -> None:
    """Refuse a member whose header promises objects, or more data than there is, before it is read."""
    name = member.filename.removesuffix(".npy")
    if name == member.filename:
        raise DataError(f"holds {member.filename!r}, which is no array", where=where, allowed="arrays of numpy.savez")
    with archive.open(member) as file:
        version = np.lib.format.read_magic(file)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = read(file, max_header_size=LARGEST_HEADER_BYTES)
        _check_kind(dtype, name, where)
        data = member.file_size - file.tell()
        if math.prod(shape) * dtype.itemsize != data:
            raise DataError(f"{name!r} of shape {shape} has {data} bytes of data", where=where, hint="write it again")


def _read_matlab(path: Path) -> dict[str, np.ndarray]:
    """MATLAB 5 to 7 (and 4), as `save` writes without -v7.3."""
    from scipy.io import loadmat, whosmat

    where = str(path)
    listed = whosmat(path, appendmat=False)
    for name, _, kind in listed:
        _check_class(name, kind, where)
    _check_size(sum(math.prod(shape) * MATLAB_NUMBERS[kind] for _, shape, kind in listed), "all data", where)
    found = loadmat(path, appendmat=False)
    arrays = {name: np.asarray(found[name]) for name, _, _ in listed}
    for name, array in arrays.items():
        _check_kind(array.dtype, name, where)
    return arrays


def _check_class(name: str, kind: str, where: str) -> None:
    if kind not in MATLAB_NUMBERS:
        raise DataError(
            f"{name!r} is a MATLAB {kind}",
            where=where,
            allowed="full numeric arrays",
            hint="save arrays, not structures",
        )


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
        _check_size(sum(dataset.nbytes for dataset in datasets.values()), "all data", str(path))
        return {name: np.asarray(dataset[()]).T for name, dataset in datasets.items()}


def _check_dataset(name: str, dataset: Any, where: str) -> None:
    import h5py

    if not isinstance(dataset, h5py.Dataset):
        _check_class(name, "structure", where)
    if "MATLAB_class" not in dataset.attrs:
        raise DataError(
            f"{name!r} was not written by MATLAB, so the order of its axes is unknown",
            where=where,
            hint="write .npz from Python, or use scipy.io.savemat",
        )
    kind = dataset.attrs["MATLAB_class"]
    _check_class(name, kind.decode() if isinstance(kind, bytes) else str(kind), where)
    _check_kind(dataset.dtype, name, where)
    if dataset.is_virtual or dataset.external:
        raise DataError(f"{name!r} keeps its data in another file", where=where)
