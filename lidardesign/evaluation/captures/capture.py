"""Captured transients: one photon histogram per pixel of a scan, as a lab measures them.

A capture is a `.npz` or MATLAB `.mat` file with these keys; the pixels are a list (P) or an image (H x W):

- `counts` (P, B) or (H, W, B): photons per time bin, whole numbers;
- `bin_width_ps`: the width of a bin [ps];
- `start_ps`: when the first bin begins, after the pulse left the scanner, two-way time [ps]; one number, or one per
  pixel (P) or (H, W) where the detector was gated;
- `origin_m` (3,): where the scanner stands [m];
- either `direction` (P, 3) or (H, W, 3): unit vectors; or `x_deg`, `y_deg`: optical scan angles as in
  `lidardesign.formats.galvo`, with `boresight_azimuth_deg` and `boresight_elevation_deg` [deg];
- optional `true_range_m` (P) or (H, W): the true one-way range [m], NaN where nothing is;
- optional `pulse_fwhm_ps`: full width at half maximum of the whole system's response [ps], for the matched filter.

Nothing that is in a file is run. Names, types and sizes are looked at before any data is read: objects, cells and
structures are refused, and so is more data than a stated size, packed or not. SciPy reads MATLAB files of versions 4 to
7 in a process of its own, which damaged ones may crash.
"""

from __future__ import annotations

import contextlib
import math
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from lidardesign.errors import DataError
from lidardesign.formats.galvo import SPEED_OF_LIGHT_M_PER_PS, degree_frame, scan_directions
from lidardesign.run.arrays import check_kind, guarded, read_npz
from lidardesign.run.inputs import CAPTURE, check_bytes, check_file
from lidardesign.run.processes import ChildError, ask

REQUIRED = ("counts", "bin_width_ps", "start_ps", "origin_m")
BORESIGHT = ("boresight_azimuth_deg", "boresight_elevation_deg")
GALVO = ("x_deg", "y_deg", *BORESIGHT)
KEYS = (*REQUIRED, "direction", *GALVO, *("true_range_m", "pulse_fwhm_ps"))
# A femtosecond and a microsecond: what lies outside was given in another unit.
BIN_LIMITS_PS = (1e-3, 1e6)
# Light that was under way for a tenth of a second came back from beyond the horizon.
LATEST_PS = 1e11
# The Earth is smaller; coordinates beyond are no metres.
FURTHEST_M = 1e8
# Directions of float32 are unit vectors to 1e-7; further ones are no directions.
UNIT_TOLERANCE = 1e-3
# Pixels that look the same way to so many decimals are one place, captured more than once.
SAME_DIRECTION_DECIMALS = 9
# More photons than this in a bin are no photons; sums over all bins stay whole numbers of 64 bits.
MOST_COUNTS = 1 << 40
# Surfaces fill few stretches of a histogram; the middle one of so many is background.
STRETCHES = 16
# Counts are checked so many numbers at a time, which bounds memory.
CHUNK = 1 << 22
# Numpy's types by MATLAB's classes.
NUMBERS = {"double": "f8", "single": "f4", "logical": "?"} | {
    f"{sign}int{8 * size}": f"{sign or 'i'}{size}" for sign in ("", "u") for size in (1, 2, 4, 8)
}
# The function that reads them in a process of its own. A file of the largest size takes some seconds.
CONVERTER = f"{__name__}:convert"
PATIENCE_SECONDS = 120.0
# Memory of the process, in times of the largest size: packed data, the same unpacked, the array, and the libraries.
MEMORY_SHARE = 4
MOST_ARRAYS = 1000  # in a file
SUFFIXES = (".npz", ".mat")


@dataclass(frozen=True, eq=False)
class Capture:
    """Histograms of P pixels over B bins.

    Arguments:
        counts: Photons per bin, shape (P, B), whole numbers of any numeric type.
        bin_ps: Width of a bin of two-way time [ps].
        start_ps: When the first bin begins [ps], shape (P,); one number counts for all pixels.
        origin_m: Where the scanner stands [m], shape (3,).
        direction: Unit vectors, shape (P, 3).
        true_range_m: The true one-way ranges [m], NaN where nothing is, shape (P,); None: unknown.
        pulse_fwhm_ps: Width of the system's response [ps]; None: unknown.
    """

    counts: np.ndarray
    bin_ps: float
    start_ps: np.ndarray
    origin_m: np.ndarray
    direction: np.ndarray
    true_range_m: np.ndarray | None = None
    pulse_fwhm_ps: float | None = None

    def __post_init__(self) -> None:
        start_ps = np.broadcast_to(np.asarray(self.start_ps, dtype=np.float64), (len(self.counts),))
        object.__setattr__(self, "start_ps", start_ps)

    def __len__(self) -> int:
        return len(self.counts)

    @property
    def bins(self) -> int:
        """Bins of a histogram."""
        return self.counts.shape[1]

    @property
    def bin_m(self) -> float:
        """The one-way range of a bin [m]."""
        return self.bin_ps * SPEED_OF_LIGHT_M_PER_PS / 2

    @property
    def start_m(self) -> np.ndarray:
        """The one-way range at which each pixel's first bin begins, shape (P,) [m]."""
        return self.start_ps * SPEED_OF_LIGHT_M_PER_PS / 2

    @property
    def window_m(self) -> tuple[float, float]:
        """The first and the last range that any histogram holds [m]."""
        return float(self.start_m.min()), float(self.start_m.max()) + self.bins * self.bin_m

    @property
    def gated(self) -> bool:
        """True where pixels begin to count at different times."""
        return bool((self.start_ps != self.start_ps[0]).any())

    @cached_property
    def spacing_rad(self) -> float | None:
        """The median angle between a pixel and the nearest that looks elsewhere; None where all look one way."""
        from scipy.spatial import cKDTree

        apart = np.unique(np.round(self.direction, SAME_DIRECTION_DECIMALS), axis=0)
        if len(apart) < 2:
            return None
        chord = cKDTree(apart).query(apart, k=2)[0][:, 1]
        return float(np.median(2 * np.arcsin(np.minimum(chord / 2, 1.0))))

    @cached_property
    def background_per_bin(self) -> float:
        """The typical background of a bin: the median over pixels of the median of 16 stretches' means.

        Where that is 0 it follows from the share of empty stretches, e^-mean.
        """
        edges = np.linspace(0, self.bins, min(STRETCHES, self.bins) + 1).astype(np.int64)
        rows = max(1, CHUNK // self.bins)
        parts = (self.counts[first : first + rows] for first in range(0, len(self), rows))
        sums = [np.add.reduceat(part, edges[:-1], axis=1, dtype=np.float64) for part in parts]
        means = np.concatenate(sums) / np.diff(edges)
        usual = float(np.median(np.median(means, axis=1)))
        return usual or _rare_background(means) * (len(edges) - 1) / self.bins


def _rare_background(means: np.ndarray) -> float:
    """Mean background of a stretch by the share of empty ones, without each pixel's fullest and its neighbours."""
    # a surface fills the fullest, and its pulse may reach into the next
    away = np.abs(np.arange(means.shape[1]) - means.argmax(axis=1)[:, None]) > 1
    empty = means[away] == 0
    return -math.log(float(empty.mean())) if empty.any() else 0.0


def load_capture(path: Path) -> Capture:
    """A checked capture from a file.

    Raises:
        DataError: The file cannot be read, a key is missing, unknown or in another unit, or a value cannot be.
    """
    where = str(path)
    arrays = read_arrays(path)
    for name in arrays:
        if name not in KEYS:
            same = [key for key in KEYS if key.rpartition("_")[0] and name.startswith(key.rpartition("_")[0] + "_")]
            hint = f"is it {same[0]!r} in another unit?" if same else None
            raise DataError(f"has an unknown key {name!r}", where=where, allowed=", ".join(KEYS), hint=hint)
    missing = [name for name in REQUIRED if name not in arrays]
    if missing:
        raise DataError(f"has no {', '.join(missing)}", where=where, allowed=", ".join(KEYS))
    angles = [name for name in GALVO if name in arrays]
    if ("direction" in arrays) == bool(angles) or len(angles) not in (0, len(GALVO)):
        found = ", ".join([*(["direction"] if "direction" in arrays else []), *angles]) or "neither"
        raise DataError(
            f"says where the pixels point by {found}", where=where, allowed=f"direction, or all of {', '.join(GALVO)}"
        )
    counts = arrays["counts"]
    if counts.ndim not in (2, 3) or not counts.size:
        raise _shape("counts", counts, "(P, B) or (H, W, B), not empty", where)
    pixels = counts.shape[:-1]
    counts = counts.reshape(-1, counts.shape[-1])
    rows = max(1, CHUNK // counts.shape[1])
    for first in range(0, len(counts), rows):
        part = counts[first : first + rows]
        if part.dtype.kind == "f":
            _refuse_counts(~np.isfinite(part), part, first, "finite numbers", where)
            _refuse_counts(part != np.floor(part), part, first, "whole numbers of photons", where)
        _refuse_counts(part < 0, part, first, "0 or more", where)
        # some types of counts do not reach the limit
        most = min(MOST_COUNTS, float(np.finfo(part.dtype).max)) if part.dtype.kind == "f" else MOST_COUNTS
        _refuse_counts(part > most, part, first, f"at most {MOST_COUNTS:.3g}", where)
    if not counts.any():
        raise DataError("all counts are zero: no photon was captured", where=where)
    origin = np.asarray(arrays["origin_m"], dtype=np.float64)
    if origin.size != 3:
        raise _shape("origin_m", origin, "(3,)", where)
    capture = Capture(
        counts,
        _scalar(arrays, "bin_width_ps", where),
        (
            np.array(_scalar(arrays, "start_ps", where))
            if arrays["start_ps"].size == 1
            else _finite(_per_pixel(arrays, "start_ps", pixels, where), "start_ps", where)
        ),
        _finite(origin.reshape(3), "origin_m", where),
        _directions(arrays, pixels, where),
        _per_pixel(arrays, "true_range_m", pixels, where) if "true_range_m" in arrays else None,
        _scalar(arrays, "pulse_fwhm_ps", where) if "pulse_fwhm_ps" in arrays else None,
    )
    _check_values(capture, where)
    return capture


def _shape(name: str, array: np.ndarray, allowed: str, where: str) -> DataError:
    return DataError(f"{name} has the shape {array.shape}", where=where, allowed=allowed)


def _finite(values: np.ndarray, name: str, where: str) -> np.ndarray:
    if not np.isfinite(values).all():
        raise DataError(f"{name} has values that are NaN or infinite", where=where, allowed="finite numbers")
    return values


def _scalar(arrays: Mapping[str, np.ndarray], name: str, where: str) -> float:
    if arrays[name].size != 1:
        raise _shape(name, arrays[name], "one number", where)
    return float(_finite(np.asarray(arrays[name], dtype=np.float64).reshape(()), name, where))


def _per_pixel(arrays: Mapping[str, np.ndarray], name: str, pixels: tuple[int, ...], where: str) -> np.ndarray:
    """One number per pixel, shape (P,); a list of pixels may be a row or a column, as MATLAB has no lists."""
    array = arrays[name]
    count = int(np.prod(pixels))
    of_list = len(pixels) == 1 and array.size == count and array.ndim <= 2 and count in array.shape
    if array.shape != pixels and not of_list:
        raise _shape(name, array, f"{pixels}, one number per pixel of counts", where)
    return np.asarray(array, dtype=np.float64).reshape(-1)


def _directions(arrays: Mapping[str, np.ndarray], pixels: tuple[int, ...], where: str) -> np.ndarray:
    """Unit vectors, shape (P, 3), from vectors or from scan angles."""
    if "direction" not in arrays:
        scan = [_finite(_per_pixel(arrays, name, pixels, where), name, where) for name in ("x_deg", "y_deg")]
        if max(np.abs(scan[0]).max(), np.abs(scan[1]).max()) > 90:
            raise DataError("scan angles are beyond 90 degrees", where=where, allowed="optical angles in degrees")
        frame = degree_frame(*(_scalar(arrays, name, where) for name in BORESIGHT))
        return scan_directions(frame, np.stack(scan, axis=1))
    array = arrays["direction"]
    if array.shape != (*pixels, 3):
        raise _shape("direction", array, f"{(*pixels, 3)}", where)
    vectors = _finite(np.asarray(array, dtype=np.float64).reshape(-1, 3), "direction", where)
    with np.errstate(over="ignore"):  # an infinite length is none of a unit vector
        length = np.linalg.norm(vectors, axis=1, keepdims=True)
    if np.abs(length - 1).max() > UNIT_TOLERANCE:
        worst = float(length[np.abs(length - 1).argmax(), 0])
        raise DataError(f"direction has a vector of length {worst:.4g}", where=where, allowed="unit vectors")
    return vectors / length


def _refuse_counts(bad: np.ndarray, part: np.ndarray, first: int, allowed: str, where: str) -> None:
    if bad.any():
        pixel, at = np.argwhere(bad)[0]
        raise DataError(
            f"counts holds {part[pixel, at]} in pixel {first + pixel}, bin {at}",
            where=where,
            allowed=allowed,
            hint="give raw counts: not averaged, and with no background subtracted",
        )


def _check_values(capture: Capture, where: str) -> None:
    """Refuse numbers that suggest another unit."""
    low, high = BIN_LIMITS_PS
    for name, value in (("bin_width_ps", capture.bin_ps), ("pulse_fwhm_ps", capture.pulse_fwhm_ps)):
        if value is not None and not low <= value <= high:
            raise DataError(f"{name} is {value:g}", where=where, allowed=f"{low:g} to {high:g} ps")
    if np.abs(capture.origin_m).max() > FURTHEST_M:
        raise DataError(
            f"origin_m is {capture.origin_m.tolist()}", where=where, allowed=f"within {FURTHEST_M:g} m of the origin"
        )
    end_ps = capture.start_ps + capture.bins * capture.bin_ps
    if not (end_ps.min() > 0 and end_ps.max() <= LATEST_PS):
        raise DataError(
            f"the histograms last from {capture.start_ps.min():g} to {end_ps.max():g} ps",
            where=where,
            allowed=f"an end after the pulse and before {LATEST_PS:g} ps",
        )
    known = capture.true_range_m
    if known is None:
        return
    seen = known[~np.isnan(known)]
    if np.isinf(seen).any() or (seen < 0).any():
        raise DataError("true_range_m is negative or infinite", where=where, allowed="0 or more, NaN where nothing is")
    start, end = capture.window_m
    heard = (known >= capture.start_m) & (known < capture.start_m + capture.bins * capture.bin_m)
    if not heard.any():
        raise DataError(
            f"no true range lies within the histograms, {start:.4g} to {end:.4g} m",
            where=where,
            hint="true_range_m is one-way, in metres; start_ps and bin_width_ps are two-way times",
        )


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """All arrays of a file by name, numbers only; MATLAB's come as MATLAB shows them, at least two-dimensional.

    Raises:
        DataError: The file is missing, damaged, too large, or holds something else than arrays of numbers.
    """
    where = str(path)
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

    # without a shape a dataset is empty, as no array of MATLAB is
    if not isinstance(dataset, h5py.Dataset) or dataset.shape is None:
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


def convert(request: dict[str, Any], _: object) -> dict[str, Any]:
    """In the child: write the arrays of a file into another; return their names and sizes, or the refusal."""
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


def refused(name: str, kind: str, where: str) -> DataError:
    """The error for a variable that is no full array of real numbers."""
    return DataError(
        f"{name!r} is a MATLAB {kind}",
        where=where,
        allowed="full numeric arrays",
        hint="save arrays, not structures",
    )
