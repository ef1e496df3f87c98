import os
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from imagine.core.config import check_settings
from imagine.core.errors import InputError, WorkError
from imagine.train.atomic_file import write_atomically
from imagine.train.checkpoint import Checkpoint, check_same_network, load_checkpoint, load_weights, pack, unpack
from imagine.train.settings import TrainSettings

plain = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**140), 2**140) | st.text(max_size=5) | st.floats(allow_nan=False),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=8,
)


@given(plain)
def test_packing_loses_nothing(value):
    assert unpack(pack(value)) == value


def test_a_generators_state_survives_a_file(tmp_path):
    rng = np.random.default_rng(5)
    state = {"generators": [rng.bit_generator.state], "grid": np.arange(6, dtype=np.int16).reshape(2, 3)}
    torch.save(pack(state), tmp_path / "state.pt")
    loaded = unpack(torch.load(tmp_path / "state.pt", weights_only=True))
    other = np.random.default_rng(0)
    other.bit_generator.state = loaded["generators"][0]
    assert other.random() == rng.random()
    np.testing.assert_array_equal(loaded["grid"], state["grid"])


class Evil:
    def __reduce__(self):
        return os.system, ("touch pwned",)


def bad_files(folder):
    (folder / "text.pt").write_text("not a checkpoint")
    (folder / "empty.pt").write_bytes(b"")
    torch.save({"format": "imagine-checkpoint-1", "phase": "ppo"}, folder / "part.pt")
    torch.save([1, 2], folder / "list.pt")
    torch.save({"weights": torch.zeros(3)}, folder / "other.pt")
    whole = (folder / "other.pt").read_bytes()
    (folder / "cut.pt").write_bytes(whole[: len(whole) // 2])
    (folder / "evil.pt").write_bytes(pickle.dumps(Evil()))


@pytest.mark.parametrize("name", ["text", "empty", "part", "list", "other", "cut", "evil", "absent"])
def test_what_is_no_checkpoint_is_refused_by_name(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    bad_files(tmp_path)
    with pytest.raises(InputError, match=rf"{name}\.pt: "):
        load_checkpoint(tmp_path / f"{name}.pt")
    assert not (tmp_path / "pwned").exists()


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_disk_is_said_and_the_older_file_stays(tmp_path):
    path = tmp_path / "latest.pt"
    path.write_text("older")
    with pytest.raises(WorkError, match=r"latest\.pt: cannot be written: the disk is full"):
        write_atomically(path, lambda _: Path("/dev/full").write_text("newer"))
    assert path.read_text() == "older"
    assert [file.name for file in tmp_path.iterdir()] == ["latest.pt"]


def test_a_torch_file_on_a_full_disk_is_said_too(tmp_path):
    with pytest.raises(WorkError, match="cannot be written"):
        write_atomically(tmp_path / "latest.pt", lambda _: torch.save({"a": torch.zeros(100_000)}, "/dev/full"))


def test_a_checkpoint_of_another_network_is_refused_by_its_first_other_setting():
    saved = Checkpoint(TrainSettings(), "ppo", {}, 0, 0.0, {}, {}, {}, {})
    check_same_network(saved, TrainSettings(), "run")
    for key, value, message in (
        ("network", {"hidden": 64, "memory": "gru"}, "network.memory is none in it, gru here"),
        ("network", {"paradigm": "dtde"}, "network.paradigm is ctde in it, dtde here"),
        ("env", {"observation": {"view_cells": 24}}, "env.observation.view_cells is 32 in it, 24 here"),
        ("env", {"action": {"mode": "body"}}, "env.action.mode is plane in it, body here"),
    ):
        wanted = check_settings(TrainSettings, {key: value}, "config")
        with pytest.raises(InputError, match=f"run: made for another network: {message}"):
            check_same_network(saved, wanted, "run")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda weights: weights.pop("weight"), "it has no 'weight'"),
        (lambda weights: weights.update(extra=torch.zeros(1)), "'extra' has no place in this one"),
        (lambda weights: weights.update(weight=torch.zeros(3, 3)), r"'weight' is \(3, 3\), this one needs \(2, 3\)"),
    ],
)
def test_weights_that_do_not_fit_are_refused_by_name_and_change_nothing(change, message):
    layer = torch.nn.Linear(3, 2)
    weights = {name: value.clone() + 1.0 for name, value in layer.state_dict().items()}
    before = {name: value.clone() for name, value in layer.state_dict().items()}
    change(weights)
    with pytest.raises(InputError, match=f"run: made for another network: {message}"):
        load_weights(layer, weights, "run")
    assert all(torch.equal(value, before[name]) for name, value in layer.state_dict().items())
