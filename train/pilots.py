"""Who may fly a batch of worlds: planners, policies and chance, all by the same three calls."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from imagine.sim.exploration import Exploration, Observation

Actions = NDArray[np.float32]


class Pilot(Protocol):
    """Decides for all drones of a batch of worlds, each drone by what it knows itself (but for centralised policies).

    A pilot may keep state from one decision to the next (goals, recurrent state); `begin` and `forget` clear it.
    """

    name: str

    def begin(self, env: Exploration) -> None:
        """Get ready for `env`, whose worlds are all at their launch."""

    def forget(self, worlds: NDArray[np.bool_]) -> None:
        """Drop what is kept of these worlds (bool `[worlds]`), which have started new episodes."""

    def act(self, env: Exploration, observation: Observation, worlds: NDArray[np.bool_] | None = None) -> Actions:
        """Return the actions, float32 `[worlds, drones, action size]` in [-1, 1]; nan where a planner has no advice.

        Those of other worlds than `worlds` (bool `[worlds]`, None: all) are not used: a pilot may leave them out.
        """


class RandomPilot:
    """Draws every action uniformly from [-1, 1], in each world from a generator of its own.

    What is drawn in a world depends on the generator given at first and on the world's key, not on the other worlds.
    """

    name = "random"

    def __init__(self, rng: np.random.Generator) -> None:
        self._seed = int(rng.integers(2**63))
        self._generators: list[np.random.Generator] = []

    def begin(self, env: Exploration) -> None:
        """Begin each world's draws."""
        self._generators = [np.random.default_rng([self._seed, key]) for key in env.twin.world_keys]

    def forget(self, worlds: NDArray[np.bool_]) -> None:
        """Keep nothing: the draws go on."""

    def act(self, env: Exploration, observation: Observation, worlds: NDArray[np.bool_] | None = None) -> Actions:
        """Return a draw."""
        shape = (env.drones, env.settings.action.size)
        return np.stack([rng.uniform(-1.0, 1.0, shape).astype(np.float32) for rng in self._generators])
