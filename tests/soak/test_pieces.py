"""Long runs that were interrupted go on behind the pieces that are done, of the same program."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import pytest
from support.pieces import Pieces, program


class InterruptedError(Exception):
    """What ends a run between two pieces."""


def run(folder, origin, until=10, **options):
    """A run of ten pieces that is interrupted before one: which were worked for, and all results."""
    pieces, worked = Pieces("run", folder, lambda: origin, **options), []

    def work(number):
        if number == until:
            raise InterruptedError
        worked.append(number)
        return {"square": number**2}

    try:
        found = [pieces.of(f"piece {number}", lambda number=number: work(number)) for number in range(10)]
    except InterruptedError:
        found = None
    return worked, found


@pytest.mark.parametrize("until", [0, 1, 9, 10])
def test_an_interrupted_run_goes_on_where_it_was(tmp_path, until):
    assert run(tmp_path, "one", until)[0] == list(range(until))
    worked, found = run(tmp_path, "one")
    assert worked == list(range(until, 10))
    assert found == [{"square": number**2} for number in range(10)]
    assert run(tmp_path, "one") == ([], found)


def test_pieces_of_another_program_are_dropped_and_that_is_said(tmp_path, capsys):
    run(tmp_path, "one", 4)
    assert run(tmp_path, "two", 6)[0] == list(range(6))
    assert "run: 4 pieces of another program, one, are dropped" in capsys.readouterr().err
    assert run(tmp_path, "three", still=lambda value: value["square"] > 9)[0] == [0, 1, 2, 3, 6, 7, 8, 9]
    assert "goes on behind 2 pieces" in capsys.readouterr().err


@pytest.mark.parametrize("lost", [1, 5, 30])
def test_a_line_that_a_kill_has_cut_is_worked_for_again(tmp_path, lost):
    run(tmp_path, "one", 5)
    path = tmp_path / "run.jsonl"
    path.write_bytes(path.read_bytes()[:-lost])
    worked, _ = run(tmp_path, "one", 7)
    assert worked in ([5, 6], [4, 5, 6])
    assert run(tmp_path, "one")[1] == [{"square": number**2} for number in range(10)]


@pytest.mark.parametrize("content", [b"", b"\xff\xfe", b'{"origin": "on', b"[]\n3\n", b"{}\n{}\n"])
def test_a_spoilt_file_is_begun_anew(tmp_path, content):
    (tmp_path / "run.jsonl").write_bytes(content)
    assert run(tmp_path, "one")[0] == list(range(10))
    assert run(tmp_path, "one")[0] == []


def test_pieces_are_kept_from_many_threads_and_their_times_add_up(tmp_path):
    pieces = Pieces("run", tmp_path, lambda: "one")
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda number: pieces.keep(str(number), number), range(200)))
    again = Pieces("run", tmp_path, lambda: "one")
    assert again.done == {str(number): number for number in range(200)}
    assert again.seconds >= again.earlier_s > 0
    again.only({"3", "5"})
    assert Pieces("run", tmp_path, lambda: "one").done == {"3": 3, "5": 5}


def test_a_run_ends_where_the_program_is_changed_meanwhile(tmp_path):
    origins = iter(["one", "one", "two"])
    pieces = Pieces("run", tmp_path, lambda: next(origins))
    pieces.keep("first", 1)
    with pytest.raises(SystemExit, match="changed meanwhile"):
        pieces.keep("second", 2)
    assert Pieces("run", tmp_path, lambda: "one").done == {"first": 1}


def test_a_program_is_named_by_its_commit_and_what_was_changed():
    assert program() == program()
