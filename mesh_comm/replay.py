"""The replay window: which datagrams of a sender have been seen, however they were reordered on the way."""

from __future__ import annotations

from dataclasses import dataclass

WINDOW = 1024
"""So far behind the highest counter heard a datagram may arrive: about eight seconds of a busy sender."""
_ALL = 2**WINDOW - 1


@dataclass(slots=True)
class ReplayWindow:
    """The counters seen of one life of a sender: the highest, and a bitmap of the `WINDOW` up to it (RFC 4303, 3.4.3).

    `mark` must only be told what has proved to be from the sender.
    """

    boot: int
    highest: int = -1
    seen: int = 0

    @classmethod
    def since(cls, boot: int, counter: int) -> ReplayWindow:
        """Return the window of a life first heard by `counter`: what came before that may be a recording."""
        return cls(boot, counter - 1, _ALL)

    def is_fresh(self, counter: int) -> bool:
        """Tell whether a counter is new; what is too far behind to be remembered is not."""
        behind = self.highest - counter
        return behind < 0 or (behind < WINDOW and not self.seen >> behind & 1)

    def mark(self, counter: int) -> None:
        """Note that a fresh counter was seen."""
        ahead = counter - self.highest
        if ahead > 0:
            self.seen = (self.seen << ahead | 1) & _ALL if ahead < WINDOW else 1
            self.highest = counter
        else:
            self.seen |= 1 << -ahead
