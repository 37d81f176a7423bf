"""Which measurement of a sweep is chosen, and what its verdict says."""

import mmap

from lidardesign.evaluate.accuracy.settings import Measurement, Sweep, timed


def sweep(*measurements, tolerance=0.1):
    return Sweep("knob", "the error", "mm", "the finest", tolerance, "a reason", "some work", measurements)


def measure(setting, error, seconds, **changes):
    return Measurement(setting, error, changes.pop("uncertainty", 0.0), seconds, **changes)


def test_the_cheapest_measurement_inside_the_tolerance_is_chosen():
    found = sweep(measure("a", 0.5, 1.0), measure("b", 0.05, 2.0), measure("c", 0.01, 4.0, default=True))
    assert found.chosen.setting == "b"
    assert found.verdict == "b suffices, 2 times cheaper than c, the setting of this run"


def test_of_measurements_that_cost_the_same_the_most_accurate_is_chosen():
    found = sweep(measure("a", 0.05, 1.0), measure("b", 0.01, 1.1), measure("c", 0.0, 2.0))
    assert found.chosen.setting == "b"


def test_of_measurements_that_cost_the_same_and_are_good_enough_the_runs_own_is_chosen():
    found = sweep(measure("a", 0.05, 1.0, default=True), measure("b", 0.02, 1.1))
    assert found.chosen.setting == "a"
    outside = sweep(measure("a", 0.15, 1.0, default=True), measure("b", 0.02, 1.1))
    assert outside.chosen.setting == "b"


def test_what_the_run_does_stays_where_nothing_is_cheaper_by_more_than_can_be_told():
    found = sweep(measure("a", 0.08, 1.0), measure("b", 0.05, 1.1), measure("c", 0.01, 1.25, default=True))
    assert found.chosen.setting == "c"
    slower = sweep(measure("a", 0.08, 1.0), measure("b", 0.05, 1.1), measure("c", 0.01, 1.4, default=True))
    assert slower.chosen.setting == "b"


def test_an_error_that_is_not_known_to_be_inside_the_tolerance_is_not():
    found = sweep(measure("a", 0.05, 1.0, uncertainty=0.2), measure("b", 0.05, 2.0, uncertainty=0.01))
    assert found.chosen.setting == "b"
    unsure = sweep(measure("a", 0.05, 1.0, uncertainty=0.2, default=True), measure("b", 0.05, 2.0))
    assert "may be outside" in unsure.verdict


def test_outside_the_tolerance_the_most_accurate_is_closest():
    found = sweep(measure("a", 0.5, 1.0), measure("b", 0.3, 2.0, default=True))
    assert found.chosen.setting == "b"
    assert found.verdict == "no setting is within 0.1 mm; b is closest"


def test_errors_fall_within_their_uncertainty():
    assert sweep(measure("a", 0.5, 1.0), measure("b", 0.3, 1.0)).falls
    assert not sweep(measure("a", 0.3, 1.0), measure("b", 0.5, 1.0)).falls
    assert sweep(measure("a", 0.3, 1.0, uncertainty=0.1), measure("b", 0.5, 1.0, uncertainty=0.1)).falls


def test_the_verdict_says_where_errors_do_not_fall():
    assert "by chance" in sweep(measure("a", 0.3, 1.0), measure("b", 0.5, 2.0), measure("c", 0.05, 3.0)).verdict
    assert "by chance" not in sweep(measure("a", 0.5, 1.0), measure("b", 0.05, 3.0)).verdict


def test_a_row_has_the_keys_of_the_contract():
    (row,) = sweep(measure("a", 0.05, 1.0, values={"worst_mm": 1.0})).as_rows()
    assert {"knob", "setting", "error", "unit", "seconds", "chosen"} <= set(row)
    assert row["chosen"] is True
    assert row["values"] == {"worst_mm": 1.0}


def touched(size):
    """Fresh pages of the system: what the process freed before may be handed out again without growing it."""
    with mmap.mmap(-1, size) as fresh:
        for page in range(0, size, mmap.PAGESIZE):
            fresh[page] = 1
    return size


def test_a_timed_call_gives_its_value_and_the_memory_of_what_it_held():
    size = 50_000_000
    value, seconds, memory = timed(lambda: touched(size))
    assert value == size
    assert seconds > 0
    assert memory is None or memory > 0.8 * size
