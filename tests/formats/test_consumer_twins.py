"""What simulators that are not installed here make of the numbers written for them, at the ends of their ranges.

Each twin was written from the published source of its program, as of 2026-11-22, and reads nothing but the files.
"""

import json
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
from support.exports import write_as
from support.rays import rays_along
from support.rigs import even, farthest_nearest, sensor
from support.sensors import normal_sensor

from lidardesign.errors import ConfigError
from lidardesign.sensors.design import DesignSpec

ONE = DesignSpec("one", (normal_sensor("one"),))
FORWARD = [1.0, 0.0, 0.0]


# HELIOS++ -----------------------------------------------------------------------------------------------------------

# src/scanner/ScanningDevice.cpp, detector/FullWaveformPulseRunnable.cpp, maths/model/*EnergyModel.cpp, WaveMaths.cpp;
# what a scanner file leaves out is of assetloading/XmlAssetsLoader.cpp
C_M_NS = 0.299792458
APERTURE_M, EFFICIENCY, VISIBILITY_KM, WAVELENGTH_M = 0.15, 0.99, 23.0, 1064e-9
# how a version spreads the power over the beam, and the least intensity [nW] that is an echo
HELIOS = [(beam, least) for beam in ("focused", "focused, radii in rad", "Gaussian") for least in (1e-3, 1e-4)]


def helios_intensity(beam, power_w, divergence_rad, start_m, range_m, brightness):
    """The received power [nW] of a surface of so much reflectance times cosine."""
    if beam == "Gaussian":
        share = 1 - np.exp(-2.0)
    else:
        waist_m = WAVELENGTH_M / (np.pi * divergence_rad)
        with np.errstate(divide="ignore"):
            defocus = 1 - np.divide(range_m, start_m)
        width_m = waist_m * np.hypot(defocus, range_m * WAVELENGTH_M / (np.pi * waist_m**2))
        radius_m = divergence_rad / 2 * (range_m if beam == "focused" else 1.0)
        share = -np.expm1(-2 * (radius_m / width_m) ** 2)
    air = np.exp(-2 * range_m * 3.91 / VISIBILITY_KM * (WAVELENGTH_M * 1e9 / 0.55) ** -1.3)
    return 1e9 * power_w * share * APERTURE_M**2 * EFFICIENCY * air * np.pi / 4 * brightness / range_m**2


def helios_range_m(scanner, channel, range_m, version, brightness):
    """The range of a point that HELIOS++ writes for a surface in front of a channel; None: it writes none."""
    beam, least = version
    waveform = scanner.find("FWFSettings")
    pulse, bin_ns = float(scanner.get("pulseLength_ns")), float(waveform.get("binSize_ns"))
    start = float(channel.get("rangeMin_m"))
    if range_m < start or range_m > float(channel.get("rangeMax_m")):
        return None
    power_w, divergence_rad = float(scanner.get("averagePower_w")), float(scanner.get("beamDivergence_rad"))
    intensity = helios_intensity(beam, power_w, divergence_rad, start, range_m, brightness)
    time = 7 / pulse * bin_ns * np.arange(int(pulse / bin_ns))
    wave = time**2 * np.exp(-time)
    peak = int(wave.argmax())
    first_ns = range_m / C_M_NS - peak * bin_ns
    if start / C_M_NS > first_ns:
        return None
    last_ns = range_m / C_M_NS + pulse - peak * bin_ns
    # older versions count the bins of the difference, newer ones have one more
    sizes = [int((last_ns - first_ns) / bin_ns), int(np.ceil(last_ns / bin_ns + 1) - np.ceil(first_ns / bin_ns))]
    assert min(sizes) >= len(wave), "a version writes past the end of the waveform"
    whole = np.zeros(sizes[beam == "Gaussian"])
    whole[: len(wave)] = intensity * wave
    reach = int(float(waveform.get("winSize_ns")) / bin_ns)
    for at, value in enumerate(whole):
        before, after = whole[max(0, at - reach) + 1 : at], whole[at + 1 : at + reach]
        around = np.concatenate([before, after])
        if value >= least and (around >= least).all() and (around < value).all():
            return C_M_NS * (at * bin_ns + first_ns)
    return None


def helios_scanner(folder, gates_m):
    notes = write_as("helios", ONE, rays_along(np.tile(FORWARD, (len(gates_m), 1)), gates_m), folder)
    scanner = ElementTree.parse(folder / "scanners.xml").find("scanner")
    return scanner, list(scanner.iter("channel")), notes


@pytest.mark.parametrize("version", HELIOS)
def test_helios_returns_what_lies_inside_a_gate_wherever_that_starts(tmp_path, version):
    gates_m = np.array([[0, 0.0005], [0, 100], [1e-6, 25], [0.001, 100], [0.02, 3], [0.4, 0.5], [5, 100], [24.9, 25]])
    scanner, channels, notes = helios_scanner(tmp_path / "out", gates_m)
    [lost] = [note for note in notes if "behind a gate's start" in note]
    lost_m = float(lost.split(" mm")[0].split()[-1]) / 1000 + 1e-4
    for channel, (start, end) in zip(channels, gates_m, strict=True):
        nearest = max(start, 0.001) + lost_m
        for range_m in nearest + np.array([0, 0.01, 0.5, 1]) * (end - nearest) if end > nearest else []:
            # a tenth of the light, at 60 degrees
            found = helios_range_m(scanner, channel, range_m, version, 0.05)
            assert found is not None, (start, range_m)
            assert abs(found - range_m) < 1e-9
        for range_m in (0.9 * start, end + 0.002):
            assert helios_range_m(scanner, channel, range_m, version, 1.0) is None
    assert any("3 of 8 rays start below 0.001 m" in note for note in notes)


# CARLA --------------------------------------------------------------------------------------------------------------

# Sensor/RayCastSemanticLidar.cpp, RayCastLidar.cpp and Sensor.cpp; Unreal's AWorldSettings::FixupDeltaSeconds
SINGLE = np.float32


def carla_frames(sensor, step_s, count):
    """Pitch and yaw [deg] of all rays of so many frames, (N, 2) each, in single precision as CARLA reckons."""
    text = sensor["attributes"]
    field, low, high, rate = (
        SINGLE(text[name]) for name in ("horizontal_fov", "lower_fov", "upper_fov", "rotation_frequency")
    )
    channels, delta = int(text["channels"]), SINGLE(np.clip(step_s, 0.0005, 0.4))
    points = int(SINGLE(int(text["points_per_second"])) * delta / SINGLE(channels) + SINGLE(0.5))
    between = (high - low) / SINGLE(channels - 1) if channels > 1 else SINGLE(0)
    pitch = high - np.arange(channels, dtype=SINGLE) * between
    tick, current, frames = rate * field * delta, SINGLE(0), []
    for _ in range(count):
        start = np.degrees(current)
        yaw = np.fmod(start + tick / SINGLE(points) * np.arange(points, dtype=SINGLE), field) - field / SINGLE(2)
        frames.append(np.stack([np.repeat(pitch, points), np.tile(yaw, channels)], axis=1))
        current = np.radians(np.fmod(start + tick, field))
    return frames


def unreal_rays(rotation, pitch_yaw_deg):
    """Unit vectors in our right-handed world of rays in an actor's frame, by the axes of FRotationMatrix."""
    (sp, cp), (sy, cy), (sr, cr) = (
        (np.sin(angle), np.cos(angle)) for angle in np.radians([rotation[name] for name in ("pitch", "yaw", "roll")])
    )
    axes = np.array(
        [
            [cp * cy, cp * sy, sp],
            [sr * sp * cy - cr * sy, sr * sp * sy + cr * cy, -sr * cp],
            [-(cr * sp * cy + sr * sy), cy * sr - cr * sp * sy, cr * cp],
        ]
    )
    pitch, yaw = np.radians(pitch_yaw_deg.astype(np.float64)).T
    local = np.stack([np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch)], axis=1)
    return local @ axes * [1, -1, 1]


CARLA_GRIDS = {
    "one ray": ((1, 1), (0.0, 0.0), (0.0, 0.0)),
    "one column": ((1, 4), (0.1, 0.1), (-0.2, 0.3)),
    "one row": ((5, 1), (-0.3, 0.2), (0.1, 0.1)),
    "even": ((7, 6), (-0.31, 0.32), (-0.2, 0.3)),
    "all round": ((36, 3), (-np.pi, np.pi - np.pi / 18), (-0.25, 0.3)),
}


@pytest.mark.parametrize(
    ("rate_hz", "case"),
    [(rate, case) for rate in (2.5, 3.7, 10, 29.97, 30, 60, 144, 333, 2000) for case in CARLA_GRIDS],
)
def test_every_frame_of_carla_has_the_grids_rays_once(tmp_path, rate_hz, case):
    (columns, rows), azimuth, elevation = CARLA_GRIDS[case]
    local = even(columns, rows, azimuth, elevation)
    count = len(local)
    looking = sensor("one", (0.3, -0.4, 1.2), 2.5, -0.4, 0.3)
    rays = rays_along(local @ looking.frame, (0.0, 9.0), looking.origin_m)
    write_as("carla", DesignSpec("one", (looking,)), rays, tmp_path / "out.json", rate_hz)
    whole = json.loads((tmp_path / "out.json").read_text())
    [written] = whole["sensors"]
    assert (written["name"], written["type"]) == ("one", "sensor.lidar.ray_cast")
    assert all(isinstance(value, str) for value in written["attributes"].values())
    assert [written["transform"]["location"][axis] for axis in "xyz"] == pytest.approx([0.3, 0.4, 1.2])
    assert float(written["attributes"]["range"]) == 9.0
    frames = carla_frames(written, whole["fixed_delta_seconds"], 100)
    fired = unreal_rays(written["transform"]["rotation"], frames[0])
    assert len(fired) == count
    assert farthest_nearest(rays.direction, fired) < 3e-5
    assert all((frame == frames[0]).all() for frame in frames)
    assert written["attributes"]["sensor_tick"] == "0.0"


# few numbers near these do
HARD_TO_SWEEP = [
    (1024.3652784223673, 0.015327117154160736),
    (128.03374440245298, 25.87963506289764),
    (512.4703039523956, 121.9597825772253),
    (128.01017118282869, 1.5650519973915888),
    (4.00009405912849, 91.6654571465388),
]


@pytest.mark.parametrize(("rate_hz", "field_deg"), HARD_TO_SWEEP)
def test_carla_sweeps_just_the_whole_field_in_a_frame(tmp_path, rate_hz, field_deg):
    field = np.radians(field_deg)
    local = even(4, 1, (-field / 2, field / 4), (0.0, 0.0))
    rays = rays_along(local, (0.0, 9.0))
    write_as("carla", ONE, rays, tmp_path / "out.json", rate_hz)
    whole = json.loads((tmp_path / "out.json").read_text())
    text = whole["sensors"][0]["attributes"]
    step_s = SINGLE(whole["fixed_delta_seconds"])
    rate, found = SINGLE(text["rotation_frequency"]), SINGLE(text["horizontal_fov"])
    assert rate * found * step_s == found
    assert found == pytest.approx(field_deg, rel=5e-4)


@pytest.mark.parametrize("rate_hz", [0.001, 1.0, 2.49, 2001, 1e5])
def test_carla_refuses_frames_that_unreal_does_not_have(tmp_path, rate_hz):
    with pytest.raises(ConfigError, match=r"--rate-hz[\s\S]*2\.5 to 2000"):
        write_as("carla", ONE, rays_along(FORWARD, np.array([[0.0, 9.0]])), tmp_path / "out.json", rate_hz)


# Gazebo -------------------------------------------------------------------------------------------------------------

# gz-rendering: ogre2/src/Ogre2GpuRays.cpp and its two fragment programs


def gazebo_pixels(scan):
    """Unit vectors in a sensor's frame of the pixels that Gazebo reads, row by row, and how many pixels a face has."""
    low, high, count = (
        [float(scan.findtext(f"{axis}/{name}")) for axis in ("horizontal", "vertical")]
        for name in ("min_angle", "max_angle", "samples")
    )
    columns, rows = map(int, count)
    wide = max(high[0] - low[0], 1e-4)
    tall = max(high[1] - low[1], 1e-4)
    most = max(int(np.pi / 2 / wide * columns), int(np.pi / 2 / tall * rows) if rows > 1 else 0)
    side = 1
    while side < most:
        side *= 2
    side = min(max(side, 128), 1024)
    read = []
    for row in range(rows):
        for column in range(columns):
            across = low[0] + column * (wide / (columns - 1) if columns > 1 else 0)
            up = low[1] + row * (tall / (rows - 1) if rows > 1 else 0)
            # a cube map looks along z, y up, x to the right
            x, y, z = -np.sin(across) * np.cos(up), np.sin(up), np.cos(across) * np.cos(up)
            if abs(z) >= abs(x) and abs(z) >= abs(y):
                u, v, scale = (-x if z < 0 else x), -y, abs(z)
                corner = lambda a, b, z=z: (-a if z < 0 else a, -b, np.sign(z))  # noqa: E731
            elif abs(y) >= abs(x):
                u, v, scale = x, (-z if y < 0 else z), abs(y)
                corner = lambda a, b, y=y: (a, np.sign(y), -b if y < 0 else b)  # noqa: E731
            else:
                u, v, scale = (z if x < 0 else -z), -y, abs(x)
                corner = lambda a, b, x=x: (np.sign(x), -b, a if x < 0 else -a)  # noqa: E731
            texel = [min(int((0.5 * one / scale + 0.5) * side), side - 1) for one in (u, v)]
            x, y, z = corner(*(2 * (one + 0.5) / side - 1 for one in texel))
            read.append(np.array([z, -x, y]) / np.linalg.norm([x, y, z]))
    return np.array(read), side


GAZEBO_GRIDS = {
    "one ray": ((1, 1), (0.0, 0.0), (0.0, 0.0), 1024),
    "few": ((6, 6), (-0.17, 0.17), (-0.17, 0.17), 128),
    "many": ((120, 40), (-0.4, 0.4), (-0.3, 0.35), 256),
    "row": ((300, 1), (-0.2, 0.2), (0.1, 0.1), 1024),
    "all round": ((36, 3), (-np.pi, np.pi - np.pi / 18), (-1.5, 1.5), 128),
}


@pytest.mark.parametrize("case", GAZEBO_GRIDS)
def test_gazebos_pixels_are_no_farther_from_the_rays_than_the_note_says(tmp_path, case):
    (columns, rows), azimuth, elevation, side = GAZEBO_GRIDS[case]
    local = even(columns, rows, azimuth, elevation)
    notes = write_as("sdf", ONE, rays_along(local, (0.0, 9.0)), tmp_path / "out.sdf")
    [sensor] = ElementTree.parse(tmp_path / "out.sdf").iter("sensor")
    read, found_side = gazebo_pixels(sensor.find("lidar/scan"))
    assert found_side == side
    beside = np.degrees(2 * np.arcsin(np.linalg.norm(read - local, axis=1) / 2)).max()
    [told] = [note for note in notes if "pixels of a picture" in note]
    assert beside <= float(told.split(" deg")[0].split()[-1])
    # half a diagonal of the pixel in the middle of a face
    assert 0.4 < beside / np.degrees(np.sqrt(2) / side) <= 1.01
    assert float(sensor.findtext("lidar/range/min")) > 0


# Robotec GPU Lidar --------------------------------------------------------------------------------------------------

# RGLGazeboPlugin: Lidar.cc, LidarPatternLoader.cc; RobotecGPULidar: src/graph/SetRangeRaysNode.cpp


@pytest.mark.parametrize("rate_hz", [0.001, 29.97, 1e6])
def test_rgl_takes_patterns_ranges_and_rates_at_their_ends(tmp_path, rate_hz):
    gates_m = np.array([[0, 0], [0, 1e-9], [0.3, 0.3 + 1e-12], [1e-30, 1e9]])
    write_as("rgl", ONE, rays_along(np.tile(FORWARD, (len(gates_m), 1)), gates_m), tmp_path / "out", rate_hz)
    plugin = ElementTree.parse(tmp_path / "out" / "model.sdf").find("model/link/sensor/plugin")
    assert {"update_rate", "range", "topic", "frame", "pattern_preset_path"} <= {one.tag for one in plugin}
    whole = np.array([[SINGLE(plugin.findtext(f"range/{name}")) for name in ("min", "max")]])
    own = np.fromfile(tmp_path / "out" / "one.range2f", SINGLE).reshape(-1, 2)
    assert len(own) == len(gates_m)
    for ranges in (whole, own):
        assert np.isfinite(ranges).all()
        assert (ranges[:, 0] >= 0).all()
        assert (ranges[:, 0] <= ranges[:, 1]).all()
    size = (tmp_path / "out" / "one.mat3x4f").stat().st_size
    assert size > 0
    assert size % 48 == 0
    # the plugin counts whole microseconds between frames
    assert int(1e6 / SINGLE(plugin.findtext("update_rate"))) >= 1


# CloudCompare and Blender -------------------------------------------------------------------------------------------

# libs/qCC_io/src/PlyFilter.cpp; source/blender/io/ply/importer/ply_import_data.cc


def cloudcompare(element, names):
    """What CloudCompare takes each property for, before it asks."""
    found = {}
    for name in map(str.upper, names):
        guesses = (
            *((axis, axis in name) for axis in ("NX", "NY", "NZ")),
            *((colour, colour in name) for colour in ("RED", "GREEN", "BLUE")),
            ("scalar", any(word in name for word in ("INTENSITY", "GRAY", "GREY"))),
            ("scalar", "VERT" in element.upper() and "SCAL" in name),
            *((axis, "VERT" in element.upper() and name.endswith(axis)) for axis in "XYZ"),
        )
        taken = set(found.values()) - {"scalar"}
        found[name] = next((what for what, fits in guesses if fits and what not in taken), None)
    return found


def test_cloudcompare_knows_every_property_of_the_points(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    write_as("ply", ONE, rays_along(FORWARD, (0.0, 9.0)), tmp_path)
    points, beams = (trimesh.load(tmp_path / f"{name}.ply").metadata["_ply_raw"] for name in ("rays", "beams"))
    names = list(points["vertex"]["properties"])
    known = cloudcompare("vertex", names)
    assert [known[name.upper()] for name in names] == [
        *("X", "Y", "Z", "NX", "NY", "NZ", "RED", "GREEN", "BLUE"), *("scalar",) * 4
    ]  # fmt: skip
    assert set(cloudcompare("edge", beams["edge"]["properties"]).values()) == {None}
