"""Two pilots in one batch of worlds: one for those that began at their level's launch point, the other elsewhere."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from imagine.sim.exploration import Exploration, Observation
from imagine.train.pilots import Actions, Pilot


class LaunchPointPilot:
    """Flies worlds that began at their level's launch point, as it is, by one pilot, and all others by the other."""

    def __init__(self, anywhere: Pilot, at_launch_point: Pilot) -> None:
        """Make a pilot that has yet to begin."""
        self.name = f"{anywhere.name}, {at_launch_point.name} from launch points"
        self._anywhere, self._at_launch_point = anywhere, at_launch_point

    def begin(self, env: Exploration) -> None:
        """Let both begin."""
        self._anywhere.begin(env)
        self._at_launch_point.begin(env)

    def forget(self, worlds: NDArray[np.bool_]) -> None:
        """Let both forget these worlds."""
        self._anywhere.forget(worlds)
        self._at_launch_point.forget(worlds)

    def act(self, env: Exploration, observation: Observation, worlds: NDArray[np.bool_] | None = None) -> Actions:
        """Return the actions of the pilot whose world it is, `[worlds, drones, action size]`; nan where it has none."""
        designed = env.as_designed
        wanted = np.ones(env.worlds, np.bool_) if worlds is None else worlds
        actions = self._anywhere.act(env, observation, wanted & ~designed)
        actions[designed] = self._at_launch_point.act(env, observation, wanted & designed)[designed]
        return actions
