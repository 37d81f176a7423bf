"""Everything that a user can get wrong: one clear message, the right exit code, and nothing half-written."""

from __future__ import annotations

import errno
import json
import math
import re
import shlex
import shutil
import socket
import stat
import struct
import sys
import zipfile
from dataclasses import replace

import h5py
import numpy as np
import pytest
from lidardesign_tasks.flatland import FlatlandTask
from support.captures import make_capture
from support.command_line import make_run
from support.conditioned_runs import make_conditioned_run
from support.meshes import write_ball
from support.mistakes import GARBAGE, GOOD, check_one_clear_message

from lidardesign.errors import InfeasibleError
from lidardesign.limits import MOST_RAYS
from lidardesign.rays.pool import FILE_NAME as CACHE
from lidardesign.run.files import run_lock
from lidardesign.run.manifest import record
from lidardesign.samples import load_samples, save_samples
from lidardesign.scenes.scene import Ambient, Body, Medium, Receiver, Scene, Sphere
from lidardesign.space import FARTHEST_M

LONG = 300 * "x"
PAGE = 20_000 * "long"
CORNERS = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n"
OPEN = CORNERS + "f 1 2 3\nf 1 2 4\n"
CLOSED = CORNERS + "f 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
EMPTY_PLY = (
    "ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
)

# Files by their names, in folders of their own where a mesh is looked for.
FILES = {
    "good.yaml": GOOD,
    "notes.txt": "not a design at all",
    "rows.csv": "a,b,c\n1,2,3\n",
    "garbage": GARBAGE,
    # meshes
    "empty_obj/a.obj": "",
    "empty_stl/a.stl": "",
    "empty_ply/a.ply": EMPTY_PLY,
    "only_points/a.obj": CORNERS,
    "nan/a.obj": OPEN.replace("v 1 0 0", "v nan 0 0"),
    "infinite/a.obj": OPEN.replace("v 1 0 0", "v inf 0 0"),
    "overflow/a.obj": CLOSED.replace("v 1 0 0", "v 1e305 0 0"),
    **{f"far{number}/a.obj": CLOSED.replace("1", f"{far:g}", 1) for number, far in enumerate((1e154, 2 * FARTHEST_M))},
    "missing_corner/a.obj": CORNERS + "f 1 2 9\n",
    "open/a.obj": OPEN,
    "one_bad_of_two/b.stl": GARBAGE,
    "one_bad_of_two/a.obj": OPEN,
    "no_mesh/a.txt": "hello",
    **{f"garbage_{suffix}/a.{suffix}": GARBAGE for suffix in ("stl", "obj", "ply", "glb", "gltf", "off")},
    # configurations
    "typo.yaml": "density:\n  sigma_m: [0.01\n",
    "unknown.yaml": "density:\n  sigma_mm: 0.1\n",
    "type.yaml": "density: {sigma_m: wide}\n",
    "other_task.yaml": "task_name: face\n",
    "upside_down.yaml": "space: {range_m: [1.0, 0.5]}\n",
    "alias.yaml": "task:\n  targets: *hand\n",
    "garbage.yaml": "\x00\x01\x02",
    "no_task.yaml": "preset: draft\n",
    # constraints
    "gate.yaml": "gate: {width_m: {max: -1}}\n",
    "contradiction.yaml": "gate: {start_m: {min: 0.8}, end_m: {max: 0.5}}\n",
    "shape.yaml": "origin:\n  exclude: [[0, 0, 0], [1, 1, 1]]\n",
    "key.yaml": "origin:\n  exclude: [{low: [0, 0, 0], high_m: [1, 1, 1]}]\n",
    "all.yaml": "origin:\n  exclude: [{low_m: [-9, -9, -9], high_m: [9, 9, 9]}]\n",
    "fixed.yaml": "origin: {fixed_m: [0.3, 0, 0], exclude: [{low_m: [0.2, -1, -1], high_m: [0.4, 1, 1]}]}\n",
    "parts.yaml": "parts: {names: [vl53l5xc], count: 2}\n",
    "empty.yaml": "",
    "comment.yaml": "# nothing yet\n",
    "no_key.yaml": "gate: {}\n",
    "long_key.yaml": f"{PAGE}: 1\n",
    "long_value.yaml": f"gate: {PAGE}\n",
    # detectors
    "short.yaml": "bin_ps: 100\nbins: 3\n",
    "pulse.yaml": "bin_ps: 100\nbins: 3\nhistogram_start: pulse\n",
    # designs
    "design.yaml": "schema_version: 2\nsensors: 3\n",
    "earlier.yaml": "schema_version: 1\nlayout: grid\nrays: 9\nsensors: []\n",
    "many.yaml": GOOD.replace("rays: 100", "rays: many"),
    "none.yaml": GOOD.replace("rays: 100", "rays: 0"),
    "unbearable.yaml": GOOD.replace("rays: 100", f"rays: {MOST_RAYS + 1}"),
    "far.yaml": GOOD.replace("end: 0.4", "end: 1e300"),
    "wide.yaml": GOOD.replace("horizontal: 0.2", "horizontal: 1.2"),
    "rays_left.yaml": GOOD.replace("budget: {rays: 100}", ""),
    "elsewhere.yaml": GOOD.replace("[0.4, 0.0, 0.0]", "[1.4, 0.0, 0.0]"),
    # models of heads
    "text.h5": "not HDF5",
}

HEADER = (
    "sensor,origin_x_m,origin_y_m,origin_z_m,direction_x,direction_y,direction_z,azimuth_rad,elevation_rad,"
    "gate_start_m,gate_end_m,time_s"
)
RAY = {"sensor": "0", "direction_x": "1", "gate_start_m": "0.2", "gate_end_m": "0.4"}
# What a ray cannot be, and a word of the message.
RAYS = [
    ({"sensor": "-1"}, "'-1'"),
    ({"sensor": "1e18"}, "'1e18'"),
    ({"sensor": "0.5"}, "whole number"),
    ({"gate_end_m": "0.2"}, "beyond"),
    ({"gate_start_m": "0", "gate_end_m": "0"}, "beyond"),
    ({"gate_end_m": "1e18"}, "1e+18 m"),
    ({"azimuth_rad": "3.1_4"}, "finite"),
    ({"azimuth_rad": "３.14"}, "finite"),
    ({"azimuth_rad": ""}, "finite"),
    ({"gate_end_m": "inf"}, "finite"),
    ({"time_s": "nan"}, "finite"),
    ({"direction_x": "nan"}, "finite"),
    ({"origin_x_m": "1e300"}, "1e+300"),
]

POINTS = np.full((9, 6), 0.5)
# Samples that are none although their hash is right: arrays, or what becomes of the file, and a word of the message.
SAMPLES = [
    (lambda content: b"words", ".npz file"),
    (lambda content: content[:-30], ".npz file"),
    (lambda content: content.replace(struct.pack("<d", 0.5), struct.pack("<d", 2.0), 1), "CRC"),
    ({"log_target": None}, "has no log_target"),
    ({"log_prob": np.array(["a"] * 9)}, "<U1"),
    ({"log_prob": np.zeros(9, np.int64)}, "int64"),
    ({"points": np.ones((9, 5))}, "(9, 5)"),
    ({"log_prob": np.zeros(8)}, "(8,)"),
    ({"points": np.ones((0, 6)), "log_prob": np.zeros(0), "log_target": np.zeros(0)}, "(0, 6)"),
    ({"points": np.array(1.0)}, "shape ()"),
    ({"log_target": np.full(9, np.inf)}, "finite"),
    ({"points": POINTS + np.array([0, 0, 0, np.inf, 0, 0])}, "finite"),
    ({"space": np.frombuffer(b"[1, 2]", np.uint8)}, "TypeError"),
    ({"space": np.frombuffer(b"{", np.uint8)}, "JSONDecodeError"),
]
# Shapes that only a header promises: numpy would ask for 8 TB before it finds that there is nothing.
PROMISED = ["(1000000000000,)", "(4294967296, 4294967296)"]

# Files that cannot be written, and those that are needed, with a word of the message.
UNWRITABLE = [
    ("folder", "folder"),
    (".", "folder"),
    ("file/new.csv", "file is a file"),
    ("folder/../file/a/b.csv", "file is a file"),
    (f"{LONG}.csv", "name too long"),
    (f"new/{LONG}/a.csv", "name too long"),
    ("/proc/new.csv", "cannot be written"),
    ("socket", "cannot be written"),
]
TAKEN = [
    *((f"fitted/{name}", "of the run") for name in ("config.yaml", "manifest.json", "samples.npz", CACHE)),
    ("fitted/designs/fit.yaml", "of the run"),
    ("folder/../fitted/config.yaml", "of the run"),
    ("link.csv", "of the run"),
    ("good.yaml", ""),
    ("twin.csv", ""),
]
WRONG_LIGHT = "illuminance_lux=1e9 light=moon visibility_m=0 visibility_m=1e-300 reflectance=1.1 gloss=.nan"
ODD_NUMBERS = ("1_0", "nan", "1e400", "１０")
SCORE = "evaluate fitted --rays 9"

# Command line, exit code, where the message says that it is, and a word of it.
CASES = [
    # commands
    ("fly", 2, "", "fly"),
    ("lern face", 2, "", "'learn'"),
    ("tasks shwo face", 2, "", "'show'"),
    ("tasks remove", 2, "", "remove"),
    ("fit run --sensor 3", 2, "", "--sensors"),
    ("learn", 2, "TASK", "flatland"),
    ("learn --config no_task.yaml", 2, "TASK", "flatland"),
    ("learn --resume --out absent", 3, "absent", "no run to resume"),
    ("fit run --modules 0 --fov 45x45 --zones 4x4", 2, "", "--modules"),
    ("fit run --modules 1 --fov 0x0 --zones 4x4", 2, "--fov and --zones", "45x45"),
    ("learn nothing", 2, "TASK", "unknown task 'nothing'"),
    ("learn flatlan", 2, "TASK", "did you mean 'flatland'"),
    ("learn flatland --unknown", 2, "", "unknown"),
    ("config init nothing", 2, "TASK", "unknown task"),
    ("config init flatland --set colour=red", 2, "--set colour=red", "colour"),
    ("config init flatland --out file", 2, "--out file", "exists"),
    ("config schema config --out file", 2, "--out file", "exists"),
    ("config schema recipe", 2, "KIND", "config, constraints, design, evaluate"),
    ("show -", 2, "RUN", "'-' is not a value"),
    ("learn --config -", 2, "--config", "'-' is not a value"),
    (f"{SCORE} --csv -", 2, "--csv", "'-' is not a value"),
    # meshes
    ("learn meshes", 2, "", "--set folder=PATH"),
    ("learn meshes --set folder=absent", 3, "absent", ""),
    ("learn meshes --set folder=folder", 3, "folder", ""),
    ("learn meshes --set folder=no_mesh", 3, "no_mesh", ""),
    ("learn meshes --set folder=open --set sign=solid", 3, "a.obj", ""),
    ("learn meshes --set folder=open --set sign=inside", 2, "--set sign=inside", ""),
    ("learn meshes --set folder=one_bad_of_two", 3, "b.stl", ""),
    ("learn meshes --set folder=open --set occluders=garbage_stl", 3, "a.stl", ""),
    ("learn meshes --set folder=overflow --set scale=1e9", 3, "a.obj", "infinite"),
    *((f"learn meshes --set folder=far{number}", 3, "a.obj", "reaches") for number in (0, 1)),
    *(
        (f"learn meshes --set folder={name.partition('/')[0]}", 3, name.partition("/")[2], "")
        for name in FILES
        if re.match("empty_|only_points|nan|infinite|missing_corner|garbage_", name)
    ),
    # configurations: file, line and column
    ("learn flatland --config absent.yaml", 2, "absent.yaml", "No such file"),
    ("learn flatland --config typo.yaml", 2, "typo.yaml:3:1", ""),
    ("learn flatland --config unknown.yaml", 2, "unknown.yaml:2:3", "density.sigma_mm"),
    ("learn flatland --config type.yaml", 2, "type.yaml:1:20", ""),
    ("learn flatland --config other_task.yaml", 2, "other_task.yaml:1:", ""),
    ("learn flatland --config upside_down.yaml", 2, "upside_down.yaml:1:", ""),
    ("learn flatland --config open", 2, "open", "folder"),
    ("learn flatland --set sigma", 2, "--set sigma", "KEY=VALUE"),
    ("learn flatland --set density.sigma_m=-1", 2, "--set density.sigma_m=-1", ""),
    ("learn flatland --set learning.step=3", 2, "--set learning.step=3", "did you mean 'steps'"),
    ("learn flatland --set train=0", 2, "--set train=0", ""),
    ("learn flatland --set space.range_m=[2,1]", 2, "--set space.range_m=[2,1]", ""),
    ("learn flatland --preset quick", 2, "--preset", "draft, standard, fine"),
    ("learn flatland --device cuda:9", 2, "--device", "auto, cpu, cuda"),
    ("learn flatland --seed -1", 2, "--seed", ""),
    ("learn mujoco --set model=robot.xml --set targets=[*hand]", 2, "", 'such as "*hand"'),
    ("learn mujoco --config alias.yaml", 2, "alias.yaml:2:", 'such as "*hand"'),
    ("learn arm --set frames=1000 --set train=10000", 2, "", "200000 frames in all"),
    ("learn mujoco --set frames=1000 --set test=10000", 2, "", "test: 10000 scenes of 1000 frames"),
    *((f"learn flatland --set {pair}", 2, f"--set {pair}", "") for pair in WRONG_LIGHT.split()),
    ("learn face --set speed_m_s=1e9", 2, "--set speed_m_s=1e9", ""),
    ("learn emitter --set field_of_view_deg=[60,180]", 2, "field_of_view_deg", "less than 180"),
    ("learn emitter --set emitter_box_m=-0.1", 2, "emitter_box_m", "0 m or more"),
    ("learn emitter --set detector_m=[1,2]", 2, "detector_m", "3 values"),
    ("learn emitter --set detector_m=[nan,0,0]", 2, "detector_m", "finite"),
    *(
        (f"learn emitter --set detector_m={place} --set train=2", 2, "task.detector_m", "inside the train head 0")
        for place in ("[-0.05,0,0]", "[-0.1,0.02,0.01]")
    ),
    # morphable models
    *((f"learn face --set model={name}.h5", 3, f"{name}.h5", "") for name in ("absent", "text", "other", "truncated")),
    ("learn face --set model=open", 3, "open", ""),
    # runs
    ("fit open", 3, "open", "not a run folder"),
    ("fit unfinished", 3, "unfinished", "--resume"),
    ("fit truncated", 3, "truncated", ""),
    ("fit flipped", 3, "flipped", "SHA-256"),
    ("fit edited", 3, "config.yaml", ""),
    ("fit no_manifest", 3, "no_manifest", "manifest.json"),
    ("fit bad_manifest", 3, "manifest.json", ""),
    ("fit newer", 3, "manifest.json", "schema version"),
    ("fit equal --layout even --sensors 2", 3, "", "its 1000 samples count as only 1"),
    ("fit elsewhere --layout even --sensors 2", 3, "elsewhere", "range_m"),
    ("fit millimetres --layout even --sensors 2", 3, "millimetres", "1000 of 1000 points"),
    *((f"fit samples{number}", 3, "samples.npz", word) for number, (_, word) in enumerate(SAMPLES)),
    ("evaluate unfinished", 3, "unfinished", "no designs yet"),
    ("evaluate run", 3, "run", "no designs yet"),
    ("evaluate absent", 3, "absent", ""),
    ("learn flatland --out run", 2, "--out run", "not empty"),
    ("learn flatland --out run --dry-run", 2, "--out run", "not empty"),
    ("learn flatland --out open", 2, "--out open", "not empty"),
    ("learn flatland --out open --overwrite", 2, "--out open", "holds no run"),
    ("learn flatland --out notes.txt", 2, "--out notes.txt", "is a file"),
    ("learn flatland --out notes.txt/run", 3, "notes.txt/run", "cannot be made"),
    ("learn flatland --resume --out absent", 3, "absent", "no run to resume"),
    ("learn flatland --resume --out open", 3, "open", "not a run folder"),
    ("learn flatland --resume --out locked", 2, "locked", "is writing this run"),
    ("learn flatland --overwrite --out locked", 2, "locked", "is writing this run"),
    ("learn face --resume --out run", 2, "run", "task"),
    # options
    ("fit run --rays 0", 2, "", "--rays"),
    ("fit run --rays 6000", 2, "--rays", "1 to 5000"),
    *((f"fit run --sensors {text}", 2, "--sensors", "from 1 to 1000, best") for text in ("0", "2.5", "9" * 5000)),
    ("fit run --seed 9223372036854775808", 2, "", "seed"),
    ("fit run --layout spinning --channels 4000000000", 2, "--channels", ""),
    ("fit run --layout spinning --channels 16 --rays 8", 2, "", "16 channels"),
    ("fit run --layout spiral", 2, "--layout", "chosen, even, spinning"),
    ("fit run --level 1", 2, "--level", "0.01 to 0.999999"),
    ("fit run --weight train=", 2, "", "train has no value"),
    ("fit run --weight train=many", 2, "--weight train=many", ""),
    ("fit run --gates one", 2, "--gates", "sensor, ray"),
    ("fit run --name ../elsewhere", 2, "--name", "not a name"),
    ("fit run --sensors 5 --rays 3", 4, "", "3 rays for 5 sensors"),
    ("fit run --parts , --sensors 1", 2, "--parts", "empty part name"),
    ("fit run --parts vl53l5xc --sensors 2", 2, "", "vl53l5cx"),
    ("fit run --modules 2 --fov 45x45", 2, "--modules", "--zones"),
    ("constrain run --modules 2 --fov wide --zones 8x8", 2, "", "--fov 45x45"),
    ("evaluate run --rays 0", 2, "", "--rays"),
    ("evaluate run --fail-above inf", 2, "--fail-above", "finite"),
    (f"{SCORE} --set test=2 --fail-unless-better other", 2, "", "'other'"),
    (f"{SCORE} --set test=2 --fail-unless-better fit", 2, "", "no other design"),
    ("evaluate good.yaml --in run --baseline best", 2, "--baseline", "uniform"),
    ("evaluate good.yaml --in run --rays 9 --baseline no-visibility", 2, "", "no design to refit"),
    ("evaluate good.yaml", 2, "", "--in RUN"),
    ("evaluate fitted second --designs absent", 2, "--designs", "'absent'"),
    ("evaluate fitted second fitted", 2, "", "fitted is named twice"),
    ("evaluate fitted second --effects audit", 2, "--effects audit", "one run"),
    ("evaluate fitted second --accuracy", 2, "--accuracy", "one run"),
    ("evaluate fitted --designs absent", 2, "--designs", "fit"),
    *((f"{SCORE} --report {name}", 2, "", ".html, .htm") for name in ("page.pdf", "page.HTML.png")),
    (f"{SCORE} --detector absent.yaml", 2, "--detector", "'absent.yaml'"),
    (f"{SCORE} --detector ../ideal", 2, "--detector", "did you mean 'ideal'"),
    (f"{SCORE} --detector Ideal", 2, "--detector", "did you mean 'ideal'"),
    (f"{SCORE} --detector {LONG}", 2, "--detector", "no detector"),
    (f"{SCORE} --detector garbage", 2, "garbage", "UTF-8"),
    (f"{SCORE} --detector run", 2, "run", "folder"),
    (f"{SCORE} --detector empty.yaml", 2, "empty.yaml", "does not describe a detector"),
    (f"{SCORE} --detector short.yaml", 2, "", "longer than the histogram"),
    (f"{SCORE} --detector pulse.yaml", 2, "", "outside the histogram"),
    (f"{SCORE} --effects ambint", 2, "--effects", "did you mean 'ambient'"),
    (f"{SCORE} --effects dew", 2, "--effects", "'dew'"),
    (f"{SCORE} --effects ALL", 2, "--effects", "did you mean 'all'"),
    (f"{SCORE} --effects audit,all", 2, "--effects", "audit alone"),
    (f"{SCORE} --effects jitter,none", 2, "--effects", "audit alone"),
    (f"{SCORE} --effects jitter,", 2, "--effects", "unknown effect ''"),
    *((f"{SCORE} --range-tolerance-mm {value}", 2, "--range-tolerance-mm", "") for value in ("0", "-1", "nan", "inf")),
    *((f"{SCORE} --return-tolerance {value}", 2, "--return-tolerance", "") for value in ("0", "-1", "nan", "inf")),
    # numbers that no computer bears
    ("fit run --rays 1000000000000", 2, "", "1000"),
    ("constrain run --set sensors.max=1000000000", 2, "", "1000"),
    ("constrain run --set sensors.min=1001", 2, "", "1000"),
    ("constrain run --set budget.rays=1000000000000000000000000", 2, "budget.rays", "1000"),
    ("evaluate run --rays 1000000000000", 2, "", "1000"),
    ("learn flatland --set learning.batch=1000000000000", 2, "", "1000"),
    ("learn flatland --set learning.samples=1000000000000", 2, "", "1000"),
    ("learn flatland --set learning.coverage_proposals=1000000000000", 2, "", "1000"),
    ("learn flatland --set learning.hidden=10000000", 2, "", "1000"),
    ("show unbearable.yaml", 2, "unbearable.yaml:2:", str(MOST_RAYS)),
    *(
        (f"constrain run --set budget.{key}={value} --set budget.rays=10 --set budget.bandwidth_mbps=5", 2, key, "")
        for key in ("bin_ps", "bits_per_bin", "rate_hz")
        for value in ("5e-324", "1e-300", "1e300")
    ),
    # numbers that are more than one, or one among words
    *((f"fit run --sensors={text}", 2, "--sensors", "") for text in ODD_NUMBERS),
    *((f"fit run --at=x_m={text}", 2, "--at", "finite") for text in ODD_NUMBERS),
    *((f"evaluate run --workers={text}", 2, "--workers", "") for text in ODD_NUMBERS),
    *((f"evaluate run --mount-error={text}mm", 2, "--mount-error", "") for text in ODD_NUMBERS),
    *((f"catalog show vl53l8cx --out a.yaml --at-origin 0,0,{text}", 2, "--at-origin", "") for text in ODD_NUMBERS),
    # constraints
    ("constrain run --constraints absent.yaml", 2, "absent.yaml", ""),
    ("constrain run --constraints gate.yaml", 2, "gate.yaml:1:23", ""),
    ("constrain run --constraints contradiction.yaml", 4, "", "gate."),
    ("constrain run --constraints parts.yaml", 2, "", "vl53l5cx"),
    *(
        (f"constrain run --constraints {name}.yaml{further} --name ../x", 2, "--name", f"{name}.yaml holds no")
        for name in ("empty", "comment", "no_key")
        for further in ("", " --set gate.width_m.max=0.5")
    ),
    ("constrain run --constraints long_key.yaml", 2, "long_key.yaml:1:", ""),
    ("constrain run --constraints long_value.yaml", 2, "long_value.yaml:1:", ""),
    (f"constrain run --set gate={PAGE}", 2, "--set gate=long", ""),
    ("constrain run --constraints shape.yaml", 2, "shape.yaml:2:", "keys and values"),
    ("constrain run --constraints key.yaml", 2, "key.yaml:2:", "did you mean 'low_m'"),
    ("constrain run --constraints all.yaml", 4, "", "origin.exclude[0]"),
    ("constrain run --constraints fixed.yaml", 4, "", "origin.fixed_m"),
    ("constrain run --set mounts_m=[[0,0,1]]", 2, "", "did you mean 'origin.mounts_m'"),
    ("constrain run --set sensors.count=3 --sensors 2", 4, "", "sensors.count"),
    ("constrain run --sensors 5 --set budget.rays=3", 4, "", "budget.rays"),
    ("constrain run --set gate.start_m.min=7", 4, "", "gate.start_m.min"),
    ("constrain run --set origin.low_m=[5,0,0] --set origin.high_m=[6,0,0]", 4, "", "origin"),
    ("constrain run --set budget.bandwidth_mbps=1e-9", 4, "", "bandwidth_mbps"),
    ("constrain run --set gate.end_m.max=0.02", 4, "", "density"),
    ("constrain good.yaml", 3, "good.yaml", "run of this design"),
    # conditions
    ("fit along --at x_m", 2, "--at", "NAME=VALUE"),
    ("fit along --at x_m=here", 2, "--at", "NAME=VALUE"),
    ("fit along --at x_m=0.1 --at x_m=0.2", 2, "--at", "twice"),
    ("fit along --at x_m=1.01", 2, "", "0 to 1"),
    ("fit along --at y_m=0", 2, "", "x_m"),
    ("fit along --layout spinning", 2, "", "density has conditions"),
    ("fit along --parts vl53l8cx --sensors 1", 2, "", "density has conditions"),
    ("constrain along --at x_m=-0.1", 2, "", "0 to 1"),
    ("constrain along --set origin.fixed_m=[0.5,0,0]", 4, "", "--at x_m=VALUE"),
    ("constrain along --layout even --set origin.low_m=[0.5,0,0]", 4, "", "--at x_m=VALUE"),
    ("fit run --at x_m=0.5", 2, "", "no conditions"),
    ("fit along_two --sensors 1 --rays 4", 2, "--at", "--at x_m=VALUE --at azimuth_rad=VALUE"),
    ("fit along_two --at x_m=0.5", 2, "--at", "--at azimuth_rad=VALUE"),
    ("fit turning", 2, "--at", "--at azimuth_rad=VALUE"),
    # designs
    ("show absent.yaml", 3, "absent.yaml", ""),
    ("show notes.txt", 2, "notes.txt", ""),
    ("show garbage.yaml", 2, "garbage.yaml", ""),
    ("show rows.csv", 3, "rows.csv:1", ""),
    *((f"show rays{number}.csv", 3, f"rays{number}.csv", word) for number, (_, word) in enumerate(RAYS)),
    ("show letters.npz", 3, "letters.npz", "'sensor_names' holds letters"),
    *((f"show promised{number}.npz", 3, f"promised{number}.npz", "80 bytes") for number in range(len(PROMISED))),
    ("evaluate design.yaml", 2, "design.yaml:2:10", ""),
    ("export design.yaml --format csv", 2, "design.yaml", ""),
    ("show earlier.yaml", 2, "earlier.yaml:1:17", "earlier version"),
    ("evaluate good.yaml far.yaml --in run --rays 8", 2, "far.yaml", "1e+300"),
    ("export", 2, "DESIGN", "no design"),
    ("export good.yaml", 2, "--format", "no format"),
    ("export good.yaml --format jpeg", 2, "--format", "csv"),
    ("export beams.yaml --format csv --rays 20", 2, "beams", "allowed: 12"),
    ("export good.yaml --format csv --out open", 3, "open", "folder"),
    ("export many.yaml --format csv", 2, "many.yaml:2:30", "budget.rays"),
    ("export wide.yaml --format galvo", 2, "", "mirrors' reach"),
    ("export far.yaml --format galvo", 2, "far.yaml", "less than or equal to"),
    ("export rays_left.yaml --format galvo", 2, "", "--rays N"),
    # captures
    ("capture garbage.npz good.yaml", 3, "garbage.npz", "cut short"),
    ("capture far.npz good.yaml", 3, "far.npz", "origin_m"),
    ("capture lengths.npz good.yaml", 3, "lengths.npz", "length inf"),
    ("capture promised0.npz good.yaml", 3, "promised0.npz", "80 bytes"),
    ("simulate good.yaml --scene scan.las --out there", 3, "scan.las", "Poisson"),
    ("simulate good.yaml --scene part.step --scale 0.001 --out there", 3, "part.step", "FreeCAD"),
    ("capture scan.npz none.yaml", 2, "none.yaml:2:30", "budget.rays"),
    ("capture scan.npz header.galvo.csv", 3, "header.galvo.csv", "no ray"),
    ("capture scan.npz good.yaml elsewhere.yaml", 3, "elsewhere", "none of the 100 rays"),
    ("capture scan.npz long.galvo.csv", 3, "long.galvo.csv:2", ""),
    # outputs that are in each other's way
    (f"{SCORE} --csv a --report folder/../a", 2, "--csv and --report", "same file"),
    (f"{SCORE} --csv a --report a/b.html", 2, "", "folder of --report"),
    (f"{SCORE} --detector file --csv file", 2, "", "file"),
]


def lost():
    raise RuntimeError("the map is lost")


# What `conditions` of a task gives, exit code, and a word of the message.
CONDITIONS = [
    (lost, 6, "the map is lost"),
    (lambda: None, 6, "task flatland"),
    (lambda: 5, 6, "task flatland"),
    (lambda: [1.0], 6, "task flatland"),
    (lambda: [{"x_m": "far"}], 6, "far"),
    (list, 6, "no condition value"),
    (lambda: [{}], 6, "x_m open"),
    (lambda: [{"x_m": 99.0}], 2, "x_m=99 is outside"),
    (lambda: [{"x_m": math.nan}], 2, "x_m=nan is outside"),
    (lambda: [{"x_m": 0.5, "z_m": 0.0}], 2, "'z_m' is not a condition"),
]
# What becomes of each scene of a task, exit code, and a word of the message.
SCENES = [
    (lambda scene: {"bodies": []}, 6, "returned a dict"),
    (lambda scene: Body(Sphere(1.0), reflectance=-0.1), 3, "-0.1"),
    (lambda scene: Body(Sphere(1.0), reflectance=0.9, specular=0.2), 3, "1 in all"),
    (lambda scene: Body(Sphere(1.0), velocity_m_s=(3e8, 0, 0)), 3, "slower than light"),
    (lambda scene: Medium(1e300, 0.0), 3, "1e+300"),
    (lambda scene: Scene(scene.bodies, ambient="sun"), 3, "'sun'"),
    (lambda scene: Scene(scene.bodies, medium=0.1), 3, "medium is 0.1"),
    (lambda scene: Scene(scene.bodies, receiver="here"), 3, "'here'"),
    (lambda scene: Receiver((0.0, 0.0), 0, 0, 1, 1, (0, 1)), 3, "three finite coordinates"),
    (lambda scene: Receiver((0.0, 0.0, 0.0), 0, 0, 0, 1, (0, 1)), 3, "horizontal_rad is 0"),
    (lambda scene: Scene(scene.bodies, frame_rate_hz=math.nan), 3, "frame_rate_hz is nan"),
    (lambda scene: Ambient(-1.0), 3, "-1.0 lux"),
]


def conditions_are(answer):
    return lambda monkeypatch: monkeypatch.setattr(
        FlatlandTask, "conditions", lambda self, config: answer(), raising=False
    )


def scenes_become(change):
    scenes = FlatlandTask.scenes
    return lambda monkeypatch: monkeypatch.setattr(
        FlatlandTask, "scenes", lambda *given: [change(scene) for scene in scenes(*given)]
    )


def nothing_is_worked_for(monkeypatch):
    def refuse(*_, **__):
        raise AssertionError("the work has begun")

    for work in ("scores.ScoreRequest.score", "export.ExportRequest.write", "design.Design.fitted"):
        monkeypatch.setattr(f"lidardesign.api.{work}", refuse)
    monkeypatch.setattr("lidardesign.evaluation.captures.capture.load_capture", refuse)


def the_disk_is_full(monkeypatch):
    def refuse(source, target):
        raise OSError(errno.ENOSPC, "No space left on device", str(target))

    monkeypatch.setattr("lidardesign.run.files.os.replace", refuse)


def nobody_waits(monkeypatch):
    monkeypatch.setattr("lidardesign.api.design.WAIT_S", 0.1)


def the_design_breaks_a_constraint(monkeypatch):
    def refuse(design, request):
        raise InfeasibleError("a wide gate", conflicts=["gate.width_m.max"])

    monkeypatch.setattr("lidardesign.fitting.fit.check_written", refuse)


# What a row needs besides the files, and the row.
NEEDING = [
    *((conditions_are(answer), ("evaluate along --rays 3", code, word)) for answer, code, word in CONDITIONS),
    *((scenes_become(change), (SCORE, code, word)) for change, code, word in SCENES),
    *(
        (nothing_is_worked_for, (f"{command} {path}", code, word))
        for command in (f"{SCORE} good.yaml --csv", "export good.yaml --format csv --out", "capture c good.yaml --csv")
        for paths, code in ((UNWRITABLE, 3), (TAKEN, 2))
        for path, word in paths
    ),
    *(
        (None, (f"config {words} --out {path}", 3, word))
        for path, word in UNWRITABLE
        for words in ("init flatland", "schema config")
    ),
    (nothing_is_worked_for, ("fit blocked --layout even --name taken", 3, "folder")),
    (the_disk_is_full, ("fit run --layout even --sensors 1", 3, "No space left")),
    (the_disk_is_full, ("constrain run --layout even --set budget.rays=20", 3, "No space left")),
    (the_disk_is_full, ("export good.yaml --format npz --out rays.npz", 3, "No space left")),
    (the_disk_is_full, ("learn flatland --preset draft --out new/run", 3, "No space left")),
    (nobody_waits, ("fit locked --layout even --sensors 1", 2, "is writing this run")),
    (the_design_breaks_a_constraint, ("constrain run --layout even --set gate.width_m.max=0.3", 4, "a wide gate")),
]


def changed_run(folder, name, change):
    """A run with one of its files changed behind its back."""
    path = shutil.copytree(folder.with_name("run"), folder) / name
    path.write_bytes(change(path.read_bytes()))


def flipped(content):
    middle = len(content) // 2
    return content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :]


def changed_samples(folder, change):
    """A run whose samples were replaced, with their hash."""
    samples = load_samples(shutil.copytree(folder.with_name("run"), folder))
    save_samples(replace(samples, **change(samples)), folder)


def bad_samples(folder, change):
    """A run of few samples, changed, with their hash."""
    run = shutil.copytree(folder.with_name("run"), folder)
    with np.load(run / "samples.npz") as kept:
        space = kept["space"]
    arrays = {"points": POINTS, "log_prob": np.zeros(9), "log_target": np.zeros(9), "space": space}
    arrays |= change if isinstance(change, dict) else {}
    np.savez(run / "samples.npz", **{name: array for name, array in arrays.items() if array is not None})
    if not isinstance(change, dict):
        (run / "samples.npz").write_bytes(change((run / "samples.npz").read_bytes()))
    record(run, ["samples.npz"])


def make_runs(folder):
    make_run(folder / "run", count=1000)
    changed_samples(folder / "equal", lambda samples: {"points": np.tile(samples.points[:1], (1000, 1))})
    changed_samples(folder / "millimetres", lambda samples: {"points": 1000 * samples.points})
    changed_samples(
        folder / "elsewhere",
        lambda samples: {"space": replace(samples.space, high=(*samples.space.high[:5], 7.0))},
    )
    for number, (change, _) in enumerate(SAMPLES):
        bad_samples(folder / f"samples{number}", change)
    changed_run(folder / "truncated", "samples.npz", lambda content: content[: len(content) // 2])
    changed_run(folder / "flipped", "samples.npz", flipped)
    changed_run(folder / "edited", "config.yaml", lambda content: content.replace(b"seed: 3", b"seed: 4"))
    changed_run(folder / "bad_manifest", "manifest.json", lambda content: content[:40])
    changed_run(folder / "newer", "manifest.json", lambda c: c.replace(b'"schema_version": 1', b'"schema_version": 2'))
    for name in ("no_manifest", "locked", "unfinished"):
        shutil.copytree(folder / "run", folder / name)
    (folder / "no_manifest" / "manifest.json").unlink()
    manifest = json.loads((folder / "unfinished" / "manifest.json").read_text())
    del manifest["files"]["samples.npz"]
    (folder / "unfinished" / "manifest.json").write_text(json.dumps(manifest))
    (folder / "unfinished" / "samples.npz").unlink()
    for name, condition in (("along", "[x_m]"), ("along_two", "[x_m,azimuth_rad]"), ("turning", "[azimuth_rad]")):
        make_conditioned_run(folder / name, 4000, condition)


def scan():
    """A capture of a wall at 0.3 m, as `GOOD` sees it."""
    y, x = np.meshgrid(np.linspace(-10, 10, 11), np.linspace(-10, 10, 11))
    counts = np.zeros((121, 60), dtype=np.uint16)
    counts[:, 20] = 50
    angles = {"x_deg": x.ravel(), "y_deg": y.ravel(), "boresight_azimuth_deg": 180.0, "boresight_elevation_deg": 0.0}
    return {"counts": counts, "bin_width_ps": 100.0, "start_ps": 0.0, "origin_m": [0.4, 0.0, 0.0], **angles}


def make_arrays(folder):
    (folder / "garbage.npz").write_bytes(GARBAGE)
    np.savez(folder / "scan.npz", **scan())
    np.savez(folder / "far.npz", **{**scan(), "origin_m": [1e300, 0.0, 0.0]})
    directions = {name: value for name, value in make_capture(3).items() if not name.endswith("_deg")}
    np.savez(folder / "lengths.npz", **directions, direction=np.full((3, 3, 3), 1e200))
    names = np.array([sys.maxunicode + 1], dtype=np.uint32).view("<U1")
    np.savez(folder / "letters.npz", azimuth_rad=[0.0], elevation_rad=[0.0], gate_end_m=[1.0], sensor_names=names)
    for number, shape in enumerate(PROMISED):
        header = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}\n".encode()
        with zipfile.ZipFile(folder / f"promised{number}.npz", "w") as archive:
            archive.writestr("points.npy", b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + bytes(80))
    for number, (changed, _) in enumerate(RAYS):
        row = [{**RAY, **changed}.get(name, "0") for name in HEADER.split(",")]
        (folder / f"rays{number}.csv").write_text(f"{HEADER}\n{','.join(row)}\n", encoding="utf-8")
    with h5py.File(folder / "other.h5", "w") as file:
        file["temperature"] = np.arange(5)
    content = (folder / "other.h5").read_bytes()
    (folder / "truncated.h5").write_bytes(content[: len(content) // 2])


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with everything that can be got wrong in it."""
    folder = tmp_path_factory.mktemp("mistakes") / "with spaces ü"
    for name, content in FILES.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
    make_arrays(folder)
    make_runs(folder)
    (folder / "folder").mkdir()
    (folder / "file").touch()
    shutil.copytree(folder / "run", folder / "blocked")
    (folder / "blocked/designs/taken.yaml").mkdir(parents=True)
    with run_lock(folder / "locked"):
        yield folder


@pytest.fixture
def ready(place, lidardesign, monkeypatch):
    """The program in the folder of mistakes, with the designs and exported files that it needs."""
    monkeypatch.chdir(place)
    if (place / "twin.csv").exists():
        return lidardesign
    for seed, name in enumerate(("fitted", "second"), 3):
        make_run(place / name, count=1000, seed=seed)
        assert lidardesign("fit", name, "--layout", "even", "--sensors", 1).code == 0
    assert lidardesign("fit", "fitted", "--sensors", 1, "--rays", 12, "--name", "beams").code == 0
    (place / "fitted/designs/beams.yaml").rename("beams.yaml")
    assert lidardesign("fit", "along", "--sensors", 1, "--rays", 3).code == 0
    assert lidardesign("export", "good.yaml", "--format", "galvo").code == 0
    header, first, *_ = (place / "good.galvo.csv").read_text().splitlines(keepends=True)
    (place / "header.galvo.csv").write_text(header)
    (place / "long.galvo.csv").write_text(header + "y" * 100_000 + first)
    (place / "fitted" / CACHE).touch()
    write_ball(place / "ball.stl", (0.1, 0.1, 0.1))
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind("socket")
    (place / "link.csv").symlink_to(place / "fitted" / "config.yaml")
    (place / "twin.csv").hardlink_to(place / "good.yaml")
    return lidardesign


def state_of(folder):
    """Every file and folder, and when each file was written last."""
    found = {path: path.lstat() for path in folder.rglob("*")}
    return {path: not stat.S_ISDIR(one.st_mode) and (one.st_ino, one.st_mtime_ns) for path, one in found.items()}


ROWS = [(None, *row) for row in CASES] + [(needs, line, code, "", word) for needs, (line, code, word) in NEEDING]


@pytest.mark.parametrize(("needs", "line", "code", "where", "word"), ROWS, ids=[row[1][:70] for row in ROWS])
def test_a_mistake_gets_one_message_its_exit_code_and_writes_nothing(
    place, ready, tmp_path, monkeypatch, needs, line, code, where, word
):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    before = state_of(place)
    if needs is not None:
        needs(monkeypatch)
    result = ready(*shlex.split(line), "--json")
    check_one_clear_message(result, code, where, word)
    assert state_of(place) == before


PARTS, MODULES = "--parts vl53l8cx --sensors 2", "--modules 2 --fov 45x45 --zones 8x8"
PLACING = "rays parts at-origin azimuth-deg elevation-deg roll-deg"
# Options of `fit` and `constrain` that exclude each other, or of which one is nothing without the other, and how the
# message names them: without dashes what may stand in a file of constraints as well.
OF_FITS = [
    ("--channels 4 --layout chosen", "--channels", "--layout"),
    ("--channels 4 --layout even", "--channels", "--layout"),
    ("--gates ray --layout even", "--gates", "--layout"),
    ("--gates ray --layout spinning", "--gates", "--layout"),
    ("--survive 1 --layout even", "survive", "--layout"),
    ("--survive 1 --layout spinning", "survive", "--layout"),
    ("--survive 1 --sensors 1", "survive", "--sensors"),
    (f"--survive 1 {PARTS}", "survive", "parts"),
    ("--at x_m=0.5 --layout spinning", "--at", "--layout"),
    ("--weight variation=2 --layout spinning", "--weight", "--layout"),
    ("--adaptive 2 --layout even", "--adaptive", "--layout"),
    ("--adaptive 2 --layout spinning", "--adaptive", "--layout"),
    (f"--adaptive 2 {PARTS}", "--adaptive", "parts"),
    ("--adaptive 2 --goal 100", "--adaptive", "goal"),
    ("--goal 100 --layout spinning", "--goal", "layouts"),
    ("--goal 100 --least sensors --sensors 2", "--least sensors", "--sensors"),
    (f"--goal 100 --least rays {PARTS}", "--least", "parts"),
    ("--goal 100 --sensors 1-3 --parts vl53l8cx", "--sensors", "goal"),
    (f"{PARTS} --at x_m=0.5", "--parts", "--at"),
    (f"{PARTS} --weight variation=2", "--parts", "--weight"),
    (f"{PARTS} --layout even", "--parts", "--layout"),
    (f"{PARTS} --gates ray", "--parts", "--gates"),
    (f"{MODULES} --parts vl53l8cx", "--modules", "--parts"),
    (f"{MODULES} --sensors 2", "--modules", "--sensors"),
    ("--sensors 1-3", "--sensors", "parts"),
    ("--sensors best --parts vl53l8cx", "--sensors", "--parts"),
    ("--goal 100 --least parts", "--least", "--parts"),
    ("--least rays", "--least", "--goal"),
    ("--fov 45x45", "--fov", "--modules"),
    ("--zones 8x8", "--zones", "--modules"),
]
EXCLUDING = [
    *((f"{command} run {options}", *names) for command in ("fit", "constrain") for options, *names in OF_FITS),
    ("constrain run --set parts.names=[vl53l8cx] --sensors 1 --layout even", "parts", "--layout"),
    ("evaluate run --baseline none --baseline cma", "--baseline", "none"),
    ("evaluate run --cma-seconds 3", "--cma-seconds", "--baseline"),
    ("evaluate fitted second --seed 4", "--seed", "--scenes-seed"),
    (f"{SCORE} --csv a --report a", "--csv", "--report"),
    ("export good.yaml --format csv --rate-hz 10", "--rate-hz", "csv"),
    ("export good.yaml --format csv --robot ball.stl", "--robot", "csv"),
    ("capture scan.npz good.galvo.csv --rays 3", "--rays", "good.galvo.csv"),
    ("capture scan.npz good.galvo.csv --at x_m=1", "--at", "good.galvo.csv"),
    ("simulate good.yaml --out seen --scene ball.stl --set test=3", "--set", "--scene"),
    ("simulate good.yaml --out seen --scene ball.stl --scenes 2", "--scenes", "--scene:"),
    *((f"catalog show vl53l8cx --{option} 2", f"--{option}", "--out") for option in PLACING.split()),
    ("catalog show vl53l8cx --arrange beside", "--arrange", "--out"),
    ("catalog show vl53l8cx --arrange beside --parts 1 --out part.yaml", "--arrange", "--parts"),
    *((f"config schema {kind} --task face", "--task", "config") for kind in ("constraints", "design", "evaluate")),
    ("show run --at x_m=1", "--at", "run"),
    ("show run --in run", "--in", "run"),
    ("fit run --adaptive 2 --survive 1 --sensors 2", "--adaptive", "survive"),
    ("fit run --sensors best --layout spinning", "--sensors", "layout"),
    (f"fit run {PARTS} --channels 4", "--channels", "parts"),
    ("evaluate run --baseline none --fail-unless-better greedy", "--baseline", "--fail-unless-better"),
    ("learn flatland --tolerance 0.1 --set learning.misplaced=0.2", "learning.misplaced", "--tolerance"),
]


@pytest.mark.parametrize(("line", "one", "other"), EXCLUDING)
def test_options_that_exclude_each_other_are_named_both(place, ready, line, one, other):
    before = state_of(place)
    result = ready(*shlex.split(line), "--json")
    check_one_clear_message(result, 2, "", one, other)
    assert state_of(place) == before


def test_a_scanner_file_that_a_spreadsheet_saved_is_read(ready, place):
    (place / "marked.galvo.csv").write_text("\ufeff" + (place / "good.galvo.csv").read_text(), encoding="utf-8")
    plain, marked = (ready("capture", "scan.npz", f"{name}.galvo.csv", "--json") for name in ("good", "marked"))
    (place / "marked.galvo.csv").unlink()
    assert marked.code == 0, marked.err
    for row, again in zip(plain.json["rows"], marked.json["rows"], strict=True):
        assert {**row, "design": ""} == {**again, "design": ""}
