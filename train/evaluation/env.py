"""The environment that policies are evaluated in: the one they were made for, with what `--set` changes."""

from __future__ import annotations

from collections.abc import Sequence

from pydantic import Field

from imagine.core.config import Settings, apply_overrides, check_settings
from imagine.core.contract import ActionSpec
from imagine.core.errors import InputError
from imagine.core.observation_spec import ObservationSpec
from imagine.sim.exploration_settings import ExplorationSettings
from imagine.train.evaluation.contenders import Contender

_EVALUATED = {
    "levels": "give --levels", "drones": "give --drones", "protocol": "give --protocol", "worlds": "give --episodes",
    "level_weights": "every level has as many episodes", "mirror": "give --launch", "random_launch": "give --launch",
    "as_designed": "give --launch", "stagger": "episodes are flown whole",
}  # fmt: skip
"""Settings that an evaluation decides itself, and what to do or know instead."""
_STOP_COVERAGE = ExplorationSettings().stop_coverage  # episodes of a training may end sooner
_PART_OF_THE_POLICY = ("observation", "action")
_PART_OF_THE_DRONE = ("map", "limits", "lidar", "lidar_beams")


class EvaluationSettings(Settings):
    """What `imagine evaluate --set` overrides: as in a training configuration, the environment is `env`."""

    env: ExplorationSettings = Field(default_factory=ExplorationSettings)


def evaluation_env(contender: Contender, overrides: Sequence[str] = ()) -> ExplorationSettings:
    """Return what a policy was made for, or the defaults for a planner, with `env.key=value` overrides laid over it.

    Raises InputError on an unknown key, with the nearest right one; on a setting that the evaluation decides itself;
    and where a policy would get other observations, or other meanings of its actions, than those it was made for.
    """
    made_for = contender.env or ExplorationSettings()
    base = EvaluationSettings(env=made_for.model_copy(update={"stop_coverage": _STOP_COVERAGE}))
    changed = check_settings(EvaluationSettings, apply_overrides(base.model_dump(), overrides), "--set").env
    for override in overrides:
        group, _, key = override.partition("=")[0].strip().partition(".")
        key = key.partition(".")[0]
        if group == "env" and key in _EVALUATED:
            raise InputError(f"--set {override:.80}: an evaluation sets {key} itself: {_EVALUATED[key]}")
    for name in _PART_OF_THE_POLICY:
        if contender.env is not None and getattr(changed, name) != getattr(base.env, name):
            raise InputError(
                f"--set env.{name}: {contender.name} was made for another one: leave it, or train for this"
            )
    return changed


def shared_envs(contenders: Sequence[Contender], overrides: Sequence[str] = ()) -> list[ExplorationSettings]:
    """Return an environment for each contender, alike in everything but what a policy sees and how it acts.

    The first network's is everyone's. Planners need no observation, and decide anew in every tick, which suits them
    best, at the network's speed. Raises InputError as `evaluation_env` does, and where
    networks were made for drones of different sensors, maps or limits: then their episodes could not be the same.
    """
    networks = [contender for contender in contenders if not contender.is_baseline]
    base = evaluation_env(networks[0] if networks else contenders[0], overrides)
    envs = []
    for contender in contenders:
        if contender.env is None and networks:
            action = ActionSpec(speed_mps=base.action.speed_mps)
            envs.append(base.model_copy(update={"action": action, "observation": ObservationSpec()}))
            continue
        if not networks or contender is networks[0]:
            envs.append(base)
            continue
        own = evaluation_env(contender, overrides)
        for name in _PART_OF_THE_DRONE:
            if getattr(own, name) != getattr(base, name):
                raise InputError(
                    f"--policy {contender.given}: was made for another {name} than {networks[0].name}, so their "
                    f"episodes cannot be the same: evaluate them apart, or give --set env.{name}"
                )
        envs.append(base.model_copy(update={name: getattr(own, name) for name in _PART_OF_THE_POLICY}))
    return envs
