"""Draws that stay the same on every machine and with every version of numpy."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np

T = TypeVar("T")


class Dice:
    """Draws from a generator by its uniform numbers alone, which numpy keeps the same from version to version."""

    def __init__(self, generator: np.random.Generator) -> None:
        """Draw from this generator."""
        self._generator = generator

    def between(self, low: float, high: float) -> float:
        """Return a number from low to high, rounded to centimetres."""
        return round(low + (high - low) * float(self._generator.random()), 2)

    def chance(self, probability: float) -> bool:
        """Return True with this probability."""
        return float(self._generator.random()) < probability

    def pick(self, items: Sequence[T]) -> T:
        """Return one of some items."""
        return items[min(int(float(self._generator.random()) * len(items)), len(items) - 1)]

    def unit(self) -> float:
        """Return a number from 0 to 1."""
        return float(self._generator.random())
