"""The environment that a policy is evaluated in: the one it was made for, with what `--set` changes."""

from __future__ import annotations

from collections.abc import Sequence

from pydantic import Field

from imagine.core.config import Settings, apply_overrides, check_settings
from imagine.core.errors import InputError
from imagine.sim.exploration_settings import ExplorationSettings
from imagine.train.policies import Policy

_EVALUATED = {
    "levels": "give --levels", "drones": "give --drones", "protocol": "give --protocol", "worlds": "give --episodes",
    "level_weights": "every level has as many episodes", "mirror": "levels are flown as they are drawn",
    "random_launch": "drones start at the level's launch point", "stagger": "episodes are flown whole",
}  # fmt: skip
"""Settings that an evaluation decides itself, and what to do or know instead."""


class EvaluationSettings(Settings):
    """What `imagine evaluate --set` overrides: as in a training configuration, the environment is `env`."""

    env: ExplorationSettings = Field(default_factory=ExplorationSettings)


def evaluation_env(policy: Policy | str, overrides: Sequence[str] = ()) -> ExplorationSettings:
    """Return what a policy was made for, or the defaults for a planner, with `env.key=value` overrides laid over it.

    Raises InputError on an unknown key, with the nearest right one; on a setting that the evaluation decides itself;
    and where a policy would get other observations, or other meanings of its actions, than those it was made for.
    """
    made_for = policy.env if isinstance(policy, Policy) else None
    base = EvaluationSettings(env=made_for or ExplorationSettings())
    changed = check_settings(EvaluationSettings, apply_overrides(base.model_dump(), overrides), "--set").env
    for override in overrides:
        group, _, key = override.partition("=")[0].strip().partition(".")
        key = key.partition(".")[0]
        if group == "env" and key in _EVALUATED:
            raise InputError(f"--set {override:.80}: an evaluation sets {key} itself: {_EVALUATED[key]}")
    for name in ("observation", "action"):
        if isinstance(policy, Policy) and getattr(changed, name) != getattr(base.env, name):
            raise InputError(f"--set env.{name}: {policy.name} was made for another one: leave it, or train for this")
    return changed
