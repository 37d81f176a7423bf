"""Files: YAML that bombs, repeats, nests or runs code, checkpoints that are none, and pickles under any name."""

from __future__ import annotations

import json
import math
import os
import pickle
import shutil
import struct

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from lidardesign.config import load_run_config, resolve
from lidardesign.constraints.document import load_constraints
from lidardesign.density.coordinates import Coordinates
from lidardesign.density.training.checkpoint import FORMAT, load_arrays, save_arrays
from lidardesign.density.training.learn import make_flow
from lidardesign.density.training.trainer import CHECKPOINT, Trainer
from lidardesign.errors import ConfigError, DataError, LidardesignError
from lidardesign.formats.designs import load_design
from lidardesign.run.manifest import record, start_manifest
from lidardesign.run.yaml import parse_yaml
from lidardesign.simulate.detector.files import load_detector
from lidardesign.task import load_task

REFUSED = {
    "an alias bomb": "".join(f"a{n}: &a{n} [{', '.join([f'*a{n - 1}' if n else '1'] * 10)}]\n" for n in range(7)),
    "a key twice": "density:\n  sigma_m: 0.1\n  sigma_m: 0.2\n",
    "deep mappings": "{a: " * 5000,
    "code": "!!python/object/apply:os.mkdir ['executed']",
    "code for a value": "seed: !!python/object/apply:os.mkdir ['executed']",
    "a new object": "seed: !!python/object/new:os.mkdir ['executed']",
    "a module": "!!python/module:os {}",
    "a variable": "seed: ${oc.env:HOME}",
}


def read_run(path):
    start_manifest(path.parent, command=[], seed=1)
    shutil.copy(path, path.with_name("config.yaml"))
    record(path.parent, ["config.yaml"])
    return load_run_config(path.parent)


# Everything that reads YAML.
READERS = {
    "configuration": lambda path: resolve(load_task("flatland"), config_file=path),
    "constraints": load_constraints,
    "design": load_design,
    "detector": load_detector,
    "run": read_run,
}


class Executed:
    """What makes a folder when it is unpickled."""

    def __reduce__(self):
        return os.mkdir, ("executed",)


@pytest.mark.hard_case(
    "36",
    "YAML: alias bomb, duplicate keys, 1 MB or 32 levels, tags, `1e-3`, `no`, `1:30`, dates, unknown key, wrong type",
    done="a reader of its own with positions: bombs, tags, merge keys, repeats, depth and size are refused at "
    "file:line:column",
)
class TestYaml:
    @pytest.mark.hard_case("P4")
    @pytest.mark.parametrize("case", REFUSED)
    @pytest.mark.parametrize("reader", READERS)
    def test_every_reader_of_yaml_refuses_it(self, tmp_path, monkeypatch, reader, case):
        monkeypatch.chdir(tmp_path)
        (tmp_path / "input.yaml").write_text(REFUSED[case])
        with pytest.raises(LidardesignError) as refused:
            READERS[reader](tmp_path / "input.yaml")
        assert refused.value.exit_code in (2, 3)
        assert str(tmp_path) in str(refused.value)
        assert not (tmp_path / "executed").exists()

    @given(st.text(st.characters(codec="utf-8"), max_size=60))
    def test_any_text_is_a_document_or_an_error_with_a_position(self, text):
        value, where = None, "f"
        try:
            value = parse_yaml(text, where="f").value
        except ConfigError as refused:
            where = refused.where
        assert where.startswith("f")
        assert json.loads(json.dumps(value, allow_nan=False)) == value


STATE = {"step": 7, "seconds": 1.5}
ARRAYS = {"flow.weight": np.linspace(0, 1, 12).reshape(3, 4), "generator": np.arange(8, dtype=np.uint8)}


def header_and_data(content):
    length = struct.unpack("<Q", content[:8])[0]
    return json.loads(content[8 : 8 + length]), content[8 + length :]


def assembled(header, data):
    text = json.dumps(header).encode()
    return struct.pack("<Q", len(text)) + text + data


def with_metadata(content, metadata):
    header, data = header_and_data(content)
    return assembled({**header, "__metadata__": metadata}, data)


def with_nan(content):
    header, data = header_and_data(content)
    at = header["flow.weight"]["data_offsets"][0]
    return assembled(header, data[:at] + struct.pack("<d", math.nan) + data[at + 8 :])


def bit_flipped(content):
    return content[:-20] + bytes([content[-20] ^ 1]) + content[-19:]


# name: damage, whether the hash is made right again, words of the reason
DAMAGES = {
    "truncated": (lambda content: content[: len(content) // 2], False, "is truncated"),
    "bit-flipped": (bit_flipped, False, "SHA-256"),
    "longer": (lambda content: content + b"\x00", False, "SHA-256"),
    "truncated, with its hash": (lambda content: content[: len(content) // 2], True, "cannot be read"),
    "of an older version": (lambda c: with_metadata(c, {"lidardesign-1": "{}"}), True, "'lidardesign-1'"),
    "of a newer version": (lambda c: with_metadata(c, {"lidardesign-3": "{}"}), True, "'lidardesign-3'"),
    "of another program": (lambda c: with_metadata(c, {"format": "pt"}), True, "format 'format'"),
    "of weights that are not finite": (with_nan, True, "not finite"),
    "with a header of a petabyte": (lambda content: struct.pack("<Q", 1 << 50) + content[8:], True, "cannot be read"),
    "without its state": (lambda c: with_metadata(c, {FORMAT: "["}), True, "state cannot be read"),
    "with a list as its state": (lambda c: with_metadata(c, {FORMAT: "[1]"}), True, "holds no state"),
    "a renamed pickle": (lambda _: pickle.dumps(Executed()), True, "cannot be read"),
    "empty": (lambda _: b"", True, "cannot be read"),
}


@pytest.fixture
def run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    start_manifest(tmp_path, command=["lidardesign", "learn"], seed=1)
    save_arrays(tmp_path, CHECKPOINT, ARRAYS, STATE)
    return tmp_path


@pytest.mark.hard_case(
    "37",
    "A checkpoint that is truncated, bit-flipped, of a newer version or another flow, or a pickle renamed to it",
    done="safetensors only, its SHA-256 in the manifest, its numbers finite",
)
class TestCheckpoints:
    @pytest.mark.parametrize("case", DAMAGES)
    def test_each_damage_has_its_own_message(self, run, case):
        damage, rehashed, words = DAMAGES[case]
        path = run / CHECKPOINT
        path.write_bytes(damage(path.read_bytes()))
        if rehashed:
            record(run, [CHECKPOINT])
        with pytest.raises(DataError) as refused:
            load_arrays(run, CHECKPOINT)
        assert CHECKPOINT in refused.value.where
        assert words in str(refused.value)
        assert refused.value.exit_code == 3
        assert not (run / "executed").exists()

    def test_one_of_another_flow_is_refused_and_the_trainer_keeps_its_weights(self, run):
        trainer = fresh_trainer(run, hidden=8)
        trainer._save(*trainer._state())
        other = fresh_trainer(run, hidden=12)
        before = [parameter.detach().clone() for parameter in other.flow.parameters()]
        with pytest.raises(DataError, match="another flow"):
            other.resume()
        assert all((old == new).all() for old, new in zip(before, other.flow.parameters(), strict=True))
        trainer.resume()

    @pytest.mark.parametrize("name", ["step", "skipped", "skipped_in_a_row", "halvings", "seconds"])
    @pytest.mark.parametrize("value", [None, -1, "7", True, [1], 1e400, 10**400], ids=lambda value: str(value)[:5])
    def test_a_counter_that_is_none_is_refused(self, run, name, value):
        trainer = fresh_trainer(run, hidden=8)
        arrays, state = trainer._state()
        save_arrays(run, CHECKPOINT, arrays, {**state, name: value})
        with pytest.raises(DataError, match=f"has {name} = "):
            trainer.resume()

    @pytest.mark.parametrize(
        ("name", "array", "words"),
        [
            ("generator", np.zeros(5, np.uint8), "random stream"),
            ("generator", np.zeros(5056), "random stream"),
            ("adam.0.exp_avg", np.zeros(3), "another flow"),
            ("adam.0.surprise", np.zeros(3), "another flow"),
            ("flow.surprise", np.zeros(3), "another flow"),
        ],
    )
    def test_parts_that_do_not_fit_are_refused(self, run, name, array, words):
        trainer = fresh_trainer(run, hidden=8)
        arrays, state = trainer._state()
        save_arrays(run, CHECKPOINT, {**arrays, name: array}, state)
        with pytest.raises(DataError, match=words):
            trainer.resume()

    @pytest.mark.parametrize(("moment", "value"), [("exp_avg_sq", -1.0), ("step", 0.0), ("step", -1.0)])
    def test_moments_that_no_step_leaves_are_refused(self, run, moment, value):
        trainer = fresh_trainer(run, hidden=8)
        for parameter in trainer.flow.parameters():
            parameter.grad = torch.ones_like(parameter)
        trainer.optimiser.step()
        arrays, state = trainer._state()
        save_arrays(run, CHECKPOINT, arrays, state)
        trainer.resume()
        name = f"adam.0.{moment}"
        array = np.full_like(arrays[name], value)
        save_arrays(run, CHECKPOINT, {**arrays, name: array}, state)
        with pytest.raises(DataError, match="impossible numbers"):
            trainer.resume()

    def test_one_from_before_float64_was_entered_is_resumed(self, run):
        """Checkpoints of the first version have no entry for the step at which float64 took over."""
        trainer = fresh_trainer(run, hidden=8)
        arrays, state = trainer._state()
        state = {key: value for key, value in state.items() if key != "doubled_at"}
        save_arrays(run, CHECKPOINT, arrays, {**state, "step": 5})
        trainer.resume()
        assert trainer.step == 5


def fresh_trainer(run, hidden):
    """A trainer of a small flow at its first step, with nothing to train on."""
    small = [f"learning.hidden={hidden}", "learning.layers=1", "learning.bins=4"]
    config = resolve(load_task("flatland"), preset="draft", overrides=small)
    generator = torch.Generator().manual_seed(0)
    flow, coordinates = make_flow(config, generator), Coordinates(config.space)
    return Trainer(flow, None, coordinates, generator, config.learning, run, None)


@pytest.mark.hard_case(
    "P4",
    "An input file holds code: pickles under any name, YAML tags, strings to be evaluated",
    done="no file runs code: YAML is read without tags, arrays without pickles, checkpoints are safetensors",
)
class TestNoFileRunsCode:
    @pytest.fixture
    def refused(self, lidardesign, tmp_path):
        def refused(*command):
            done = lidardesign(*command)
            assert done.code in (2, 3), (done.out, done.err)
            assert not (tmp_path / "executed").exists()

        return refused

    def test_samples_of_pickles_are_refused_though_their_hash_is_right(self, refused, flat):
        np.savez(flat / "samples.npz", points=np.array([Executed()], dtype=object), log_prob=np.zeros(1))
        record(flat, ["samples.npz"])
        refused("fit", flat)
        (flat / "samples.npz").write_bytes(pickle.dumps(Executed()))
        record(flat, ["samples.npz"])
        refused("fit", flat)

    @pytest.mark.parametrize("suffix", ["stl", "obj", "ply", "glb", "off"])
    def test_meshes_of_pickles_are_refused(self, refused, tmp_path, suffix):
        (tmp_path / f"a.{suffix}").write_bytes(pickle.dumps(Executed()))
        refused("learn", "meshes", "--set", f"folder={tmp_path}", "--out", "new")

    @pytest.mark.parametrize(
        "text", ["__import__('os').mkdir('executed')", "eval(os.mkdir('executed'))", "$(mkdir executed)"]
    )
    def test_values_are_never_evaluated(self, refused, text):
        refused("learn", "flatland", "--set", f"learning.rate={text}", "--out", "new")
