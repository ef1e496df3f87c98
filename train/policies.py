"""Networks that fly: a name, a function from a batch of observations to one of actions, and the pilot made of it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import torch
from numpy.typing import NDArray

from imagine.core.contract import LEVEL, NEXT_STATE, STATE
from imagine.core.errors import InputError
from imagine.core.lidar import PRESETS, LidarSpec
from imagine.onboard.policy import OUTPUT, OnnxPolicy
from imagine.sim.exploration import Exploration, Observation
from imagine.sim.exploration_settings import ExplorationSettings
from imagine.train.checkpoint import actor_of, load_checkpoint
from imagine.train.networks import Actor
from imagine.train.pilots import Actions

Arrays = dict[str, NDArray[np.float32]]
_LEAST_ROWS = 32  # matrix products of fewer rows are summed in another order, and an episode would hang on the others


@dataclass(frozen=True)
class Policy:
    """A network that decides for many drones at once.

    `act` takes what `inputs` name, `[rows, ...]`, rows being whole teams of so many drones in order, and who of them
    flies (bool `[rows]`); it returns actions `[rows, action size]` in [-1, 1] and the next states
    `[rows, state_size]`. `inputs` are `views`, `lidar` and `motion`, `level` for a centralised policy, `state` for one
    that remembers. `env` is the environment the policy was made for, where it is known.
    """

    name: str
    act: Callable[[Arrays, int, NDArray[np.bool_]], tuple[NDArray[np.float32], NDArray[np.float32]]]
    env: ExplorationSettings | None = None
    inputs: tuple[str, ...] = ("views", "lidar", "motion")
    state_size: int = 0


class PolicyPilot:
    """Flies a batch of worlds by a policy alone: deterministic, without rescue, each drone by its own observation.

    A centralised policy, which only a twin can fly, also gets its teammates' observations and the whole level.
    """

    def __init__(self, policy: Policy) -> None:
        self.name = policy.name
        self._policy = policy
        self._state: NDArray[np.float32] = np.zeros((0, 0, policy.state_size), np.float32)

    def begin(self, env: Exploration) -> None:
        """Remember nothing."""
        self._state = np.zeros((env.worlds, env.drones, self._policy.state_size), np.float32)

    def forget(self, worlds: NDArray[np.bool_]) -> None:
        """Drop what is remembered of these worlds."""
        self._state[worlds] = 0.0

    def act(self, env: Exploration, observation: Observation, worlds: NDArray[np.bool_] | None = None) -> Actions:
        """Return the policy's actions, the same for a world whichever others fly beside it."""
        rows, drones = env.worlds * env.drones, env.drones
        room = drones * max(env.worlds, math.ceil(_LEAST_ROWS / drones))
        arrays = {**observation.policy, STATE: self._state}
        if LEVEL in self._policy.inputs:
            arrays[LEVEL] = observation.critic
        flat = {}
        for key in self._policy.inputs:
            array = arrays[key]
            flat[key] = np.zeros((room, *array.shape[2:]), np.float32)
            flat[key][:rows] = array.reshape(rows, *array.shape[2:])
        flying = np.zeros(room, bool)
        flying[:rows] = env.alive.reshape(-1)
        actions, state = self._policy.act(flat, drones, flying)
        self._state = state[:rows].reshape(self._state.shape).copy()
        return np.clip(actions[:rows], -1.0, 1.0).reshape(env.worlds, drones, -1)


def policy_of(actor: Actor, name: str, env: ExplorationSettings | None = None) -> Policy:
    """Return a network's deterministic policy."""

    @torch.no_grad()
    def act(inputs: Arrays, drones: int, flying: NDArray[np.bool_]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        seen = {key: torch.from_numpy(value).to(actor.device) for key, value in inputs.items()}
        state = seen.pop(STATE, None)
        decisions = actor.decide({**seen, "alive": torch.from_numpy(flying).to(actor.device)}, state, drones=drones)
        return decisions.mean.cpu().numpy(), decisions.state.cpu().numpy()

    return Policy(name, act, env, actor.inputs, actor.state_size)


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

    outputs = [OUTPUT, NEXT_STATE] if contract.state_size else [OUTPUT]

    def run(inputs: Arrays) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        found = session.run(outputs, inputs)
        return found[0], found[1] if contract.state_size else np.zeros((len(found[0]), 0), np.float32)

    def act(inputs: Arrays, drones: int, flying: NDArray[np.bool_]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        if contract.paradigm != "ctce":
            return run(inputs)
        actions = np.zeros((len(flying), contract.action.size), np.float32)
        state = np.zeros((len(flying), contract.state_size), np.float32)
        for first in range(0, len(flying), drones):  # a batch is a team: those of it who still fly
            team = first + np.flatnonzero(flying[first : first + drones])
            if len(team):
                actions[team], state[team] = run({key: value[team] for key, value in inputs.items()})
        return actions, state

    env = ExplorationSettings(
        map=contract.map, limits=contract.limits, observation=contract.observation, action=contract.action,
        **_sensor(contract.lidar.spec(), path),
    )  # fmt: skip
    return Policy(contract.name, act, env, tuple(contract.inputs), contract.state_size)


def _sensor(spec: LidarSpec, path: Path) -> dict[str, Any]:
    """Return the settings of exploration that give this sensor. Raises InputError where no preset is like it."""
    for name, preset in PRESETS.items():
        if dataclasses.replace(preset, beams=spec.beams) == spec:
            return {"lidar": name, "lidar_beams": None if preset.beams == spec.beams else spec.beams}
    raise InputError(f"{path}: contract: lidar: no preset of the twin is like this sensor; known: {', '.join(PRESETS)}")
