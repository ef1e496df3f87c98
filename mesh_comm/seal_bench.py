"""How many datagrams a core seals, opens and refuses a second: the figures behind the choice of seals."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from typing import Any

from imagine.mesh_comm.keyring import KEY_BYTES, KeyRing, SwarmKey, ground_public
from imagine.mesh_comm.seal import OVERHEAD, Rejected, Sealer

_SENDERS = 32
_SCAN_BYTES = 240 - OVERHEAD  # a scan of 360 beams, before sealing
_FULL_BYTES = 1200 - OVERHEAD


def bench_seal(datagrams: int = 20_000, rounds: int = 5) -> dict[str, dict[str, Any]]:
    """Return datagrams per second of CPU time by what is done with them: the best of so many rounds.

    Datagrams come from 32 senders in turn, under a ring of two keys. `signed` are the ground's; as many of everybody's
    could be opened if all drones signed.
    """
    old, new = bytes(KEY_BYTES), bytes(range(KEY_BYTES))
    sign = bytes(range(1, KEY_BYTES + 1))
    ring = KeyRing((SwarmKey(old, accepted_until=2.0), SwarmKey(new, sends_from=0.0)), ground_public(sign), sign)

    def make(own: int, boot: int = 1) -> Sealer:
        return Sealer(ring if own == 0 else ring.for_drones(), own, boot, unix_time_s=1.0)

    found: dict[str, dict[str, Any]] = {}
    for name, size in (("scans", _SCAN_BYTES), ("full", _FULL_BYTES)):
        payload, best = bytes(size), [0.0, 0.0, 0.0, 0.0]
        for number in range(rounds):
            senders = [make(own, number) for own in range(1, _SENDERS + 1)]
            sealed: list[bytes] = []
            each = [senders[index % _SENDERS] for index in range(datagrams)]
            rates = [_rate(partial(_seal, payload, sealed), each)]
            opener = make(254)
            rates.append(_rate(partial(_open, opener), sealed))
            rates.append(_rate(partial(_refuse, opener), sealed))  # replays
            forged = [datagram[:-1] + bytes((datagram[-1] ^ 1,)) for datagram in sealed]
            rates.append(_rate(partial(_refuse, opener), forged))
            best = list(map(max, best, rates))
        for what, rate in zip(("seal", "open", "refuse_replayed", "refuse_forged"), best, strict=True):
            found[f"{what}_{name}"] = {"value": rate, "unit": "datagrams/s of CPU time", "bytes": size + OVERHEAD}
    ground, drone = make(0), make(1)
    signed = [ground.seal(bytes(_SCAN_BYTES), 0.0) for _ in range(datagrams // 20)]
    rate = _rate(partial(_open, drone), signed)
    found["open_signed"] = {"value": rate, "unit": "datagrams/s of CPU time", "bytes": len(signed[0])}
    return found


def _seal(payload: bytes, sealed: list[bytes], sender: Sealer) -> None:
    sealed.append(sender.seal(payload, 0.0))


def _open(opener: Sealer, datagram: bytes) -> None:
    opener.open(datagram, 0.0)


def _refuse(opener: Sealer, datagram: bytes) -> None:
    with suppress(Rejected):
        opener.open(datagram, 0.0)


def _rate(do: Callable[[Any], Any], items: Sequence[Any]) -> float:
    started = time.thread_time()
    for item in items:
        do(item)
    return len(items) / (time.thread_time() - started)
