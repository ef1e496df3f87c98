"""Networks that remember or decide for a team, exported: what flies, and what only the twin may fly."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from imagine.core.errors import InputError
from imagine.core.observation_spec import ObservationSpec
from imagine.export.onnx_export import export_onnx, inspect
from imagine.onboard.build import load_policy as load_on_board
from imagine.onboard.settings import DroneSettings
from imagine.sim.exploration import Exploration
from imagine.sim.exploration_settings import ExplorationSettings
from imagine.train.checkpoint import Checkpoint, save_checkpoint
from imagine.train.networks import Actor, Critic, NetworkSettings
from imagine.train.policies import PolicyPilot, load_policy
from imagine.train.settings import TrainSettings

SPEC = ObservationSpec(view_cells=16, lidar_sectors=17)
SMALL = {
    "view_channels": (4, 4, 4), "critic_channels": (4, 4), "lidar_channels": 2, "hidden": 16, "memory_size": 12,
    "stack_frames": 3,
}  # fmt: skip
KINDS = {
    "gru": {"paradigm": "dtde", "memory": "gru", "lidar": "dense", "views": "patch"},
    "stack": {"paradigm": "ctde", "memory": "stack", "lidar": "conv1", "encoder": "shared"},
    "patches": {"paradigm": "ctde", "memory": "stack", "lidar": "dense", "views": "patch", "stack_frames": 2},
    "team": {"paradigm": "ctce", "memory": "gru", "lidar": "conv2"},
    "twin": {"paradigm": "ctce", "memory": "none", "lidar": "dense", "encoder": "shared"},
}


@pytest.fixture(scope="module", params=KINDS)
def exported(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp(request.param)
    torch.manual_seed(2)
    settings = TrainSettings(
        env=ExplorationSettings(observation=SPEC), network=NetworkSettings(**{**SMALL, **KINDS[request.param]})
    )
    actor, critic = Actor(settings.network, SPEC, 2), Critic(settings.network, SPEC)
    torch.nn.init.normal_(actor.mean.weight)  # actions that fill the range
    checkpoint = Checkpoint(settings, "ppo", {"ppo": 1}, 1, 1.0, actor.state_dict(), critic.state_dict(), {}, {})
    save_checkpoint(checkpoint, folder / "checkpoints" / "latest.pt")
    export_onnx(folder, folder / "model.onnx", name=request.param)
    return request.param, folder, actor


def test_the_contract_names_what_the_model_takes_and_remembers(exported):
    kind, folder, actor = exported
    found = inspect(folder / "model.onnx")
    contract = found.contract
    assert contract.paradigm == KINDS[kind]["paradigm"]
    assert contract.contract_version == 2
    assert contract.training["parity_max_difference"] <= 1e-5
    expected = {"gru": 12, "stack": 2 * 4 * 16 * 16, "patches": 4 * 16 * 16, "team": 12, "twin": 0}[kind]
    assert contract.state_size == actor.state_size == expected
    assert found.inputs == contract.inputs == actor.shapes
    assert ("level" in found.inputs) == (kind in ("team", "twin"))
    assert found.outputs == ({"action": (2,), "next_state": (expected,)} if expected else {"action": (2,)})


def test_in_the_twin_the_model_flies_as_the_checkpoint_does(exported):
    """Step by step, over the end of an episode, with a drone that has fallen."""
    kind, folder, _ = exported
    settings = ExplorationSettings(levels=("1",), worlds=2, drones=3, episode_ticks=6, observation=SPEC, mirror=False)
    env = Exploration(settings, seed=4)
    pilots = [PolicyPilot(load_policy(folder / name)) for name in ("model.onnx", "checkpoints/latest.pt")]
    observation = env.reset()
    first = []
    for pilot in pilots:
        pilot.begin(env)
    for t in range(8):
        if t == 3:
            env.alive[1, 2] = False
        (found, expected), flying = [pilot.act(env, observation) for pilot in pilots], env.alive.copy()
        np.testing.assert_allclose(found[flying], expected[flying], atol=1e-5)
        first.append(found)
        step = env.step(np.where(flying[..., None], found, 0.0))
        for pilot in pilots:
            pilot.forget(step.done)
        observation = step.observation
    assert np.abs(first).max() > 0.3
    if kind != "twin":  # what it saw before makes a difference
        pilots[0].forget(np.ones(2, bool))
        assert not np.allclose(pilots[0].act(env, observation), pilots[1].act(env, observation), atol=1e-4)


def test_a_drone_flies_what_decides_for_it_alone(exported):
    kind, folder, _ = exported
    drone = DroneSettings(policy=folder / "model.onnx")
    if KINDS[kind]["paradigm"] == "ctce":
        with pytest.raises(InputError, match=r"model\.onnx: contract: paradigm: the model \(ctce\) wants"):
            load_on_board(drone)
        return
    policy = load_on_board(drone)
    observation = {name: np.ones(shape, np.float32) for name, shape in SPEC.shapes.items()}
    state = np.zeros(policy.contract.state_size, np.float32)
    action, after = policy.infer(observation, state)
    again, _ = policy.infer(observation, after)
    assert action.shape == (2,)
    assert not np.array_equal(state, after)
    assert not np.array_equal(action, again)
