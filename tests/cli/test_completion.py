"""A shell is offered commands, options and values, and what fails while it asks says nothing at the prompt."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

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
    """What the program answers bash at the end of a line."""
    words = f"lidardesign {line}"
    variables = {"_LIDARDESIGN_COMPLETE": "complete_bash", "COMP_WORDS": words, "COMP_CWORD": str(words.count(" "))}
    return subprocess.run(
        [sys.executable, "-m", "lidardesign"],
        env={**os.environ, **variables},
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.parametrize(("line", "candidate"), OFFERED)
def test_a_shell_is_offered_commands_options_and_values(line, candidate):
    assert candidate in asked(line).stdout.split()


def test_what_fails_while_a_shell_asks_says_nothing():
    failed = asked("learn --set le")
    assert (failed.returncode, failed.stdout, failed.stderr) == (1, "", "")


def test_the_script_of_a_shell_is_shown():
    command = [sys.executable, "-m", "lidardesign", "--show-completion", "bash"]
    # a suite may be run by no shell at all
    named = {**os.environ, "_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION": "1"}
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=named)
    assert "_LIDARDESIGN_COMPLETE" in done.stdout


@pytest.mark.parametrize("name", completion.detectors())
def test_every_detector_that_is_offered_is_one(name):
    assert load_detector(name).name
