"""Files: YAML that bombs, repeats, nests or means something else, and checkpoints that are none."""

from __future__ import annotations

import json
import math
import pickle
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.tables import each_row

from lidardesign.config import resolve
from lidardesign.constraints.document import load_constraints
from lidardesign.density.training.checkpoint import FORMAT, load_arrays, save_arrays
from lidardesign.density.training.trainer import CHECKPOINT
from lidardesign.errors import ConfigError, DataError, LidardesignError
from lidardesign.formats.designs import load_design
from lidardesign.registry import load_task
from lidardesign.run.manifest import record, start_manifest
from lidardesign.run.yaml import parse_yaml
from lidardesign.simulate.detector.files import load_detector

BOMB_LEVELS = 7
REFUSED = {
    "an alias bomb": "\n".join(
        ["a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]"]
        + [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 10)}]" for n in range(1, BOMB_LEVELS)]
    ),
    "an alias of itself": "a: &x [*x]\n",
    "a key twice": "density:\n  sigma_m: 0.1\n  sigma_m: 0.2\n",
    "deep lists": "[" * 5000 + "]" * 5000,
    "deep mappings": "{a: " * 5000,
    "a tag that runs code": "density: !!python/object/apply:os.system ['touch executed']\n",
    "a tag of its own": "density: !thing {sigma_m: 1}\n",
    "a merge key": "a: &a {sigma_m: 1}\ndensity:\n  <<: *a\n",
    "infinity": "density: {sigma_m: .inf}\n",
    "two documents": "seed: 1\n---\nseed: 2\n",
    "control characters": "seed: \x00\n",
}


def readers(folder):
    """Everything that reads YAML, by name."""
    path = folder / "input.yaml"
    return {
        "configuration": lambda: resolve(load_task("flatland"), config_file=path),
        "constraints": lambda: load_constraints(path),
        "design": lambda: load_design(path),
        "detector": lambda: load_detector(path),
    }


@pytest.mark.hard_case(
    "36",
    "YAML: alias bomb, duplicate keys, 1 MB or 32 levels, tags, `1e-3`, `no`, `1:30`, dates, unknown key, wrong type",
    done="a reader of its own with positions: bombs, tags, merge keys, repeats, depth and size are refused at "
    "file:line:column; words and dates stay text, true and quoted text are no numbers; nothing is ever executed",
)
class TestYaml:
    @each_row("case", REFUSED)
    @each_row("reader", ["configuration", "constraints", "design", "detector"])
    def test_every_reader_of_yaml_refuses_it(self, tmp_path, monkeypatch, reader, case):
        monkeypatch.chdir(tmp_path)
        (tmp_path / "input.yaml").write_bytes(REFUSED[case].encode())
        with pytest.raises(LidardesignError) as refused:
            readers(tmp_path)[reader]()
        assert "input.yaml" in str(refused.value)
        assert [path.name for path in tmp_path.iterdir()] == ["input.yaml"]

    def test_a_small_number_in_scientific_notation_is_a_number_of_the_configuration(self, tmp_path):
        (tmp_path / "input.yaml").write_text("density: {sigma_m: 1e-3}\n")
        assert readers(tmp_path)["configuration"]().density.sigma_m == 1e-3

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


class Executed:
    """What a pickle of this does when it is loaded."""

    def __reduce__(self):
        return (open, ("executed", "w"))


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
    done="safetensors only, its SHA-256 in the manifest, its numbers finite; its format and its parts checked before "
    "they are used; each damage has a message of its own and no file is ever unpickled",
)
class TestCheckpoints:
    def test_a_good_one_comes_back_bit_for_bit(self, run):
        arrays, state = load_arrays(run, CHECKPOINT)
        assert state == STATE
        for name, array in ARRAYS.items():
            np.testing.assert_array_equal(arrays[name], array)

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

    @given(at=st.integers(0), bit=st.integers(0, 7))
    def test_every_flipped_bit_is_found(self, tmp_path_factory, at, bit):
        folder = tmp_path_factory.mktemp("run")
        start_manifest(folder, command=[], seed=1)
        save_arrays(folder, CHECKPOINT, ARRAYS, STATE)
        content = bytearray((folder / CHECKPOINT).read_bytes())
        content[at % len(content)] ^= 1 << bit
        (folder / CHECKPOINT).write_bytes(bytes(content))
        with pytest.raises(DataError, match="SHA-256"):
            load_arrays(folder, CHECKPOINT)

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
        import torch

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
    import torch

    from lidardesign.density.coordinates import Coordinates
    from lidardesign.density.training.learn import make_flow
    from lidardesign.density.training.trainer import Trainer

    small = [f"learning.hidden={hidden}", "learning.layers=1", "learning.bins=4"]
    config = resolve(load_task("flatland"), preset="draft", overrides=small)
    generator = torch.Generator().manual_seed(0)
    flow, coordinates = make_flow(config, generator), Coordinates(config.space)
    return Trainer(flow, None, coordinates, generator, config.learning, run, None)
