"""Every law of the task contract is kept by a good task and broken by one that breaks it."""

from __future__ import annotations

import os
import tempfile
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from support.plugins import GOOD

from lidardesign.contract import BrokenLawError, check_task, contract_of
from lidardesign.contract.contract import LAWS
from lidardesign.contract.law import geometry_fingerprint
from lidardesign.errors import ConfigError, PluginError
from lidardesign.run.content import fingerprint
from lidardesign.scenes.scene import Body, Medium, Mesh, Scene, Sphere
from lidardesign.task import load_task, mount_of

METRIC = 'Metric("radius error", "mm", "lower", worst=100.0, tolerance=0.5)'
DEFAULTS = 'Defaults(density={"sigma_m": 0.05})'
SPACE = "        return DesignSpace("
SCENES = "    def scenes(self, config, split, seed):\n"
SCORE = "    def score(self, scene, returns):\n"
VALUE = "        return Score(min(1000 * off + 50 / len(points), 100.0))\n"
CENTRE = "        centre = np.array([generator.uniform(2.0, 3.0), generator.uniform(-0.5, 0.5), 0.0])\n"
CONFIG = "    Config = TaskConfig\n"
METRIC_OF = "    def metric_of(self, config):\n        from dataclasses import replace\n        return "
# All returns tell about the one thing that there is.
INFORMS = """    def informs(self, scene, returns):
        from lidardesign.task import Information
        ray = np.flatnonzero(returns[0].returned)
        return Information(ray, 0 * ray, np.ones(len(ray)), np.zeros(1, dtype=int))

"""
# A score by what was learned, before which there may be a call of something else.
LEARNS = """    def prepare(self, scenes, returns, seed):
        self.calls = getattr(self, "calls", 0) + 1
        return {"shift": 0.0}

    def score(self, scene, returns, prepared):
        return Score(20.0 + prepared["shift"])
"""
# What a task is changed into, by the law that it then breaks: words that are replaced, and what is said of it.
BROKEN = {
    "configuration is described": [
        (CONFIG, "    class Config(TaskConfig):\n        depth: int = 3\n", "'depth' has no description"),
    ],
    "metric is defined": [
        (METRIC, METRIC.replace("0.5", "0.0"), "metric.tolerance is 0.0"),
        (METRIC, METRIC.replace("100.0", "float('inf')"), "metric.worst is inf"),
        (METRIC, METRIC.replace("lower", "smaller"), "metric.better is 'smaller'"),
        (METRIC, METRIC.replace("100.0", "10**400"), "OverflowError"),
        (SCORE, METRIC_OF + "replace(self.metric, worst=float('nan'))\n\n" + SCORE, "metric.worst is nan"),
        (SCORE, METRIC_OF + "100.0\n\n" + SCORE, "metric_of failed: it returned float"),
        (SCORE, METRIC_OF + "replace(self.metric, unit='m')\n\n" + SCORE, "it returned radius error [m]"),
    ],
    "defaults are accepted": [
        (DEFAULTS, "Defaults(rays=())", "defaults.rays is ()"),
        (DEFAULTS, "Defaults(rays=36)", "defaults.rays is 36"),
        (DEFAULTS, "Defaults(level=95)", "defaults.level is 95"),
        (DEFAULTS, "Defaults(learning={'rough': {}})", "the preset 'rough'"),
        (DEFAULTS, "Defaults(learning={'fine': {'step': 3}})", "preset fine: unknown key 'learning.step'"),
    ],
    "space is fixed": [
        (SPACE, "        self.asked = getattr(self, 'asked', 4) + 1\n" + SPACE, "a different one the second time"),
        ("4.0))", "4.0 + self.asked))", ""),
    ],
    "conditions lie in the space": [
        ("4.0))", "4.0), condition=('azimuth_rad',))\n    def conditions(self, config):\n"
         "        return [{'azimuth_rad': 9.0}]", "outside the design space"),
    ],
    "scenes are made": [
        (SCENES, SCENES + "        if split == 'test': return []\n", "the split test has no scenes"),
        (SCENES, SCENES + "        1 / 0\n", "ZeroDivisionError: division by zero"),
    ],
    "scenes repeat": [
        (CENTRE, CENTRE.replace("generator", "np.random.default_rng()"), "has a different scene 0"),
    ],
    "seeds differ": [
        ("random_generator(seed,", "random_generator(0,", "the same training scenes"),
        (SCORE, INFORMS + SCORE, ""),
    ],
    "splits are disjoint": [("split, i)", "i)", "is the held-out scene 'test 0'")],
    "scenes are picklable": [('{"at": centre}', '{"at": centre, "f": lambda: 0}', "cannot be pickled")],
    "targets are in reach": [(CENTRE, CENTRE.replace("0.0]", "90.0]"), "no ray from the design space")],
    "scores are numbers": [
        (VALUE, "        return 3.0\n", "score returned float"),
        (VALUE, "        return Score(float('inf'))\n", "score returned inf"),
        (VALUE, "        return Score(1.0, details={'seen': 'much'})\n", "the details {'seen': 'much'}"),
    ],
    "no returns are scored": [
        ("Score(self.metric.worst, failed=True)", "Score(-5.0)", "score returned -5"),
    ],
    "best on the truth": [
        (METRIC, METRIC.replace("lower", "higher").replace("100.0", "0.0"), "does not reward seeing the targets"),
        (VALUE, "        return Score(100.0)\n", "100 of 400 rays at targets, 100 of 12, 100 of none"),
    ],
    "order does not matter": [
        (VALUE, "        return Score(20 + abs(points[0, 1]))\n", "rays in another order change the score by"),
    ],
    "scores repeat": [
        (VALUE, "        self.calls = getattr(self, 'calls', 0) + 1\n        return Score(1 + 1e-9 * self.calls)\n",
         "for the same returns"),
    ],
    "scores change nothing": [
        (VALUE, "        returns[0].range_m[:] = 1.0\n" + VALUE, "score changed returns"),
        (VALUE, "        scene.bodies[0].poses[0, 3] += 1e-9\n" + VALUE, "score changed the scene 'train 0'"),
    ],
    "preparing repeats": [
        (SCORE, LEARNS.replace(": 0.0", ": self.calls"), "preparing again changes the score by"),
        (SCORE, LEARNS.replace("return Score", "prepared['shift'] += 1\n        return Score"), "preparing again"),
        (SCORE, LEARNS.replace("self.calls =", "scenes[0].bodies[0].poses[0, 3] += 1e-9\n        self.calls ="),
         "prepare changed the scene 'train 0'"),
    ],
    "returns inform": [
        (SCORE, INFORMS.replace("Information(", "print(").replace("import print", "import Information") + SCORE,
         "informs returned NoneType"),
        (SCORE, INFORMS.replace("0 * ray", "1 + ray") + SCORE, "informs gave item outside 0 to 0"),
        (SCORE, INFORMS.replace("np.ones", "-np.ones") + SCORE, "informs gave worth that is negative"),
        (SCORE, INFORMS.replace("int))", "int), sums=(0, 1, 2))") + SCORE, "sums up to 2, above complete, 1"),
        (SCORE, INFORMS.replace("returns[0].returned", "returns[0].range_m") + SCORE, "without a return have worth"),
        (SCORE, INFORMS.replace("np.flatnonzero(", "np.repeat(*np.where(").replace("turned)", "turned), 2)") + SCORE,
         "given twice"),
        (SCORE, INFORMS.replace("np.ones(len(ray))", "1.0 + ray") + SCORE, "worth of rays changes with their order"),
        (SCORE, INFORMS.replace("returns[0].returned", "[]") + SCORE, "rays at targets are worth nothing"),
    ],
    "no global random state": [
        (VALUE, "        np.random.uniform()\n" + VALUE, "numpy's random in score"),
        (VALUE, "        import random; random.random()\n" + VALUE, "Python's random in score"),
        (SCORE, LEARNS.replace("self.calls =", "self.calls = np.random.uniform() +"), "numpy's random in prepare"),
    ],
}  # fmt: skip
# Laws whose breakers replace several words at once.
TOGETHER = ("space is fixed", "seeds differ")


def task_of(source: str):
    """The task of a source, as a module would have it."""
    namespace: dict[str, object] = {"__name__": "a_task"}
    exec(source.replace("NAME", "ball"), namespace)
    return namespace["Task"]()


def replaced(changes) -> str:
    source = GOOD
    for before, after, _ in changes:
        assert before in source
        source = source.replace(before, after)
    return source


def mutants():
    """Law, source and words of every broken task."""
    for law, changes in BROKEN.items():
        groups = [changes] if law in TOGETHER else [[change] for change in changes]
        for group in groups:
            yield pytest.param(law, replaced(group), group[0][2], id=f"{law}: {group[0][2]}")


@pytest.mark.parametrize(("law", "source", "words"), list(mutants()))
def test_a_task_that_breaks_a_law_is_told_so(law, source, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    finding = contract_of(task_of(source)).finding(law)
    assert (finding.outcome, finding.law) == ("fail", law), finding
    assert words in finding.detail
    assert os.listdir(tmp_path) == []


def test_a_good_task_keeps_every_law_that_applies():
    kept = {finding.law: finding for finding in contract_of(task_of(GOOD.replace(SCORE, INFORMS + SCORE))).findings()}
    skipped = {finding.law for finding in kept.values() if finding.outcome == "skip"}
    assert skipped == {"conditions lie in the space", "scenes repeat elsewhere", "preparing repeats"}
    assert not [finding for finding in kept.values() if finding.outcome == "fail"]
    assert kept["best on the truth"].figures["dense"] < kept["best on the truth"].figures["none"]
    assert contract_of(task_of(GOOD)).finding("returns inform").outcome == "skip"


SHIPPED = {
    "arm": ("train=2", "test=2", "frames=6"),
    "face": ("train=2", "test=2", "truth_points=500"),
    "flatland": ("train=2", "test=2"),
    "warehouse": ("train=2", "test=2", "size=small"),
}


@pytest.mark.parametrize("name", SHIPPED)
def test_the_shipped_tasks_keep_the_contract(name):
    contract = contract_of(load_task(name), overrides=SHIPPED[name])
    for law in LAWS:
        # in another process they are made again by the tests of workers
        if law.name != "scenes repeat elsewhere":
            finding = contract.finding(law.name)
            assert finding.outcome != "fail", finding


def test_the_limit_of_time_is_kept():
    assert "took" in contract_of(task_of(GOOD), limit_s=1e-9).finding("within time").detail


def test_scenes_that_hang_on_the_hashes_of_a_process_are_noticed(tmp_path, monkeypatch):
    source = GOOD.replace("random_generator(seed,", "random_generator(abs(hash(split)),").replace("NAME", "hashed")
    (tmp_path / "hashed_task.py").write_text(source)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("PYTHONHASHSEED", "20251")
    import hashed_task

    contract = contract_of(hashed_task.Task())
    assert contract.finding("scenes repeat").outcome == "pass"
    assert "another process makes a different scene 0" in contract.finding("scenes repeat elsewhere").detail


def test_laws_that_need_a_broken_one_are_not_tried_and_say_so():
    contract = contract_of(task_of(GOOD.replace(SCENES, SCENES + "        1 / 0\n")))
    finding = contract.finding("order does not matter")
    assert (finding.outcome, finding.detail) == ("skip", "needs: scores are numbers")


def test_check_task_returns_findings_or_raises_with_every_broken_law():
    with pytest.raises(BrokenLawError, match=r"broken laws: 2 of \d+: metric is defined") as caught:
        check_task(task_of(GOOD.replace(METRIC, METRIC.replace("radius error", " ")).replace("split, i)", "i)")))
    assert caught.value.exit_code == 6
    with pytest.raises(PluginError, match="version 9"):
        contract_of(task_of(GOOD.replace("api_version = 1", "api_version = 9")))
    with pytest.raises(ConfigError, match="unknown key"):
        contract_of(task_of(GOOD), overrides=["depth=1"])
    with pytest.raises(ConfigError, match="unknown law"):
        contract_of(task_of(GOOD)).finding("scenes are pretty")


def test_a_fingerprint_is_of_the_content_alone():
    def scene(name="a", radius=0.2, **truth):
        return Scene((Body(Sphere(radius), name),), name, truth=truth)

    assert fingerprint(scene(x=1, y={"b", "a"})) == fingerprint(scene(y={"a", "b"}, x=1))
    assert fingerprint(scene(x=np.zeros(2))) != fingerprint(scene(x=np.zeros(3)))
    assert fingerprint(scene(x=1)) != fingerprint(scene(x=1.0))
    assert geometry_fingerprint(scene("a")) == geometry_fingerprint(scene("b"))
    assert geometry_fingerprint(scene()) != geometry_fingerprint(scene(radius=0.3))
    assert geometry_fingerprint(scene()) != geometry_fingerprint(replace(scene(), medium=Medium(0.1, 0.01)))
    assert geometry_fingerprint(scene()) == geometry_fingerprint(replace(scene(x=1), notes=("one",)))
    mesh = Mesh(np.eye(3), np.array([[0, 1, 2]]), "unsigned")
    before = fingerprint(mesh)
    assert mesh.content_hash
    assert fingerprint(mesh) == before


def test_sensors_are_on_a_body_with_a_name_or_in_the_world():
    for found in (None, "torso"):
        assert mount_of(SimpleNamespace(name="case", mount_of=lambda config, found=found: found), None) == found
    assert mount_of(SimpleNamespace(name="case"), None) is None
    for found in ("", 3):
        with pytest.raises(PluginError, match="a name or None"):
            mount_of(SimpleNamespace(name="case", mount_of=lambda config, found=found: found), None)
