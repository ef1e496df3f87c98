"""Sealing: only true, fresh datagrams open, whatever the air does to them."""

from __future__ import annotations

import contextlib
import itertools

import numpy as np
import pytest
from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305
from hypothesis import given
from hypothesis import strategies as st

from imagine.core.errors import InputError
from imagine.mesh_comm.budget import TokenBucket
from imagine.mesh_comm.keyring import KeyRing, SwarmKey, ground_public
from imagine.mesh_comm.replay import WINDOW
from imagine.mesh_comm.seal import OVERHEAD, SIGNATURE_BYTES, Rejected, Sealer

KEY = bytes(32)
OTHER = bytes(31) + b"\1"
SIGN = bytes(range(32))


def pair() -> tuple[Sealer, Sealer]:
    return Sealer(KEY, 1, 10), Sealer(KEY, 2, 10)


def refusal(sealer: Sealer, datagram: bytes, now: float = 0.0) -> str:
    with pytest.raises(Rejected) as caught:
        sealer.open(datagram, now)
    return caught.value.reason


@given(st.binary(max_size=1170))
def test_a_payload_comes_back_with_its_sender(payload: bytes) -> None:
    a, b = pair()
    datagram = a.seal(payload, 0.0)
    assert len(datagram) == len(payload) + OVERHEAD
    assert payload not in datagram or len(payload) < 4
    assert b.open(datagram, 0.0) == (1, 10, 1, payload)


@given(st.data())
def test_any_changed_bit_is_refused_and_nothing_moves(data: st.DataObject) -> None:
    a, b = pair()
    true = a.seal(b"a message", 0.0)
    for _ in range(data.draw(st.integers(1, 5))):
        datagram = bytearray(true)
        datagram[data.draw(st.integers(0, len(datagram) - 1))] ^= 1 << data.draw(st.integers(0, 7))
        refusal(b, bytes(datagram))
    assert b.open(true, 0.0).payload == b"a message"


@given(st.binary(max_size=200))
def test_noise_is_refused_and_counted(noise: bytes) -> None:
    _, b = pair()
    reason = refusal(b, noise)
    assert b.rejected == {reason: 1}


@given(st.data())
def test_each_datagram_opens_once_in_any_order_however_often_it_comes(data: st.DataObject) -> None:
    a, b = pair()
    datagrams = [a.seal(bytes((i,)), 0.0) for i in range(40)]
    heard = [0, *data.draw(st.lists(st.integers(0, 39), max_size=120))]
    opened = []
    for index in heard:
        with contextlib.suppress(Rejected):
            opened.append(b.open(datagrams[index], 0.0).payload[0])
    assert opened == list(dict.fromkeys(heard))
    assert b.rejected.total() == b.rejected["replay"] == len(heard) - len(opened)


def test_what_falls_behind_the_window_is_refused() -> None:
    a, b = pair()
    first, *datagrams = [a.seal(b"", 0.0) for _ in range(WINDOW + 2)]
    b.open(first, 0.0)
    b.open(datagrams[WINDOW], 0.0)
    b.open(datagrams[1], 0.0)
    assert refusal(b, datagrams[0]) == "replay"


@given(st.integers(0, 29), st.permutations(range(30)))
def test_nothing_said_before_a_sender_was_first_heard_is_taken_after_that(first: int, order: list[int]) -> None:
    a, b = pair()
    datagrams = [a.seal(bytes((i,)), 0.0) for i in range(30)]
    b.open(datagrams[first], 0.0)
    for index in order:
        if index <= first:
            assert refusal(b, datagrams[index]) == "replay"
        else:
            assert b.open(datagrams[index], 0.0).payload == bytes((index,))


def test_a_restarted_sender_is_heard_and_its_past_is_not() -> None:
    a, b = pair()
    past = [a.seal(b"", 0.0) for _ in range(3)]
    b.open(past[0], 0.0)
    again = Sealer(KEY, 1, 11)
    assert b.open(again.seal(b"new", 0.0), 0.0).boot == 11
    assert refusal(b, past[1]) == "old-boot"


def test_every_refusal_is_counted_under_its_reason() -> None:
    a, b = pair()
    good = a.seal(b"payload", 0.0)
    wrong = {
        b"": "short", bytes(29): "short", b"XX" + good[2:]: "magic", good[:2] + b"\x09" + good[3:]: "version",
        good[:5] + b"\x80" + good[6:]: "flags", Sealer(OTHER, 1, 10).seal(b"payload", 0.0): "unknown-key",
        good[:-1] + bytes((good[-1] ^ 1,)): "forged", b.seal(b"", 0.0): "echo",
        Sealer(KEY, 2, 9).seal(b"", 0.0): "own-id",
    }  # fmt: skip
    assert [refusal(b, datagram) for datagram in wrong] == list(wrong.values())
    assert b.rejected.total() == len(wrong)


def test_a_datagram_of_one_drone_does_not_open_as_anothers() -> None:
    a, b = pair()
    datagram = bytearray(a.seal(b"I am 1", 0.0))
    datagram[4] = 3
    assert refusal(b, bytes(datagram)) == "forged"
    assert SwarmKey(KEY).sender_secret(1) != SwarmKey(KEY).sender_secret(3)


def test_a_forger_cannot_move_the_window() -> None:
    a, b = pair()
    first, second = a.seal(b"1", 0.0), a.seal(b"2", 0.0)
    ahead = bytearray(first)
    ahead[6] = 0xFF  # a later boot, unauthenticated
    assert refusal(b, bytes(ahead)) == "forged"
    assert b.open(first, 0.0).payload == b"1"
    assert b.open(second, 0.0).payload == b"2"


def test_wrong_key_id_boot_or_counter_is_named() -> None:
    for key, own, boot, first, word in (
        (bytes(31), 1, 1, 1, "31 bytes"), (KEY, 255, 1, 1, "255"), (KEY, 1, -1, 1, "-1"), (KEY, 1, 1, 0, "counter"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=word):
            Sealer(key, own, boot, first_counter=first)


# --- keys that change ----------------------------------------------------------------------------------------------


OLD = SwarmKey(KEY, accepted_until=2000.0)
NEW = SwarmKey(OTHER, made_at=500.0, sends_from=1000.0)
BOTH = KeyRing((OLD, NEW))


def test_the_new_key_sends_from_its_time_and_the_old_one_opens_until_its_end() -> None:
    a, b, behind = Sealer(BOTH, 1, 1, unix_time_s=900.0), Sealer(BOTH, 2, 1, unix_time_s=900.0), Sealer(KEY, 3, 1)
    first = a.seal(b"", 0.0)
    assert first[3] == a.seal(b"", 99.9)[3] == OLD.id
    later = a.seal(b"new", 100.0)
    assert later[3] == NEW.id
    assert b.open(first, 0.0).sender == 1  # b's time begins with its first call
    assert b.open(later, 100.0).payload == b"new"
    assert b.open(behind.seal(b"old", 0.0), 1099.9).payload == b"old"
    assert refusal(b, behind.seal(b"old", 0.0), 1100.0) == "expired-key"
    assert refusal(behind, later) == "unknown-key"


@given(st.floats(-7200, 7200), st.floats(-1e5, 1e5), st.floats(-1e5, 1e5))
def test_drones_whose_clocks_differ_by_hours_hear_each_other_all_through_the_overlap(
    error_s: float, origin_a: float, origin_b: float
) -> None:
    day = 86400.0
    ring = KeyRing((SwarmKey(KEY, accepted_until=3 * day), SwarmKey(OTHER, made_at=0.0, sends_from=2 * day)))
    a = Sealer(ring, 1, 1, unix_time_s=day)
    b = Sealer(ring, 2, 1, unix_time_s=day + error_s)
    for at in np.arange(0.0, 1.9 * day, 3600.0).tolist():
        assert b.open(a.seal(b"", origin_a + at), origin_b + at).sender == 1
        assert a.open(b.seal(b"", origin_b + at), origin_a + at).sender == 2


@given(st.tuples(*[st.floats(-3e6, 3e6)] * 3))
def test_drones_with_one_file_hear_each_other_whatever_their_clocks_say(errors_s: tuple[float, ...]) -> None:
    ring = KeyRing.of(KEY)
    for number in range(1, 4):  # changed every ten days
        secret = bytes((number,)) * 32
        ring = ring.rotated(lambda made=secret: made, 864e3 * number, after_s=86400.0, overlap_s=86400.0)
    drones = [Sealer(ring, own, 1, unix_time_s=1e6 + error) for own, error in enumerate(errors_s, 1)]
    for tick in range(4):
        for a, b in itertools.permutations(drones, 2):
            with contextlib.suppress(Rejected):
                b.open(a.seal(b"", float(tick)), float(tick))
    for a, b in itertools.permutations(drones, 2):
        assert b.open(a.seal(b"x", 5.0), 5.0).payload == b"x"


def test_a_key_in_use_before_its_time_sets_the_clock_forward_and_ends_the_old_one_in_time() -> None:
    behind, right = Sealer(BOTH, 1, 1, unix_time_s=0.0), Sealer(BOTH, 2, 1, unix_time_s=1700.0)  # it is 500 at least
    stolen = Sealer(KEY, 3, 1)
    forged = bytearray(right.seal(b"", 0.0))
    forged[-1] ^= 1
    assert refusal(behind, bytes(forged)) == "forged"
    assert behind.seal(b"", 0.0)[3] == OLD.id  # only what is true counts
    behind.open(right.seal(b"", 0.0), 0.0)
    assert behind.seal(b"", 0.0)[3] == NEW.id
    assert behind.open(stolen.seal(b"", 999.0), 999.0).sender == 3
    assert refusal(behind, stolen.seal(b"", 1000.0), 1000.0) == "expired-key"


def test_a_clock_that_stands_at_1970_keeps_no_old_key_alive_for_ever() -> None:
    reset = Sealer(BOTH, 1, 1, unix_time_s=0.0)  # it is 500 at least: the new key was made then
    old = Sealer(KEY, 2, 1)
    assert reset.open(old.seal(b"", 0.0), 0.0).sender == 2
    assert refusal(reset, old.seal(b"", 0.0), 1500.0) == "expired-key"


def test_keys_with_times_need_the_time() -> None:
    with pytest.raises(InputError, match="time"):
        Sealer(BOTH, 1, 1)


@given(st.lists(st.tuples(st.sampled_from([0, 1]), st.booleans()), max_size=40))
def test_replays_stay_replays_whichever_key_sealed_them(script: list[tuple[int, bool]]) -> None:
    a, b = Sealer(BOTH, 1, 1, unix_time_s=0.0), Sealer(BOTH, 2, 1, unix_time_s=0.0)
    sent: list[bytes] = []
    now = 0.0
    for step, repeats in script:
        now += 60.0 * step
        sent.append(a.seal(b"x", now))
        assert b.open(sent[-1], now).payload == b"x"
        if repeats:
            assert {refusal(b, datagram, now) for datagram in sent[-5:]} == {"replay"}


# --- the ground's signature ----------------------------------------------------------------------------------------


GROUND_RING = KeyRing((SwarmKey(KEY),), ground_public(SIGN), SIGN)


def test_with_a_signing_ground_a_holder_of_the_swarms_key_cannot_speak_for_it() -> None:
    drone = Sealer(GROUND_RING.for_drones(), 1, 1)
    ground, captured = Sealer(GROUND_RING, 0, 1), Sealer(KEY, 0, 2)
    order = ground.seal(b"land", 0.0)
    assert len(order) == 4 + OVERHEAD + SIGNATURE_BYTES == 4 + ground.overhead
    assert refusal(drone, captured.seal(b"land", 0.0)) == "unsigned"
    other = KeyRing((SwarmKey(KEY),), ground_public(OTHER), OTHER)
    assert refusal(drone, Sealer(other, 0, 3).seal(b"land", 0.0)) == "unsigned"
    assert drone.open(order, 0.0) == (0, 1, 1, b"land")  # nor did they move the window
    assert refusal(drone, order) == "replay"
    assert Sealer(KEY, 1, 1).open(order, 0.0).payload == b"land"  # a drone that asks for no signature


def test_a_signed_order_cannot_be_sealed_anew_by_a_holder_of_the_swarms_key() -> None:
    ground, drone = Sealer(GROUND_RING, 0, 1), Sealer(GROUND_RING.for_drones(), 1, 1)
    signed = bytearray(ground.seal(b"land", 0.0))
    cipher = ChaCha20Poly1305(SwarmKey(KEY).sender_secret(0))
    plain = cipher.decrypt(bytes(signed[2:14]), bytes(signed[14:]), bytes(signed[:14]))
    signed[9] += 1  # a later boot
    again = bytes(signed[:14]) + cipher.encrypt(bytes(signed[2:14]), plain, bytes(signed[:14]))
    assert refusal(drone, again) == "unsigned"


def test_the_signing_key_is_the_grounds_and_the_ground_needs_it() -> None:
    with pytest.raises(InputError, match="drone 1 was given the ground station's"):
        Sealer(GROUND_RING, 1, 1)
    with pytest.raises(InputError, match="own key file"):
        Sealer(GROUND_RING.for_drones(), 0, 1)


# --- the byte budget -----------------------------------------------------------------------------------------------


@given(
    st.lists(st.tuples(st.floats(-0.1, 2.0), st.integers(1, 1200)), max_size=60),
    st.floats(100, 50000),
    st.floats(1200, 9000),
)
def test_no_window_of_time_passes_more_than_rate_and_burst(
    steps: list[tuple[float, int]], rate: float, burst: float
) -> None:
    bucket, now, taken = TokenBucket(rate, burst), 0.0, []
    for step, size in steps:
        now += step  # a negative step: time that runs backwards fills nothing
        if bucket.take(size, now):
            taken.append((now, size))
    times = np.maximum.accumulate([at for at, _ in taken]) if taken else np.zeros(0)
    sizes = np.array([size for _, size in taken])
    for first in range(len(times)):
        assert np.all(np.cumsum(sizes[first:]) <= rate * (times[first:] - times[first]) + burst + 1e-3)


def test_a_waiting_bucket_fills_up_again() -> None:
    bucket = TokenBucket(1000.0, 1200.0)
    assert bucket.take(1200, 0.0)
    assert not bucket.take(600, 0.5)
    assert bucket.take(600, 0.6)
