"""Sealing: only true, fresh datagrams open; keys and boot numbers are kept safely."""

from __future__ import annotations

import itertools
import stat
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from imagine.core.errors import InputError
from imagine.mesh_comm.budget import TokenBucket
from imagine.mesh_comm.keys import KEY_VARIABLE, find_key, load_key, next_boot_number, write_new_key
from imagine.mesh_comm.seal import OVERHEAD, Rejected, Sealer

KEY = bytes(32)


def pair() -> tuple[Sealer, Sealer]:
    return Sealer(KEY, 1, 10), Sealer(KEY, 2, 10)


@given(st.binary(max_size=1200))
def test_a_payload_comes_back_with_its_sender(payload: bytes) -> None:
    a, b = pair()
    datagram = a.seal(payload)
    assert len(datagram) == len(payload) + OVERHEAD
    assert payload not in datagram or len(payload) < 4
    assert b.open(datagram) == (1, 10, 1, payload)


@given(st.data())
def test_any_changed_bit_is_refused(data: st.DataObject) -> None:
    a, b = pair()
    datagram = bytearray(a.seal(b"a message"))
    datagram[data.draw(st.integers(0, len(datagram) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    with pytest.raises(Rejected):
        b.open(bytes(datagram))
    assert sum(b.rejected.values()) == 1


@given(st.permutations(range(60)))
def test_any_order_within_the_window_opens_each_exactly_once(order: list[int]) -> None:
    a, b = pair()
    datagrams = [a.seal(bytes((i,))) for i in range(60)]
    assert [b.open(datagrams[i]).payload[0] for i in order] == order
    for datagram in datagrams:
        with pytest.raises(Rejected, match="seen before"):
            b.open(datagram)


def test_what_falls_behind_the_window_is_refused() -> None:
    a, b = pair()
    datagrams = [a.seal(b"") for _ in range(65)]
    b.open(datagrams[64])
    b.open(datagrams[1])
    with pytest.raises(Rejected):
        b.open(datagrams[0])
    assert b.rejected == {"replay": 1}


def test_a_restarted_sender_is_heard_and_its_past_is_not() -> None:
    a, b = pair()
    past = [a.seal(b"") for _ in range(3)]
    b.open(past[0])
    again = Sealer(KEY, 1, 11)
    assert b.open(again.seal(b"new")).boot == 11
    with pytest.raises(Rejected, match="before its restart"):
        b.open(past[1])
    assert b.rejected == {"old-boot": 1}


def test_every_refusal_is_counted_under_its_reason() -> None:
    a, b = pair()
    good = a.seal(b"payload")
    stranger = Sealer(bytes(31) + b"\1", 1, 10).seal(b"payload")
    for datagram in (b"", b"\0" * 29, b"XX" + good[2:], good[:2] + b"\x09" + good[3:], stranger, b.seal(b"")):
        with pytest.raises(Rejected):
            b.open(datagram)
    assert b.rejected == {"short": 2, "magic": 1, "version": 1, "forged": 1, "echo": 1}


def test_a_forger_cannot_move_the_window() -> None:
    a, b = pair()
    first, second = a.seal(b"1"), a.seal(b"2")
    ahead = bytearray(first)
    ahead[4] = 0xFF  # a later boot, unauthenticated
    with pytest.raises(Rejected):
        b.open(bytes(ahead))
    assert b.open(first).payload == b"1"
    assert b.open(second).payload == b"2"


def test_wrong_key_id_or_boot_is_named() -> None:
    for key, own, boot, word in ((bytes(31), 1, 1, "31 bytes"), (KEY, 255, 1, "255"), (KEY, 1, -1, "-1")):
        with pytest.raises(InputError, match=word):
            Sealer(key, own, boot)


def test_a_new_key_is_private_readable_back_and_never_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "swarm.key"
    key = write_new_key(path)
    assert load_key(path) == key
    assert len(key) == 32
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    with pytest.raises(InputError, match="exists already"):
        write_new_key(path)
    assert load_key(path) == key
    assert find_key(path, {}) == find_key(None, {KEY_VARIABLE: key.hex()}) == key
    with pytest.raises(InputError, match="cannot be written"):
        write_new_key(tmp_path / "absent" / "swarm.key")


@pytest.mark.parametrize("content", [b"", b"ab" * 31, b"ab" * 33, b"zz" * 32, b"\xff" * 32])
def test_a_damaged_key_file_is_refused_by_name(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "swarm.key"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"swarm\.key"):
        load_key(path)


def test_a_missing_key_says_what_to_do(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        load_key(tmp_path / "none.key")
    with pytest.raises(InputError, match="keygen"):
        find_key(None, {})
    with pytest.raises(InputError, match=KEY_VARIABLE):
        find_key(None, {KEY_VARIABLE: "1234"})


def test_boot_numbers_grow_whatever_the_clock_does(tmp_path: Path) -> None:
    path = tmp_path / "boot"
    numbers = [next_boot_number(path, at) for at in (1.8e9, 1.8e9, 0.0, 1.9e9)]
    assert all(later > earlier for earlier, later in itertools.pairwise(numbers))
    path.write_text("rubbish")
    with pytest.raises(InputError, match="boot"):
        next_boot_number(path, 2e9)


def test_a_boot_file_gets_its_folder_and_one_that_cannot_be_written_is_named_with_the_remedy(tmp_path: Path) -> None:
    assert next_boot_number(tmp_path / "new" / "folder" / "boot", 0.0) == 1
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match=r"file/boot: .*set boot_file"):
        next_boot_number(tmp_path / "file" / "boot", 2e9)


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
