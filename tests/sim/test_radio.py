"""The radio medium: who hears whom, when, and that the same inputs always give the same air."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from imagine.sim.radio import GROUND, Delivery, RadioMedium, RadioSettings

NEAR = np.array([[0.0, 0.0], [4.0, 0.0], [8.0, 0.0]])


def medium(drones: int = 3, seed: int = 0, walls: NDArray[np.float64] | None = None, **settings: float) -> RadioMedium:
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


def test_walls_between_two_drones_cost_range() -> None:
    wall = np.array([[2.0, -1.0, 2.0, 1.0], [2.1, -1.0, 2.1, 1.0]])  # both faces of one wall
    clear, walled = medium(walls=wall), medium(walls=wall, wall_m=2.0)
    assert clear.in_reach(NEAR)[1, 2]
    assert not walled.in_reach(NEAR)[1, 2]
    assert walled.in_reach(NEAR)[2, 3]
    past_the_end = NEAR + np.array([0.0, 3.0])
    assert walled.in_reach(past_the_end)[1, 2]


def test_a_ground_station_with_a_range_is_held_to_it() -> None:
    radio = medium(ground_range_m=5.0)
    assert radio.in_reach(NEAR)[GROUND].tolist() == [True, True, True, False]


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
