"""What a run's policy comes to on its levels, flown once training has ended, and kept beside the checkpoints."""

from __future__ import annotations

import json
import logging
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from imagine.sim.generator import is_generated
from imagine.train.atomic_file import write_atomically
from imagine.train.evaluation import evaluate
from imagine.train.policies import Policy
from imagine.train.settings import TrainSettings

logger = logging.getLogger(__name__)

_MOST_HOUSES = 5


class _BrokenOff(Exception):
    """Whoever waits for the evaluation has asked for an end."""


def write_final_evaluation(
    folder: Path, policy: Policy, settings: TrainSettings, levels: Sequence[str], told: dict[str, Any],
    stop: threading.Event,
) -> None:  # fmt: skip
    """Evaluate a policy on the levels of its run and write the rows, with what is `told` of it, as evaluation.json.

    Episodes end as in `imagine evaluate`, though those of the training may have ended sooner (env.stop_coverage). Once
    `stop` is set it is broken off before the next level and nothing written. Raises WorkError where the disk is full.
    """

    def go_on(_level: str) -> None:
        if stop.is_set():
            raise _BrokenOff

    try:
        rows = evaluate(
            policy,
            levels=evaluated_levels(levels),
            drones=(settings.env.drones,),
            protocol=settings.env.protocol,
            episodes=settings.run.final_episodes,
            seed=settings.run.seed + 1,
            progress=go_on,
        )
    except _BrokenOff:
        logger.warning("trained to the end; its evaluation was broken off: imagine evaluate makes up for it")
        return
    text = json.dumps({**told, "rows": rows}, indent=2)
    write_atomically(folder / "evaluation.json", lambda file: file.write_text(text + "\n", "utf-8"))


def evaluated_levels(levels: Sequence[str]) -> list[str]:
    """Return those of a run's levels that are flown at its end: all, but of generated houses only the first few."""
    houses = [level for level in levels if is_generated(level)]
    return sorted({level for level in levels if level not in houses} | set(houses[:_MOST_HOUSES]))
