"""Messages and their packed parts: what goes in comes out, and anything else is refused."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imagine.core.errors import InputError
from imagine.core.evidence import TileKey
from imagine.core.frames import Pose
from imagine.mesh_comm import messages
from imagine.mesh_comm.codec import unpack_versions
from imagine.mesh_comm.digest import Held, digests
from imagine.mesh_comm.messages import (
    WIRE_VERSION,
    Command,
    Digest,
    Holding,
    Scan,
    Status,
    Tile,
    Tiles,
    Unreadable,
    decode,
    encode,
    read,
)

HERE = Pose(1.5, -2.25, 0.5)
SAMPLES = [
    Scan(1, 2.5, HERE, 7, 0.0, 0.0174, 360, 4.0, b"packed"),
    Tiles(3, [Tile(-2, 5, 9, b"cells"), Tile(0, 0, 1, b"")]),
    Digest(1.0, [Holding(1, None, (3, 4), b"a"), Holding(1, (3, 4), None, b"b")]),
    Digest(1.0, []),
    Status(4, 1.0, HERE, (0.5, 0.0), 1.2, 0.8, "OFFBOARD", True, "policy", "", 1, 2, 3, {"scan": 9}, {0: 0.1}, 5, 6),
    Command("land", 0, 2**52, {1: 2**32 - 1, 254: 0}),
    messages.Here(4, 1.0, HERE, (0.5, 0.0)),
    messages.Sketch(3, [Tile(-2, 5, 0, b"cells")], 7),
]


@pytest.mark.parametrize("message", SAMPLES, ids=lambda m: type(m).__name__)
def test_a_message_comes_back_equal_and_any_cut_is_refused(message: messages.Message) -> None:
    data = encode(message)
    assert decode(data) == message
    for end in range(len(data)):
        with pytest.raises(InputError):
            decode(data[:end])
    with pytest.raises(InputError):
        decode(data + b"\0")


def test_numpy_numbers_travel_as_numbers() -> None:
    pose = Pose(np.float64(1.0), np.float32(0.5), np.float64(0.0))
    assert decode(encode(Status(2, np.float64(0.1), pose))) == Status(2, 0.1, Pose(1.0, 0.5, 0.0))


@settings(max_examples=300)
@given(st.binary(max_size=200))
def test_random_bytes_are_refused_or_read_but_nothing_else_happens(data: bytes) -> None:
    for candidate in (data, bytes((WIRE_VERSION,)) + data):
        try:
            decode(candidate)
        except InputError:
            continue


def wire(*fields: object) -> bytes:
    return bytes((WIRE_VERSION,)) + msgspec.msgpack.encode(list(fields))


def test_fields_a_newer_sender_appends_are_ignored_and_those_an_older_leaves_out_have_defaults() -> None:
    newer = wire(5, "hold", 2, 3, {2: 7}, "a field from the future", [1, 2])
    assert decode(newer) == Command("hold", 2, 3, {2: 7})
    assert read(newer)[1] == 2
    assert decode(wire(2, 3, [[-2, 5, 9, b"cells", "more of a tile"]])) == Tiles(3, [Tile(-2, 5, 9, b"cells")])
    older = wire(4, 1, 0.5, list(HERE))
    assert decode(older) == Status(1, 0.5, HERE)
    assert read(older)[1] == 0
    assert [read(encode(message))[1] for message in SAMPLES] == [0] * len(SAMPLES)


def test_fields_appended_to_a_long_message_are_counted() -> None:
    status = msgspec.msgpack.decode(encode(SAMPLES[4])[1:])
    assert len(status) > 15  # a longer form of array
    longer = wire(*status, 7, None, "x")
    assert decode(longer) == SAMPLES[4]
    assert read(longer)[1] == 3


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "wire-version"),
        (bytes((WIRE_VERSION + 1,)) + encode(SAMPLES[0])[1:], "wire-version"),
        (bytes((WIRE_VERSION - 1,)) + encode(SAMPLES[0])[1:], "wire-version"),
        (wire(8, "what", 2, {"nobody": ["knows"]}), "unknown-kind"),
        (wire(127), "unknown-kind"),
        (wire(200, 1, 2), "unknown-kind"),
        (wire(0), "unknown-kind"),
        (wire("5", "hold", 2, 3), "malformed"),
        (wire(), "malformed"),
        (bytes((WIRE_VERSION,)), "malformed"),
        (bytes((WIRE_VERSION,)) + b"\xdc\x00", "malformed"),
        (wire(5, "explode", 0, 1), "malformed"),
    ],
)
def test_why_a_message_was_not_read_is_told(data: bytes, reason: str) -> None:
    with pytest.raises(Unreadable) as refused:
        decode(data)
    assert refused.value.reason == reason


@pytest.mark.parametrize(
    "data",
    [
        wire(99, 1),
        bytes((WIRE_VERSION + 1,)) + encode(SAMPLES[0])[1:],
        wire(4, 1, 0.5, [float("nan"), 0.0, 0.0]),
        wire(4, 1, float("inf"), [0.0, 0.0, 0.0]),
        wire(4, 1, 0.5, [1e6, 0.0, 0.0]),
        wire(4, 1, 0.5, [0.0, 0.0]),
        wire(4, 300, 0.5, list(HERE)),
        wire(4, 1, 0.5, list(HERE), [0.0, 0.0], 1.0, 1.5),
        wire(4, 1, 0.5, list(HERE), [51.0, 0.0]),
        wire(4, 1, 0.5, list(HERE), [40.0, 40.0]),
        wire(4, 1, 0.5, list(HERE), [0.0, float("nan")]),
        wire(4, 1, 0.5, list(HERE), [0.0, 0.0], 1e5),
        wire(4, 1, 1e300, list(HERE)),
        wire(4, 1, 0.5, [0.0, 0.0, 1e300]),
        wire(4, 1, 0.5, list(HERE), [0.0, 0.0], 1.0, 0.5, "", False, "", "", 2**60),
        wire(3, -1e300, []),
        wire(5, "land", 0, 2**60),
        wire(5, "explode", 0, 1),
        wire(5, "land", 0, 0),
        wire(1, 1, 0.0, list(HERE), 1, 0.0, 0.5, 360, 4.0, b""),
        wire(1, 1, 0.0, list(HERE), 1, 0.0, 0.01, 360, 400.0, b""),
        wire(1, 0, 0.0, list(HERE), 1, 0.0, 0.01, 360, 4.0, b""),
        wire(2, 1, [[5000, 0, 1, b""]]),
        wire(2, 1, [[0, 0, 0, b""]]),
    ],
)
def test_values_out_of_bounds_are_refused(data: bytes) -> None:
    with pytest.raises(InputError):
        decode(data)


def test_a_long_reason_is_cut() -> None:
    assert messages.clip_text("lost", 160) == "lost"
    assert len(messages.clip_text("x" * 500, 160)) == 160


tile_keys = st.builds(TileKey, st.integers(-160, 160), st.integers(-160, 160))
versions = st.dictionaries(tile_keys, st.integers(1, 2**31), max_size=300)


@settings(max_examples=50)
@given(
    st.dictionaries(st.integers(1, 9), st.tuples(st.integers(0, 2**32 - 1), versions), max_size=4),
    st.integers(250, 1170),
)
def test_digests_tell_all_versions_within_their_size(
    held: dict[int, tuple[int, dict[TileKey, int]]], max_bytes: int
) -> None:
    told: dict[int, dict[TileKey, int]] = {source: {} for source in held}
    for digest in digests(1.0, {source: Held(*of) for source, of in held.items()}, max_bytes):
        assert len(encode(digest)) <= max_bytes
        for holding in digest.holdings:
            part = unpack_versions(holding.packed)
            assert all(holding.after is None or key > holding.after for key in part)
            assert all(holding.until is None or key <= holding.until for key in part)
            assert holding.boot == held[holding.source][0]
            told[holding.source].update(part)
    assert told == {source: of[1] for source, of in held.items()}
