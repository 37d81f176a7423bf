"""The manifest of a run: versions, command, time, and the SHA-256 of every file in it."""

from __future__ import annotations

import contextlib
import hashlib
import json
import platform
from collections.abc import Collection, Iterable, Iterator, Mapping
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from lidardesign import __version__
from lidardesign.errors import DataError
from lidardesign.run.clock import WAIT_S, Clock, peak_memory_bytes
from lidardesign.run.files import run_lock, sha256_file, write_atomic, writer
from lidardesign.run.inputs import RECORD, parse_json, read_file

FILE_NAME = "manifest.json"
SCHEMA_VERSION = 1
PACKAGES = ("numpy", "torch", "zuko", "embreex")
# What is merged or looked up by key; each may be missing.
MAPPINGS = ("timings", "learn", "inputs", "scores")
# What the run's own probe may have decided, where the configuration left it open.
VISIBILITIES = ("off", "raycast", "quadrature")
DAMAGED_HINT = "restore it or learn the run again"
LEARN_HINT = "lidardesign learn TASK --out RUN makes a run"


def versions() -> dict[str, str]:
    """Versions of the libraries that results depend on, read without importing them."""
    found = {"lidardesign": __version__, "python": platform.python_version()}
    for package in PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "absent"
    return found


def start_manifest(run: Path, *, command: list[str], seed: int) -> None:
    """Write the manifest of a new run: versions, command and time; no files yet."""
    manifest = {
        "schema_version": SCHEMA_VERSION,
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "command": list(command),
        "seed": seed,
        "versions": versions(),
        "timings": {},
        "files": {},
    }
    write_manifest(run, manifest)


def read_manifest(run: Path) -> dict[str, Any]:
    """The manifest of a run.

    Raises:
        DataError: There is no such run, or its manifest is damaged or of a newer version.
    """
    path = run / FILE_NAME
    if not run.exists():
        raise DataError("no such run", where=str(run), hint=LEARN_HINT)
    if not path.exists():
        raise DataError(f"is not a run folder: it has no {FILE_NAME}", where=str(run), hint=LEARN_HINT)
    try:
        manifest = parse_json(read_file(path, RECORD))
    except ValueError as error:
        raise DataError(f"the manifest cannot be read: {error}", where=str(path), hint="learn the run again") from None
    if not isinstance(manifest, dict) or not isinstance(manifest.get("files"), dict):
        raise DataError("the manifest lists no files", where=str(path), hint="learn the run again")
    # Refuse entries that this program does not write
    for name, entry in manifest["files"].items():
        contents = [entry, entry.get("replaces") or entry] if isinstance(entry, dict) else [entry]
        if not all(
            isinstance(content, dict)
            and isinstance(content.get("sha256"), str)
            and isinstance(content.get("bytes"), int)
            for content in contents
        ):
            raise DataError(f"the manifest's entry of {name} is damaged", where=str(path), hint=DAMAGED_HINT)
    decided = manifest.get("visibility")
    if decided is not None and decided not in VISIBILITIES:
        raise DataError(
            f"the manifest has visibility {decided!r}", where=str(path), allowed=", ".join(VISIBILITIES),
            hint=DAMAGED_HINT,
        )  # fmt: skip
    for name in MAPPINGS:
        if not isinstance(manifest.get(name) or {}, dict):
            raise DataError(f"the manifest's {name!r} is damaged", where=str(path), hint=DAMAGED_HINT)
    found = manifest.get("schema_version")
    if found != SCHEMA_VERSION:
        raise DataError(
            f"the manifest has schema version {found!r}", where=str(path), allowed=str(SCHEMA_VERSION),
            hint="use the version of lidardesign that made the run, or a newer one",
        )  # fmt: skip
    return manifest


@contextlib.contextmanager
def locked_run(run: Path, created: str | None = None, wait_s: float = WAIT_S) -> Iterator[dict[str, Any]]:
    """Hold the lock of a run that is still there, and give its manifest.

    Arguments:
        run: The run folder.
        created: When the run was made that must be in it; None: any.
        wait_s: Time to wait for another writer [s].

    Raises:
        ConfigError: Another process writes this run.
        DataError: It is gone, another run is in its folder, or it cannot be written.
    """
    read_manifest(run)  # the lock would make the folder
    with run_lock(run, wait_s=wait_s):
        manifest = read_manifest(run)
        if created not in (None, manifest.get("created")):
            raise DataError("another run has taken its place meanwhile", where=str(run), hint="give the command again")
        yield manifest


def write_manifest(run: Path, manifest: dict[str, Any]) -> None:
    """Replace the manifest of a run, atomically."""
    write_atomic(run / FILE_NAME, json.dumps(manifest, indent=2) + "\n")


def record(run: Path, names: Iterable[str]) -> None:
    """Enter the present size and SHA-256 of files of a run (names relative to it, with forward slashes)."""
    manifest = read_manifest(run)
    for name in names:
        path = run / name
        manifest["files"][Path(name).as_posix()] = {"sha256": sha256_file(path), "bytes": path.stat().st_size}
    write_manifest(run, manifest)


def forget(run: Path, names: Collection[str]) -> None:
    """Remove files of a run and then their entries; missing files lose only their entry."""
    if not names:
        return
    for name in names:
        (run / name).unlink(missing_ok=True)
    manifest = read_manifest(run)
    for name in names:
        manifest["files"].pop(Path(name).as_posix(), None)
    write_manifest(run, manifest)


def announce(run: Path, name: str, content: bytes) -> None:
    """Enter the hash of a file's next content before it is written; its present content stays valid as well.

    A process that is killed between the two writes then leaves a file that still verifies.
    """
    manifest = read_manifest(run)
    path, key = run / name, Path(name).as_posix()
    entry: dict[str, Any] = {"sha256": hashlib.sha256(content).hexdigest(), "bytes": len(content)}
    if key in manifest["files"] and path.is_file():
        present = {"sha256": sha256_file(path), "bytes": path.stat().st_size}
        if present["sha256"] in _hashes(manifest["files"][key]):
            entry["replaces"] = present
    manifest["files"][key] = entry
    write_manifest(run, manifest)


def write_recorded(run: Path, name: str, content: bytes) -> None:
    """Write a file of a run atomically, with its hash in the manifest at every moment."""
    announce(run, name, content)
    write_atomic(run / name, content)
    record(run, [name])


def changed_since_recorded(run: Path, name: str) -> str | None:
    """The change of a file since it was recorded, in words; None where it is unchanged or was not recorded.

    Raises:
        DataError: The manifest or the file cannot be read.
    """
    entry = read_manifest(run)["files"].get(Path(name).as_posix())
    if entry is None or sha256_file(run / name) in _hashes(entry):
        return None
    size = (run / name).stat().st_size
    if size < entry["bytes"]:
        return f"is truncated: {size} of {entry['bytes']} bytes"
    return "was changed after it was written (its SHA-256 differs from the manifest's)"


def _hashes(entry: dict[str, Any]) -> list[str]:
    """The valid SHA-256 values of a file: its own, and that of the content it replaces while being written."""
    return [version["sha256"] for version in (entry, entry.get("replaces")) if version]


def note(run: Path, **fields: Any) -> None:
    """Merge fields into the manifest; a mapping merges into a mapping of the same name."""
    manifest = read_manifest(run)
    for name, value in fields.items():
        old = manifest.get(name)
        manifest[name] = {**old, **value} if isinstance(old, dict) and isinstance(value, dict) else value
    write_manifest(run, manifest)


def verify(run: Path, name: str) -> None:
    """Check that a file of a run is there and is the one that was recorded.

    Raises:
        DataError: No such run; the file was never recorded; it is missing, truncated or changed.
    """
    path = run / name
    entry = read_manifest(run)["files"].get(Path(name).as_posix())
    if entry is None and path.exists():
        hint = "continue learning with --resume; if that does not help, remove the file"
        raise DataError("is not listed in the run's manifest", where=str(path), hint=hint)
    if entry is None:
        at_work = writer(run)
        unfinished = "learning was not finished: continue with --resume"
        hint = f"{at_work} is still learning it: wait" if at_work else unfinished
        raise DataError(f"the run has no {name} yet", where=str(run), hint=hint)
    if not path.is_file():
        raise DataError(
            "the manifest lists this file, but it is missing",
            where=str(path),
            hint="restore it, or learn again: --resume continues from the last checkpoint",
        )
    difference = changed_since_recorded(run, name)
    if difference is not None:
        raise DataError(difference, where=str(path), hint="restore it or learn the run again")


def keep_timings(
    run: Path,
    command: str,
    clock: Clock,
    *,
    wait_s: float = WAIT_S,
    created: str | None = None,
    further: Mapping[str, Any] | None = None,
) -> None:
    """Enter a command's times in a run's manifest, in place of those of the last time, under the run's lock.

    Arguments:
        run: The run folder.
        command: Its name.
        clock: Its clock.
        wait_s: Time to wait for another writer [s].
        created: When the run was made that must be in it; None: any.
        further: Mappings of the manifest that get further entries, by name.

    Raises:
        ConfigError, DataError: The run is being written, or cannot be.
    """
    entry: dict[str, Any] = {
        "when": datetime.now(UTC).isoformat(timespec="seconds"),
        "seconds": round(clock.seconds, 3),
        "peak_memory_bytes": peak_memory_bytes(),
        "phases": clock.timings(),
    }
    with locked_run(run, created, wait_s) as manifest:
        commands = {name: times for name, times in manifest.get("timings", {}).items() if isinstance(times, dict)}
        merged = {name: {**(manifest.get(name) or {}), **entries} for name, entries in (further or {}).items()}
        write_manifest(run, {**manifest, "timings": {**commands, command: entry}, **merged})
