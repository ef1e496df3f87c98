"""Where one evidence grid lies in another: searching and refining a planar pose by walls and free space.

The maximum of a likelihood field over all yaws and shifts, found by correlation (Olson 2009, "Real-time correlative
scan matching"), with the shifts of a yaw all at once by FFT, and free space speaking against walls. The best distinct
hypotheses are refined below a cell by Gauss-Newton on the distances to walls, weighted by their likelihood, and judged
on the full grid. Poses say where the peer's frame lies in the reference's: metres and radians.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from imagine.core.frames import Pose, compose, inverse, transform_points, wrap_angle
from imagine.core.map_field import CLEAR_M, CONTRADICTION_WEIGHT, Field, Fit, distances, judge, slopes
from imagine.core.raster import CELL

COARSE = 2
"""Cells along a pixel of the search."""
YAW_STEP_RAD = math.radians(3.0)
YAWS = round(2.0 * math.pi / YAW_STEP_RAD)
_SEARCH_SIGMA_M = 0.2
_PEAKS_PER_YAW = 3
_APART_M = 0.5
_APART_RAD = math.radians(12.0)
_REFINED = 6
_SIGMAS_M = (0.25, 0.12, 0.08)
_ITERATIONS = 6


class Hypothesis(NamedTuple):
    """A pose of the peer's frame in the reference's, and its fit."""

    pose: Pose
    fit: Fit


def refine(reference: Field, peer: Field, pose: Pose) -> Pose:
    """Return `pose` moved to the nearby maximum of the walls' likelihood, walls of either map seen by the other's."""
    middle = peer.centre
    for sigma_m in _SIGMAS_M:
        for _ in range(_ITERATIONS):
            step = _step(reference, peer, pose, middle, sigma_m)
            # turned about the middle of the walls, where turning and shifting depend on each other least
            about = transform_points(pose, middle[None])[0]
            turned = compose(Pose(about[0] + step[0], about[1] + step[1], step[2]), Pose(-about[0], -about[1], 0.0))
            pose = compose(turned, pose)
            if abs(step[0]) + abs(step[1]) < 1e-3 and abs(step[2]) < 1e-4:
                break
    return pose


def _step(
    reference: Field, peer: Field, pose: Pose, middle: NDArray[np.float64], sigma_m: float
) -> NDArray[np.float64]:
    """Return a step of Gauss-Newton (dx, dy, dyaw) about the peer's middle, metres and radians in the reference."""
    points = transform_points(pose, peer.walls)
    about = transform_points(pose, middle[None])[0]
    normal, right = _equations(slopes(reference, points), points - about, distances(reference, points), sigma_m)
    # the other way round: the reference's walls in the peer's field, their slope turned back into the reference
    theirs = transform_points(inverse(pose), reference.walls)
    c, s = math.cos(pose.yaw), math.sin(pose.yaw)
    turned_back = -slopes(peer, theirs) @ np.array([[c, s], [-s, c]])
    more_normal, more_right = _equations(turned_back, reference.walls - about, distances(peer, theirs), sigma_m)
    held = np.diag([1e-3, 1e-3, 1e-3])  # where the walls leave a way free
    step = -np.linalg.solve(normal + more_normal + held, right + more_right)
    limit = max(1.0, math.hypot(step[0], step[1]) / sigma_m, abs(step[2]) / math.radians(3.0))
    limited: NDArray[np.float64] = step / limit
    return limited


def _equations(
    slope: NDArray[np.float64], lever: NDArray[np.float64], distance: NDArray[np.float64], sigma_m: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the normal equations, `[3, 3]` and `[3]`, of walls by slopes and levers `[n, 2]` and distances."""
    weight = np.exp(-0.5 * (distance / sigma_m) ** 2)
    jacobian = np.column_stack((slope, slope[:, 1] * lever[:, 0] - slope[:, 0] * lever[:, 1]))
    weighted = (jacobian * weight[:, None]).T
    normal: NDArray[np.float64] = weighted @ jacobian
    right: NDArray[np.float64] = weighted @ distance
    return normal, right


def difference(a: Pose, b: Pose, middle: NDArray[np.float64]) -> tuple[float, float]:
    """Return how far apart two poses lay the peer's `middle` (`[2]`, metres), and the angle between them, radians."""
    shift = transform_points(a, middle[None])[0] - transform_points(b, middle[None])[0]
    return math.hypot(shift[0], shift[1]), abs(wrap_angle(a.yaw - b.yaw))


def are_apart(a: Pose, b: Pose, middle: NDArray[np.float64]) -> bool:
    """Tell whether two poses are different answers: they lay the peer's `middle` apart, or turn it otherwise."""
    shift_m, turn = difference(a, b, middle)
    return shift_m > _APART_M or turn > _APART_RAD


class Within(NamedTuple):
    """What is known of a pose beforehand: the peer's origin lies at most `radius_m` from (x, y) of the reference."""

    x: float
    y: float
    radius_m: float

    def holds(self, pose: Pose) -> bool:
        """Tell whether a pose is possible."""
        return math.hypot(pose.x - self.x, pose.y - self.y) <= self.radius_m


class Search:
    """The search over all yaws and shifts, in slices: `advance` until `found` is not None.

    A slice is a few yaws, then a hypothesis refined; what comes out does not depend on how it is sliced.
    """

    def __init__(self, reference: Field, peer: Field, within: Within | None = None) -> None:
        """Prepare: about a slice's time. Poses not `within` what is known beforehand are no hypotheses."""
        self.reference, self.peer, self._within = reference, peer, within
        self.found: list[Hypothesis] | None = None
        self._yaw = 0
        self._peaks: list[tuple[float, Pose]] = []
        self._chosen: list[Pose] | None = None
        self._refined: list[Hypothesis] = []
        self._pixel = CELL * COARSE
        about = peer.centre
        self._about = about
        self._points = peer.walls - about, peer.opens - about
        radius = max(float(np.hypot(*points.T).max(initial=0.0)) for points in self._points) + self._pixel
        self._half = math.ceil(radius / self._pixel)
        rows, columns = (math.ceil(n / COARSE) for n in reference.distance.shape)
        self._shape = tuple(fft.next_fast_len(n + 2 * self._half + 1, real=True) for n in (rows, columns))
        self._span = rows, columns
        pad = [(0, -n % COARSE) for n in reference.distance.shape]
        near = np.exp(-0.5 * (reference.distance / _SEARCH_SIGMA_M) ** 2)
        against = reference.clear & (reference.distance > CLEAR_M)
        walls = reference.distance < CELL / 2.0
        seen = np.pad(near - CONTRADICTION_WEIGHT / 2.0 * against, pad)
        blocks = seen.reshape(rows, COARSE, columns, COARSE).mean(axis=(1, 3))
        wall_blocks = np.pad(walls, pad).reshape(rows, COARSE, columns, COARSE).sum(axis=(1, 3))
        # the peer's open space on the reference's walls speaks against a pose as much as walls on open space
        self._seen = np.conj(fft.rfft2(blocks.astype(np.float32), self._shape))
        self._walls = np.conj(fft.rfft2(wall_blocks.astype(np.float32), self._shape))

    def advance(self, yaws: int) -> bool:
        """Do a slice: so many yaws, or refine one hypothesis; tell whether the search is over."""
        if self.found is not None:
            return True
        if self._yaw < YAWS:
            for _ in range(min(yaws, YAWS - self._yaw)):
                self._correlate(-math.pi + self._yaw * YAW_STEP_RAD)
                self._yaw += 1
        elif self._chosen is None:
            self._chosen = self._distinct()
        elif self._chosen:
            pose = refine(self.reference, self.peer, self._chosen.pop(0))
            self._refined.append(Hypothesis(pose, judge(self.reference, self.peer, pose)))
        else:
            self._refined.sort(key=lambda hypothesis: -hypothesis.fit.score)
            distinct: list[Hypothesis] = []
            for hypothesis in self._refined:
                if all(are_apart(hypothesis.pose, other.pose, self._about) for other in distinct):
                    distinct.append(hypothesis)
            self.found = distinct
        return self.found is not None

    def _correlate(self, yaw: float) -> None:
        images = []
        c, s = math.cos(yaw), math.sin(yaw)
        for points in self._points:
            column = np.floor((c * points[:, 0] - s * points[:, 1]) / self._pixel).astype(np.int64) + self._half
            row = np.floor((s * points[:, 0] + c * points[:, 1]) / self._pixel).astype(np.int64) + self._half
            flat = np.bincount(row * self._shape[1] + column, minlength=self._shape[0] * self._shape[1])
            images.append(flat[: self._shape[0] * self._shape[1]].reshape(self._shape).astype(np.float32))
        per_block = float(COARSE * COARSE)
        walls, frees = (fft.rfft2(image) for image in images)
        # correlation: score[shift] = sum over pixels p of image[p] field[p + shift], for all shifts at once
        spectrum = np.conj(walls * self._seen) - np.conj(frees * self._walls) * (CONTRADICTION_WEIGHT / 2.0 / per_block)
        score = fft.irfft2(spectrum, self._shape)
        for _ in range(_PEAKS_PER_YAW):
            at = int(np.argmax(score))
            row, column = divmod(at, self._shape[1])
            self._peaks.append((float(score[row, column]), self._pose(yaw, row, column)))
            for r in (row - 2, row - 1, row, row + 1, row + 2):
                for k in (column - 2, column - 1, column, column + 1, column + 2):
                    score[r % self._shape[0], k % self._shape[1]] = -np.inf

    def _pose(self, yaw: float, row: int, column: int) -> Pose:
        """Return the pose of a shift of the peer's image by (row, column) pixels, negative ones wrapped."""
        row = row - self._shape[0] if row >= self._span[0] else row
        column = column - self._shape[1] if column >= self._span[1] else column
        x = self.reference.x0 + (column + self._half) * self._pixel
        y = self.reference.y0 + (row + self._half) * self._pixel
        return compose(Pose(x, y, yaw), Pose(-self._about[0], -self._about[1], 0.0))

    def _distinct(self) -> list[Pose]:
        chosen: list[Pose] = []
        for _, pose in sorted(self._peaks, key=lambda peak: -peak[0]):
            is_possible = self._within is None or self._within.holds(pose)
            if is_possible and all(are_apart(pose, other, self._about) for other in chosen):
                chosen.append(pose)
            if len(chosen) == _REFINED:
                break
        return chosen


def search(reference: Field, peer: Field) -> list[Hypothesis]:
    """Return the best distinct hypotheses of where `peer` lies in `reference`, best first, of all that there are."""
    whole = Search(reference, peer)
    while not whole.advance(YAWS):
        pass
    return whole.found or []
