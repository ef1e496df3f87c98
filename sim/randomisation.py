"""Settings that are a number, or a range to draw one from for every episode."""

from __future__ import annotations

import math

import numpy as np
from pydantic import AfterValidator

Quantity = float | tuple[float, float]
"""A number, or a range (low, high)."""


def within(least: float, most: float) -> AfterValidator:
    """Return a check that a number, or both ends of a range, lie within bounds, the lower end first."""

    def check(value: Quantity) -> Quantity:
        low, high = ends(value)
        if not least <= low <= high <= most:
            raise ValueError(f"give a number, or a range [low, high], within {least:g} and {most:g}, lowest first")
        return value

    return AfterValidator(check)


def positive() -> AfterValidator:
    """Return a check that a number, or both ends of a range, are greater than 0, the lower end first."""

    def check(value: Quantity) -> Quantity:
        low, high = ends(value)
        if not 0.0 < low <= high < math.inf:
            raise ValueError("give a number, or a range [low, high], greater than 0, lowest first")
        return value

    return AfterValidator(check)


def ends(value: Quantity) -> tuple[float, float]:
    """Return the range's ends; of a number twice itself."""
    return value if isinstance(value, tuple) else (value, value)


def draw(value: Quantity, rng: np.random.Generator | None) -> float:
    """Return a number from a range, equally likely anywhere in it; its middle without a generator.

    A plain number is returned as it is and takes nothing from the generator.
    """
    if not isinstance(value, tuple):
        return value
    low, high = value
    return (low + high) / 2.0 if rng is None else float(rng.uniform(low, high))
