"""Networks that fly: a name, a function from a batch of observations to one of actions, and the pilot made of it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import torch
from numpy.typing import NDArray

from imagine.core.errors import InputError
from imagine.core.lidar import PRESETS, LidarSpec
from imagine.onboard.policy import OnnxPolicy
from imagine.sim.exploration import Exploration, Observation
from imagine.sim.exploration_settings import ExplorationSettings
from imagine.train.checkpoint import actor_of, load_checkpoint
from imagine.train.networks import Actor
from imagine.train.pilots import Actions
from imagine.train.rollout import OBSERVATION_KEYS

Arrays = dict[str, NDArray[np.float32]]
_LEAST_ROWS = 32  # matrix products of fewer rows are summed in another order, and an episode would hang on the others


@dataclass(frozen=True)
class Policy:
    """`act` takes `views`, `lidar`, `motion`, `[batch, ...]`, and returns actions `[batch, action size]` in [-1, 1].

    `env` is the environment the policy was made for, where it is known.
    """

    name: str
    act: Callable[[Arrays], NDArray[np.float32]]
    env: ExplorationSettings | None = None


class PolicyPilot:
    """Flies a batch of worlds by a policy alone: deterministic, without rescue, each drone by its own observation."""

    def __init__(self, policy: Policy) -> None:
        self.name = policy.name
        self._policy = policy

    def begin(self, env: Exploration) -> None:
        """Keep nothing: the policy has no memory."""

    def forget(self, worlds: NDArray[np.bool_]) -> None:
        """Keep nothing."""

    def act(self, env: Exploration, observation: Observation) -> Actions:
        """Return the policy's actions, the same for a world whichever others fly beside it."""
        rows = env.worlds * env.drones
        flat = {}
        for key in OBSERVATION_KEYS:
            array = observation.policy[key]
            flat[key] = np.zeros((max(rows, _LEAST_ROWS), *array.shape[2:]), np.float32)
            flat[key][:rows] = array.reshape(rows, *array.shape[2:])
        actions = self._policy.act(flat)[:rows]
        return np.clip(actions, -1.0, 1.0).reshape(env.worlds, env.drones, -1)


def policy_of(actor: Actor, name: str, env: ExplorationSettings | None = None) -> Policy:
    """Return a network's deterministic policy."""

    @torch.no_grad()
    def act(observation: Arrays) -> NDArray[np.float32]:
        result: NDArray[np.float32] = actor(*(torch.from_numpy(observation[key]) for key in OBSERVATION_KEYS)).numpy()
        return result

    return Policy(name, act, env)


def load_policy(path: Path) -> Policy:
    """Load a policy from an ONNX model with its contract, or from a checkpoint (`.pt`, or a run folder).

    Raises InputError when the file is missing, damaged, without a contract, or made for a sensor that is no preset's.
    """
    if path.is_dir() or path.suffix == ".pt":
        checkpoint = load_checkpoint(path)
        return policy_of(actor_of(checkpoint, str(path)), checkpoint.settings.run.name, checkpoint.settings.env)
    contract = OnnxPolicy.load(path).contract  # with all the checks made before a flight
    options = onnxruntime.SessionOptions()
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")  # idle threads would take the twin's cores
    session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])

    def act(observation: Arrays) -> NDArray[np.float32]:
        result: NDArray[np.float32] = session.run(["action"], {key: observation[key] for key in OBSERVATION_KEYS})[0]
        return result

    env = ExplorationSettings(
        map=contract.map, limits=contract.limits, observation=contract.observation, action=contract.action,
        **_sensor(contract.lidar.spec(), path),
    )  # fmt: skip
    return Policy(contract.name, act, env)


def _sensor(spec: LidarSpec, path: Path) -> dict[str, Any]:
    """Return the settings of exploration that give this sensor. Raises InputError where no preset is like it."""
    for name, preset in PRESETS.items():
        if dataclasses.replace(preset, beams=spec.beams) == spec:
            return {"lidar": name, "lidar_beams": None if preset.beams == spec.beams else spec.beams}
    raise InputError(f"{path}: contract: lidar: no preset of the twin is like this sensor; known: {', '.join(PRESETS)}")
