"""Distributions that a study draws values of settings from."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from pydantic import Field, model_validator

from imagine.core.config import Settings


class Distribution(Settings):
    """Where a setting's values are drawn from: exactly one of the four."""

    uniform: tuple[float, float] | None = Field(default=None, description="least and greatest value")
    loguniform: tuple[float, float] | None = Field(default=None, description="the same, uniform in the logarithm")
    randint: tuple[int, int] | None = Field(default=None, description="whole numbers, both ends among them")
    choice: tuple[Any, ...] | None = Field(default=None, min_length=1, description="values, equally likely")

    @model_validator(mode="after")
    def _one_of_them(self) -> Distribution:
        given = [name for name in type(self).model_fields if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(f"give exactly one of {', '.join(type(self).model_fields)}, not {len(given)}")
        for name in ("uniform", "loguniform", "randint"):
            ends = getattr(self, name)
            if ends is not None and not ends[0] < ends[1]:
                raise ValueError(f"{name}: the first number must be less than the second")
        if self.loguniform is not None and self.loguniform[0] <= 0.0:
            raise ValueError("loguniform: both numbers must be above 0")
        return self

    def draw(self, rng: np.random.Generator) -> Any:
        """Return one value; numbers have four significant figures, so that they can be read and typed."""
        if self.choice is not None:
            return self.choice[int(rng.integers(len(self.choice)))]
        if self.randint is not None:
            return int(rng.integers(self.randint[0], self.randint[1], endpoint=True))
        if self.uniform is not None:
            low, high = self.uniform
            return _inside(float(rng.uniform(low, high)), low, high)
        assert self.loguniform is not None  # the validator leaves no other case
        low, high = self.loguniform
        return _inside(math.exp(float(rng.uniform(math.log(low), math.log(high)))), low, high)


def _inside(value: float, low: float, high: float) -> float:
    return min(max(float(f"{value:.4g}"), low), high)
