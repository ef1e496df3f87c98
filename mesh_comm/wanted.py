"""An entry of the queue of tiles to send: what a tile would tell which peers."""

from __future__ import annotations

from typing import NamedTuple

from imagine.core.evidence import TileKey


class Wanted(NamedTuple):
    """A tile that peers lack, since when; `told`: the cells it would tell each of them, `worth` so much in all.

    `is_sketch`: it goes out as it is drawn here, with scans that its source confirms no more.
    """

    rank: tuple[float, ...]
    source: int
    key: TileKey
    since: float
    told: dict[int, int]
    worth: int
    known: int
    is_sketch: bool = False

    @property
    def brings_news(self) -> bool:
        """Whether it tells some peer a cell that it does not know, as far as is known here."""
        return self.worth > 0
