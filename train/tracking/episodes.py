"""The newest episodes of a run: what they came to, by level and by drone."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imagine.sim.metrics import BYTE_KINDS, CONTACT_KINDS, EpisodeMetrics
from imagine.sim.twin import TICK_S
from imagine.train.tracking.level_groups import LevelGroups

RECENT_EPISODES = 50
"""Episodes of a level that count: enough to be steady, few enough to follow the policy."""
EARLY_TICKS = 300
"""When `coverage_300` is taken: most of the way through the larger levels, where sharing maps shows first."""
TEAM_METRICS = (
    "coverage", f"coverage_{EARLY_TICKS}", "coverage_area", "t90", "t95", "t99", "t90_reached", "ticks", "overlap",
    "contacts", *(f"contacts_{kind}" for kind in CONTACT_KINDS), "bytes", *(f"bytes_{kind}" for kind in BYTE_KINDS),
    "path_m", "productivity_ratio", "link_share", "survivors", "peer_cells_share",
)  # fmt: skip
"""What `team_metrics` returns; docs/tracking.md says what each is."""
DRONE_METRICS = (
    "discovered", "discovered_share", "own_cells", "path_m", "speed_mps", "contacts",
    *(f"contacts_{kind}" for kind in CONTACT_KINDS), "bytes", "link_share", "alive_share",
)  # fmt: skip
"""What `drone_metrics` returns for each drone; docs/tracking.md says what each is."""
_RATIO = TEAM_METRICS.index("productivity_ratio")
_REACHED = {"t90": 0.90, "t90_reached": 0.90, "t95": 0.95, "t99": 0.99}
"""The coverage up to which an episode must be flown for a metric to be measured."""
Means = dict[str, dict[str, float]]


def team_metrics(episode: EpisodeMetrics, episode_ticks: int) -> NDArray[np.float64]:
    """Return an episode's TEAM_METRICS `[metrics]`; a coverage that was never reached counts as `episode_ticks`.

    Bytes and path are means over drones, contacts sums over the team.
    """
    curve, ticks = episode.curve.astype(np.float64), episode.ticks
    rest = max(0, episode_ticks - ticks)  # an explored level stays explored
    cells = episode.cells_by.sum(axis=0)
    sent = episode.bytes_by.mean(axis=0)
    return np.array(
        [
            episode.coverage,
            curve[min(EARLY_TICKS, ticks) - 1],
            (curve.sum() + rest * curve[-1]) / (ticks + rest),
            *(episode_ticks if reached is None else reached for reached in (episode.t90, episode.t95, episode.t99)),
            episode.t90 is not None,
            ticks,
            episode.overlap,
            episode.contacts,
            *episode.contacts_by.sum(axis=0),
            sent.sum(),
            *sent,
            episode.path_m.mean(),
            episode.productivity_ratio,
            episode.link_share,
            (episode.alive_ticks == ticks).mean(),
            cells[1:].sum() / max(1, cells.sum()),
        ],
        np.float64,
    )


def drone_metrics(episode: EpisodeMetrics) -> NDArray[np.float64]:
    """Return an episode's DRONE_METRICS, `[drones, metrics]`."""
    return np.column_stack(
        (
            episode.discovered,
            episode.discovered / max(1, episode.discovered.sum()),
            episode.known,
            episode.path_m,
            episode.path_m / (TICK_S * np.maximum(1, episode.alive_ticks)),
            episode.contacts_by.sum(axis=1),
            episode.contacts_by,
            episode.bytes_by.sum(axis=1),
            episode.link_ticks / episode.ticks,
            episode.alive_ticks / episode.ticks,
        )
    ).astype(np.float64)


class RecentEpisodes:
    """The newest RECENT_EPISODES finished episodes of each group of levels, in rings that are never moved.

    `levels` are those of the settings, see `LevelGroups`. Where episodes end at a `stop_coverage` below that of a
    metric, nobody knows when it would have been reached, and the metric is left out of all means. State saved and
    loaded again gives the same means to the last bit, so that a resumed run tells what an uninterrupted one would.
    """

    def __init__(self, episode_ticks: int, levels: Iterable[str] = (), stop_coverage: float = 1.0) -> None:
        self.episode_ticks = episode_ticks
        self._measured = [name for name in TEAM_METRICS if _REACHED.get(name, 0.0) <= stop_coverage]
        self.group_of = LevelGroups(levels)
        self._teams: dict[str, NDArray[np.float64]] = {}
        self._drones: dict[str, NDArray[np.float64]] = {}
        self._counts: dict[str, int] = {}

    def add(self, episodes: Iterable[EpisodeMetrics]) -> None:
        """Take finished episodes, all of equally many drones."""
        for episode in episodes:
            group = self.group_of(episode.level)
            drones = drone_metrics(episode)
            if group not in self._counts:
                self._teams[group] = np.zeros((RECENT_EPISODES, len(TEAM_METRICS)))
                self._drones[group] = np.zeros((RECENT_EPISODES, *drones.shape))
                self._counts[group] = 0
            place = self._counts[group] % RECENT_EPISODES
            self._teams[group][place] = team_metrics(episode, self.episode_ticks)
            self._drones[group][place] = drones
            self._counts[group] += 1

    def means(self) -> Means:
        """Return the mean of every team metric measured, by group; of the productivity ratio the geometric one."""
        means = {}
        for group in sorted(self._counts):
            kept = self._teams[group][: self._counts[group]]
            values = kept.mean(axis=0)
            values[_RATIO] = np.exp(np.log(kept[:, _RATIO]).mean())
            told = dict(zip(TEAM_METRICS, values.tolist(), strict=True))
            means[group] = {name: told[name] for name in self._measured}
        return means

    def summary(self) -> Means:
        """Return of `means` what says most: for records that travel with checkpoints and exported policies."""
        names = [name for name in ("coverage", "t90", "contacts") if name in self._measured]
        return {group: {name: means[name] for name in names} for group, means in self.means().items()}

    def drone_means(self) -> Means:
        """Return the mean of every drone metric by drone, `"0"` the first; each group of levels counts alike."""
        if not self._counts:
            return {}
        groups = [self._drones[group][:count].mean(axis=0) for group, count in sorted(self._counts.items())]
        values = np.mean(groups, axis=0)
        return {str(k): dict(zip(DRONE_METRICS, row.tolist(), strict=True)) for k, row in enumerate(values)}

    def state_dict(self) -> dict[str, Any]:
        """Return all that is kept, as arrays and numbers in plain containers, to be saved in a checkpoint."""
        return {
            group: {"count": count, "team": self._teams[group].copy(), "drones": self._drones[group].copy()}
            for group, count in self._counts.items()
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on with what `state_dict` returned; groups kept with other metrics than today's are left out."""
        for group, kept in state.items():
            team, drones = np.asarray(kept["team"], np.float64), np.asarray(kept["drones"], np.float64)
            if team.shape == (RECENT_EPISODES, len(TEAM_METRICS)) and drones.shape[2:] == (len(DRONE_METRICS),):
                self._teams[group], self._drones[group] = team.copy(), drones.copy()
                self._counts[group] = int(kept["count"])
