"""No file runs code: nothing is unpickled or evaluated, YAML has no tags, and files name only their own folder."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest
from lidardesign_tasks.robot.arm_robot import load_robot

from lidardesign.errors import ConfigError, DataError
from lidardesign.formats.designs import load_design
from lidardesign.scenes.mesh_files import load_mesh
from lidardesign.scenes.mujoco_models import model_files
from lidardesign.simulate.detector.files import load_detector

ROOT = Path(__file__).parents[1]
SOURCES = sorted([*(ROOT / "lidardesign").rglob("*.py"), *(ROOT / "tasks").rglob("*.py")])
# Packages that can run what a file says.
UNSAFE_PACKAGES = {
    "pickle",
    "_pickle",
    "cPickle",
    "dill",
    "cloudpickle",
    "joblib",
    "shelve",
    "marshal",
    "code",
    "runpy",
}
UNSAFE_NAMES = {"eval", "exec", "compile", "__import__", "breakpoint", "input"}
UNSAFE_CALLS = {
    "torch.load", "torch.save", "torch.jit.load", "yaml.load", "yaml.load_all", "yaml.unsafe_load", "yaml.full_load",
    "np.fromregex", "os.system", "os.popen", "pd.read_pickle", "numpy.load", "builtins.eval", "builtins.exec",
}  # fmt: skip


def dotted(node):
    """The name of what is called, as `np.load`."""
    if isinstance(node, ast.Attribute):
        return f"{dotted(node.value)}.{node.attr}"
    return node.id if isinstance(node, ast.Name) else ""


def unsafe(tree):
    """What in a module could run a file's code, with its line."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            named = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            named = [node.module or ""]
        else:
            named = []
        yield from (f"{node.lineno}: imports {name}" for name in named if name.split(".")[0] in UNSAFE_PACKAGES)
        if isinstance(node, ast.Attribute) and dotted(node) in UNSAFE_CALLS:
            yield f"{node.lineno}: uses {dotted(node)}"
        if not isinstance(node, ast.Call):
            continue
        name = dotted(node.func)
        keywords = {keyword.arg: keyword.value for keyword in node.keywords}
        if name in UNSAFE_NAMES:
            yield f"{node.lineno}: calls {name}"
        if name in ("np.load", "np.lib.format.read_array", "np.save"):
            allowed = keywords.get("allow_pickle")
            if not (isinstance(allowed, ast.Constant) and allowed.value is False):
                yield f"{node.lineno}: {name} without allow_pickle=False"
        if isinstance(keywords.get("shell"), ast.Constant) and keywords["shell"].value is True:
            yield f"{node.lineno}: a shell"


# Scenes, and what a task prepares, are read where they were written a moment before, which is in no file.
READS_NO_FILE = {
    "lidardesign/contract/scenes.py": "imports pickle",
    "lidardesign/scoring/scene_scores.py": "imports pickle",
}


@pytest.mark.hard_case("P4")
@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(ROOT)))
def test_a_module_runs_no_code_of_files(path):
    known = READS_NO_FILE.get(path.relative_to(ROOT).as_posix())
    found = [words.partition(": ")[2] for words in unsafe(ast.parse(path.read_text(encoding="utf-8")))]
    assert found == ([known] if known else [])


@pytest.mark.parametrize(
    "code",
    [
        "import pickle", "from pickle import loads", "import torch\ntorch.load(p)", "np.load(p)", "eval(text)",
        "np.load(p, allow_pickle=True)", "yaml.load(text)", "subprocess.run(x, shell=True)", "os.system(x)",
        "import joblib.numpy_pickle",
    ],
)  # fmt: skip
def test_what_could_run_code_is_found(code):
    assert len(list(unsafe(ast.parse(code)))) == 1


@pytest.mark.parametrize("mark", ["\\e[31m", "\\e]0;title\\a", "\\r", "\\b", "\\x9b2J", "\\n"])
def test_a_name_that_would_steer_the_terminal_is_refused(tmp_path, mark):
    path = tmp_path / "d.yaml"
    sensor = "origin_m: {mean: [0, 0, 0]}\n  boresight: {azimuth_rad: 0, elevation_rad: 0}\n"
    sensor += "  field_of_view_rad: {horizontal: 1, vertical: 1}\n  gate_m: {start: 1, end: 2}\n"
    for text, read in (
        (f'name: "a{mark}b"\nsensors:\n- {sensor}', load_design),
        (f'sensors:\n- name: "a{mark}b"\n  {sensor}', load_design),
        (f'mount: {{body: "a{mark}b"}}\nsensors:\n- {sensor}', load_design),
        (f'name: "a{mark}b"\npulse_fwhm_ps: 100\n', load_detector),
    ):
        path.write_text("schema_version: 2\n" + text if read is load_design else text)
        with pytest.raises(ConfigError, match="control characters") as refused:
            read(path)
        assert all(letter.isprintable() or letter == "\n" for letter in str(refused.value))


BOMB = (
    "<!DOCTYPE mujoco ["
    + '<!ENTITY a0 "boom">'
    + "".join(f'<!ENTITY a{n} "{f"&a{n - 1};" * 10}">' for n in range(1, 12))
)


@pytest.mark.hard_case("M4")
@pytest.mark.parametrize(
    "text",
    [
        BOMB + "]><mujoco model='&a11;'/>",
        '<!DOCTYPE mujoco [<!ENTITY x SYSTEM "file:///etc/passwd">]><mujoco><size>&x;</size></mujoco>',
        '<!DOCTYPE mujoco [<!ENTITY % x SYSTEM "file:///etc/passwd">%x;]><mujoco/>',
    ],
    ids=["entities that grow a billionfold", "an entity of a file", "a definition from a file"],
)
def test_entities_of_a_robot_are_neither_expanded_nor_read(tmp_path, text):
    (tmp_path / "arm.xml").write_text(text)
    with pytest.raises(DataError) as refused:
        load_robot(tmp_path / "arm.xml", 0.15)
    assert "root:" not in str(refused.value)
    assert len(str(refused.value)) < 2000


@pytest.mark.hard_case("M4")
@pytest.mark.parametrize("depth", [1, 3])
def test_a_link_that_leads_out_of_the_folder_of_a_robot_is_not_followed(tmp_path, depth):
    inside = tmp_path / "model"
    inside.mkdir()
    (tmp_path / "secret.xml").write_text("<mujoco/>")
    previous = tmp_path / "secret.xml"
    for step in range(depth):
        link = inside / f"link{step}.xml"
        link.symlink_to(previous)
        previous = link
    (inside / "arm.xml").write_text(f'<mujoco><include file="{previous.name}"/></mujoco>')
    with pytest.raises(DataError, match="outside the model's folder"):
        model_files(inside / "arm.xml")


@pytest.mark.parametrize("library", ["../outside.mtl", "/etc/passwd", "\x00", "x" * 5000])
def test_what_a_mesh_names_besides_itself_is_not_read(tmp_path, library):
    (tmp_path / "outside.mtl").write_text("newmtl a\nmap_Kd ../../etc/passwd\n")
    folder = tmp_path / "meshes"
    folder.mkdir()
    text = f"mtllib {library}\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nusemtl a\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    (folder / "m.obj").write_text(text)
    try:
        mesh = load_mesh(folder / "m.obj")
    except DataError as refused:
        mesh, text = None, str(refused)
    assert mesh is None or len(mesh.faces) == 4
    assert "root:" not in text
