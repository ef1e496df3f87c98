"""The episodes that a batch of worlds is in: what levels they draw, how far they are, and how they came there.

What the solver remembers of contacts can be neither read nor written, so a saved state does not tell what worlds are
like but how they came to be so: how each episode began, and every action since. All that is random in a world follows
from seed, key, generator and counters, so the same actions from the same beginning lead to the same world, bit for bit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imagine.core.errors import InputError
from imagine.sim.action_log import ActionLog
from imagine.sim.exploration_settings import ExplorationSettings
from imagine.sim.level import Level
from imagine.sim.level_names import expand_levels
from imagine.sim.level_variants import LevelVariants

FORMAT = "imagine-exploration-2"
_SHORTEST_TICKS = 50  # of an episode that is cut so that not all end at once


@dataclass(frozen=True)
class Start:
    """All that an episode's beginning follows from, besides seed, key and settings.

    `level` and `variant` as drawn, and whether drones launch `anywhere` in it; `generator` the state of the world's
    generator after these draws, `shown` and `turns` how many levels the twin had shown and how many turns its LiDARs
    had taken in this world by then.
    """

    level: int
    variant: int
    anywhere: bool
    generator: dict[str, Any]
    shown: int
    turns: int


class Episodes:
    """Episodes by world: `ticks`, `limit` and `idle` int64 `[worlds]`, `ended` bool `[worlds]` (and not begun anew).

    `turns` int64 `[worlds]` counts the LiDARs' turns over all episodes; `generators` are the worlds' own; `weights`
    `[levels]` the shares of the levels in coming episodes; `actions` what was done in those in progress.
    """

    def __init__(self, settings: ExplorationSettings, seed: int, keys: Sequence[int]) -> None:
        """Load the levels; no episode has begun. Raises InputError on wrong levels, and on a negative seed or key."""
        worlds = settings.worlds
        if seed < 0:
            raise InputError(f"seed is {seed}: give 0 or more")
        if len(keys) != worlds or min(keys) < 0:
            raise InputError(f"world_keys {keys}: give one for each of the {worlds} worlds, none negative")
        self._settings = settings
        names, shares = expand_levels(settings.levels, settings.level_weights)
        self.variants = LevelVariants(names, settings.mirror)
        self.weights = np.array(shares)
        self.generators = [np.random.default_rng([seed, key]) for key in keys]
        self.ticks = np.zeros(worlds, np.int64)
        self.limit = np.full(worlds, settings.episode_ticks)
        self.idle = np.zeros(worlds, np.int64)
        self.ended = np.zeros(worlds, np.bool_)
        self.turns = np.zeros(worlds, np.int64)
        self.actions = ActionLog(worlds, settings.drones, settings.action.size)
        self._starts: dict[int, Start] = {}

    def first_levels(self) -> list[Level]:
        """Draw what the worlds show before their first episodes."""
        return [self.variants.get(*self.variants.draw(generator, self.weights)) for generator in self.generators]

    def draw(self, world: int, shown: int) -> Start:
        """Draw a world's next episode, when it has shown so many levels."""
        generator = self.generators[world]
        level, variant = self.variants.draw(generator, self.weights)
        anywhere, designed = self._settings.random_launch, self._settings.as_designed
        if designed > 0.0 and generator.random() < designed:
            variant, anywhere = 0, False
        return Start(level, variant, anywhere, dict(generator.bit_generator.state), shown, int(self.turns[world]))

    def begin(self, world: int, start: Start) -> Level:
        """Begin an episode and return its level; the world's generator goes on from after the level's draw."""
        self._starts[world] = start
        self.actions.clear(world)
        self.generators[world].bit_generator.state = start.generator
        self.turns[world] = start.turns
        self.ticks[world] = self.idle[world] = 0
        self.ended[world] = False
        self.limit[world] = self._settings.episode_ticks
        return self.variants.get(start.level, start.variant)

    def stagger(self) -> None:
        """Give the worlds' episodes different lengths."""
        shares = np.arange(1, len(self.limit) + 1) / len(self.limit)
        self.limit[...] = np.maximum(_SHORTEST_TICKS, np.round(self._settings.episode_ticks * shares))

    def as_designed(self) -> NDArray[np.bool_]:
        """Return which worlds began at the launch point of their level as it is, bool `[worlds]`."""
        starts = [self._starts.get(world) for world in range(len(self.limit))]
        return np.array([start is not None and not start.anywhere and start.variant == 0 for start in starts])

    def state_dict(self) -> dict[str, Any]:
        """Return how the episodes in progress began and came on; plain containers and arrays of the caller's own."""
        starts = [self._starts[world] for world in sorted(self._starts)]
        return {
            "levels": np.array([(start.level, start.variant, start.anywhere) for start in starts], np.int64).reshape(
                -1, 3
            ),
            "start_generators": [start.generator for start in starts],
            "start_shown": np.array([start.shown for start in starts], np.int64),
            "start_turns": np.array([start.turns for start in starts], np.int64),
            "weights": self.weights.copy(),
            "generators": [generator.bit_generator.state for generator in self.generators],
            **{name: getattr(self, name).copy() for name in ("ticks", "limit", "idle", "ended", "turns")},
            **self.actions.state_dict(),
        }

    def starts(self, state: dict[str, Any]) -> list[Start]:
        """Return how the episodes of a `state_dict` began; none where none had."""
        rows = zip(
            state["levels"].tolist(), state["start_generators"], state["start_shown"].tolist(),
            state["start_turns"].tolist(), strict=True,
        )  # fmt: skip
        return [Start(level, variant, bool(anywhere), *rest) for (level, variant, anywhere), *rest in rows]

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take up all of a state but the beginnings of episodes: `begin` those first."""
        if not len(state["levels"]):
            self._starts.clear()  # none had begun
        self.weights = np.array(state["weights"])
        for generator, saved in zip(self.generators, state["generators"], strict=True):
            generator.bit_generator.state = saved
        for name in ("ticks", "limit", "idle", "ended", "turns"):
            getattr(self, name)[...] = state[name]
        self.actions.load_state_dict(state)


def check_same(state: Any, here: dict[str, Any]) -> None:
    """Raise InputError unless a saved state is of this format, and `state["of"]` what it has to be `here`."""
    if not isinstance(state, dict) or state.get("format") != FORMAT:
        raise InputError(
            f"environment state: not of this version ({FORMAT}): go on with the version that wrote it, or start the "
            "environment anew"
        )
    different = list(_differences(state["of"], here, ""))
    if different:
        raise InputError(
            f"environment state: of another environment: {'; '.join(different)}: give it the settings that it was "
            "saved with, or start the environment anew"
        )


def _differences(saved: Any, here: Any, key: str) -> list[str]:
    if isinstance(saved, dict) and isinstance(here, dict):
        names = [*saved, *(name for name in here if name not in saved)]
        below = [_differences(saved.get(name), here.get(name), f"{key}.{name}" if key else name) for name in names]
        return [difference for found in below for difference in found]
    return [] if saved == here else [f"{key} was {saved}, is {here}"]
