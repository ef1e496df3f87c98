"""How well a policy explores: episodes in batches, and rows of means with bootstrap intervals."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from imagine.core.errors import InputError
from imagine.mesh_comm.settings import Protocol
from imagine.sim.exploration import Exploration
from imagine.sim.exploration_settings import ExplorationSettings
from imagine.sim.film import Film
from imagine.sim.level import load_level
from imagine.sim.metrics import BYTE_KINDS, CONTACT_KINDS, EpisodeMetrics
from imagine.train.evaluation_env import evaluation_env
from imagine.train.policies import Policy, PolicyPilot, load_policy

MAX_WORLDS = 16
_RESAMPLES = 2000


def named_policy(name: str) -> Policy | Literal["random", "frontier"]:
    """Return a baseline by its name, or the policy in a file. Raises InputError when it is neither."""
    if name == "random":
        return "random"
    if name == "frontier":
        return "frontier"
    path = Path(name)
    if not path.exists():
        raise InputError(f"{name}: no such policy: give an ONNX file, a checkpoint, a run, 'frontier' or 'random'")
    return load_policy(path)


def evaluate(
    policy: Policy | Literal["random", "frontier"],
    levels: Sequence[str],
    drones: Sequence[int] = (3,),
    protocol: Protocol = "one-hop",
    episodes: int = 20,
    seed: int = 0,
    env: ExplorationSettings | None = None,
    progress: Callable[[str], None] | None = None,
    film: Film | None = None,
) -> list[dict[str, Any]]:
    """Fly `episodes` episodes on each level with each number of drones; return a row for each.

    Drones start at the level's launch point in the level as it is drawn. `env` gives what the rows do not (episode
    length, limits, radio); by default what the policy was made for. The deterministic policy flies. `progress` is told
    what comes next; `film` takes the first episode of the first row. Raises InputError where any level is wrong, or too
    small for the largest team, before anything is flown.
    """
    base = env or evaluation_env(policy)
    for level in levels:
        load_level(level).launch_poses(max(drones), None)
    rows: list[dict[str, Any]] = []
    for level in levels:
        for count in drones:
            if progress is not None:
                progress(f"level {level}, {count} drones")
            settings = base.model_copy(
                update={
                    "levels": (level,), "level_weights": None, "drones": count, "protocol": protocol,
                    "mirror": False, "random_launch": False, "stagger": False,
                }
            )  # fmt: skip
            finished = run_episodes(policy, settings, episodes, seed, film if not rows else None)
            name = policy if isinstance(policy, str) else policy.name
            rows.append(row(name, level, count, protocol, finished, settings, seed))
    return rows


def run_episodes(
    policy: Policy | Literal["random", "frontier"],
    settings: ExplorationSettings,
    episodes: int,
    seed: int,
    film: Film | None = None,
) -> list[EpisodeMetrics]:
    """Fly whole episodes in batches of worlds; each world gives one a batch, so that quick ones do not count double.

    `film` takes the first of them.
    """
    finished: list[EpisodeMetrics] = []
    batch = 0
    while len(finished) < episodes:
        worlds = min(MAX_WORLDS, episodes - len(finished))
        # a filmed world must stay as it ended, or its last picture would be of the next episode
        filmed = film if batch == 0 else None
        batch_settings = settings.model_copy(update={"worlds": worlds})
        exploration = Exploration(batch_settings, seed + 1000 * batch, restart=filmed is None)
        finished.extend(_first_episodes(policy, exploration, np.random.default_rng([seed, batch]), filmed))
        batch += 1
    return finished


def _first_episodes(
    policy: Policy | Literal["random", "frontier"],
    exploration: Exploration,
    rng: np.random.Generator,
    film: Film | None,
) -> list[EpisodeMetrics]:
    """Return the first finished episode of every world, and film that of world 0."""
    observation = exploration.reset()
    if film is not None:
        film.take(exploration, 0)
    first: dict[int, EpisodeMetrics] = {}
    pilot = None if isinstance(policy, str) else PolicyPilot(policy)
    if pilot is not None:
        pilot.begin(exploration)
    shape = (exploration.worlds, exploration.drones, exploration.settings.action.size)
    while len(first) < exploration.worlds:
        if policy == "frontier":
            actions = np.nan_to_num(exploration.planner_actions(), nan=0.0)
        elif policy == "random":
            actions = rng.uniform(-1.0, 1.0, shape).astype(np.float32)
        else:
            assert pilot is not None
            actions = pilot.act(exploration, observation)
        step = exploration.step(actions)
        if film is not None and 0 not in first:
            film.take(exploration, 0)
        if pilot is not None:
            pilot.forget(step.done)
        for episode in step.episodes:
            first.setdefault(episode.world, episode)
        observation = step.observation
    return [first[world] for world in sorted(first)]


def row(
    policy: str,
    level: str,
    drones: int,
    protocol: str,
    episodes: Sequence[EpisodeMetrics],
    settings: ExplorationSettings,
    seed: int,
) -> dict[str, Any]:
    """Return the means over episodes as a row.

    An episode that never reaches a coverage counts with its full length. `productivity_ratio` is the geometric mean,
    as becomes ratios.
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
    }
    for name in ("t90", "t95", "t99"):
        ticks = [getattr(episode, name) for episode in episodes]
        row[f"{name}_mean"] = float(np.mean([settings.episode_ticks if t is None else t for t in ticks]))
        row[f"{name}_reached"] = float(np.mean([t is not None for t in ticks]))
    row["overlap"] = float(np.mean([episode.overlap for episode in episodes]))
    row["collisions_per_episode"] = float(np.mean([episode.contacts for episode in episodes]))
    row["path_m"] = float(np.mean([episode.path_m.mean() for episode in episodes]))
    sent = np.mean([episode.bytes_by.mean(axis=0) for episode in episodes], axis=0)
    row["bytes_per_drone"] = float(sent.sum())
    row["bytes_sent"] = dict(zip(BYTE_KINDS, sent.tolist(), strict=True))
    contacts = np.mean([episode.contacts_by.sum(axis=0) for episode in episodes], axis=0)
    row["collisions_by_kind"] = dict(zip(CONTACT_KINDS, contacts.tolist(), strict=True))
    row["productivity_ratio"] = float(np.exp(np.mean([np.log(episode.productivity_ratio) for episode in episodes])))
    row["link_share"] = float(np.mean([episode.link_share for episode in episodes]))
    row["survivors"] = float(np.mean([(episode.alive_ticks == episode.ticks).mean() for episode in episodes]))
    return row


def bootstrap_interval(values: NDArray[np.float64], rng: np.random.Generator) -> tuple[float, float]:
    """Return the 95 % percentile bootstrap interval of the mean (Efron 1979)."""
    draws = rng.integers(0, len(values), (_RESAMPLES, len(values)))
    low, high = np.percentile(values[draws].mean(axis=1), [2.5, 97.5])
    return float(low), float(high)
