"""The levels that a batch of worlds draws from, each in the eight ways that mirrors can show it."""

from __future__ import annotations

import itertools
from collections import OrderedDict
from collections.abc import Sequence
from weakref import WeakValueDictionary

import numpy as np
from numpy.typing import NDArray

from imagine.core.errors import InputError
from imagine.sim.level import Level, load_level, mirrored

_FLAGS = (False, True)
_MIRRORS = tuple(itertools.product(_FLAGS, _FLAGS, _FLAGS))
"""Axes swapped, turned round along x, along y; the first is the level as it is."""
_KEPT = 512
"""Mirrored levels that are kept with what was found out about them, about 0.2 MB each; others are made again."""


class LevelVariants:
    """Levels by number, and their variants (`mirror` False: one, the level itself), made when they are first asked for.

    `names` are the levels'; `rows` and `columns`, in cells, are what the largest of all variants takes.
    """

    def __init__(self, names: Sequence[str], mirror: bool) -> None:
        """Load the levels. Raises InputError naming the one that is wrong."""
        self.names = tuple(names)
        self._levels = [load_level(name) for name in names]
        self._mirrors = _MIRRORS if mirror else _MIRRORS[:1]
        self._recent: OrderedDict[tuple[int, int], Level] = OrderedDict()
        self._living: WeakValueDictionary[tuple[int, int], Level] = WeakValueDictionary()
        # A mirror may move the outline by a rounding, and so onto another tile: all are looked at, and not kept.
        grids = [self._make(level, flags).grid for level in self._levels for flags in self._mirrors]
        self.rows, self.columns = max(grid[3] for grid in grids), max(grid[2] for grid in grids)

    def __len__(self) -> int:
        """Return the number of levels."""
        return len(self._levels)

    def draw(self, generator: np.random.Generator, weights: NDArray[np.float64]) -> tuple[int, int]:
        """Draw a level by `weights` `[levels]`, which add up to 1, and one of its variants; return their numbers."""
        level = int(generator.choice(len(self._levels), p=weights))
        return level, int(generator.integers(len(self._mirrors)))

    def get(self, level: int, variant: int) -> Level:
        """Return a variant of a level; the same object for as long as anybody holds it."""
        if variant == 0:
            return self._levels[level]
        key = level, variant
        found = self._living.get(key)
        if found is None:
            found = self._living[key] = self._make(self._levels[level], self._mirrors[variant])
        self._recent[key] = found
        self._recent.move_to_end(key)
        if len(self._recent) > _KEPT:
            self._recent.popitem(last=False)
        return found

    @staticmethod
    def _make(level: Level, mirror: tuple[bool, bool, bool]) -> Level:
        return mirrored(level, *mirror) if any(mirror) else level


def level_shares(weights: Sequence[float] | None, levels: int) -> NDArray[np.float64]:
    """Return the shares `[levels]` of episodes that `weights` give; equal ones where it is None. Raises InputError."""
    given = np.array((1.0,) * levels if weights is None else tuple(weights), float)
    if given.shape != (levels,) or not np.isfinite(given).all() or (given < 0).any() or given.sum() <= 0:
        raise InputError("level_weights: give one weight for each of levels, none negative, not all zero")
    return np.asarray(given / given.sum())
