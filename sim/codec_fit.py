"""Counts the chances that `mesh_comm` packs tiles and scans by: `python -m imagine.sim.codec_fit` writes them anew.

Counted is what teams of real nodes say on their way through levels 0 to 5 and some houses; level 6 is left for
measuring. Few beams leave gaps between them, which tiles of many do not have, so some teams have 64. New chances change
the wire: raise `messages.WIRE_VERSION`, then fit `sim.air_fit` and write the test vectors anew.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from imagine.core.lidar import LD19
from imagine.mesh_comm import messages
from imagine.mesh_comm.chances import PATH, Chances, count_chances, write_chances
from imagine.mesh_comm.codec import largest_code, range_codes, unpack_ranges, unpack_tile
from imagine.mesh_comm.scan_model import MOST_BEAM_STEPS, SCAN_CONTEXTS, scan_steps
from imagine.mesh_comm.settings import MeshSettings
from imagine.mesh_comm.tile_model import MOST_TILE_STEPS, TILE_CONTEXTS, tile_steps
from imagine.sim.level import load_level
from imagine.sim.mesh_flight import MeshFlight, Said
from imagine.sim.radio import RadioSettings

_LEVELS = ("0", "1", "2", "3", "4", "5", "house:1", "house:2", "house:3:120", "house:4:160")
_SPARSE = ("3", "5", "house:2")  # levels that are flown with few beams as well


class Tally:
    """How often each context of a model was seen, and how often with a one."""

    def __init__(self, contexts: int) -> None:
        """Start with nothing seen."""
        self.ones, self.seen = np.zeros(contexts, np.int64), np.zeros(contexts, np.int64)

    def add(self, steps: NDArray[np.int16]) -> None:
        """Count steps of `range_coder`."""
        contexts, ones = steps >> 1, (steps & 1).astype(bool)
        self.seen += np.bincount(contexts, minlength=len(self.seen))
        self.ones += np.bincount(contexts[ones], minlength=len(self.seen))


def count(said: Iterable[Said]) -> Chances:
    """Return the chances that fit what was said."""
    tiles, scans = Tally(TILE_CONTEXTS), Tally(SCAN_CONTEXTS)
    tile_buffer = np.empty(MOST_TILE_STEPS, np.int16)
    for message in (item.message for item in said):
        match message:
            case messages.Tiles():
                for tile in message.tiles:
                    tiles.add(tile_buffer[: tile_steps(unpack_tile(tile.packed), tile_buffer)])
            case messages.Scan():
                cap = message.range_cap_m
                codes = range_codes(unpack_ranges(message.packed, message.beams, cap), 0.0, cap)
                buffer = np.empty(MOST_BEAM_STEPS * len(codes), np.int16)
                scans.add(buffer[: scan_steps(codes, largest_code(cap), buffer)])
    return Chances(count_chances(tiles.ones, tiles.seen), count_chances(scans.ones, scans.seen))


def fly(ticks: int = 600) -> Iterator[Said]:
    """Yield what teams of three say in so many ticks on each level."""
    flights = [(name, LD19.beams) for name in _LEVELS] + [(name, 64) for name in _SPARSE]
    for seed, (name, beams) in enumerate(flights):
        lidar, radio = dataclasses.replace(LD19, beams=beams), RadioSettings(range_m=8.0)
        yield from MeshFlight(load_level(name), 3, radio, MeshSettings(), seed=100 + seed, lidar=lidar).fly(ticks).said


def main() -> None:
    """Fly, count, and write the table into the package."""
    write_chances(count(fly()))
    print(f"{PATH} is written: raise WIRE_VERSION, and see the module's text")


if __name__ == "__main__":
    main()
