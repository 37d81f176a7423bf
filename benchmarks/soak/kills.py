"""Kills of commands that write, `make soak-kills`: what is left can be read, and going on gives the same bytes.

A fork is sent SIGKILL or SIGTERM before one of the steps by which files change, or after a random time. Then every
file that is there must be readable, the command given again (`learn` with --resume) must end well and leave no lock and
no temporary file, and the bytes of flow, samples, snapshots, checkpoint, designs and tables must be those of a run that
nobody disturbed, but for the seconds in them. A folder of several files must be the old or the new one, or name what is
unfinished, and be the new one once the command is given again. Of two commands at once in one folder one must work, and
the other must work or be told why not.

Any command, as a program of its own, ends with 130 or 143 within 5 s of a SIGINT or SIGTERM at any time, and with a
message within 10 s of the death of one of its workers, unless it needs it no more.
"""

from __future__ import annotations

import contextlib
import functools
import itertools
import os
import shutil
import signal
import subprocess
import sys
import time
import zlib
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import psutil
import pytest
from trimesh.creation import box

from benchmarks.soak.disturbed import (
    COMMANDS,
    EVALUATE,
    FINISHED,
    FIT,
    LEARN,
    Ended,
    Fork,
    Straight,
    contents,
    import_all,
    strays,
    unreadable,
)
from benchmarks.soak.long_runs import amount
from lidardesign.errors import NumericalError
from lidardesign.run.inputs import UNFINISHED, unfinished_names

# Commands that are given at once, in a folder as it was before one of them.
GIVEN = {**{name: command.arguments for name, command in COMMANDS.items()}, "learn --resume": [*LEARN, "--resume"]}
PAIRS = {
    f"{first} and {second}": (before, first, second)
    for before, first, second in (
        ("learn", "learn", "learn"), ("learn", "learn", "learn --resume"), ("learn", "learn", "fit"),
        ("fit", "learn --resume", "learn --resume"), ("fit", "learn --resume", "fit"), ("fit", "fit", "fit"),
        ("evaluate", "evaluate", "evaluate"), ("evaluate", "evaluate", "fit"),
    )
}  # fmt: skip
# Commands that write several files, over those of another design; the last ones in the folder where they are given.
EXPORT = ["export", "../new.yaml", "--quiet", "--format"]
SETS = {
    **{f"{form}": [*EXPORT, form, "--out", "../set"] for form in ("mounts", "helios", "rgl", "mitsuba", "ply")},
    "simulate": ["simulate", "../new.yaml", "--quiet", "--scene", "../box.stl", "--out", "../set"],
    "tasks new": ["tasks", "new", "landmark", "--quiet", "--out", "../set"],
    "mounts here": [*EXPORT, "mounts", "--out", "."],
    "rgl here": [*EXPORT, "rgl", "--out", "."],
    "tasks new here": ["tasks", "new", "landmark", "--quiet", "--out", "."],
}
PARTS = {"old": "vl53l8cx", "new": "tmf8828"}
WORKERS = ["--workers", "2"]
CONSTRAIN = ["constrain", "run", "--set", "gate.width_m.max=0.5"]
# Programs that are sent signals: where a command of this name is given, and what is given.
PROGRAMS = {
    "learn": ("learn", LEARN),
    "fit": ("fit", FIT),
    "fit --workers": ("fit", [*FIT, *WORKERS]),
    "constrain": ("evaluate", CONSTRAIN),
    "constrain --workers": ("evaluate", [*CONSTRAIN, *WORKERS]),
    "evaluate": ("evaluate", EVALUATE),
    "evaluate --workers": ("evaluate", [*EVALUATE, *WORKERS]),
    "export": ("evaluate", ["export", "run/designs/fit.yaml", "--format", "npz", "--out", "rays.npz"]),
    "simulate": ("evaluate", ["simulate", "run", "--scenes", "2", "--out", "clouds"]),
    "show": ("evaluate", ["show", "run", "--json"]),
    "studio": ("evaluate", ["studio", "run", "--no-browser"]),
    "catalog": ("learn", ["catalog", "list"]),
    "tasks": ("learn", ["tasks", "check", "flatland"]),
}
LONGEST_PROGRAM_S, LONGEST_END_S, LONGEST_LOSS_S = 6.0, 5.0, 10.0
# Death by the signal itself, before the first line of the program, counts.
ENDS = {"SIGINT": (130, -signal.SIGINT), "SIGTERM": (143, -signal.SIGTERM)}
OF_A_WORKER = "SIGKILL of a worker"
REFUSED = (2, 3)
LONGEST_DELAY_S = 2.0
TERMINATED = 143
# How often a command is ended in a round, by where; one of many steps more often than one of few.
TURNS = {"step": {"learn": 10, "learn --tolerance": 6, "fit": 2, "evaluate": 1}, "time": dict.fromkeys(COMMANDS, 1)}
WAYS = [(where, sent) for where in TURNS for sent in ("SIGKILL", "SIGTERM")]
ROUND = [
    *((*way, name) for turn in range(10) for way in WAYS for name, turns in TURNS[way[0]].items() if turn < turns),
    *(("pair", "", name) for name in PAIRS),
    *(("set", "SIGKILL", name) for name in SETS),
    *(("program", sent, name) for name in PROGRAMS for sent in ENDS),
    *(("program", OF_A_WORKER, name) for name, (_, given) in PROGRAMS.items() if WORKERS[0] in given),
]


def pytest_generate_tests(metafunc):
    done = Counter()
    rows = []
    for case in itertools.islice(itertools.cycle(ROUND), amount(metafunc.config)):
        rows.append((*case, done[case]))
        done[case] += 1
    metafunc.parametrize(("where", "sent", "name", "number"), rows)


@pytest.fixture(scope="session")
def straight(tmp_path_factory):
    """A function that gives the run that nobody disturbed: not needed where all is done."""
    return functools.cache(lambda: Straight(tmp_path_factory.mktemp("straight")))


@pytest.mark.long
@pytest.mark.filterwarnings("default")
def test_what_is_disturbed_recovers(tmp_path, piece, straight, where, sent, name, number):
    def work():
        if where == "set":
            met, told, faults = set_killed(name, number, tmp_path)
        elif where == "pair":
            met, told, faults = at_once(straight(), name, number, tmp_path / "both")
        elif sent == OF_A_WORKER:
            return worker_killed(straight(), name, number, tmp_path)
        elif where == "program":
            return signalled(straight(), sent, name, number, tmp_path)
        else:
            met, told, faults = ended_early(straight(), where, sent, name, number, tmp_path / "killed")
        faults = [f"{name}, {told}: {fault}" for fault in faults]
        case = f"{name}, {sent} at a {where}" if sent else name
        return {"case": case, "counts": {"met at work, or both worked": int(met)}, "faults": faults}

    piece(work)


def ended_early(
    straight: Straight, where: str, sent: str, name: str, number: int, place: Path
) -> tuple[bool, str, list[str]]:
    """End one command in a folder of its own, look, give it again, and compare.

    Returns:
        Whether it was met at work, at which moment, and what was not as it must be.
    """
    whole, sign = straight.ends[name], signal.Signals[sent]
    straight.before(name, place)
    if where == "step":  # every one of them, in as many rounds
        step = int(np.random.default_rng(0).permutation(whole.steps)[number % whole.steps]) + 1
        told, ended = f"step {step}", Fork(GIVEN[name], place, step, sign).ended()
    else:
        after_s = np.random.default_rng([zlib.crc32(f"{sent} {name}".encode()), number]).uniform(0, whole.seconds)
        told, ended = f"after {after_s:.3f} s", Fork(GIVEN[name], place).ended(after_s, sign)
    return ended.code not in FINISHED, told, [*_left(where, sent, ended, place), *_again(straight, name, place)]


def _left(where: str, sent: str, ended: Ended, place: Path) -> Iterator[str]:
    """What is wrong with the folder as it was left."""
    yield from (f"unreadable: {fault}" for fault in unreadable(place / "run"))
    if sent == "SIGKILL":
        return
    if ended.code not in (*FINISHED, TERMINATED, -signal.SIGTERM) or "Traceback" in ended.said:
        yield f"exit code {ended.code}: {ended.said[-300:]}"
    # a step may be that of tidying up itself: then the command given again does it
    if where == "time" and strays(place):
        yield f"left {strays(place)}"


def _again(straight: Straight, name: str, place: Path) -> Iterator[str]:
    """What is wrong with the folder after the command was given again."""
    arguments = list(GIVEN[name])
    if arguments[0] == "learn" and (place / "run").exists():
        arguments.append("--resume")
    ended = Fork(arguments, place).ended()
    if ended.code not in FINISHED:
        yield f"given again it ended with {ended.code}: {ended.said[-300:]}"
        return
    if strays(place):
        yield f"given again it left {strays(place)}"
    expected, found = straight.after[name], contents(place / "run")
    yield from (f"{file} differs" for file in sorted({*expected, *found}) if expected.get(file) != found.get(file))
    shutil.rmtree(place)


def set_killed(name: str, number: int, place: Path) -> tuple[bool, str, list[str]]:
    """Kill a command that writes several files, at every second time at one of its steps, look, and give it again."""
    import_all()
    here = place / ("set" if name.endswith("here") else "elsewhere")
    here.mkdir(exist_ok=True)
    (place / "box.stl").write_bytes(box(extents=(0.2, 0.2, 0.2)).apply_translation((1, 0, 0)).export(file_type="stl"))
    found, ends = [], []
    for version, part in PARTS.items():
        Fork(["catalog", "show", part, "--out", f"../{version}.yaml"], here).ended()
        ends.append(Fork([word.replace("new.", f"{version}.") for word in SETS[name]], here).ended())
        found.append(files_of(place / "set"))
        shutil.rmtree(place / "set")
        here.mkdir(exist_ok=True)
    old = {} if name.startswith("tasks new") else found[0]
    for file, content in old.items():
        (place / "set" / file).parent.mkdir(parents=True, exist_ok=True)
        (place / "set" / file).write_bytes(content)
    draw = np.random.default_rng([zlib.crc32(name.encode()), number])
    step, after_s = int(draw.integers(ends[1].steps)) + 1, draw.uniform(0, ends[1].seconds)
    told = f"step {step}" if number % 2 else f"after {after_s:.3f} s"
    ended = Fork(SETS[name], here, step).ended() if number % 2 else Fork(SETS[name], here).ended(after_s)
    left = files_of(place / "set")
    state = next((word for word, files in (("old", old), ("new", found[1])) if files == left), "mixed")
    faults = [f"undisturbed: {end.said[-300:]}" for end in ends if end.code]
    faults += ["mixed, without saying so"] if state == "mixed" and not unfinished_names(place / "set") else []
    if (again := Fork(SETS[name], here).ended()).code and (state, old) != ("new", {}):
        faults.append(f"given again it ended with {again.code}: {again.said[-300:]}")
    faults += ["given again it is not the new one"] if {**old, **found[1]} != {**old, **files_of(place / "set")} else []
    faults += [f"given again it left {path.name}" for path in place.rglob(".*.tmp") if not again.code]
    return ended.code not in FINISHED, f"{told}: {state}", faults


def files_of(folder: Path) -> dict[str, bytes]:
    """The content of all files in a folder but for those that are temporary or name what is unfinished."""
    paths = [path for path in folder.rglob("*") if path.is_file() and path.name != UNFINISHED]
    within = [path.relative_to(folder) for path in paths]
    return {path.as_posix(): (folder / path).read_bytes() for path in within if ".tmp" not in path.parts[0]}


def at_once(straight: Straight, name: str, number: int, place: Path) -> tuple[bool, str, list[str]]:
    """Two commands at once: each works or is told why not, one works at least, and nothing is spoilt."""
    before, first, second = PAIRS[name]
    # the first time really at once
    delay_s = np.random.default_rng([zlib.crc32(name.encode()), number]).uniform(0, LONGEST_DELAY_S) if number else 0.0
    straight.before(before, place)
    one = Fork(GIVEN[first], place)
    time.sleep(delay_s)
    other = Fork(GIVEN[second], place)
    ends = [one.ended(), other.ended()]
    faults = [] if any(end.code == 0 for end in ends) else ["neither worked"]
    for end in ends:
        if end.code not in (0, *REFUSED) or "Traceback" in end.said or "internal error" in end.said:
            faults.append(f"exit code {end.code}: {end.said[-300:]}")
    faults += [f"unreadable: {fault}" for fault in unreadable(place / "run")]
    faults += [f"left {strays(place)}"] if strays(place) else []
    found, whole = contents(place / "run"), straight.after["evaluate"]
    faults += [f"{file} is missing" for file in straight.after["learn"] if file not in found]
    faults += [f"{file} differs" for file in found if file in whole and found[file] != whole[file]]
    shutil.rmtree(place)
    return all(end.code == 0 for end in ends), f"{delay_s:.3f} s apart", faults


@functools.cache
def seconds_of(straight: Straight, name: str, place: Path) -> float:
    """How long a program takes, undisturbed; the page of the studio never ends."""
    straight.before(PROGRAMS[name][0], place)
    command, began = [sys.executable, "-m", "lidardesign", *PROGRAMS[name][1]], time.monotonic()
    with contextlib.suppress(subprocess.TimeoutExpired):
        subprocess.run(command, cwd=place, capture_output=True, check=False, timeout=LONGEST_PROGRAM_S)
    return time.monotonic() - began


def signalled(straight: Straight, sent: str, name: str, number: int, place: Path) -> dict[str, object]:
    """Send a program a signal at a random time, SIGINT to all of its processes, as terminals do."""
    seconds = seconds_of(straight, name, place / "before")
    after_s = np.random.default_rng([zlib.crc32(f"program {sent} {name}".encode()), number]).uniform(0, seconds)
    straight.before(PROGRAMS[name][0], place / "signalled")
    # a suite that runs in the background of a shell hands on that interruptions are ignored
    signal.signal(signal.SIGINT, signal.default_int_handler)
    with subprocess.Popen(
        [sys.executable, "-m", "lidardesign", *PROGRAMS[name][1]], cwd=place / "signalled", text=True,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, start_new_session=True,
    ) as process:  # fmt: skip
        time.sleep(after_s)
        met, began = process.poll() is None, time.monotonic()
        if met and sent == "SIGINT":
            os.killpg(process.pid, signal.SIGINT)
        elif met:
            process.terminate()
        said, _ = process.communicate()
    took_s, code = time.monotonic() - began, process.returncode
    faults = []
    # Python itself has a traceback for an interruption before the first line
    if met and (code not in ENDS[sent] or took_s > LONGEST_END_S or (code > 0 and "Traceback" in said)):
        faults.append(f"{name}, {sent} after {after_s:.3f} s: exit code {code} {took_s:.1f} s later: {said[-300:]}")
    if (place / "signalled" / "run").exists():
        faults += [
            f"{name}, {sent} after {after_s:.3f} s: unreadable: {fault}"
            for fault in unreadable(place / "signalled/run")
        ]
    return {
        "case": f"{name}, {sent} to the program", "counts": {"met at work, or both worked": int(met)},
        "figures": {"seconds to the end": took_s} if met else {}, "faults": faults,
    }  # fmt: skip


def worker_killed(straight: Straight, name: str, number: int, place: Path) -> dict[str, object]:
    """Kill one of a program's workers at a random time."""
    seconds = seconds_of(straight, name, place / "before")
    generator = np.random.default_rng([zlib.crc32(name.encode()), number])
    after_s = generator.uniform(0, seconds)
    straight.before(PROGRAMS[name][0], place / "killed")
    with subprocess.Popen(
        [sys.executable, "-m", "lidardesign", *PROGRAMS[name][1]], cwd=place / "killed", text=True,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
    ) as process:  # fmt: skip
        time.sleep(after_s)
        # the first keeps account of what the others share
        workers = psutil.Process(process.pid).children()[1:] if process.poll() is None else []
        began = time.monotonic()
        if workers:
            generator.choice(np.array(workers, dtype=object)).kill()
        said, _ = process.communicate()
    took_s, code = time.monotonic() - began, process.returncode
    told = code == NumericalError.exit_code and "a worker process died" in said
    faults = []
    if workers and (took_s > LONGEST_LOSS_S or not (told or code == 0)):
        faults.append(
            f"{name}, worker killed after {after_s:.3f} s: exit code {code} {took_s:.1f} s later: {said[-300:]}"
        )
    return {
        "case": f"{name}, {OF_A_WORKER}", "counts": {"met at work, or both worked": int(told)},
        "figures": {"seconds to the end": took_s} if workers else {}, "faults": faults,
    }  # fmt: skip
