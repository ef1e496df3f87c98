"""Whether another node runs under this node's id, found out so that no recording can make it seem so.

Recordings of one's own earlier lives are sealed under one's own id, so hearing that id proves nothing. What proves it
is a datagram under the own id, sealed by another life, that names the boot number of *this* life: nobody could have
named it before this life began. Such a datagram is a claim. A node answers with a claim whom it hears with a boot
number above its own (no earlier life of itself had one), and who has proved to be there. So of two nodes with one id
the older one speaks first, the younger one then knows, and answers; replayed lives of oneself are never answered.
"""

from __future__ import annotations

import math
import struct

_PERIOD_S = 0.5
ANSWER_S = 2.0
"""Claims are repeated for so long, for the radio loses some; who goes because of a namesake goes no sooner."""
_MOST_NAMED = 4  # boot numbers in a claim; of more, those heard last
_BOOT = struct.Struct(">I")


class NamesakeWatch:
    """What one node knows of others under its id. Times are the caller's, seconds."""

    def __init__(self, boot: int) -> None:
        """Start alone; `boot` is the number of this life."""
        self.is_proven = False
        """Whether another node is known to have used this node's id since this life began. It stays so."""
        self._boot = boot
        self._to_name: dict[int, float] = {}  # boot numbers and until when, in order of hearing
        self._next_at = -math.inf

    def hear(self, boot: int, claim: bytes | None, now: float) -> None:
        """Take a true datagram under the own id that this life did not send; `claim` is what it claims, if it does."""
        names_this_life = claim is not None and self._boot in _named(claim)
        if boot == self._boot or names_this_life:
            self.is_proven = True
        if boot > self._boot or names_this_life:
            self._to_name.pop(boot, None)
            self._to_name[boot] = now + ANSWER_S
            if len(self._to_name) > _MOST_NAMED:
                del self._to_name[next(iter(self._to_name))]

    def claim(self, now: float) -> bytes | None:
        """Return what to claim now, if anyone is to be answered and nobody was within the last half second."""
        if now < self._next_at:
            return None
        self._to_name = {boot: until for boot, until in self._to_name.items() if now < until}
        if not self._to_name:
            return None
        self._next_at = now + _PERIOD_S
        return b"".join(map(_BOOT.pack, self._to_name))


def _named(claim: bytes) -> list[int]:
    whole = claim[: len(claim) // _BOOT.size * _BOOT.size]
    return [boot for (boot,) in _BOOT.iter_unpack(whole)]
