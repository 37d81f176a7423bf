"""Files that hold nothing, names of parts that are none, names that are no page, and folders that are new."""

from __future__ import annotations

import pytest
from support.command_line import caller, make_run


@pytest.fixture(scope="module")
def work(tmp_path_factory):
    folder = tmp_path_factory.mktemp("work")
    make_run(folder / "run", count=1000)
    return folder


@pytest.fixture
def call(capsys, work, monkeypatch):
    call = caller(capsys, work, monkeypatch)
    if not (work / "run" / "designs").exists():
        assert call("fit", "run", "--layout", "even", "--sensors", 1).code == 0
    return call


@pytest.mark.parametrize(
    ("text", "empty"), [("", True), ("# nothing yet\n", True), ("gate: {}\n", True), ("budget: {rays: 9}\n", False)]
)
def test_a_file_without_constraints_is_told(call, work, text, empty):
    (work / "bounds.yaml").write_text(text)
    for further in ([], ["--set", "gate.width_m.max=0.5"]):
        result = call("constrain", "run", "--constraints", "bounds.yaml", *further, "--layout", "spiral")
        assert result.code == 2
        assert ("bounds.yaml holds no constraints" in result.err) == empty


def test_a_misspelt_part_is_refused_before_anything_is_fitted(call, work):
    (work / "parts.yaml").write_text("parts: {names: [vl53l5xc], count: 2}\n")
    result = call("constrain", "run", "--constraints", "parts.yaml", "--name", "parts")
    assert result.code == 2
    assert "there is no part 'vl53l5xc'" in result.err
    assert "vl53l5cx" in result.err
    assert call("fit", "run", "--parts", "vl53l5xc", "--sensors", 2).code == 2
    assert not (work / "run" / "designs" / "parts.yaml").exists()


def test_a_report_that_is_called_something_else_than_a_page_is_refused(call, work):
    for name in ("rep.pdf", "rep.HTML.png"):
        result = call("evaluate", "run", "--rays", 9, "--report", name)
        assert result.code == 2
        assert ".html, .htm" in result.err
        assert not (work / name).exists()
    assert call("evaluate", "run", "--rays", 9, "--report", "rep.HTM").code == 0


@pytest.mark.parametrize(
    "arguments",
    [
        "evaluate run --rays 9 --csv {}/deep/rows.csv",
        "export run/designs/fit.yaml --format csv --rays 9 --out {}/rays.csv",
        "config init flatland --out {}/flat.yaml",
    ],
)
def test_a_folder_that_is_made_for_a_file_is_told_once(call, work, arguments):
    name = "made" + arguments.split("{}")[1].replace("/", "").replace(" ", "") + arguments[:2]
    result = call(*arguments.format(name).split())
    assert result.code == 0, result.err
    notes = [line for line in result.err.splitlines() if "does not exist yet" in line]
    assert len(notes) == 1
    assert f"the folder {name} does not exist yet" in notes[0]
    again = call(*arguments.replace("flat.yaml", "two.yaml").format(name).split())
    assert "does not exist yet" not in again.err
