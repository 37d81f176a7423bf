"""MATLAB files of versions 4 to 7, read by SciPy in a process of its own, which damaged ones may crash.

Run as a program, it looks at names, shapes and classes before it reads any data, writes all arrays to a `.npz` file and
prints what came of it as JSON: the arrays' names, what it refused, or how large they are.
"""

from __future__ import annotations

import contextlib
import json
import math
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from lidardesign.errors import DataError
from lidardesign.run import arrays as npz

# Numpy's types by MATLAB's classes.
NUMBERS = {"double": "f8", "single": "f4", "logical": "?"} | {
    f"{sign}int{8 * size}": f"{sign or 'i'}{size}" for sign in ("", "u") for size in (1, 2, 4, 8)
}
# A file of the largest size takes some seconds.
PATIENCE_SECONDS = 120.0
# Memory of the process, in times of the largest size: packed data, the same unpacked, the array, and the libraries.
MEMORY_SHARE = 4


def read_matlab(path: Path) -> dict[str, np.ndarray]:
    """All arrays of a file by name, at least two-dimensional, in MATLAB's shapes.

    Raises:
        DataError: It is damaged, too large, or holds other things than full real arrays of numbers.
    """
    # modules are found where this process finds them
    program = f"import sys; sys.path[:] = {sys.path!r}; from {__name__} import main; main()"
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "arrays.npz"
        command = [sys.executable, "-c", program, str(path), str(target), str(npz.LARGEST_BYTES)]
        try:
            done = subprocess.run(command, capture_output=True, check=True, timeout=PATIENCE_SECONDS)
            found = json.loads(done.stdout)
        except (subprocess.SubprocessError, ValueError) as error:
            hint = "write it again with save or savemat"
            raise DataError("is no MATLAB file, or a damaged one", where=str(path), hint=hint) from error
        if "refused" in found:
            raise refused(*found["refused"], str(path))
        npz.check_size([found["bytes"]], str(path))
        stored = npz.read_npz(target)
        return {name: stored[f"array_{number}"] for number, name in enumerate(found["names"])}


def refused(name: str, kind: str, where: str) -> DataError:
    """The error that something in a file is no full array of real numbers."""
    allowed, hint = "full numeric arrays", "save arrays, not structures"
    return DataError(f"{name!r} is a MATLAB {kind}", where=where, allowed=allowed, hint=hint)


def main() -> None:
    """Read the file that the first argument names into the one of the second, up to the bytes of the third."""
    source, target, most = sys.argv[1], sys.argv[2], int(sys.argv[3])
    with contextlib.suppress(ImportError, ValueError, OSError):
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (MEMORY_SHARE * max(most, 1 << 30), resource.RLIM_INFINITY))
    print(json.dumps(_convert(source, target, most)))


def _convert(source: str, target: str, most: int) -> dict[str, object]:
    from scipy.io import loadmat, whosmat

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
