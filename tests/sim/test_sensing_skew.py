"""Scans taken while the drone moves: each beam from where the drone was when it was taken."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from ray_reference import furthest_error, reference

from imagine.core.lidar import LidarSpec
from imagine.sim.level import BUILT_IN, Level, load_level
from imagine.sim.lidar_model import LidarModel
from imagine.sim.sensing import Sensing
from imagine.sim.workers import Workers

LEVELS = {name: load_level(name) for name in BUILT_IN}
IDEAL = LidarSpec(beams=120, noise_std=0.0, range_min=0.0)
HALF_TURN = LidarSpec(beams=60, fov=math.pi, start=-math.pi / 2, noise_std=0.0, range_min=0.0, rate_hz=5.0)


def skewed(
    level: Level, poses: NDArray[np.float64], velocity: NDArray[np.float64], spec: LidarSpec, **rest: object
) -> NDArray[np.float64]:
    """Return skewed scans `[n, beams]` of drones that do not see each other."""
    sensing = Sensing(1, len(poses), spec, 0, Workers(1), model=LidarModel(skew=True))
    sensing.set_level(0, level)
    return sensing.scan(poses[None], velocity[None], 0.0, 0, **rest)[0].astype(np.float64)  # type: ignore[arg-type]


def beam_by_beam(
    level: Level, pose: NDArray[np.float64], velocity: NDArray[np.float64], spec: LidarSpec, turn_s: float, reach: float
) -> NDArray[np.float64]:
    ago = (1.0 - np.arange(spec.beams) / spec.beams)[:, None] * turn_s
    then = pose - velocity * ago
    return reference(level.segments, level.circles, then[:, :2], then[:, 2] + spec.bearings, reach)


def drawn(level: Level, count: int, rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    low, high = level.outline.min(axis=0), level.outline.max(axis=0)
    places = rng.uniform(low, high, (10 * count, 2))
    places = places[level.is_free(places, 0.21)][:count]
    course, speed = rng.uniform(-math.pi, math.pi, len(places)), rng.uniform(0.0, 1.0, len(places))
    poses = np.column_stack((places, rng.uniform(-9.0, 9.0, len(places))))
    rates = rng.uniform(-3.0, 3.0, len(places))
    return poses, np.column_stack((speed * np.cos(course), speed * np.sin(course), rates))


@pytest.mark.parametrize(("spec", "turn_s"), [(IDEAL, 0.1), (HALF_TURN, 0.1)])
@pytest.mark.parametrize("name", BUILT_IN)
def test_each_beam_is_taken_from_where_the_drone_then_was(name: str, spec: LidarSpec, turn_s: float) -> None:
    level = LEVELS[name]
    poses, velocity = drawn(level, 60, np.random.default_rng(int(name)))
    for reach in (3.0, 12.0):
        found = skewed(level, poses, velocity, spec, reach_m=reach)
        for k in range(len(poses)):
            exact = beam_by_beam(level, poses[k], velocity[k], spec, turn_s, reach)
            assert furthest_error(found[k], exact) <= 0.001


def test_a_drone_at_rest_has_no_skew() -> None:
    level = LEVELS["6"]
    poses, _ = drawn(level, 40, np.random.default_rng(3))
    still = Sensing(1, 40, IDEAL, 0, Workers(1))
    still.set_level(0, level)
    nowhere = np.zeros_like(poses)
    plain = still.scan(poses[None], nowhere[None], 0.0, 0)[0]
    assert furthest_error(skewed(level, poses, nowhere, IDEAL), plain.astype(np.float64)) <= 1e-5


def test_a_drone_that_flies_at_a_wall_saw_it_from_further_off_in_its_first_beam() -> None:
    """At the stamp it is 3 m from the wall; a turn earlier, when beam 0 was taken, 8 cm more."""
    scan = skewed(LEVELS["0"], np.array([[3.0, 3.0, 0.0]]), np.array([[0.8, 0.0, 0.0]]), IDEAL)[0]
    assert scan[0] == pytest.approx(3.08)
    assert scan[60] == pytest.approx(3.0 - 0.04)  # backward, half a turn later


def test_a_turning_drone_spreads_its_beams_over_more_than_a_turn() -> None:
    """Turning left at 3 rad/s, beam 0 looked 0.3 rad further right than straight ahead at the stamp."""
    scan = skewed(LEVELS["0"], np.array([[3.0, 3.0, 0.0]]), np.array([[0.0, 0.0, 3.0]]), IDEAL)[0]
    assert scan[0] == pytest.approx(3.0 / math.cos(0.3))


def test_moving_things_and_teammates_are_where_they_are_at_the_stamp() -> None:
    sensing = Sensing(1, 2, IDEAL, 0, Workers(1), model=LidarModel(skew=True))
    sensing.set_level(0, LEVELS["0"])
    poses = np.array([[[3.0, 3.0, 0.0], [3.0, 5.0, 0.0]]])
    velocity = np.array([[[0.0, 0.8, 0.0], [0.0, 0.0, 0.0]]])
    disc = np.array([[[1.5, 3.0, 0.25]]])
    edge = np.array([[[2.5, 2.0, 3.5, 2.0]]])
    scan = sensing.scan(poses, velocity, 0.1, 0, disc, edge)[0, 0]
    assert scan[30] == pytest.approx(2.0 + 0.75 * 0.08 - 0.1, abs=1e-5)  # left, a quarter of a turn after beam 0
    assert scan[60] == pytest.approx(1.5 - 0.25, abs=0.004)  # behind: 4 cm off its middle
    assert scan[90] == pytest.approx(1.0 - 0.25 * 0.08, abs=1e-5)  # right
    assert sensing.scan(poses, velocity, 0.1, 0)[0, 0, 60] > 2.9


def test_a_sensor_that_slides_along_a_wall_sees_the_wall() -> None:
    level = LEVELS["0"]
    scan = skewed(level, np.array([[3.0, 0.0, 0.0]]), np.array([[0.8, 0.0, 0.0]]), IDEAL)[0]
    assert (scan[61:120] < 1e-5).all()
    assert (scan[1:60] > 1.0).all()
