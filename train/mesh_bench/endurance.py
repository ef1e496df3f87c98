"""Measured on nodes alone: a crowd on a bad radio, memory over an hour, how much a core hears, and hostile bytes."""

from __future__ import annotations

import gc
import os
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from imagine.core.evidence import EvidenceMap
from imagine.mesh_comm import messages
from imagine.mesh_comm.node import MeshNode, MeshSettings
from imagine.mesh_comm.seal import KEY_BYTES, Sealer
from imagine.sim.mesh_flight import BOOT
from imagine.sim.radio import RadioSettings
from imagine.train.mesh_bench.exchange import FAR, NEAR, Results
from imagine.train.mesh_bench.flights import TICK_S, Flight
from imagine.train.mesh_bench.team import HALF_EXTENT_M, Team

_KEY = bytes(KEY_BYTES)
_LIMIT_S = 300.0
_STRIDE_TICKS = 5


def crowd(flight: Flight, minutes: float, progress: Callable[[str], None]) -> Results:
    """Let many drones explore with half of all datagrams lost and half a second of delay, then fly on for `minutes`.

    Seconds from the last scan until every drone holds every layer; and resident memory, in the first and in the last
    quarter of the time after that. They fly the same ways back and forth then and scan twice a second, so that maps
    keep changing and scans, tiles and digests never end, in steps of half a second.
    """
    radio = RadioSettings(range_m=1000.0, loss=0.5, latency_s=0.5)
    team = Team(flight, MeshSettings(), radio)
    for second in range(round(flight.seconds)):
        progress(f"{flight.drones} drones, half of it lost: {second} s of {flight.seconds:.0f}")
        for _ in range(round(1.0 / TICK_S)):
            if team.ticks < len(flight.poses):
                team.tick()
    end_s = team.now
    while not team.agrees() and team.now < end_s + _LIMIT_S:
        team.tick(scans=False)
    converged_s = team.now - end_s if team.agrees() else None
    results: Results = {
        "crowd_converges": {
            "value": None if converged_s is None else round(converged_s, 1), "unit": "s after the last scan",
            "drones": flight.drones, "loss": 0.5, "latency_s": 0.5, "flown_s": round(end_s, 1),
            "bytes_a_drone": round(sum(team.bytes_sent.values()) / flight.drones),
        }
    }  # fmt: skip
    memory = []
    before = dict(team.bytes_sent)
    for minute in range(round(minutes)):
        progress(f"{flight.drones} drones fly to and fro: minute {minute} of {minutes:.0f}")
        for _ in range(round(60.0 / TICK_S / _STRIDE_TICKS)):
            team.to_and_fro(_STRIDE_TICKS)
        memory.append(_resident_bytes())
    if len(memory) > 2:
        quarter = max(1, len(memory) // 4)
        early, late = float(np.mean(memory[:quarter])), float(np.mean(memory[-quarter:]))
        results["memory_growth"] = {
            "value": round(late / early - 1.0, 5), "unit": "share of resident memory", "minutes": len(memory),
            "early_bytes": round(early), "late_bytes": round(late), "drones": flight.drones,
            "sent_meanwhile": {kind: sent - before[kind] for kind, sent in team.bytes_sent.items()},
        }  # fmt: skip
    return results


def _resident_bytes() -> int:
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def throughput(flight: Flight, rounds: int) -> Results:
    """Play all that a team says on a flight to a drone that listens: datagrams a second of CPU time, the best round."""
    team = Team(flight, MeshSettings(), FAR, keeps=True).fly()
    kinds = Counter(type(message).__name__.lower() for message in _contents([said for _, _, said in team.said]))
    rates, by_kind = [], Counter[str]()
    for _ in range(rounds):
        node = _listener(flight)
        started = time.thread_time()
        for at, _, datagram in team.said:
            node.receive(datagram, at)
        rates.append(len(team.said) / (time.thread_time() - started))
    reader, node = Sealer(_KEY, 253, 1), _listener(flight)
    for at, _, datagram in team.said:
        kind = type(messages.decode(reader.open(datagram, at).payload)).__name__.lower()
        started = time.thread_time()
        node.receive(datagram, at)
        by_kind[kind] += round(1e9 * (time.thread_time() - started))
    return {
        "received": {
            "value": round(max(rates)), "unit": "datagrams/s of CPU time", "datagrams": len(team.said),
            "mix": dict(kinds),
            "us_each": {kind: round(by_kind[kind] / 1e3 / count, 1) for kind, count in kinds.items()},
            "bytes_mean": round(float(np.mean([len(said) for _, _, said in team.said]))), "dropped": node.stats,
        }
    }  # fmt: skip


def _listener(flight: Flight, evidence: EvidenceMap | None = None) -> MeshNode:
    evidence = evidence or EvidenceMap(200, HALF_EXTENT_M)
    return MeshNode(evidence, flight.lidar, flight.range_cap_m, MeshSettings(), Sealer(_KEY, evidence.own, BOOT))


def _contents(datagrams: Sequence[bytes]) -> list[messages.Message]:
    reader = Sealer(_KEY, 254, 1)
    return [messages.decode(reader.open(datagram, 0.0).payload) for datagram in datagrams]


def hostile(flight: Flight, datagrams: int, seed: int) -> Results:
    """Play altered and random datagrams to a listener: nothing raises, nothing changes, memory stays."""
    team = Team(flight, MeshSettings(), NEAR, keeps=True)
    while team.ticks < min(len(flight.poses), 300):
        team.tick()
    sound = [said for _, _, said in team.said]
    evidence = EvidenceMap(200, HALF_EXTENT_M)
    node = _listener(flight, evidence)
    for datagram in sound:
        node.receive(datagram, team.now)
    before, counted = state(node, evidence), sum(node.stats.values())
    rng = np.random.default_rng(seed)
    play(node, sound, min(1000, datagrams), rng, team.now)
    resident = _resident_bytes()
    started = time.thread_time()
    play(node, sound, datagrams, rng, team.now)
    took = time.thread_time() - started
    return {
        "hostile": {
            "value": datagrams, "unit": "datagrams",
            "refused": sum(node.stats.values()) - counted - min(1000, datagrams),
            "state_changed": state(node, evidence) != before, "resident_growth_bytes": _resident_bytes() - resident,
            "per_s": round(datagrams / took), "reasons": node.stats,
        }
    }  # fmt: skip


def play(node: MeshNode, sound: Sequence[bytes], count: int, rng: np.random.Generator, now: float) -> None:
    """Let a node receive `count` datagrams that are none of a swarm's: sound ones altered, cut or run together; noise.

    A sound datagram is altered in at least one bit, so that the seal is broken.
    """
    for kind, pick, at, flip in zip(
        rng.integers(0, 5, count), rng.integers(0, len(sound), count), rng.random(count), rng.integers(1, 256, count),
        strict=True,
    ):  # fmt: skip
        datagram = bytearray(sound[pick])
        place = int(at * len(datagram))
        match int(kind):
            case 0 | 1:
                datagram[place] ^= int(flip)
            case 2:
                del datagram[place:]
            case 3:
                datagram[place:] = rng.bytes(len(datagram) - place)
                datagram[place] = sound[pick][place] ^ int(flip)
            case _:
                datagram = bytearray(rng.bytes(int(at * 1400)))
        node.receive(bytes(datagram), now)


def state(node: MeshNode, evidence: EvidenceMap) -> tuple[object, ...]:
    """Return what must not change: layers, peers, and what the node would say."""
    layers = tuple(
        (source, layer.boot, layer.clock, layer.cells.tobytes(), layer.versions.tobytes(), layer.provisional.tobytes())
        for source, layer in sorted(evidence.layers.items())
    )
    return layers, repr(node.peers(0.0)), node.own_cells, node.scan_cells, node.map_cells, node.commands()
