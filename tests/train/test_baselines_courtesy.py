"""Two drones that meet pass each other on the right; nobody else is turned aside."""

from __future__ import annotations

import math

import numpy as np
import pytest

from imagine.sim.air import NEVER, PEER
from imagine.train.baselines.courtesy import keep_right


def peers(x: float, y: float, vx: float, vy: float, tick: int = 100) -> np.ndarray:
    """Return what drone 0 of two knows of drone 1."""
    told = np.zeros(2, PEER)
    told["pose_tick"] = NEVER
    told[1]["x"], told[1]["y"], told[1]["vx"], told[1]["vy"], told[1]["pose_tick"] = x, y, vx, vy, tick
    return told


@pytest.mark.parametrize("bearing", [0.0, 2.0, -1.1])
def test_of_two_that_meet_each_turns_right_and_the_more_the_nearer(bearing: float) -> None:
    ux, uy = math.cos(bearing), math.sin(bearing)
    turns = []
    for distance in (1.2, 0.8, 0.5):
        told = peers(distance * ux, distance * uy, -0.8 * ux, -0.8 * uy)
        dx, dy = keep_right(ux, uy, 0, 0.0, 0.0, told, 100, 10.0, 0.8)
        assert math.hypot(dx, dy) == pytest.approx(1.0)
        turns.append(math.remainder(bearing - math.atan2(dy, dx), math.tau))
    assert 0.0 < turns[0] < turns[1] < turns[2] <= math.pi / 4


@pytest.mark.parametrize(
    ("told", "why"),
    [
        (peers(1.0, 0.0, 0.8, 0.0), "flies ahead in the same direction"),
        (peers(-1.0, 0.0, 0.8, 0.0), "is behind"),
        (peers(2.0, 0.0, -0.8, 0.0), "is far"),
        (peers(1.0, 0.0, -0.8, 0.0, tick=50), "was last heard of five seconds ago"),
    ],
)
def test_a_peer_that_is_in_nobodys_way_turns_nobody(told: np.ndarray, why: str) -> None:
    assert keep_right(1.0, 0.0, 0, 0.0, 0.0, told, 100, 10.0, 0.8) == (1.0, 0.0), why
