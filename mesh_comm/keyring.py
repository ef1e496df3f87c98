"""The keys of a swarm: several at once while they are changed, and the ground station's signing key.

Pure: texts and times in, records out; `keys.py` reads and writes the files. A key ring as text has one key a line:

    64 hexadecimal digits [made=TIME] [sends-from=TIME] [accepted-until=TIME]

with times as 2026-11-25T10:00:00Z, and may have one of `ground-verify=` (drones: the ground station's public key) and
`ground-sign=` (the ground station: its private key), 64 digits each. `#` begins a comment.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import cached_property

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.kdf.hkdf import HKDF

from imagine.core.errors import InputError

KEY_BYTES = 32
_MOST_KEYS = 8
_TIME = "%Y-%m-%dT%H:%M:%SZ"
_DIGITS = 2 * KEY_BYTES


@dataclass(frozen=True)
class SwarmKey:
    """A key that all drones of a swarm share; times in Unix seconds.

    It is used for sending from `sends_from` until a later key is, and opened until `accepted_until`. `made_at` is a
    time that has certainly passed.
    """

    secret: bytes
    made_at: float = -math.inf
    sends_from: float = -math.inf
    accepted_until: float = math.inf

    @property
    def has_times(self) -> bool:
        """Whether it begins or ends."""
        return math.isfinite(self.sends_from) or math.isfinite(self.accepted_until)

    @cached_property
    def id(self) -> int:
        """The byte that names the key in a datagram's clear header: HKDF-SHA256 of the key, info `imagine key id`."""
        return _derive(self.secret, b"imagine key id", 1)[0]

    def sender_secret(self, sender: int) -> bytes:
        """Return the key that seals what `sender` says: HKDF-SHA256, info `imagine sender ` and the sender's byte."""
        return _derive(self.secret, b"imagine sender " + bytes((sender,)), KEY_BYTES)


@dataclass(frozen=True)
class KeyRing:
    """All keys a node holds, in order of `sends_from`, and its part of the ground station's signature."""

    keys: tuple[SwarmKey, ...]
    ground_verify: bytes | None = None
    """The ground's Ed25519 public key: what comes in its name must be signed. None: the swarm's key is enough."""
    ground_sign: bytes | None = None
    """The ground's Ed25519 private key, only in its own ring."""

    @classmethod
    def of(cls, secret: bytes) -> KeyRing:
        """Return the ring of one key without times. Raises InputError unless it has 32 bytes."""
        if len(secret) != KEY_BYTES:
            raise InputError(f"mesh key is {len(secret)} bytes, needs {KEY_BYTES}: make one with `imagine keygen`")
        return cls((SwarmKey(secret),))

    def latest_time(self, unix_time_s: float) -> float:
        """Return the time it is at least, of a clock that may be behind: no key is from the future."""
        return max(unix_time_s, *(key.made_at for key in self.keys))

    def check(self, where: str) -> KeyRing:
        """Return the ring in order. Raises InputError naming `where` if it holds no key, too many, or unsound ones."""
        if not self.keys:
            raise InputError(f"{where}: holds no mesh key; make one with `imagine keygen`")
        if len(self.keys) > _MOST_KEYS:
            raise InputError(f"{where}: holds {len(self.keys)} keys, at most {_MOST_KEYS}; remove the oldest")
        if len({key.id for key in self.keys}) < len(self.keys):
            raise InputError(f"{where}: two of its keys have one key id; remove one, or make another")
        ordered = sorted(self.keys, key=lambda key: key.sends_from)
        if ordered[-1].accepted_until < math.inf:  # there must be a key to send by whenever one asks
            raise InputError(f"{where}: its last key ends; append another with `imagine keygen --rotate`")
        return replace(self, keys=tuple(ordered))

    def rotated(self, draw: Callable[[], bytes], unix_time_s: float, after_s: float, overlap_s: float) -> KeyRing:
        """Return the ring with a new key that sends in `after_s`, the others being accepted `overlap_s` longer.

        Keys that have ended are left out. `draw` gives 32 random bytes, as often as it takes for an id of its own.
        """
        sends_from = unix_time_s + after_s
        until = sends_from + overlap_s
        kept = tuple(
            replace(key, accepted_until=min(key.accepted_until, until))
            for key in self.keys
            if key.accepted_until > unix_time_s
        )
        fresh = SwarmKey(draw(), made_at=unix_time_s, sends_from=sends_from)
        while fresh.id in {key.id for key in kept}:
            fresh = replace(fresh, secret=draw())
        latest = max((key.sends_from for key in kept), default=-math.inf)
        if latest >= sends_from:
            raise InputError(f"the last key sends from {_format_time(latest)} only: let the new one send after that")
        return replace(self, keys=(*kept, fresh)).check("the rotated keys")

    def for_drones(self) -> KeyRing:
        """Return the ring without what only the ground station needs."""
        return replace(self, ground_sign=None)


def ground_public(private: bytes) -> bytes:
    """Return the Ed25519 public key, 32 bytes, of a private one."""
    return Ed25519PrivateKey.from_private_bytes(private).public_key().public_bytes_raw()


def parse_ring(text: str, where: str) -> KeyRing:
    """Read a ring from its text; `where` names the origin in the InputError, which never shows a key."""
    keys: list[SwarmKey] = []
    ground: dict[str, bytes] = {}
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.partition("#")[0].split()
        if not words:
            continue
        at = where if len(text.splitlines()) == 1 else f"{where}:{number}"
        name, equals, value = words[0].partition("=")
        if equals:
            if name not in ("ground-verify", "ground-sign") or len(words) > 1 or name in ground:
                raise InputError(f"{at}: expected a key of {_DIGITS} hexadecimal digits, or one ground-verify or -sign")
            ground[name] = _parse_digits(value, at)
        else:
            keys.append(_parse_key(words, at))
    sign, verify = ground.get("ground-sign"), ground.get("ground-verify")
    if sign is not None:
        if verify not in (None, ground_public(sign)):
            raise InputError(f"{where}: ground-verify is not of the same pair as ground-sign")
        verify = ground_public(sign)
    return KeyRing(tuple(keys), verify, sign).check(where)


def format_ring(ring: KeyRing) -> str:
    """Return the text that `parse_ring` reads."""
    lines = []
    for key in ring.keys:
        times = {"made": key.made_at, "sends-from": key.sends_from, "accepted-until": key.accepted_until}
        words = [f"{name}={_format_time(value)}" for name, value in times.items() if math.isfinite(value)]
        lines.append(" ".join([key.secret.hex(), *words]))
    if ring.ground_sign is not None:
        lines.append(f"ground-sign={ring.ground_sign.hex()}")
    elif ring.ground_verify is not None:
        lines.append(f"ground-verify={ring.ground_verify.hex()}")
    return "\n".join(lines) + "\n"


def _parse_key(words: list[str], where: str) -> SwarmKey:
    secret = _parse_digits(words[0], where)
    times: dict[str, float] = {}
    for word in words[1:]:
        name, _, value = word.partition("=")
        if name not in ("made", "sends-from", "accepted-until") or name in times:
            raise InputError(f"{where}: '{name[:20]}' behind a key: expected made=, sends-from= or accepted-until=")
        try:
            times[name] = datetime.strptime(value, _TIME).replace(tzinfo=UTC).timestamp()
        except ValueError as error:
            raise InputError(f"{where}: {name} is no time like 2026-11-25T10:00:00Z") from error
    return SwarmKey(
        secret,
        times.get("made", -math.inf),
        times.get("sends-from", -math.inf),
        times.get("accepted-until", math.inf),
    )


def _parse_digits(text: str, where: str) -> bytes:
    try:
        key = bytes.fromhex(text)
    except ValueError as error:
        raise InputError(f"{where}: the mesh key is not hexadecimal; make one with `imagine keygen`") from error
    if len(key) != KEY_BYTES:
        raise InputError(f"{where}: the mesh key has {len(text)} hexadecimal digits, needs {_DIGITS}")
    return key


def _format_time(unix_time_s: float) -> str:
    return datetime.fromtimestamp(unix_time_s, UTC).strftime(_TIME)


def _derive(secret: bytes, info: bytes, length: int) -> bytes:
    return HKDF(SHA256(), length, salt=None, info=info).derive(secret)
