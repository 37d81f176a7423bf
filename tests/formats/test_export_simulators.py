"""Exports for simulators and viewers: every format is read by someone else, as its own readers read it."""

import json
import re
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.exports import write_as
from support.sensors import normal_sensor
from support.transients import no_simulator

from lidardesign.errors import ConfigError, DataError
from lidardesign.formats import FORMATS
from lidardesign.formats.mounts import mounts
from lidardesign.scenes.rays import Rays
from lidardesign.sensors.design import DesignSpec

SCHEMAS = Path(__file__).parents[1] / "schemas"
MINE = ("helios", "osi", "rgl", "mitsuba", "ply", "stl")
NASTY = ("</script><!-- \"&'", "größe 測 \n\t\x07", "../../etc/passwd", "con", "CON", "]]>%s{0}\\")
PIXEL_M = 0.0149896229

EXACT, FLOAT32 = 1e-14, 1e-6
# Of any rays, with gates and places of their own.
ANY_RAYS = ("csv", "npz", "sensors-csv", *MINE)


def design(names=NASTY, roll=True):
    """Sensors that look everywhere, one straight down and one straight up, each with its own roll."""
    generator = np.random.default_rng(5)
    sensors = []
    for number, name in enumerate(names):
        azimuth, elevation, turn = generator.uniform((0, -1.5, -3), (6.2, 1.5, 3))
        elevation = (-np.pi / 2, np.pi / 2)[number] if number < 2 else elevation
        origin, spreads = generator.uniform(-3, 3, 3), generator.uniform(0.05, 0.2, 2)
        pose = (azimuth, elevation, turn if roll else 0.0)
        sensors.append(normal_sensor(name, 1 / len(names), origin, *pose, spreads, 4.0, 0.5))
    return DesignSpec("a <design> & 'more'", tuple(sensors), constraints={"gate": {"width_m": {"max": 9.0}}})


def rays_of(some, count=9, spread_m=0.0, own_gates=False, seed=1, apart_rad=0.2):
    """Uneven rays around the boresights, in an order that mixes the sensors."""
    generator = np.random.default_rng(seed)
    sensor = generator.permutation(np.repeat(np.arange(len(some.sensors)), count))
    tangent = generator.normal(0, apart_rad, (len(sensor), 2))
    looking = np.stack([one.frame for one in some.sensors])[sensor]
    ray = looking[:, 0] + tangent[:, :1] * looking[:, 1] + tangent[:, 1:] * looking[:, 2]
    origin = np.array([one.origin_m for one in some.sensors])[sensor]
    origin = origin + spread_m * generator.normal(size=origin.shape)
    gate = np.array([one.gate_m for one in some.sensors])[sensor]
    gate = gate + own_gates * generator.uniform(0, 0.4, gate.shape)
    time = np.arange(len(sensor)) / (len(sensor) * 10.0)
    return Rays(origin, ray / np.linalg.norm(ray, axis=1)[:, None], gate, sensor, time)


DESIGN = design()
CASES = {
    "mounted": rays_of(DESIGN),
    "with gates of their own": rays_of(DESIGN, own_gates=True),
    "from many places": rays_of(DESIGN, count=3, spread_m=0.3, own_gates=True),
}
# within the reach of two mirrors
NARROW = rays_of(DESIGN, apart_rad=0.05)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """Every format of every case: the file or folder, and the notes."""
    root = tmp_path_factory.mktemp("exports")
    found = {}
    for number, (case, rays) in enumerate(CASES.items()):
        for name in ANY_RAYS:
            path = root / f"{number}{FORMATS.load(name).suffix}"
            found[name, case] = path, write_as(name, DESIGN, rays, path)
    return found


@pytest.mark.parametrize("name", ANY_RAYS)
def test_every_format_says_that_it_does_not_hold_the_constraints(written, name):
    for case in CASES:
        assert any("constraints" in note for note in written[name, case][1])


@pytest.mark.parametrize("name", MINE)
def test_names_of_files_are_plain_whatever_the_sensors_are_called(written, name):
    for case in CASES:
        path, _ = written[name, case]
        files = [one.name for one in path.iterdir()] if path.is_dir() else [path.name]
        assert all(re.fullmatch(r"[A-Za-z0-9_.]+", one) for one in files)
        assert len({one.lower() for one in files}) == len(files)


@pytest.mark.parametrize("name", ["helios", "osi", "rgl", "mitsuba"])
def test_sensors_that_fire_nothing_are_left_out_and_told(tmp_path, name):
    rays = CASES["mounted"].subset(CASES["mounted"].sensor % 2 == 0)
    notes = write_as(name, DESIGN, rays, tmp_path / "out")
    assert "3 of 6 sensors fire no ray and are left out" in notes


@pytest.mark.parametrize("name", sorted({*FORMATS.names()} - {"csv", "npz", "galvo", "sensors-csv"}))
def test_formats_made_of_rays_refuse_a_design_without_them_and_others_take_it(tmp_path, name):
    none = CASES["mounted"].subset(np.arange(0))
    if name in ("helios", "osi", "rgl", "mitsuba"):
        with pytest.raises(DataError, match="no rays"):
            write_as(name, DESIGN, none, tmp_path / "out")
        assert not list(tmp_path.iterdir())
        return
    notes = write_as(name, DESIGN, none, tmp_path / "out")
    assert ("6 of 6 sensors fire no ray and are left out" in notes) == (name not in ("ply", "stl", "mounts"))


@pytest.mark.parametrize("name", [name for name in FORMATS.names() if "rate" not in FORMATS.load(name).holds])
def test_a_format_without_a_frame_rate_refuses_one(tmp_path, name):
    with pytest.raises(ConfigError, match="cannot hold a frame rate"):
        write_as(name, DESIGN, NARROW, tmp_path / "out", 25.0)


def test_files_that_an_earlier_export_left_in_a_folder_are_told(tmp_path):
    path = tmp_path / "out"
    write_as("helios", DESIGN, CASES["mounted"], path)
    (path / "Mine.xml").write_text("<document/>", encoding="utf-8")
    fewer = CASES["mounted"].subset(CASES["mounted"].sensor == 0)
    notes = write_as("helios", DESIGN, fewer, path)
    (note,) = (note for note in notes if note.startswith("the folder also holds 6 other files"))
    assert "Mine.xml" in note
    assert (path / "Mine.xml").read_text(encoding="utf-8") == "<document/>"


# HELIOS++ -----------------------------------------------------------------------------------------------------------


def helios_pulses(folder, survey):
    """What HELIOS++ fires in a survey: (origin, direction, range limits) per pulse, step by step as its loop does."""
    leg = ElementTree.parse(survey).find("survey")
    scanners = ElementTree.parse(folder / "scanners.xml")
    name = leg.get("scanner").split("#")[1]
    scanner = next(one for one in scanners.iter("scanner") if one.get("id") == name)
    platform, settings = leg.find("leg/platformSettings"), leg.find("leg/scannerSettings")
    place = np.array([float(platform.get(axis)) for axis in "xyz"])
    speed, frequency = float(settings.get("headRotatePerSec_deg")), int(settings.get("pulseFreq_hz"))
    assert speed <= float(scanner.get("headRotatePerSecMax_deg"))
    assert str(frequency) in scanner.get("pulseFreqs_Hz").split(",")
    head_deg, fired = float(settings.get("headRotateStart_deg")), []
    while head_deg < float(settings.get("headRotateStop_deg")):
        head_deg += speed / frequency
        for channel in scanner.iter("channel"):
            beam = channel.find("beamOrigin")
            ray = np.array([0.0, 1.0, 0.0])
            for axis, angle_deg in [(rot.get("axis"), float(rot.get("angle_deg"))) for rot in beam] + [("z", head_deg)]:
                ray = Rotation.from_euler(axis, angle_deg, degrees=True).apply(ray)
            limits = (float(channel.get("rangeMin_m")), float(channel.get("rangeMax_m")))
            fired.append((place + [float(beam.get(axis)) for axis in "xyz"], ray, limits))
    return fired


@pytest.mark.parametrize("case", CASES)
def test_helios_fires_every_ray_once_with_its_own_gate(written, case):
    folder, _ = written["helios", case]
    rays, surveys = CASES[case], sorted(folder.glob("*.survey.xml"))
    assert len(surveys) == len(DESIGN.sensors)
    fired = [pulse for survey in surveys for pulse in helios_pulses(folder, survey)]
    rows = np.array([np.concatenate(pulse) for pulse in fired])
    expected = np.concatenate([rays.origin_m, rays.direction, rays.gate_m], axis=1)
    nearest = np.abs(rows[:, None] - expected[None]).max(axis=2)
    assert rows.shape == expected.shape
    assert nearest.min(axis=1).max() < 1e-12
    assert len(set(nearest.argmin(axis=1))) == len(rays)


@pytest.mark.parametrize("case", CASES)
def test_helios_files_are_valid(written, case):
    etree = pytest.importorskip("lxml.etree", reason="lxml is not installed")
    folder, _ = written["helios", case]
    scanners, survey = (etree.XMLSchema(file=str(SCHEMAS / f"helios-{kind}.xsd")) for kind in ("scanners", "survey"))
    scanners.assertValid(etree.parse(str(folder / "scanners.xml")))
    for file in folder.glob("*.survey.xml"):
        survey.assertValid(etree.parse(str(file)))
        # its loader takes the node behind the declaration for the root
        assert re.match(rb"<\?xml [^>]*\?>\s*<document>", file.read_bytes())
    [platform] = ElementTree.parse(folder / "platforms.xml").getroot()
    assert platform.attrib == {"id": "fixed", "name": "fixed", "type": "static"}


def test_helios_takes_whole_frame_rates_and_says_so(tmp_path):
    notes = write_as("helios", DESIGN, CASES["mounted"], tmp_path / "out", rate_hz=7.5)
    assert any(note.startswith("7.5 frames per second became 8") for note in notes)
    assert helios_pulses(tmp_path / "out", next((tmp_path / "out").glob("con.survey.xml")))


# ASAM OSI -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("case", CASES)
def test_osi_is_read_by_protobuf_and_its_rays_are_ours(written, case):
    json_format = pytest.importorskip("google.protobuf.json_format", reason="protobuf is not installed")
    osi = pytest.importorskip("osi3.osi_sensorviewconfiguration_pb2", reason="osi-python is not installed")
    path, _ = written["osi", case]
    found = json_format.Parse(path.read_text(encoding="utf-8"), osi.SensorViewConfiguration())
    rays, rows = CASES[case], []
    for number, lidar in enumerate(found.lidar_sensor_view_configuration):
        at, turned = lidar.mounting_position.position, lidar.mounting_position.orientation
        # the sensor's axes turn by yaw, then pitch about the new y, then roll about the new x
        frame = Rotation.from_euler("ZYX", [turned.yaw, turned.pitch, turned.roll]).as_matrix()
        assert lidar.sensor_id.value == number
        assert lidar.num_of_pixels == len(lidar.directions) == len(lidar.timings)
        for ray, time_us in zip(lidar.directions, lidar.timings, strict=True):
            rows.append([at.x, at.y, at.z, *(frame @ [ray.x, ray.y, ray.z]), time_us])
            azimuth, elevation = np.arctan2(ray.y, ray.x), np.arcsin(ray.z)
            assert abs(azimuth) <= lidar.field_of_view_horizontal / 2 + EXACT
            assert abs(elevation) <= lidar.field_of_view_vertical / 2 + EXACT
    rows = np.array(rows)[np.argsort([row[-1] for row in rows])]
    np.testing.assert_allclose(rows[:, :3], rays.origin_m, atol=0)
    np.testing.assert_allclose(rows[:, 3:6], rays.direction, atol=1e-12)
    np.testing.assert_allclose(rows[:, 6], rays.time_s * 1e6, atol=0.5)
    assert found.range == rays.gate_m[:, 1].max()
    assert (found.update_cycle_time.seconds, found.update_cycle_time.nanos) == (0, 100_000_000)


@pytest.mark.parametrize("rate_hz", [0.001, 10.0, 30.0, 1e6])
def test_osi_fires_nothing_in_the_next_frame(tmp_path, rate_hz):
    rays = CASES["mounted"]
    late = Rays(rays.origin_m, rays.direction, rays.gate_m, rays.sensor, np.linspace(0, 0.1, len(rays), endpoint=False))
    late.time_s[-1] = np.nextafter(0.1, 0)
    write_as("osi", DESIGN, late, tmp_path / "out.json", rate_hz=rate_hz)
    whole = json.loads((tmp_path / "out.json").read_text(encoding="utf-8"))
    times_us = [time for lidar in whole["lidarSensorViewConfiguration"] for time in lidar["timings"]]
    assert 0 <= min(times_us) <= max(times_us) < min(1e6 / rate_hz, 2**32)
    assert max(times_us) >= 1e6 / rate_hz - 1


@pytest.mark.parametrize("rate_hz", [1e-5, 1e10])
def test_osi_refuses_frames_whose_times_it_cannot_count(tmp_path, rate_hz):
    with pytest.raises(ConfigError, match="rate-hz"):
        write_as("osi", DESIGN, CASES["mounted"], tmp_path / "out", rate_hz=rate_hz)


# Robotec GPU Lidar --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("case", CASES)
def test_rgl_patterns_look_along_the_third_axis_of_proper_poses(written, case):
    folder, _ = written["rgl", case]
    rays, rows = CASES[case], []
    for sensor in ElementTree.parse(folder / "model.sdf").iter("sensor"):
        x, y, z, roll, pitch, yaw = (float(number) for number in sensor.findtext("pose").split())
        frame = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()
        pattern = Path(sensor.findtext("plugin/pattern_preset_path"))
        assert pattern.is_absolute()
        poses = np.frombuffer(pattern.read_bytes(), dtype="<f4").reshape(-1, 3, 4).astype(np.float64)
        limits = np.frombuffer(pattern.with_suffix(".range2f").read_bytes(), dtype="<f4").reshape(-1, 2)
        turns = poses[:, :, :3]
        np.testing.assert_allclose(turns @ turns.transpose(0, 2, 1), np.tile(np.eye(3), (len(turns), 1, 1)), atol=1e-6)
        np.testing.assert_allclose(np.linalg.det(turns), 1, atol=1e-6)
        start, end = (float(sensor.findtext(f"plugin/range/{bound}")) for bound in ("min", "max"))
        assert start <= limits[:, 0].min() + FLOAT32
        assert end >= limits[:, 1].max() - FLOAT32
        at = np.array([x, y, z]) + poses[:, :, 3] @ frame.T
        times_s = np.frombuffer(pattern.with_suffix(".time1f").read_bytes(), dtype="<f4")[:, None] / 1e3
        rows.append(np.concatenate([at, turns @ [0, 0, 1] @ frame.T, limits, times_s], axis=1))
        assert sensor.findtext("plugin/update_rate") == "10.0"
    order = np.argsort(rays.sensor, kind="stable")
    expected = np.concatenate([rays.origin_m, rays.direction, rays.gate_m, rays.time_s[:, None]], axis=1)[order]
    np.testing.assert_allclose(np.concatenate(rows), expected, atol=2e-6)


def test_rgl_times_follow_the_frame_rate(tmp_path):
    write_as("rgl", DESIGN, CASES["mounted"], tmp_path / "out", rate_hz=40.0)
    times_ms = np.concatenate([np.fromfile(file, "<f4") for file in (tmp_path / "out").glob("*.time1f")])
    np.testing.assert_allclose(np.sort(times_ms), CASES["mounted"].time_s * 1e3 / 4, rtol=1e-6)


def test_rgl_says_how_much_wider_the_plugins_gates_are(written):
    assert not any("gates of their own" in note for note in written["rgl", "mounted"][1])
    [note] = [note for note in written["rgl", "with gates of their own"][1] if "gates of their own" in note]
    rays = CASES["with gates of their own"]
    worst = max(
        max((gate[:, 0] - gate[:, 0].min()).max(), (gate[:, 1].max() - gate[:, 1]).max())
        for gate in (rays.gate_m[rays.sensor == index] for index in range(len(DESIGN.sensors)))
    )
    assert f"up to {worst:.3g} m" in note


# Mitsuba with mitransient -------------------------------------------------------------------------------------------

RENDER = """
import json, sys
import mitsuba, numpy
mitsuba.set_variant("llvm_ad_mono")
import mitransient
found = []
for path in sys.argv[1:]:
    scene = mitsuba.load_file(path)
    steady, transient = scene.integrator().render(scene, spp=1)
    found.append(numpy.asarray(transient)[0, :, :, 0].tolist())
print("RESULT" + json.dumps(found))
"""
FLOOR_M, GATE_M = -1.0, (0.9, 1.6)
GROUND = (
    '<scene version="3.0.0"><include filename="{}"/><shape type="rectangle"><transform name="to_world">'
    '<scale value="50"/><translate z="{}"/></transform></shape></scene>'
)


@pytest.fixture(scope="module")
def rendered(tmp_path_factory):
    """Two sensors above a floor, and the histograms that mitransient makes of their scenes, one array each."""
    if reason := no_simulator():
        pytest.skip(reason)
    names = ("left & <right>", "other")
    at = (np.array([0.3, -0.2, 0.0]), np.array([-2.0, 0.5, 0.1]))
    sensors = tuple(
        normal_sensor(name, 0.5, place, 1.0, -1.2, 0.4, (0.1, 0.1), 1.25) for name, place in zip(names, at, strict=True)
    )
    some = DesignSpec("floor", sensors)
    rays = rays_of(some, count=40)
    rays = Rays(rays.origin_m, rays.direction, np.tile(GATE_M, (len(rays), 1)), rays.sensor, rays.time_s)
    folder = tmp_path_factory.mktemp("mitsuba")
    write_as("mitsuba", some, rays, folder / "out")
    scenes = []
    for file in sorted((folder / "out").iterdir()):
        scenes.append(folder / f"with_floor_{file.name}")
        scenes[-1].write_text(GROUND.format(file, FLOOR_M), encoding="utf-8")
    command = [sys.executable, "-c", RENDER, *map(str, scenes)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert "RESULT" in done.stdout, done.stderr
    return rays, [np.array(one) for one in json.loads(done.stdout.rsplit("RESULT", 1)[1].splitlines()[0])]


def test_mitsuba_sees_light_in_the_bin_of_each_rays_range(rendered):
    rays, histograms = rendered
    inside = 0
    for sensor, histogram in enumerate(histograms):
        mine = rays.subset(rays.sensor == sensor)
        down = -mine.direction[:, 2]
        range_m = np.where(down > 0, (mine.origin_m[:, 2] - FLOOR_M) / np.where(down > 0, down, 1), np.inf)
        assert histogram.shape[0] == len(mine)
        for bins, true_m in zip(histogram, range_m, strict=True):
            lit = np.flatnonzero(bins)
            if GATE_M[0] + PIXEL_M < true_m < GATE_M[1] - PIXEL_M:
                inside += 1
                # single precision may put a range at a bin's border into the next
                assert len(lit) == 1
                assert abs(GATE_M[0] + (lit[0] + 0.5) * PIXEL_M - true_m) <= PIXEL_M / 2 + 1e-5
            elif not GATE_M[0] - PIXEL_M < true_m < GATE_M[1] + 2 * PIXEL_M:
                assert not len(lit)
    assert inside > 40


def test_mitsuba_films_are_as_long_as_the_gates_that_they_stand_for(written):
    folder, notes = written["mitsuba", "with gates of their own"]
    rays = CASES["with gates of their own"]
    wider = 0
    for index, mount in enumerate(mounts(DESIGN, rays)):
        file, gate = folder / f"{mount.name}.xml", rays.gate_m[rays.sensor == index]
        wider += (gate != [gate[:, 0].min(), gate[:, 1].max()]).any(axis=1).sum()
        film = {
            one.get("name"): float(one.get("value")) for one in ElementTree.parse(file).findall("sensor/film/*[@value]")
        }
        assert film["start_opl"] == 2 * gate[:, 0].min()
        end = (film["start_opl"] + film["temporal_bins"] * film["bin_width_opl"]) / 2
        assert gate[:, 1].max() <= end < gate[:, 1].max() + PIXEL_M
        assert film["width"] == len(gate)
        meters = ElementTree.parse(file).findall("sensor/sensor")
        for tag, expected in (("point", rays.origin_m), ("vector", rays.direction)):
            values = [[float(meter.find(tag).get(axis)) for axis in "xyz"] for meter in meters]
            np.testing.assert_array_equal(values, expected[mount.ray])
    assert any(f"{wider} of {len(rays)} rays have gates of their own" in note for note in notes)


# PLY and STL --------------------------------------------------------------------------------------------------------


def read_ply(path):
    """Elements of a PLY as trimesh finds them."""
    trimesh = pytest.importorskip("trimesh")
    loaded = trimesh.load(path, process=False)
    return {name: element["data"] for name, element in loaded.metadata["_ply_raw"].items()}


def places(table, names=("x", "y", "z")):
    return np.stack([table[name] for name in names], axis=1)


def test_ply_points_are_the_rays_and_edges_their_gates(written):
    path, _ = written["ply", "from many places"]
    rays = CASES["from many places"]
    points = read_ply(path / "rays.ply")["vertex"]
    np.testing.assert_array_equal(places(points), rays.origin_m)
    np.testing.assert_array_equal(places(points, ("nx", "ny", "nz")), rays.direction)
    for name, column in (("gate_start", rays.gate_m[:, 0]), ("gate_end", rays.gate_m[:, 1]), ("sensor", rays.sensor)):
        np.testing.assert_array_equal(points[f"scalar_{name}"], column)
    beams = read_ply(path / "beams.ply")
    ends = places(beams["vertex"])[np.stack([beams["edge"]["vertex1"], beams["edge"]["vertex2"]], axis=1)]
    along = rays.gate_m[:, :, None] * rays.direction[:, None]
    np.testing.assert_allclose(ends - rays.origin_m[:, None], along, atol=1e-12)
    colours = {tuple(row) for row in places(points, ("red", "green", "blue"))}
    assert len(colours) == len(DESIGN.sensors)


def test_ply_frusta_hold_what_lies_in_the_field_of_view_and_gate(written):
    trimesh = pytest.importorskip("trimesh")
    path, _ = written["ply", "mounted"]
    assert trimesh.load(path / "frusta.ply", process=False).is_watertight
    table, count = read_ply(path / "frusta.ply"), len(DESIGN.sensors)
    points = places(table["vertex"]).reshape(count, -1, 3)
    faces = table["face"]["vertex_indices"]["f1"].reshape(count, -1, 4) % points.shape[1]
    grid = (np.arange(200) + 0.5) / 200 - 0.5
    for sensor, place, corners in zip(DESIGN.sensors, points, faces, strict=True):
        around = place - sensor.origin_m
        # a tangent cell at the angle t from the boresight covers the solid angle sin(t) / t of its own area
        wide, high = sensor.field_of_view_rad
        angle = np.hypot(wide * grid[:, None], high * grid[None])
        solid_angle = (np.sin(angle) / angle).mean() * wide * high
        start, end = sensor.gate_m
        a, b, c, d = around[corners].transpose(1, 0, 2)
        volume = ((a * np.cross(b, c)).sum() + (a * np.cross(c, d)).sum()) / 6
        assert volume == pytest.approx(solid_angle * (end**3 - start**3) / 3, rel=0.01)
        np.testing.assert_allclose(np.linalg.norm(around, axis=1), np.repeat([start, end], len(around) // 2))


def test_ply_leaves_out_frusta_that_have_no_width(tmp_path):
    some = DesignSpec("ray", (normal_sensor("thin", spread_rad=(0.0, 0.0)),))
    notes = write_as("ply", some, rays_of(some, count=1), tmp_path / "out")
    assert "1 of 1 sensors have no width, so no frustum" in notes
    assert sorted(file.name for file in (tmp_path / "out").iterdir()) == ["beams.ply", "rays.ply"]


def test_stl_solids_are_closed_and_stand_where_the_sensors_do_in_millimetres(written):
    trimesh = pytest.importorskip("trimesh")
    path, _ = written["stl", "mounted"]
    loaded = trimesh.load(path, file_type="stl_ascii")
    solids = list(loaded.geometry.values())
    assert len(solids) == len(DESIGN.sensors)
    for solid, sensor in zip(solids, DESIGN.sensors, strict=True):
        assert solid.is_watertight
        assert solid.volume == pytest.approx(20 * (16 + 8) / 2 * 12 / 3, rel=1e-3)
        local = (solid.vertices - 1000 * sensor.origin_m) @ sensor.frame.T
        np.testing.assert_allclose([local[:, 0].min(), local[:, 0].max()], [0, 20], atol=1e-2)
        np.testing.assert_allclose(np.abs(local[:, 1]).max(), 8, atol=1e-2)
        # wide below, narrow above: the roll can be seen
        far = local[local[:, 0] > 10]
        assert np.abs(far[far[:, 2] < 0, 1]).min() > np.abs(far[far[:, 2] > 0, 1]).max()


def test_names_that_look_like_the_format_do_not_become_part_of_it(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    some = design(("endsolid x", "facet normal 0 0 1", "element vertex 9\nend_header\n", "\U0001f600" * 5000))
    rays = rays_of(some)
    for name in MINE:
        path = tmp_path / f"out{FORMATS.load(name).suffix}"
        write_as(name, some, rays, path)
    assert len(trimesh.load(tmp_path / "out.stl", file_type="stl_ascii").geometry) == 4
    header = (tmp_path / "out.ply.d" / "rays.ply").read_bytes().partition(b"end_header\n")[0]
    assert max(map(len, header.splitlines())) < 1024
    assert len(trimesh.load(tmp_path / "out.ply.d" / "rays.ply", process=False).vertices) == len(rays)


@pytest.mark.parametrize(("name", "what"), [("stl", "solids"), ("ply", "frusta")])
def test_shapes_of_sensors_that_are_regions_stand_in_their_middles_and_say_so(tmp_path, name, what):
    some = DesignSpec("region", (normal_sensor("wide", origin_covariance_m2=np.diag([1.0, 0, 0])),))
    notes = write_as(name, some, rays_of(some), tmp_path / "out")
    assert any("1 sensors are regions" in note and f"1 m: {what} stand in their middles" in note for note in notes)
