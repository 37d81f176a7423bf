"""Track files that people get wrong, and tracks that end before the places where they are judged."""

from __future__ import annotations

import numpy as np
import pytest
from lidardesign.layouts.gates import central_intervals
from support.conditioned_runs import make_conditioned_run
from support.tables import each_row

from lidardesign.errors import ConfigError
from lidardesign.run.yaml import dump_yaml, load_yaml
from lidardesign.sensors.design_file import design_from_document


def written(**changes):
    """The document of a design of one ray along x, from 0 to 1 m."""
    track = {
        "dimension": "x_m",
        "knots_m": [0.0, 1.0],
        "azimuth_rad": [[1.4], [1.6]],
        "elevation_rad": [[0.0], [0.1]],
        "gate_start_m": [[0.1], [0.2]],
        "gate_end_m": [[1.0], [1.0]],
        "sensor": [0],
    }
    sensor = {
        "origin_m": {"mean": [0.5, 0.0, 0.0]},
        "boresight": {"azimuth_rad": 1.5, "elevation_rad": 0.05},
        "field_of_view_rad": {"horizontal": 0.0, "vertical": 0.1},
        "gate_m": {"start": 0.1, "end": 1.0},
    }
    return {"schema_version": 1, "layout": "scan", "sensors": [sensor], "track": {**track, **changes}}


EMPTY = {key: [[], []] for key in ("azimuth_rad", "elevation_rad", "gate_start_m", "gate_end_m")}
MISTAKES = {
    "equal": ({"knots_m": [1.0, 1.0]}, "each above"),
    "one knot": ({"knots_m": [1.0]}, "at least two"),
    "nan": ({"knots_m": [0.0, float("nan")]}, "a number"),
    "beyond all measure": ({"knots_m": [-1.7e308, 1.7e308]}, "-1e.09 to 1e.09"),
    "no rays": ({"sensor": [], **EMPTY}, "at least one ray"),
    "a ray too many": ({"azimuth_rad": [[1.4, 1.5], [1.6, 1.7]]}, "has 2 numbers"),
}


@each_row("mistake", MISTAKES)
def test_a_mistake_in_a_track_is_refused_in_words(mistake):
    changes, words = MISTAKES[mistake]
    with pytest.raises(ConfigError, match=words):
        design_from_document(written(**changes))


def test_a_track_that_ends_too_early_is_refused_by_name_before_anything_is_scored(lidardesign, tmp_path):
    run = make_conditioned_run(tmp_path / "run", count=3000)
    (tmp_path / "short.yaml").write_text(dump_yaml(written(knots_m=[0.4, 0.6])))
    result = lidardesign("evaluate", "short.yaml", "--in", run, "--rays", 1, "--json")
    assert result.code == 2, result.err
    assert "design short" in result.err
    assert "x_m=0.4 to 0.6" in result.err


def test_exporting_where_a_track_does_not_go_writes_nothing(lidardesign, tmp_path):
    (tmp_path / "track.yaml").write_text(dump_yaml(written()))
    for at in ("x_m=1.5", "x_m=nan", "y_m=0", "x_m", "x_m=0 1"):
        result = lidardesign("export", "track.yaml", "--format", "csv", "--out", "rays.csv", "--at", at, "--json")
        assert result.code == 2, result.err
        assert "--at" in result.err
    assert lidardesign("export", "track.yaml", "--format", "csv", "--out", "rays.csv").code == 2
    assert not (tmp_path / "rays.csv").exists()
    assert load_yaml(tmp_path / "track.yaml").value == written()


def test_gates_of_samples_with_vanishing_weights_rest_on_as_many_as_with_large_ones():
    values, labels = np.arange(12.0), np.zeros(12, dtype=int)
    for scale in (1.0, 1e-200, 1e-300, 1e150):
        ends, effective = central_intervals(values, np.full(12, scale), labels, 1, 0.9)
        np.testing.assert_allclose(effective, [12.0], rtol=1e-12)
        assert np.isfinite(ends).all()
