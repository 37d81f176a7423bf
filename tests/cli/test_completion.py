"""What shells complete: names, keys and paths as they are, in every shell, without a slow library."""

from __future__ import annotations

import os
import pty
import select
import shlex
import shutil
import subprocess
import sys
import time
from unittest import mock

import pytest
import typer
from hypothesis import given
from hypothesis import strategies as st
from support.command_line import make_run, program
from support.tables import each_row

from lidardesign.cli import candidates
from lidardesign.cli.candidates import BASELINES, FILE, FOLDER, PATH, BashCompletion, ShellCompletion, split_line
from lidardesign.cli.commands.completion import VARIABLE
from lidardesign.cli.main import app
from lidardesign.cli.options import sensor_count
from lidardesign.design.catalog.library import load_library
from lidardesign.design.sensor import FITTED_LAYOUTS
from lidardesign.evaluate.baselines import simple
from lidardesign.export.registry import EXPORTERS
from lidardesign.simulate.detector.detector import EFFECTS

# What nobody can know beforehand; a metavar that is neither here nor completed is a mistake.
FREE = {"N", "SECONDS", "SHARE", "VALUE", "MM", "DEG", "HZ", "P", "X,Y,Z", "PERCENT", "KLUX", "MB", "S", "LENGTH,ANGLE"}
NEW_NAMES = {("tasks new", "NAME"), ("fit", "NAME"), ("constrain", "NAME")}


@pytest.fixture(scope="module")
def root():
    return typer.main.get_command(app)


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with a run that has two designs, one of them in a folder with a blank."""
    folder = tmp_path_factory.mktemp("place")
    for run in ("flat", "more runs/second"):
        make_run(folder / run, count=1000)
        (folder / run / "designs").mkdir()
        (folder / run / "designs" / "free.yaml").write_text("schema_version: 1\n")
    (folder / "mine.csv").write_text("")
    return folder


def items_at(root, line):
    """The candidates at the end of a line, as the parser has them."""
    *before, current = split_line(line, len(line))[0]
    return ShellCompletion(root, {}, "lidardesign", VARIABLE).get_completions(before, current)


def completed(root, line):
    """The candidates at the end of a line."""
    return [item.value for item in items_at(root, line)]


def every_parameter(command, path=()):
    for name, one in getattr(command, "commands", {}).items():
        yield from every_parameter(one, (*path, name))
    if not hasattr(command, "commands"):
        yield from ((" ".join(path), parameter) for parameter in command.params)


def test_every_option_and_argument_is_completed_or_known_to_be_free(root):
    for command, parameter in every_parameter(root):
        metavar = parameter.metavar
        if metavar is None or getattr(parameter, "is_flag", False):
            continue
        listed = candidates.source_of(command, parameter) is not None
        known = listed or metavar in {
            "RUN", *candidates.FILE_METAVARS, *candidates.FOLDER_METAVARS, *candidates.DESIGN_METAVARS
        }  # fmt: skip
        assert known or metavar in FREE or metavar.split("|")[0] in FREE or (command, metavar) in NEW_NAMES, (
            f"{command} {metavar}"
        )


def test_commands_and_options_are_completed_by_their_beginning(root):
    assert completed(root, "le") == ["learn"]
    assert {"list", "show", "check", "new"} <= set(completed(root, "tasks "))
    assert completed(root, "evaluate run --fail") == ["--fail-above", "--fail-unless-better"]
    assert "--dry-run" in completed(root, "fit run --")


def test_an_option_that_may_stand_once_is_not_offered_again(root):
    options = completed(root, "learn face --preset draft --set a=1 --")
    assert "--preset" not in options
    assert "--set" in options


@each_row("line", ["learn fl", "learn --seed 3 fl", "config init fl", "tasks show fl", "learn -- fl"])
def test_tasks_are_completed_where_one_is_wanted(root, line):
    assert completed(root, line) == ["flatland"]


def test_values_follow_their_option_with_a_blank_or_an_equals_sign(root):
    assert completed(root, "learn face --preset ") == ["draft", "standard", "fine"]
    assert completed(root, "learn face --preset=d") == ["--preset=draft"]


def test_layouts_and_ways_to_count_sensors_are_those_of_the_program(root):
    for command in ("fit", "constrain"):
        assert set(completed(root, f"{command} run --layout ")) == set(FITTED_LAYOUTS)
        words = completed(root, f"{command} run --sensors ")
        assert [sensor_count(word) for word in words] == words == ["best", "auto"]


def test_formats_parts_detectors_and_effects_are_those_of_the_program(root):
    assert completed(root, "export design.yaml --format ") == list(EXPORTERS)
    parts = {name for name in completed(root, "catalog show ")}
    assert parts == {part.name.partition(":")[0] for part in load_library().every_mode()}
    assert "single-photon" in completed(root, "evaluate run --detector ")
    assert set(completed(root, "evaluate run --effects ")) == {"auto", "all", "none", "audit", *EFFECTS}
    assert "jitter,motion" in completed(root, "evaluate run --effects jitter,")
    assert "jitter,jitter" not in completed(root, "evaluate run --effects jitter,")


def test_the_baselines_that_are_listed_are_those_that_there_are():
    assert list(BASELINES) == list(simple.BASELINES)


def test_keys_are_those_of_the_task_and_their_words_follow(root):
    keys = completed(root, "learn face --set ")
    assert {"model=", "density.sigma_m=", "learning.steps=", "space.range_m="} <= set(keys)
    assert "variation=" not in keys
    assert completed(root, "learn face --set light=") == ["light=indoor", "light=sun"]
    assert completed(root, "learn meshes --set centre=") == ["centre=true", "centre=false"]
    assert completed(root, "constrain run --set gate.width_m.") == ["gate.width_m.min=", "gate.width_m.max="]
    assert "parts.power_w=" in completed(root, "constrain run --set parts.p")


def test_keys_of_a_run_are_those_of_its_task(root, place, monkeypatch):
    monkeypatch.chdir(place)
    assert "variation=" in completed(root, "evaluate flat --set ")
    assert "variation=" in completed(root, "evaluate flat/designs/free.yaml --set ")
    assert completed(root, "evaluate flat --designs ") == ["free"]
    assert completed(root, "evaluate flat --fail-unless-better fr") == ["free"]
    assert "density.sigma_m=" not in completed(root, "evaluate flat --set ")
    assert completed(root, "evaluate absent --set ") == []
    assert completed(root, "fit flat --at ") == []


def test_runs_and_designs_are_completed_and_other_folders_lead_on(root, place, monkeypatch):
    monkeypatch.chdir(place)
    assert completed(root, "fit ") == ["flat", "more runs/"]
    assert completed(root, "evaluate ") == ["flat", "flat/designs/free.yaml", "mine.csv", "more runs/"]
    assert completed(root, "show flat/") == ["flat/designs/free.yaml"]
    inside = "show 'more runs/"
    assert completed(root, inside) == ["more runs/second", "more runs/second/designs/free.yaml"]
    assert completed(root, f"show {place}/mi") == [f"{place}/mine.csv"]
    assert completed(root, "fit absent/") == []


@each_row(
    ("line", "kind"),
    [
        ("learn face --config ", {FILE}),
        ("evaluate run --plots ", {FOLDER}),
        ("evaluate ", {PATH}),
        ("fit run --rays ", set()),
        ("fit run extra ", set()),
        ("learn face --unknown ", set()),
    ],
)
def test_what_the_shell_lists_itself_is_left_to_it(root, place, monkeypatch, line, kind):
    monkeypatch.chdir(place)
    assert {item.type for item in items_at(root, line)} == kind


@given(st.lists(st.text(alphabet=st.characters(exclude_categories=("Cc", "Cs"))), min_size=1, max_size=5))
def test_a_line_is_taken_apart_as_the_shell_does(words):
    line = shlex.join(words)
    assert split_line(line, len(line)) == (words, False)
    assert split_line(f"{line} ", len(line) + 1) == ([*words, ""], False)


@given(st.text(st.characters(exclude_characters="\0", exclude_categories=("Cs",))), st.integers(0, 40))
def test_no_line_is_too_odd_to_be_asked_about(root, line, point):
    environment = {"COMP_LINE": f"lidardesign {line}", "COMP_POINT": str(12 + point)}
    with mock.patch.dict(os.environ, environment):
        assert BashCompletion(root, {}, "lidardesign", VARIABLE).complete()


def asked(shell, *words, before="", **environment):
    process = program(*words, before=f"{before}\nimport sys; sys.argv[1:] = {list(words)!r}", env={
        **os.environ, VARIABLE: shell, **environment
    })  # fmt: skip
    out, err = process.communicate()
    return process.returncode, out.decode(), err.decode()


def test_no_slow_library_is_loaded_to_complete_keys():
    slow = "('torch', 'numba', 'trimesh', 'matplotlib', 'plotly', 'mujoco')"
    before = f"import atexit, sys; atexit.register(lambda: print([m for m in {slow} if m in sys.modules]))"
    code, out, _ = asked("fish", "learn", "face", "--set", "density.si", before=before)
    assert code == 0
    assert out.splitlines() == ["plain", "density.sigma_m=\tstandard deviation of the surface proximity [m]", "[]"]


def test_a_plugin_that_prints_spoils_nothing_and_one_that_hangs_is_not_waited_for():
    loads = "from lidardesign import registry\nkept = registry.load_task\n"
    printing = f"{loads}registry.load_task = lambda name: (print('I am here'), kept(name))[1]"
    assert asked("zsh", "learn", "flatland", "--set", "vari", before=printing)[1].splitlines() == [
        "plain",
        "variation=\thow much scenes differ",
    ]
    hanging = "import time\nfrom lidardesign.cli.commands import completion\ncompletion.MOST_SECONDS = 0.3\n"
    hanging += f"{loads}registry.load_task = lambda name: time.sleep(60)"
    code, out, err = asked("zsh", "learn", "flatland", "--set", "vari", before=hanging)
    assert (code != 0, out, err) == (True, "", "")


def test_a_plugin_that_fails_completes_nothing_and_says_nothing():
    broken = "from lidardesign import registry\nregistry.load_task = lambda name: 1 / 0"
    assert asked("fish", "learn", "flatland", "--set", "vari", before=broken) == (1, "", "")


@pytest.fixture(scope="module")
def shell_place(place):
    """Where a shell finds the program."""
    folder = place / "bin"
    folder.mkdir()
    script = folder / "lidardesign"
    script.write_text(f'#!/bin/sh\nexec {shlex.quote(sys.executable)} -m lidardesign "$@"\n')
    script.chmod(0o755)
    return {**os.environ, "PATH": f"{folder}{os.pathsep}{os.environ['PATH']}", "HOME": str(place)}


def run_shell(name, script, environment, folder, *options):
    path = shutil.which(name)
    if path is None:
        pytest.skip(f"{name} is not installed")
    done = subprocess.run(
        [path, *options, "-c", script], capture_output=True, text=True, check=False, cwd=folder, env=environment
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


BASH = """
eval "$(lidardesign completion bash)"
complete -p lidardesign >/dev/null || exit 1
compopt() { printf 'option %s\\n' "$2"; }
try() { COMP_LINE=$1 COMP_POINT=${#1}; shift; COMP_WORDS=("$@") COMP_CWORD=$(($# - 1)); COMPREPLY=()
    _lidardesign; printf '<%s>\\n' "${COMPREPLY[@]}"; }
try 'lidardesign learn flatland --set sce' lidardesign learn flatland --set sce
try 'lidardesign learn flatland --set scene=d' lidardesign learn flatland --set scene = d
try 'lidardesign learn flatland --set "scene=d' lidardesign learn flatland --set '"scene=d'
try '~/bin/lidardesign tasks sh' '~/bin/lidardesign' tasks sh
try 'lidardesign fit ' lidardesign fit ''
"""


def test_bash_completes_with_the_words_that_it_takes_apart(place, shell_place):
    out = run_shell("bash", BASH, shell_place, place, "--norc")
    assert out.splitlines() == [
        "option nospace",
        "<scene=>",
        "<discs>",
        # bash takes nothing apart within quotes, and would replace all that is in them
        "<scene=discs>",
        "<show>",
        "option filenames",
        "<bin/>",
        "<flat>",
        "<more runs/>",
    ]


def test_fish_completes_with_descriptions(place, shell_place):
    script = "lidardesign completion fish | source; complete -C 'lidardesign learn flatland --set scene=d'; "
    script += "complete -C 'lidardesign config sch'"
    out = run_shell("fish", script, shell_place, place, "--no-config").splitlines()
    assert out[0] == "scene=discs"
    assert out[1].startswith("schema\tPrint the JSON Schema")


ZSHRC = """
PS1=
autoload -U compinit
compinit -u -D
eval "$(lidardesign completion zsh)"
print ready
"""
TYPED = "lidardesign learn flatland --set scene=d\t"


def read_until(descriptor, wanted, seconds=60.0):
    """What a terminal shows until it has shown something."""
    shown, end = b"", time.monotonic() + seconds
    while wanted not in shown and time.monotonic() < end:
        if select.select([descriptor], [], [], 0.1)[0]:
            shown += os.read(descriptor, 4096)
    return shown


def test_zsh_completes_at_its_prompt(place, shell_place):
    path = shutil.which("zsh")
    if path is None:
        pytest.skip("zsh is not installed")
    (place / ".zshrc").write_text(ZSHRC)
    ours, theirs = pty.openpty()
    environment = {**shell_place, "ZDOTDIR": str(place), "TERM": "dumb"}
    with subprocess.Popen(
        [path, "-i"], stdin=theirs, stdout=theirs, stderr=theirs, cwd=place, env=environment, start_new_session=True
    ) as shell:
        try:
            assert b"ready" in read_until(ours, b"ready")
            os.write(ours, TYPED.encode())
            assert b"scene=discs" in read_until(ours, b"scene=discs")
        finally:
            shell.kill()
            os.close(ours)
            os.close(theirs)
