"""Rehearsal: after PPO a policy learns to fly known levels by heart, and everything else as it did.

PPO keeps a plan of a whole flight no better than it finds one: its chance blurs what has to be done exactly. So the
last lessons are labels again. From a level's own launch point `clairvoyant` gives them, which plans by the true level;
anywhere else, and in generated houses, of which there are too many to be known, the policy itself, as it came from PPO;
and where nearly all is seen a planner, which leaves no corner out.
"""

from __future__ import annotations

from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from imagine.sim.exploration import Exploration, Observation
from imagine.sim.exploration_settings import ExplorationSettings
from imagine.sim.generator import is_generated
from imagine.sim.level_names import expand_levels
from imagine.train.imitation import LabelSettings, Teacher
from imagine.train.pilots import Actions, Pilot


class RehearsalSettings(LabelSettings):
    """How long and by whom a policy is taught after PPO."""

    agent_steps: int = Field(default=0, ge=0, description="decisions of all drones; 0 leaves rehearsal out")
    known_share: float | None = Field(
        default=None, ge=0.0, le=1.0,
        description="share of episodes in levels that can be known, which generated houses are not; none: as in PPO",
    )  # fmt: skip
    as_designed: float | None = Field(
        default=None, ge=0.0, le=1.0, description="as env.as_designed; none: as in PPO"
    )  # fmt: skip
    launch_point_teacher: Teacher = Field(
        default="clairvoyant",
        description="who labels what began at the launch point of a level as it is, but for generated houses",
    )
    late_teacher: Teacher = Field(default="coordinated", description="who labels worlds that are nearly explored")
    late_coverage: float = Field(default=0.92, gt=0.0, le=1.0, description="share seen from which on it does")
    stop_coverage: float = Field(default=0.985, gt=0.0, le=1.0, description="share seen that ends an episode")
    student_draws: bool = Field(default=False, description="the student flies what it draws, not its best")
    planner_share: float = Field(default=0.5, ge=0.0, le=1.0, description="drones the teachers fly in round one")

    def environment(self, env: ExplorationSettings) -> ExplorationSettings:
        """Return what is flown in, by the environment of PPO."""
        changes: dict[str, Any] = {"stop_coverage": self.stop_coverage}
        if self.as_designed is not None:
            changes["as_designed"] = self.as_designed
        levels, weights = expand_levels(env.levels, env.level_weights)
        known = np.array([not is_generated(level) for level in levels])
        shares, share = np.array(weights), self.known_share
        if share is not None and shares[known].any() and shares[~known].any():
            shares[known] *= share / shares[known].sum()
            shares[~known] *= (1.0 - share) / shares[~known].sum()
            changes |= {"levels": levels, "level_weights": tuple(shares.tolist())}
        return env.model_copy(update=changes)

    @model_validator(mode="after")
    def _late_comes_before_the_end(self) -> Self:
        if self.late_coverage >= self.stop_coverage:
            raise ValueError(
                f"rehearsal.late_coverage {self.late_coverage} is not below stop_coverage {self.stop_coverage}: "
                "the late teacher would never be asked"
            )
        return self


class RehearsalPilot:
    """Advises each world by one of three pilots, as `RehearsalSettings` tells."""

    name = "rehearsal"

    def __init__(self, policy: Pilot, at_launch_point: Pilot, late: Pilot, late_coverage: float) -> None:
        """Make a pilot that has yet to begin."""
        self._pilots = policy, at_launch_point, late
        self._late_coverage = late_coverage
        self.by_reference: NDArray[np.bool_] = np.zeros(0, np.bool_)
        """Whose worlds the policy advised last, `[worlds]`."""

    def begin(self, env: Exploration) -> None:
        """Let all begin."""
        for pilot in self._pilots:
            pilot.begin(env)

    def forget(self, worlds: NDArray[np.bool_]) -> None:
        """Let all forget these worlds."""
        for pilot in self._pilots:
            pilot.forget(worlds)

    def act(self, env: Exploration, observation: Observation, worlds: NDArray[np.bool_] | None = None) -> Actions:
        """Return the actions of the pilot whose world it is, `[worlds, drones, action size]`; nan where it has none."""
        late = env.maps.coverage() >= self._late_coverage
        houses = np.array([is_generated(level.name) for level in env.twin.levels])
        designed = env.as_designed & ~late & ~houses
        self.by_reference = ~late & ~designed
        wanted = np.ones(env.worlds, np.bool_) if worlds is None else worlds
        actions = np.full((env.worlds, env.drones, env.settings.action.size), np.nan, np.float32)
        for pilot, its in zip(self._pilots, (~late & ~designed, designed, late), strict=True):
            if (its & wanted).any():
                actions[its] = pilot.act(env, observation, its & wanted)[its]
        actions[~env.alive] = np.nan  # a policy says something for the dead as well
        return actions
