"""A frontier baseline as a pilot: surveys, deals, and flies all drones of a batch of worlds."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from imagine.core.dealing import LEAST_UTILITY
from imagine.core.frontier_targets import gain_rays
from imagine.sim.exploration import Exploration, Observation
from imagine.train.baselines.parameters import Parameters
from imagine.train.baselines.plan_state import PlanState, forget, plan_scratch, plan_state
from imagine.train.baselines.planning import deal_worlds, fly_worlds, survey_worlds
from imagine.train.pilots import Actions

_UNREACHABLE_M = 1e5
Dealing = Literal["greedy", "hungarian"]


class FrontierPilot:
    """Flies every drone to a frontier of its own map, chosen by `parameters` and `dealing`."""

    def __init__(self, name: str, parameters: Parameters, dealing: Dealing = "greedy") -> None:
        """Make a pilot that has yet to begin."""
        self.name = name
        self._parameters, self._dealing = parameters, dealing
        self._rays = gain_rays()

    def goals(self) -> NDArray[np.int32]:
        """Return where each drone is going, int32 `[worlds, drones]`: flat padded planning cells, -1 for nowhere."""
        return self._state.goal

    def begin(self, env: Exploration) -> None:
        """Make room for the worlds of `env`."""
        rows, columns = env.maps.arrays.kinds.shape[2:]
        self._state = plan_state(env.worlds, env.drones, rows, columns)
        self._scratch = [plan_scratch(rows, columns) for _ in range(env.twin.workers.threads)]

    def forget(self, worlds: NDArray[np.bool_]) -> None:
        """Drop the choices made in these worlds."""
        forget(self._state, worlds)

    def act(self, env: Exploration, observation: Observation, worlds: NDArray[np.bool_] | None = None) -> Actions:
        """Return full speed toward each drone's frontier, nan where it is dead or knows of none that it can get to."""
        state, maps, air = self._state, env.maps.arrays, env.air
        over = env.twin.workers.over
        # under the protocol `off` nobody is known, as on board
        shares = air.rules.shares
        parameters = self._parameters if shares else self._parameters._replace(peer_age_s=-1.0)
        over(
            env.worlds, survey_worlds, state, maps, env.estimates, env.alive, env.decisions.intents, air.state.peers,
            env.ticks, air.rules.ticks_per_s, parameters, self._rays, scratch=self._scratch,
        )  # fmt: skip
        if self._dealing == "greedy":
            over(env.worlds, deal_worlds, state, maps, parameters, self._rays, scratch=self._scratch)
        else:
            deal_by_assignment(state, parameters.cost_weight_per_m)
        actions = np.full((env.worlds, env.drones, env.settings.action.size), np.nan, np.float32)
        hold_s = (env.settings.action.decision_ticks - 1) * env.dt
        over(
            env.worlds, fly_worlds, actions, state, maps, env.estimates, env.alive, air.state.peers, env.ticks,
            air.rules.ticks_per_s if shares else 0.0, env.decisions.parameters, hold_s,
        )  # fmt: skip
        return actions


def deal_by_assignment(state: PlanState, weight: float) -> None:
    """Deal targets out where a choice is due, so that the sum of worths (log utility less weighted way) is greatest.

    A drone that more robots than targets leave without one takes what is worth most to it.
    """
    for world, drone in np.argwhere(state.due):
        found, robots = state.found[world, drone], state.robots[world, drone]
        state.dealt[world, drone] = -1
        if found:
            gain = np.log(np.maximum(state.utility[world, drone, :found], LEAST_UTILITY))
            worth = gain - weight * np.minimum(state.ways[world, drone, :robots, :found], _UNREACHABLE_M)
            chosen, dealt = linear_sum_assignment(worth, maximize=True)
            mine = dealt[chosen == 0]
            state.dealt[world, drone] = mine[0] if len(mine) else int(np.argmax(worth[0]))
