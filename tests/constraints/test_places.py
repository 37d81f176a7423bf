"""Places of sensors that are told to the millimetre, where the design space has one of all digits."""

from __future__ import annotations

import numpy as np
import pytest
from support.sensors import normal_sensor

from lidardesign.constraints.check import check_design
from lidardesign.constraints.document import Constraints
from lidardesign.constraints.feasibility import check_feasible
from lidardesign.constraints.origins import SAME_PLACE_M, snap_to_space
from lidardesign.errors import InfeasibleError
from lidardesign.formats.designs import load_design
from lidardesign.formats.rig import rig_constraints
from lidardesign.sensors.design import DesignSpec
from lidardesign.sensors.design_file import design_document
from lidardesign.space import DesignSpace

PLACE_M = 0.4510446472167969
SPACE = DesignSpace((PLACE_M, 0.0, 0.0, 2.0, -1.0, 0.1), (PLACE_M, 1.0, 0.0, 4.0, 1.0, 2.0))


def rig(*origins_m):
    sensors = tuple(
        normal_sensor(f"lidar {i}", 1 / len(origins_m), origin, azimuth_rad=3.0, spread_rad=(0.1, 0.1), range_m=0.5)
        for i, origin in enumerate(origins_m)
    )
    return DesignSpec("rig", sensors)


@pytest.mark.parametrize("told", [PLACE_M, 0.451044647, 0.451, 0.4515])
def test_a_place_that_was_rounded_is_the_place(told):
    constraints = Constraints.from_mapping({"origin": {"fixed_m": [told, 0.5, 0]}})
    check_feasible(constraints, SPACE)
    found, notes = snap_to_space(constraints, SPACE)
    assert found.origin.fixed_m == [PLACE_M, 0.5, 0.0]
    assert len(notes) == (abs(told - PLACE_M) > 1e-9)
    like = rig_constraints(rig((told, 0.5, 0)), SPACE, Constraints(), rays=None)
    assert like.each[0].origin.fixed_m == [PLACE_M, 0.5, 0.0]
    document = design_document(rig((PLACE_M, 0.5, 0)))
    kept = {check.name: check.satisfied for check in check_design(document, constraints, SPACE)}
    assert kept["lidar 0.origin.fixed_m"]


def test_a_place_that_is_another_stays_another():
    far = PLACE_M + 1.01 * SAME_PLACE_M
    constraints = Constraints.from_mapping({"origin": {"fixed_m": [far, 0.5, 0]}})
    assert snap_to_space(constraints, SPACE) == (constraints, [])
    with pytest.raises(InfeasibleError, match="x_m of the origin"):
        check_feasible(constraints, SPACE)
    with pytest.raises(
        InfeasibleError, match=r"stand at x 0\.451045, y 0 to 1, z 0 m; the rig's lidar 1 at x 0\.452055"
    ):
        rig_constraints(rig((PLACE_M, 0.5, 0), (far, 0.5, 0)), SPACE, Constraints(), rays=None)
    free = Constraints.from_mapping({"origin": {"fixed_m": [PLACE_M, 0.1234567, 0]}})
    assert snap_to_space(free, SPACE) == (free, [])


def test_a_place_that_the_user_gives_is_not_the_rigs():
    own = Constraints.from_mapping({"origin": {"low_m": [0, 0, 0], "high_m": [1, 1, 1]}})
    found = rig_constraints(rig((3.0, 0.5, 0)), SPACE, own, rays=None)
    assert found.each[0].origin.fixed_m is None


def rays_file(tmp_path, y_m):
    lines = ["sensor,origin_x_m,origin_y_m,origin_z_m,azimuth_deg,elevation_deg,gate_start_m,gate_end_m"]
    lines += [
        f"{name},{x},{y_m},0,{angle},0,0.1,0.9"
        for name, x in (("left", 0.2), ("it's right", 0.8))
        for angle in (60, 90, 120)
    ]
    path = tmp_path / "rig.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


def test_a_fit_like_a_rig_keeps_its_names_and_its_place_where_that_was_rounded(call, flat, tmp_path):
    path = rays_file(tmp_path, 4e-4)
    result = call("fit", flat, "--like", path, "--name", "alike", "--json")
    assert result.code == 0, result.err
    note = "left, it's right: 0.4 mm from where the run's sensors stand: treated as standing there"
    assert note in result.err
    assert [sensor["name"] for sensor in result.json["sensors"]] == ["left", "it's right"]
    design = load_design(flat / "designs" / "alike.yaml")
    assert [sensor.name for sensor in design.sensors] == ["left", "it's right"]
    assert [list(sensor.origin_m) for sensor in design.sensors] == [[0.2, 0, 0], [0.8, 0, 0]]
    assert design.count == 6
    for one, theirs in zip(design.sensors, load_design(path).sensors, strict=True):
        assert (np.array(one.field_of_view_rad) <= np.array(theirs.field_of_view_rad) + 1e-6).all()
        assert np.ptp(one.gate_m) <= 0.8 + 1e-9
    assert {"left.origin.fixed_m", "it's right.gate.width_m.max"} <= {one["name"] for one in result.json["constraints"]}
    assert result.json["satisfied"]


def test_a_rig_elsewhere_is_refused_with_what_to_learn(call, flat, tmp_path):
    result = call("fit", flat, "--like", rays_file(tmp_path, 0.3))
    assert result.code == 4
    assert "the rig's left at x 0.2, y 0.3, z 0 m" in result.err
    assert "learn with" in result.err
    assert not {"relax", "loosen"} & set(result.err.split())


def test_an_origin_that_is_set_counts_as_the_place_next_to_it(call, flat):
    setting = ["--set", "origin.fixed_m=[0.5, 0.0008, 0]", "--layout", "even", "--sensors", 1]
    result = call("constrain", flat, *setting, "--name", "set", "--json")
    assert result.code == 0, result.err
    assert "origin.fixed_m is 0.8 mm from where the run's sensors stand: treated as being there" in result.err
    refused = call("constrain", flat, "--set", "origin.fixed_m=[0.5, 0.002, 0]", "--sensors", 1)
    assert refused.code == 4
