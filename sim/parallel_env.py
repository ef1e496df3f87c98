"""One world of exploration as a PettingZoo ParallelEnv, for those who bring their own multi-agent learning."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from imagine.core.errors import InputError
from imagine.sim.exploration import CRITIC_CELLS, CRITIC_CHANNELS, Exploration, Observation
from imagine.sim.exploration_settings import ExplorationSettings

try:
    from gymnasium import spaces
    from pettingzoo import ParallelEnv
except ImportError as error:
    raise InputError(
        "ExplorationEnv needs PettingZoo, which is not installed: pip install 'imagine-swarm[train]'"
    ) from error

# Values that bound each input of the policy, see core.observation.
_BOUNDS = {"views": (-1.0, 1.0), "lidar": (0.0, 1.0), "motion": (-2.0, 2.0)}

PolicyObservation = dict[str, NDArray[np.float32]]


class ExplorationEnv(ParallelEnv):  # type: ignore[misc]  # PettingZoo carries no types
    """A team of drones `drone_1`, `drone_2`, ... that explores one level after another, one episode a `reset`.

    Observations are named and shaped as `ObservationSpec.shapes`, actions lie in [-1, 1] and mean what `ActionSpec`
    says; both are float32. An episode terminates when the level is covered or nothing is left to reach, and is
    truncated at `episode_ticks`; the team ends together. Infos hold `coverage` (share of the level the team has seen),
    `discovered` (cells this drone saw first), `contacts` (walls and drones it has touched) and `ticks`.
    """

    metadata = {"name": "imagine_exploration_v0", "render_modes": [], "is_parallelizable": True}  # noqa: RUF012
    render_mode = None

    def __init__(self, settings: ExplorationSettings | None = None, seed: int = 0) -> None:
        """Make the world; of `settings`, `worlds` is taken as 1. `seed` serves until `reset` is given another."""
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
        return spaces.Dict({name: spaces.Box(*_BOUNDS[name], shape, np.float32) for name, shape in shapes.items()})

    def observation_space(self, agent: str) -> spaces.Dict:
        """Return what an agent sees."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Box:
        """Return what an agent may do."""
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, PolicyObservation], dict[str, dict[str, Any]]]:
        """Start the next episode; with a seed, the first one of that seed. `options` are not used."""
        if seed is not None:
            self._exploration = Exploration(self.settings, seed, restart=False)
        self.agents = list(self.possible_agents)
        return self._observations(self._exploration.reset()), self._infos()

    def step(
        self, actions: dict[str, NDArray[np.float32]]
    ) -> tuple[
        dict[str, PolicyObservation], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]
    ]:
        """Fly one tick of 0.1 s. Raises InputError without a running episode or where an agent's action is missing."""
        if not self.agents:
            raise InputError("the episode is over (or none was started): call reset")
        wanted = np.zeros((1, len(self.agents), self.settings.action.size), np.float32)
        for drone, agent in enumerate(self.agents):
            if agent not in actions:
                raise InputError(f"no action for {agent}")
            if np.shape(actions[agent]) != wanted.shape[2:]:
                raise InputError(f"the action of {agent} is {np.shape(actions[agent])}, expected {wanted.shape[2:]}")
            wanted[0, drone] = actions[agent]
        step = self._exploration.step(wanted)
        over = bool(step.done[0])
        coverage = float(self._exploration.maps.coverage()[0])
        late = int(self._exploration.ticks[0]) >= self.settings.episode_ticks
        truncated = over and late and coverage < self.settings.stop_coverage
        rewards = {agent: float(step.reward[0, drone]) for drone, agent in enumerate(self.agents)}
        terminations = dict.fromkeys(self.agents, over and not truncated)
        truncations = dict.fromkeys(self.agents, truncated)
        observations, infos = self._observations(step.observation), self._infos()
        if over:
            self.agents = []
        return observations, rewards, terminations, truncations, infos

    def state(self) -> NDArray[np.float32]:
        """Return what a centralised critic sees, float32 `[drones, channels, side, side]`: one image a drone."""
        return self._critic.copy()

    def render(self) -> None:
        """Draw nothing: no render modes are offered."""

    def close(self) -> None:
        """Let go of nothing: the world holds no files or windows."""

    def _observations(self, observation: Observation) -> dict[str, PolicyObservation]:
        self._critic = np.clip(observation.critic[0], 0.0, 1.0)
        return {
            agent: {name: array[0, drone] for name, array in observation.policy.items()}
            for drone, agent in enumerate(self.agents)
        }

    def _infos(self) -> dict[str, dict[str, Any]]:
        exploration = self._exploration
        coverage, ticks = float(exploration.maps.coverage()[0]), int(exploration.ticks[0])
        return {
            agent: {
                "coverage": coverage,
                "ticks": ticks,
                "discovered": int(exploration.maps.discovered[0, drone]),
                "contacts": int(exploration.twin.contacts[0, drone]),
            }
            for drone, agent in enumerate(self.agents)
        }
