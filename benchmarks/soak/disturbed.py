"""The run that is disturbed, the same one undisturbed, and what of a run can be read and compared."""

from __future__ import annotations

import csv
import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from benchmarks.soak.forks import Fork, import_all
from lidardesign.density.training.checkpoint import load_arrays
from lidardesign.errors import LidardesignError
from lidardesign.formats.designs import load_design
from lidardesign.rays.pool import FILE_NAME as POOL
from lidardesign.run.arrays import read_npz
from lidardesign.run.inputs import SAMPLES as LIMITS
from lidardesign.run.manifest import read_manifest, verify
from lidardesign.samples import load_samples

SETTINGS = (
    "learning.steps=160", "learning.batch=64", "learning.layers=1", "learning.hidden=12", "learning.samples=1000",
    "learning.coverage_proposals=256", "learning.balance_proposals=256", "learning.checkpoint_seconds=0.000001",
    "train=3", "test=2",
)  # fmt: skip
LEARN = ["learn", "flatland", "--preset", "draft", "--out", "run", "--seed", "3", "--quiet"]
LEARN += [word for setting in SETTINGS for word in ("--set", setting)]
FIT = ["fit", "run", "--sensors", "2", "--rays", "8", "--quiet"]
# half of its time it writes
EVALUATE = ["evaluate", "run", "--rays", "8", "--csv", "run/rows.csv", "--report", "run/page.html", "--quiet"]
STATE = "checkpoint.safetensors"
SAMPLES = "samples.npz"
# Of evaluate, what shows how long things took.
TIMES = ("manifest.json", "page.html")


@dataclass(frozen=True)
class Command:
    """What is given, and after which other command."""

    arguments: list[str]
    after: str = "nothing"


COMMANDS = {
    "learn": Command(LEARN),
    "learn --tolerance": Command([*LEARN, "--tolerance", "0.01"]),
    "fit": Command(FIT, "learn"),
    "evaluate": Command(EVALUATE, "fit"),
}
# With a tolerance all steps are not enough: exit 1, with a run that is whole.
FINISHED = (0, 1)


class Straight:
    """The run that nobody disturbed: `run` inside of a folder for each command, and how that ended."""

    def __init__(self, folder: Path) -> None:
        import_all()
        self._folder, self.ends, self.after = folder, {}, {}
        (folder / "nothing").mkdir()
        for name, command in COMMANDS.items():
            ended = Fork(command.arguments, self.before(name, folder / name)).ended()
            if ended.code not in FINISHED:
                raise SystemExit(f"{name} failed undisturbed: {ended.said}")
            self.ends[name], self.after[name] = ended, contents(folder / name / "run")

    def before(self, name: str, place: Path) -> Path:
        """Make a place what the folder was before a command."""
        return shutil.copytree(self._folder / COMMANDS[name].after, place)


def contents(run: Path) -> dict[str, object]:
    """What a run holds, without the times that are in some of its files."""
    found: dict[str, object] = {}
    for path in sorted(run.rglob("*")):
        name = path.relative_to(run).as_posix()
        if path.is_dir() or name in TIMES:
            continue
        found[name] = _plain(path, name)
    return found


def _plain(path: Path, name: str) -> object:
    if name == "progress.jsonl":
        rows = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
        return [{key: value for key, value in row.items() if key != "seconds"} for row in rows]
    if name == STATE:
        arrays, state = load_arrays(path.parent, name)
        return {key: value.tobytes() for key, value in arrays.items()}, {**state, "seconds": None}
    if name == "rows.csv":
        with path.open(newline="", encoding="utf-8") as file:
            return [{key: value for key, value in row.items() if "seconds" not in key} for row in csv.DictReader(file)]
    return path.read_bytes()


def unreadable(run: Path) -> Iterator[str]:
    """What of a run that was just killed is there but cannot be read, in one line each."""
    if not (run / "config.yaml").exists():
        return  # it had not begun
    manifest = read_manifest(run)
    for name in (*manifest["files"], "config.yaml"):
        if name != "progress.jsonl" and (run / name).exists():
            yield from _refused(name, lambda name=name: verify(run, name))
    for name, read in ((STATE, lambda: load_arrays(run, STATE)), (SAMPLES, lambda: load_samples(run))):
        if (run / name).exists() and name in manifest["files"]:
            yield from _refused(name, read)
    if (run / POOL).exists():
        yield from _refused(POOL, lambda: read_npz(run / POOL, LIMITS))
    for path in (run / "designs").glob("*.yaml"):
        yield from _refused(path.name, lambda path=path: load_design(path))
    page = run / "page.html"
    if page.exists() and not page.read_text(encoding="utf-8").rstrip().endswith("</html>"):
        yield "page.html is cut"


def _refused(name: str, read: Callable[[], object]) -> Iterator[str]:
    try:
        read()
    except LidardesignError as error:
        yield f"{name}: {error.message}"


def strays(folder: Path) -> list[str]:
    """Temporary files and locks."""
    return [path.name for path in folder.rglob(".*") if path.suffix == ".tmp" or path.name == ".lock"]
