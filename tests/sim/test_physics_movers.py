"""People walk their loops and push drones aside, crates roll and stop, and drones that fell are in nobody's way."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from imagine.core.frames import Pose
from imagine.core.lidar import LidarSpec
from imagine.core.vehicle_limits import VehicleLimits
from imagine.sim.dynamics import TICK_S
from imagine.sim.level import Crate, Level, Person, load_level
from imagine.sim.movers import CRATE_DAMPING_PER_S
from imagine.sim.twin import Twin

BEAMS = LidarSpec(beams=360, noise_std=0.0)
ROOM = load_level("0")  # 6 x 6 m, empty
RADIUS_M = VehicleLimits().radius_m
SUBSTEP_M = 0.016


def room_with(people: Sequence[Person] = (), crates: Sequence[Crate] = ()) -> Level:
    return replace(ROOM, people=tuple(people), crates=tuple(crates))


def flying(level: Level, *poses: Pose) -> Twin:
    twin = Twin([level], len(poses), BEAMS)
    twin.set_level(0, level, poses)
    return twin


def fly(twin: Twin, forward: float, ticks: int = 1) -> None:
    for _ in range(ticks):
        twin.step(np.broadcast_to(np.array([forward, 0.0, 0.0]), (1, twin.drones, 3)))


def test_a_person_walks_the_whole_loop_at_the_stated_speed_and_again() -> None:
    loop = [(1.0, 1.0), (5.0, 1.0), (5.0, 4.0), (1.0, 4.0)]  # 14 m
    twin = flying(room_with([Person(loop=loop, speed_mps=0.7)]), Pose(3.0, 5.5, 0.0))
    start = twin.mover_discs[0, 0].copy()
    way, corners, last = 0.0, set(), start[:2]
    for _ in range(200):  # 14 m at 0.7 m/s
        fly(twin, 0.0)
        here = twin.mover_discs[0, 0, :2].copy()
        step = math.dist(here, last)
        assert step <= 0.07 + 1e-9
        way, last = way + step, here
        corners |= {corner for corner in loop if math.dist(corner, here) < 0.071}
    assert math.dist(last, start[:2]) < 1e-6
    assert way == pytest.approx(14.0, abs=0.2)  # corners are cut between two looks
    assert corners == set(loop)
    assert start[2] == 0.25


def test_where_people_start_follows_seed_and_episode_and_is_off_the_drones() -> None:
    level = room_with([Person(loop=[(1.0, 3.0), (5.0, 3.0)])])
    poses = [Pose(3.0, 3.0, 0.0)]
    places = []
    for seed in range(20):
        twin = Twin([level], 1, BEAMS, seed=seed)
        for _ in range(2):
            twin.set_level(0, level, poses)
            places.append(twin.mover_discs[0, 0, 0])
    assert len(set(places)) == 40
    assert min(abs(x - 3.0) for x in places) >= 0.25 + RADIUS_M + 0.5
    again = Twin([level], 1, BEAMS, seed=3)
    again.set_level(0, level, poses)
    assert again.mover_discs[0, 0, 0] == places[6]


def test_a_person_pushes_a_hovering_drone_along_and_it_is_one_contact() -> None:
    twin = flying(room_with([Person(loop=[(1.0, 3.0), (5.0, 3.0)])]), Pose(3.0, 3.02, 0.0))
    for _ in range(50):
        fly(twin, 0.0)
        gap = math.dist(twin.mover_discs[0, 0, :2], twin.poses[0, 0, :2]) - 0.25 - RADIUS_M
        assert gap > -0.001
    assert math.dist((3.0, 3.02), twin.poses[0, 0, :2]) > 0.2  # it was moved out of the way
    assert twin.mover_contacts[0, 0] == twin.contacts[0, 0] == 1
    fly(twin, 0.0, 100)
    assert np.hypot(*twin.velocity[0, 0, :2]) < 1e-3  # and hovers again, beside the way


def test_a_drone_that_flies_into_a_person_is_stopped_and_counts_it() -> None:
    twin = flying(room_with([Person(loop=[(4.0, 3.0), (4.0, 3.001)], speed_mps=0.01)]), Pose(2.0, 3.0, 0.0))
    fly(twin, 0.8, 40)
    assert twin.poses[0, 0, 0] == pytest.approx(4.0 - 0.25 - RADIUS_M, abs=0.002)
    assert twin.mover_contacts[0, 0] == 1
    assert twin.wall_contacts[0, 0] == 0


@pytest.mark.parametrize("speed", [0.8, 3.0])
def test_a_drone_pinned_between_a_person_and_a_wall_is_not_driven_into_the_wall(speed: float) -> None:
    # The loop brushes the wall itself, so there is no room for the drone, with a corner behind it at last.
    twin = flying(room_with([Person(loop=[(1.0, 0.3), (5.9, 0.3)], speed_mps=speed)]), *[
        Pose(3.0 + 0.3 * k, 0.1, 0.0) for k in range(3)
    ])  # fmt: skip
    for _ in range(400):
        fly(twin, 0.0)
        deepest = max(SUBSTEP_M, speed * 0.02)
        assert (twin.poses[0, :, :2] > RADIUS_M - deepest).all()
        assert (twin.poses[0, :, :2] < 6.0 - RADIUS_M + deepest).all()
    assert (twin.mover_contacts > 0).all()


def test_a_crate_is_pushed_by_a_drone_rolls_on_and_stops() -> None:
    crate = Crate(center=(3.0, 3.0), size=(0.4, 0.4), mass_kg=0.5)
    twin = flying(room_with(crates=[crate]), Pose(2.0, 3.0, 0.0))
    fly(twin, 0.8, 60)
    x = twin.mover_edges[0, :, 0].mean()
    assert x > 3.3
    assert twin.mover_contacts[0, 0] >= 1
    fly(twin, -0.8, 10)
    speeds = []
    for _ in range(10):
        before = twin.mover_edges[0, :, 0].mean()
        fly(twin, 0.0)
        speeds.append((twin.mover_edges[0, :, 0].mean() - before) / TICK_S)
    assert speeds[0] > 0.05
    np.testing.assert_allclose(np.array(speeds[1:]) / speeds[:-1], math.exp(-CRATE_DAMPING_PER_S * TICK_S), rtol=1e-3)


def test_a_heavy_crate_moves_less_and_none_leaves_the_room() -> None:
    def pushed(mass_kg: float, ticks: int) -> float:
        crate = Crate(center=(3.0, 3.0), size=(0.4, 0.4), mass_kg=mass_kg)
        twin = flying(room_with(crates=[crate]), Pose(2.0, 3.0, 0.0))
        fly(twin, 0.8, ticks)
        assert twin.mover_edges[..., ::2].max() < 6.0 + 0.002
        return float(twin.mover_edges[0, :, 0].mean() - 3.0)

    assert pushed(0.3, 60) > pushed(2.0, 60) > pushed(20.0, 60) > 0.0
    assert pushed(0.1, 200) == pytest.approx(6.0 - 0.2 - 3.0, abs=0.005)  # against the wall


def test_a_crate_shoved_off_its_centre_turns() -> None:
    twin = flying(room_with(crates=[Crate(center=(3.0, 3.0), size=(0.4, 0.4), mass_kg=0.3)]), Pose(2.0, 2.9, 0.0))
    fly(twin, 0.8, 40)
    (x0, y0), (x1, y1) = twin.mover_edges[0, 0, :2], twin.mover_edges[0, 0, 2:]
    assert math.hypot(x1 - x0, y1 - y0) == pytest.approx(0.4, abs=1e-9)
    assert math.atan2(y1 - y0, x1 - x0) > 0.05


def test_a_person_waits_where_a_crate_lies_and_goes_on_when_it_is_gone() -> None:
    person = Person(loop=[(1.0, 3.0), (5.0, 3.0)])
    blocked = room_with([person], [Crate(center=(3.0, 3.0), size=(0.4, 0.4), mass_kg=0.1)])
    twin = flying(blocked, Pose(5.5, 5.5, 0.0))
    fly(twin, 0.0, 200)
    apart = abs(twin.mover_discs[0, 0, 0] - 3.0) - 0.2
    assert 0.25 <= apart < 0.25 + 0.8 * 0.02
    np.testing.assert_allclose(twin.mover_edges[0, :, 0].mean(), 3.0, atol=1e-9)
    # a drone comes and pushes the crate across the loop
    twin = flying(blocked, Pose(3.0, 5.0, -math.pi / 2))
    fly(twin, 0.0, 100)
    side = math.copysign(1.0, twin.mover_discs[0, 0, 0] - 3.0)
    fly(twin, 0.8, 100)
    assert twin.mover_edges[0, :, 1].max() < 3.0 - 0.25
    fly(twin, -0.8, 15)
    seen = set()
    for _ in range(100):
        fly(twin, 0.0)
        seen.add(math.copysign(1.0, twin.mover_discs[0, 0, 0] - 3.0))
    assert -side in seen


def test_no_drone_is_driven_into_a_wall_by_people_and_crates() -> None:
    people = [
        Person(loop=[(0.4, 0.4), (5.6, 0.4), (5.6, 5.6), (0.4, 5.6)], speed_mps=1.5),
        Person(loop=[(1.0, 3.0), (5.0, 3.0)], speed_mps=3.0),
    ]
    crates = [
        Crate(center=(1.0 + 1.3 * k, 2.0), size=(0.5, 0.4), mass_kg=mass) for k, mass in enumerate((0.1, 2.0, 0.5, 9.0))
    ]
    levels = [room_with(people, crates)] * 16
    twin = Twin(levels, 3, BEAMS)
    rng = np.random.default_rng(1)
    nearest = math.inf
    for tick in range(2000):
        if tick % 10 == 0:
            angle = rng.uniform(-math.pi, math.pi, (16, 3))
            setpoints = np.stack((0.8 * np.cos(angle), 0.8 * np.sin(angle), 0.0 * angle), axis=-1)
        twin.step(setpoints)
        nearest = min(nearest, twin.poses[..., :2].min(), 6.0 - twin.poses[..., :2].max())
        assert twin.mover_edges.min() > -0.03
        assert twin.mover_edges.max() < 6.03
    assert nearest > RADIUS_M - 3.0 * 0.02  # what pushed it came at 3 m/s
    assert twin.mover_contacts.sum() > 500


def test_lidars_see_people_and_crates_where_they_are() -> None:
    level = room_with(
        [Person(loop=[(3.0, 5.0), (3.0, 5.001)], speed_mps=0.01)],
        [Crate(center=(5.0, 3.0), size=(0.4, 0.4)), Crate(center=(3.0, 1.0), size=(1.0, 1.0), yaw_deg=45)],
    )
    scan = flying(level, Pose(3.0, 3.0, 0.0)).scan()[0, 0]
    assert scan[0] == pytest.approx(1.8, abs=1e-5)
    assert scan[90] == pytest.approx(2.0 - 0.25, abs=2e-3)
    assert scan[270] == pytest.approx(2.0 - math.sqrt(0.5), abs=2e-2)
    assert scan[180] == pytest.approx(3.0, abs=1e-5)


def test_a_level_with_more_in_it_than_any_before_leaves_the_other_worlds_as_they_are() -> None:
    first = room_with([Person(loop=[(1.0, 1.0), (5.0, 1.0)])], [Crate(center=(3.0, 3.0), size=(0.4, 0.4))])
    fuller = room_with(
        [Person(loop=[(1.0, 5.0), (3.0, 5.5), (5.0, 5.0), (4.0, 4.0)])] * 3,
        [Crate(center=(1.0 + k, 2.0), size=(0.3, 0.3)) for k in range(4)],
    )
    pose = [Pose(2.0, 3.0, 0.0)]
    changed, left = (Twin([first, first], 1, BEAMS) for _ in range(2))
    for twin in (changed, left):
        for world in range(2):
            twin.set_level(world, first, pose)
        fly_all(twin, 10)
    changed.set_level(1, fuller, pose)
    assert (changed.mover_discs[1, :, 2] > 0).sum() == 3
    assert np.abs(changed.mover_edges[1]).any(axis=-1).sum() == 16
    for twin in (changed, left):
        fly_all(twin, 30)
    np.testing.assert_array_equal(changed.poses[0], left.poses[0])
    np.testing.assert_array_equal(changed.mover_discs[0, :1], left.mover_discs[0])
    assert not changed.mover_discs[0, 1:].any()
    np.testing.assert_array_equal(changed.mover_edges[0, :4], left.mover_edges[0])
    changed.set_level(1, ROOM, pose)
    assert not changed.mover_discs[1].any()
    assert not changed.mover_edges[1].any()


def fly_all(twin: Twin, ticks: int) -> None:
    for _ in range(ticks):
        twin.step(np.broadcast_to(np.array([0.8, 0.0, 0.0]), (twin.worlds, twin.drones, 3)))


def test_a_drone_that_fell_lies_still_and_is_in_nobodys_way_or_sight() -> None:
    person = Person(loop=[(1.0, 3.0), (5.0, 3.0)])
    twin = flying(room_with([person], [Crate(center=(4.0, 4.5), size=(0.3, 0.3), mass_kg=0.1)]), *[
        Pose(2.0, 4.5, 0.0), Pose(3.0, 4.5, 0.0), Pose(3.0, 1.5, 1.0)
    ])  # fmt: skip
    fly(twin, 0.4, 3)
    twin.alive[0, 1] = False
    fell = twin.poses[0, 1].copy()
    fly(twin, 0.8, 30)
    np.testing.assert_array_equal(twin.poses[0, 1], fell)
    assert not twin.velocity[0, 1].any()
    assert twin.poses[0, 0, 0] > fell[0] + 0.3  # the first drone flew over it
    assert twin.drone_contacts[0].tolist() == [0, 0, 0]
    assert twin.mover_contacts[0, 1] == 0
    scans = twin.scan()[0]
    assert np.isnan(scans[1]).all()
    back = round(math.degrees(math.atan2(fell[1] - twin.poses[0, 0, 1], fell[0] - twin.poses[0, 0, 0])))
    assert scans[0, back] > 2.0  # the wall behind, not the drone that lies between


def test_a_drone_that_is_up_again_flies_on_from_where_it_lay() -> None:
    twin = flying(ROOM, Pose(2.0, 3.0, 0.0), Pose(4.0, 1.0, 0.0))
    fly(twin, 0.8, 5)
    twin.alive[0, 0] = False
    fly(twin, 0.8, 5)
    lay = twin.poses[0, 0].copy()
    twin.alive[0, 0] = True
    fly(twin, 0.8, 5)
    assert lay[0] + 0.05 < twin.poses[0, 0, 0] < lay[0] + 0.4
    fly(twin, 0.8, 60)
    assert twin.poses[0, 0, 0] == pytest.approx(6.0 - RADIUS_M, abs=0.003)  # and walls are there for it
    twin.alive[0, 0] = False
    fly(twin, 0.0)
    twin.set_level(0, ROOM, [Pose(2.0, 3.0, 0.0), Pose(4.0, 1.0, 0.0)])
    assert twin.alive.all()


def test_sliding_along_a_wall_of_many_edges_is_one_contact() -> None:
    angles = np.linspace(0.0, 2.0 * math.pi, 60, endpoint=False)
    pillar = np.column_stack((3.0 + 1.0 * np.cos(angles), 3.0 + 1.0 * np.sin(angles)))  # edges of 0.1 m
    notched = np.array([[0.0, 0.0], [0.6, 0.0], [0.6, 1.0], [0.3, 0.5], [0.0, 1.0]])
    twin = flying(replace(ROOM, solids=(pillar, notched)), Pose(0.8, 3.3, 0.0))
    for _ in range(150):
        twin.step(np.array([[[0.8, 0.0, 0.0]]]))
        assert twin.levels[0].is_free(twin.poses[0, :, :2]).all()
        assert twin.poses[0, 0, 0] < 6.0 - RADIUS_M + 0.003
        if math.dist(twin.poses[0, 0, :2], (3.0, 3.0)) > 1.5 and twin.poses[0, 0, 0] > 3.0:
            break
    assert twin.poses[0, 0, 0] > 3.0  # it went round
    assert twin.wall_contacts[0, 0] == 1
