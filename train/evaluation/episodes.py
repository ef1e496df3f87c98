"""Whole episodes in batches of worlds, each drawn from the seed and its own number alone."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from imagine.sim.exploration import Exploration
from imagine.sim.exploration_settings import ExplorationSettings
from imagine.sim.film import Film
from imagine.sim.metrics import EpisodeMetrics
from imagine.train.evaluation.contenders import contender_of
from imagine.train.pilots import Pilot
from imagine.train.policies import Policy

MOST_WORLDS = 50
"""Worlds flown at a time at most; what an episode comes to does not depend on it."""
_SEEDS = 1 << 32
"""Where seeds of evaluations begin, so that none is ever one of training, whatever number both are given."""


def run_episodes(
    who: Pilot | Policy | str,
    settings: ExplorationSettings,
    episodes: int,
    seed: int,
    film: Film | None = None,
    ended: Callable[[int], None] | None = None,
    most_worlds: int = MOST_WORLDS,
) -> list[EpisodeMetrics]:
    """Fly episodes 0 to `episodes` - 1 in the level, launch and team of `settings`, and return them in that order.

    Episode e has the same level variant, launch, sensor noise, radio losses and people for everyone who flies it under
    the same `seed`: it is world e of that seed, whatever batch it flies in. `film` takes the first episode; `ended` is
    told how many have ended each time some have.
    """
    pilot = contender_of(who, seed).pilot
    batches = -(-episodes // most_worlds)
    finished: list[EpisodeMetrics] = []
    for numbers in np.array_split(np.arange(episodes), batches):
        batch = settings.model_copy(update={"worlds": len(numbers)})
        # a world stays as it ended: its next episode is nobody's, and a film's last picture shows the end
        env = Exploration(batch, _SEEDS + seed, restart=False, world_keys=numbers.tolist())
        finished += _fly(pilot, env, film if not finished else None, ended)
    return finished


def _fly(
    pilot: Pilot, env: Exploration, film: Film | None, ended: Callable[[int], None] | None
) -> list[EpisodeMetrics]:
    """Fly every world's episode to its end, and film that of world 0."""
    observation = env.reset()
    pilot.begin(env)
    if film is not None:
        film.take(env, 0)
    finished: dict[int, EpisodeMetrics] = {}
    while len(finished) < env.worlds:
        actions = np.clip(np.nan_to_num(pilot.act(env, observation), nan=0.0), -1.0, 1.0)
        step = env.step(actions)
        if film is not None and 0 not in finished:
            film.take(env, 0)
        observation = step.observation
        if step.episodes:
            over = np.zeros(env.worlds, np.bool_)
            for episode in step.episodes:
                finished[episode.world] = episode
                over[episode.world] = True
            pilot.forget(over)
            if ended is not None:
                ended(len(step.episodes))
    return [finished[world] for world in sorted(finished)]
