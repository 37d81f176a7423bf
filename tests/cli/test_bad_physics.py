"""What a user can get wrong about detectors, effects, surroundings, scanners and captures: one message each."""

from __future__ import annotations

import math

import numpy as np
import pytest
from lidardesign_tasks.flatland import FlatlandTask
from support.command_line import files_under, make_run
from support.mistakes import GARBAGE, GOOD, check_one_clear_message

from lidardesign.cli.terminal.output import EXIT_INTERRUPTED, Output, describe_error
from lidardesign.errors import PluginError
from lidardesign.registry import plugin_guard
from lidardesign.scenes.scene import Ambient, Body, Medium, Receiver, Scene, Sphere
from lidardesign.simulate.light_transport import transport as light_transport_process

LONG = "x" * 300
TEXTS = {
    "empty.yaml": "",
    "short.yaml": "bin_ps: 100\nbins: 3\n",
    "pulse.yaml": "bin_ps: 100\nbins: 3\nhistogram_start: pulse\n",
    "shape.yaml": "origin:\n  exclude: [[0, 0, 0], [1, 1, 1]]\n",
    "turned.yaml": "origin:\n  exclude: [{low_m: [1, 0, 0], high_m: [0, 1, 1]}]\n",
    "key.yaml": "origin:\n  exclude: [{low: [0, 0, 0], high_m: [1, 1, 1]}]\n",
    "all.yaml": "origin:\n  exclude: [{low_m: [-9, -9, -9], high_m: [9, 9, 9]}]\n",
    "fixed.yaml": "origin: {fixed_m: [0.3, 0, 0], exclude: [{low_m: [0.2, -1, -1], high_m: [0.4, 1, 1]}]}\n",
    "far.yaml": GOOD.replace("end: 0.4", "end: 1e300"),
    "wide.yaml": GOOD.replace("horizontal: 0.2", "horizontal: 1.2"),
    "open.yaml": GOOD.replace("budget: {rays: 100}", ""),
    "none.yaml": GOOD.replace("rays: 100", "rays: 0"),
    "elsewhere.yaml": GOOD.replace("[0.4, 0.0, 0.0]", "[1.4, 0.0, 0.0]"),
}

CASES = [
    *(
        (f"evaluate run --rays 8 --detector {name}", 2, words)
        for name, words in {
            "absent.yaml": "there is no detector 'absent.yaml'",
            "../ideal": "did you mean 'ideal'",
            "Ideal": "did you mean 'ideal'",
            LONG: "there is no detector",
            "garbage": "is not UTF-8 text",
            "run": "it is a folder",
            "empty.yaml": "does not describe a detector",
            "short.yaml": "is longer than the histogram",
            "pulse.yaml": "outside the histogram, which starts with the pulse",
        }.items()
    ),
    ("evaluate run --effects ambint", 2, "did you mean 'ambient'"),
    ("evaluate run --effects dew", 2, "unknown effect 'dew'"),
    ("evaluate run --effects ALL", 2, "did you mean 'all'"),
    ("evaluate run --effects audit,all", 2, "one of auto, all, none, audit alone"),
    ("evaluate run --effects jitter,none", 2, "one of auto, all, none, audit alone"),
    ("evaluate run --effects jitter,", 2, "unknown effect ''"),
    *(
        (f"evaluate run {option} {value}", 2, f"{option}: ")
        for option in ("--range-tolerance-mm", "--return-tolerance")
        for value in ("0", "-1", "nan", "inf")
    ),
    ("evaluate good.yaml far.yaml --in run --rays 8", 2, "gate_m.end: found 1e+300"),
    ("evaluate bare --effects audit", 3, "no designs yet"),
    *(
        (f"learn flatland --set {key}={value}", 2, f"--set {key}={value}")
        for key, value in [
            ("illuminance_lux", "1e9"),
            ("light", "moon"),
            ("visibility_m", "0"),
            ("visibility_m", "1e-300"),
            ("reflectance", "1.1"),
            ("gloss", ".nan"),
        ]
    ),
    ("learn face --set speed_m_s=1e9", 2, "--set speed_m_s=1e9"),
    ("learn emitter --set field_of_view_deg=[60,180]", 2, "allowed: less than 180"),
    ("learn emitter --set emitter_box_m=-0.1", 2, "half sizes are 0 m or more"),
    ("learn emitter --set detector_m=[1,2]", 2, "allowed: a list of 3 values"),
    ("learn emitter --set detector_m=[nan,0,0]", 2, "a finite number"),
    ("constrain run --constraints shape.yaml", 2, "allowed: keys and values"),
    ("constrain run --constraints turned.yaml", 2, "low_m is above high_m along x"),
    ("constrain run --constraints key.yaml", 2, "did you mean 'low_m'"),
    ("constrain run --constraints all.yaml", 4, "origin.exclude[0]"),
    ("constrain run --constraints fixed.yaml", 4, "origin.fixed_m"),
    ("export wide.yaml --format galvo", 2, "beyond the mirrors' reach"),
    ("export far.yaml --format galvo", 2, "less than or equal to"),
    ("export open.yaml --format galvo", 2, "give --rays N"),
    ("capture broken.npz good.yaml", 3, "cut short"),
    ("capture far.npz good.yaml", 3, "origin_m"),
    ("capture scan.npz none.yaml", 2, "none.yaml:2:30: budget.rays"),
    ("capture scan.npz header.galvo.csv", 3, "header.galvo.csv: fires no ray"),
    ("capture scan.npz good.yaml elsewhere.yaml", 3, "elsewhere: none of the 100 rays was captured"),
    ("capture scan.npz long.galvo.csv", 3, "long.galvo.csv:2: "),
]


@pytest.fixture(scope="module")
def mistakes(tmp_path_factory):
    """A folder with everything that can be got wrong in it."""
    folder = tmp_path_factory.mktemp("physics")
    for name, text in {"good.yaml": GOOD, **TEXTS}.items():
        (folder / name).write_text(text)
    (folder / "garbage").write_bytes(GARBAGE)
    (folder / "broken.npz").write_bytes(GARBAGE)
    np.savez(folder / "scan.npz", **scan())
    np.savez(folder / "far.npz", **{**scan(), "origin_m": [1e300, 0.0, 0.0]})
    make_run(folder / "run", count=1000)
    make_run(folder / "bare", count=1000)
    return folder


def scan():
    """A capture of a wall at 0.3 m, as `GOOD` sees it."""
    y, x = np.meshgrid(np.linspace(-10, 10, 11), np.linspace(-10, 10, 11))
    counts = np.zeros((121, 60), dtype=np.uint16)
    counts[:, 20] = 50
    angles = {"x_deg": x.ravel(), "y_deg": y.ravel(), "boresight_azimuth_deg": 180.0, "boresight_elevation_deg": 0.0}
    return {"counts": counts, "bin_width_ps": 100.0, "start_ps": 0.0, "origin_m": [0.4, 0.0, 0.0], **angles}


@pytest.fixture
def ready(mistakes, lidardesign, monkeypatch):
    """The program in the folder of mistakes, whose run has a design and whose scanner file is there."""
    monkeypatch.chdir(mistakes)
    if not (mistakes / "header.galvo.csv").exists():
        assert lidardesign("fit", "run", "--layout", "even", "--sensors", 1).code == 0
        assert lidardesign("export", "good.yaml", "--format", "galvo").code == 0
        header, *rows = (mistakes / "good.galvo.csv").read_text().splitlines(keepends=True)
        (mistakes / "header.galvo.csv").write_text(header)
        (mistakes / "long.galvo.csv").write_text(header + "y" * 100_000 + rows[0])
        (mistakes / "marked.galvo.csv").write_text("\ufeff" + "".join([header, *rows]), encoding="utf-8")
    return lidardesign


@pytest.mark.parametrize(("arguments", "code", "words"), CASES, ids=[case[0][:70] for case in CASES])
def test_a_mistake_gets_one_short_message_its_exit_code_and_writes_nothing(mistakes, ready, arguments, code, words):
    before = files_under(mistakes)
    result = ready(*arguments.split(), "--json")
    check_one_clear_message(result, code, words)
    assert max(map(len, result.err.splitlines())) < 1200
    assert files_under(mistakes) == before
    assert not (mistakes / "runs").exists()


def test_an_empty_name_of_a_detector_is_no_folder(ready):
    check_one_clear_message(ready("evaluate", "run", "--detector", "", "--json"), 2, "--detector: is empty")


def test_spaces_around_effects_do_not_matter(ready):
    assert ready("evaluate", "run", "--rays", 8, "--effects", " none ").code == 0


def test_a_scanner_file_that_a_spreadsheet_saved_is_read(ready):
    plain, marked = (ready("capture", "scan.npz", f"{name}.galvo.csv", "--json") for name in ("good", "marked"))
    assert marked.code == 0, marked.err
    for row, again in zip(plain.json["rows"], marked.json["rows"], strict=True):
        assert {**row, "design": ""} == {**again, "design": ""}


# what a plugin may do to a scene, and the words of the message
SCENES = {
    "a negative reflectance": (lambda scene: Body(Sphere(1.0), reflectance=-0.1), "reflectance is -0.1"),
    "more light than comes": (lambda scene: Body(Sphere(1.0), reflectance=0.9, specular=0.2), "at most 1 in all"),
    "faster than light": (lambda scene: Body(Sphere(1.0), velocity_m_s=(3e8, 0, 0)), "slower than light"),
    "air of lead": (lambda scene: Medium(1e300, 0.0), "extinction_per_m is 1e+300"),
    "light by name": (lambda scene: Scene(scene.bodies, ambient="sun"), "ambient is 'sun'"),
    "air by number": (lambda scene: Scene(scene.bodies, medium=0.1), "medium is 0.1"),
    "a receiver by name": (lambda scene: Scene(scene.bodies, receiver="here"), "receiver is 'here'"),
    "a flat receiver": (lambda scene: Receiver((0.0, 0.0), 0, 0, 1, 1, (0, 1)), "three finite coordinates"),
    "a blind receiver": (lambda scene: Receiver((0.0, 0.0, 0.0), 0, 0, 0, 1, (0, 1)), "horizontal_rad is 0"),
    "no time": (lambda scene: Scene(scene.bodies, frame_rate_hz=math.nan), "frame_rate_hz is nan"),
    "dark light": (lambda scene: Ambient(-1.0), "-1.0 lux"),
}


@pytest.mark.parametrize("given", SCENES)
def test_a_plugin_that_gives_impossible_scenes_is_told_what_is_wrong(ready, monkeypatch, given):
    change, words = SCENES[given]
    scenes = FlatlandTask.scenes
    monkeypatch.setattr(FlatlandTask, "scenes", lambda *arguments: [change(scene) for scene in scenes(*arguments)])
    result = ready("evaluate", "run", "--rays", 8, "--json")
    check_one_clear_message(result, 3, words)


@pytest.mark.parametrize("place", ["[-0.05,0,0]", "[-0.1,0.02,0.01]"])
def test_a_detector_inside_of_a_head_is_refused(ready, place):
    result = ready("learn", "emitter", "--set", f"detector_m={place}", "--set", "train=2", "--json")
    check_one_clear_message(result, 2, "is inside the train head 0")
    assert "task.detector_m" in result.err


def test_a_library_that_cannot_be_is_named_where_it_comes_from(monkeypatch, tmp_path):
    monkeypatch.setattr(light_transport_process, "PACKAGES", {})
    for wrong in (tmp_path, tmp_path / "absent.so"):
        monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(wrong))
        assert light_transport_process.missing().endswith(f"newer: {wrong}")


def interrupted_kernel():
    """What a compiled kernel raises that was interrupted."""
    raise SystemError("returned a result with an exception set") from KeyboardInterrupt()


def test_an_interruption_inside_a_compiled_kernel_is_an_interruption():
    with pytest.raises(SystemError) as raised:
        interrupted_kernel()
    with pytest.raises(PluginError) as blamed, plugin_guard("flatland"):
        interrupted_kernel()
    for error in (raised.value, blamed.value):
        document, code, text = describe_error(error, Output())
        assert (document["kind"], code, text) == ("interrupted", EXIT_INTERRUPTED, "interrupted")
