"""Which measurement of a sweep is chosen, and what its verdict says."""

import mmap

import pytest

from lidardesign.scoring.sweep import Measurement, Sweep, timed


def sweep(*measurements, tolerance=0.1):
    return Sweep("knob", "the error", "mm", "the finest", tolerance, "a reason", "some work", measurements)


def measure(setting, error, seconds, **changes):
    return Measurement(setting, error, changes.pop("uncertainty", 0.0), seconds, **changes)


OWN = {"default": True}


@pytest.mark.parametrize(
    ("errors_and_seconds", "verdict"),
    [
        # the cheapest inside the tolerance; of those that cost the same, the most accurate
        ([(0.5, 1.0), (0.05, 2.0), (0.01, 4.0, OWN)], "b suffices, 2 times cheaper than c"),
        ([(0.05, 1.0), (0.01, 1.1), (0.0, 2.0)], "b suffices"),
        # what the run does stays where it is inside and nothing is cheaper by more than can be told
        ([(0.05, 1.0, OWN), (0.02, 1.1)], "a, the setting of this run, is the one to choose"),
        ([(0.15, 1.0, OWN), (0.02, 1.1)], "b is needed"),
        ([(0.08, 1.0), (0.05, 1.1), (0.01, 1.25, OWN)], "c, the setting of this run, is the one to choose"),
        ([(0.08, 1.0), (0.05, 1.1), (0.01, 1.4, OWN)], "b suffices, 1.3 times cheaper than c"),
        # an error that is not known to be inside is not
        ([(0.05, 1.0, {"uncertainty": 0.2}), (0.05, 2.0, {"uncertainty": 0.01})], "b suffices"),
        ([(0.05, 1.0, {"uncertainty": 0.2, **OWN}), (0.05, 2.0)], "b is needed"),
        # outside the tolerance the most accurate is closest
        ([(0.5, 1.0), (0.3, 2.0, OWN)], "b is closest"),
        ([(0.3, 1.0), (0.5, 2.0), (0.05, 3.0)], "c suffices; but errors do not fall here"),
    ],
)
def test_the_cheapest_measurement_that_is_surely_inside_the_tolerance_is_chosen(errors_and_seconds, verdict):
    rows = zip("abc", errors_and_seconds, strict=False)
    found = sweep(*(measure(name, *row[:2], **dict(*row[2:])) for name, row in rows))
    assert found.chosen.setting == verdict[0]
    assert verdict in found.verdict


def test_errors_fall_within_their_uncertainty():
    assert sweep(measure("a", 0.5, 1.0), measure("b", 0.3, 1.0)).falls
    assert not sweep(measure("a", 0.3, 1.0), measure("b", 0.5, 1.0)).falls
    assert sweep(measure("a", 0.3, 1.0, uncertainty=0.1), measure("b", 0.5, 1.0, uncertainty=0.1)).falls


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
