"""The manual page behind `--help`: what a command reads and writes, examples, exit codes, where to read on.

Every example is parsed, and run where it can be, by the tests.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Manual:
    """What `--help` says below the options.

    Arguments:
        examples: Command lines that work, and what each is for.
        about: What should be known before, in sentences.
        files: What is read and written, one line each.
        exits: Exit codes beside those that every command has.
        see: Pages of the documentation.
    """

    examples: Mapping[str, str]
    about: str = ""
    files: Sequence[str] = ()
    exits: Mapping[int, str] | None = None
    see: Sequence[str] = ()


COMMON_EXITS = {0: "done", 2: "wrong usage or configuration", 3: "bad input data"}
FROM_A_RUN = {4: "constraints that no design satisfies", 5: "a numerical failure", 6: "the task's plugin failed"}


GOAL = {1: "a threshold was missed"}

MANUALS: dict[str, Manual] = {
    "learn": Manual(
        {
            "lidardesign learn face --preset draft --out runs/face": "ten seconds, for trials",
            "lidardesign learn meshes --set folder=scans --set scale=0.001 --out runs/scans": "meshes in mm",
            "lidardesign learn --config - < face.yaml": "a configuration from standard input",
            "lidardesign learn face --tolerance 0.15 --out runs/good_enough": "until it is good enough",
            "lidardesign learn face --time-budget 60 --out runs/minute": "as well as a minute allows",
            "lidardesign learn face --out runs/face --resume": "continue after Ctrl-C, to the same result",
            "lidardesign learn face --out runs/face --overwrite": "again; the old run stays until then",
            "lidardesign learn face --out runs/face --dry-run": "what would be learned, where to, and how long",
        },
        about="Learns which rays are worth firing. All other commands (fit, constrain, evaluate, export) work on the "
        "run folder that this writes, and learn nothing again.",
        files=(
            "--config FILE: any of the sections task, space, density, learning (config init TASK writes one)",
            "RUN/: config.yaml, manifest.json, flow.safetensors, samples.npz, checkpoint.safetensors, progress.jsonl",
        ),
        exits={1: "--tolerance was not reached", 5: "learning diverged", 6: "the task's plugin failed"},
        see=("run-folder.md", "accuracy.md"),
    ),
    "fit": Manual(
        {
            "lidardesign fit runs/face": "as many sensors as score best, their rays chosen",
            "lidardesign fit runs/face --sensors 4 --layout grid --name even": "four sensors with even rays",
            "lidardesign fit runs/face --layout scan --rays 576 --name beams": "one steerable beam per ray",
            "lidardesign fit runs/face --parts vl53l8cx,tmf8828 --sensors 2 --name bought": "which parts, and where",
            "lidardesign fit runs/face --like robot.sdf --name instead": "no more than an existing rig",
            "lidardesign fit runs/warehouse --rays 12 --at x_m=0.37 --name here": "for one position of a robot",
        },
        about="Reads sensors off the learned density: a mixture is fitted to its samples, and its components are "
        "sensors with a field of view and a gate. Their rays, and how many sensors there are, are chosen on training "
        "scenes.",
        files=("RUN/samples.npz: the samples of the density", "RUN/designs/NAME.yaml: the design"),
        exits=FROM_A_RUN,
        see=("design-file.md", "selection.md", "parts.md", "importance.md"),
    ),
    "constrain": Manual(
        {
            "lidardesign constrain runs/face --set gate.width_m.max=0.1 --name tight": "one bound",
            "lidardesign constrain runs/face --constraints buyable.yaml --name buyable": "bounds of a file",
            "echo 'budget: {rays: 196}' | lidardesign constrain runs/face --constraints - --name few": "bounds from "
            "standard input",
        },
        about="Answers what-if questions: the same samples, another fit. What is written satisfies every "
        "constraint: the finished file is checked again by code that the fit does not share.",
        files=(
            "--constraints FILE: YAML (schema: config schema constraints), - for standard input",
            "RUN/designs/NAME.yaml: the design",
        ),
        exits=FROM_A_RUN,
        see=("constraints.md", "catalog.md"),
    ),
    "evaluate": Manual(
        {
            "lidardesign evaluate runs/face --report report.html": "all designs of a run, and a page to look at",
            "lidardesign evaluate runs/face/designs/free.yaml --rays 100 --rays 576 --fail-above 8": "a quality gate: "
            "exit 1 where a score is worse",
            "lidardesign evaluate runs/face --csv - --quiet > rows.csv": "the rows as CSV on standard output",
            "lidardesign evaluate runs/face --detector single-photon --effects audit": "a real detector, and "
            "whether the effects that were skipped matter",
            "lidardesign evaluate runs/arm --baseline occupancy --baseline no-visibility": "two more rivals",
            "lidardesign evaluate runs/face --workers 8": "eight processes",
            "lidardesign evaluate runs/face --accuracy --plots pictures": "what accuracy costs here, and pictures",
        },
        about="Scores designs in scenes that nothing was learned from, next to what an engineer would build without "
        "learning, at equal rays and at equal bandwidth, with intervals and paired differences.",
        files=(
            "RUN or DESIGN: designs, and the task and scenes of their run",
            "--report, --plots, --csv: what is written",
        ),
        exits={**GOAL, 5: "a numerical failure", 6: "the task's plugin failed"},
        see=("evaluate.md", "rivals.md", "detectors.md", "shell.md"),
    ),
    "export": Manual(
        {
            "lidardesign export --list": "the formats, who reads them, and how that is checked",
            "lidardesign export runs/face/designs/free.yaml --format csv --rays 576 --out rays.csv": "explicit rays",
            "lidardesign export runs/face/designs/free.yaml --format csv --rays 576 --out - | head -3": "to stdout",
        },
        about="Says what the format cannot hold, and reads the file back to say how exact its numbers are.",
        files=(
            "DESIGN: a design file or one of a rig (lidardesign show --help), - for standard input",
            "--out PATH: what is written, - for standard output",
        ),
        exits={6: "the task's plugin failed"},
        see=("formats.md", "design-file.md"),
    ),
    "capture": Manual(
        {
            "lidardesign capture scan.npz runs/face/designs/free.yaml --rays 576": "a captured scan",
            "lidardesign capture scan.mat free.galvo.csv --reference head.ply --csv points.csv": "what a scanner "
            "was given, against a reference surface",
        },
        about="Scores designs on histograms measured in a lab: with their gates, without them, and next to even rays.",
        files=("CAPTURE: .npz or .mat", "--csv FILE: every ray's range and point, - for standard output"),
        see=("captures.md",),
    ),
    "show": Manual(
        {
            "lidardesign show runs/face": "its density, designs and last scores, and what can be done next",
            "lidardesign show runs/face/designs/free.yaml": "its sensors, constraints and cost",
            "lidardesign show runs/warehouse/designs/track.yaml --at x_m=3.91": "its rays at one position",
            "lidardesign show robot.sdf": "the lidars of a Gazebo model",
        },
        files=(
            "DESIGN: a design, the research code's sensor CSV, or a rig of others: rays as CSV or NPZ, a MuJoCo model "
            "with rangefinders, an SDF file with lidars",
        ),
        see=("design-file.md", "rigs.md", "formats.md"),
    ),
    "compare": Manual(
        {
            "lidardesign compare runs/face/designs/free.yaml runs/face/designs/beams.yaml": "two designs of a run",
            "lidardesign compare robot.sdf runs/face/designs/free.yaml --rays 100": "an existing rig, and a design",
            "lidardesign compare rig.csv other.csv --in runs/face": "two rigs in the scenes of a run",
        },
        about="Shows what differs, sensor by sensor, and what that is worth: both are scored in the same held-out "
        "scenes, and compared scene by scene.",
        exits=FROM_A_RUN,
        see=("rigs.md", "evaluate.md"),
    ),
    "catalog list": Manual(
        {"lidardesign catalog list --reflectance 10 --klux 100": "ranges stated for dark targets in the sun"},
        see=("catalog.md",),
    ),
    "catalog show": Manual(
        {
            "lidardesign catalog show vl53l5cx:4x4": "every figure of a part in one of its modes, with its source",
            "lidardesign catalog show vl53l8cx --out bought.yaml --rays 196 --at-origin 0.4,0,0 --azimuth-deg 180": "a "
            "design of the part, to evaluate",
        },
        files=("--out FILE.yaml: a design of the part",),
        see=("catalog.md",),
    ),
    "tasks list": Manual(
        {"lidardesign tasks list": "names, and what is wrong with broken ones"}, see=("writing-tasks.md",)
    ),
    "tasks show": Manual({"lidardesign tasks show face": "its metric, its keys with units and defaults, its space"}),
    "tasks check": Manual(
        {
            "lidardesign tasks check landmark": "a table of all laws, with what was measured",
            "lidardesign tasks check meshes --set folder=scans --json": "with settings, for scripts",
        },
        about="Every law of the contract is tried: determinism, splits that share nothing, targets in reach, "
        "scores that are numbers and best on the truth, no global random state. The task runs in a process of its own "
        "with a limit on time.",
        exits={6: "a law does not hold, or the plugin does not load"},
        see=("writing-tasks.md",),
    ),
    "tasks new": Manual(
        {
            "lidardesign tasks new landmark": "the package lidardesign-landmark, in this folder",
            "lidardesign tasks new landmark --out work/landmark": "in a folder of another name",
        },
        files=("--out DIR: a new or empty folder; nothing is overwritten",),
        see=("writing-tasks.md",),
    ),
    "config init": Manual(
        {
            "lidardesign config init meshes --set folder=scans --out scans.yaml": "a file to edit, for learn --config",
            "lidardesign config init face --preset fine": "every key and its default, to standard output",
        },
        about="Every key has its default, its bounds and what it is in a comment. Defaults are commented out, so that "
        "the file says only what was changed.",
        files=("--out FILE: a new file; an existing one is not overwritten",),
        see=("run-folder.md",),
    ),
    "config schema": Manual(
        {
            "lidardesign config schema constraints --out constraints.schema.json": "for an editor that completes keys",
            "lidardesign config schema config --task face": "with the task's own keys",
            "lidardesign config schema evaluate": "what scripts can rely on in evaluate --json",
        },
        see=("shell.md", "design-file.md"),
    ),
    "completion": Manual(
        {
            'eval "$(lidardesign completion bash)"': "in this shell; in ~/.bashrc for all",
            "lidardesign completion zsh > ~/.zfunc/_lidardesign": "where ~/.zfunc is in fpath",
            "lidardesign completion fish > ~/.config/fish/completions/lidardesign.fish": "for all new shells",
        },
        about="Completes commands, options, tasks, keys of --set with their values, formats, presets, baselines, "
        "parts, effects, run folders and their designs. The shell asks the program, so plugins' tasks are there too.",
        see=("shell.md",),
    ),
}
