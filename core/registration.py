"""How two evidence grids lie on each other: judging, refining and searching a planar pose from walls and free space.

The maximum of a likelihood field over all yaws and shifts, found by correlation (Olson 2009, "Real-time correlative
scan matching"), with the shifts of a yaw all at once by FFT, and free space speaking against walls. The best distinct
hypotheses are refined below a cell by Gauss-Newton on the field (Kohlbrecher et al. 2011) and judged on the full grid.
Poses say where the peer's frame lies in the reference's: metres and radians. Nothing here keeps state.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from imagine.core.frames import Pose, compose, inverse, transform_points, wrap_angle
from imagine.core.raster import CELL

WALL_UNITS = 2
"""A cell is a wall from one hit on."""
FREE_UNITS = -2
"""A cell is clear from two misses on."""
MATCH_M = 0.15
"""A wall this near to the other map's is the same wall: a cell's diagonal, beside rounding in both grids."""
CLEAR_M = 0.35
"""A wall further than this from the other map's, on cells clear there, contradicts it; less may be drift."""
CONTRADICTION_WEIGHT = 3.0
"""How many cells of matching wall one of contradicting wall outweighs."""
COARSE = 2
"""Cells along a pixel of the search."""
YAW_STEP_RAD = math.radians(3.0)
YAWS = round(2.0 * math.pi / YAW_STEP_RAD)
_SEARCH_SIGMA_M = 0.2
_PEAKS_PER_YAW = 3
_APART_M = 0.5
_APART_RAD = math.radians(12.0)
_REFINED = 6
_MARGIN_M = 1.0  # around the known cells, where distances to walls are still told
_SIGMAS_M = (0.25, 0.12, 0.08)
_ITERATIONS = 6


@dataclass(frozen=True)
class Field:
    """What one evidence grid says at any point near it, in its own frame.

    `distance` float32 `[rows, columns]` to the nearest wall, metres; `clear`, `known` bool of the same shape;
    (`x0`, `y0`) metres of the first cell's corner; `walls` float64 `[n, 2]`, `frees` `[m, 2]` are cell centres, metres.
    """

    x0: float
    y0: float
    distance: NDArray[np.float32]
    clear: NDArray[np.bool_]
    known: NDArray[np.bool_]
    walls: NDArray[np.float64]
    frees: NDArray[np.float64]

    @property
    def centre(self) -> NDArray[np.float64]:
        """Middle of the walls, metres `[2]`."""
        middle: NDArray[np.float64] = self.walls.mean(axis=0)
        return middle


def field_of(cells: NDArray[np.int8], origin_cells: tuple[int, int]) -> Field | None:
    """Return the field of a grid (int8 `[rows, columns]`, its first cell at `origin_cells`); None without a wall."""
    rows, columns = np.nonzero(cells)
    is_wall = cells >= WALL_UNITS
    if not is_wall.any():
        return None
    margin = round(_MARGIN_M / CELL)
    row0, row1, column0, column1 = int(rows.min()), int(rows.max()) + 1, int(columns.min()), int(columns.max()) + 1
    window = np.pad(cells[row0:row1, column0:column1], margin)
    wall, clear = window >= WALL_UNITS, window <= FREE_UNITS
    x0 = (origin_cells[0] + column0 - margin) * CELL
    y0 = (origin_cells[1] + row0 - margin) * CELL
    distance = (ndimage.distance_transform_edt(~wall) * CELL).astype(np.float32)

    def centres(mask: NDArray[np.bool_]) -> NDArray[np.float64]:
        at_row, at_column = np.nonzero(mask)
        return np.column_stack((x0 + (at_column + 0.5) * CELL, y0 + (at_row + 0.5) * CELL))

    return Field(x0, y0, distance, clear, window != 0, centres(wall), centres(clear))


class Fit(NamedTuple):
    """How well two maps agree under a pose, in cells: of wall where both know, both ways round, and in all.

    `matched` and `contradicted` walls; `overlap` cells known to both; `balance` in [0, 1] how evenly the matched walls
    fix the two directions (0: one straight corridor, along which the pose is free; 1: as many either way).
    """

    matched: float
    contradicted: float
    overlap: int
    balance: float

    @property
    def score(self) -> float:
        """What hypotheses are compared by."""
        return self.matched - CONTRADICTION_WEIGHT * self.contradicted

    @property
    def contradiction(self) -> float:
        """Share of walls in the overlap that the other map contradicts, 0 to 1."""
        return self.contradicted / max(1.0, self.matched + self.contradicted)


class Hypothesis(NamedTuple):
    """A pose of the peer's frame in the reference's, and its fit."""

    pose: Pose
    fit: Fit


def judge(reference: Field, peer: Field, pose: Pose) -> Fit:
    """Return how well `peer`, placed by `pose`, agrees with `reference`."""
    forth = _compare(reference, transform_points(pose, peer.walls))
    back = _compare(peer, transform_points(inverse(pose), reference.walls))
    row, column, inside = _cells(reference, transform_points(pose, np.concatenate((peer.frees, peer.walls))))
    overlap = int(np.count_nonzero(reference.known[row[inside], column[inside]]))
    return Fit(
        (forth.matched + back.matched) / 2.0, (forth.contradicted + back.contradicted) / 2.0, overlap,
        _balance(reference, transform_points(pose, peer.walls)),
    )  # fmt: skip


class _Compared(NamedTuple):
    matched: int
    contradicted: int


def _compare(field: Field, walls: NDArray[np.float64]) -> _Compared:
    row, column, inside = _cells(field, walls)
    row, column = row[inside], column[inside]
    distance = field.distance[row, column]
    contradicted = field.clear[row, column] & (distance > CLEAR_M)
    return _Compared(int(np.count_nonzero(distance <= MATCH_M)), int(np.count_nonzero(contradicted)))


def _cells(
    field: Field, points: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
    """Return row and column of points in a field, and whether they lie on it."""
    column = np.floor((points[:, 0] - field.x0) / CELL).astype(np.int64)
    row = np.floor((points[:, 1] - field.y0) / CELL).astype(np.int64)
    rows, columns = field.distance.shape
    return row, column, (row >= 0) & (row < rows) & (column >= 0) & (column < columns)


def _balance(field: Field, walls: NDArray[np.float64]) -> float:
    """Return the smaller over the greater of the sums of squared normals of matched walls along their main axes."""
    _, gradient, near = _likelihood(field, walls, 0.12)
    normal = gradient[near > 0.3]
    length = np.hypot(normal[:, 0], normal[:, 1])
    normal = normal[length > 0.0] / length[length > 0.0, None]
    if len(normal) < 2:
        return 0.0
    least, most = np.linalg.eigvalsh(normal.T @ normal)
    return float(max(0.0, least) / most)


def _likelihood(
    field: Field, points: NDArray[np.float64], sigma_m: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return the field's distances at points (bilinear), the gradient of the likelihood `[n, 2]`, and the likelihood."""
    rows, columns = field.distance.shape
    u = np.clip((points[:, 0] - field.x0) / CELL - 0.5, 0.0, columns - 1.001)
    v = np.clip((points[:, 1] - field.y0) / CELL - 0.5, 0.0, rows - 1.001)
    column, row = u.astype(np.int64), v.astype(np.int64)
    fu, fv = u - column, v - row
    at = row * columns + column
    flat = field.distance.ravel()
    d00, d01, d10, d11 = flat[at], flat[at + 1], flat[at + columns], flat[at + columns + 1]
    low, high = d00 + fu * (d01 - d00), d10 + fu * (d11 - d10)
    distance = low + fv * (high - low)
    slope_x = ((1.0 - fv) * (d01 - d00) + fv * (d11 - d10)) / CELL
    slope_y = (high - low) / CELL
    likelihood = np.exp(-0.5 * (distance / sigma_m) ** 2)
    factor = -likelihood * distance / sigma_m**2
    return distance, np.column_stack((factor * slope_x, factor * slope_y)), likelihood


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
    distance, _, weight = _likelihood(reference, points, sigma_m)
    rows = _rows(reference, points, distance)
    jacobian = np.column_stack((rows, rows[:, 1] * (points[:, 0] - about[0]) - rows[:, 0] * (points[:, 1] - about[1])))
    normal = (jacobian * weight[:, None]).T @ jacobian
    right = (jacobian * weight[:, None]).T @ distance
    # the other way round: the reference's walls in the peer's field, their slope turned back into the reference
    back = inverse(pose)
    theirs = transform_points(back, reference.walls)
    distance, _, weight = _likelihood(peer, theirs, sigma_m)
    c, s = math.cos(pose.yaw), math.sin(pose.yaw)
    rows = -_rows(peer, theirs, distance) @ np.array([[c, s], [-s, c]])
    lever = reference.walls - about
    jacobian = np.column_stack((rows, rows[:, 1] * lever[:, 0] - rows[:, 0] * lever[:, 1]))
    normal += (jacobian * weight[:, None]).T @ jacobian
    right += (jacobian * weight[:, None]).T @ distance
    normal += np.diag([1e-3, 1e-3, 1e-3])
    step = -np.linalg.solve(normal, right)
    limit = max(1.0, math.hypot(step[0], step[1]) / sigma_m, abs(step[2]) / math.radians(3.0))
    return step / limit


def _rows(field: Field, points: NDArray[np.float64], distance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the slope of the distance at points `[n, 2]`, by differences a cell wide."""
    out = np.empty((len(points), 2))
    for axis in range(2):
        shift = np.zeros(2)
        shift[axis] = CELL / 2.0
        out[:, axis] = (_distance(field, points + shift) - _distance(field, points - shift)) / CELL
    return out


def _distance(field: Field, points: NDArray[np.float64]) -> NDArray[np.float64]:
    rows, columns = field.distance.shape
    u = np.clip((points[:, 0] - field.x0) / CELL - 0.5, 0.0, columns - 1.001)
    v = np.clip((points[:, 1] - field.y0) / CELL - 0.5, 0.0, rows - 1.001)
    column, row = u.astype(np.int64), v.astype(np.int64)
    fu, fv = u - column, v - row
    at = row * columns + column
    flat = field.distance.ravel()
    low = flat[at] + fu * (flat[at + 1] - flat[at])
    high = flat[at + columns] + fu * (flat[at + columns + 1] - flat[at + columns])
    out: NDArray[np.float64] = low + fv * (high - low)
    return out


def are_apart(a: Pose, b: Pose, middle: NDArray[np.float64]) -> bool:
    """Tell whether two poses are different answers: they lay the peer's `middle` apart, or turn it otherwise."""
    shift = transform_points(a, middle[None])[0] - transform_points(b, middle[None])[0]
    return math.hypot(shift[0], shift[1]) > _APART_M or abs(wrap_angle(a.yaw - b.yaw)) > _APART_RAD


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
        self._points = peer.walls - about, peer.frees - about
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
        # a peer's free cells on the reference's walls, by cells of wall: as much as walls on free cells
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
