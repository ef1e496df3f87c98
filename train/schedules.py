"""Numbers that change while a run goes on: constant, linear or cosine, by the share of the run that is done."""

from __future__ import annotations

import math
from typing import Any, Literal, Self

from pydantic import Field, model_validator

from imagine.core.config import Settings


class Schedule(Settings):
    """From `start` to `end` over a run's progress, 0 to 1; a bare number in its place is a constant.

    The end is reached at progress `until` and kept from there on. `cosine` leaves the start slowly and comes slowly to
    the end (half a wave, after Loshchilov and Hutter 2017, without restarts).
    """

    start: float
    end: float | None = Field(default=None, description="none: as at the start, always")
    shape: Literal["linear", "cosine"] = "linear"
    until: float = Field(default=1.0, gt=0.0, le=1.0, description="progress at which the end is reached")

    @model_validator(mode="before")
    @classmethod
    def _of_a_number(cls, data: Any) -> Any:
        return {"start": data} if isinstance(data, int | float) and not isinstance(data, bool) else data

    def at(self, progress: float) -> float:
        """Return the value at a progress, which is taken to lie in [0, 1]."""
        if self.end is None:
            return self.start
        share = min(max(progress, 0.0), 1.0) / self.until
        share = min(share, 1.0)
        if self.shape == "cosine":
            share = 0.5 - 0.5 * math.cos(math.pi * share)
        return self.start + share * (self.end - self.start)


class PositiveSchedule(Schedule):
    """A schedule whose values are all above 0, such as a step size or a standard deviation."""

    @model_validator(mode="after")
    def _positive(self) -> Self:
        if self.start <= 0.0 or (self.end is not None and self.end <= 0.0):
            raise ValueError("start and end have to be above 0")
        return self


class WeightSchedule(Schedule):
    """A schedule whose values are 0 or above, such as a weight in a loss."""

    @model_validator(mode="after")
    def _not_negative(self) -> Self:
        if self.start < 0.0 or (self.end is not None and self.end < 0.0):
            raise ValueError("start and end have to be 0 or above")
        return self
