"""`evaluate --effects audit`: all effects against the planned ones, row by row; and what `evaluate` says of effects."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from support.planning import SINGLE
from support.scoring import MissTask, design, make_request, scenes

from lidardesign.api.run import open_run
from lidardesign.evaluation.entries import effect_notes, effect_summaries
from lidardesign.evaluation.results import Audit, AuditRow
from lidardesign.evaluation.score import evaluate
from lidardesign.report.sections import audit_section, effects_section
from lidardesign.scenes.scene import Ambient, Scene
from lidardesign.simulate import plan as plan_module
from lidardesign.simulate.detector.physics import EFFECTS, IDEAL, Detector
from lidardesign.simulate.plan import Planner, Tolerance, parse_effects

JITTERY = Detector("jittery", jitter_sigma_s=1e-9)


@pytest.fixture(autouse=True)
def without_light_transport(monkeypatch):
    """The same on every machine: late light is rendered by another program, which some do not have."""
    monkeypatch.setattr(plan_module.transport, "missing", lambda: "not here")


class RangeTask(MissTask):
    """Mean range [mm]."""

    def __init__(self, tolerance=0.001):
        self.metric = replace(MissTask.metric, worst=1e4, tolerance=tolerance)

    def score(self, scene, returns):
        score, found = super().score(scene, returns), np.concatenate([one.range_m[one.returned] for one in returns])
        return replace(score, value=1000 * float(found.mean())) if len(found) else score


def sunny(count=2, lux=1e5):
    return [Scene(scene.bodies, scene.name, ambient=Ambient(lux)) for scene in scenes(2, count)]


def sunlit(**changes):
    """Two scenes in the sun, seen by the single-photon detector, at 9 rays."""
    return evaluate(make_request(**{"test": sunny(), "train": (), "planner": Planner(SINGLE), "rays": (9,), **changes}))


def values(evaluation):
    return {(row.design, row.rays, row.matched_to): list(row.per_scene) for row in evaluation.rows}


def test_geometry_alone_is_what_it_was_with_any_choice_for_an_ideal_detector():
    plain = evaluate(make_request())
    assert [effect.name for effect in plain.effects] == list(EFFECTS)
    assert not any(effect.on for effect in plain.effects)
    for choice in ("none", "all"):
        other = evaluate(make_request(planner=Planner(IDEAL, choice)))
        for key, scores in values(plain).items():
            assert values(other)[key] == pytest.approx(scores, abs=1e-9)


def test_rows_meet_the_effects_that_their_scenes_call_for():
    calm, noisy = evaluate(make_request(test=scenes(2, 2))), sunlit()
    effects = {effect.name: effect for effect in noisy.effects}
    assert effects["ambient"].on
    assert effects["ambient"].scenes_on == 1.0
    assert values(noisy) != values(calm)
    assert noisy.detector == "single-photon"
    mixed = evaluate(make_request(test=[*sunny(1), *scenes(3, 3)], planner=Planner(replace(SINGLE, photons=quiet()))))
    assert {effect.name: effect.scenes_on for effect in mixed.effects}["ambient"] == 0.25


def quiet():
    return replace(SINGLE.photons, dark_hz=0.0)


def test_an_audit_pairs_every_row_and_passes_where_nothing_that_matters_is_skipped():
    evaluation = sunlit(audit=True)
    audit, rows = evaluation.audit, [*evaluation.rows, *evaluation.equal_bandwidth]
    assert {id(row) for row in rows} == {id(audited.planned) for audited in audit.rows}
    assert not audit.failed
    assert audit.unavailable == ["multipath"]
    for row in audit.rows:
        assert row.difference == pytest.approx(row.planned.value - row.everything.value)
        assert row.ci_low <= row.difference <= row.ci_high
        assert row.everything.seconds > 0


def test_an_audit_fails_where_something_that_matters_is_skipped():
    planner = Planner(JITTERY, parse_effects("footprint"))
    evaluation = evaluate(make_request(task=RangeTask(), planner=planner, audit=True))
    assert evaluation.audit.failed
    assert "jitter" in evaluation.audit.skipped
    assert evaluation.audit.worst > 0.001
    assert any("not simulated, as requested" in note and "jitter" in note for note in evaluation.notes)
    tolerant = evaluate(make_request(task=RangeTask(1e4), planner=planner, audit=True))
    assert not tolerant.audit.failed


def test_both_sides_of_an_audit_draw_the_same_random_numbers():
    """With everything on in both, not a bit differs."""
    planner = Planner(SINGLE, frozenset(EFFECTS) - {"multipath"})
    audit = sunlit(planner=planner, audit=True).audit
    assert audit.worst == 0
    assert audit.skipped == []


def test_what_cannot_be_simulated_is_noted_where_it_may_matter():
    decision = Planner(SINGLE).plan(sunny(1)[0], [design().rays(9)])
    found = [
        replace(effect, range_m=0.5, missing="not installed: mitsuba") if effect.name == "multipath" else effect
        for effect in effect_summaries([decision])
    ]
    notes = effect_notes(found, "auto")
    assert any("multipath" in note and "mitsuba" in note and "500 mm" in note for note in notes)
    assert not effect_notes(effect_summaries([decision]), "auto")


def test_documents_hold_effects_and_audits_as_plain_json():
    planner = Planner(SINGLE, tolerance=Tolerance(0.002, 0.05))
    document = sunlit(audit=True, planner=planner).as_dict()
    assert json.loads(json.dumps(document, allow_nan=False)) == document
    assert {(effect["unit"], effect["lost_tolerance"]) for effect in document["effects"]} == {("m", 0.05)}
    assert document["audit"]["tolerance"] == MissTask.metric.tolerance
    assert "audit" not in evaluate(make_request()).as_dict()


def test_the_report_shows_effects_and_audit_and_escapes_names():
    request = make_request(test=sunny(1), planner=Planner(replace(SINGLE, name="<b>x</b>")), audit=True, rays=(9,))
    evaluation = evaluate(request)
    page = effects_section(evaluation) + audit_section(evaluation)
    assert "The audit passed." in page
    assert "100,000 lux (sun)" in page
    assert "<b>x</b>" not in page
    assert "No effect" in effects_section(evaluate(make_request()))


def test_failed_rows_are_those_beyond_the_tolerance_on_either_side():
    sides = SimpleNamespace(seconds=1.0), SimpleNamespace(seconds=2.0)
    rows = [AuditRow(*sides, moved, -1.0, 1.0) for moved in (0.5, -0.5, 0.51, -0.6)]
    audit = Audit(0.5, "mm", rows, [], [])
    assert audit.failed == rows[2:]
    assert (audit.worst, audit.seconds) == (0.6, (4.0, 8.0))


@pytest.fixture(scope="module")
def fitted(made):
    open_run(made).fit(layout="even", sensors=2).save()
    return made


def test_the_program_audits_and_exits_with_1_only_where_scores_move(lidardesign, fitted, tmp_path):
    (tmp_path / "timed.yaml").write_text("pulse_fwhm_ps: 10\njitter_fwhm_ps: 2000\n")
    rough = ("--detector", "timed.yaml", "--effects", "audit", "--rays", 8, "--set", "test=10")
    passed = lidardesign("evaluate", fitted, *rough, "--json")
    assert passed.code == 0
    assert passed.json["audit"]["passed"]
    assert {effect["name"] for effect in passed.json["effects"] if effect["on"]} == {"jitter"}
    failed = lidardesign("evaluate", fitted, *rough, "--range-tolerance-mm", 1e4)
    assert failed.code == 1
    assert "audit failed" in failed.out
    assert "fit at 8 rays" in failed.err


def test_the_program_judges_by_other_surroundings_than_were_learned(lidardesign, fitted):
    options = ("evaluate", fitted, "--rays", 8, "--baseline", "uniform", "--detector", "single-photon")
    room = lidardesign(*options, "--json").json
    sunny = lidardesign(*options, "--set", "illuminance_lux=100000", "--set", "light=sun", "-v")
    assert sunny.code == 0
    assert "illuminance_lux=100000, light=sun" in sunny.out
    assert "100,000 lux (sun)" in sunny.out
    assert room["set"] == []
    assert "300 lux (indoor)" in next(one["reason"] for one in room["effects"] if one["name"] == "ambient")
    other = lidardesign("evaluate", fitted, "--rays", 8, "--set", "density.sigma_m=1")
    assert (other.code, "what was learned cannot be changed" in other.err) == (2, True)
