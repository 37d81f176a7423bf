"""Damaged files through whole commands: one message and an exit code of its own, and nothing half-written."""

from __future__ import annotations

import contextlib
import io
import re
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

from support.command_line import files_under, make_run

from fuzz import corpus, fuzz_rigs
from fuzz.attempts import Read, Target
from fuzz.containers import mutate_glb, mutate_hdf5, mutate_npz, mutate_safetensors
from fuzz.fuzz_runs import SMALL, checkpoints, rerecord, small_config
from fuzz.fuzz_targets import TEXTS
from fuzz.mutators import mutate_bytes, mutate_yaml
from lidardesign.config import save_run_config
from lidardesign.errors import LidardesignError
from lidardesign.sensors.design_file import save_design

KNOWN_CODES = (0, 1, 2, 3, 4, 5, 6)
NUMERICAL = 5
LONGEST_MESSAGE = 30


class RefusedError(LidardesignError):
    """A command that said what is wrong; `place` is its message without numbers."""

    def __init__(self, message: str) -> None:
        super().__init__(message)
        self.place = re.sub(r"[\d.'\"]+|input\S*", "#", message)[:80]


def call(arguments: Sequence[str]) -> tuple[int, str, str]:
    """Run the program in this process: exit code, stdout, stderr."""
    from lidardesign.cli.main import run

    out, err = io.StringIO(), io.StringIO()
    code: object = 0
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            run(list(arguments))
        except SystemExit as ended:
            code = ended.code or 0
    return int(code), out.getvalue(), err.getvalue()


def checked(arguments: Sequence[str], kept: Path) -> object:
    """Run a command; what it must not do is an AssertionError, what it refuses a `RefusedError`.

    Arguments:
        arguments: Its arguments.
        kept: A folder that stays as it is when the command refuses its input.
    """
    before = files_under(kept)
    code, out, err = call(arguments)
    text = f"exit code {code}\n{err[-3000:]}"
    if code not in KNOWN_CODES or "Traceback" in err or "Warning" in err:
        raise AssertionError(text)
    if code == 0:
        if "NaN" in out or "Infinity" in out:
            raise AssertionError(f"not finite: {out[:500]}")
        return None
    if not re.search(r"^(\w+) error: .+", err, re.MULTILINE) or len(err.splitlines()) > LONGEST_MESSAGE:
        raise AssertionError(f"no short message: {text}")
    changed = {name for name, content in files_under(kept).items() if before.get(name) != content}
    # what diverged while it was learned leaves its last good state
    if changed and code != NUMERICAL:
        raise AssertionError(f"{', '.join(sorted(changed))} was written: {text}")
    raise RefusedError(next(line for line in err.splitlines() if re.match(r"\w+ error: ", line)))


def command(arguments: str, suffix: str = ".yaml") -> Callable[[Path], Read]:
    """A reader that hands the input to a command; INPUT is its place, `run` a run, `good.yaml` a design."""

    def opened(folder: Path) -> Read:
        make_run(folder / "run", count=1000)
        save_design(corpus.sample_designs()[0], folder / "good.yaml")
        (folder / "good.npz").write_bytes(corpus.captures_npz(folder)[0])
        path = folder / f"input{suffix}"

        def read(content: bytes) -> object:
            path.write_bytes(content)
            shutil.rmtree(folder / "input_out", ignore_errors=True)
            return checked(arguments.replace("INPUT", path.name).split(), folder / "run")

        return read

    return opened


def learning(arguments: str, suffix: str = ".yaml", *, inside: str = "") -> Callable[[Path], Read]:
    """A reader that learns for two steps; the input may have to lie inside a folder."""

    def opened(folder: Path) -> Read:
        place = folder / "input_folder" if inside else folder
        place.mkdir(exist_ok=True)
        path = place / f"input{suffix}"
        out = folder / "input_out"

        def read(content: bytes) -> object:
            path.write_bytes(content)
            shutil.rmtree(out, ignore_errors=True)
            out.mkdir()
            words = arguments.replace("INPUT", inside or path.name).split()
            small = ["--preset", "draft", *(word for value in SMALL for word in ("--set", value))]
            return checked(["learn", *words, "--out", "input_out", *small], place)

        return read

    return opened


def changed_run(name: str, arguments: str) -> Callable[[Path], Read]:
    """A reader of a file of a run whose hash is right."""

    def opened(folder: Path) -> Read:
        make_run(folder / "run", count=1000)
        save_run_config(small_config(), folder / "run")

        def read(content: bytes) -> object:
            rerecord(folder / "run", name, content)
            return checked(arguments.split(), folder / "run")

        return read

    return opened


DESIGNS, MESHES = corpus.design_files, "meshes --set folder=INPUT --set poses=1 --json"
COMMANDS = tuple(
    # learning takes a while: a command may take so much processor time [s]
    Target(name, share, seeds, mutate, opened, slow_s=60.0)
    for name, share, seeds, mutate, opened in (
        ("show DESIGN", 30, DESIGNS, mutate_yaml, command("show INPUT --json")),
        ("export DESIGN", 50, DESIGNS, mutate_yaml,
         command("export INPUT --format csv --out input_out/rays.csv --json")),
        ("export TABLE", 30, corpus.sensor_tables, TEXTS,
         command("export INPUT --format galvo --rays 20 --json", ".csv")),
        ("constrain --constraints", 50, corpus.constraint_files, mutate_yaml,
         command("constrain run --layout even --constraints INPUT --name made --json")),
        ("evaluate DESIGN", 20, DESIGNS, mutate_yaml, command("evaluate run INPUT --rays 20 --json")),
        ("evaluate --detector", 20, corpus.detectors, mutate_yaml,
         command("evaluate good.yaml --in run --detector INPUT --rays 20 --json")),
        ("capture FILE", 30, corpus.captures_npz, mutate_npz,
         command("capture INPUT good.yaml --rays 20 --json", ".npz")),
        ("capture LIST", 30, corpus.steering_lists, TEXTS,
         command("capture good.npz INPUT --within-deg 90 --json", ".galvo.csv")),
        ("learn --config", 30, corpus.configurations, mutate_yaml, learning("flatland --config INPUT --json")),
        ("learn meshes", 20, lambda _: corpus.mesh_exports("glb"), mutate_glb,
         learning(MESHES, ".glb", inside="input_folder")),
        ("learn meshes, STL", 15, lambda _: corpus.mesh_exports("stl"), mutate_bytes,
         learning(MESHES, ".stl", inside="input_folder")),
        ("fit, samples changed", 30, corpus.samples, mutate_npz,
         changed_run("samples.npz", "fit run --layout even --json --name made")),
        ("learn --resume", 20, checkpoints, mutate_safetensors,
         changed_run("checkpoint.safetensors", "learn flatland --resume --out run --json")),
        ("show RIG", 20, fuzz_rigs.rigs("sdf"), TEXTS, command("show INPUT --json", ".sdf")),
        ("fit --like RIG", 20, fuzz_rigs.rigs("mjcf"), TEXTS,
         command("fit run --like INPUT --layout even --name made --json", ".xml")),
        ("catalog show PART", 20, fuzz_rigs.part_files, mutate_yaml, command("catalog show INPUT --json")),
        ("learn mujoco", 20, fuzz_rigs.models, TEXTS,
         learning("mujoco --set model=INPUT --set targets=[hand] --set train=2 --set test=2 --json", ".xml")),
        ("learn face", 10, corpus.face_models, mutate_hdf5,
         learning("face --set model=INPUT --set train=2 --set test=2 --json", ".h5")),
    )
)  # fmt: skip
