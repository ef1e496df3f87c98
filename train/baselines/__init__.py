"""Frontier baselines that a policy is measured against, and taught by: `baseline(name, seed)` makes one as a pilot."""

from __future__ import annotations

import difflib
from collections.abc import Callable

import numpy as np

from imagine.core.errors import InputError
from imagine.train.baselines.clairvoyant import ClairvoyantPilot
from imagine.train.baselines.parameters import COORDINATED, HUNGARIAN, NEAREST
from imagine.train.baselines.pilot import FrontierPilot
from imagine.train.pilots import Pilot, RandomPilot

BASELINES: dict[str, Callable[[int], Pilot]] = {
    "random": lambda seed: RandomPilot(np.random.default_rng(seed)),
    "frontier": lambda seed: FrontierPilot("frontier", NEAREST),
    "coordinated": lambda seed: FrontierPilot("coordinated", COORDINATED),
    "hungarian": lambda seed: FrontierPilot("hungarian", HUNGARIAN, "hungarian"),
    "clairvoyant": ClairvoyantPilot,
}
"""What makes each baseline, given a seed; only chance, and the search for clairvoyant plans, use it."""


def baseline(name: str, seed: int) -> Pilot:
    """Return a new baseline by its name. Raises InputError on an unknown one, with the nearest there is."""
    if name not in BASELINES:
        near = difflib.get_close_matches(name, BASELINES, 1, 0.0)
        raise InputError(f"{name}: no such baseline: did you mean {near[0]}? There are {', '.join(BASELINES)}")
    return BASELINES[name](seed)
