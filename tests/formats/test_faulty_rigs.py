"""Rigs' files with small faults: what is wrong is said, as of a bad file and not of a bad command line."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest

from lidardesign.errors import DataError
from lidardesign.formats.designs import load_design
from lidardesign.run.xml import read_xml
from lidardesign.sensors.design_file import save_design

HEADER = "origin_x_m,origin_y_m,origin_z_m,azimuth_deg,elevation_deg,gate_start_m,gate_end_m"
ROWS = ["0.5,0,0,60,0,0.1,0.9", "0.5,0,0,90,0,0.1,0.9", "0.5,0,0,120,0,0.1,0.9"]
GOOD = "\n".join([HEADER, *ROWS]) + "\n"
SDF = """<sdf version="1.9"><model name="m"><link name="l"><sensor name="fan" type="gpu_lidar">
<pose>0.5 0 0 0 0 1.5708</pose><lidar><scan><horizontal><samples>3</samples>
<min_angle>-0.5</min_angle><max_angle>0.5</max_angle></horizontal></scan>
<range><min>0.1</min><max>0.9</max></range></lidar></sensor></link></model></sdf>
"""
MJCF = """<mujoco><worldbody><body name="b" pos="PLACE"><site name="s"/></body></worldbody>
<sensor><rangefinder name="eye" site="s" cutoff="2"/></sensor></mujoco>
"""


SEMICOLONS = "\n".join([HEADER, *ROWS]).replace(",", ";").replace(".", ",")
NOISE = np.random.default_rng(5).bytes(3000)
ARCHIVE = io.BytesIO()
np.savez(ARCHIVE, azimuth_deg=np.zeros(3))


def placed(place):
    return MJCF.replace("PLACE", place).encode()


FAULTS = {
    **{f"empty {kind}": (f"rig.{kind}", b"\n", "is empty") for kind in ("csv", "sdf", "xml")},
    "empty npz": ("rig.npz", b"", "is empty"),
    "semicolons": ("rig.csv", SEMICOLONS.encode(), "separated by ; (a semicolon)"),
    "semicolons with commas first": ("rig.csv", SEMICOLONS.partition("\n")[2].encode(), "separated by ;"),
    "tabs": ("rig.csv", GOOD.replace(",", "\t").encode(), "separated by tabs"),
    "comment": ("rig.csv", f"# made by hand\n{GOOD}".encode(), "begins with a comment"),
    "no header": ("rig.csv", "\n".join(ROWS).encode(), "no names of columns"),
    "no header, names": ("rig.csv", b"left,0.5,0,0,60,0\nleft,0.5,0,0,90,0\n", "no names"),
    "noise csv": ("rig.csv", NOISE, "is not UTF-8 text"),
    "noise sdf": ("rig.sdf", NOISE, "is not XML"),
    "noise npz": ("rig.npz", NOISE, "is not an NPZ archive"),
    "cut npz": ("rig.npz", ARCHIVE.getvalue()[:-30], "cut short"),
    "far mjcf": ("rig.xml", placed("0 1e30 0"), "'eye' has the place 1e+30 m"),
    "farther mjcf": ("rig.xml", placed("-1e308 0 0"), "'eye' has the place 1e+308 m"),
    "mjcf nowhere": ("rig.xml", placed("0 0 nan"), "MuJoCo cannot read it"),
    "far sdf": ("rig.sdf", SDF.replace("0.5 0 0 0", "1e12 0 0 0").encode(), "place of 'fan' is 1e+12 m"),
    "Latin-1": ("rig.csv", GOOD.replace("origin_x_m", "l\u00e4nge").encode("latin-1"), "is not UTF-8 text"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_faulty_file_is_refused_for_what_is_wrong_with_it(call, tmp_path, fault):
    name, content, found = FAULTS[fault]
    (tmp_path / name).write_bytes(content)
    result = call("show", name)
    assert found in " ".join(result.err.split())
    assert name in result.err
    assert result.code == 3


def test_what_mujoco_warns_of_is_written_to_no_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rig.xml").write_text(MJCF.replace('name="s"', 'name="s" size="nan nan"').replace("PLACE", "0 0 0"))
    assert len(load_design(tmp_path / "rig.xml").sensors) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["rig.xml"]


def test_good_files_are_read_as_before_whatever_they_are_called(tmp_path):
    (tmp_path / "rig.csv").write_text(GOOD)
    rig = load_design(tmp_path / "rig.csv")
    save_design(rig, tmp_path / "design.yaml")
    for name, source in (("rig.txt", "rig.csv"), ("rig.sdf", "rig.csv"), ("design.csv", "design.yaml")):
        (tmp_path / name).write_bytes((tmp_path / source).read_bytes())
        assert load_design(tmp_path / name).count == 3


def test_xml_that_stops_anywhere_is_said_to_end_early(tmp_path):
    path = tmp_path / "rig.sdf"
    for end in range(1, SDF.rindex("</sdf>") + 5, 7):
        path.write_text(SDF[:end])
        with pytest.raises(DataError, match="ends early"):
            read_xml(path, "XML")
    path.write_text(SDF[: SDF.index("<range>")])
    with pytest.raises(DataError, match="ends early: <lidar> of line 2 is not closed"):
        read_xml(path, "XML")


def test_a_file_that_may_not_be_read_is_a_bad_file_like_one_that_is_not_there(call, made, tmp_path, monkeypatch):
    (tmp_path / "rig.csv").write_text(GOOD)

    # whoever runs the tests may read everything
    def refused(path, *arguments):
        if Path(path).name == "rig.csv":
            raise PermissionError(13, "Permission denied")
        return open(path, *arguments)

    monkeypatch.setattr("lidardesign.run.inputs.open", refused, raising=False)
    for arguments in (["show", "rig.csv"], ["evaluate", "rig.csv"], ["fit", made, "--like", "rig.csv"]):
        result = call(*arguments)
        assert (result.code, "Permission denied" in result.err) == (3, True), arguments
    assert call("show", "none.csv").code == 3


def test_files_that_only_their_endings_tell_apart_are_called_by_them(call, made, tmp_path):
    (tmp_path / "rig.csv").write_text(GOOD)
    (tmp_path / "rig.sdf").write_text(SDF)
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "rig.csv").write_text(GOOD)
    options = ("--in", made, "--rays", 2, "--baseline", "none", "--json")
    scored = call("evaluate", "rig.csv", "rig.sdf", *options)
    assert scored.code == 0, scored.err
    assert [row["design"] for row in scored.json["rows"]] == ["rig.csv", "rig.sdf"]
    names = [row["design"] for row in call("evaluate", "rig.csv", "rig.sdf", "other/rig.csv", *options).json["rows"]]
    assert len(set(names)) == 3
    assert names[2] == "other/rig"
