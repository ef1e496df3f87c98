"""Datagrams with their contents, for whoever implements the mesh elsewhere: `python -m imagine.mesh_comm.vectors FILE`.

One or more of every kind, sealed under a key that no swarm has. Contents are made of whole numbers by formulas, so the
file is the same wherever it is written; `tests/mesh_comm/vectors.json` must be equal to what `vectors` returns.
"""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from imagine.core.evidence import TileKey
from imagine.core.frames import Pose
from imagine.core.raster import LIMIT, TILE
from imagine.mesh_comm import messages
from imagine.mesh_comm.codec import (
    pack_ranges,
    pack_tile,
    pack_versions,
    range_codes,
    unpack_ranges,
    unpack_tile,
    unpack_versions,
)
from imagine.mesh_comm.messages import (
    Command,
    Digest,
    Here,
    Holding,
    Message,
    Scan,
    Sketch,
    Status,
    Tile,
    Tiles,
)
from imagine.mesh_comm.seal import Sealer

KEY = bytes(range(32))
BOOT = 3
SENDER, GROUND = 7, messages.GROUND
_POSE = Pose(1.5, -2.25, 0.5)
_BEAMS, _CAP_M = 48, 4.0


def samples() -> list[tuple[int, Message]]:
    """Return messages with their senders."""
    held = {TileKey(-2, 0): 9, TileKey(-2, 1): 12, TileKey(0, -3): 2**31, TileKey(5, 5): 1}
    tiles = [
        Tile(-2, 1, 12, pack_tile(_wall())),
        Tile(0, 0, 1, pack_tile(_noise())),
        Tile(1, 0, 300, pack_tile(_free())),
    ]
    status = Status(
        SENDER, 2.5, _POSE, (0.5, -0.25), 1.25, 0.75, "OFFBOARD", True, "policy", "exploring", 1200, 300, 40000,
        {"scan": 9000, "tile": 700}, {GROUND: 0.5, 2: 1.25}, 3, 1001,
    )  # fmt: skip
    return [
        (SENDER, Scan(SENDER, 2.5, _POSE, 12, 0.0, 2 * math.pi / _BEAMS, _BEAMS, _CAP_M, _ranges())),
        (SENDER, Tiles(SENDER, tiles)),
        (SENDER, Digest(2.5, [])),
        (SENDER, Digest(2.5, [Holding(1, None, None, pack_versions(held)), Holding(2, (-1, 4), None, b"")])),
        (SENDER, status),
        (SENDER, Status(SENDER, 2.5, _POSE)),
        (GROUND, Command("land", 0, 2**40, {SENDER: BOOT})),
        (SENDER, Here(SENDER, 2.75, _POSE, (0.5, -0.25))),
        (SENDER, Sketch(2, [Tile(-2, 1, 0, pack_tile(_wall())), tiles[2]], 3)),
    ]


def vectors() -> dict[str, Any]:
    """Return what the file holds: keys, and each datagram with its payload and contents; bytes in hexadecimal."""
    sealers = {sender: Sealer(KEY, sender, BOOT, first_counter=1) for sender in (SENDER, GROUND)}
    listed = []
    for sender, message in samples():
        payload = messages.encode(message)
        listed.append(
            {
                "kind": type(message).__name__,
                "sender": sender,
                "datagram": sealers[sender].seal(payload, 0.0).hex(),
                "payload": payload.hex(),
                "content": content(message),
            }
        )
    return {"wire_version": messages.WIRE_VERSION, "key": KEY.hex(), "boot": BOOT, "datagrams": listed}


def content(message: Message) -> dict[str, Any]:
    """Return a message's fields by name, what is packed in them unpacked, as JSON can say it.

    Ranges are codes: 0 invalid, 1 no return, else centimetres plus 2. Cells are rows of a tile, from the south.
    """
    fields: dict[str, Any] = {
        name: list(value) if isinstance(value, tuple) else value for name, value in _fields(message).items()
    }
    match message:
        case Scan():
            del fields["packed"]
            ranges = unpack_ranges(message.packed, message.beams, message.range_cap_m)
            fields["codes"] = range_codes(ranges, 0.0, message.range_cap_m).tolist()
        case Tiles() | Sketch():
            fields["tiles"] = [
                {**_fields(tile), "packed": tile.packed.hex(), "cells": unpack_tile(tile.packed).tolist()}
                for tile in message.tiles
            ]
        case Digest():
            fields["holdings"] = [
                {**_fields(holding), "packed": [[*key, v] for key, v in unpack_versions(holding.packed).items()]}
                for holding in message.holdings
            ]
        case _:
            pass
    plain: dict[str, Any] = json.loads(json.dumps(fields))  # tuples as lists, numbers in keys as texts
    return plain


def _fields(record: msgspec.Struct) -> dict[str, Any]:
    return {name: getattr(record, name) for name in record.__struct_fields__}


def _ranges() -> bytes:
    """Return the packed turn of a sensor between two walls, with a door, a noisy stretch and blind beams."""
    beam = np.arange(_BEAMS)
    centimetres = (
        150 + (beam * beam * 7) % 5 + np.where(beam // 8 % 2 == 0, 0, 90) + np.where(beam > 40, beam * 37 % 100, 0)
    )
    ranges = (centimetres / 100.0).astype(np.float32)
    ranges[10:14] = np.inf
    ranges[[20, 33]] = np.nan
    return pack_ranges(ranges, 0.05, _CAP_M)


def _wall() -> NDArray[np.int8]:
    """Return the cells of a tile with a wall: free before it, unknown behind, unsure at the edge of what is seen."""
    row, column = np.indices((TILE, TILE))
    depth = column - 20 - row // 8
    cells = np.where(depth < 0, -LIMIT, np.where(depth < 2, LIMIT, 0))
    cells = np.where(row > 27, -((row + column) % (LIMIT + 1)), cells)
    cells = np.where((depth == 1) & (row % 3 == 0), 2 * (row % 5), cells)
    return cells.astype(np.int8)


def _noise() -> NDArray[np.int8]:
    """Return cells like nothing that a map holds: they travel plain."""
    place = np.arange(TILE * TILE).reshape(TILE, TILE)
    return ((place * place * 31 + place * 17) // 7 % (2 * LIMIT + 1) - LIMIT).astype(np.int8)


def _free() -> NDArray[np.int8]:
    return np.full((TILE, TILE), -LIMIT, np.int8)


def main() -> None:
    """Write the file named on the command line."""
    if len(sys.argv) != 2:
        sys.exit("usage: python -m imagine.mesh_comm.vectors FILE")
    Path(sys.argv[1]).write_text(json.dumps(vectors(), separators=(",", ":")).replace('{"kind"', '\n{"kind"') + "\n")


if __name__ == "__main__":
    main()
