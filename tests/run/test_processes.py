"""Work in processes of their own: answered, or lost with the reason."""

import pytest

from lidardesign.run import processes
from lidardesign.run.processes import Child, ChildError, ask


def test_answers_come_back_apart_from_what_is_printed():
    process = Child("support.work:repeats", None)
    try:
        for number in range(3):
            process.send({"number": number})
            assert process.answer(60, "now") == {"number": number}
        assert process.alive
    finally:
        process.end()
    assert set(process.printed) == {"not an answer"}
    assert not process.alive


@pytest.mark.parametrize(
    ("work", "reason", "words"),
    [
        ("crashes", "died", "crashes while it works"),
        ("leaves", "died", "ends the program while it works (exit code 3)"),
        ("hangs", "late", "gave no answer within 0.1 s"),
        ("shouts", "foreign", "writes to a stream that is not its own"),
        ("is_not_there", "unstarted", "could not be started"),
    ],
)
def test_work_that_gives_no_answer_is_lost_with_the_reason(monkeypatch, work, reason, words):
    monkeypatch.setattr(processes, "GRACE_SECONDS", 0.1)
    with pytest.raises(ChildError) as lost:
        ask(f"support.work:{work}", None, 0.1 if work == "hangs" else 60, "while it works")
    assert (lost.value.reason, words in str(lost.value)) == (reason, True)


def test_a_large_request_and_variables_arrive():
    request = {"text": "ü" * 1_000_000}
    assert ask("support.work:returns", request, 60, "now", {"LIDARDESIGN_ANY": "1"}) == request
