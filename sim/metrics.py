"""What an episode of exploration comes to: its curve, its times, and what each drone gave and took."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

SAMPLE_TICKS = 10
"""Ticks between two samples of `EpisodeMetrics.drone_curves`: a second."""
CONTACT_KINDS = ("wall", "drone", "mover")
CELL_SOURCES = ("own", "scan", "map")
"""How a drone first came to know a cell: by its own LiDAR, from a peer's scan, from a map tile."""
BYTE_KINDS = ("scan", "tile", "digest", "status")
_FIRST_CAPACITY = 1024  # ticks that the curves have room for before they grow


@dataclass(frozen=True)
class EpisodeTotals:
    """What the counters of one world stand at when its episode ends; the recorder keeps none of these itself.

    Per drone: `discovered` int `[drones]`, coverable cells it was the first to see; `known` int `[drones]`, cells it
    knows from its own sensor; `contacts` int `[drones, 3]` by CONTACT_KINDS; `bytes_by` int `[drones, 4]` by
    BYTE_KINDS and `cells_by` int `[drones, 3]` by CELL_SOURCES. Of the team: `seen` cells, and the level's `coverable`
    ones.
    """

    level: str
    coverable: int
    seen: int
    discovered: NDArray[np.int64]
    known: NDArray[np.int64]
    contacts: NDArray[np.int64]
    bytes_by: NDArray[np.int64]
    cells_by: NDArray[np.int64]


@dataclass(frozen=True)
class EpisodeMetrics:
    """One finished episode. Times are ticks of 0.1 s, None where never reached; distances metres; shares 0 to 1."""

    world: int
    seed: int
    """Of the whole batch: with `world` it names the episode's random streams."""
    level: str
    ticks: int
    coverage: float
    curve: NDArray[np.float32]
    """Coverage after each tick, `[ticks]`."""
    t90: int | None
    t95: int | None
    t99: int | None
    overlap: float
    """Cells known by their own sensors, summed over drones, per cell the team has seen: 1 is no overlap."""
    path_m: NDArray[np.float64]
    """Length of each drone's way, `[drones]`."""
    discovered: NDArray[np.int64]
    """Coverable cells that each drone was the first of the team to see, `[drones]`."""
    drone_curves: NDArray[np.float32]
    """`discovered` as shares of the level after every SAMPLE_TICKS ticks and at the end, `[drones, samples]`.

    The drones' curves add up to the team's.
    """
    known: NDArray[np.int64]
    """Cells each drone knows from its own sensor, `[drones]`."""
    contacts: int
    """Things that drones have begun to touch, over the team; two drones that meet count two."""
    link_ticks: NDArray[np.int64]
    """Ticks in which each drone was linked with at least one other, `[drones]`."""
    pair_ticks: NDArray[np.int64]
    """Ticks in which drone i was linked to drone j, `[drones, drones]`, 0 on the diagonal."""
    alive_ticks: NDArray[np.int64]
    """Ticks after which each drone still flew, `[drones]`; `ticks` for those that never fell."""
    contacts_by: NDArray[np.int64]
    """`contacts` of each drone, `[drones, 3]` by CONTACT_KINDS."""
    bytes_by: NDArray[np.int64]
    """Bytes each drone sent, `[drones, 4]` by BYTE_KINDS."""
    cells_by: NDArray[np.int64]
    """Cells by how each drone first came to know them, `[drones, 3]` by CELL_SOURCES."""

    @property
    def total_bytes(self) -> int:
        """Bytes the team sent."""
        return int(self.bytes_by.sum())

    @property
    def link_share(self) -> float:
        """Share of the episode in which a drone was linked with another, mean over the team; a fallen one never is."""
        return float(self.link_ticks.mean() / self.ticks)

    @property
    def productivity_ratio(self) -> float:
        """Cells discovered by the most productive drone per cell of the least productive one, at least 1.

        A drone that discovered nothing counts as one cell, so that the ratio stays finite; where nobody discovered
        anything it is 1.
        """
        return float(max(1, self.discovered.max()) / max(1, self.discovered.min()))


class Recorder:
    """Follows every world of a batch tick by tick, and tells what an episode came to when it ends.

    All arrays are `[worlds, ...]` and written by one compiled loop a tick. Curves grow by doubling, so episodes may
    last as long as they like.
    """

    def __init__(self, worlds: int, drones: int, seed: int = 0) -> None:
        """Make room for a batch; `seed` is what the batch was made with, and goes into the metrics."""
        self.seed = seed
        self._lengths = np.zeros(worlds, np.int64)
        self._curves = np.empty((worlds, _FIRST_CAPACITY), np.float32)
        self._samples = np.empty((worlds, drones, -(-_FIRST_CAPACITY // SAMPLE_TICKS)), np.int32)
        self._last = np.zeros((worlds, drones, 2))
        self._path = np.zeros((worlds, drones))
        self._links = np.zeros((worlds, drones), np.int64)
        self._pairs = np.zeros((worlds, drones, drones), np.int64)
        self._alive_ticks = np.zeros((worlds, drones), np.int64)
        self._everyone, self._everywhere = np.ones((worlds, drones), np.bool_), np.ones(worlds, np.bool_)

    def begin(self, world: int, poses: NDArray[np.float64]) -> None:
        """Forget a world's episode and start the next one with the drones at `poses` `[drones, 2 or 3]`, metres."""
        self._lengths[world] = 0
        self._last[world] = poses[:, :2]
        for total in (self._path, self._links, self._pairs, self._alive_ticks):
            total[world] = 0

    def record(
        self,
        coverage: NDArray[np.float64],
        poses: NDArray[np.float64],
        linked: NDArray[np.bool_],
        discovered: NDArray[np.int64],
        alive: NDArray[np.bool_] | None = None,
        running: NDArray[np.bool_] | None = None,
    ) -> None:
        """Take what a tick brought in every world, or in those that are `running` (bool `[worlds]`).

        `coverage` `[worlds]` shares; `poses` `[worlds, drones, 2 or 3]`, metres; `linked` bool `[worlds, drones,
        drones]`, who reaches whom; `discovered` `[worlds, drones]`, since the episode began; `alive` bool `[worlds,
        drones]` says who still flies, everyone where it is None.
        """
        longest = _record(
            coverage, poses, linked, discovered, self._everyone if alive is None else alive,
            self._everywhere if running is None else running, self._lengths,
            self._curves, self._samples, self._last, self._path, self._links, self._pairs, self._alive_ticks,
        )  # fmt: skip
        if longest == self._curves.shape[1]:
            self._curves = np.concatenate((self._curves, np.empty_like(self._curves)), axis=1)
            self._samples = np.concatenate((self._samples, np.empty_like(self._samples)), axis=2)

    def finish(self, world: int, totals: EpisodeTotals) -> EpisodeMetrics:
        """Return what a world's episode came to, of at least one tick; the next one starts with `begin`."""
        ticks = int(self._lengths[world])
        curve = self._curves[world, :ticks].copy()
        samples = self._samples[world, :, : -(-ticks // SAMPLE_TICKS)].astype(np.float64)
        samples[:, -1] = totals.discovered
        return EpisodeMetrics(
            world=world,
            seed=self.seed,
            level=totals.level,
            ticks=ticks,
            coverage=float(curve[-1]),
            curve=curve,
            t90=first_at_least(curve, 0.90),
            t95=first_at_least(curve, 0.95),
            t99=first_at_least(curve, 0.99),
            overlap=float(totals.known.sum() / max(1, totals.seen)),
            path_m=self._path[world].copy(),
            discovered=totals.discovered.copy(),
            drone_curves=(samples / max(1, totals.coverable)).astype(np.float32),
            known=totals.known.copy(),
            contacts=int(totals.contacts.sum()),
            link_ticks=self._links[world].copy(),
            pair_ticks=self._pairs[world].copy(),
            alive_ticks=self._alive_ticks[world].copy(),
            contacts_by=totals.contacts.copy(),
            bytes_by=totals.bytes_by.copy(),
            cells_by=totals.cells_by.copy(),
        )


def first_at_least(curve: NDArray[np.float32], share: float) -> int | None:
    """Return the first tick, counted from 1, after which `curve` `[ticks]` is at `share` or more; None if it never is.

    Both are compared as float32, so that a coverage of just the share counts.
    """
    reached = np.flatnonzero(curve >= np.float32(share))
    return int(reached[0]) + 1 if len(reached) else None


@numba.njit(cache=True, nogil=True)
def _record(  # type: ignore[no-untyped-def]
    coverage, poses, linked, discovered, alive, running, lengths, curves, samples, last, path, links, pairs, alive_ticks
):
    """Write one tick of every world into the recorder's arrays; return the ticks of the longest episode."""
    longest = 0
    drones = poses.shape[1]
    for world in range(len(lengths)):
        tick = lengths[world]
        if not running[world]:
            longest = max(longest, tick)
            continue
        curves[world, tick] = coverage[world]
        if (tick + 1) % SAMPLE_TICKS == 0:
            for drone in range(drones):
                samples[world, drone, tick // SAMPLE_TICKS] = discovered[world, drone]
        for drone in range(drones):
            x, y = poses[world, drone, 0], poses[world, drone, 1]
            path[world, drone] += np.hypot(x - last[world, drone, 0], y - last[world, drone, 1])
            last[world, drone, 0], last[world, drone, 1] = x, y
            if not alive[world, drone]:
                continue
            alive_ticks[world, drone] += 1
            heard = 0
            for other in range(drones):
                if other != drone and linked[world, drone, other] and alive[world, other]:
                    pairs[world, drone, other] += 1
                    heard = 1
            links[world, drone] += heard
        lengths[world] = tick + 1
        longest = max(longest, tick + 1)
    return longest
