"""Distances to peers: to the nearest ones that are known, nearest first, and 1 for those who are not."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from imagine.core.peer_poses import fill_peer_distances

PEERS = st.lists(
    st.tuples(st.floats(-20.0, 20.0), st.floats(-20.0, 20.0), st.sampled_from([0.0, 1.9, 2.0, 2.1, math.inf])),
    max_size=8,
)


def distances(count: int, peers: list[tuple[float, float, float]], x: float = 0.0, y: float = 0.0) -> list[float]:
    out = np.empty(count, np.float32)
    told = np.array(peers, np.float64).reshape(-1, 3)
    fill_peer_distances(out, x, y, np.ascontiguousarray(told[:, :2]), np.ascontiguousarray(told[:, 2]), 10.0)
    return [float(value) for value in out]


@given(st.integers(0, 6), PEERS, st.floats(-5.0, 5.0), st.floats(-5.0, 5.0))
def test_they_are_those_to_the_nearest_known(
    count: int, peers: list[tuple[float, float, float]], x: float, y: float
) -> None:
    known = sorted(min(math.hypot(px - x, py - y) / 10.0, 1.0) for px, py, age in peers if age <= 2.0)
    expected = (known + [1.0] * count)[:count]
    assert distances(count, peers, x, y) == pytest.approx(expected, abs=1e-6)


def test_who_is_silent_for_longer_than_two_seconds_is_unknown() -> None:
    heard = [(3.0, 4.0, 0.1 * 20), (0.0, 1.0, 2.1)]
    assert distances(2, heard) == pytest.approx([0.5, 1.0])
    ticks = sum([0.1] * 20)  # a little more than 2, as ages summed tick by tick are
    assert distances(1, [(3.0, 4.0, ticks)]) == pytest.approx([0.5])
