"""A network with every option on, exported, loaded by a drone, and flown: what flies is what trained."""

from __future__ import annotations

import numpy as np
import pytest
from flat_world import FlatFlight

pytest.importorskip("torch", reason="torch is not installed: it comes with the extra 'train'")

import imagine.train  # sets up OpenMP, so it comes before torch  # isort: skip

import torch

from imagine.core.contract import ActionSpec
from imagine.core.observation_spec import ObservationSpec
from imagine.export.onnx_export import export_onnx
from imagine.onboard.build import build_runner, load_policy, warm_up
from imagine.onboard.settings import DroneSettings, LaunchPose
from imagine.sim.exploration_settings import ExplorationSettings
from imagine.train.checkpoint import Checkpoint, save_checkpoint
from imagine.train.networks import Actor, Critic, NetworkSettings
from imagine.train.settings import TrainSettings

assert imagine.train

EVERYTHING = ObservationSpec(
    view_cells=16, lidar_sectors=16, axes="heading", position=True, heading=True, peers=2, visits="team"
)
TINY = NetworkSettings(view_channels=(4, 4, 4), critic_channels=(4, 4), lidar_channels=2, hidden=16)


@pytest.mark.parametrize(
    "action", [ActionSpec(mode="forward"), ActionSpec(mode="waypoint", decision_ticks=4)], ids=["forward", "waypoint"]
)
def test_a_policy_with_every_option_is_exported_loaded_and_flown(tmp_path, action):
    torch.manual_seed(1)
    env = ExplorationSettings(observation=EVERYTHING, action=action)
    actor, critic = Actor(TINY, EVERYTHING, action.size), Critic(TINY, EVERYTHING)
    torch.nn.init.normal_(actor.mean.weight)  # actions that fill the range
    settings = TrainSettings(env=env, network=TINY)
    checkpoint = Checkpoint(settings, "ppo", {"ppo": 1}, 1, 1.0, actor.state_dict(), critic.state_dict(), {}, {}, {})
    save_checkpoint(checkpoint, tmp_path / "run" / "latest.pt")
    export_onnx(tmp_path / "run" / "latest.pt", tmp_path / "all.onnx")

    drone = DroneSettings(policy=tmp_path / "all.onnx", launch=LaunchPose(x=1.5, y=1.5))
    policy = load_policy(drone)
    assert (policy.contract.observation, policy.contract.action) == (EVERYTHING, action)
    warm_up(drone, policy)

    flight = FlatFlight(drone, policy)
    flight.runner = build_runner(drone, policy, sealer=None)
    flight.fly_until(lambda output: output.status.decider == "policy", longest_s=10.0)
    for _ in range(8):
        flight.tick()
    flown = [output for output in flight.outputs if output.status.decider == "policy"]
    assert len(flown) == 9
    numbers = np.array([(o.setpoint.vx, o.setpoint.vy, o.setpoint.yaw_rate) for o in flown])
    assert np.isfinite(numbers).all()
    assert np.abs(numbers).max() > 0.02
    assert flight.runner.visits.own.sum() == 9
