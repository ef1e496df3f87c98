"""What a node knows of the others: when they were heard, where they are, and which tiles they hold."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import NamedTuple

from imagine.core.errors import InputError
from imagine.core.evidence import EvidenceMap, TileKey
from imagine.core.frames import Pose
from imagine.mesh_comm.codec import tile_code, tile_of, unpack_coded_versions
from imagine.mesh_comm.messages import Digest, Here, Holding, Status, Tile

_EXTRAPOLATE_S = 1.0  # a last known velocity says little about where a peer is later than this


class Peer(NamedTuple):
    """A peer as the outside sees it: `age_s` since it was last heard; pose and status None until told."""

    id: int
    age_s: float
    is_live: bool
    pose: Pose | None
    velocity: tuple[float, float]
    status: Status | None


class Told(NamedTuple):
    """What a peer holds of a source: the number of the start that it is of, and versions by `codec.tile_code`."""

    boot: int
    versions: dict[int, int]


@dataclass
class PeerRecord:
    """Everything heard from one peer. Times are the listener's, seconds; `holdings` by source."""

    id: int
    boot: int
    heard_at: float
    pose: Pose | None = None
    pose_stamp: float = -math.inf
    pose_at: float = -math.inf
    velocity: tuple[float, float] = (0.0, 0.0)
    status: Status | None = None
    status_stamp: float = -math.inf
    digest_at: float = -math.inf
    digest_stamp: float = -math.inf
    holdings: dict[int, Told] = field(default_factory=dict)
    met: dict[TileKey, int] | None = None
    """The listener's own tile versions when the peer came into reach; None until they are noted."""

    def restart(self, boot: int) -> None:
        """Forget what ended with the peer's restart: its clock begins anew and its map is empty."""
        self.boot = boot
        self.pose_stamp = self.status_stamp = self.digest_stamp = self.digest_at = -math.inf
        self.holdings, self.met = {}, None

    def note_pose(self, pose: Pose, stamp: float, now: float) -> None:
        """Take a pose unless a newer one is known."""
        if stamp >= self.pose_stamp:
            self.pose, self.pose_stamp, self.pose_at = pose, stamp, now

    def note_status(self, status: Status, now: float) -> None:
        """Take a status unless a newer one is known."""
        if status.stamp >= self.status_stamp:
            self.status, self.status_stamp, self.velocity = status, status.stamp, status.velocity
        self.note_pose(status.pose, status.stamp, now)

    def note_here(self, here: Here, now: float) -> None:
        """Take where the peer is, and how fast it moves, unless a newer pose is known."""
        if here.stamp >= self.pose_stamp:
            self.velocity = here.velocity
        self.note_pose(here.pose, here.stamp, now)

    def note_digest(self, digest: Digest, now: float, max_sources: int, grid: EvidenceMap) -> None:
        """Take what the peer says it holds, interval by interval; an older digest than the last is left out.

        Of a source more tiles than `grid` has places are kept only where these are: no others could be sent, and that
        bounds the memory, whatever a digest claims.

        Raises InputError on a damaged list and on more than `max_sources` sources, then with nothing taken.
        """
        if digest.stamp < self.digest_stamp:
            return
        if len({holding.source for holding in digest.holdings} | self.holdings.keys()) > max_sources + 1:
            raise InputError(f"mesh digest of {self.id} makes more than {max_sources} sources")
        lists = [(holding, _versions(holding)) for holding in digest.holdings]
        for holding, versions in lists:
            known = self.holdings.get(holding.source)
            if known is None or known.boot != holding.boot:
                known = Told(holding.boot, {})  # its layer of an earlier start is gone
            if holding.after is not None or holding.until is not None:
                low, high = _interval(holding)
                kept = {code: version for code, version in known.versions.items() if not low < code <= high}
                versions = kept | versions
            if len(versions) > grid.tile_rows * grid.tile_columns:
                versions = {code: version for code, version in versions.items() if _is_on(grid, code)}
            self.holdings[holding.source] = Told(holding.boot, versions)
        self.digest_stamp, self.digest_at = digest.stamp, now

    def note_held(self, source: int, boot: int, tiles: Iterable[Tile]) -> None:
        """Take it that the peer holds tiles, because it sent them."""
        known = self.holdings.get(source)
        if known is None or known.boot < boot:
            known = self.holdings[source] = Told(boot, {})
        if known.boot == boot:
            for tile in tiles:
                code = tile_code((tile.column, tile.row))
                if tile.version > known.versions.get(code, 0):
                    known.versions[code] = tile.version

    def holds(self, source: int, boot: int, key: TileKey) -> float:
        """Return the version of a tile of a source's start that the peer is known to hold: 0 for none.

        Infinite where the peer knows of a later start, for it takes nothing of this one.
        """
        known = self.holdings.get(source)
        if known is None or known.boot < boot:
            return 0
        return known.versions.get(tile_code(key), 0) if known.boot == boot else math.inf

    def hears(self, other: int, within_s: float) -> bool:
        """Tell whether the peer, by the last status of its present start, heard node `other` lately."""
        if self.status is None or self.status_stamp == -math.inf:
            return False
        return self.status.links.get(other, math.inf) <= within_s

    def position(self, now: float) -> tuple[float, float] | None:
        """Return where the peer should be now, by its last pose and velocity; None if never told."""
        if self.pose is None:
            return None
        ahead = min(max(0.0, now - self.pose_at), _EXTRAPOLATE_S)
        return self.pose.x + self.velocity[0] * ahead, self.pose.y + self.velocity[1] * ahead


def _versions(holding: Holding) -> dict[int, int]:
    versions = unpack_coded_versions(holding.packed)
    low, high = _interval(holding)
    if versions and not (low < next(iter(versions)) and next(reversed(versions)) <= high):  # they are in order
        raise InputError(f"mesh digest of source {holding.source} lists tiles outside its own interval")
    return versions


def _interval(holding: Holding) -> tuple[float, float]:
    """Return the codes of tiles that a holding speaks for: above the first, up to the second."""
    low = -math.inf if holding.after is None else tile_code(holding.after)
    return low, math.inf if holding.until is None else tile_code(holding.until)


def _is_on(grid: EvidenceMap, code: int) -> bool:
    key = tile_of(code)
    row, column = key.row - grid.corner.row, key.column - grid.corner.column
    return 0 <= row < grid.tile_rows and 0 <= column < grid.tile_columns
