"""Files are whole or absent, and a run knows what is in it."""

from __future__ import annotations

import contextlib
import errno
import itertools
import json
import os
import socket
import stat
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from lidardesign.errors import ConfigError, DataError
from lidardesign.run import files
from lidardesign.run import manifest as manifest_module
from lidardesign.run.files import run_lock, write_atomic, write_folder
from lidardesign.run.inputs import RECORD, UNFINISHED, read_file
from lidardesign.run.manifest import (
    announce,
    note,
    read_manifest,
    record,
    start_manifest,
    verify,
    write_manifest,
    write_recorded,
)

FULL = OSError(errno.ENOSPC, "No space left on device")
GONE = 2**22 + 1  # beyond the largest process id that Linux gives


def recorded(folder):
    """A run of one file."""
    start_manifest(folder, command=["lidardesign", "learn"], seed=7)
    write_atomic(folder / "data.bin", b"0123456789")
    record(folder, ["data.bin"])
    return folder


@pytest.fixture
def run(tmp_path):
    return recorded(tmp_path)


def test_a_write_makes_folders_and_leaves_only_the_file(tmp_path):
    path = tmp_path / "deep" / "name with spaces é.txt"
    write_atomic(path, "text é")
    assert path.read_text(encoding="utf-8") == "text é"
    assert os.listdir(path.parent) == [path.name]
    assert stat.S_IMODE(path.stat().st_mode) & stat.S_IRUSR


@pytest.mark.hard_case("38")
@pytest.mark.parametrize(
    ("failing", "error", "told", "words"),
    [
        ("fsync", FULL, DataError, "No space left"),
        ("replace", FULL, DataError, "No space left"),
        ("replace", KeyboardInterrupt, KeyboardInterrupt, None),
    ],
)
def test_a_write_that_fails_or_is_interrupted_leaves_the_old_file_and_no_temporary(
    tmp_path, monkeypatch, failing, error, told, words
):
    path = tmp_path / "file"
    write_atomic(path, b"old")

    def fail(*_):
        raise error

    monkeypatch.setattr(files.os, failing, fail)
    with pytest.raises(told, match=words):
        write_atomic(path, b"new")
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["file"]


def test_a_folder_is_not_a_file(tmp_path):
    with pytest.raises(DataError, match="folder"):
        write_atomic(tmp_path, b"")
    with pytest.raises(DataError, match="cannot be written"):
        write_atomic(tmp_path / "a" / "b", b"") or write_atomic(tmp_path / "a" / "b" / "c", b"")


def test_a_device_is_written_straight():
    write_atomic(Path("/dev/null"), b"gone")
    assert stat.S_ISCHR(os.stat("/dev/null").st_mode), "a rename over it would have left a file"


@pytest.mark.hard_case("38")
@pytest.mark.parametrize("name", ["samples.npz", "größe " * 14 + ".npz"])
def test_the_next_writer_of_a_file_removes_what_a_killed_one_left(tmp_path, name):
    left = files.temporary_beside(tmp_path / name)
    abandoned = left.with_name(left.name.replace(f"-{os.getpid()}.", f"-{GONE}."))
    at_work, of_another_file = left, abandoned.with_name(f".other{abandoned.name}")
    of_another_computer = abandoned.with_name(abandoned.name.replace(files.host_mark(), "0" * 8))
    for path in (abandoned, at_work, of_another_file, of_another_computer):
        path.write_bytes(b"half")
    write_atomic(tmp_path / name, b"whole")
    assert {path.name for path in tmp_path.iterdir()} == {
        name, at_work.name, of_another_file.name, of_another_computer.name
    }  # fmt: skip


def test_the_run_s_next_writer_cleans_its_folders_but_not_what_is_at_work_or_not_ours(tmp_path):
    (tmp_path / "designs").mkdir()
    left = tmp_path / f".mounts.{'0' * 8}-{GONE}.0.tmp" / "half"
    left.mkdir(parents=True)
    at_work = files.temporary_beside(tmp_path / "designs" / "fit.yaml")
    abandoned = at_work.with_name(at_work.name.replace(f"-{os.getpid()}.", f"-{GONE}."))
    foreign = tmp_path / "designs" / ".notes.tmp"
    for path in (at_work, abandoned, foreign):
        path.write_bytes(b"half")
    with run_lock(tmp_path):
        assert {*tmp_path.iterdir()} == {tmp_path / ".lock", tmp_path / "designs"}
        assert {*(tmp_path / "designs").iterdir()} == {at_work, foreign}


OLD, NEW = ({name: f"{word} {name}".encode() for name in "abc"} for word in ("old", "new"))
# Every step by which what is on the disk changes.
STEPS = [
    *((os, name) for name in ("fsync", "mkdir", "rename", "replace")), (Path, "write_text"),
    (files, "exchange"), (os, "rmdir"), (os, "unlink"),
]  # fmt: skip
PLACES = ("absent", "empty", "old", "a link", "among others", "its own mode", "the working folder", "no exchange")


def place_of(kind, folder, patch):
    """A folder of a kind, with the old set of files in it."""
    folder = folder / kind.replace(" ", "_")
    if kind not in ("absent", "empty"):
        write_folder(folder, OLD)
    if kind == "empty":
        folder.mkdir(parents=True)
    elif kind == "a link":
        folder.rename(folder.with_name("far"))
        folder.symlink_to("far")
    elif kind == "among others":
        (folder / "mine").write_bytes(b"mine")
    elif kind == "its own mode":
        folder.chmod(0o750)
    elif kind == "the working folder":
        patch.chdir(folder)
    elif kind == "no exchange":
        patch.setattr(files, "exchange", lambda *_: False)
    return folder


def at_step(patch, number, act, steps=STEPS):
    """Do something instead of one of some steps; gives the list of those that were taken."""
    taken = []

    def counting(real, name):
        def step(*given, **options):
            taken.append(name)
            return act() if len(taken) == number else real(*given, **options)

        return step

    for owner, name in steps:
        patch.setattr(owner, name, counting(getattr(owner, name), name))
    return taken


def state(folder):
    """What a set is: old, new, absent or unfinished, as it says itself; None where it is mixed and says nothing."""
    found = {name: (folder / name).read_bytes() for name in NEW if (folder / name).exists()}
    if (folder / UNFINISHED).exists() and (folder / UNFINISHED).read_bytes():
        with pytest.raises(DataError, match="a set that is unfinished"):
            read_file(folder / "a", RECORD)
        return "unfinished"
    return next((word for word, whole in (("absent", {}), ("old", OLD), ("new", NEW)) if found == whole), None)


def killed_at(number, folder):
    """Write the new set in a fork that ends at a step; whether it got so far."""
    child = os.fork()
    if not child:
        at_step(pytest.MonkeyPatch(), number, lambda: os._exit(9))
        write_folder(folder, NEW)
        os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 9


def full_at(number, folder):
    """Write the new set on a disk that is full at a step; whether it got so far."""

    def fail():
        raise FULL

    with pytest.MonkeyPatch.context() as patch:
        taken = at_step(patch, number, fail, STEPS[:-3])
        with contextlib.suppress(DataError):
            write_folder(folder, NEW)
    return len(taken) >= number


@pytest.mark.skipif(not hasattr(os, "fork"), reason="a kill is tried in a fork")
@pytest.mark.parametrize("kind", PLACES)
@pytest.mark.parametrize("fails_at", [killed_at, full_at])
def test_a_folder_is_the_old_or_the_new_one_or_names_itself_unfinished_whatever_step_fails(tmp_path, kind, fails_at):
    found = set()
    for number in itertools.count(1):
        with pytest.MonkeyPatch.context() as patch:
            folder = place_of(kind, tmp_path / str(number), patch)
            before, mode = state(folder), folder.stat().st_mode if folder.exists() else None
            failed = fails_at(number, folder)
            left = state(folder)
            assert left in (before, "new", "unfinished")
            found |= {left} if failed else set()
            write_folder(folder, NEW)
            assert (state(folder), [*folder.parent.rglob(".*")]) == ("new", [])
            assert (folder / "mine").exists() == (kind == "among others")
            assert folder.is_symlink() == (kind == "a link")
            assert mode in (None, folder.stat().st_mode)
        if not failed:
            break
    assert number > len(NEW)
    assert ("unfinished" in found) == (kind in PLACES[4:])


def test_a_set_that_is_unfinished_stays_named_until_its_own_files_are_whole(tmp_path):
    (tmp_path / UNFINISHED).write_text("a\nz")
    write_folder(tmp_path, NEW)
    assert (tmp_path / UNFINISHED).read_text() == "z"
    assert read_file(tmp_path / "a", RECORD) == NEW["a"]


def test_a_folder_in_the_way_of_a_file_is_named_and_nothing_is_replaced(tmp_path):
    write_folder(tmp_path / "set", OLD)
    (tmp_path / "set" / "b").unlink()
    (tmp_path / "set" / "b").mkdir()
    with pytest.raises(DataError, match="b: is a folder"):
        write_folder(tmp_path / "set", NEW)
    assert {path.name for path in (tmp_path / "set").iterdir()} == {*OLD}
    assert (tmp_path / "set" / "a").read_bytes() == OLD["a"]


def test_two_writers_of_one_folder_do_not_mix(tmp_path):
    for kind in ("old", "among others"):
        with pytest.MonkeyPatch.context() as patch:
            folder = place_of(kind, tmp_path, patch)
        sets = [{name: bytes([number]) for name in "abc"} for number in range(8)]
        writers = [threading.Thread(target=write_folder, args=(folder, one)) for one in sets]
        for writer in writers:
            writer.start()
        for writer in writers:
            writer.join()
        assert {name: (folder / name).read_bytes() for name in "abc"} in sets
        assert not [*folder.parent.rglob(".*")]


def test_a_recorded_file_verifies_and_the_manifest_says_what_made_it(run):
    verify(run, "data.bin")
    manifest = read_manifest(run)
    assert manifest["seed"] == 7
    assert manifest["versions"]["numpy"]
    assert manifest["files"]["data.bin"]["bytes"] == 10


def test_notes_merge_into_the_manifest(run):
    note(run, timings={"learn": 1.0})
    note(run, timings={"fit": 2.0}, learn={"ess": 0.5})
    manifest = read_manifest(run)
    assert manifest["timings"] == {"learn": 1.0, "fit": 2.0}
    assert manifest["learn"] == {"ess": 0.5}


def changed(**changes):
    """Damage to the manifest's top level."""
    return lambda run, document: write_manifest(run, {**document, **changes})


def with_entry(entry):
    """Damage to the manifest's entry of the file."""
    return lambda run, document: write_manifest(run, {**document, "files": {"data.bin": entry(document)}})


DAMAGE = {
    "missing": (lambda run, _: (run / "data.bin").unlink(), "is missing"),
    "truncated": (lambda run, _: (run / "data.bin").write_bytes(b"01234"), "truncated: 5 of 10"),
    "changed": (lambda run, _: (run / "data.bin").write_bytes(b"0123456788"), "changed after"),
    "appended": (lambda run, _: (run / "data.bin").write_bytes(b"0123456789 "), "changed after"),
    "unrecorded": (changed(files={}), "is not listed"),
    "no manifest": (lambda run, _: (run / "manifest.json").unlink(), "not a run folder"),
    "garbage manifest": (lambda run, _: (run / "manifest.json").write_text("{"), "cannot be read"),
    "newer": (changed(schema_version=2), "schema version 2"),
    "timings": (changed(timings=[5]), "the manifest's 'timings' is damaged"),
    "learn": (changed(learn=[5]), "the manifest's 'learn' is damaged"),
    "visibility": (changed(visibility="words"), "visibility 'words'"),
    "number of visibility": (changed(visibility=[5]), "visibility \\[5\\]"),
    "entry": (with_entry(lambda _: 5), "entry of data.bin is damaged"),
    "empty entry": (with_entry(lambda _: {}), "entry of data.bin is damaged"),
    "replaced entry": (
        with_entry(lambda document: {**document["files"]["data.bin"], "replaces": [1]}), "entry of data.bin is damaged"
    ),
}  # fmt: skip


@pytest.mark.parametrize("how", DAMAGE)
def test_every_damage_has_its_own_message(tmp_path, how):
    run, (damage, message) = recorded(tmp_path), DAMAGE[how]
    damage(run, json.loads((run / "manifest.json").read_text()))
    with pytest.raises(DataError, match=message):
        verify(run, "data.bin")


HOLDER = """
import sys, time
from lidardesign.run.files import run_lock
with run_lock(sys.argv[1]):
    print("held", flush=True)
    time.sleep(60)
"""


def test_the_lock_of_a_killed_process_is_free(tmp_path):
    holder = subprocess.Popen([sys.executable, "-c", HOLDER, tmp_path], stdout=subprocess.PIPE, text=True)
    assert holder.stdout.readline() == "held\n"
    name = f"process {holder.pid} on {socket.gethostname()}"
    assert files.writer(tmp_path) == name
    with pytest.raises(ConfigError, match=f"{name} is writing this run"), run_lock(tmp_path):
        pass
    holder.kill()
    holder.wait()
    holder.stdout.close()
    (tmp_path / ".flow.1.aa.tmp").write_bytes(b"half")
    assert files.writer(tmp_path) is None
    with run_lock(tmp_path):
        assert os.listdir(tmp_path) == [files.FILE_NAME]
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("content", ["", "{}", "[]", json.dumps({"pid": 1, "host": "elsewhere"})])
def test_a_lock_file_that_nobody_holds_is_no_obstacle(tmp_path, content):
    (tmp_path / files.FILE_NAME).write_text(content)
    assert files.writer(tmp_path) == ("process 1 on elsewhere" if "host" in content else "another process")
    with run_lock(tmp_path):
        assert files.writer(tmp_path) == f"process {os.getpid()} on {socket.gethostname()}"
    assert files.writer(tmp_path) is None


def test_a_writer_waits_for_one_that_holds_the_run_for_an_instant(tmp_path):
    held = threading.Event()

    def hold():
        with run_lock(tmp_path):
            held.set()
            time.sleep(0.2)

    thread = threading.Thread(target=hold)
    thread.start()
    held.wait()
    with run_lock(tmp_path, wait_s=30):
        assert (tmp_path / files.FILE_NAME).exists()
    thread.join()
    assert not (tmp_path / files.FILE_NAME).exists()


def test_a_file_verifies_before_and_after_the_write_that_was_announced(run):
    announce(run, "first.bin", b"content")
    with pytest.raises(DataError, match="missing"):
        verify(run, "first.bin")
    announce(run, "data.bin", b"new content")
    verify(run, "data.bin")
    announce(run, "data.bin", b"newer content")
    verify(run, "data.bin")
    write_atomic(run / "data.bin", b"newer content")
    verify(run, "data.bin")
    record(run, ["data.bin"])
    assert set(read_manifest(run)["files"]["data.bin"]) == {"sha256", "bytes"}
    write_atomic(run / "data.bin", b"0123456789")
    with pytest.raises(DataError, match="truncated"):
        verify(run, "data.bin")


def test_a_file_that_somebody_is_still_making_says_to_wait(run):
    with pytest.raises(DataError, match="--resume"):
        verify(run, "samples.npz")
    with run_lock(run), pytest.raises(DataError, match=f"process {os.getpid()} .* still learning it: wait"):
        verify(run, "samples.npz")


@pytest.mark.hard_case("P3")
@pytest.mark.parametrize("stopped_at", ["announce", "write_atomic", "record"])
def test_a_kill_while_a_run_s_file_is_written_anew_leaves_one_that_verifies(tmp_path, monkeypatch, stopped_at):
    run = recorded(tmp_path)
    names = ("announce", "write_atomic", "record")

    def killed(*_):
        raise KeyboardInterrupt

    for name in names[names.index(stopped_at) :]:
        monkeypatch.setattr(manifest_module, name, killed)
    with pytest.raises(KeyboardInterrupt):
        write_recorded(run, "data.bin", b"longer than it was")
    verify(run, "data.bin")


def test_a_file_that_nobody_recorded_is_told_from_one_that_is_not_there_yet(run):
    (run / "foreign.bin").write_bytes(b"?")
    with pytest.raises(DataError, match="not listed"):
        verify(run, "foreign.bin")
    with pytest.raises(DataError, match=r"has no absent\.bin yet"):
        verify(run, "absent.bin")
    with pytest.raises(DataError, match="no such run"):
        verify(run / "nowhere", "data.bin")
