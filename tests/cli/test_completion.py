"""A shell is offered commands, options and values, and what fails while it asks says nothing at the prompt."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
import typer

from lidardesign.cli.terminal import options as completion
from lidardesign.simulate.detector.files import load_detector

# The line so far, and some of what may stand at its end.
OFFERED = [
    ("le", "learn"),
    ("tasks sh", "show"),
    ("fit run --la", "--layout"),
    ("fit run --layout ", "spinning"),
    ("learn fl", "flatland"),
    ("learn flatland --set learning.st", "learning.steps="),
    ("config init face --set tr", "train="),
    ("constrain run --set gate.w", "gate.width_m.max="),
    ("export design.yaml --format c", "csv"),
    ("catalog show vl", "vl53l8cx"),
    ("evaluate run --detector ", "single-photon"),
]


def asked(line):
    """The variables with which bash asks the program at the end of a line."""
    words = f"lidardesign {line}"
    return {"_LIDARDESIGN_COMPLETE": "complete_bash", "COMP_WORDS": words, "COMP_CWORD": str(words.count(" "))}


@pytest.mark.parametrize(("line", "candidate"), OFFERED)
def test_a_shell_is_offered_commands_options_and_values(lidardesign, monkeypatch, line, candidate):
    for name, value in asked(line).items():
        monkeypatch.setenv(name, value)
    assert candidate in lidardesign().out.split()


def test_what_fails_while_a_shell_asks_says_nothing():
    command = [sys.executable, "-m", "lidardesign"]
    environment = {**os.environ, **asked("learn --set le")}
    failed = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert (failed.returncode, failed.stdout, failed.stderr) == (1, "", "")


def test_the_script_of_a_shell_is_shown(lidardesign, monkeypatch):
    # a suite may be run by no shell at all, which is asked when the command line is built
    monkeypatch.setattr(typer.main, "get_command", typer.main.get_command.__wrapped__)
    monkeypatch.setenv("_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION", "1")
    assert "_LIDARDESIGN_COMPLETE" in lidardesign("--show-completion", "bash").out


@pytest.mark.parametrize("name", completion.detectors())
def test_every_detector_that_is_offered_is_one(name):
    assert load_detector(name).name
