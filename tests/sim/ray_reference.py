"""What a ray meets, the slow and plain way: every beam against every obstacle, by the textbook's two equations."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def reference(
    segments: NDArray[np.float64],
    circles: NDArray[np.float64],
    places: NDArray[np.float64],
    bearings: NDArray[np.float64],
    range_max: float,
) -> NDArray[np.float64]:
    """Return the ranges `[n]` of rays from `places` `[n, 2]` along `bearings` `[n]`; inf past `range_max`.

    Solves place + r u = a + t (b − a) for every ray and edge, and |place + r u − centre| = radius for every circle. An
    edge ends a billionth of its length late, so that no ray passes between two.
    """
    ux, uy = np.cos(bearings)[:, None], np.sin(bearings)[:, None]
    x, y = places[:, 0, None], places[:, 1, None]
    ax, ay = segments[:, 0] - x, segments[:, 1] - y
    ex, ey = segments[:, 2] - segments[:, 0], segments[:, 3] - segments[:, 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        determinant = ux * ey - uy * ex
        r, t = (ax * ey - ay * ex) / determinant, (ax * uy - ay * ux) / determinant
        walls = np.where((r >= 0.0) & (t >= -1e-9) & (t <= 1.0 + 1e-9), r, np.inf)
        cx, cy = circles[:, 0] - x, circles[:, 1] - y
        middle = ux * cx + uy * cy
        root = circles[:, 2] ** 2 - (cx**2 + cy**2 - middle**2)
        posts = np.where(root >= 0.0, middle - np.sqrt(root), np.inf)
        posts = np.where(posts >= 0.0, posts, np.inf)
    nearest = np.concatenate((walls, posts, np.full((len(bearings), 1), np.inf)), axis=1).min(axis=1)
    ranges: NDArray[np.float64] = np.where(nearest <= range_max, nearest, np.inf)
    return ranges


def furthest_error(found: NDArray[np.float64], expected: NDArray[np.float64]) -> float:
    """Return the largest difference in metres; inf where one has a return and the other has none."""
    both_none = np.isinf(found) & np.isinf(expected)
    with np.errstate(invalid="ignore"):
        error: NDArray[np.float64] = np.where(both_none, 0.0, np.abs(found - expected))
    return float(error.max())
