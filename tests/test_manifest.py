"""Files are whole or absent, and a run knows what is in it."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import stat
import threading

import numpy as np
import pytest

from lidardesign.errors import ConfigError, DataError
from lidardesign.run import checkpoint, files, lock
from lidardesign.run.checkpoint import load_arrays, save_arrays
from lidardesign.run.files import remove_stray_temporaries, sha256_file, write_atomic
from lidardesign.run.lock import run_lock
from lidardesign.run.manifest import announce, note, read_manifest, record, start_manifest, verify, write_manifest


@pytest.fixture
def run(tmp_path):
    start_manifest(tmp_path, command=["lidardesign", "learn"], seed=7)
    write_atomic(tmp_path / "data.bin", b"0123456789")
    record(tmp_path, ["data.bin"])
    return tmp_path


def test_a_write_makes_folders_and_leaves_only_the_file(tmp_path):
    path = tmp_path / "deep" / "name with spaces é.txt"
    write_atomic(path, "text é")
    assert path.read_text(encoding="utf-8") == "text é"
    assert os.listdir(path.parent) == [path.name]
    assert stat.S_IMODE(path.stat().st_mode) & stat.S_IRUSR


@pytest.mark.parametrize("failing", ["fsync", "replace"])
def test_a_write_that_fails_leaves_the_old_file_and_no_temporary(tmp_path, monkeypatch, failing):
    path = tmp_path / "file"
    write_atomic(path, b"old")

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(files.os, failing, full)
    with pytest.raises(DataError, match="No space left"):
        write_atomic(path, b"new")
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["file"]


def test_an_interrupted_write_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "file"
    write_atomic(path, b"old")
    monkeypatch.setattr(files.os, "replace", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        write_atomic(path, b"new")
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["file"]


def test_a_folder_is_not_a_file(tmp_path):
    with pytest.raises(DataError, match="folder"):
        write_atomic(tmp_path, b"")
    with pytest.raises(DataError, match="cannot be written"):
        write_atomic(tmp_path / "a" / "b", b"") or write_atomic(tmp_path / "a" / "b" / "c", b"")


def test_a_device_is_written_straight():
    write_atomic("/dev/null", b"gone")
    assert stat.S_ISCHR(os.stat("/dev/null").st_mode), "a rename over it would have left a file"


def test_stray_temporaries_of_killed_writers_are_removed(tmp_path):
    (tmp_path / ".samples.npz.123.abcdef12.tmp").write_bytes(b"half")
    (tmp_path / "samples.npz").write_bytes(b"whole")
    assert len(remove_stray_temporaries(tmp_path)) == 1
    assert os.listdir(tmp_path) == ["samples.npz"]


def test_the_hash_is_sha256(tmp_path):
    content = os.urandom(3_000_000)
    (tmp_path / "file").write_bytes(content)
    assert sha256_file(tmp_path / "file") == hashlib.sha256(content).hexdigest()


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


def break_run(run, how):
    data, manifest = run / "data.bin", run / "manifest.json"
    document = json.loads(manifest.read_text())
    if how == "missing":
        data.unlink()
    elif how == "truncated":
        data.write_bytes(b"01234")
    elif how == "changed":
        data.write_bytes(b"0123456788")
    elif how == "appended":
        data.write_bytes(b"0123456789 ")
    elif how == "unrecorded":
        write_manifest(run, {**document, "files": {}})
    elif how == "no manifest":
        manifest.unlink()
    elif how == "garbage manifest":
        manifest.write_text("{")
    elif how == "newer":
        write_manifest(run, {**document, "schema_version": 2})
    elif how in ("timings", "goal", "learn"):
        write_manifest(run, {**document, how: [5]})
    elif how in ("visibility", "number of visibility"):
        write_manifest(run, {**document, "visibility": "words" if how == "visibility" else [5]})
    elif how == "entry":
        write_manifest(run, {**document, "files": {"data.bin": 5}})
    elif how == "empty entry":
        write_manifest(run, {**document, "files": {"data.bin": {}}})
    elif how == "replaced entry":
        write_manifest(run, {**document, "files": {"data.bin": {**document["files"]["data.bin"], "replaces": [1]}}})


MESSAGES = {
    "missing": "is missing",
    "truncated": "truncated: 5 of 10",
    "changed": "changed since",
    "appended": "changed since",
    "unrecorded": "is not listed",
    "no manifest": "no run folder",
    "garbage manifest": "cannot be read",
    "newer": "schema version 2",
    "timings": "the manifest's 'timings' is damaged",
    "goal": "the manifest's 'goal' is damaged",
    "learn": "the manifest's 'learn' is damaged",
    "visibility": "visibility 'words'",
    "number of visibility": "visibility \\[5\\]",
    "entry": "entry of data.bin is damaged",
    "empty entry": "entry of data.bin is damaged",
    "replaced entry": "entry of data.bin is damaged",
}


@pytest.mark.parametrize("how", MESSAGES)
def test_every_damage_has_its_own_message(run, how):
    break_run(run, how)
    with pytest.raises(DataError, match=MESSAGES[how]):
        verify(run, "data.bin")


def test_a_run_that_is_not_there_says_so(tmp_path):
    with pytest.raises(DataError, match="no such run"):
        verify(tmp_path / "nowhere", "data.bin")


def test_a_second_writer_is_told_who_holds_the_run(tmp_path):
    with run_lock(tmp_path):
        with pytest.raises(ConfigError, match=f"process {os.getpid()}"), run_lock(tmp_path):
            pass
        assert (tmp_path / lock.FILE_NAME).exists()
    assert not (tmp_path / lock.FILE_NAME).exists()


@pytest.mark.parametrize("change", [{"pid": 2**22 + 1}, {"started": "0"}])
def test_the_lock_of_a_dead_process_is_taken_over(tmp_path, change):
    owner = {**lock._owner(), **change}
    (tmp_path / lock.FILE_NAME).write_text(json.dumps(owner))
    (tmp_path / ".flow.1.aa.tmp").write_bytes(b"half")
    with run_lock(tmp_path):
        assert not (tmp_path / ".flow.1.aa.tmp").exists()


@pytest.mark.parametrize("content", ["", "{}", json.dumps({"pid": 1, "host": "elsewhere"})])
def test_a_lock_of_unknown_origin_is_respected(tmp_path, content):
    (tmp_path / lock.FILE_NAME).write_text(content)
    with pytest.raises(ConfigError, match="is writing this run"), run_lock(tmp_path):
        pass


def test_a_writer_waits_for_one_that_holds_the_run_for_an_instant(tmp_path):
    holder = json.dumps({"pid": 1, "host": "elsewhere"})
    (tmp_path / lock.FILE_NAME).write_text(holder)
    threading.Timer(0.2, (tmp_path / lock.FILE_NAME).unlink).start()
    with run_lock(tmp_path, wait_s=30):
        assert (tmp_path / lock.FILE_NAME).read_text() != holder


def test_a_file_verifies_before_and_after_the_write_that_was_announced(run):
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


def test_a_file_that_was_announced_but_never_written_is_missing(run):
    announce(run, "first.bin", b"content")
    with pytest.raises(DataError, match="missing"):
        verify(run, "first.bin")


def test_a_file_that_nobody_recorded_is_told_from_one_that_is_not_there_yet(run):
    (run / "foreign.bin").write_bytes(b"?")
    with pytest.raises(DataError, match="not listed"):
        verify(run, "foreign.bin")
    with pytest.raises(DataError, match=r"holds no absent\.bin yet"):
        verify(run, "absent.bin")


@pytest.mark.parametrize("stopped_at", ["announce", "write_atomic", "record"])
def test_a_kill_at_any_moment_leaves_a_checkpoint_that_loads(run, monkeypatch, stopped_at):
    save_arrays(run, "state.safetensors", {"step": np.arange(3)}, {"step": 1})
    names = ("announce", "write_atomic", "record")
    with monkeypatch.context() as patched:

        def killed(*_):
            raise KeyboardInterrupt

        for name in names[names.index(stopped_at) :]:
            patched.setattr(checkpoint, name, killed)
        with pytest.raises(KeyboardInterrupt):
            save_arrays(run, "state.safetensors", {"step": np.arange(4)}, {"step": 2})
    arrays, state = load_arrays(run, "state.safetensors")
    assert len(arrays["step"]) == state["step"] + 2
    save_arrays(run, "state.safetensors", {"step": np.arange(5)}, {"step": 3})
    assert load_arrays(run, "state.safetensors")[1] == {"step": 3}
