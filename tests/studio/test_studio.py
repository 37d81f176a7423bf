"""The studio without a browser: what it keeps, whom it lets in, and that nothing asked for on the page ends it."""

from __future__ import annotations

import http.client
import math
import shlex
import signal
import socket
import threading
from dataclasses import replace

import numpy as np
import pytest
from support.command_line import files_under, program
from support.studios import make_robot_run, wait_for

pytest.importorskip("viser", reason="viser is not installed (extra: studio)")

from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from lidardesign.api.design import Design
from lidardesign.api.run import open_run
from lidardesign.errors import ConfigError, LidardesignError
from lidardesign.studio import open_page, server
from lidardesign.studio.choices import Choices, SensorPose, constraint_keys, key_label
from lidardesign.studio.studio import Studio

MODULE = "module-45x45-4x4"


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    run = open_run(make_robot_run(tmp_path_factory.mktemp("studio") / "robot"))
    run.fit(sensors=2, rays=16, name="two").save()
    return run


@pytest.fixture
def studio(robot):
    studio = Studio(robot)
    yield studio
    studio.stop()


@pytest.fixture
def choices(robot):
    (design,) = (one for one in robot.designs() if one.name == "two")
    return Choices(robot, design, {}, design)


def raised(pose, up_m=0.02):
    return SensorPose.of(np.add(pose.place_m, (0, 0, up_m)), pose.angles_deg)


def turned(pose, by_deg=5.0):
    return SensorPose.of(pose.place_m, np.add(pose.angles_deg, (by_deg, 0, 3 * by_deg)))


CHANGES = {
    "a limit of all": lambda one: one.constrained("field_of_view.horizontal_deg.max", "20"),
    "limits of one": lambda one: one.constrained("gate.end_m.max", "0.6", "s1").constrained("budget.rays", "12"),
    "a place": lambda one: one.moved("s0", raised(one.poses["s0"])),
    "a boresight": lambda one: one.moved("s1", turned(one.poses["s1"])),
    "modules at a place": lambda one: one.made_of(MODULE).moved("s1", raised(one.poses["s1"])),
    "a module turned": lambda one: one.made_of(MODULE).moved("s1", turned(one.poses["s1"], 30.0)),
    "the run itself": lambda one: replace(one.constrained("sensors.count", "1"), base=None),
    "sunlight": lambda one: replace(one, settings=("illuminance_lux=100000", "light=sun")),
}


@pytest.mark.parametrize("change", CHANGES)
def test_the_shown_command_writes_what_the_page_saves(choices, lidardesign, change):
    changed, name = CHANGES[change](choices), f"own-{[*CHANGES].index(change)}"
    fitted = changed.fit("studio")
    own = Design(replace(fitted.specification, name=name), fitted.run)
    saved = own.save().read_bytes()
    own.path.unlink()
    result = lidardesign(*shlex.split(changed.command(name))[1:])
    assert result.code == 0, result.err
    assert own.path.read_bytes() == saved


@pytest.mark.parametrize("change", ["a place", "a boresight", "a module turned"])
def test_what_is_moved_by_hand_is_there_after_the_fit(choices, change):
    name = "s0" if change == "a place" else "s1"
    moved = CHANGES[change](choices)
    asked, got = (one.poses[name] for one in (moved, replace(moved, design=moved.fit("moved"))))
    if change == "a place":
        assert got.place_m == asked.place_m
    else:
        assert got.angles_deg[:2] == asked.angles_deg[:2]
        # a fitted field is the same after a quarter turn; a part is not
        quarter = 360 if change == "a module turned" else 90
        assert math.remainder(got.angles_deg[2] - asked.angles_deg[2], quarter) == pytest.approx(0, abs=0.02)
    assert moved.freed(name).constraints.keys() <= {"sensors", "parts"}


def test_a_mount_goes_with_the_sensor_that_stands_at_it(choices):
    place = list(choices.poses["s0"].place_m)
    there = choices.constrained("origin.mounts_m", f"[[0.13, 0, 0.09], {place}]")
    moved = there.moved("s0", raised(there.poses["s0"]))
    assert moved.mounts_m[0] == [0.13, 0, 0.09]
    assert moved.mounts_m[1] == pytest.approx(np.add(place, (0, 0, 0.02)))
    assert "fixed_m" not in str(moved.constraints)


def test_every_key_of_a_constraint_file_has_a_field():
    keys = [*constraint_keys()]
    assert {"gate.width_m.max", "origin.mounts_m", "budget.bandwidth_mbps", "parts.names", "survive"} <= {*keys}
    assert not [key for key in keys if key.startswith("each")]
    assert key_label("field_of_view.horizontal_deg.max") == "horizontal max [deg]"
    assert key_label("budget.bandwidth_mbps") == "bandwidth [Mbit/s]"


def test_undo_goes_back_to_every_record_and_redo_forth(studio):
    states = [studio.choices]
    for key, value in (
        ("limit", ("gate.width_m.max", "0.5")),
        ("handle", "s0"),
        ("pose", ("angles_deg", "10, 5, 0")),
        ("limit", ("budget.rays", 12)),
    ):
        studio.wish(key, value)
        if key != "handle":
            states.append(wait_for(lambda known=states[-1]: studio.choices if studio.choices is not known else None))
    for state in states[-2::-1]:
        studio.wish("step", "Undo")
        wait_for(lambda state=state: studio.choices is state)
    for state in states[1:]:
        studio.wish("step", "Redo")
        wait_for(lambda state=state: studio.choices is state)
    # presses in a row all count
    for step in ("Undo", "Undo", "Redo"):
        studio.wish("step", step)
    wait_for(lambda: len(studio._after) == 1)
    assert studio.choices is states[-2]


HOSTILE = {
    "a name with a path": [("saved name", "../../x"), ("step", "Fit"), ("save", None)],
    "a name that is there": [("saved name", "two"), ("step", "Fit"), ("save", None)],
    "saving before a fit": [("save", None)],
    "exporting what is not saved": [("handle", "s0"), ("pose", ("angles_deg", "10, 5, 0")), ("export", "csv")],
    "not a number": [("limit", ("gate.width_m.max", ".nan"))],
    "a limit of another kind": [("limit", ("gate.width_m.max", "[1, 2"))],
    "an unknown key": [("limit", ("gate.widht_m.max", "1"))],
    "half a sensor": [("limit", ("sensors.count", "1.5"))],
    "a path of a part": [("limit", ("parts.names", '["/etc/x.yaml"]'))],
    "a module that is none": [("limit", ("parts", "{names: [module-wide], count: 2}")), ("step", "Fit")],
    "a wish that there is not": [("no such wish", 1)],
    "a place that is not a number": [("handle", "s0"), ("pose", ("place_m", "nan 0 0"))],
}


@pytest.mark.parametrize("case", HOSTILE)
def test_what_cannot_be_done_is_a_message_and_the_page_lives_on(studio, robot, case):
    before = files_under(robot.folder.parent)
    for wish, value in HOSTILE[case]:
        if wish == "saved name":
            studio._panel.name.value = value
        elif value == "Fit" and "module" not in case:
            studio.wish(wish, value)
            wait_for(lambda: studio.choices.state == "fitted")
        else:
            studio.wish(wish, value)
    wait_for(lambda: "This " in studio._panel._working.content)
    # the cache of training information may have grown
    after = files_under(robot.folder.parent)
    assert {name for name in after if after[name] != before.get(name)} <= {"robot/informed.npz"}
    studio.wish("limit", ("budget.rays", "11"))
    wait_for(lambda: studio.choices.value("budget.rays") == "11")


def test_a_field_is_narrowed_fitted_saved_shown_to_mounters_and_scored(studio, robot):
    studio.wish("limit", ("field_of_view.horizontal_deg.max", "2"))
    studio.wish("step", "Fit")
    wait_for(lambda: studio.choices.state == "fitted")
    assert all(math.degrees(sensor.field_of_view_rad[0]) <= 2 for sensor in studio.choices.sensors)
    studio._panel.name.value = "narrow"
    studio.wish("save")
    wait_for(robot.design_path("narrow").exists)
    studio.wish("mounts")
    wait_for(lambda: [*robot.folder.rglob("mounts.html")])
    studio.wish("step", "Score")
    wait_for(lambda: "held-out scenes, which" in studio._panel.scores.content.replace("*", ""))
    robot.design_path("narrow").unlink()


def test_values_that_no_control_offers_change_nothing(studio):
    before = studio.choices
    wishes = {"detector": "/etc/passwd", "design": "nobody", "handle": "s9", "step": "Quit"}
    for name, value in wishes.items():
        studio.wish(name, value)
    studio.wish("look", ("scene", 10**9))
    studio.wish("look", ("frame", -5))
    last = len(studio._scenes_of(before)) - 1
    wait_for(lambda: studio.choices.scene == last)
    assert replace(studio.choices, scene=0) == before


def test_held_out_scenes_are_looked_at_and_nothing_is_moved_by_them(studio):
    studio.wish("handle", "s0")
    studio.wish("look", ("split", "held-out"))
    wait_for(lambda: studio.choices.split == "test")
    design = studio.choices.design
    studio.wish("pose", ("place_m", "0.135, 0, 0"))
    studio.wish("look", ("frame", 1))
    wait_for(lambda: studio.choices.frame == 1)
    assert studio.choices.design is design


def test_the_limits_of_a_sensor_that_a_fit_leaves_out_are_not_shown_any_more(studio, robot):
    studio.wish("scope", "s1")
    wait_for(lambda: studio._scope == "s1")
    studio.choices = replace(studio.choices, design=robot.fit(sensors=1, rays=16, name="one"))
    studio.wish("limit", ("budget.rays", "11"))
    wait_for(lambda: studio._scope == "all sensors" and studio.choices.value("budget.rays") == "11")
    assert "bug" not in studio._panel._working.content


def test_a_design_of_elsewhere_is_shown_and_the_run_is_fitted_to(robot, tmp_path):
    design = robot.fit(sensors=1, rays=16, name="elsewhere")
    design.save(tmp_path / "elsewhere.yaml")
    with Studio(robot, design) as studio:
        assert studio.choices.base is None
        assert shlex.split(studio.choices.command("x"))[:3] == ["lidardesign", "constrain", str(robot.folder)]


def test_a_thousand_wishes_come_to_the_last_one(studio):
    for number in range(1, 1001):
        studio.wish("limit", ("budget.rays", number))
    wait_for(lambda: studio.choices.value("budget.rays") == "1000")
    assert studio._before[-1] is not studio.choices


def test_a_fit_is_stopped_and_what_has_changed_meanwhile_is_kept(studio):
    studio.wish("step", "Fit")
    wait_for(lambda: "fitting" in studio._panel._working.content or "..." in studio._panel._working.content)
    studio.wish("step", "Stop")
    wait_for(lambda: studio._panel._working.content.count("stopped"))
    assert studio.choices.state == "saved"


REFUSED = {
    "no token": ("/", {}),
    "a wrong token": ("/x{token}/", {}),
    "a part of the token": ("/{short}/", {}),
    "another origin": ("/{token}/", {"Origin": "http://evil.example"}),
    "no origin that is one": ("/{token}/", {"Origin": "null"}),
    "another host": ("/{token}/", {"Host": "evil.example:{port}"}),
    "a token behind a path": ("/a/{token}/", {}),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_stranger_is_refused(studio, case):
    guard = studio._guard
    named = {"token": guard.token, "short": guard.token[:-1], "port": guard.port}
    path, headers = REFUSED[case]
    path, headers = path.format(**named), {key: text.format(**named) for key, text in headers.items()}
    connection = http.client.HTTPConnection("127.0.0.1", guard.port)
    connection.request("GET", path, headers=headers)
    assert connection.getresponse().status == 403
    connection.close()
    if "Host" not in headers:
        with pytest.raises(InvalidStatus, match="403"):
            connect(f"ws://127.0.0.1:{guard.port}{path}", additional_headers=headers, subprotocols=["viser-v1.1.1"])


def test_what_is_no_request_is_no_log_on_the_terminal(studio, capfd):
    for words in (b"", b"POST / HTTP/1.1\r\n\r\n", b"HEAD / HTTP/1.1\r\n\r\n", b"GET /" + 20_000 * b"a", b"\x16\x03"):
        with socket.create_connection(("127.0.0.1", studio._guard.port)) as connection:
            connection.sendall(words)
    with socket.create_connection(("127.0.0.1", studio._guard.port)) as connection:
        connection.sendall(b"GET /\xff HTTP/1.1\r\nHost: localhost\r\n\r\n")
        assert connection.recv(100).startswith(b"HTTP/1.1 403")
    assert capfd.readouterr() == ("", "")


def test_a_flood_of_messages_that_are_none_closes_its_own_connection_alone(studio):
    address = studio.address.replace("http", "ws")
    with connect(address, subprotocols=["viser-v1.1.1"], max_size=None, close_timeout=0.2) as websocket:
        for _ in range(1000):
            try:
                websocket.send(b"\x00nonsense")
            except Exception:
                break
    with connect(address, subprotocols=["viser-v1.1.1"], max_size=None) as websocket:
        assert websocket.recv()


def test_a_server_that_lets_strangers_in_is_not_started(monkeypatch):
    monkeypatch.setattr(server.Guard, "refuses", lambda self, request: False)
    with pytest.raises(ConfigError, match="goes around"):
        server.start_server()


def test_a_port_that_is_taken_is_refused(studio, robot):
    with pytest.raises(ConfigError, match="is taken"):
        open_page(robot, port=studio._guard.port)
    with pytest.raises(LidardesignError, match="port"):
        open_page(robot, port=0)


def test_nothing_is_left_of_a_page_that_is_stopped(robot):
    before = {*threading.enumerate()}
    studio = Studio(robot)
    port = studio._guard.port
    studio.stop()
    wait_for(lambda: {*threading.enumerate()} <= before)
    with pytest.raises(OSError, match="refused"):
        http.client.HTTPConnection("127.0.0.1", port).connect()


def test_ctrl_c_ends_the_command(robot):
    with program("studio", robot.folder, "--no-browser", text=True) as process:
        address = process.stdout.readline()
        assert address.startswith("http://127.0.0.1:")
        process.send_signal(signal.SIGINT)
        try:
            out, err = process.communicate(timeout=30)
        finally:
            process.kill()
    assert (process.returncode, out, err) == (130, "", "interrupted\n")
