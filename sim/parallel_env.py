"""One world of exploration as a PettingZoo ParallelEnv, for those who bring their own multi-agent learning."""

from __future__ import annotations

import math
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from imagine.core.errors import InputError
from imagine.sim.action_values import action_values
from imagine.sim.exploration import CRITIC_CELLS, CRITIC_CHANNELS, Exploration, Observation
from imagine.sim.exploration_settings import ExplorationSettings
from imagine.sim.render import render_world
from imagine.sim.scene import Trails
from imagine.sim.twin import TICK_S

try:
    from gymnasium import logger, spaces
    from pettingzoo import ParallelEnv
except ImportError as error:
    raise InputError(
        "ExplorationEnv needs PettingZoo, which is not installed: pip install 'imagine-swarm[train]'"
    ) from error

# Values that bound each input of the policy with all its options, see core.observation; others count as unbounded.
_BOUNDS = {"views": (-1.0, 1.0), "lidar": (0.0, 1.0), "motion": (-2.0, 2.0)}

PolicyObservation = dict[str, NDArray[np.float32]]


class ExplorationEnv(ParallelEnv):  # type: ignore[misc]  # PettingZoo carries no types
    """A team of drones `drone_1`, `drone_2`, ... that explores one level after another, one episode a `reset`.

    Observations are named and shaped as `ObservationSpec.shapes`, actions lie in [-1, 1] and mean what `ActionSpec`
    says; both are float32. An episode terminates when the level is covered or nothing is left to reach, and is
    truncated at `episode_ticks`; the team ends together. Who falls on the way terminates alone, and is no agent of the
    rest of the episode. Infos hold `coverage` (share of the level the team has seen), `discovered` (cells this drone
    saw first), `contacts` (what it has touched), `alive` and `ticks`.
    """

    metadata = {  # noqa: RUF012
        "name": "imagine_exploration_v0",
        "render_modes": ["rgb_array"],
        "render_fps": round(1.0 / TICK_S),
        "is_parallelizable": True,
    }

    def __init__(
        self,
        settings: ExplorationSettings | None = None,
        seed: int = 0,
        render_mode: Literal["rgb_array"] | None = None,
        render_px: int = 960,
    ) -> None:
        """Make the world; of `settings`, `worlds` is taken as 1. `seed` serves until `reset` is given another.

        `render_px` bounds the longer side of the map that `render` draws. Raises InputError for another render mode.
        """
        if render_mode not in (None, "rgb_array"):
            raise InputError(f"render_mode {render_mode!r}: give 'rgb_array', or None to draw nothing")
        self.render_mode, self._render_px = render_mode, render_px
        self._trails = Trails()
        self.settings = (settings or ExplorationSettings()).model_copy(update={"worlds": 1})
        self.possible_agents = [f"drone_{i + 1}" for i in range(self.settings.drones)]
        self.agents: list[str] = []
        self._exploration = Exploration(self.settings, seed, restart=False)
        self._critic = np.zeros((self.settings.drones, CRITIC_CHANNELS, CRITIC_CELLS, CRITIC_CELLS), np.float32)
        self.observation_spaces = {agent: self._observation_space() for agent in self.possible_agents}
        size = self.settings.action.size
        self.action_spaces = {agent: spaces.Box(-1.0, 1.0, (size,), np.float32) for agent in self.possible_agents}
        self.state_space = spaces.Box(0.0, 1.0, self._critic.shape, np.float32)

    def _observation_space(self) -> spaces.Dict:
        shapes = self.settings.observation.shapes
        unbounded = (-math.inf, math.inf)
        return spaces.Dict(
            {name: spaces.Box(*_BOUNDS.get(name, unbounded), shape, np.float32) for name, shape in shapes.items()}
        )

    def observation_space(self, agent: str) -> spaces.Dict:
        """Return what an agent sees."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Box:
        """Return what an agent may do."""
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, PolicyObservation], dict[str, dict[str, Any]]]:
        """Start the next episode; with a seed, the first one of that seed. `options` are not used.

        Raises InputError on a negative seed, and the running episode goes on.
        """
        if seed is not None:
            self._exploration = Exploration(self.settings, seed, restart=False)
        self.agents = list(self.possible_agents)
        observation = self._exploration.reset()
        self._trails = Trails()
        self._trails.add(self._exploration, 0)
        return self._observations(observation), self._infos()

    def step(
        self, actions: dict[str, NDArray[np.float32]]
    ) -> tuple[
        dict[str, PolicyObservation], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]
    ]:
        """Let every agent act. Raises InputError without a running episode or where an agent's action is missing.

        What is returned is of those who were agents before; who fell in this step is told so for the last time.
        """
        if not self.agents:
            raise InputError("the episode is over (or none was started): call reset")
        step = self._exploration.step(self._wanted(actions))
        self._trails.add(self._exploration, 0)
        over = bool(step.done[0])
        coverage = float(self._exploration.maps.coverage()[0])
        late = int(self._exploration.ticks[0]) >= self.settings.episode_ticks
        truncated = over and late and coverage < self.settings.stop_coverage
        alive = {agent: bool(self._exploration.alive[0, self._drone(agent)]) for agent in self.agents}
        rewards = {agent: float(step.reward[0, self._drone(agent)]) for agent in self.agents}
        terminations = {agent: not alive[agent] or (over and not truncated) for agent in self.agents}
        truncations = {agent: alive[agent] and truncated for agent in self.agents}
        observations, infos = self._observations(step.observation), self._infos()
        self.agents = [] if over else [agent for agent in self.agents if alive[agent]]
        return observations, rewards, terminations, truncations, infos

    def _drone(self, agent: str) -> int:
        return self.possible_agents.index(agent)

    def _wanted(self, actions: dict[str, NDArray[np.float32]]) -> NDArray[np.float32]:
        """Return the actions as a batch of one world; the fallen do nothing."""
        wanted = np.zeros((1, len(self.possible_agents), self.settings.action.size), np.float32)
        for agent in self.agents:
            if agent not in actions:
                raise InputError(f"no action for {agent}")
            action = action_values(actions[agent], f"the action of {agent}")
            if action.shape != wanted.shape[2:]:
                raise InputError(f"the action of {agent} is {action.shape}, expected {wanted.shape[2:]}")
            wanted[0, self._drone(agent)] = action
        return wanted

    def state(self) -> NDArray[np.float32]:
        """Return what a centralised critic sees, float32 `[drones, channels, side, side]`: one image a drone."""
        return self._critic.copy()

    def render(self) -> NDArray[np.uint8] | None:
        """Return a picture of the world as it is, uint8 `[height, width, 3]`; nothing without a render mode.

        See `sim/render.py` for what it shows. Raises InputError before the first `reset`.
        """
        if self.render_mode is None:
            logger.warn("render does nothing: make the environment with render_mode='rgb_array'")
            return None
        if not self._trails.ways:
            raise InputError("there is no episode to draw yet: call reset")
        return render_world(self._exploration, 0, self._render_px, self._trails.ways)

    def close(self) -> None:
        """Let go of nothing: the world holds no files or windows."""

    def _observations(self, observation: Observation) -> dict[str, PolicyObservation]:
        self._critic = np.clip(observation.critic[0], 0.0, 1.0)
        return {
            agent: {name: array[0, self._drone(agent)].copy() for name, array in observation.policy.items()}
            for agent in self.agents
        }

    def _infos(self) -> dict[str, dict[str, Any]]:
        exploration = self._exploration
        coverage, ticks = float(exploration.maps.coverage()[0]), int(exploration.ticks[0])
        return {
            agent: {
                "coverage": coverage,
                "ticks": ticks,
                "discovered": int(exploration.maps.discovered[0, self._drone(agent)]),
                "contacts": int(exploration.twin.contacts[0, self._drone(agent)]),
                "alive": bool(exploration.alive[0, self._drone(agent)]),
            }
            for agent in self.agents
        }
