"""Episodes as numbers: rows of means with bootstrap intervals, and how two pilots compare over the same episodes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imagine.sim.metrics import BYTE_KINDS, CONTACT_KINDS, EpisodeMetrics

COVERAGE_TICKS = (100, 200, 300, 500, 1000)
"""Ticks after which a row tells the mean coverage, where episodes last as long."""
CURVE_TICKS = 10
"""Ticks between two numbers of a curve in an episode's record."""
_RESAMPLES = 4000
_PART = 2_000_000  # numbers drawn at a time, so that thousands of episodes do not fill the memory

Values = NDArray[np.float64]


def row(
    policy: str,
    level: str,
    drones: int,
    protocol: str,
    episodes: Sequence[EpisodeMetrics],
    episode_ticks: int,
    seed: int,
) -> dict[str, Any]:
    """Return the means over episodes as a row.

    An episode that never reaches a coverage counts with its full length, `episode_ticks`. `productivity_ratio` is the
    geometric mean, as becomes ratios. `paired` is empty: see `paired`.
    """
    coverage = np.array([episode.coverage for episode in episodes])
    row: dict[str, Any] = {
        "policy": policy,
        "level": level,
        "drones": drones,
        "protocol": protocol,
        "episodes": len(episodes),
        "coverage_mean": float(coverage.mean()),
        "coverage_ci95": bootstrap_interval(coverage, np.random.default_rng(seed)),
        "coverage_min": float(coverage.min()),
    }
    lasted = held_curves(episodes, episode_ticks)
    row["coverage_at"] = {
        str(tick): float(lasted[:, tick - 1].mean()) for tick in COVERAGE_TICKS if tick <= episode_ticks
    }
    for name in ("t90", "t95", "t99"):
        ticks = reaching_ticks(episodes, name, episode_ticks)
        row[f"{name}_mean"] = float(ticks.mean())
        if name == "t90":
            row["t90_ci95"] = bootstrap_interval(ticks, np.random.default_rng(seed))
        row[f"{name}_reached"] = float(np.mean([getattr(episode, name) is not None for episode in episodes]))
    row["overlap"] = float(np.mean([episode.overlap for episode in episodes]))
    row["collisions_per_episode"] = float(np.mean([episode.contacts for episode in episodes]))
    row["collisions_per_drone"] = row["collisions_per_episode"] / drones
    row["path_m"] = float(np.mean([episode.path_m.mean() for episode in episodes]))
    sent = np.mean([episode.bytes_by.mean(axis=0) for episode in episodes], axis=0)
    row["bytes_per_drone"] = float(sent.sum())
    row["bytes_sent"] = dict(zip(BYTE_KINDS, sent.tolist(), strict=True))
    contacts = np.mean([episode.contacts_by.sum(axis=0) for episode in episodes], axis=0)
    row["collisions_by_kind"] = dict(zip(CONTACT_KINDS, contacts.tolist(), strict=True))
    row["productivity_ratio"] = float(np.exp(np.mean([np.log(episode.productivity_ratio) for episode in episodes])))
    row["link_share"] = float(np.mean([episode.link_share for episode in episodes]))
    row["survivors"] = float(np.mean([(episode.alive_ticks == episode.ticks).mean() for episode in episodes]))
    row["paired"] = None
    return row


def paired(
    episodes: Sequence[EpisodeMetrics],
    reference: Sequence[EpisodeMetrics],
    against: str,
    episode_ticks: int,
    seed: int,
) -> dict[str, Any]:
    """Compare with the reference over the same episodes, in the same order.

    `t90_ratio` is the ratio of the mean T90s, own per reference's; differences are own less the reference's, means over
    pairs. Intervals are 95 % percentile bootstrap intervals over resampled pairs.
    """
    own, others = (reaching_ticks(flown, "t90", episode_ticks) for flown in (episodes, reference))
    gained = np.array([episode.coverage for episode in episodes]) - [episode.coverage for episode in reference]
    return {
        "against": against,
        "t90_ratio": float(own.mean() / others.mean()),
        "t90_ratio_ci95": ratio_interval(own, others, np.random.default_rng(seed)),
        "t90_difference": float((own - others).mean()),
        "t90_difference_ci95": bootstrap_interval(own - others, np.random.default_rng(seed)),
        "coverage_difference": float(gained.mean()),
        "coverage_difference_ci95": bootstrap_interval(gained, np.random.default_rng(seed)),
    }


def record(policy: str, level: str, drones: int, protocol: str, number: int, episode: EpisodeMetrics) -> dict[str, Any]:
    """Return one episode as a record; `curve` is coverage after every CURVE_TICKS ticks, to four places."""
    return {
        "policy": policy, "level": level, "drones": drones, "protocol": protocol, "episode": number,
        "ticks": episode.ticks, "coverage": episode.coverage,
        "t90": episode.t90, "t95": episode.t95, "t99": episode.t99,
        "overlap": episode.overlap, "collisions": episode.contacts,
        "path_m": episode.path_m.tolist(), "discovered": episode.discovered.tolist(),
        "bytes_sent": episode.bytes_by.sum(axis=1).tolist(), "link_share": episode.link_share,
        "alive_ticks": episode.alive_ticks.tolist(),
        "curve": [round(float(share), 4) for share in episode.curve[CURVE_TICKS - 1 :: CURVE_TICKS]],
    }  # fmt: skip


def reaching_ticks(episodes: Sequence[EpisodeMetrics], name: str, episode_ticks: int) -> Values:
    """Return each episode's `t90`, `t95` or `t99`, float `[episodes]`; `episode_ticks` where it was never reached."""
    ticks = [getattr(episode, name) for episode in episodes]
    return np.array([episode_ticks if tick is None else tick for tick in ticks], float)


def held_curves(episodes: Sequence[EpisodeMetrics], ticks: int) -> NDArray[np.float32]:
    """Return coverage after ticks 1 to `ticks` of each episode, `[episodes, ticks]`; after its end it stays."""
    curves = np.empty((len(episodes), ticks), np.float32)
    for curve, episode in zip(curves, episodes, strict=True):
        known = min(ticks, episode.ticks)
        curve[:known] = episode.curve[:known]
        curve[known:] = episode.curve[known - 1]
    return curves


def bootstrap_interval(values: Values, rng: np.random.Generator) -> tuple[float, float]:
    """Return the 95 % percentile bootstrap interval of the mean (Efron 1979)."""
    return _interval(len(values), lambda drawn: values[drawn].mean(axis=1), rng)


def ratio_interval(above: Values, below: Values, rng: np.random.Generator) -> tuple[float, float]:
    """Return the 95 % percentile bootstrap interval of the ratio of the means of paired values, `[n]` each."""
    return _interval(len(above), lambda drawn: above[drawn].mean(axis=1) / below[drawn].mean(axis=1), rng)


def _interval(
    count: int, statistic: Callable[[NDArray[np.int64]], Values], rng: np.random.Generator
) -> tuple[float, float]:
    """Return the middle 95 % of a statistic over resamples; it takes drawn numbers `[resamples, count]`."""
    parts = -(-_RESAMPLES * count // _PART)
    told = [statistic(rng.integers(0, count, (-(-_RESAMPLES // parts), count))) for _ in range(parts)]
    low, high = np.percentile(np.concatenate(told), [2.5, 97.5])
    return float(low), float(high)
