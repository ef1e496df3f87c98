"""How far a drone's estimate of its pose is off, without running odometry: a model fitted to the odometry that flies.

In batched training nobody matches scans. What LiDAR odometry does to poses is drawn instead: estimated = true + drift
− lag × velocity + jitter, each of x, y and yaw (Ornstein and Uhlenbeck 1930, over distance instead of time):

    drift' = drift × exp(−s / length) + sigma × scale × sqrt(1 − exp(−2 s / length)) × normal

with s the metres flown plus `per_rad_m` for each radian turned. It starts at 0, since the launch pose is known, grows
like a random walk, and levels off: odometry registers against its own local map, which pulls it back. `scale` is drawn
for each drone and episode, as some flights drift ten times as far as others; the jitter is new with every scan.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numba
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from imagine.core.config import Settings
from imagine.sim.keyed_noise import key_of, normal_table
from imagine.sim.workers import Workers


class DriftSettings(Settings):
    """The model's constants; the defaults are fitted to flights with instantaneous scans, see docs/sensing.md."""

    enabled: bool = Field(default=False, description="give drones drifting poses; otherwise they know where they are")
    share: float = Field(
        default=1.0,
        ge=0.0,
        le=1.0,
        description="share of episodes with drift, where enabled; in the others poses are exact",
    )
    sigma_m: float = Field(default=0.051, ge=0.0, le=10.0, description="drift of x and of y, once levelled off")
    length_m: float = Field(default=100.0, gt=0.0, description="distance over which drift of x and y is forgotten")
    sigma_rad: float = Field(default=0.0062, ge=0.0, le=1.0, description="the same of yaw")
    length_rad_m: float = Field(default=3.6, gt=0.0, description="distance over which drift of yaw is forgotten")
    per_rad_m: float = Field(default=0.15, ge=0.0, description="a radian turned counts as so many metres flown")
    jitter_m: float = Field(default=0.0073, ge=0.0, le=1.0, description="error of x and of y that is new every scan")
    jitter_rad: float = Field(default=0.0011, ge=0.0, le=1.0, description="the same of yaw")
    lag_s: float = Field(default=0.0065, ge=-1.0, le=1.0, description="how old the estimated position is")
    spread: float = Field(
        default=0.76, ge=0.0, le=2.0, description="deviation of the logarithm of a drone's drift from flight to flight"
    )


SKEWED = DriftSettings(
    enabled=True, sigma_m=0.049, length_m=100.0, sigma_rad=0.0065, length_rad_m=20.0, per_rad_m=0.0, jitter_m=0.017,
    jitter_rad=0.0055, lag_s=0.0077, spread=0.56,
)  # fmt: skip
"""The same of flights with skewed scans that the odometry deskews, as a real spinning LiDAR's are."""


class OdometryDrift:
    """The estimated poses of `drones` drones in each of `worlds` worlds; call `reset` before a world's first tick."""

    def __init__(
        self, worlds: int, drones: int, settings: DriftSettings, dt: float, workers: Workers | None = None
    ) -> None:
        """Start without drift; `dt` is seconds from call to call of `advance`."""
        self.settings = settings
        self._workers = workers or Workers(1)
        self.error = np.zeros((worlds, drones, 3))
        self._before = np.zeros((worlds, drones, 3))
        self._scale = np.ones((worlds, drones))
        self._keys = np.zeros(worlds, np.uint64)
        self._ages = np.zeros(worlds, np.int64)
        s = settings
        self._numbers = np.array(
            [s.sigma_m, s.length_m, s.sigma_rad, s.length_rad_m, s.per_rad_m, s.jitter_m, s.jitter_rad, s.lag_s / dt]
        )
        self._drifts = np.ones(worlds, np.bool_)

    def reset(self, world: int, generator: np.random.Generator) -> None:
        """Begin an episode: the launch poses are known; the generator draws whether and how far drones will drift."""
        drones, spread = self.error.shape[1], self.settings.spread
        self._keys[world] = generator.integers(2**64, dtype=np.uint64)
        self._scale[world] = np.exp(spread * generator.standard_normal(drones) - spread * spread)  # mean square 1
        if self.settings.share < 1.0:
            self._drifts[world] = generator.random() < self.settings.share
        self._ages[world] = 0
        self.error[world] = 0.0

    def advance(self, poses: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the estimates `[worlds, drones, 3]` of true poses, one tick on; the poses where it is not enabled."""
        if not self.settings.enabled:
            return poses.copy()
        estimated = np.empty_like(poses)
        self._workers.over(len(poses), advance_worlds, estimated, np.ascontiguousarray(poses), *self.kernel_args())
        return estimated

    def kernel_args(self) -> tuple[NDArray[np.generic], ...]:
        """Return what `advance_worlds` takes after the poses, for kernels that call it themselves."""
        return (
            self.error, self._before, self._scale, self._drifts, self._keys, self._ages, self._numbers, normal_table()
        )  # fmt: skip


@numba.njit(cache=True, nogil=True)
def advance_worlds(  # type: ignore[no-untyped-def]
    first, last, estimated, poses, error, before, scale, drifts, keys, ages, numbers, normal
):
    """Fill `estimated` `[worlds, drones, 3]` of worlds first to last, and carry their drift on by a tick.

    The noise is a function of the episode's key, its tick and the drone.
    """
    for world in range(first, last):
        tick_key = key_of(keys[world], ages[world])
        for drone in range(poses.shape[1]):
            if ages[world] == 0 or not drifts[world]:
                before[world, drone] = poses[world, drone]
                estimated[world, drone] = poses[world, drone]
                continue
            _advance(
                estimated[world, drone], poses[world, drone], error[world, drone], before[world, drone],
                scale[world, drone], key_of(tick_key, drone), numbers, normal,
            )  # fmt: skip
        ages[world] += 1


@numba.njit(cache=True, nogil=True)
def _advance(estimated, pose, error, before, scale, key, numbers, normal):  # type: ignore[no-untyped-def]
    dx, dy, turn = pose[0] - before[0], pose[1] - before[1], pose[2] - before[2]
    turn -= 2.0 * math.pi * math.floor(turn / (2.0 * math.pi) + 0.5)
    way = math.sqrt(dx * dx + dy * dy) + numbers[4] * abs(turn)
    drive, jitter = key_of(key, 0), key_of(key, 1)
    for axis in range(3):
        kind = 2 if axis == 2 else 0
        keep = math.exp(-way / numbers[kind + 1])
        new = numbers[kind] * scale * math.sqrt(1.0 - keep * keep)
        error[axis] = keep * error[axis] + new * normal[drive & np.uint64(0xFFFF)]
        blur = numbers[6 if axis == 2 else 5] * normal[jitter & np.uint64(0xFFFF)]
        estimated[axis] = pose[axis] + error[axis] + blur
        drive >>= np.uint64(16)
        jitter >>= np.uint64(16)
        before[axis] = pose[axis]
    estimated[0] -= numbers[7] * dx
    estimated[1] -= numbers[7] * dy
    yaw = estimated[2] + math.pi
    estimated[2] = yaw - 2.0 * math.pi * math.floor(yaw / (2.0 * math.pi)) - math.pi


Track = tuple[NDArray[np.float64], NDArray[np.float64]]
"""A drone's true and its estimated poses, `[ticks, 3]` each."""
_GAPS_M = np.geomspace(0.1, 50.0, 13)
_LONGEST_M = 100.0
_WINDOWS = (2, 5, 10, 20)  # ticks; of several lengths, to tell what grows from the jitter that does not


def fit(tracks: Sequence[Track], dt: float) -> DriftSettings:
    """Return the model whose errors grow with distance as those of the tracks do; `dt` is seconds between poses.

    Lag by regression on velocity; metres per radian by regression of what errors change by within two seconds; the rest
    by least squares on the mean square change of the error over gaps of 0.1 to 50 m, 2 jitter² + 2 sigma² (1 −
    exp(−gap / length)); the spread from how much the tracks' rms errors differ beyond what the model's own do.
    """
    lag_s = _lag(tracks, dt)
    errors = [pose_errors(*track) for track in tracks]
    for error, (true, _) in zip(errors, tracks, strict=True):
        error[1:, :2] += lag_s / dt * np.diff(true[:, :2], axis=0)
    per_rad = _metres_per_radian(tracks, errors)
    ways = [_way(true, per_rad) for true, _ in tracks]
    sigma_m, length_m, jitter_m = _levelling_off(ways, [error[:, :2] for error in errors])
    sigma_rad, length_rad_m, jitter_rad = _levelling_off(ways, [error[:, 2:] for error in errors])
    flat = DriftSettings(
        enabled=True, sigma_m=sigma_m, length_m=length_m, sigma_rad=sigma_rad, length_rad_m=length_rad_m,
        per_rad_m=per_rad, jitter_m=jitter_m, jitter_rad=jitter_rad, lag_s=lag_s, spread=0.0,
    )  # fmt: skip
    own = [np.log(rms_error(replayed(flat, tracks, dt, seed))).var() for seed in range(8)]
    spread = math.sqrt(max(0.0, float(np.log(rms_error(tracks)).var() - np.mean(own))))
    return flat.model_copy(update={"spread": round(min(spread, 2.0), 2)})


def replayed(settings: DriftSettings, tracks: Sequence[Track], dt: float, seed: int) -> list[Track]:
    """Return the tracks with estimates drawn from the model along the same true poses."""
    drift = OdometryDrift(len(tracks), 1, settings.model_copy(update={"enabled": True}), dt)
    for world in range(len(tracks)):
        drift.reset(world, np.random.default_rng([seed, world]))
    longest = max(len(true) for true, _ in tracks)
    true = np.stack([np.pad(t, ((0, longest - len(t)), (0, 0)), mode="edge") for t, _ in tracks])
    estimated = np.stack([drift.advance(true[:, None, tick])[:, 0] for tick in range(longest)], axis=1)
    return [(t, estimated[k, : len(t)]) for k, (t, _) in enumerate(tracks)]


def pose_errors(true: NDArray[np.float64], estimated: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return estimated minus true poses `[n, 3]`, metres and radians."""
    error: NDArray[np.float64] = estimated - true
    error[:, 2] = np.remainder(error[:, 2] + np.pi, 2.0 * np.pi) - np.pi
    return error


def rms_error(tracks: Sequence[Track]) -> NDArray[np.float64]:
    """Return each track's rms distance of estimated from true positions, metres."""
    return np.array([math.sqrt((pose_errors(*track)[:, :2] ** 2).sum(axis=1).mean()) for track in tracks])


def _lag(tracks: Sequence[Track], dt: float) -> float:
    across = along = 0.0
    for true, estimated in tracks:
        velocity = np.diff(true[:, :2], axis=0) / dt
        error = pose_errors(true, estimated)[1:, :2]
        across -= float((velocity * (error - error.mean(axis=0))).sum())
        along += float((velocity**2).sum())
    return round(across / along, 4)


def _metres_per_radian(tracks: Sequence[Track], errors: list[NDArray[np.float64]]) -> float:
    """Regress the square of what positions change by on the metres flown and the radians turned meanwhile."""
    from scipy.optimize import nnls  # here, since only fitting needs it

    rows, squares = [], []
    for (true, _), error in zip(tracks, errors, strict=True):
        flown = _way(true, 0.0)
        turned = _way(true, 1.0) - flown
        for ticks in _WINDOWS:
            columns = (np.ones(len(true) - ticks), flown[ticks:] - flown[:-ticks], turned[ticks:] - turned[:-ticks])
            rows.append(np.column_stack(columns))
            squares.append(np.square(error[ticks:, :2] - error[:-ticks, :2]).sum(axis=1))
    (_, per_m, per_rad), _ = nnls(np.concatenate(rows), np.concatenate(squares))
    return round(float(per_rad / per_m), 2) if per_m > 0.0 else 0.0


def _way(true: NDArray[np.float64], per_rad: float) -> NDArray[np.float64]:
    step = np.diff(true, axis=0)
    turn = np.abs(np.remainder(step[:, 2] + np.pi, 2.0 * np.pi) - np.pi)
    return np.concatenate(([0.0], np.cumsum(np.hypot(step[:, 0], step[:, 1]) + per_rad * turn)))


def _levelling_off(ways: list[NDArray[np.float64]], errors: list[NDArray[np.float64]]) -> tuple[float, float, float]:
    """Return sigma, length and jitter of errors `[n, axes]` at travelled distances `[n]`.

    Two kinds of mean squares are to be met, both on a logarithmic scale: what errors change by over gaps, and
    what they are at distances from the launch, where they were 0.
    """
    from scipy.optimize import least_squares

    sums = np.zeros((2, len(_GAPS_M), 3))
    for way, error in zip(ways, errors, strict=True):
        for k, gap in enumerate(_GAPS_M):
            now = np.arange(len(way))
            later = np.searchsorted(way, way + gap)
            now, later = now[later < len(way)], later[later < len(way)]
            near = np.flatnonzero((way > 0.8 * gap) & (way < 1.25 * gap))
            for kind, begin, end in ((0, now, later), (1, np.zeros_like(near), near)):
                change = error[end] - (error[begin] if kind == 0 else 0.0)
                sums[kind, k] += np.square(change).sum(), (way[end] - way[begin]).sum() * error.shape[1], change.size
    counts = np.maximum(sums[..., 2], 1.0)
    mean_square, gaps = sums[..., 0] / counts, sums[..., 1] / counts  # ticks are coarser than the shortest gaps
    used = (mean_square > 0.0) & (counts >= len(ways))  # not what only a few tracks tell of

    def misfit(logs: NDArray[np.float64]) -> NDArray[np.float64]:
        sigma2, length, jitter2 = np.exp(logs * (2.0, 1.0, 2.0))
        change = 2.0 * sigma2 * (1.0 - np.exp(-gaps[0] / length)) + 2.0 * jitter2
        since_launch = sigma2 * (1.0 - np.exp(-2.0 * gaps[1] / length)) + jitter2
        off: NDArray[np.float64] = np.log(np.stack((change, since_launch))[used] / mean_square[used])
        return off

    size = math.sqrt(mean_square[used].max())
    best = least_squares(misfit, np.log((size, 5.0, 0.2 * size)), bounds=(np.log(1e-6), np.log(_LONGEST_M)))
    sigma, length, jitter = np.exp(best.x)
    return round(float(sigma), 5), round(float(length), 2), round(float(jitter), 5)
