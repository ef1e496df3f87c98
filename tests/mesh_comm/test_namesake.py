"""Two nodes under one id find out; recordings of one's own past say nothing."""

from __future__ import annotations

import contextlib
import itertools

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from radio_room import KEY, exchange, make_drone

from imagine.core.frames import Pose
from imagine.mesh_comm.seal import Rejected, Sealer


def hear(sealer: Sealer, *datagrams: bytes, now: float = 0.0) -> None:
    for datagram in datagrams:
        with contextlib.suppress(Rejected):
            sealer.open(datagram, now)


@given(st.lists(st.booleans(), min_size=400, max_size=400))
def test_two_nodes_with_one_id_both_find_out_over_a_radio_that_loses_half(lost: list[bool]) -> None:
    nodes, losses = [Sealer(KEY, 2, 10), Sealer(KEY, 2, 20)], iter(itertools.cycle([*lost, False]))
    for tick in range(200):
        now = tick / 10
        for node, other in itertools.permutations(nodes):
            for datagram in (node.seal(b"status", now), node.claim(now)):
                if datagram is not None and not next(losses):
                    hear(other, datagram, now=now)
    assert [node.has_namesake for node in nodes] == [True, True]


def test_two_nodes_started_in_the_same_second_find_out_by_their_first_word() -> None:
    a, b = Sealer(KEY, 2, 10, first_counter=1), Sealer(KEY, 2, 10, first_counter=1000)
    hear(a, b.seal(b"", 0.0))
    hear(b, a.seal(b"", 0.0))
    assert a.has_namesake
    assert b.has_namesake
    assert a.rejected == {"own-id": 1}


@given(st.lists(st.integers(1, 9), max_size=30), st.lists(st.integers(1, 9), max_size=30))
def test_recordings_of_ones_own_earlier_lives_prove_nothing_and_are_not_answered(
    spoken: list[int], overheard: list[int]
) -> None:
    lives = {boot: Sealer(KEY, 2, boot) for boot in range(1, 10)}
    recorded = [lives[boot].seal(b"status", 0.0) for boot in spoken]
    for boot, other in zip(overheard, reversed(overheard), strict=True):  # they may have met namesakes of their own
        hear(lives[boot], lives[other].seal(b"", 0.0))
        recorded += [claim for claim in (lives[boot].claim(1e3 * len(recorded)),) if claim is not None]
    now_living = Sealer(KEY, 2, 10)
    hear(now_living, *recorded, *recorded)
    assert not now_living.has_namesake
    assert now_living.claim(0.0) is None


def test_recordings_with_a_later_boot_number_are_answered_but_prove_nothing() -> None:
    """Such as one's own, once the file with the boot number is lost and the clock is wrong."""
    past = Sealer(KEY, 2, 50)
    recorded = [past.seal(b"status", 0.0) for _ in range(20)]
    living = Sealer(KEY, 2, 10)
    claims = 0
    for tick in range(100):
        hear(living, recorded[tick % 20], now=tick / 10)
        claims += living.claim(tick / 10) is not None
    assert not living.has_namesake
    assert 15 <= claims <= 20  # two a second


def test_an_own_datagram_that_comes_back_is_an_echo() -> None:
    a = Sealer(KEY, 2, 10, first_counter=7)
    hear(a, a.seal(b"", 0.0), a.seal(b"", 0.0))
    assert a.rejected == {"echo": 2}
    assert not a.has_namesake


def test_a_claim_means_nothing_to_others_and_does_not_disturb_them() -> None:
    a, b, other = Sealer(KEY, 2, 10), Sealer(KEY, 2, 20), Sealer(KEY, 3, 1)
    hear(a, b.seal(b"", 0.0))
    claim = a.claim(0.0)
    assert claim is not None
    hear(other, claim)
    assert other.rejected == {"claim": 1}
    assert other.open(a.seal(b"x", 0.0), 0.0).payload == b"x"


def test_nodes_with_one_id_know_it_within_seconds_and_the_rest_of_the_swarm_does_not_mind() -> None:
    drones = [make_drone(2, boot=10), make_drone(2, boot=20), make_drone(3)]
    for number, drone in enumerate(drones):
        drone.fly(Pose(0.1 * number, 0.0, 0.0), 0.0)
    exchange(drones, np.arange(0.0, 3.0, 0.1))
    assert [drone.node.has_namesake for drone in drones] == [True, True, False]
    assert "malformed" not in drones[2].node.stats
