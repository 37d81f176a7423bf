"""MuJoCo models as bodies: rays meet them where MuJoCo's do, distances are those of their surfaces, bad files fail."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from lidardesign.density.fields.distance import build_field
from lidardesign.errors import DataError
from lidardesign.scenes.casting import SceneCaster
from lidardesign.scenes.mujoco_models import PNG_BEGINNING, bodies_from_mujoco, load_model, model_files, visible_geoms
from lidardesign.scenes.scene import Cylinder, Mesh, Plane, Scene, Sphere
from lidardesign.scenes.surface import sample_body
from lidardesign.space import DesignSpace

SPACE = DesignSpace((-1, -1, -1, -3, -1, 0.1), (1, 1, 1, 3, 1, 3))
RAY_M = 1e-6
SPACING_M = 5e-3  # of 200,000 points on a square metre or two, at their sparsest
TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
WEDGE = "0 0 0  .5 0 0  .1 .6 0  0 .1 .7  .3 .3 .5"
ASSETS = f"""<asset><mesh name="wedge" vertex="{WEDGE}"/>
<hfield name="hills" nrow="4" ncol="5" size=".6 .4 .3 .1"
 elevation="0 1 2 1 0  3 1 4 1 5  2 6 5 3 5  8 9 7 9 3"/></asset>"""
GEOMS = {
    "sphere": 'type="sphere" size=".3"',
    "box": 'type="box" size=".3 .2 .4"',
    "capsule": 'type="capsule" size=".2 .4"',
    "cylinder": 'type="cylinder" size=".3 .4"',
    "ellipsoid": 'type="ellipsoid" size=".5 .3 .1"',
    "mesh": 'type="mesh" mesh="wedge"',
    "height field": 'type="hfield" hfield="hills"',
}


def model_of(geoms, inside="", assets=ASSETS):
    return mujoco.MjModel.from_xml_string(f"<mujoco>{assets}<worldbody>{inside}{geoms}</worldbody></mujoco>")


def turned(generator):
    """A random place and orientation, as attributes of a geom or body."""
    quaternion = Rotation.random(random_state=int(generator.integers(2**31))).as_quat(scalar_first=True)
    return f'pos="{" ".join(map(str, generator.normal(0, 0.1, 3)))}" quat="{" ".join(map(str, quaternion))}"'


def mujoco_ranges(model, qpos, origins, directions):
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    hit = np.zeros(1, dtype=np.int32)
    ranges = [
        mujoco.mj_ray(model, data, origin, ray, None, True, -1, hit)
        for origin, ray in zip(origins, directions, strict=True)
    ]
    return np.where(np.array(ranges) < 0, np.inf, ranges)


def rays_inward(count, generator, distance_m=2.0):
    origins = generator.normal(size=(count, 3))
    origins *= distance_m / np.linalg.norm(origins, axis=1, keepdims=True)
    directions = generator.normal(scale=0.2, size=(count, 3)) - origins
    return origins, directions / np.linalg.norm(directions, axis=1, keepdims=True)


def assert_same_ranges(found, expected):
    """But for rays that graze: meshes are met in float32, two metres away."""
    same = np.isclose(found, expected, rtol=0, atol=RAY_M) | (np.isinf(found) & np.isinf(expected))
    assert np.isfinite(expected).sum() > 50
    assert same.mean() > 0.99
    assert (np.isclose(found, expected, rtol=0, atol=1e-5) | same).mean() > 0.998


@pytest.mark.parametrize("kind", GEOMS)
@pytest.mark.parametrize("seed", range(3))
def test_rays_meet_a_geom_where_those_of_mujoco_do(kind, seed):
    generator = np.random.default_rng(seed)
    body = f'<body {turned(generator)}><joint type="ball"/><geom {GEOMS[kind]} {turned(generator)}/></body>'
    model = model_of(body if kind != "height field" else f"<geom {GEOMS[kind]} {turned(generator)}/>")
    qpos = Rotation.random(random_state=seed).as_quat(scalar_first=True)[: model.nq]
    (part,) = bodies_from_mujoco(model, qpos)
    origins, directions = rays_inward(1000, generator)
    origins[::4] *= 0.05  # some start inside
    if kind in ("mesh", "height field"):
        origins[::4] *= 20.0  # MuJoCo sees meshes from outside alone
    hits = SceneCaster(Scene((part.body,))).first_hit(origins, directions)
    assert_same_ranges(hits.range_m, mujoco_ranges(model, qpos, origins, directions))


@pytest.mark.parametrize("kind", GEOMS)
def test_the_signed_distance_of_a_geom_is_that_to_the_nearest_of_many_points_on_it(kind):
    generator = np.random.default_rng(4)
    model = model_of(f"<geom {GEOMS[kind]} {turned(generator)}/>")
    (part,) = bodies_from_mujoco(model, model.qpos0)
    surface = sample_body([part.body], SPACE, 200_000, generator).points
    # near it, where grids of meshes reach
    points = generator.choice(surface, 300) + generator.normal(0, 0.04, (300, 3))
    brute_m, _ = cKDTree(surface).query(points)
    field = build_field([Scene((part.body,))], lambda body: True, resolution=96, padding_m=0.1)
    found = field.distances(points)[:, 0]
    far = brute_m > 0.01
    # what is inside is left by every ray through an odd number of surfaces
    caster = SceneCaster(Scene((part.body,)))
    crossed = caster.crossings(points, np.tile([[0.36, 0.48, 0.8]], (300, 1)), np.zeros(300), np.full(300, 9.0))
    inside = np.bincount(crossed.row, minlength=300) % 2 == 1
    assert inside[far].any()
    assert (np.sign(found[far]) == np.where(inside, -1, 1)[far]).all()
    # no point on the surface is nearer, and one is near the nearest: of a mesh, within the error of its grid
    slack = 5e-3 if isinstance(part.body.shape, Mesh) else 1e-9
    assert (np.abs(found) <= brute_m + slack).all()
    assert (np.abs(found) >= brute_m - slack - SPACING_M).all()


def test_a_whole_model_is_met_where_mujoco_meets_it_in_every_frame():
    generator = np.random.default_rng(7)
    geoms = [f"<body {turned(generator)}><joint/><geom {geom} {turned(generator)}/></body>" for geom in GEOMS.values()]
    model = model_of('<geom type="plane" size="1 2 1" pos="0 0 -.8"/>' + "".join(geoms[:-1]))
    qpos = generator.normal(size=(3, model.nq))
    parts = bodies_from_mujoco(model, qpos)
    assert [part.body_name for part in parts] == ["world", *(f"body {number}" for number in range(1, model.nbody))]
    scene = Scene(tuple(part.body for part in parts))
    assert scene.frames == 3
    origins, directions = rays_inward(1000, generator)
    origins[:, 2] = np.abs(origins[:, 2])  # MuJoCo sees planes from their front alone
    for frame in range(3):
        hits = SceneCaster(scene, frame).first_hit(origins, directions)
        assert_same_ranges(hits.range_m, mujoco_ranges(model, qpos[frame], origins, directions))


def test_planes_reach_as_far_as_their_size_or_the_clip():
    model = model_of('<geom name="a" type="plane" size="0 0 1"/><geom name="b" type="plane" size="2 3 1"/>')
    endless, sized = (part.body.shape for part in bodies_from_mujoco(model, model.qpos0))
    assert isinstance(endless, Plane)
    np.testing.assert_array_equal(sized.bounds_m[1], [2, 3, 0])
    clipped = [part.body.shape.bounds_m[1] for part in bodies_from_mujoco(model, model.qpos0, clip_m=2.5)]
    np.testing.assert_array_equal(clipped, [[2.5, 2.5, 0], [2, 2.5, 0]])


def test_geoms_are_seen_by_their_group_and_keep_their_names():
    model = model_of("""<body name="arm">
      <geom name="skin" size=".1" group="2"/><geom size=".2"/><geom name="hull" size=".3" group="3"/>
      <geom name="glass" size=".4" rgba="1 1 1 0"/>
      <geom type="mesh" mesh="wedge"/><geom type="mesh" mesh="wedge" pos="1 0 0"/></body>""")
    shown, notes = visible_geoms(model)
    assert [(geom.name, geom.body_name, geom.geom_name) for geom in shown] == [
        ("arm skin", "arm", "skin"), ("arm 2", "arm", ""), ("arm 3", "arm", ""),
    ]  # fmt: skip
    assert not notes
    assert shown[2].shape.bounds_m[1, 0] > 1.0  # meshes without a name are one
    hulls, _ = visible_geoms(model, groups=[3])
    assert [(geom.name, geom.shape) for geom in hulls] == [("arm", Sphere(0.3))]


@pytest.mark.parametrize("material", ["", 'material="clear"', 'material="solid"'])
@pytest.mark.parametrize("colour", ["", 'rgba="1 0 0 0"', 'rgba="1 0 0 1"'])
def test_what_rays_of_mujoco_pass_through_is_no_body(material, colour):
    assets = '<asset><material name="clear" rgba="1 1 1 0"/><material name="solid" rgba="1 1 1 1"/></asset>'
    model = model_of(f'<geom size="1" {material} {colour}/><geom name="other" size=".1" pos="5 5 5"/>', assets=assets)
    (range_m,) = mujoco_ranges(model, model.qpos0, np.array([[3.0, 0, 0]]), np.array([[-1.0, 0, 0]]))
    assert len(bodies_from_mujoco(model, model.qpos0)) == 1 + np.isfinite(range_m)


def test_what_only_collides_is_left_out_where_its_body_has_other_shapes_to_be_seen():
    hull, skin = '<geom name="hull" size=".3"/>', '<geom name="skin" size=".2" group="1" contype="0" conaffinity="0"/>'
    for geoms, names in (
        (hull + skin, ["skin"]),
        (hull, ["hull"]),
        (hull + skin.replace('group="1"', ""), ["hull", "skin"]),
    ):
        model = model_of(f"<geom size='.1'/><body>{geoms}</body>")
        on_body = [part.geom_name for part in bodies_from_mujoco(model, model.qpos0) if part.body_name != "world"]
        assert on_body == names
        assert bool(visible_geoms(model)[1]) == (names == ["skin"])


def test_poses_and_groups_that_a_model_does_not_have_are_refused():
    model = model_of('<body><freejoint/><geom size="1"/></body>')
    for qpos in (np.zeros(3), np.full((2, 7), np.nan), np.zeros((0, 7))):
        with pytest.raises(DataError, match=r"\(frames, 7\)"):
            bodies_from_mujoco(model, qpos)
    with pytest.raises(DataError, match=r"(?s)groups that it uses: 0.*--set 'groups=\[0\]'"):
        bodies_from_mujoco(model, model.qpos0, groups=[4])


URDF = """<robot name="r"><link name="base"><visual><geometry><mesh filename="package://r/meshes/m.obj"/></geometry>
</visual></link><link name="tip"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>
</inertial><visual><geometry><sphere radius=".1"/></geometry></visual><collision><geometry>
<cylinder radius=".1" length=".4"/></geometry></collision></link>
<joint name="turn" type="continuous"><parent link="base"/><child link="tip"/><axis xyz="0 0 1"/></joint></robot>"""


def test_a_urdf_finds_the_meshes_of_its_package_and_shows_its_visual_shapes(tmp_path):
    for folder in ("meshes", "urdf"):
        (tmp_path / folder).mkdir()
    path = tmp_path / "urdf" / "r.urdf"
    path.write_text(URDF)
    (tmp_path / "meshes" / "m.obj").write_text(TETRAHEDRON)
    model, _ = load_model(path, folder=tmp_path)
    parts = bodies_from_mujoco(model, [0.3])
    assert [(part.body_name, type(part.body.shape)) for part in parts] == [("base", Mesh), ("tip", Sphere)]
    assert [type(geom.shape) for geom in visible_geoms(model, groups=[0])[0]] == [Cylinder]
    with pytest.raises(DataError, match=r"m\.obj"):
        load_model(path)
    path.write_text(URDF.replace(".obj", ".dae"))
    model, notes = load_model(path)
    assert [part.body_name for part in bodies_from_mujoco(model, [0.3])] == ["tip"]
    assert "reads no .dae" in notes[0]
    assert "links without any: base; to read them: python -c" in notes[0]
    path.write_text(URDF.replace(".obj", ".dae").replace("collision", "other"))
    assert [part.body_name for part in bodies_from_mujoco(load_model(path)[0], [0.3])] == ["tip"]
    path.write_text(URDF.replace("sphere", 'mesh filename="n.dae"').replace("collision", "other"))
    path.write_text(path.read_text().replace(".obj", ".dae"))
    with pytest.raises(DataError, match="no other shape is left"):
        load_model(path)


@pytest.mark.parametrize("name", ["package://r/meshes/m.obj", "model://r/meshes/m.obj", "file://{}/meshes/m.obj"])
def test_a_mesh_is_found_by_every_kind_of_name_and_the_hint_names_the_folder_that_holds_it(tmp_path, name):
    for folder in ("r/urdf", "r/meshes", "other/meshes"):
        (tmp_path / folder).mkdir(parents=True)
    path = tmp_path / "r" / "urdf" / "r.urdf"
    path.write_text(URDF.replace("package://r/meshes/m.obj", name.format(tmp_path / "r")))
    (tmp_path / "r" / "meshes" / "m.obj").write_text(TETRAHEDRON)
    with pytest.raises(DataError, match="outside the model's folder") as refused:
        load_model(path)
    assert f"--set folder={tmp_path / 'r'} " in str(refused.value)
    assert load_model(path, folder=tmp_path / "r")[0].nmesh == 1
    # a file of the same name in another package is another file
    (tmp_path / "other" / "meshes" / "m.obj").write_text(TETRAHEDRON.replace("1", "2").replace("f 2 3 2", "f 1 3 2"))
    path.write_text(URDF.replace("package://r", "package://other"))
    assert model_files(path, tmp_path)[1][0] == str(tmp_path / "other" / "meshes" / "m.obj")


MASSLESS = {
    "a flat mesh": '<geom type="mesh" mesh="flat" contype="0" conaffinity="0"/>',
    "a body without mass": '<geom size="1" mass="0"/>',
    "a body without shapes": "<body name='frame'><joint/></body><geom size='1'/>",
    "an inertia that no body has": '<inertial pos="0 0 0" mass="1" diaginertia="9 1 1"/><geom size="1"/>',
}


@pytest.mark.parametrize("case", MASSLESS)
def test_masses_that_mujoco_refuses_are_replaced_with_a_note(tmp_path, case):
    (tmp_path / "flat.obj").write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3\nf 1 3 4\n")
    asset = '<asset><mesh name="flat" file="flat.obj"/></asset>' if "flat" in case else ""
    body = f'<worldbody><body name="b"><joint/>{MASSLESS[case]}</body></worldbody>'
    (tmp_path / "m.xml").write_text(f"<mujoco>{asset}{body}</mujoco>")
    model, (note,) = load_model(tmp_path / "m.xml")
    assert "m.xml: MuJoCo refuses its masses (" in note
    assert len(visible_geoms(model)[0]) == 1


def test_a_range_that_ends_below_its_start_is_told(tmp_path):
    joint = '<body><joint name="lift" range="60 -60"/><geom size="1"/></body>'
    (tmp_path / "lift.xml").write_text(f"<mujoco><worldbody>{joint}</worldbody></mujoco>")
    model, notes = load_model(tmp_path / "lift.xml")
    assert not model.jnt_limited.any()
    assert "the range of joint 'lift' ends below its start" in notes[0]


BAD = {
    "a missing file": (None, "cannot be read"),
    "no XML": ("hello", "is not XML"),
    "another format": ("<sdf/>", "its root element is <sdf>.*sdf2mjcf"),
    "macros": ('<robot><xacro:include filename="a"/></robot>', "run xacro first.*xacro .*robot.xml > "),
    "macros in names": (URDF.replace("package://r", "$(find r)"), "run xacro first"),
    "a mesh of another machine": (URDF.replace("package://", "/nowhere/"), "it is not on this machine"),
    "a mesh that is text": (
        '<mujoco><asset><mesh file="words.stl"/></asset></mujoco>',
        "trimesh.load_mesh.*rglob..words.stl",
    ),
    "a pointer": ('<mujoco><asset><mesh file="pointer.obj"/></asset></mujoco>', "git lfs pull"),
    "a file outside": ('<mujoco><asset><mesh file="../m.obj"/></asset></mujoco>', "outside the model's folder"),
    "a folder outside": ('<mujoco><compiler meshdir="/etc"/></mujoco>', "outside the model's folder"),
    "an unknown joint": (
        '<mujoco><worldbody><body><joint type="saddle"/><geom size="1"/></body></worldbody></mujoco>',
        "MuJoCo cannot read it",
    ),
    "copies without end": (
        '<mujoco><worldbody><replicate count="1000"><replicate count="1000"><geom size="1"/></replicate></replicate>'
        "</worldbody></mujoco>",
        "has 2.001e.06 copies",
    ),
    "a grid without end": (
        '<mujoco><worldbody><body name="b"><flexcomp name="f" count="900 900 9"/></body></worldbody></mujoco>',
        "has 7.29e.06 copies",
    ),
    "elements without end": (
        "<mujoco><worldbody>" + '<geom size="1"/>' * 30_000 + "</worldbody></mujoco>",
        "too many elements.*20000 elements",
    ),
    "a texture without end": (
        '<mujoco><asset><texture type="2d" name="t" builtin="flat" width="60000" height="60000"/></asset></mujoco>',
        "has 3.6e.09 pixels of textures",
    ),
    "a sky without end": (
        '<mujoco><asset><texture type="skybox" builtin="flat" width="30000" height="1"/></asset></mujoco>',
        "has 5.4e.09 pixels of textures",
    ),
    "a picture without end": (
        '<mujoco><asset><texture type="2d" name="t" file="huge.png"/></asset></mujoco>',
        "has 9e.08 pixels of textures",
    ),
    "terrain without end": (
        '<mujoco><asset><hfield name="h" nrow="50000" ncol="50000" size="1 1 1 1"/></asset></mujoco>',
        "has 2.5e.09 places of height fields",
    ),
    "a picture of terrain without end": (
        '<mujoco><asset><hfield name="h" file="huge.png" size="1 1 1 1"/></asset></mujoco>',
        "has 9e.08 places of height fields",
    ),
    "keyframes without end": ('<mujoco><size nkey="1000000000"/></mujoco>', "nkey is 1000000000"),
    "numbers without end": ('<mujoco><size nuser_geom="100000000"/></mujoco>', "nuser_geom is 100000000"),
    "levels without end": ("<mujoco>" + "<worldbody>" * 5000, "nested too deep"),
    **{
        f"a range of {low}": (
            '<mujoco><worldbody><body><joint name="lift" limited="true" range="'
            f'{low} {high}"/><geom size="1"/></body></worldbody></mujoco>',
            "jnt_range of 'lift' is",
        )
        for low, high in (("-inf", "inf"), ("nan", "nan"), ("-1e300", "1e300"))
    },
    "a place that is no number": (
        '<mujoco><worldbody><geom name="g" pos="nan 0 0" size="1"/></worldbody></mujoco>',
        "geom_pos of 'g' is nan 0.0 0.0",
    ),
    "a place far away": (
        '<mujoco><worldbody><body name="b" pos="1e200 0 0"><geom size="1"/></body></worldbody></mujoco>',
        "body_pos of 'b' is 1e.200 0.0 0.0",
    ),
    "a document type": ("<!DOCTYPE m [<!ENTITY a 'a'>]><mujoco model='&a;'/>", "has a document type"),
    "a URDF without its mesh": (
        URDF.replace("m.obj", "b.stl"),
        "MuJoCo cannot read it.*b.stl",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_a_file_that_is_no_model_is_refused_with_its_name(tmp_path, case):
    text, message = BAD[case]
    path = tmp_path / "robot.xml"
    if text is not None:
        path.write_text(text)
    (tmp_path / "words.stl").write_text("solid\n" + "facet normal 0 0 1\n" * 20)
    (tmp_path / "pointer.obj").write_text("version https://git-lfs.github.com/spec/v1\n")
    (tmp_path / "huge.png").write_bytes(PNG_BEGINNING + b"\0\0\0\rIHDR" + 2 * (30_000).to_bytes(4, "big"))
    with pytest.raises(DataError, match=f"(?s){message}") as refused:
        load_model(path)
    assert refused.value.where.startswith(str(path))


def test_files_may_lie_in_a_wider_folder_that_is_named(tmp_path):
    (tmp_path / "models").mkdir()
    (tmp_path / "m.obj").write_text(TETRAHEDRON)
    path = tmp_path / "models" / "robot.xml"
    path.write_text(
        '<mujoco><asset><mesh name="m" file="../m.obj"/></asset>'
        '<worldbody><geom type="mesh" mesh="m"/></worldbody></mujoco>'
    )
    with pytest.raises(DataError, match="outside the model's folder"):
        load_model(path)
    model, _ = load_model(path, folder=tmp_path)
    assert len(visible_geoms(model)[0]) == 1
