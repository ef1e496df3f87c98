"""Episodes as numbers: rows of means with bootstrap intervals, and how two pilots compare over the same episodes."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

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
    levels: Sequence[Sequence[EpisodeMetrics]],
    episode_ticks: int,
    seed: int,
) -> dict[str, Any]:
    """Return what was flown on some levels, the episodes of each, as a row of means.

    Every level counts alike, however many episodes were flown on it. An episode that never reaches a coverage counts
    with its full length, `episode_ticks`. `productivity_ratio` is the geometric mean, as becomes ratios. `paired` is
    empty: see `paired`.
    """
    sizes = [len(flown) for flown in levels]
    episodes = [episode for flown in levels for episode in flown]

    def mean(values: ArrayLike) -> Any:
        return level_mean(np.asarray(values, float), sizes).tolist()

    coverage = np.array([episode.coverage for episode in episodes])
    row: dict[str, Any] = {
        "policy": policy,
        "level": level,
        "drones": drones,
        "protocol": protocol,
        "episodes": len(episodes),
        "coverage_mean": mean(coverage),
        "coverage_ci95": bootstrap_interval(coverage, np.random.default_rng(seed), sizes),
        "coverage_min": float(coverage.min()),
    }
    lasted = held_curves(episodes, episode_ticks)
    row["coverage_at"] = {str(tick): mean(lasted[:, tick - 1]) for tick in COVERAGE_TICKS if tick <= episode_ticks}
    for name in ("t90", "t95", "t99"):
        ticks = reaching_ticks(episodes, name, episode_ticks)
        row[f"{name}_mean"] = mean(ticks)
        if name == "t90":
            row["t90_ci95"] = bootstrap_interval(ticks, np.random.default_rng(seed), sizes)
        row[f"{name}_reached"] = mean([getattr(episode, name) is not None for episode in episodes])
    row["overlap"] = mean([episode.overlap for episode in episodes])
    row["collisions_per_episode"] = mean([episode.contacts for episode in episodes])
    row["collisions_per_drone"] = row["collisions_per_episode"] / drones
    row["path_m"] = mean([float(episode.path_m.mean()) for episode in episodes])
    sent = mean([episode.bytes_by.mean(axis=0) for episode in episodes])
    row["bytes_per_drone"] = float(sum(sent))
    row["bytes_sent"] = dict(zip(BYTE_KINDS, sent, strict=True))
    contacts = mean([episode.contacts_by.sum(axis=0).astype(float) for episode in episodes])
    row["collisions_by_kind"] = dict(zip(CONTACT_KINDS, contacts, strict=True))
    row["productivity_ratio"] = math.exp(mean([math.log(episode.productivity_ratio) for episode in episodes]))
    row["link_share"] = mean([episode.link_share for episode in episodes])
    row["survivors"] = mean([float((episode.alive_ticks == episode.ticks).mean()) for episode in episodes])
    row["paired"] = None
    return row


def paired(
    levels: Sequence[Sequence[EpisodeMetrics]],
    reference: Sequence[Sequence[EpisodeMetrics]],
    against: str,
    episode_ticks: int,
    seed: int,
) -> dict[str, Any]:
    """Compare with the reference over the same episodes of the same levels, in the same order.

    `t90_ratio` is the ratio of the mean T90s, own per reference's; differences are own less the reference's, means over
    pairs; means count every level alike. Intervals are 95 % percentile bootstrap intervals over resampled pairs, drawn
    as in `bootstrap_interval`.
    """
    sizes = [len(flown) for flown in levels]
    episodes, others = ([episode for flown in both for episode in flown] for both in (levels, reference))
    own, theirs = (reaching_ticks(flown, "t90", episode_ticks) for flown in (episodes, others))
    gained = np.array([episode.coverage for episode in episodes]) - [episode.coverage for episode in others]
    return {
        "against": against,
        "t90_ratio": float(level_mean(own, sizes) / level_mean(theirs, sizes)),
        "t90_ratio_ci95": ratio_interval(own, theirs, np.random.default_rng(seed), sizes),
        "t90_difference": float(level_mean(own - theirs, sizes)),
        "t90_difference_ci95": bootstrap_interval(own - theirs, np.random.default_rng(seed), sizes),
        "coverage_difference": float(level_mean(gained, sizes)),
        "coverage_difference_ci95": bootstrap_interval(gained, np.random.default_rng(seed), sizes),
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


def level_mean(values: Values, sizes: Sequence[int]) -> Values:
    """Return the mean over levels of each level's mean, `[...]`, of values `[episodes, ...]` level after level.

    `sizes` are the numbers of episodes of the levels.
    """
    mean: Values = np.mean([part.mean(axis=0) for part in np.split(values, np.cumsum(sizes)[:-1])], axis=0)
    return mean


def bootstrap_interval(
    values: Values, rng: np.random.Generator, sizes: Sequence[int] | None = None
) -> tuple[float, float]:
    """Return the 95 % percentile bootstrap interval of the mean (Efron 1979) of values `[n]`.

    `sizes` are those of the levels that the values belong to, one after another (None: a single one). The mean is then
    `level_mean`, and each level is resampled for itself (Davison and Hinkley 1997, section 3.2): what differs between
    levels is no matter of chance, for they were chosen.
    With one episode a level, as of many floor plans, levels are the sample, and are resampled.
    """
    return _interval(sizes or [len(values)], lambda drawn: values[drawn].mean(axis=1), lambda mean: mean, rng)


def ratio_interval(
    above: Values, below: Values, rng: np.random.Generator, sizes: Sequence[int] | None = None
) -> tuple[float, float]:
    """Return the 95 % percentile bootstrap interval of the ratio of the means of paired values, `[n]` each.

    `sizes` are as for `bootstrap_interval`.
    """
    pairs = np.stack([above, below])
    return _interval(
        sizes or [len(above)], lambda drawn: pairs[:, drawn].mean(axis=2), lambda means: means[0] / means[1], rng
    )


def _interval(
    sizes: Sequence[int],
    level_means: Callable[[NDArray[np.int64]], Values],
    statistic: Callable[[Values], Values],
    rng: np.random.Generator,
) -> tuple[float, float]:
    """Return the middle 95 % of a statistic over resamples of each level.

    `level_means` takes drawn numbers of a level's values, `[resamples, size]`, and returns means `[..., resamples]`;
    `statistic` makes `[resamples]` of their mean over levels.
    """
    if max(sizes) == 1:
        sizes = [len(sizes)]
    parts = -(-_RESAMPLES * sum(sizes) // _PART)
    firsts = np.cumsum([0, *sizes[:-1]])
    told = []
    for _ in range(parts):
        rows = -(-_RESAMPLES // parts)
        drawn = [rng.integers(first, first + size, (rows, size)) for first, size in zip(firsts, sizes, strict=True)]
        told.append(statistic(np.mean([level_means(numbers) for numbers in drawn], axis=0)))
    low, high = np.percentile(np.concatenate(told), [2.5, 97.5])
    return float(low), float(high)
