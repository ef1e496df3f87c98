"""Sealing of datagrams with ChaCha20-Poly1305 (RFC 8439) under the swarm's key, with replays dropped.

Datagram: a clear header, authenticated as associated data, then ciphertext and 16-byte tag. Header, big-endian:
magic 2 bytes, version u8, sender u8, boot u32, counter u48. The nonce is sender u8, boot u32, counter u48, padded
with one zero byte, so it never repeats under one key while a sender never uses a boot number twice.
"""

from __future__ import annotations

import struct
from collections import Counter
from dataclasses import dataclass
from typing import NamedTuple

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305

from imagine.core.errors import InputError

MAGIC = b"\xa7M"
SEAL_VERSION = 1
KEY_BYTES = 32
OVERHEAD = 14 + 16
"""Bytes that sealing adds: header and tag."""
_HEADER = struct.Struct(">2sBBIHI")
_WINDOW = 64
_LAST_COUNTER = 2**48 - 1


class Opened(NamedTuple):
    """A datagram that proved to be from `sender` and is no replay."""

    sender: int
    boot: int
    counter: int
    payload: bytes


class Rejected(InputError):
    """A datagram that was refused; `reason` is one short word for the counters."""

    def __init__(self, reason: str, message: str) -> None:
        """Keep the counter's name beside the message."""
        super().__init__(message)
        self.reason = reason


@dataclass
class _Window:
    """The counters already seen of one sender's boot: the highest, and a bitmap of the 64 up to it."""

    boot: int
    highest: int = 0
    seen: int = 0

    def is_fresh(self, counter: int) -> bool:
        back = self.highest - counter
        return back < 0 or (back < _WINDOW and not self.seen >> back & 1)

    def mark(self, counter: int) -> None:
        ahead = counter - self.highest
        if ahead > 0:
            self.seen = (self.seen << min(ahead, _WINDOW) | 1) & (2**_WINDOW - 1)
            self.highest = counter
        else:
            self.seen |= 1 << -ahead


class Sealer:
    """Seals what one node sends and opens what it hears.

    `boot` (u32) must grow at every start of the node (`keys.next_boot_number`): it keeps nonces unique, and lets the
    others accept a restarted node while they still refuse recordings of its earlier life.
    """

    def __init__(self, key: bytes, own: int, boot: int) -> None:
        """Make the sealer of node `own` (0..254) under a 32-byte key. Raises InputError on values out of range."""
        if len(key) != KEY_BYTES:
            raise InputError(f"mesh key is {len(key)} bytes, needs {KEY_BYTES}: make one with `imagine keygen`")
        if not 0 <= own <= 254:
            raise InputError(f"mesh id is {own}, needs to be 0 (ground) to 254")
        if not 0 <= boot < 2**32:
            raise InputError(f"boot number is {boot}, needs to be in 0..2^32-1")
        self.own = own
        self.boot = boot
        self.rejected: Counter[str] = Counter()
        self._cipher = ChaCha20Poly1305(key)
        self._counter = 0
        self._windows: dict[int, _Window] = {}

    def seal(self, payload: bytes) -> bytes:
        """Return the datagram that carries `payload`, `OVERHEAD` bytes longer."""
        if self._counter >= _LAST_COUNTER:
            raise InputError("mesh counter is used up: restart the node with a new boot number")
        self._counter += 1
        header = _header(self.own, self.boot, self._counter)
        return header + self._cipher.encrypt(_nonce(header), payload, header)

    def open(self, datagram: bytes) -> Opened:
        """Check and decrypt a datagram. Raises Rejected (and counts its reason) on anything but a fresh, true one.

        Reasons: short, magic, version, echo (own datagram heard back), forged (wrong key or altered), old-boot, replay.
        """
        try:
            return self._open(bytes(datagram))
        except Rejected as rejection:
            self.rejected[rejection.reason] += 1
            raise

    def _open(self, datagram: bytes) -> Opened:
        if len(datagram) < OVERHEAD:
            raise Rejected("short", f"mesh datagram of {len(datagram)} bytes is shorter than a seal")
        magic, version, sender, boot, high, low = _HEADER.unpack_from(datagram)
        if magic != MAGIC:
            raise Rejected("magic", f"mesh datagram starts with {magic!r}")
        if version != SEAL_VERSION:
            raise Rejected("version", f"mesh datagram of seal version {version}, expected {SEAL_VERSION}")
        if sender == self.own and boot == self.boot:
            raise Rejected("echo", "own mesh datagram heard back")
        header, counter = datagram[: _HEADER.size], high << 32 | low
        try:
            payload = self._cipher.decrypt(_nonce(header), datagram[_HEADER.size :], header)
        except InvalidTag as error:
            raise Rejected("forged", f"mesh datagram in the name of {sender}: altered, or another key") from error
        # only now is the header true: nothing below may be reached by a forger
        window = self._windows.get(sender)
        if window is not None and boot < window.boot:
            raise Rejected("old-boot", f"mesh datagram of {sender} from before its restart")
        if window is None or boot > window.boot:
            window = self._windows[sender] = _Window(boot)
        if not window.is_fresh(counter):
            raise Rejected("replay", f"mesh datagram {counter} of {sender} was seen before")
        window.mark(counter)
        return Opened(sender, boot, counter, payload)


def _header(sender: int, boot: int, counter: int) -> bytes:
    return _HEADER.pack(MAGIC, SEAL_VERSION, sender, boot, counter >> 32, counter & 0xFFFFFFFF)


def _nonce(header: bytes) -> bytes:
    return header[3:] + b"\0"  # sender, boot, counter: 11 bytes, padded to RFC 8439's 12
