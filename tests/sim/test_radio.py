"""The radio medium: who hears whom, when, and that the same inputs always give the same air."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from imagine.sim.propagation import crossings
from imagine.sim.radio import GROUND, Delivery, RadioMedium, RadioSettings

NEAR = np.array([[0.0, 0.0], [4.0, 0.0], [8.0, 0.0]])
WALL = np.array([[2.0, -1.0, 2.0, 1.0], [2.1, -1.0, 2.1, 1.0]])  # both faces of one wall


def medium(drones: int = 3, seed: int = 0, walls: NDArray[np.float64] | None = None, **settings: object) -> RadioMedium:
    return RadioMedium(drones, RadioSettings.model_validate(settings), np.random.default_rng(seed), walls)


def test_drones_in_range_and_the_ground_hear_it_others_do_not() -> None:
    radio = medium()
    radio.send(1, b"hello", 0.0)
    heard = radio.deliver(1.0, NEAR)
    assert [(d.receiver, d.datagram) for d in heard] == [(GROUND, b"hello"), (2, b"hello")]
    assert radio.links[1][3].out_of_range == 1
    assert radio.links[1][2].delivered_bytes == 5
    radio.send(GROUND, b"land", 1.0)
    assert [d.receiver for d in radio.deliver(2.0, NEAR)] == [1, 2, 3]


def test_a_datagram_takes_its_size_over_the_rate_and_the_latency() -> None:
    radio = medium(rate_bps=8000.0, latency_s=0.02)
    radio.send(1, bytes(100), 0.0)
    assert radio.deliver(0.119, NEAR) == []
    assert len(radio.deliver(0.121, NEAR)) == 2


def test_a_sender_is_held_to_its_rate_and_others_are_not_delayed_by_it() -> None:
    radio = medium(rate_bps=8000.0, latency_s=0.0)
    for _ in range(20):
        assert radio.send(1, bytes(100), 0.0)
    radio.send(2, bytes(100), 0.0)
    heard = radio.deliver(1.0, NEAR)
    assert sum(d.sender == 1 and d.receiver == GROUND for d in heard) == 10
    assert sum(d.sender == 2 and d.receiver == GROUND for d in heard) == 1


def test_a_full_queue_drops_and_counts() -> None:
    radio = medium(rate_bps=8000.0, queue_bytes=1000)
    taken = [radio.send(1, bytes(100), 0.0) for _ in range(15)]
    assert taken == [True] * 10 + [False] * 5
    assert (radio.sent[1].sent, radio.sent[1].dropped) == (10, 5)
    assert radio.send(1, bytes(100), 0.5)


def test_losses_come_at_their_rate_and_repeat_with_the_seed() -> None:
    def fly(seed: int) -> list[Delivery]:
        radio = medium(seed=seed, loss=0.3, queue_bytes=10**9, rate_bps=1e9)
        for k in range(1000):
            radio.send(1, k.to_bytes(2, "little"), 0.0)
        return radio.deliver(1.0, NEAR)

    first = fly(5)
    assert len(first) == pytest.approx(1400, rel=0.05)
    assert fly(5) == first
    assert fly(6) != first


def test_the_disc_goes_through_walls() -> None:
    assert medium(walls=WALL).in_reach(NEAR)[1, 2]


def test_behind_a_wall_the_path_loss_grows_and_the_reach_shrinks() -> None:
    radio = medium(walls=WALL, model="path-loss", tx_dbm=-15.0)
    assert radio.settings.propagation.clear_m == pytest.approx(5.62, abs=0.01)
    assert radio.settings.propagation.walled_m == pytest.approx(2.37, abs=0.01)
    reach = radio.in_reach(NEAR)
    assert not reach[1, 2]  # 4 m, the wall between
    assert reach[2, 3]  # 4 m in the clear
    assert radio.in_reach(NEAR + np.array([0.0, 3.0]))[1, 2]  # past the end of the wall
    assert radio.in_reach(np.array([[0.9, 0.0], [3.2, 0.0], [9.0, 0.0]]))[1, 2]  # near enough through the wall


def test_the_default_path_loss_is_a_radio_of_a_milliwatt() -> None:
    propagation = RadioSettings(model="path-loss").propagation
    assert propagation.clear_m == pytest.approx(31.6, abs=0.05)  # 30 dB over 20 dB a decade
    assert propagation.walled_m == pytest.approx(5.62, abs=0.01)  # 30 dB over 40 dB a decade


@pytest.mark.parametrize(("walls_between", "farthest_m"), [(0, 10.0), (1, 5.62), (2, 3.16), (3, 1.78)])
def test_each_wall_may_cost_decibels(walls_between: int, farthest_m: float) -> None:
    faces = np.concatenate([WALL + np.array([0.2 * k - 1.9, 0.0] * 2) for k in range(walls_between)] or [WALL + 50.0])
    radio = medium(walls=faces, model="path-loss", tx_dbm=-10.0, wall_db=5.0)
    for distance, hears in ((farthest_m - 0.02, True), (farthest_m + 0.02, False)):
        there = np.array([[0.0, 0.0], [distance, 0.0], [90.0, 0.0]])
        assert bool(radio.in_reach(there)[1, 2]) is hears


def test_a_transmitter_too_weak_for_the_first_metre_is_heard_by_nobody() -> None:
    radio = medium(model="path-loss", tx_dbm=-31.0)
    assert not radio.in_reach(NEAR)[1:, 1:].any()


coordinate = st.integers(-8, 8).map(float)
points = st.tuples(coordinate, coordinate)


@given(points, points, st.lists(st.tuples(coordinate, coordinate, coordinate, coordinate), max_size=8))
@example((0.0, -1.0), (0.0, 2.0), [(0.0, 0.0, 1.0, 0.0)])  # a wall that ends on the line
def test_reach_is_mutual_and_between_that_behind_walls_and_that_in_the_clear(
    a: tuple[float, float], b: tuple[float, float], walls: list[tuple[float, float, float, float]]
) -> None:
    radio = medium(walls=np.array(walls).reshape(-1, 4), model="path-loss", tx_dbm=-12.0)
    there, back = (radio.in_reach(np.array([*pair, (99.0, 99.0)])) for pair in ((a, b), (b, a)))
    assert there[1, 2] == there[2, 1] == back[1, 2]
    distance, limits = float(np.hypot(a[0] - b[0], a[1] - b[1])), radio.settings.propagation
    if distance <= limits.walled_m - 1e-9:
        assert there[1, 2]
    elif distance > limits.clear_m + 1e-9:
        assert not there[1, 2]
    elif not walls:
        assert there[1, 2]


halves = st.tuples(coordinate.map(lambda v: v + 0.5), coordinate.map(lambda v: v + 0.5))


@given(halves, halves, st.lists(points, min_size=3, max_size=6))
def test_a_line_between_two_sides_of_a_closed_loop_crosses_it_oddly(
    a: tuple[float, float], b: tuple[float, float], corners: list[tuple[float, float]]
) -> None:
    """Also through corners, which ends on half metres and corners on whole ones make common."""
    loop = np.array(corners)
    turns = []
    for point in (a, b):
        there, then = loop - point, np.roll(loop, -1, axis=0) - point
        swept = np.arctan2(
            there[:, 0] * then[:, 1] - there[:, 1] * then[:, 0], there[:, 0] * then[:, 0] + there[:, 1] * then[:, 1]
        )
        assume(np.abs(np.abs(swept) - np.pi).min() > 1e-6)  # not on an edge
        turns.append(round(swept.sum() / (2 * np.pi)))  # the winding number
    faces = np.hstack((loop, np.roll(loop, -1, axis=0)))
    assert crossings(*a, *b, faces, 99) % 2 == sum(turns) % 2


def test_a_ground_station_with_a_range_is_held_to_it() -> None:
    radio = medium(ground_range_m=5.0)
    assert radio.in_reach(NEAR)[GROUND].tolist() == [False, True, True, False]


def test_links_count_bytes_and_the_ticks_in_reach() -> None:
    radio = medium(loss=0.5, queue_bytes=10**6)
    for tick in range(1, 21):
        radio.send(1, bytes(100), 0.1 * tick - 0.09)
        radio.deliver(0.1 * tick, NEAR if tick <= 15 else NEAR * 2.0)
        radio.deliver(0.1 * tick, NEAR)  # asked again at the same time: the same tick
    link = radio.links[1][2]
    assert (link.ticks, radio.links[2][1].ticks, radio.links[1][3].ticks) == (15, 15, 0)
    assert link.delivered + link.lost == 15
    assert (link.out_of_range, radio.links[1][3].out_of_range) == (5, 20)
    assert link.delivered_bytes == 100 * link.delivered > 0
    assert link.lost_bytes == 100 * link.lost > 0


sends = st.lists(st.tuples(st.integers(0, 3), st.integers(1, 1200), st.integers(0, 20)), max_size=40)


@given(sends, st.integers(1, 5))
def test_arrivals_do_not_depend_on_how_often_they_are_asked_for(
    queued: list[tuple[int, int, int]], polls_a_tick: int
) -> None:
    def fly(polls: int) -> list[Delivery]:
        radio = medium(seed=1, loss=0.2)
        heard: list[Delivery] = []
        for tick in range(60):
            for number, (sender, size, at) in enumerate(queued):
                if at == tick:
                    radio.send(sender, bytes([number]) * size, 0.1 * tick)
            for poll in range(polls):
                heard += radio.deliver(0.1 * (tick + (poll + 1) / polls) - 1e-6, NEAR)
        return heard

    assert fly(polls_a_tick) == fly(1)


@given(sends)
def test_each_sender_is_heard_in_order_and_never_above_its_rate(queued: list[tuple[int, int, int]]) -> None:
    radio = medium()
    for number, (sender, size, _) in enumerate(queued):
        radio.send(sender, bytes([number]) * size, 0.0)
    seconds = 0.2
    heard = radio.deliver(seconds, np.zeros((3, 2)))
    for sender in range(4):
        for receiver in range(4):
            mine = [d.datagram for d in heard if (d.sender, d.receiver) == (sender, receiver)]
            assert [d[0] for d in mine] == sorted(d[0] for d in mine)
            assert 8 * sum(map(len, mine)) <= seconds * 250_000
