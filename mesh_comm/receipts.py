"""What the bytes that a node sent have bought: cells that peers learned, by what told them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

from imagine.core.evidence import TileKey

Bought = Literal["scan", "tile", "repeat"]
_WAIT_S = 10.0  # a digest that does not show a tile by then will not: the peer is out of reach, or the tile got lost
_MOST_OPEN = 8192


@dataclass
class Receipt:
    """Bytes that went out, cells that peers have learned by them, and cells that were sent and never confirmed."""

    bytes: int = 0
    cells: int = 0
    lost_cells: int = 0

    @property
    def cells_per_byte(self) -> float:
        """What a byte bought, 0 before any."""
        return self.cells / self.bytes if self.bytes else 0.0


def shares(size: int, parts: Sequence[int]) -> list[int]:
    """Return whole numbers that are as `parts` to each other and sum to `size`: the largest remainders are rounded up.

    Hamilton's method; of equal remainders the earlier is. Where all parts are 0 they count alike.
    """
    total = sum(parts)
    if total == 0:
        parts, total = [1] * len(parts), len(parts)
    whole = [size * part // total for part in parts]
    left = size - sum(whole)
    for k in sorted(range(len(parts)), key=lambda k: -(size * parts[k] % total))[:left]:
        whole[k] += 1
    return whole


class _Open(NamedTuple):
    boot: int
    version: int
    cells: int
    at: float


class Receipts:
    """Bytes and cells by kind: scans (estimated), tiles that tell peers something new, and tiles that only confirm.

    What a tile tells is estimated when it is sent, and counts for a peer once a digest of that peer shows it. What a
    scan tells is the cells that it was the first to see, for every peer in reach: nothing comes back for it.
    """

    def __init__(self) -> None:
        """Start with nothing sent."""
        self.by_kind: dict[Bought, Receipt] = {"scan": Receipt(), "tile": Receipt(), "repeat": Receipt()}
        self._open: dict[tuple[int, int, TileKey], _Open] = {}

    def note_scan(self, size: int, cells: int) -> None:
        """Take a scan of `size` sealed bytes that told peers in reach `cells`, each counted as often as it was told."""
        receipt = self.by_kind["scan"]
        receipt.bytes += size
        receipt.cells += cells

    def note_tile(
        self, source: int, boot: int, key: TileKey, version: int, size: int, told: Mapping[int, int], now: float
    ) -> None:
        """Take a tile that went out in `size` bytes and tells each peer of `told` so many new cells."""
        self.by_kind["tile" if any(told.values()) else "repeat"].bytes += size
        for peer, cells in told.items():
            if cells:
                self._close(peer, source, key, lost=True)
                self._open[peer, source, key] = _Open(boot, version, cells, now)
        while len(self._open) > _MOST_OPEN:
            self._close(*next(iter(self._open)), lost=True)

    def note_sketch(self, size: int, told: Mapping[int, int]) -> None:
        """Take a tile of a source out of reach that went out in `size` bytes: an estimate, as scans are."""
        receipt = self.by_kind["tile"]
        receipt.bytes += size
        receipt.cells += sum(told.values())

    def settle(self, peer: int, holds: Callable[[int, int, TileKey], float], now: float) -> None:
        """Look through what was sent to a peer, after a digest: `holds` as `PeerRecord.holds`."""
        for to, source, key in [entry for entry in self._open if entry[0] == peer]:
            sent = self._open[to, source, key]
            if holds(source, sent.boot, key) >= sent.version:
                self._close(to, source, key, lost=False)
        for entry in [entry for entry, sent in self._open.items() if now - sent.at > _WAIT_S]:
            self._close(*entry, lost=True)

    def _close(self, peer: int, source: int, key: TileKey, lost: bool) -> None:
        sent = self._open.pop((peer, source, key), None)
        if sent is not None and lost:
            self.by_kind["tile"].lost_cells += sent.cells
        elif sent is not None:
            self.by_kind["tile"].cells += sent.cells
