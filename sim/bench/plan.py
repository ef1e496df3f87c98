"""What is measured of the batched step, and the flights it is measured in."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from imagine.core.errors import WorkError
from imagine.sim.exploration import Exploration
from imagine.sim.exploration_settings import ExplorationSettings

Results = dict[str, dict[str, Any]]
"""`{name: {value, unit, ...}}`."""
Flying = Literal["frontier", "random"]
Progress = Callable[[str], None]


@dataclass(frozen=True)
class BenchPlan:
    """What is measured: `worlds` and `drones` are the sizes tried, `seconds` the time for each thing compared."""

    level: str = "6"
    beams: tuple[int, ...] = (64, 360)
    worlds: tuple[int, ...] = (1, 4, 16, 64, 256, 1024)
    drones: tuple[int, ...] = (1, 2, 3, 4, 8, 16)
    seconds: float = 3.0
    rounds: int = 5
    compared_worlds: int = 64
    compared_drones: int = 3
    worlds_for_drones: int = 16
    episode_ticks: int = 400
    random_ticks: int = 60
    """How long drones at random have flown when they are measured."""
    growth_ticks: int = 12
    """How long those of all sizes have flown when they are measured."""
    memory_limit_bytes: float | None = None
    """No batch may take more; by default half of what is free."""
    copies: int = 4
    """Batches of few worlds, in which more or less happens to be in sight, are so many worlds together."""

    def settings(self, worlds: int, drones: int, beams: int, stagger: bool) -> ExplorationSettings:
        """Return what is explored: everything that training has on, but mirrored levels."""
        return ExplorationSettings(
            levels=(self.level,), worlds=worlds, drones=drones, lidar_beams=beams, stagger=stagger,
            episode_ticks=self.episode_ticks, mirror=False,
        )  # fmt: skip


def make_batch(
    plan: BenchPlan, worlds: int, drones: int, beams: int, seed: int = 0, stagger: bool = False
) -> Exploration:
    """Return worlds at their launch. Raises WorkError where they are not of the plan."""
    batch = Exploration(plan.settings(worlds, drones, beams, stagger), seed)
    if batch.lidar.beams != beams:
        raise WorkError(f"the batched step flies with {batch.lidar.beams} beams where {beams} are to be measured")
    batch.reset()
    return batch


def choose_actions(batch: Exploration, flying: Flying, generator: np.random.Generator) -> NDArray[np.float32]:
    """Return everyone's actions, `[worlds, drones, action size]`: the frontier planner's, or any."""
    if flying == "frontier":
        return np.nan_to_num(batch.planner_actions())
    shape = batch.worlds, batch.drones, batch.settings.action.size
    return generator.uniform(-1.0, 1.0, shape).astype(np.float32)
