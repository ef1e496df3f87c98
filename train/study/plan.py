"""From a study to the list of its trials, every one of them checked before the first starts."""

from __future__ import annotations

import itertools
import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from imagine.core.errors import InputError
from imagine.train.curriculum import Curriculum
from imagine.train.settings import TrainSettings, load_train_settings
from imagine.train.study.settings import StudySettings

MOST_TRIALS = 10_000


@dataclass(frozen=True)
class Trial:
    """One training run of a study.

    `condition` names what it shares with its repeats, `parameters` holds that by setting (`variant` for a variant's
    name); `settings` are complete.
    """

    name: str
    condition: str
    parameters: dict[str, Any]
    seed: int
    settings: TrainSettings


def plan_trials(study: StudySettings) -> list[Trial]:
    """Return the trials in the order they start: the first repeat of everything, then the second, and so on.

    Equal studies give equal lists: draws come from the study's seed. Repeats of all combinations have the same seeds,
    so that differences between combinations are seen in pairs. Raises InputError naming the combination whose settings
    are wrong.
    """
    combinations = _combinations(study)
    if len(combinations) * study.repeats > MOST_TRIALS:
        raise InputError(f"study {study.name}: more than {MOST_TRIALS} trials; narrow its grid")
    return [
        _trial(study, repeat * len(combinations) + index, variant, parameters, study.seed + repeat)
        for repeat in range(study.repeats)
        for index, (variant, parameters) in enumerate(combinations)
    ]


def _combinations(study: StudySettings) -> list[tuple[tuple[str, ...], dict[str, Any]]]:
    """Return overrides that go together, and the parameters they are told by, for every combination."""
    rng = np.random.default_rng(study.seed)
    space = study.parameters.space
    draws = [{key: space[key].draw(rng) for key in space} for _ in range(study.samples)]
    grid = study.parameters.grid
    variants = [(variant.set, {"variant": variant.name}) for variant in study.variants] or [((), {})]
    points = [dict(zip(grid, values, strict=True)) for values in itertools.product(*grid.values())]
    return [
        (overrides, {**name, **point, **draw})
        for (overrides, name), point, draw in itertools.product(variants, points, draws)
    ]


def _trial(
    study: StudySettings, number: int, overrides: tuple[str, ...], parameters: dict[str, Any], seed: int
) -> Trial:
    told = [f"{key}={json.dumps(value)}" for key, value in parameters.items() if key != "variant"]
    condition = ", ".join(
        str(value) if key == "variant" else f"{key}={_short(value)}" for key, value in parameters.items()
    )
    name = _name(number, parameters, seed)
    decided = (
        f"run.name={name}",
        f"run.root={json.dumps(str(study.folder / 'trials'))}",
        f"run.seed={seed}",
        f"run.threads={study.resources.cpus}",
    )
    try:
        settings = load_train_settings(Path(study.base), (*study.set, *overrides, *told, *decided))
        Curriculum(settings.curriculum, settings.env)  # lessons that no episode could pass
    except InputError as error:
        raise InputError(f"study {study.name}: {condition or 'its only combination'}: {error}") from error
    return Trial(name, condition or "as configured", parameters, seed, _stopped_at(settings, study.stop.agent_steps))


def _stopped_at(settings: TrainSettings, agent_steps: int | None) -> TrainSettings:
    """Return settings that end at so many agent-steps of imitation and PPO, the first first; without rehearsal."""
    if agent_steps is None:
        return settings
    imitated = min(settings.imitation.agent_steps, agent_steps)
    return settings.model_copy(
        update={
            "imitation": settings.imitation.model_copy(update={"agent_steps": imitated}),
            "ppo": settings.ppo.model_copy(update={"agent_steps": agent_steps - imitated}),
            "rehearsal": settings.rehearsal.model_copy(update={"agent_steps": 0}),
        }
    )


def total_steps(settings: TrainSettings) -> int:
    """Return the agent-steps after which a trial has trained."""
    return settings.imitation.agent_steps + settings.ppo.agent_steps + settings.rehearsal.agent_steps


def _short(value: Any) -> str:
    """Return a value as it stands in a condition."""
    return "+".join(map(str, value)) if isinstance(value, list | tuple) else str(value)


def _name(number: int, parameters: dict[str, Any], seed: int) -> str:
    """Return a name that a run folder may have: number, values, seed; long ones are cut, the number tells them apart.

    Of a setting's key the last part is enough.
    """
    parts = [str(v) if key == "variant" else f"{key.rpartition('.')[2]}-{_short(v)}" for key, v in parameters.items()]
    middle = re.sub(r"[^A-Za-z0-9._-]+", "-", "-".join(parts))[:56].strip("-.")
    return "-".join(part for part in (f"{number:04d}", middle, f"seed{seed}") if part)
