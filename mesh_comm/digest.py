"""Writing down which tiles a node holds, in as many datagrams as that takes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from imagine.core.evidence import TileKey
from imagine.mesh_comm.codec import pack_versions
from imagine.mesh_comm.messages import Digest, Holding
from imagine.mesh_comm.version_model import MOST_LISTED

_HOLDING_BYTES = 29  # a holding beside its packed list: source, boot, two keys and lengths, at their longest
_DIGEST_BYTES = 24  # version byte, tag, stamp and lengths
_MOST_HOLDINGS = 256


class Held(NamedTuple):
    """What is held of a source: the number of its start that all of it is of, and tile versions."""

    boot: int
    versions: dict[TileKey, int]


def digests(stamp: float, held: Mapping[int, Held], max_bytes: int) -> list[Digest]:
    """Return the digests, each of at most `max_bytes` encoded, that tell the tile versions held of each source.

    At least one is returned: an empty one tells that nothing is held.
    """
    parts: list[Holding] = []
    for source in sorted(held):
        items = sorted(held[source].versions.items())
        parts += _split(source, held[source].boot, items, None, None, max_bytes - _HOLDING_BYTES - _DIGEST_BYTES)
    messages: list[list[Holding]] = [[]]
    size = _DIGEST_BYTES
    for part in parts:
        needed = len(part.packed) + _HOLDING_BYTES
        if size + needed > max_bytes or len(messages[-1]) == _MOST_HOLDINGS:
            messages.append([])
            size = _DIGEST_BYTES
        messages[-1].append(part)
        size += needed
    return [Digest(stamp, holdings) for holdings in messages]


def _split(
    source: int,
    boot: int,
    items: list[tuple[TileKey, int]],
    after: TileKey | None,
    until: TileKey | None,
    max_packed: int,
) -> list[Holding]:
    """Halve a list of tiles until each part, with the interval of keys it speaks for, is small enough."""
    if len(items) <= MOST_LISTED and len(packed := pack_versions(dict(items))) <= max_packed:
        return [Holding(source, after, until, packed, boot)]
    middle = len(items) // 2
    border = items[middle - 1][0]
    return _split(source, boot, items[:middle], after, border, max_packed) + _split(
        source, boot, items[middle:], border, until, max_packed
    )
