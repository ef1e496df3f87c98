"""The messages that drones and ground exchange, and their binary form: a version byte, then MessagePack.

Structs travel as arrays with the tag first, so a newer sender may append fields that an older receiver ignores, and
an older sender may leave out fields that have defaults. A newer sender may also send kinds that an older receiver does
not know. What an older receiver would misread takes a new version. Units: metres, seconds, radians, map frame.
"""

from __future__ import annotations

import math
from typing import Annotated, get_args

import msgspec
import numpy as np
from msgspec import Meta, Struct

from imagine.core.errors import InputError
from imagine.core.evidence import MAX_TILES, TileKey
from imagine.core.frames import Pose
from imagine.core.raster import CELL, TILE

MAX_DATAGRAM = 1200
"""Largest sealed datagram, bytes: passes every link unfragmented (IPv6's smallest MTU is 1280)."""
WIRE_VERSION = 2
"""Of messages and of what is packed in them (`codec`, `chances.json`); others are refused."""
GROUND = 0
"""Id of the ground station, which listens, shows and commands, and never writes a map."""
POSITION_LIMIT_M = MAX_TILES * TILE * CELL / 2
"""A position further than this from the origin cannot be in any map and is refused."""
MAX_BEAMS = 4096
MOST_NAMED = 96
"""Drones that one order names at most, 7 bytes each: it fits a datagram with the ground's signature."""
MAX_RANGE_CAP_M = 30.0
MAX_SPEED_MPS = 50.0
_MAX_HEIGHT_M = 1000.0
_MAX_YAW_RAD = 1e4  # senders may leave turns unwrapped
_MAX_TIME_S = 1e10

NodeId = Annotated[int, Meta(ge=0, le=254)]
SourceId = Annotated[int, Meta(ge=1, le=254)]
Count = Annotated[int, Meta(ge=0, le=2**53)]
Clock = Annotated[int, Meta(ge=0, le=2**31)]
Boot = Annotated[int, Meta(ge=0, le=2**32 - 1)]
Tag = Annotated[str, Meta(max_length=32)]
Column = Annotated[int, Meta(ge=-MAX_TILES, le=MAX_TILES)]


class Scan(Struct, tag=1, array_like=True, frozen=True):
    """A LiDAR turn, thinned to what mapping uses: pose, beam angles, and ranges packed by `codec.pack_ranges`.

    `clock` is the sender's layer clock after it had integrated this scan: a tile of that version contains it.
    """

    sender: SourceId
    stamp: float
    pose: Pose
    clock: Clock
    start: float
    increment: float
    beams: Annotated[int, Meta(ge=1, le=MAX_BEAMS)]
    range_cap_m: float
    packed: bytes


class Tile(Struct, array_like=True, frozen=True):
    """One tile of a source's layer: place, version (0 in sketches only), and its cells packed by `codec.pack_tile`."""

    column: Column
    row: Column
    version: Annotated[int, Meta(ge=0, le=2**31)]
    packed: bytes


class Tiles(Struct, tag=2, array_like=True, frozen=True):
    """As many tiles of one source as fit the datagram; confirmed content only.

    `boot` is the number of the source's start that they are of: with it their versions are greater than all of earlier
    starts.
    """

    source: SourceId
    tiles: Annotated[list[Tile], Meta(max_length=256)]
    boot: Boot = 0


class Holding(Struct, array_like=True, frozen=True):
    """Which tiles of `source` the sender holds, among the keys in the interval (after, until] (null: unbounded).

    `packed` lists the confirmed versions (`codec.pack_versions`); a key in the interval but not listed is not held.
    All are of the source's start number `boot`; of earlier ones the sender holds nothing.
    """

    source: SourceId
    after: tuple[Column, Column] | None
    until: tuple[Column, Column] | None
    packed: bytes
    boot: Boot = 0


class Digest(Struct, tag=3, array_like=True, frozen=True):
    """What the sender holds, by source; a long digest comes in several datagrams of one stamp."""

    stamp: float
    holdings: Annotated[list[Holding], Meta(max_length=256)]


class Status(Struct, tag=4, array_like=True, frozen=True):
    """How a drone is doing. The node fills in everything from `own_cells` on when it sends.

    `velocity` in the map frame, m/s; `battery` 0..1 or null where unknown; `mode` is the autopilot's; `ladder` the
    decision ladder's state (policy, frontier, hold, land) and `reason` why; `links` seconds since each peer was heard;
    `taught` how many cells peers learned by the drone's scans and tiles (`receipts.py`), summed over peers.
    """

    id: NodeId
    stamp: float
    pose: Pose
    velocity: tuple[float, float] = (0.0, 0.0)
    height_m: float = 0.0
    battery: Annotated[float, Meta(ge=0.0, le=1.0)] | None = None
    mode: Tag = ""
    armed: bool = False
    ladder: Tag = ""
    reason: Annotated[str, Meta(max_length=160)] = ""
    own_cells: Count = 0
    scan_cells: Count = 0
    map_cells: Count = 0
    bytes_sent: Annotated[dict[Tag, Count], Meta(max_length=16)] = {}
    links: Annotated[dict[NodeId, float], Meta(max_length=32)] = {}
    rejected: Count = 0
    last_command: Count = 0
    taught: Annotated[dict[Tag, Count], Meta(max_length=16)] = {}


class Command(Struct, tag=5, array_like=True, frozen=True):
    """An order from the ground: `action` is hold, land or resume; `target` 0 means all.

    `nonce` grows with every order, so a repeated or relayed copy is obeyed once. `starts` names the drones that are
    meant, each with the boot number of its present start: no recording can name a start that was yet to come.
    """

    action: Tag
    target: NodeId
    nonce: Annotated[int, Meta(ge=1, le=2**53)]
    starts: Annotated[dict[SourceId, Boot], Meta(max_length=MOST_NAMED)] = {}


class Here(Struct, tag=6, array_like=True, frozen=True):
    """Where a drone is, between its statuses; `velocity` in the map frame, m/s."""

    id: NodeId
    stamp: float
    pose: Pose
    velocity: tuple[float, float]


class Sketch(Struct, tag=7, array_like=True, frozen=True):
    """Tiles of a source that is out of reach, with the scans drawn over them that the sender heard of it.

    Nothing of it is confirmed: it tells of cells that the receiver has no evidence of, until the tiles themselves come.
    The version of a tile is that of the confirmed copy under the scans, 0 where there is none; whoever holds a later
    one knows better.
    """

    source: SourceId
    tiles: Annotated[list[Tile], Meta(max_length=256)]
    boot: Boot


ACTIONS = ("hold", "land", "resume")
SAFE_ACTIONS = ("hold", "land")
"""Orders that a drone obeys even where the ground does not know it."""

Message = Scan | Tiles | Digest | Status | Command | Here | Sketch
_FIELDS = {kind.__struct_config__.tag: 1 + len(kind.__struct_fields__) for kind in get_args(Message)}


class Unreadable(InputError):
    """A message that was not read; `reason` is one word for the counters: malformed, wire-version, unknown-kind.

    `wire-version`: another `WIRE_VERSION`. `unknown-kind`: one that newer senders know, so nothing is wrong with it.
    """

    def __init__(self, reason: str, message: str) -> None:
        """Keep the counter's name beside the message."""
        super().__init__(message)
        self.reason = reason


def _plain(value: object) -> object:
    """Let numpy's scalars pass as the numbers they are."""
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"a mesh message cannot hold {type(value).__name__}")


_encoder = msgspec.msgpack.Encoder(enc_hook=_plain)
_decoder: msgspec.msgpack.Decoder[Message] = msgspec.msgpack.Decoder(Message)


def encode(message: Message) -> bytes:
    """Return a message's bytes, unsealed."""
    return bytes((WIRE_VERSION,)) + _encoder.encode(message)


def decode(data: bytes) -> Message:
    """Read and check a message; raises Unreadable as `read` does."""
    return read(data)[0]


def read(data: bytes) -> tuple[Message, int]:
    """Read and check a message; return it, and how many fields it has beyond those of its kind that are known here.

    Raises Unreadable on another version, on an unknown kind, and on anything truncated, malformed, or out of bounds.
    """
    if not data or data[0] != WIRE_VERSION:
        version = data[0] if data else "none"
        raise Unreadable("wire-version", f"mesh message of wire version {version}, expected {WIRE_VERSION}")
    kind, fields = _array(data)
    known = fields if kind is None else _FIELDS.get(kind)
    if known is None:
        raise Unreadable("unknown-kind", f"mesh message of kind {kind}, known are {', '.join(map(str, _FIELDS))}")
    try:
        message = _decoder.decode(memoryview(data)[1:])
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise Unreadable("malformed", f"mesh message cannot be read: {error}") from error
    _check(message)
    return message, max(0, fields - known)


def _array(data: bytes) -> tuple[int | None, int]:
    """Return the kind of a message, None where it has none, and how many elements its array has."""
    size = len(data)
    header = data[1] if size > 1 else 0
    if header & 0xF0 == 0x90:
        fields, at = header & 0x0F, 2
    elif header == 0xDC:
        fields, at = int.from_bytes(data[2:4], "big"), 4
    elif header == 0xDD:
        fields, at = int.from_bytes(data[2:6], "big"), 6
    else:
        return None, 0
    if at < size and data[at] == 0xCC:  # a byte of its own for numbers from 128
        at += 1
    elif at < size and data[at] >= 0x80:
        return None, fields
    return (data[at] if fields > 0 and at < size else None), fields


def tile_key(tile: Tile) -> TileKey:
    """Return a tile's place."""
    return TileKey(tile.column, tile.row)


def clip_text(text: str, limit: int) -> str:
    """Return `text` cut to `limit` characters, so that a long reason never makes a message unreadable."""
    return text if len(text) <= limit else text[: limit - 1] + "…"


def _check(message: Message) -> None:
    """Refuse what the types cannot: numbers that are not finite, poses no map can hold, orders nobody knows."""
    match message:
        case Scan():
            _check_pose(message.pose)
            turn = 2.0 * math.pi + 1e-3
            if not (0.0 < message.increment <= turn and message.increment * message.beams <= turn):
                raise Unreadable(
                    "malformed", f"mesh scan: increment {message.increment} rad with {message.beams} beams"
                )
            if not (abs(message.start) <= turn and 0.0 < message.range_cap_m <= MAX_RANGE_CAP_M):
                raise Unreadable(
                    "malformed", f"mesh scan: start {message.start} rad, range cap {message.range_cap_m} m"
                )
            _check_bound("scan: stamp", _MAX_TIME_S, message.stamp)
        case Status():
            _check_pose(message.pose)
            _check_bound("status: time", _MAX_TIME_S, message.stamp)
            for age_s in message.links.values():
                _check_bound("status: time", _MAX_TIME_S, age_s)
            _check_bound("status: velocity", MAX_SPEED_MPS, math.hypot(*message.velocity))
            _check_bound("status: height", _MAX_HEIGHT_M, message.height_m)
        case Here():
            _check_pose(message.pose)
            _check_bound("here: time", _MAX_TIME_S, message.stamp)
            _check_bound("here: velocity", MAX_SPEED_MPS, math.hypot(*message.velocity))
        case Digest():
            _check_bound("digest: stamp", _MAX_TIME_S, message.stamp)
        case Command():
            if message.action not in ACTIONS:
                raise Unreadable("malformed", f"mesh command '{message.action}', expected one of {', '.join(ACTIONS)}")
        case Tiles():  # each tile's cells are checked when they are unpacked
            if any(tile.version < 1 for tile in message.tiles):
                raise Unreadable("malformed", "mesh tile of version 0, which only sketches have")
        case Sketch():
            pass


def _check_bound(what: str, most: float, value: float) -> None:
    if not -most <= value <= most:  # nan is not, either
        raise Unreadable("malformed", f"mesh {what} {value}, expected at most {most:g} either way")


def _check_pose(pose: Pose) -> None:
    x, y, yaw = pose
    if abs(x) <= POSITION_LIMIT_M and abs(y) <= POSITION_LIMIT_M and abs(yaw) <= _MAX_YAW_RAD:
        return
    _check_bound("pose: position", POSITION_LIMIT_M, pose.x)
    _check_bound("pose: position", POSITION_LIMIT_M, pose.y)
    _check_bound("pose: yaw", _MAX_YAW_RAD, pose.yaw)
