"""Isaac Sim's sensors as USD: fields, types, lengths, and where rays go."""

import numpy as np
import pytest
from support.exports import write_as
from support.rigs import rig

from lidardesign.errors import ConfigError
from lidardesign.scenes.rays import rotation_of_quaternion
from lidardesign.space import direction

DESIGN, RAYS = rig()
COUNTS = np.bincount(RAYS.sensor)

# Attributes of OmniSensorGenericLidarCoreAPI and its emitter states, with the types of USD.
CORE_TYPES = {
    **dict.fromkeys(("scanType", "rayType", "elementsCoordsType", "outputFrameOfReference"), "token"),
    **dict.fromkeys(
        ("scanRateBaseHz", "reportRateBaseHz", "patternFiringRateHz", "numberOfEmitters", "numberOfChannels",
         "maxReturns", "numLines", "rangeCount"), "uint"),
    **dict.fromkeys(
        ("nearRangeM", "farRangeM", "minDistBetweenEchosM", "azimuthErrorMean", "azimuthErrorStd",
         "elevationErrorMean", "elevationErrorStd", "rangeAccuracyM", "rangeResolutionM", "minReflectance",
         "minReflectionRangeM"), "float"),
    **dict.fromkeys(("rangesMinM", "rangesMaxM"), "float[]"),
    "numRaysPerLine": "uint[]",
    **dict.fromkeys(("emitterState:s001:azimuthDeg", "emitterState:s001:elevationDeg"), "float[]"),
    **{f"emitterState:s001:{name}": "uint[]" for name in ("fireTimeNs", "channelId", "rangeId", "bank")},
}  # fmt: skip
TOKENS = {
    "scanType": "SOLID_STATE", "rayType": "IDEALIZED", "elementsCoordsType": "CARTESIAN",
    "outputFrameOfReference": "SENSOR",
}  # fmt: skip


@pytest.fixture(scope="module")
def stage(tmp_path_factory):
    usd = pytest.importorskip("pxr.Usd", reason="needs usd-core: the extra `consumers`")
    path = tmp_path_factory.mktemp("usd") / "rig.usda"
    write_as("isaac-usd", DESIGN, RAYS, path)
    return usd.Stage.Open(str(path))


def test_usd_has_an_omnilidar_per_sensor_with_the_schemas_types(stage):
    assert str(stage.GetDefaultPrim().GetPath()) == "/Lidar"
    assert stage.GetMetadata("upAxis") == "Z"
    assert stage.GetMetadata("metersPerUnit") == 1
    prims = stage.GetDefaultPrim().GetChildren()
    assert [one.GetTypeName() for one in prims] == ["OmniLidar"] * len(DESIGN.sensors)
    for prim, sensor, count in zip(prims, DESIGN.sensors, COUNTS, strict=True):
        assert prim.GetDisplayName() == prim.GetAttribute("omni:sensor:marketName").Get() == sensor.name
        schemas = prim.GetMetadata("apiSchemas").GetAddedOrExplicitItems()
        assert schemas == ["OmniSensorGenericLidarCoreAPI", "OmniSensorGenericLidarCoreEmitterStateAPI:s001"]
        core = {one.GetName().removeprefix("omni:sensor:Core:"): one for one in prim.GetAttributes()}
        for name, kind in CORE_TYPES.items():
            assert str(core[name].GetTypeName()) == kind, name
            if kind.endswith("[]") and name.startswith("emitterState"):
                assert len(core[name].Get()) == count
        assert {name: core[name].Get() for name in TOKENS} == TOKENS
        ours = {name for name in core if not name.startswith(("omni:", "xformOp"))}
        assert ours == set(CORE_TYPES)
        assert sum(core["numRaysPerLine"].Get()) == core["numberOfEmitters"].Get() == count
        assert sorted(core["emitterState:s001:channelId"].Get()) == list(range(1, count + 1))
        assert len(core["rangesMinM"].Get()) == len(core["rangesMaxM"].Get()) == core["rangeCount"].Get()
        assert 0 == core["minDistBetweenEchosM"].Get() < core["nearRangeM"].Get()
        assert core["rangeResolutionM"].Get() > 0
        assert core["minReflectionRangeM"].Get() >= core["farRangeM"].Get()
        assert list(prim.GetAttribute("omni:sensor:frameRate").Get()) == [10, 1]


def test_usd_places_every_ray_with_its_gate(stage):
    for index, prim in enumerate(stage.GetDefaultPrim().GetChildren()):
        mine = RAYS.subset(RAYS.sensor == index)
        assert list(prim.GetAttribute("xformOpOrder").Get()) == ["xformOp:translate", "xformOp:orient"]
        place = np.array(prim.GetAttribute("xformOp:translate").Get())
        np.testing.assert_allclose(place, mine.origin_m.mean(axis=0), atol=1e-12)
        orient = prim.GetAttribute("xformOp:orient").Get()
        turn = rotation_of_quaternion(orient.GetReal(), *orient.GetImaginary())
        core = {one.GetName().split(":")[-1]: one.Get() for one in prim.GetAttributes()}
        # degrees: x forward, y to the left at +90, z up
        looking = direction(*(np.radians(np.array(core[name], float)) for name in ("azimuthDeg", "elevationDeg")))
        np.testing.assert_allclose(looking @ turn.T, mine.direction, atol=2e-7)
        ranges = np.stack([core["rangesMinM"], core["rangesMaxM"]], axis=1)[list(core["rangeId"])]
        np.testing.assert_allclose(ranges, np.maximum(mine.gate_m, 0.001), atol=3e-7)
        times = np.array(core["fireTimeNs"], dtype=np.int64)
        assert (np.abs(times - mine.time_s * 1e9) <= 1).all()
        assert times.max() < 100_000_000


def test_frames_are_whole_numbers_per_second(tmp_path):
    with pytest.raises(ConfigError, match=r"0\.3 frames per second"):
        write_as("isaac-usd", DESIGN, RAYS, tmp_path / "slow", 0.3)
    assert list(tmp_path.iterdir()) == []
    notes = write_as("isaac-usd", DESIGN, RAYS, tmp_path / "out", 12.6)
    assert any("12.6 Hz is 13 Hz" in note for note in notes)
