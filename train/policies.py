"""Policies as evaluation sees them: a name and a function from a batch of observations to a batch of actions."""

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
from imagine.sim.exploration_settings import ExplorationSettings
from imagine.train.checkpoint import actor_of, load_checkpoint
from imagine.train.networks import Actor
from imagine.train.rollout import actor_inputs

Arrays = dict[str, NDArray[np.float32]]


@dataclass(frozen=True)
class Policy:
    """`act` takes `views`, `lidar`, `motion`, `[batch, ...]`, and returns actions `[batch, action size]` in [-1, 1].

    `env` is the environment the policy was made for, where it is known.
    """

    name: str
    act: Callable[[Arrays], NDArray[np.float32]]
    env: ExplorationSettings | None = None


def policy_of(actor: Actor, name: str, env: ExplorationSettings | None = None) -> Policy:
    """Return a network's deterministic policy."""

    @torch.no_grad()
    def act(observation: Arrays) -> NDArray[np.float32]:
        result: NDArray[np.float32] = actor(
            *actor_inputs({key: torch.from_numpy(array) for key, array in observation.items()})
        ).numpy()
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
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])

    def act(observation: Arrays) -> NDArray[np.float32]:
        result: NDArray[np.float32] = session.run(["action"], dict(observation))[0]
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
