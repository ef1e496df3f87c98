"""Checkpoints: everything a run needs to go on, in one file that is read without running any code in it."""

from __future__ import annotations

import json
import pickle
import zipfile
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import torch
from torch import Tensor, nn

from imagine.core.config import check_settings
from imagine.core.errors import InputError
from imagine.train.atomic_file import write_atomically
from imagine.train.networks import Actor, steers
from imagine.train.settings import TrainSettings

FORMAT = "imagine-checkpoint-1"
Phase = Literal["imitation", "ppo", "rehearsal"]
PHASES: tuple[Phase, ...] = get_args(Phase)


@dataclass
class Checkpoint:
    """The state of a run. Weights and optimisers are torch state dicts; `env` is the environment's own state,
    `progress` that of the curriculum, of recent episodes and of what drones remember.

    `agent_steps` counts decisions by phase, `wall_s` the seconds of training so far.
    """

    settings: TrainSettings
    phase: Phase
    agent_steps: dict[str, int]
    updates: int
    wall_s: float
    actor: dict[str, Tensor]
    critic: dict[str, Tensor]
    optimisers: dict[str, dict[str, Any]]
    rngs: dict[str, Any]
    env: Any = None
    progress: dict[str, Any] = field(default_factory=dict)
    record: dict[str, Any] = field(default_factory=dict)


def save_checkpoint(checkpoint: Checkpoint, path: Path) -> None:
    """Write a checkpoint atomically. Raises WorkError when the disk is full."""
    content = {key.name: getattr(checkpoint, key.name) for key in fields(Checkpoint)}
    content["settings"] = checkpoint.settings.model_dump_json()
    content["record"] = json.dumps(checkpoint.record)
    content["rngs"] = pack(checkpoint.rngs)
    content["env"] = pack(checkpoint.env)
    content["progress"] = pack(checkpoint.progress)
    content["format"] = FORMAT
    write_atomically(path, lambda temporary: torch.save(content, temporary))


def load_checkpoint(path: Path) -> Checkpoint:
    """Read a checkpoint. Raises InputError when it is missing, corrupt, or not one of this project's."""
    if path.is_dir():
        path = path / "checkpoints" / "latest.pt"
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    except (pickle.UnpicklingError, RuntimeError, EOFError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: not a checkpoint, or a damaged one; take another one of the run") from error
    if not isinstance(content, dict) or content.pop("format", None) != FORMAT:
        raise InputError(f"{path}: not a checkpoint of this project's training (no '{FORMAT}' in it)")
    names = {key.name for key in fields(Checkpoint)}
    if set(content) != names:
        raise InputError(f"{path}: damaged checkpoint: without {', '.join(sorted(names - set(content)))}")
    settings = check_settings(TrainSettings, json.loads(content["settings"]), where=f"{path}: settings")
    return Checkpoint(
        **{
            **content,
            "settings": settings,
            "record": json.loads(content["record"]),
            "rngs": unpack(content["rngs"]),
            "env": unpack(content["env"]),
            "progress": unpack(content["progress"]),
        }
    )


def load_weights(network: nn.Module, weights: dict[str, Tensor], where: str) -> None:
    """Put a checkpoint's weights into a network. Raises InputError naming the first tensor that does not fit."""
    own = network.state_dict()
    for name in dict.fromkeys((*own, *weights)):
        if name not in weights:
            raise InputError(f"{where}: made for another network: it has no '{name}'")
        if name not in own:
            raise InputError(f"{where}: made for another network: '{name}' has no place in this one")
        if own[name].shape != weights[name].shape:
            has, needs = tuple(weights[name].shape), tuple(own[name].shape)
            raise InputError(f"{where}: made for another network: '{name}' is {has}, this one needs {needs}")
    network.load_state_dict(weights)


_NOT_OF_THE_WEIGHTS = ("log_std", "choice_momentum", "decision_ticks")
"""Where learning began, and what is of flight alone."""


def check_same_network(checkpoint: Checkpoint, settings: TrainSettings, where: str) -> None:
    """Raise InputError naming the first setting in which a checkpoint's networks, or how they learn, are others."""
    was = checkpoint.settings
    for key, has, needs in (
        ("ppo.decision_ticks", was.practice.action.decision_ticks, settings.practice.action.decision_ticks),
        ("ppo.choice_momentum", was.practice_momentum, settings.practice_momentum),
    ):
        if has != needs:
            raise InputError(f"{where}: learned with {key} {has}, not {needs}: leave it as it was, or begin a new run")
    for group, saved, wanted in (
        ("network", checkpoint.settings.network, settings.network),
        ("env.observation", checkpoint.settings.env.observation, settings.env.observation),
        ("env.action", checkpoint.settings.env.action, settings.env.action),
    ):
        for name in type(saved).model_fields:
            has, needs = getattr(saved, name), getattr(wanted, name)
            if has != needs and name not in _NOT_OF_THE_WEIGHTS:
                raise InputError(
                    f"{where}: made for another network: {group}.{name} is {has} in it, {needs} here; "
                    "leave the setting as it was, or train anew"
                )


def actor_of(checkpoint: Checkpoint, where: str) -> Actor:
    """Return the policy of a checkpoint, ready to fly."""
    settings = checkpoint.settings
    observation, action = settings.env.observation, settings.env.action
    actor = Actor(settings.network, observation, action.size, steers(observation, action))
    load_weights(actor, checkpoint.actor, where)
    return actor.eval()


def pack(value: Any) -> Any:
    """Turn numpy arrays and large integers inside plain containers into what a safe checkpoint may hold."""
    if isinstance(value, np.ndarray):
        return {"__array__": torch.from_numpy(np.ascontiguousarray(value).copy())}
    if isinstance(value, np.generic):
        return pack(value.item())
    if isinstance(value, dict):
        return {key: pack(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return {"__list__": [pack(item) for item in value], "tuple": isinstance(value, tuple)}
    if isinstance(value, int) and not isinstance(value, bool) and abs(value) >= 2**63:
        return {"__int__": str(value)}  # generators have 128-bit states
    return value


def unpack(value: Any) -> Any:
    """Undo `pack`."""
    if not isinstance(value, dict):
        return value
    if "__array__" in value:
        return value["__array__"].numpy()
    if "__list__" in value:
        items = [unpack(item) for item in value["__list__"]]
        return tuple(items) if value["tuple"] else items
    if "__int__" in value:
        return int(value["__int__"])
    return {key: unpack(item) for key, item in value.items()}
