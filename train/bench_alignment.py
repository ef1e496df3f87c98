"""How well drones without a shared frame find each other: `python -m imagine.train.bench_alignment [--pairs 210]`.

Drones explore the twin's levels by the coordinated baseline, alone, from launches anywhere. Their scans are mapped
again in frames of their own, turned and shifted at random, and every three seconds of the flight one map is searched
for in the other, as the mesh does. Pairs: of one flight, of two flights of a level, and of two levels, which never fit.
"""

from __future__ import annotations

import argparse
import itertools
import math
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from imagine.core.evidence import EvidenceMap
from imagine.core.frames import Pose, compose, inverse, relative, transform_points, wrap_angle
from imagine.core.lidar import LidarSpec, Scan
from imagine.core.map_field import field_of, judge
from imagine.mesh_comm.alignment import AlignmentSettings
from imagine.mesh_comm.placement import Placements
from imagine.sim.exploration import Exploration
from imagine.sim.exploration_settings import ExplorationSettings
from imagine.sim.odometry_drift import DriftSettings
from imagine.train.baselines import baseline

LEVELS = ("4", "5", "6", "0", *(f"house:{seed}" for seed in range(1, 9)))
"""Level 0 is a square and level 4 looks the same from both ends: there geometry alone can never tell."""
SYMMETRIC = ("0", "4")
SECONDS, EVERY = 60, 2
"""Length of a flight, and of its ticks (0.1 s) every how many-eth is mapped."""
ERROR_M, ERROR_RAD = 0.10, math.radians(1.5)
"""How far off a place may be, over the peer's walls (rms), and turned."""
WRONG_M = 0.5
SHARE = 0.3
"""Of the smaller map, so much is known to both from where on the errors are held against the bars."""
Kind = Literal["one flight", "two flights", "two levels"]
Results = dict[str, dict[str, Any]]


class Flights(NamedTuple):
    """Flights of one level: ranges `[ticks, worlds, drones, beams]` metres and estimated poses `[..., 3]`."""

    level: str
    ranges: NDArray[np.float32]
    poses: NDArray[np.float64]
    lidar: LidarSpec
    range_cap_m: float


class Member(NamedTuple):
    """One drone of one flight."""

    flights: Flights
    world: int
    drone: int

    def pose(self, tick: int) -> Pose:
        """Return where the drone takes itself to be, in the level's frame."""
        x, y, yaw = self.flights.poses[tick, self.world, self.drone].tolist()
        return Pose(x, y, yaw)


@dataclass(frozen=True)
class Look:
    """One attempt's outcome: the share of the smaller map that both know; errors where the place is trusted."""

    time_s: float
    share: float
    trusted: bool
    error_m: float
    error_rad: float
    cpu_s: float


@dataclass(frozen=True)
class Trial:
    """A pair of drones through their flights."""

    level: str
    other: str
    kind: Kind
    drift: bool
    looks: tuple[Look, ...]

    @property
    def is_wrong(self) -> bool:
        """Whether at any time a wrong place was trusted: of two levels, any."""
        return any(look.trusted and not look.error_m < WRONG_M for look in self.looks)


def fly(level: str, drift: bool, worlds: int, seed: int) -> Flights:
    """Fly `worlds` pairs of drones through a level and keep what they scanned and where they took themselves to be."""
    settings = ExplorationSettings(
        levels=(level,), worlds=worlds, drones=2, mirror=False, random_launch=True, protocol="off",
        episode_ticks=10 * SECONDS + 1, stop_coverage=1.0, drift=DriftSettings(enabled=drift),
    )  # fmt: skip
    env, pilot = Exploration(settings, seed, restart=False), baseline("coordinated", seed)
    observation = env.reset()
    pilot.begin(env)
    ranges, poses = [], []
    for tick in range(10 * SECONDS):
        if tick % EVERY == 0:
            ranges.append(env.ranges.copy())
            poses.append(env.estimates.copy())
        actions = np.clip(np.nan_to_num(pilot.act(env, observation)), -1.0, 1.0)
        observation = env.step(actions).observation
    return Flights(level, np.array(ranges), np.array(poses), env.lidar, settings.map.range_cap_m)


def attempt_pair(
    one: Member,
    other: Member,
    late: int,
    drift: bool,
    kind: Kind,
    rng: np.random.Generator,
    settings: AlignmentSettings,
) -> Trial:
    """Let one drone search for the other, who began `late` ticks later, every period of their flights."""
    shift_m = 5.0 if settings.launch_radius_m is None else 0.0  # else frames begin where the drones do
    frames = [compose(member.pose(0), _anywhere(rng, shift_m)) for member in (one, other)]
    evidence = EvidenceMap(1, half_extent_m=25.6, max_extent_m=256.0, shares_frame=False)
    placements = Placements(evidence, settings)
    truth = relative(*frames) if kind != "two levels" else None
    step = round(settings.period_s * 10 / EVERY)
    looks = []
    for tick in range(len(one.flights.ranges)):
        now = tick * EVERY / 10
        evidence.integrate(*_view(one, frames[0], tick, now), one.flights.range_cap_m)
        if tick >= late:
            evidence.integrate_provisional(2, *_view(other, frames[1], tick - late, now), other.flights.range_cap_m)
        if tick % step == step - 1 and tick >= late:
            begun = time.thread_time()
            for _ in range(200):  # slices of one attempt; more find nothing due
                placements.advance(now)
            looks.append(_look(evidence, placements, truth, now, time.thread_time() - begun))
    return Trial(one.flights.level, other.flights.level, kind, drift, tuple(looks))


def _anywhere(rng: np.random.Generator, shift_m: float) -> Pose:
    x, y, yaw = rng.uniform((-shift_m, -shift_m, -math.pi), (shift_m, shift_m, math.pi)).tolist()
    return Pose(x, y, yaw)


def _view(member: Member, frame: Pose, tick: int, now: float) -> tuple[Pose, Scan, LidarSpec]:
    scan = Scan(now, member.flights.ranges[tick, member.world, member.drone])
    return compose(inverse(frame), member.pose(tick)), scan, member.flights.lidar


def _look(evidence: EvidenceMap, placements: Placements, truth: Pose | None, now: float, cpu_s: float) -> Look:
    own, peer = (field_of(evidence.layers[source].cells, evidence.origin_cells) for source in (1, 2))
    pose = placements.place(2).pose
    share, error_m, error_rad = 0.0, math.inf, math.inf
    if truth is not None and own is not None and peer is not None:
        smaller = min(np.count_nonzero(own.known), np.count_nonzero(peer.known))
        share = judge(own, peer, truth).overlap / float(smaller)
        if pose is not None:
            off = transform_points(pose, peer.walls) - transform_points(truth, peer.walls)
            error_m = float(np.sqrt((off**2).sum(axis=1).mean()))
            error_rad = abs(wrap_angle(pose.yaw - truth.yaw))
    return Look(now, share, pose is not None, error_m, error_rad, cpu_s)


def run(
    pairs: int, seed: int, levels: tuple[str, ...], launch_radius_m: float | None, progress: Callable[[str], None]
) -> list[Trial]:
    """Fly the levels with drift and without, and try so many pairs of their drones.

    With `launch_radius_m` all pairs are of one flight, and it is known that they began so near to each other.
    """
    kinds, shares = np.array(["one flight", "two flights", "two levels"]), (0.35, 0.35, 0.3)
    if launch_radius_m is not None:
        shares = (1.0, 0.0, 0.0)
    settings = AlignmentSettings(launch_radius_m=launch_radius_m)
    rng = np.random.default_rng(seed)
    flown = {(level, drift): fly(level, drift, 4, seed + drift) for level in levels for drift in (False, True)}
    trials = []
    for number in range(pairs):
        level, drift = levels[number % len(levels)], bool(number // len(levels) % 2)
        kind: Kind = rng.choice(kinds, p=shares).item()
        world, second = rng.choice(4, 2, replace=False).tolist()
        one = Member(flown[level, drift], world, 0)
        if kind == "two levels":
            elsewhere = [name for name in levels if name != level]
            other = Member(flown[elsewhere[int(rng.integers(len(elsewhere)))], drift], second, 1)
        else:
            other = Member(flown[level, drift], world if kind == "one flight" else second, 1)
        trial = attempt_pair(one, other, int(rng.integers(0, 100)), drift, kind, rng, settings)
        trials.append(trial)
        progress(f"{number + 1}/{pairs} {trial.level} {trial.other} {kind}{' WRONG' if trial.is_wrong else ''}")
    return trials


def summary(trials: list[Trial]) -> Results:
    """Return the figures: wrong places, errors against the bars, who was trusted by how much overlap, time."""
    out: Results = {}

    def put(name: str, value: float, unit: str, **more: Any) -> None:
        out[name] = {"value": round(float(value), 4), "unit": unit} | more

    kinds = Counter(trial.kind for trial in trials)
    put("pairs", len(trials), "pairs", **{kind: kinds[kind] for kind in sorted(kinds)})
    put("wrong_pairs", sum(trial.is_wrong for trial in trials), "pairs")
    fitting = [t for t in trials if t.kind != "two levels"]
    looks = [look for trial in fitting for look in trial.looks if look.trusted and look.share >= SHARE]
    off = [look for look in looks if look.error_m > ERROR_M or look.error_rad > ERROR_RAD]
    put("places_off_the_bar", len(off), "attempts", of=len(looks))
    for name, values, unit in (
        ("error", [look.error_m for look in looks], "m"),
        ("turn", [math.degrees(look.error_rad) for look in looks], "degrees"),
    ):
        for quantile in (50, 95, 100):
            put(f"{name}_p{quantile}", np.percentile(values, quantile) if values else math.nan, unit)
    for what, among in (
        ("asymmetric", [t for t in fitting if t.level not in SYMMETRIC]),
        ("symmetric", [t for t in fitting if t.level in SYMMETRIC]),
    ):
        for low, high in itertools.pairwise((0.0, 0.1, 0.3, 0.5, 0.7, 0.9, 1.01)):
            at = [look.trusted for trial in among for look in trial.looks if low <= look.share < high]
            put(f"trusted_{what}_from_{low:.1f}", _mean(at), "share", attempts=len(at))
        put(f"trusted_{what}_at_the_end", _mean([t.looks[-1].trusted for t in among]), "share")
    waits = [w for trial in fitting if trial.level not in SYMMETRIC and (w := _wait_s(trial)) is not None]
    put("trusted_after_share", np.median(waits) if waits else math.nan, "s", what="from 30 % overlap to trust, median")
    cpu = [look.cpu_s for trial in trials for look in trial.looks]
    for quantile in (50, 95, 100):
        put(f"attempt_cpu_p{quantile}", np.percentile(cpu, quantile), "s")
    return out


def _mean(values: list[bool]) -> float:
    return sum(values) / len(values) if values else math.nan


def _wait_s(trial: Trial) -> float | None:
    """Return the time from the first look at enough overlap to the first at which the place was trusted."""
    shared = [look.time_s for look in trial.looks if look.share >= SHARE]
    trusted = [look.time_s for look in trial.looks if look.trusted]
    return max(0.0, trusted[0] - shared[0]) if shared and trusted else None


def main() -> None:
    """Read the flags, run, print, and write JSON where asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pairs", type=int, default=210)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--levels", default=",".join(LEVELS))
    parser.add_argument("--launch-radius", type=float, help="metres; only pairs of one flight, known to begin so near")
    parser.add_argument("--json", type=Path)
    flags = parser.parse_args()
    trials = run(
        flags.pairs,
        flags.seed,
        tuple(flags.levels.split(",")),
        flags.launch_radius,
        lambda text: print(text, flush=True),
    )
    results = summary(trials)
    for name, figure in results.items():
        print(f"{name:32} {figure['value']:10} {figure['unit']}", {k: v for k, v in figure.items() if k != "value"})
    if flags.json is not None:
        flags.json.write_bytes(msgspec.json.format(msgspec.json.encode(results), indent=1))


if __name__ == "__main__":
    main()
