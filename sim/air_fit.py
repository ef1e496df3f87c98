"""Fits the weights of `sim.air_costs` on messages of real mesh nodes: `python -m imagine.sim.air_fit` prints them."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imagine.core.lidar import LD19
from imagine.core.raster import TILE
from imagine.mesh_comm import messages
from imagine.mesh_comm.codec import unpack_ranges, unpack_tile, unpack_versions
from imagine.mesh_comm.settings import MeshSettings
from imagine.sim.air_costs import scan_features, tile_features
from imagine.sim.level import load_level
from imagine.sim.mesh_flight import RANGE_CAP_M, MeshFlight, Said
from imagine.sim.radio import RadioSettings


@dataclass(frozen=True)
class Samples:
    """Packed sizes, bytes `[n]`, and what they are explained by, `[n, features]` with a first column of ones."""

    features: NDArray[np.float64]
    packed_bytes: NDArray[np.float64]

    def fit(self) -> NDArray[np.float64]:
        """Return the weights of least squares, one per feature."""
        return np.asarray(np.linalg.lstsq(self.features, self.packed_bytes, rcond=None)[0], np.float64)

    def estimated_bytes(self, weights: Iterable[float]) -> NDArray[np.float64]:
        """Return what `weights` make of the features, `[n]`."""
        estimate: NDArray[np.float64] = self.features @ np.array(list(weights))
        return estimate


def collect(said: Iterable[Said]) -> dict[str, Samples]:
    """Return the samples of scans, tiles and version lists in what real nodes said; each kind must occur."""
    scans: list[tuple[float, ...]] = []
    tiles: list[tuple[float, ...]] = []
    versions: list[tuple[float, ...]] = []
    for message in (item.message for item in said):
        match message:
            case messages.Scan():
                ranges = unpack_ranges(message.packed, message.beams, message.range_cap_m)
                scans.append((len(message.packed), 1, *scan_features(ranges, LD19.range_min, message.range_cap_m)))
            case messages.Tiles():
                for tile in message.tiles:
                    cells = unpack_tile(tile.packed).reshape(TILE, TILE)
                    tiles.append((len(tile.packed), 1, *tile_features(np.ascontiguousarray(cells), 0, 0)))
            case messages.Digest():
                for holding in message.holdings:
                    held = unpack_versions(holding.packed)
                    if held:
                        versions.append((len(holding.packed), 1, len(held)))
    rows = {"scan": scans, "tile": tiles, "versions": versions}
    return {name: Samples(np.array(r, float)[:, 1:], np.array(r, float)[:, 0]) for name, r in rows.items()}


def fly(seed: int = 1, ticks: int = 400) -> list[Said]:
    """Return what teams of three say on levels 1, 3, 4, 5 and 6, half of them relaying; with all beams, and with 64.

    Few beams leave gaps between them, which scans and tiles of many do not have.
    """
    said = []
    for beams in (LD19.beams, 64):
        lidar = dataclasses.replace(LD19, beams=beams)
        for number, level in enumerate(("1", "3", "4", "5", "6")):
            mesh = MeshSettings(protocol="multi-hop" if number % 2 else "one-hop")
            flight = MeshFlight(load_level(level), 3, RadioSettings(), mesh, seed=seed + number, lidar=lidar)
            said += flight.fly(ticks).said
    return said


def main() -> None:
    """Fly, fit and print the weights, with the error of a single message."""
    for name, samples in collect(fly()).items():
        weights = samples.fit()
        error = samples.estimated_bytes(weights) - samples.packed_bytes
        rms, mean = np.sqrt((error**2).mean()), samples.packed_bytes.mean()
        listed = ", ".join(f"{weight:.3f}" for weight in weights)
        print(f"{name:9} weights ({listed})  {len(error)} messages of {mean:.0f} bytes, rms error {rms:.0f}")
    print(f"for a range cap of {RANGE_CAP_M:g} m")


if __name__ == "__main__":
    main()
