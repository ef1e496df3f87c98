"""Closed loops: simple ones pass as they are, others are refused where they go wrong."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from imagine.core.errors import InputError
from imagine.sim.polygon import first_crossing, signed_area, simple_loop, without_spikes

radii = st.lists(st.floats(0.5, 5.0), min_size=3, max_size=40)


def star(distances: list[float], turn: float = 0.0) -> NDArray[np.float64]:
    """Corners at these distances round the origin, evenly turned: always a simple polygon."""
    bearings = turn + 2.0 * math.pi * np.arange(len(distances)) / len(distances)
    return np.array(distances)[:, None] * np.column_stack((np.cos(bearings), np.sin(bearings)))


def crosses(loop: NDArray[np.float64]) -> bool:
    """Try every pair of edges that are no neighbours, by orientations: the slow way to the same answer."""

    def side(a: NDArray[np.float64], b: NDArray[np.float64], c: NDArray[np.float64]) -> float:
        return float((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))

    count = len(loop)
    for i in range(count):
        for j in range(i + 2, count - (i == 0)):
            p, q, r, s = loop[i], loop[(i + 1) % count], loop[j], loop[(j + 1) % count]
            if side(p, q, r) * side(p, q, s) <= 0 and side(r, s, p) * side(r, s, q) <= 0:
                return True
    return False


@given(radii, st.floats(0.0, 6.0), st.booleans(), st.booleans())
def test_a_simple_polygon_passes_whichever_way_round_and_closed_or_not(
    distances: list[float], turn: float, clockwise: bool, closed: bool
) -> None:
    loop = star(distances, turn)[:: -1 if clockwise else 1]
    assume(abs(signed_area(loop)) > 1e-3)
    given_corners = np.vstack((loop, loop[:1])) if closed else loop
    np.testing.assert_array_equal(simple_loop(given_corners.tolist(), "here"), loop)


@given(radii)
def test_the_area_is_that_of_the_triangles_round_the_origin(distances: list[float]) -> None:
    ahead = np.roll(distances, -1)
    wanted = 0.5 * math.sin(2.0 * math.pi / len(distances)) * float(np.sum(np.array(distances) * ahead))
    assert signed_area(star(distances)) == pytest.approx(wanted, abs=1e-9)
    assert signed_area(star(distances)[::-1] + 100.0) == pytest.approx(-wanted, abs=1e-9)


@given(st.lists(st.tuples(st.floats(0, 9), st.floats(0, 9)), min_size=4, max_size=9, unique=True))
def test_crossings_are_found_if_and_only_if_there_are_any(corners: list[tuple[float, float]]) -> None:
    loop = np.array(corners)
    first, second, x, y = first_crossing(loop)
    assert (first >= 0) == crosses(loop) or _degenerate(loop)
    if first >= 0:
        for k in (first, second):  # the place named lies on both edges
            a, b = loop[k], loop[(k + 1) % len(loop)]
            t = np.clip(np.dot(np.array([x, y]) - a, b - a) / max(np.dot(b - a, b - a), 1e-300), 0.0, 1.0)
            assert np.hypot(*(a + t * (b - a) - (x, y))) < 1e-6


def _degenerate(loop: NDArray[np.float64]) -> bool:
    """Three corners in line, on which rounding decides."""
    for i in range(len(loop)):
        for j in range(i):
            for k in range(j):
                a, b = loop[i] - loop[k], loop[j] - loop[k]
                if abs(a[0] * b[1] - a[1] * b[0]) < 1e-9:
                    return True
    return False


@pytest.mark.parametrize(
    ("corners", "said"),
    [
        ([[0, 0], [4, 4], [4, 0], [0, 4]], r"touches itself at \(2, 2\), where edge 0 from \(0, 0\) meets edge 2"),
        ([[0, 0], [4, 0], [4, 3], [2, 0], [0, 3]], r"touches itself at \(2, 0\)"),
        ([[0, 0], [4, 0], [2, 0], [2, 3]], r"touches itself at \(4, 0\)"),
        ([[0, 0], [3, 0], [3, 3], [0, 0], [0, 3]], r"corner 0 at \(0, 0\) comes again as corner 3"),
        ([[0, 0], [3, 0], [3, 0], [3, 3]], r"corner 1 at \(3, 0\) comes again as corner 2"),
        ([[0, 0], [1, 1], [3, 3]], r"no area: an open line from \(0, 0\) to \(3, 3\)"),
        ([[0, 0], [1, 1], [0, 0]], "2 different corners enclose nothing"),
        ([[1, 1]], "1 different corners enclose nothing"),
    ],
)
def test_what_is_no_polygon_is_refused_with_its_coordinates(corners: list[list[float]], said: str) -> None:
    with pytest.raises(InputError, match=rf"^plan:7: .*{said}"):
        simple_loop(corners, "plan:7")


def test_spikes_of_no_width_go_and_longer_ones_stay() -> None:
    square = [[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [0.0, 4.0]]
    spiked = [*square[:2], [4.0, 2.0], [4.03, 2.0], [4.0, 2.0], *square[2:]]
    cleaned = simple_loop(without_spikes(np.array(spiked), 0.05), "plan")
    assert signed_area(cleaned) == 16.0
    overshot = [[0.0, 0.0], [4.02, 0.0], [4.0, 0.0], [4.0, 4.0], [0.0, 4.0]]
    np.testing.assert_array_equal(without_spikes(np.array(overshot), 0.05), square)
    wall = [*square[:2], [4.0, 2.0], [1.0, 2.0], [4.0, 2.0], *square[2:]]
    assert len(without_spikes(np.array(wall), 0.05)) == len(wall)
    np.testing.assert_array_equal(without_spikes(np.array(square), 0.05), square)
