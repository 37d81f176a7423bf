"""Captures are read from every kind of file alike, and nothing wrong in one gets past the reader."""

import pickle
import zipfile
from dataclasses import replace

import h5py
import numpy as np
import pytest
from scipy.io import savemat
from support.captures import BINS, make_capture

from lidardesign.errors import DataError
from lidardesign.evaluation.captures import capture as matlab
from lidardesign.evaluation.captures.capture import load_capture, read_arrays
from lidardesign.run.inputs import CAPTURE


def save_npz(path, arrays):
    np.savez_compressed(path, **arrays)


def save_matlab_5(path, arrays):
    savemat(path, arrays, do_compression=True)


def save_matlab_73(path, arrays):
    """What MATLAB writes by save('-v7.3'): HDF5 behind 512 bytes of text, all axes in reverse."""
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, array in arrays.items():
            array = np.atleast_2d(array)
            stored = file.create_dataset(name, data=array.T, compression="gzip")
            kind = {"f": "double", "u": "uint16", "i": "int64"}[array.dtype.kind]
            stored.attrs["MATLAB_class"] = np.bytes_(kind)
    with open(path, "r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(512))


FORMATS = {"npz": save_npz, "mat 5": save_matlab_5, "mat 7.3": save_matlab_73}


def path_of(folder, kind):
    return folder / f"scan.{kind.split()[0]}"


@pytest.mark.parametrize("images", [True, False])
@pytest.mark.parametrize("kind", FORMATS)
def test_a_capture_is_the_same_from_every_kind_of_file(tmp_path, kind, images):
    arrays = make_capture(9, images=images)
    found = stored(tmp_path, kind, arrays)
    np.testing.assert_array_equal(found.counts, arrays["counts"].reshape(-1, BINS))
    assert found.counts.dtype == np.uint16, "counts keep their small type"
    np.testing.assert_array_equal(found.true_range_m, arrays["true_range_m"].reshape(-1))
    np.testing.assert_allclose(np.linalg.norm(found.direction, axis=1), 1.0, atol=1e-15)
    assert (found.bin_ps, found.pulse_fwhm_ps) == (20.0, 60.0)
    np.testing.assert_array_equal(found.start_ps, np.full(81, 2000.0))
    assert found.window_m == pytest.approx((0.29979, 2.09855), abs=1e-5)
    assert np.degrees(found.spacing_rad) == pytest.approx(30 / 8, rel=0.01)


def without_angles(arrays):
    return {name: array for name, array in arrays.items() if not name.endswith("_deg")}


def stored(folder, kind, arrays):
    """What is read of arrays that were written as one kind of file."""
    FORMATS[kind](path_of(folder, kind), arrays)
    return load_capture(path_of(folder, kind))


@pytest.mark.parametrize("kind", FORMATS)
def test_directions_and_scan_angles_say_the_same_and_every_pixel_may_have_a_start_of_its_own(tmp_path, kind):
    by_angles, starts = stored(tmp_path, "npz", make_capture(5)).direction, 2000.0 + np.arange(25.0).reshape(5, 5)
    by_vectors = {**without_angles(make_capture(5)), "direction": by_angles.reshape(5, 5, 3), "start_ps": starts}
    found = stored(tmp_path, kind, by_vectors)
    np.testing.assert_allclose(found.direction, by_angles, atol=1e-15)
    np.testing.assert_array_equal(found.start_ps, starts.ravel())


def changed(**values):
    def change(arrays):
        for name, value in values.items():
            if value is None:
                del arrays[name]
            else:
                arrays[name] = value(arrays[name]) if callable(value) else value
        return arrays

    return change


def at(index, value):
    def put(array):
        array = array.astype(np.float64)
        array[index] = value
        return array

    return put


def renamed(old, new):
    return lambda arrays: {new if name == old else name: value for name, value in arrays.items()}


WRONG = {
    "no time of the first bin": (changed(start_ps=None), "has no start_ps"),
    "no directions": (changed(x_deg=None, y_deg=None), "boresight_azimuth_deg.*\n.*direction, or all of"),
    "directions twice": (changed(direction=np.ones((5, 5, 3)) / 3**0.5), "direction, x_deg"),
    "half the angles": (changed(y_deg=None), "x_deg, boresight"),
    "bins in ns": (renamed("bin_width_ps", "bin_width_ns"), "'bin_width_ps' in another unit"),
    "a key of its own": (changed(operator=np.ones(3)), "unknown key 'operator'"),
    "bins of a row too few": (changed(x_deg=lambda x: x[:-1]), r"x_deg has the shape \(4, 5\)"),
    "flat counts": (changed(counts=lambda c: c.reshape(-1)), "counts has the shape"),
    "NaN counts": (changed(counts=at((1, 2, 3), np.nan)), "nan in pixel 7, bin 3"),
    "negative counts": (changed(counts=at((0, 4, 599), -1)), "-1.0 in pixel 4, bin 599"),
    "counts beyond counting": (changed(counts=at((0, 0, 0), 1e300)), "1e.300 in pixel 0, bin 0"),
    "averaged counts": (changed(counts=lambda c: c / 10), "whole numbers"),
    "no photons": (changed(counts=lambda c: 0 * c), "no photon"),
    "complex counts": (changed(counts=lambda c: c * 1j), "complex"),
    "several bin widths": (changed(bin_width_ps=np.ones(3)), "one number"),
    "NaN bin width": (changed(bin_width_ps=np.nan), "bin_width_ps has values that are NaN"),
    "no bin width": (changed(bin_width_ps=0.0), "bin_width_ps is 0"),
    "histograms before the pulse": (changed(start_ps=-1e9), "an end after the pulse"),
    "pulse in s": (changed(pulse_fwhm_ps=5e-11), "pulse_fwhm_ps is 5e-11"),
    "too few starts": (changed(start_ps=np.ones(3)), "start_ps has the shape"),
    "one late start": (changed(start_ps=lambda s: np.where(np.arange(25).reshape(5, 5) == 7, 1e13, s)), "an end after"),
    "flat origin": (changed(origin_m=np.zeros(2)), r"origin_m has the shape \(2,\)"),
    "angles beyond a right angle": (changed(x_deg=lambda x: x * 10), "beyond 90 degrees"),
    "NaN angles": (changed(y_deg=at((0, 0), np.nan)), "y_deg has values that are NaN"),
    "negative true ranges": (changed(true_range_m=at((0, 0), -0.1)), "negative"),
    "true ranges elsewhere": (changed(true_range_m=lambda r: r * 1000), "one-way, in metres"),
    "no true range at all": (changed(true_range_m=lambda r: r * np.nan), "no true range"),
}


# MATLAB files are read in a process of their own, whose start takes longest: a few of all stand for the rest.
BY_MATLAB = ("complex counts", "flat origin")


@pytest.mark.parametrize(
    ("kind", "name"), [*(("npz", name) for name in WRONG), *(("mat 5", name) for name in BY_MATLAB)]
)
def test_what_cannot_be_is_refused(tmp_path, kind, name):
    change, message = WRONG[name]
    # MATLAB knows no list of three, only a row
    with pytest.raises(DataError, match=message.replace(r"\(2,\)", r"\((1, )?2,?\)")) as caught:
        stored(tmp_path, kind, change(make_capture(5)))
    assert str(path_of(tmp_path, kind)) in str(caught.value)


def test_directions_that_are_no_unit_vectors_are_refused(tmp_path):
    arrays, ones = without_angles(make_capture(3)), np.ones((3, 3, 3))
    for vectors, message in ((ones, "length 1.732"), (ones.reshape(9, 3), "shape"), (0 * ones, "length 0")):
        with pytest.raises(DataError, match=message):
            stored(tmp_path, "npz", {**arrays, "direction": vectors})


# --- files


class Bomb:
    def __reduce__(self):
        return (open, ("owned", "w"))


@pytest.mark.hard_case("P4")
def test_pickled_objects_are_refused_and_never_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    np.savez("s.npz", **{**make_capture(3), "origin_m": np.array([Bomb()], dtype=object)}, allow_pickle=True)
    with pytest.raises(DataError, match="Python objects"):
        load_capture(tmp_path / "s.npz")
    (tmp_path / "raw.npz").write_bytes(pickle.dumps(Bomb()))
    with pytest.raises(DataError):
        load_capture(tmp_path / "raw.npz")
    assert not (tmp_path / "owned").exists()


MATLAB_OBJECTS = {"cell": np.array([[1], "x"], dtype=object), "struct": {"a": 1.0}, "char": "text"}


@pytest.mark.parametrize("kind", MATLAB_OBJECTS)
def test_matlab_structures_are_refused(tmp_path, kind):
    savemat(tmp_path / "s.mat", {**make_capture(3), "start_ps": MATLAB_OBJECTS[kind]})
    with pytest.raises(DataError, match=f"'start_ps' is a MATLAB {kind}"):
        load_capture(tmp_path / "s.mat")


def test_a_reader_that_crashes_or_does_not_end_is_a_damaged_file(tmp_path, monkeypatch):
    path = tmp_path / "s.mat"
    save_matlab_5(path, make_capture(3))
    for work, seconds in (("hangs", 0.01), ("crashes", 60.0)):
        monkeypatch.setattr(matlab, "PATIENCE_SECONDS", seconds)
        monkeypatch.setattr(matlab, "CONVERTER", f"support.work:{work}")
        with pytest.raises(DataError, match="not a MATLAB file, or is damaged"):
            load_capture(path)


def test_matlab_7_structures_and_foreign_hdf5_are_refused(tmp_path):
    path = tmp_path / "s.mat"
    save_matlab_73(path, make_capture(3))

    def elsewhere(file):
        stored = file.create_dataset("counts", (4,), "u1", external=[(str(tmp_path / "other.bin"), 0, 4)])
        stored.attrs["MATLAB_class"] = np.bytes_("uint8")

    for mode, change, message in (
        ("a", lambda file: file.create_group("scanner"), "'scanner' is a MATLAB structure"),
        ("w", lambda file: file.create_dataset("start_ps", data=h5py.Empty("f8")), "start_ps"),
        ("w", lambda file: file.create_dataset("counts", data=np.ones((3, 3, 5))), "not written by MATLAB"),
        ("w", lambda file: file.update({"counts": h5py.ExternalLink("other.h5", "/counts")}), "link"),
        ("w", elsewhere, "another file"),
    ):
        with h5py.File(path, mode) as file:
            change(file)
        with pytest.raises(DataError, match=message):
            load_capture(path)


@pytest.mark.parametrize("kind", FORMATS)
@pytest.mark.parametrize("share", [0.3, 0.999])
def test_a_file_that_was_cut_short_is_refused(tmp_path, kind, share):
    path = path_of(tmp_path, kind)
    FORMATS[kind](path, make_capture(5))
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(DataError, match="scan"):
        load_capture(path)


@pytest.mark.parametrize("suffix", [".npz", ".mat"])
def test_garbage_and_nothing_are_refused(tmp_path, suffix):
    path = tmp_path / f"s{suffix}"
    with pytest.raises(DataError, match="No such file"):
        load_capture(path)
    path.write_bytes(bytes(range(256)) * 16)
    with pytest.raises(DataError):
        load_capture(path)
    with pytest.raises(DataError, match=r"suffix '.csv'.*\n.*\.npz, \.mat"):
        load_capture(tmp_path / "s.csv")


def test_files_above_the_stated_size_are_refused_before_they_are_read(tmp_path, monkeypatch):
    small = replace(CAPTURE, most_bytes=100_000, unpacked_bytes=100_000)
    monkeypatch.setattr("lidardesign.evaluation.captures.capture.CAPTURE", small)
    zeros = {**make_capture(3), "counts": np.zeros((3, 3, 100_000), np.uint8)}
    for kind, save in FORMATS.items():
        path = path_of(tmp_path, kind)
        save(path, zeros)
        assert path.stat().st_size < 100_000, "packed, it is small"
        with pytest.raises(DataError, match="unpacked data take"):
            load_capture(path)


def test_what_is_no_array_in_an_archive_is_refused(tmp_path):
    with zipfile.ZipFile(tmp_path / "s.npz", "w") as archive:
        archive.writestr("notes.txt", "hello")
    with pytest.raises(DataError, match=r"notes\.txt"):
        read_arrays(tmp_path / "s.npz")


def test_a_full_capture_is_read_in_bounded_memory(tmp_path):
    import tracemalloc

    counts = np.zeros((576, 4096), np.uint16)
    counts[:, 100] = 3
    looking = np.tile([1.0, 0.0, 0.0], (576, 1))
    values = {"counts": counts, "bin_width_ps": 8.0, "start_ps": 0.0, "origin_m": np.zeros(3), "direction": looking}
    np.savez(tmp_path / "s.npz", **values)
    tracemalloc.start()
    load_capture(tmp_path / "s.npz")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 6 * counts.nbytes
