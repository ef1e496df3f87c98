"""What the drones of a batch of worlds keep beyond their maps: peers heard, visits, and the decision that stands."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from imagine.core.action import Parameters, action_parameters
from imagine.core.contract import ActionSpec
from imagine.core.frontier import PAD
from imagine.core.frontier_choice import choice_scratch
from imagine.core.observation import MOTION, option_parameters
from imagine.core.observation_spec import ObservationSpec
from imagine.core.visits import visit_levels
from imagine.sim.air import Air
from imagine.sim.decision_kernels import (
    count_visits,
    fill_frontier_choices,
    fill_option_numbers,
    fill_visit_views,
    hear_peers,
    take_decisions,
)
from imagine.sim.workers import Workers


class DecisionState:
    """The state behind the options of an observation and behind actions, for drones `[worlds, drones]`.

    `positions` float64 `[worlds, drones, peers, 2]` and `ages` `[worlds, drones, peers]` are what each drone was told
    by the others (`PeerPoses`), `explorer_ages` the same for those who said that they explore; `own_visits` and
    `peer_visits` uint16 `[worlds, drones, rows // 2, columns // 2]`, empty where the specification shows none;
    `intents` float64 `[worlds, drones, 3]` the decisions that stand.
    """

    def __init__(
        self,
        worlds: int,
        drones: int,
        rows: int,
        columns: int,
        observation: ObservationSpec,
        action: ActionSpec,
        workers: Workers | None = None,
    ) -> None:
        """Start with nobody heard and nothing visited, on maps of `rows` by `columns` cells."""
        self._workers = workers or Workers()
        self._spec = observation
        self._options = option_parameters(observation)
        self._scales = np.array(observation.view_scales_m)
        self._levels = visit_levels(observation.visits_full_ticks)
        self._sees_team = observation.visits == "team"
        self.parameters: Parameters = action_parameters(action, observation.axes)
        grid = (worlds, drones, rows // 2, columns // 2)
        nothing = (worlds, drones, 0, 0)
        self.own_visits = np.zeros(grid if observation.visits != "off" else nothing, np.uint16)
        self.peer_visits = np.zeros(grid if self._sees_team else nothing, np.uint16)
        self.positions = np.zeros((worlds, drones, drones, 2))
        self.ages = np.full((worlds, drones, drones), np.inf)
        self.explorer_ages = self.ages.copy()
        self.intents = np.zeros((worlds, drones, 3))
        padded = rows // 2 + 2 * PAD, columns // 2 + 2 * PAD
        threads = self._workers.threads if observation.frontiers else 0
        self._choice_scratch = [choice_scratch(*padded) for _ in range(threads)]

    def clear(self, world: int) -> None:
        """Forget everything of a world."""
        self.own_visits[world] = 0
        self.peer_visits[world] = 0
        self.ages[world] = self.explorer_ages[world] = np.inf

    def sense(
        self,
        poses: NDArray[np.float64],
        air: Air,
        ticks: NDArray[np.int64],
        origins: NDArray[np.int64],
        alive: NDArray[np.bool_],
        active: NDArray[np.bool_],
    ) -> None:
        """Hear the peers and count the visits of the tick `ticks` (`[worlds]`), in the `active` worlds (`[worlds]`).

        `poses` `[worlds, drones, 3]`, `origins` of the grids in cells `[worlds, 2]`, `alive` bool `[worlds, drones]`.
        Call it once after the air has delivered what arrives in the tick, and once at a launch. Nobody is known under
        the protocol `off`, as on board.
        """
        if (
            self._spec.peers == self._spec.peer_places == self._spec.frontiers == 0
            and not self._sees_team
            and self._spec.visits == "off"
        ):
            return
        worlds = len(poses)
        if air.rules.shares:
            self._workers.over(
                worlds, hear_peers, self.positions, self.ages, self.explorer_ages, air.state.peers, ticks,
                air.rules.ticks_per_s, active,
            )  # fmt: skip
        if self._spec.visits != "off":
            self._workers.over(
                worlds, count_visits, self.own_visits, self.peer_visits, self._sees_team, self.positions,
                self.explorer_ages, poses, origins, alive, active,
            )  # fmt: skip

    def fill(
        self,
        views: NDArray[np.float32],
        motion: NDArray[np.float32],
        poses: NDArray[np.float64],
        origins: NDArray[np.int64],
    ) -> None:
        """Fill what the options add to the observations `views` and `motion`, both `[worlds, drones, ...]`."""
        worlds = len(poses)
        if motion.shape[2] > MOTION:
            self._workers.over(worlds, fill_option_numbers, motion, self.positions, self.ages, poses, self._options)
        if self._spec.visits != "off":
            self._workers.over(
                worlds, fill_visit_views, views, self.own_visits, self.peer_visits, self._sees_team, origins, poses,
                self._spec.axes == "heading", self._scales, self._levels,
            )  # fmt: skip

    def fill_frontiers(
        self,
        frontiers: NDArray[np.float32],
        kinds: NDArray[np.uint8],
        states: NDArray[np.uint8],
        belief: NDArray[np.int8],
        poses: NDArray[np.float64],
        origins: NDArray[np.int64],
        shown: NDArray[np.bool_],
    ) -> None:
        """Fill what drones can choose from, `[worlds, drones, n, numbers]`, in the `shown` worlds (`[worlds]`).

        `kinds` and `states` are the padded planning grids of their maps, uint8 `[worlds, drones, rows, columns]`,
        and `belief` the maps themselves, int8.
        """
        spec = self._spec
        self._workers.over(
            len(poses), fill_frontier_choices, frontiers, kinds, states, belief, origins, poses, self.positions,
            self.ages, spec.peer_memory_s, spec.axes == "heading", shown, scratch=self._choice_scratch,
        )  # fmt: skip

    def decide(self, actions: NDArray[np.float32], poses: NDArray[np.float64]) -> None:
        """Let the decisions `actions` `[worlds, drones, size]`, taken at `poses`, stand until the next call."""
        take_decisions(0, len(poses), self.intents, actions, self.parameters, poses)
