"""What a curriculum is made of: lessons, when one is passed, and what is still drawn from those behind."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from imagine.core.config import Settings
from imagine.core.errors import InputError
from imagine.sim.level_names import MOST_LEVELS, expand_levels


class HousePlans(Settings):
    """Generated houses, one for each seed; areas are spread over a range as `house:FIRST-LAST:LOW-HIGH` does."""

    count: int = Field(ge=1, le=MOST_LEVELS, description="how many houses")
    first_seed: int = Field(default=0, ge=0, le=2**62, description="seed of the first; the others follow")
    area_m2: tuple[float, float] | None = Field(
        default=None, description="least and greatest floor area, m²; left out: as each seed draws it"
    )
    weight: float = Field(default=1.0, gt=0.0, description="share of the lesson's episodes, of all houses together")

    @property
    def name(self) -> str:
        """The range of levels that these are."""
        seeds = f"house:{self.first_seed}-{self.first_seed + self.count - 1}"
        return seeds if self.area_m2 is None else f"{seeds}:{self.area_m2[0]:.12g}-{self.area_m2[1]:.12g}"


class Lesson(Settings):
    """Levels that are learned together, and when they are passed; what is left out is as for all lessons."""

    name: str = Field(default="", max_length=40, description="for people; left out: its number, from 1")
    levels: tuple[str, ...] = Field(default=(), description="names or ranges of levels, as in env.levels")
    level_weights: tuple[float, ...] | None = Field(
        default=None, description="share of the lesson's episodes, one for each of levels; left out: all alike"
    )
    houses: HousePlans | None = Field(default=None, description="generated houses beside the levels")
    weight: float = Field(default=1.0, gt=0.0, description="share of episodes among lessons that are drawn together")
    pass_area: float | None = Field(default=None, gt=0.0, le=1.0, description="as of the curriculum, for this lesson")
    pass_x_times: int | None = Field(default=None, ge=1, description="as of the curriculum, for this lesson")
    max_agent_steps: int | None = Field(default=None, ge=1, description="as of the curriculum, for this lesson")

    @model_validator(mode="after")
    def _has_levels(self) -> Lesson:
        if not self.levels and self.houses is None:
            raise ValueError("a lesson needs levels, or houses")
        try:
            self.shares()
        except InputError as error:
            raise ValueError(str(error)) from error
        return self

    def shares(self) -> dict[str, float]:
        """Return each level's share of the lesson's episodes, by name; they add up to 1."""
        names, weights = list(self.levels), list(self.level_weights or (1.0,) * len(self.levels))
        if len(weights) != len(names):
            raise InputError("level_weights: give one weight for each of the lesson's levels")
        if self.houses is not None:
            names.append(self.houses.name)
            weights.append(self.houses.weight)
        shares: dict[str, float] = {}
        for level, share in zip(*expand_levels(names, weights, "level"), strict=True):
            shares[level] = shares.get(level, 0.0) + share
        return shares


class CurriculumSettings(Settings):
    """Lessons, one after another or side by side; off: `env.levels` are flown throughout."""

    mode: Literal["off", "sequential", "parallel"] = Field(
        default="off", description="sequential: one lesson after another; parallel: all, passed ones ever less"
    )
    lessons: tuple[Lesson, ...] = Field(default=(), description="with lessons these take the place of env.levels")
    pass_area: float = Field(default=0.9, gt=0.0, le=1.0, description="coverage with which an episode is passed")
    pass_x_times: int = Field(default=20, ge=1, description="episodes to be passed in a row, until a lesson is passed")
    keep_earlier: float = Field(
        default=0.2, ge=0.0, lt=1.0,
        description="against forgetting: share of episodes from passed lessons (parallel: of what they had before)",
    )  # fmt: skip
    max_agent_steps: int | None = Field(
        default=None, ge=1, description="decisions after which a lesson is given up and left; left out: never"
    )

    @model_validator(mode="after")
    def _has_lessons(self) -> CurriculumSettings:
        if self.mode != "off" and not self.lessons:
            raise ValueError(f"curriculum.lessons: a {self.mode} curriculum needs at least one lesson")
        names = [self.name_of(number) for number in range(len(self.lessons))]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"curriculum.lessons: two are called '{name}': give each a name of its own")
        return self

    def name_of(self, lesson: int) -> str:
        """Return what a lesson, counted from 0, is called."""
        return self.lessons[lesson].name or str(lesson + 1)
