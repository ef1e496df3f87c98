"""Orders from the ground: repeated by the ground, obeyed once by each drone, passed on to those out of its reach."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from imagine.core.errors import InputError
from imagine.mesh_comm.messages import ACTIONS, GROUND, MOST_NAMED, SAFE_ACTIONS, Command

_PERIOD_S = 0.25
_EPSILON_S = 1e-6


@dataclass
class Repeat:
    """An order that the ground is still repeating, to drone `target` or (0) to all; times in seconds."""

    action: str
    target: int
    nonce: int
    next_at: float
    until: float

    def commands(self, starts: Mapping[int, int]) -> list[Command]:
        """Return the order as it is sent, when the drones that are known are in `starts`: boot numbers by id.

        It names its targets among them, in as many messages as that takes. Where no target is known yet it names none,
        and goes out only if it is safe to obey all the same.
        """
        named = sorted((id_, boot) for id_, boot in starts.items() if self.target in (GROUND, id_))
        if not named and self.action in SAFE_ACTIONS:
            return [Command(self.action, self.target, self.nonce, {})]
        return [
            Command(self.action, self.target, self.nonce, dict(named[first : first + MOST_NAMED]))
            for first in range(0, len(named), MOST_NAMED)
        ]


class Orders:
    """A node's side of the orders: the ground issues and repeats them, a drone takes them and passes them on."""

    def __init__(self, own: int, boot: int, repeat_s: float) -> None:
        """Start with no orders; by `boot` a drone knows those for this start, and the ground's nonces grow."""
        self.last_nonce = 0
        """Nonce of the last order taken, 0 before any."""
        self.relays: deque[bytes] = deque(maxlen=16)
        """Sealed orders still to be passed on, as they came."""
        self._own, self._boot = own, boot
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
        self._repeats = [repeat for repeat in self._repeats if target not in (GROUND, repeat.target)]
        self._repeats.append(Repeat(action, target, self._issued, now, now + self._repeat_s))
        return self._issued

    def due(self, now: float) -> Iterator[Repeat]:
        """Yield what the ground should send now; call `note_sent` on each that went out."""
        self._repeats = [repeat for repeat in self._repeats if repeat.next_at <= repeat.until + _EPSILON_S]
        yield from [repeat for repeat in self._repeats if now >= repeat.next_at - _EPSILON_S]

    def note_sent(self, repeat: Repeat, now: float) -> None:
        """Set when an order that just went out is repeated."""
        repeat.next_at = now + _PERIOD_S

    def take(self, command: Command, sender: int, datagram: bytes) -> bool:
        """Take an order that was heard; tell whether it is for another start of this drone. Raises InputError.

        It is passed on as it came under every protocol: a pilot's order must reach drones out of the ground's reach.
        The seal proves that it is the ground's, and the replay window ends the flood. But a drone that has just started
        has no window yet, and what it hears may be a recording: what names another start of it is not obeyed, and what
        names none only if it tells it to hold or land, for a pilot must be able to stop a drone that nobody hears. So
        is an order to hold or land that names a later start: whoever told the ground of one must not keep a drone up.
        """
        if sender != GROUND or self._own == GROUND:
            raise InputError("a command that is not from the ground")
        self.relays.append(datagram)
        if command.target not in (GROUND, self._own):
            return False
        boot = command.starts.get(self._own)
        if boot is None and command.action not in SAFE_ACTIONS:
            if command.target == self._own or not command.starts:
                raise InputError("a command to fly on that does not name the start of the drone that it is for")
            return False
        if boot is not None and (boot < self._boot or (boot != self._boot and command.action not in SAFE_ACTIONS)):
            return True
        if command.nonce > self.last_nonce:
            self.last_nonce = command.nonce
            self._taken.append(command)
        return False

    def drain(self) -> list[Command]:
        """Return the orders taken since the last call, oldest first."""
        drained = list(self._taken)
        self._taken.clear()
        return drained
