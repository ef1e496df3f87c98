"""Orders from the ground: repeated by the ground, obeyed once by each drone, passed on to those out of its reach."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

from imagine.core.errors import InputError
from imagine.mesh_comm.messages import ACTIONS, GROUND, Command

_PERIOD_S = 0.25
_EPSILON_S = 1e-6


@dataclass
class Repeat:
    """An order that the ground is still repeating; times in seconds."""

    command: Command
    next_at: float
    until: float


class Orders:
    """A node's side of the orders: the ground issues and repeats them, a drone takes them and passes them on."""

    def __init__(self, own: int, boot: int, repeat_s: float) -> None:
        """Start with no orders; `boot` makes the ground's nonces grow across its restarts."""
        self.last_nonce = 0
        """Nonce of the last order taken, 0 before any."""
        self.relays: deque[bytes] = deque(maxlen=16)
        """Sealed orders still to be passed on, as they came."""
        self._own = own
        self._repeat_s = repeat_s
        self._issued = boot << 20
        self._repeats: list[Repeat] = []
        self._taken: deque[Command] = deque(maxlen=64)

    def issue(self, action: str, target: int, now: float) -> int:
        """Start repeating an order and return its nonce. Raises InputError on a drone, and on an invalid order."""
        if self._own != GROUND:
            raise InputError(f"only the ground station sends commands, not node {self._own}")
        if action not in ACTIONS or not 0 <= target <= 254:
            raise InputError(f"command '{action}' to {target}: expected {', '.join(ACTIONS)} and a target of 0 to 254")
        self._issued += 1
        # an older order to the same drones must not be heard again after this one
        self._repeats = [repeat for repeat in self._repeats if target not in (GROUND, repeat.command.target)]
        self._repeats.append(Repeat(Command(action, target, self._issued), now, now + self._repeat_s))
        return self._issued

    def due(self, now: float) -> Iterator[Repeat]:
        """Yield what the ground should send now; call `note_sent` on each that went out."""
        self._repeats = [repeat for repeat in self._repeats if repeat.next_at <= repeat.until + _EPSILON_S]
        yield from [repeat for repeat in self._repeats if now >= repeat.next_at - _EPSILON_S]

    def note_sent(self, repeat: Repeat, now: float) -> None:
        """Set when an order that just went out is repeated."""
        repeat.next_at = now + _PERIOD_S

    def take(self, command: Command, sender: int, datagram: bytes) -> None:
        """Take an order a drone heard. Raises InputError if it is not the ground's.

        It is passed on as it came under every protocol: a pilot's order must reach drones out of the ground's reach.
        The seal proves that it is the ground's, and the replay window ends the flood.
        """
        if sender != GROUND or self._own == GROUND:
            raise InputError("a command that is not from the ground")
        self.relays.append(datagram)
        if command.target in (GROUND, self._own) and command.nonce > self.last_nonce:
            self.last_nonce = command.nonce
            self._taken.append(command)

    def drain(self) -> list[Command]:
        """Return the orders taken since the last call, oldest first."""
        drained = list(self._taken)
        self._taken.clear()
        return drained
