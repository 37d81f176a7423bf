"""The worst value and the tolerance of meshes follow from their size."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from lidardesign_tasks.meshes import TOLERATED_SHARE, MeshesTask
from support.meshes import write_ball

from lidardesign.errors import PluginError
from lidardesign.methods.laid_out import rays_at
from lidardesign.scoring.scene_scores import checked_score
from lidardesign.simulate.returns import simulate
from lidardesign.task import Metric, metric_of

TASK = MeshesTask()
PATH = "time_s,body,x_m,y_m,z_m,qw,qx,qy,qz\n" + "".join(f"{0.1 * i},*,0,{0.01 * i},0,1,0,0,0\n" for i in range(3))


def config_of(folder, **further):
    return TASK.Config(folder=folder, truth_points=300, poses=1, **further)


@pytest.fixture
def balls(tmp_path):
    for number, radius in enumerate((0.5, 1.0, 1.4)):
        write_ball(tmp_path / "balls" / f"{number}.stl", (radius, 0.4, 0.2), shift=(10.0 * number, 0.0, 0.0))
    return tmp_path / "balls"


@pytest.mark.parametrize("scale", [1e-3, 0.1, 1.0, 1000.0])
@pytest.mark.parametrize("centre", [True, False])
def test_the_worst_value_is_the_longest_extent_of_any_mesh_wherever_it_stands(balls, scale, centre):
    metric = metric_of(TASK, config_of(balls, scale=scale, centre=centre))
    assert metric.worst == pytest.approx(2800.0 * scale, rel=1e-5)
    assert metric.tolerance == pytest.approx(TOLERATED_SHARE * metric.worst, rel=1e-12)
    assert (metric.name, metric.unit, metric.better) == (TASK.metric.name, TASK.metric.unit, TASK.metric.better)


def test_a_head_keeps_its_tolerance_of_a_tenth_of_a_millimetre(tmp_path):
    write_ball(tmp_path / "heads" / "head.stl", (0.09, 0.08, 0.125))
    assert metric_of(TASK, config_of(tmp_path / "heads")).tolerance == pytest.approx(0.1, rel=1e-5)


@pytest.mark.parametrize("moves", [False, True])
def test_scenes_at_any_scale_are_scored_up_to_their_own_worst_value(balls, moves, tmp_path):
    (tmp_path / "path.csv").write_text(PATH)
    motion = {"motion": tmp_path / "path.csv"} if moves else {}
    config = config_of(balls, scale=1000.0, **motion)
    space, metric = TASK.space(config), metric_of(TASK, config)
    (scene, *_) = TASK.scenes(config, "test", 0)
    aimed = space.sample(400, np.random.default_rng(0))
    returns = simulate(scene, rays_at(aimed, np.array([0.0, space.high[5]])))
    seen = TASK.score(scene, returns)
    assert not seen.failed
    assert 1000.0 < seen.value < metric.worst, "a score of kilometres is more than a metre"
    blind = simulate(scene, rays_at(aimed[:5], np.array([0.0, 1e-3])))
    assert TASK.score(scene, blind).value == pytest.approx(metric.worst, rel=1e-12)
    assert checked_score(TASK, metric, scene, blind).value == metric.worst


def test_a_configuration_may_choose_among_the_metrics_of_a_task():
    usual, further = Metric("miss", "mm", "lower", 5.0, 0.1), Metric("seen", "%", "higher", 0.0, 1.0)
    task = SimpleNamespace(name="case", metric=usual, metrics=(further,), metric_of=lambda config: config)
    assert metric_of(task, further) is further
    assert metric_of(task, usual) is usual
    with pytest.raises(PluginError, match=r"allowed: miss \[mm\], lower is better or seen \[%\]"):
        metric_of(task, Metric("seen", "%", "lower", 0.0, 1.0))


def test_a_task_without_it_has_one_metric_for_every_configuration():
    task = SimpleNamespace(metric=Metric("miss", "mm", "lower", 5.0, 0.1))
    assert metric_of(task, None) is task.metric
