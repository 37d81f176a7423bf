"""What people bring along: rigs of other programs, robots and how they move, part files; and run folders as a whole."""

from __future__ import annotations

import hashlib
import io
import json
import random
import shutil
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from support.command_line import files_under, make_run

from fuzz import corpus
from fuzz.attempts import Read, of_file
from fuzz.containers import mutate_npz
from fuzz.fuzz_runs import rerecord
from fuzz.mutators import Mutator, mutate_bytes, mutate_json, mutate_text, mutate_yaml
from lidardesign.formats.registry import EXPORTERS
from lidardesign.parts.catalogue import FOLDER as PARTS
from lidardesign.sensors.design_file import save_design

ROBOT = """<mujoco model="arm"><default><geom rgba="1 0 0 1"/></default><worldbody>
<geom name="ground" type="box" size="2 2 .1" pos="0 0 -.1"/>
<body name="base" pos="0 0 .5"><geom name="trunk" type="box" size=".1 .1 .4"/>
<body name="arm" pos=".15 0 .4"><joint name="lift" axis="0 1 0" range="-80 80"/>
<geom name="upper" type="capsule" size=".04" fromto="0 0 0 .4 0 0"/>
<body name="hand" pos=".5 0 0"><joint name="turn" type="slide" axis="0 0 1" range="-.2 .2"/>
<geom name="palm" type="ellipsoid" size=".06 .05 .04"/><camera name="eye" fovy="40"/></body></body></body>
<body name="parcel" pos="1 0 .1"><freejoint name="parcel"/><geom name="lid" type="cylinder" size=".1 .1"/></body>
</worldbody><keyframe><key qpos="0 0 1 0 .1 1 0 0 0"/></keyframe></mujoco>"""
URDF = """<robot name="arm"><link name="base"><visual><geometry><box size=".1 .1 .4"/></geometry></visual></link>
<link name="hand"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
<visual><origin xyz="0 0 .1" rpy="0 .1 0"/><geometry><sphere radius=".1"/></geometry></visual></link>
<joint name="turn" type="revolute"><parent link="base"/><child link="hand"/><origin xyz="0 0 .3"/><axis xyz="0 0 1"/>
<limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>"""
RIG_FORMATS = {"sdf": (0, 1), "mjcf": (0, 1), "csv": (1, 4), "npz": (1, 4)}


def rigs(kind: str) -> Callable[[Path], list[bytes]]:
    """Designs as other programs have them."""

    def good(folder: Path) -> list[bytes]:
        found = []
        for index in RIG_FORMATS[kind]:
            design = corpus.sample_designs()[index]
            exporter = EXPORTERS[kind]
            path = folder / f"rig{index}{exporter.suffix}"
            exporter.write(design, design.rays(), path)
            found.append(path.read_bytes())
        return found

    return good


def models(_: Path) -> list[bytes]:
    """Robots as MuJoCo loads them."""
    return [ROBOT.encode(), URDF.encode(), *corpus.robots(_)]


def read_model(path: Path) -> object:
    """As the task mujoco does."""
    from lidardesign.scenes.mujoco_models import load_model

    model, notes = load_model(path)
    return model.nq, list(notes)


def _motion() -> dict[str, np.ndarray]:
    times = np.linspace(0.0, 2.0, 12)
    names = ("parcel.x", "parcel.y", "parcel.z", "parcel.qw", "parcel.qx", "parcel.qy", "parcel.qz")
    rest = {name: np.full(12, value) for name, value in zip(names, (1, 0, 0.1, 1, 0, 0, 0), strict=True)}
    return {"time_s": times, "lift": np.sin(times), "turn": 0.1 * times, **rest}


def recordings_csv(_: Path) -> list[bytes]:
    """How the robot moves, as a table."""
    motion = _motion()
    rows = [",".join(motion), *(",".join(map(repr, row)) for row in np.stack(list(motion.values()), axis=1).tolist())]
    return ["\n".join(rows).encode(), "\n".join(row.replace(",", ", ") for row in rows).encode()]


def recordings_npz(_: Path) -> list[bytes]:
    """How the robot moves, as arrays: by joint, and whole."""
    motion, found = _motion(), []
    whole = np.stack([motion[name] for name in list(motion)[1:]], axis=1)
    for arrays in (motion, {"time_s": motion["time_s"], "qpos": whole}):
        buffer = io.BytesIO()
        np.savez_compressed(buffer, **arrays)
        found.append(buffer.getvalue())
    return found


def open_recordings(suffix: str) -> Callable[[Path], Read]:
    """As the task mujoco does with `motion`."""

    def opened(folder: Path) -> Read:
        import mujoco
        from lidardesign_tasks.robot.recordings import read_recordings

        model = mujoco.MjModel.from_xml_string(ROBOT)
        return of_file(suffix, lambda path: read_recordings(model, path))(folder)

    return opened


def poses(_: Path) -> list[bytes]:
    """Bodies that move, with both kinds of rotations."""
    header = "time_s,body,x_m,y_m,z_m"
    plain = f"{header}\n0,a,0,0,0\n1,a,1,0,0\n0.5,b,0,1,0\n"
    turned = f"{header},qw,qx,qy,qz\n0,a,0,0,0,1,0,0,0\n1,a,1,0,0,0,0,0,2\n"
    rolled = f"{header},roll_deg,pitch_deg,yaw_deg\n0,a,0,0,0,0,0,0\n2.5,a,1,0,0,90,-10,180\n"
    return [text.encode() for text in (plain, turned, rolled)]


def read_motion(path: Path) -> object:
    """As the task meshes does with `motion`."""
    from lidardesign_tasks.poses import read_poses

    paths = read_poses(path)
    return {name: (one.time_s, one.at(np.linspace(-1.0, 3.0, 5))) for name, one in paths.items()}


def part_files(_: Path) -> list[bytes]:
    """Parts of the catalog, of every kind of pattern."""
    return [path.read_bytes() for path in sorted(PARTS.glob("*.yaml"))[::3]]


def read_part_file(path: Path) -> object:
    """As `fit --parts FILE` does: the part in all its modes, and what it fires."""
    from lidardesign.parts.catalogue import find_part

    part = find_part(path)
    return part.as_dict() if hasattr(part, "as_dict") else part


def _packed(files: dict[str, bytes]) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return buffer.getvalue()


def run_folders(folder: Path) -> list[bytes]:
    """A run with a design, packed."""
    run = make_run(folder / "run", count=60)
    save_design(corpus.sample_designs()[0], run / "designs" / "fit.yaml")
    rerecord(run, "designs/fit.yaml", (run / "designs" / "fit.yaml").read_bytes())
    return [_packed(files_under(run))]


BY_ENDING = {".yaml": mutate_yaml, ".json": mutate_json, ".npz": mutate_npz}


def mutate_folder(content: bytes, source: random.Random, others: Sequence[bytes]) -> bytes:
    """A run of which files are damaged, with or without their hashes made right, or are gone, empty, or swapped."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    for _ in range(source.choice((1, 1, 2, 3))):
        name = source.choice(list(files) or ["config.yaml"])
        mutate = source.choice((BY_ENDING.get(Path(name).suffix, mutate_bytes), mutate_bytes, mutate_text))
        kind = source.random()
        if kind < 0.6:
            files[name] = _mutated(mutate, files.get(name, b""), source)
        elif kind < 0.8:
            files.pop(name, None)
        else:
            files[name] = source.choice((b"", b"\0" * 100, *files.values()))
    if source.random() < 0.5 and "manifest.json" in files:
        files = _recorded(files)
    return _packed(files)


def _mutated(mutate: Mutator, content: bytes, source: random.Random) -> bytes:
    """Other content; of what is no such file any more, other bytes."""
    try:
        return mutate(content, source, [content])
    except Exception:
        return mutate_bytes(content, source, [content])


def _recorded(files: dict[str, bytes]) -> dict[str, bytes]:
    """Files with the hashes of what they hold in their manifest, where it is one."""
    try:
        manifest = json.loads(files["manifest.json"])
        for name in manifest["files"]:
            content = files.get(name, b"")
            manifest["files"][name] = {"sha256": hashlib.sha256(content).hexdigest(), "bytes": len(content)}
    except (ValueError, TypeError, KeyError):
        return files
    return {**files, "manifest.json": json.dumps(manifest).encode()}


def open_run_folders(folder: Path) -> Read:
    """As `evaluate RUN` does, up to the scenes."""
    from lidardesign.api.scores import ScoreOptions, ScoreRequest
    from lidardesign.samples import load_samples

    def read(content: bytes) -> object:
        run = folder / "input_run"
        shutil.rmtree(run, ignore_errors=True)
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            archive.extractall(run)
        request = ScoreRequest.resolve([run], ScoreOptions(rays=[9]))
        samples = load_samples(run)
        return request.rays, samples.points, request.run.command_times()

    return read
