"""Morphable models: every layout of the Basel Face Model is read alike, all else is refused by name."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from lidardesign_tasks.basel import load_model
from lidardesign_tasks.face import FaceTask, HeadFamily

from lidardesign.errors import DataError

h5py = pytest.importorskip("h5py")

REAL_MODEL = Path(__file__).parents[3] / "shared" / "data" / "ict_face.h5"
VERTICES, MODES = 12, 3


def parts(seed=0):
    """A model of 12 vertices: mean [mm], orthonormal basis, variances, triangles."""
    random = np.random.default_rng(seed)
    mean = 100 * random.uniform(-1, 1, (VERTICES, 3))
    mean[0], mean[1] = (0.0, -100.0, 0.0), (0.0, 100.0, 0.0)
    basis, _ = np.linalg.qr(random.normal(size=(3 * VERTICES, MODES)))
    faces = np.array([random.choice(VERTICES, 3, replace=False) for _ in range(10)])
    return {"mean": mean.ravel(), "basis": basis, "variance": np.array([400.0, 100.0, 25.0]), "faces": faces}


def write(path, model, *, prefix="shape/", scaled=False, cells="representer/cells", unit="mm", damage=None):
    """Write a model; of damaged datasets what a function makes of them, or nothing."""
    basis = model["basis"] * (np.sqrt(model["variance"]) if scaled else 1.0)
    content = {
        "model/mean": model["mean"],
        "model/pcaBasis": basis,
        "model/pcaVariance": model["variance"],
        cells: model["faces"].T.astype(np.int32),
    }
    with h5py.File(path, "w") as file:
        for name, values in content.items():
            changed = (damage or {}).get(name.rpartition("/")[2], lambda v: v)(values)
            if changed is not None:
                file[prefix + name] = changed
        if unit is not None:
            file.require_group("shape").attrs["unit"] = unit
    return path


@pytest.mark.parametrize(
    "layout",
    [
        {},
        {"scaled": True},
        {"cells": "representer/reference-mesh/triangle-list"},
        {"prefix": "", "unit": None},
        {"prefix": "", "unit": None, "scaled": True},
    ],
    ids=["0.9", "0.8", "old triangle list", "without the shape group", "0.8 without the shape group"],
)
def test_every_layout_gives_the_same_shapes_in_metres(tmp_path, layout):
    model, coefficients = parts(), np.array([1.0, -2.0, 0.5])
    loaded = load_model(write(tmp_path / "m.h5", model, **layout))
    expected = model["mean"] + model["basis"] @ (np.sqrt(model["variance"]) * coefficients)
    np.testing.assert_allclose(loaded.shape(coefficients), expected.reshape(-1, 3) / 1000, rtol=1e-12)
    np.testing.assert_array_equal(loaded.faces, model["faces"])


@pytest.mark.parametrize(("unit", "factor"), [("mm", 1.0), ("cm", 10.0), ("m", 1000.0)])
@pytest.mark.parametrize("said", [True, False])
def test_the_unit_is_read_from_the_file_or_from_the_size_of_a_head(tmp_path, unit, factor, said):
    model = parts()
    model["mean"], model["variance"] = model["mean"] / factor, model["variance"] / factor**2
    loaded = load_model(write(tmp_path / "m.h5", model, unit=unit if said else None))
    np.testing.assert_allclose(np.ptp(loaded.mean, axis=0).max(), 0.2, rtol=0.01)
    assert any("names no unit" in note for note in loaded.notes) != said


def test_a_length_unit_dataset_is_obeyed_and_a_size_of_no_head_is_refused(tmp_path):
    path = write(tmp_path / "m.h5", parts(), unit=None)
    with h5py.File(path, "a") as file:
        file["shape/representer/length-unit"] = 0.001
    assert np.ptp(load_model(path).mean, axis=0).max() == pytest.approx(0.2, rel=0.01)
    with h5py.File(path, "a") as file:
        del file["shape/representer/length-unit"]
        file["shape/representer/length-unit"] = np.zeros(0)
    with pytest.raises(DataError, match="length-unit"):
        load_model(path)
    model = parts()
    model["mean"] = model["mean"] * 1e4
    path = write(tmp_path / "big.h5", model, unit=None)
    with pytest.raises(DataError, match=r"big\.h5.*names no unit"):
        load_model(path)
    assert np.ptp(load_model(path, unit="mm").mean, axis=0).max() == pytest.approx(2000, rel=0.01)


def test_fewer_modes_are_the_first_ones(tmp_path):
    path = write(tmp_path / "m.h5", parts())
    np.testing.assert_array_equal(load_model(path, modes=2).modes, load_model(path).modes[:2])


DAMAGE = {
    "NaN in the mean": ("mean", lambda v: np.where(np.arange(v.size) == 5, np.nan, v), "1 values are NaN"),
    "infinite basis": ("pcaBasis", lambda v: v * np.inf, "NaN or infinite"),
    "mean of a broken length": ("mean", lambda v: v[:-1], "x, y, z of every vertex"),
    "basis of another mesh": ("pcaBasis", lambda v: v[:-3], "has the shape"),
    "too few variances": ("pcaVariance", lambda v: v[:-1], "has the shape"),
    "negative variance": ("pcaVariance", lambda v: -v, "negative"),
    "basis of another scale": ("pcaBasis", lambda v: 3 * v, "columns of length"),
    "text": ("pcaVariance", lambda v: np.array([b"a", b"b", b"c"]), "not an array of numbers"),
    **{f"{name} without values": (name, lambda v: h5py.Empty("f8"), rf"/{name}.*not an array of numbers")
       for name in ("mean", "pcaVariance", "cells")},
    **{f"{name} beyond all sizes": (name, lambda v: v * 1e300, rf"/{name}.*reaches")
       for name in ("mean", "pcaVariance", "pcaBasis")},
    "faces beyond the vertices": ("cells", lambda v: v + VERTICES, "names vertex"),
    "faces of four": ("cells", lambda v: np.vstack([v, v[:1]]), "whole numbers"),
    **{f"no {name}": (name, lambda v: None, rf"m\.h5: dataset shape/\w+/{name}: is missing")
       for name in ("mean", "pcaBasis", "pcaVariance", "cells")},
}  # fmt: skip


@pytest.mark.parametrize("case", DAMAGE)
def test_damaged_content_is_refused_with_file_and_dataset(tmp_path, case):
    name, damage, message = DAMAGE[case]
    with pytest.raises(DataError, match=message) as caught:
        load_model(write(tmp_path / "m.h5", parts(), damage={name: damage}))
    assert "m.h5: dataset shape/" in str(caught.value)
    assert caught.value.exit_code == 3


def test_a_file_that_is_not_hdf5_or_cut_is_refused(tmp_path):
    path = write(tmp_path / "model.h5", parts())
    for content in (b"", b"this is no HDF5 file", b"\x89HDF\r\n\x1a\n" + bytes(200), path.read_bytes()[:-600]):
        path.write_bytes(content)
        with pytest.raises(DataError, match=r"model\.h5: is not a readable HDF5 file"):
            load_model(path)
    with pytest.raises(DataError, match="No such file"):
        load_model(tmp_path / "nowhere.h5")


def test_a_link_to_another_file_is_not_followed(tmp_path):
    write(tmp_path / "other.h5", parts())
    path = write(tmp_path / "m.h5", parts(), damage={"mean": lambda _: None})
    with h5py.File(path, "a") as file:
        file["shape/model/mean"] = h5py.ExternalLink("other.h5", "/shape/model/mean")
    with pytest.raises(DataError, match="stored in another file"):
        load_model(path)


def test_the_embedded_model_is_a_head_of_natural_size_looking_along_x():
    family = HeadFamily.load(FaceTask.Config())
    mesh = family.mesh(np.zeros(len(family.model.modes)))
    low, high = mesh.bounds_m
    assert high[0] == 0.0  # the nose tip is the foremost point and the origin
    assert 0.20 < high[2] - low[2] < 0.30
    assert 0.13 < high[1] - low[1] < 0.20
    np.testing.assert_allclose(low[1], -high[1], atol=0.002)  # left and right are alike
    package = Path(__file__).parents[2] / "tasks" / "lidardesign_tasks" / "data"
    assert (package / "head_model.h5").stat().st_size <= 2e6
    assert "CC0" in (package / "LICENSE-MakeHuman.md").read_text()


@pytest.mark.skipif(not REAL_MODEL.exists(), reason="../shared/data/ict_face.h5 is not here")
def test_the_real_model_loads_and_each_mode_moves_it_by_its_standard_deviation():
    model = load_model(REAL_MODEL)
    assert model.mean.shape == (14_388, 3)
    assert 0.3 < np.ptp(model.mean, axis=0).max() < 0.4
    with h5py.File(REAL_MODEL) as file:
        deviation = np.sqrt(file["shape/model/pcaVariance"][()].astype(float)) / 1000
    np.testing.assert_allclose(np.linalg.norm(model.modes.reshape(100, -1), axis=1), deviation, rtol=1e-4)
