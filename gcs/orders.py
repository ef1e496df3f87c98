"""The pilot's orders: repeated to each drone until it has confirmed, given up after a while, replaced by newer ones."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from imagine.gcs.snapshot import CommandView

GIVE_UP_S = 30.0
"""A drone that has not confirmed an order by then is told no more: an old order must not surprise anyone."""
_SHOWN_S = 8.0
"""How long an order that everyone has confirmed stays on display."""


@dataclass
class Order:
    """One order of the pilot, and who has confirmed it. `nonces` is the first nonce under which each drone was told."""

    action: str
    target: int
    given_at: float
    nonces: dict[int, int]
    told_at: dict[int, float]
    confirmed: set[int] = field(default_factory=set)
    done_at: float | None = None

    @property
    def missing(self) -> list[int]:
        """Drones that have not confirmed yet."""
        return sorted(set(self.nonces) - self.confirmed)


class Orders:
    """Keeps the orders that not every drone has confirmed. Sends nothing itself: `due` says whom to tell again."""

    def __init__(self, repeat_s: float) -> None:
        """Tell a drone again every `repeat_s` seconds."""
        self._repeat_s = max(repeat_s, 0.2)
        self._orders: list[Order] = []

    def give(self, action: str, target: int, drones: set[int], nonce: int, now: float) -> None:
        """Note that `action` was sent under `nonce` to `drones`; older orders to the same drones are void."""
        for order in self._orders:
            for drone in drones:
                order.nonces.pop(drone, None)
        self._orders = [order for order in self._orders if order.nonces]
        if drones:
            self._orders.append(Order(action, target, now, dict.fromkeys(drones, nonce), dict.fromkeys(drones, now)))

    def confirm(self, last_commands: Mapping[int, int], now: float) -> None:
        """Take note of the newest nonce each drone says it has obeyed."""
        for order in self._orders:
            order.confirmed |= {i for i, nonce in order.nonces.items() if last_commands.get(i, 0) >= nonce}
            if order.done_at is None and not order.missing:
                order.done_at = now

    def due(self, now: float) -> list[tuple[str, int]]:
        """Return (action, drone) of the orders to send again now."""
        again: list[tuple[str, int]] = []
        for order in self._orders:
            if now - order.given_at >= GIVE_UP_S - self._repeat_s:
                continue  # each telling is repeated for a while: the last must end before the order is given up
            for drone in order.missing:
                if now - order.told_at[drone] >= self._repeat_s:
                    order.told_at[drone] = now
                    again.append((order.action, drone))
        return again

    def give_up(self, now: float) -> list[tuple[str, int]]:
        """Drop what is done or too old; return (action, drone) of those who never confirmed."""
        old = [order for order in self._orders if order.missing and now - order.given_at >= GIVE_UP_S]
        done = [order for order in self._orders if order.done_at is not None and now - order.done_at >= _SHOWN_S]
        self._orders = [order for order in self._orders if order not in old and order not in done]
        return [(order.action, drone) for order in old for drone in order.missing]

    def view(self, now: float) -> CommandView | None:
        """Return the newest order still of interest."""
        if not self._orders:
            return None
        order = self._orders[-1]
        expected = tuple(sorted(order.nonces))
        return CommandView(
            order.action, order.target, max(0.0, now - order.given_at), expected, tuple(sorted(order.confirmed))
        )
