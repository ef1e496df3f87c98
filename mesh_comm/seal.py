"""Sealing of datagrams with ChaCha20-Poly1305 (RFC 8439) under keys derived for each sender, with replays dropped.

Datagram: a clear header of 14 bytes, authenticated as associated data, then ciphertext and 16-byte tag. Header,
big-endian: magic 2 bytes, version u8, key id u8, sender u8, flags u8, boot u32, counter u32. The nonce is the header
without its magic, 12 bytes: it never repeats under one key while a sender never uses a boot number twice.

Flags: 1, a claim (`namesake.py`) instead of a message; 2, the plaintext ends in the ground station's Ed25519 signature
(RFC 8032) over `imagine ground`, header and message. docs/mesh.md says what this protects and what not.
"""

from __future__ import annotations

import math
import struct
from collections import Counter
from typing import NamedTuple

from cryptography.exceptions import InvalidSignature, InvalidTag
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey
from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305

from imagine.core.errors import InputError
from imagine.mesh_comm.keyring import KEY_BYTES, KeyRing, SwarmKey
from imagine.mesh_comm.messages import GROUND
from imagine.mesh_comm.namesake import NamesakeWatch
from imagine.mesh_comm.replay import ReplayWindow

__all__ = ["KEY_BYTES", "MAGIC", "OVERHEAD", "SEAL_VERSION", "Opened", "Rejected", "Sealer"]

MAGIC = b"\xa7M"
SEAL_VERSION = 2
OVERHEAD = 14 + 16
"""Bytes that sealing adds: header and tag."""
SIGNATURE_BYTES = 64
_HEADER = struct.Struct(">2sBBBBII")
_HEADER_BYTES = _HEADER.size
_CLAIM, _SIGNED = 1, 2
_SIGNS_FOR = b"imagine ground"
_LAST_COUNTER = 2**32 - 1


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


class _Timed(NamedTuple):
    """A key with its times as the caller counts seconds."""

    key: SwarmKey
    sends_from: float
    accepted_until: float


class Sealer:
    """Seals what one node sends and opens what it hears.

    `boot` (u32) must grow at every start of the node (`keys.next_boot_number`): it keeps nonces unique, and lets the
    others accept a restarted node while they still refuse recordings of its earlier life. Times `now` are the caller's
    seconds, of any origin; they matter only to keys with times. A key that is heard before it sends by this node's time
    shows that its clock is behind: from then on it is at least that key's `sends_from`.
    """

    def __init__(
        self, keys: KeyRing | bytes, own: int, boot: int, unix_time_s: float = -math.inf, first_counter: int = 1
    ) -> None:
        """Make the sealer of node `own` (0..254); a bare 32-byte key stands for a ring of it alone.

        `unix_time_s` is the time at the first call's `now`. `first_counter` (below 2^31) should be random where two
        nodes could by mistake be started with one id in the same second. Raises InputError on values out of range, and
        where the ring is not one for this node.
        """
        ring = KeyRing.of(keys) if isinstance(keys, bytes) else keys.check("mesh keys")
        if not 0 <= own <= 254:
            raise InputError(f"mesh id is {own}, needs to be 0 (ground) to 254")
        if not 0 <= boot < 2**32:
            raise InputError(f"boot number is {boot}, needs to be in 0..2^32-1")
        if not 0 < first_counter < 2**31:
            raise InputError(f"first counter is {first_counter}, needs to be in 1..2^31-1")
        if own != GROUND and ring.ground_sign is not None:
            raise InputError(f"drone {own} was given the ground station's signing key: give it the drones' key file")
        if own == GROUND and ring.ground_verify is not None and ring.ground_sign is None:
            raise InputError("the drones' keys ask for signed orders: give the ground station its own key file")
        if not math.isfinite(unix_time_s) and any(key.has_times for key in ring.keys):
            raise InputError("the mesh keys have times: a sealer under them needs to know the time")
        self.own = own
        self.boot = boot
        self.rejected: Counter[str] = Counter()
        self.overhead = OVERHEAD + (SIGNATURE_BYTES if own == GROUND and ring.ground_sign is not None else 0)
        """Bytes that sealing adds to a message of this node."""
        self._ring = ring
        self._unix_time_s = unix_time_s
        self._sign = Ed25519PrivateKey.from_private_bytes(ring.ground_sign) if ring.ground_sign is not None else None
        self._verify = (
            Ed25519PublicKey.from_public_bytes(ring.ground_verify) if ring.ground_verify is not None else None
        )
        self._keys: dict[int, _Timed] = {}
        self._ciphers: dict[tuple[int, int], ChaCha20Poly1305] = {}  # by key id and sender: at most 8 times 255
        self._first = first_counter
        self._counter = first_counter - 1
        self._windows: dict[int, ReplayWindow] = {}
        self._namesake = NamesakeWatch(boot)

    @property
    def has_namesake(self) -> bool:
        """Whether another node is known to have used this node's id since this sealer was made."""
        return self._namesake.is_proven

    def seal(self, payload: bytes, now: float) -> bytes:
        """Return the datagram that carries `payload`, `overhead` bytes longer."""
        return self._seal(payload, 0, now)

    def claim(self, now: float) -> bytes | None:
        """Return a sealed claim that answers another node with this id, where one is due; send it like a message."""
        claim = self._namesake.claim(now)
        return None if claim is None else self._seal(claim, _CLAIM, now)

    def open(self, datagram: bytes, now: float) -> Opened:
        """Check and decrypt a datagram. Raises Rejected (and counts its reason) on anything but a fresh, true message.

        Reasons: short, magic, version, flags, unknown-key, expired-key, echo (an own datagram heard back), forged
        (another key, or altered), unsigned (in the ground's name without its signature), old-boot, replay, own-id
        (true, of another life under the own id), claim (true, and for another node).
        """
        try:
            return self._open(bytes(datagram), now)
        except Rejected as rejection:
            self.rejected[rejection.reason] += 1
            raise

    def _seal(self, payload: bytes, flags: int, now: float) -> bytes:
        if self._counter >= _LAST_COUNTER:
            raise InputError("mesh counter is used up: restart the node with a new boot number")
        self._counter += 1
        flags |= _SIGNED if self._sign is not None else 0
        key_id = self._sending_key(now)
        header = _HEADER.pack(MAGIC, SEAL_VERSION, key_id, self.own, flags, self.boot, self._counter)
        if self._sign is not None:
            payload += self._sign.sign(_SIGNS_FOR + header + payload)
        return header + self._cipher(key_id, self.own).encrypt(header[2:], payload, header)

    def _open(self, datagram: bytes, now: float) -> Opened:
        if len(datagram) < OVERHEAD:
            raise Rejected("short", f"mesh datagram of {len(datagram)} bytes is shorter than a seal")
        magic, version, key_id, sender, flags, boot, counter = _HEADER.unpack_from(datagram)
        if magic != MAGIC:
            raise Rejected("magic", f"mesh datagram starts with {magic!r}")
        if version != SEAL_VERSION:
            raise Rejected("version", f"mesh datagram of seal version {version}, expected {SEAL_VERSION}")
        if flags & ~(_CLAIM | _SIGNED):
            raise Rejected("flags", f"mesh datagram with flags {flags:#x}")
        timed = (self._keys or self._time_keys(now)).get(key_id)
        if timed is None:
            raise Rejected("unknown-key", f"mesh datagram in the name of {sender} under key {key_id:02x}, not held")
        if now >= timed.accepted_until:
            raise Rejected("expired-key", f"mesh datagram in the name of {sender} under key {key_id:02x}, which ended")
        if sender == self.own and boot == self.boot and self._first <= counter <= self._counter:
            raise Rejected("echo", "own mesh datagram heard back")
        header = datagram[:_HEADER_BYTES]
        try:
            payload = self._cipher(key_id, sender).decrypt(header[2:], datagram[_HEADER_BYTES:], header)
        except InvalidTag as error:
            raise Rejected("forged", f"mesh datagram in the name of {sender}: altered, or another key") from error
        # only now is the header true: nothing below may be reached by one without the key
        window = None if sender == self.own else self._windows.get(sender)
        if window is not None and boot < window.boot:
            raise Rejected("old-boot", f"mesh datagram of {sender} from before its restart")
        if window is not None and boot == window.boot and not window.is_fresh(counter):
            raise Rejected("replay", f"mesh datagram {counter} of {sender} was seen before")
        if flags & _SIGNED or (sender == GROUND and self._verify is not None):  # late: it takes thirty times as long
            payload = self._check_signature(header, payload, sender, flags)
        if sender == self.own:
            self._namesake.hear(boot, payload if flags & _CLAIM else None, now)
            raise Rejected("own-id", f"mesh datagram under the own id {sender}, of another life or another node")
        if window is None or boot > window.boot:
            window = self._windows[sender] = ReplayWindow.since(boot, counter)
        window.mark(counter)
        if now < timed.sends_from:  # somebody's clock says that this key's time has come, and no clock runs early
            self._set_forward(timed.sends_from - now)
        if flags & _CLAIM:
            raise Rejected("claim", f"mesh node {sender} tells another one that they share an id")
        return Opened(sender, boot, counter, payload)

    def _check_signature(self, header: bytes, signed: bytes, sender: int, flags: int) -> bytes:
        """Return the message without its signature, which only those check who hold the ground's public key."""
        payload, signature = signed[:-SIGNATURE_BYTES], signed[-SIGNATURE_BYTES:]
        if sender != GROUND or not flags & _SIGNED or len(signature) < SIGNATURE_BYTES:
            raise Rejected("unsigned", f"mesh datagram in the name of {sender} without the ground's signature")
        if self._verify is not None:
            try:
                self._verify.verify(signature, _SIGNS_FOR + header + payload)
            except InvalidSignature as error:
                raise Rejected("unsigned", "mesh datagram in the ground's name with a wrong signature") from error
        return payload

    def _sending_key(self, now: float) -> int:
        """Return the id of the last key that sends by now; before the first one does, that of the first."""
        timed = list((self._keys or self._time_keys(now)).values())
        return next((t.key.id for t in reversed(timed) if t.sends_from <= now), timed[0].key.id)

    def _time_keys(self, now: float) -> dict[int, _Timed]:
        """Express the keys' times in the caller's seconds, at the first call."""
        unix_time_s = self._ring.latest_time(self._unix_time_s)
        for key in self._ring.keys:
            timed = _Timed(key, key.sends_from, key.accepted_until)
            if key.has_times:
                timed = _Timed(key, now + (key.sends_from - unix_time_s), now + (key.accepted_until - unix_time_s))
            self._keys[key.id] = timed
        return self._keys

    def _set_forward(self, seconds: float) -> None:
        """Take it to be so much later than the clock said at the start."""
        self._keys = {
            id_: _Timed(timed.key, timed.sends_from - seconds, timed.accepted_until - seconds)
            for id_, timed in self._keys.items()
        }

    def _cipher(self, key_id: int, sender: int) -> ChaCha20Poly1305:
        cipher = self._ciphers.get((key_id, sender))
        if cipher is None:
            secret = self._keys[key_id].key.sender_secret(sender)
            cipher = self._ciphers[key_id, sender] = ChaCha20Poly1305(secret)
        return cipher
