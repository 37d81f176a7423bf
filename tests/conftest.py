"""What every test keeps to: no global random state, default dtype or thread count is touched."""

from __future__ import annotations

import collections
import functools
import os
import shutil
import sys

# Set before numpy and torch are imported: two thread pools on shared cores spin against each other.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import numpy as np
import pytest
import typer
from hypothesis import HealthCheck, settings
from lidardesign_tasks import flatland

settings.register_profile("dev", max_examples=25, deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("ci", max_examples=100, deadline=None, derandomize=True, print_blob=True)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "ci" if os.environ.get("CI") else "dev"))


# Files that take longest, which are begun first: a worker that begins one last is waited for by the others.
LONGEST = (
    "test_benchmarks.py",
    "test_examples.py",
    "test_docs_run.py",
    "test_bad_input.py",
    "test_hard_flow.py",
    "test_hard_fields.py",
    "test_hard_space.py",
    "test_hard_processes.py",
    "test_cluster.py",
    "test_worker_processes.py",
)


def pytest_collection_modifyitems(items):
    """Begin with the files that take longest; everything else stays as it is."""
    order = {name: place for place, name in enumerate(LONGEST)}
    items.sort(key=lambda item: order.get(item.path.name, len(LONGEST)))


def pytest_terminal_summary(terminalreporter):
    """Count what was skipped by its reasons, as the last lines."""
    skipped = terminalreporter.stats.get("skipped", ())
    reasons = collections.Counter(report.longrepr[2].removeprefix("Skipped: ") for report in skipped)
    for reason, count in reasons.most_common():
        terminalreporter.write_line(f"{count} skipped: {reason}")


# Numbers of scenes, and of sensors, poses and sets that are tried, with the modules that read them.
SMALL = (
    ("FEW_SCENES", 5, "rays.information rays.training_scenes rays.selection fitting.chosen fitting.trials"),
    ("MOST_SCENES", 10, "rays.information rays.selection fitting.trials"),
    ("MOST_SCENES", 60, "rays.adaptive"),
    ("USUAL_SCENES", 10, "methods.greedy"),
    ("COUNTS", (1, 2), "fitting.fit"),
    ("MOST_POSES", 60, "fitting.part_design"),
    ("MOST_JUDGED", 3, "fitting.part_design"),
)


@pytest.fixture(autouse=True, scope="session")
def work_is_shortened():
    """Rays and sensors are chosen as users choose them, but on fewer scenes: those take half a minute.

    The command line is built once, not by every command.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(typer.main, "get_command", functools.cache(typer.main.get_command))
        for name, number, modules in SMALL:
            for module in modules.split():
                patch.setattr(f"lidardesign.{module}.{name}", number)
        patch.setattr(flatland, "visible_outline", kept_outlines(flatland.visible_outline))
        yield


def kept_outlines(visible_outline):
    """What flatland finds visible, found once of the same shapes at the same places from the same space."""
    known = {}

    def found(scene, space):
        shapes = tuple((body.shape, body.is_target, body.pose().tobytes()) for body in scene.bodies)
        key = shapes, (*space.low, *space.high)
        if key not in known:
            known[key] = visible_outline(scene, space)
        return known[key].copy()

    return found


def _torch_state() -> tuple[object, ...] | None:
    torch = sys.modules.get("torch")
    if torch is None or not hasattr(torch, "get_rng_state"):
        return None
    return bytes(torch.get_rng_state().numpy()), torch.get_default_dtype(), torch.get_num_threads()


@pytest.fixture(autouse=True)
def global_state_is_untouched():
    """Fail a test that draws from a global generator or changes torch's default dtype or threads."""
    numpy_before, torch_before = _numpy_state(), _torch_state()
    yield
    assert _numpy_state() == numpy_before, "the test changed numpy's global random state"
    if torch_before is not None:
        names = ("global random state", "default dtype", "thread count")
        for name, before, after in zip(names, torch_before, _torch_state(), strict=True):
            assert after == before, f"the test changed torch's {name}"


def _numpy_state() -> tuple[object, ...]:
    name, keys, *rest = np.random.get_state()  # noqa: NPY002 (it is this state that must not change)
    return name, keys.tobytes(), *rest


@pytest.fixture
def lidardesign(capsys, tmp_path, monkeypatch):
    """Run the program in this process, in an empty folder: see `caller`."""
    from support.command_line import caller

    return caller(capsys, tmp_path, monkeypatch)


call = lidardesign


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A small run that no test changes."""
    from support.command_line import make_run

    return make_run(tmp_path_factory.mktemp("made") / "run")


@pytest.fixture
def flat(made, tmp_path):
    """A copy of the small run."""
    return shutil.copytree(made, tmp_path / "run")


@pytest.fixture
def own_cache(tmp_path, monkeypatch):
    """No field of another test is read from the cache."""
    monkeypatch.setenv("LIDARDESIGN_CACHE", str(tmp_path / "cache"))
