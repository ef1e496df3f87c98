"""Everyone over the same episodes: flown level by level, so that comparisons come early, and told policy by policy."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from imagine.mesh_comm.settings import Protocol
from imagine.sim.exploration_settings import ExplorationSettings
from imagine.sim.film import Film
from imagine.sim.metrics import EpisodeMetrics
from imagine.train.evaluation.contenders import Contender, contender_of
from imagine.train.evaluation.env import evaluation_env
from imagine.train.evaluation.episodes import run_episodes
from imagine.train.evaluation.plan import ALL_LEVELS, Group, Plan
from imagine.train.evaluation.rows import paired, record
from imagine.train.evaluation.rows import row as row_of
from imagine.train.pilots import Pilot
from imagine.train.policies import Policy


@dataclass(frozen=True)
class Flight:
    """What one contender flew on one level in one group."""

    contender: int
    group: Group
    level: str
    episodes: list[EpisodeMetrics]


@dataclass(frozen=True)
class Progress:
    """Whom to tell how far it is: `begins` of each flight in words, `ended` how many episodes have just ended."""

    begins: Callable[[str], None] = lambda _: None
    ended: Callable[[int], None] = lambda _: None


class Comparison:
    """Flies all contenders over a plan, and holds what has been flown so far: nothing is lost if it is broken off."""

    def __init__(
        self,
        contenders: Sequence[Contender],
        envs: Sequence[ExplorationSettings],
        plan: Plan,
        reference: int | None = None,
    ) -> None:
        """Take who flies, each in its environment of `envs`; `reference` is whom the others are compared with.

        Raises InputError where the plan cannot be flown.
        """
        plan.check()
        self.contenders, self.plan, self.reference = list(contenders), plan, reference
        self._envs = list(envs)
        self._rows: dict[tuple[int, Group, str], dict[str, Any]] = {}
        self._flown: dict[tuple[int, Group, str], Flight] = {}

    @property
    def flights(self) -> int:
        """How many flights the plan has."""
        return len(self.contenders) * len(self.plan.levels) * len(list(self.plan.groups()))

    @property
    def episode_ticks(self) -> int:
        """How long an episode may last, the same for all."""
        return self._envs[0].episode_ticks

    @property
    def rows(self) -> list[dict[str, Any]]:
        """The rows so far: policies one after another, each over protocols, team sizes and levels, `all` last."""
        levels = (*self.plan.levels, ALL_LEVELS)
        keys = [
            (who, group, level)
            for who in range(len(self.contenders))
            for group in self.plan.groups()
            for level in levels
        ]
        return [self._rows[key] for key in keys if key in self._rows]

    @property
    def flown(self) -> list[Flight]:
        """The finished flights, in the order of their rows."""
        keys = [
            (who, group, level)
            for who in range(len(self.contenders))
            for group in self.plan.groups()
            for level in self.plan.levels
        ]
        return [self._flown[key] for key in keys if key in self._flown]

    def records(self, flight: Flight) -> list[dict[str, Any]]:
        """Return a record for every episode of a flight."""
        name, group = self.contenders[flight.contender].name, flight.group
        return [
            record(name, flight.level, group.drones, group.protocol, number, episode)
            for number, episode in enumerate(flight.episodes)
        ]

    def fly(self, progress: Progress | None = None, film: Film | None = None) -> Iterator[Flight]:
        """Fly everything, and yield each flight when it is over and its row told; `film` takes the first episode.

        On each level the reference flies first, so that the others' rows can say how they compare.
        """
        tell = progress or Progress()
        order = sorted(range(len(self.contenders)), key=lambda who: who != self.reference)
        for group in self.plan.groups():
            for level in self.plan.levels:
                for who in order:
                    tell.begins(self._words(who, group, level))
                    settings = self.plan.settings(self._envs[who], level, group)
                    filmed = film if not self._flown else None
                    episodes = run_episodes(
                        self.contenders[who].pilot, settings, self.plan.episodes, self.plan.seed, filmed, tell.ended
                    )
                    yield self._take(Flight(who, group, level, episodes))

    def _words(self, who: int, group: Group, level: str) -> str:
        name = f"{self.contenders[who].name}: " if len(self.contenders) > 1 else ""
        team = "1 drone" if group.drones == 1 else f"{group.drones} drones"
        return f"{name}level {level}, {team}" + (f", {group.protocol}" if len(self.plan.protocols) > 1 else "")

    def _take(self, flight: Flight) -> Flight:
        """Keep a flight and its row, and with a group's last level the row over all of them."""
        who, group = flight.contender, flight.group
        self._flown[who, group, flight.level] = flight
        self._tell(who, group, flight.level)
        if len(self.plan.levels) > 1 and all((who, group, level) in self._flown for level in self.plan.levels):
            self._tell(who, group, ALL_LEVELS)
        return flight

    def _tell(self, who: int, group: Group, level: str) -> None:
        ticks, seed = self.episode_ticks, self.plan.seed
        flown = self.by_level(who, group, level)
        told = row_of(self.contenders[who].name, level, group.drones, group.protocol, flown, ticks, seed)
        if self.reference is not None and who != self.reference:
            others = self.by_level(self.reference, group, level)
            told["paired"] = paired(flown, others, self.contenders[self.reference].name, ticks, seed)
        self._rows[who, group, level] = told

    def by_level(self, who: int, group: Group, level: str) -> list[list[EpisodeMetrics]]:
        """Return what one flew on a level, or on each of all levels: a list of episodes for every level."""
        levels = self.plan.levels if level == ALL_LEVELS else (level,)
        return [self._flown[who, group, name].episodes for name in levels]


def evaluate(
    policy: Pilot | Policy | str,
    levels: Sequence[str],
    drones: Sequence[int] = (3,),
    protocol: Protocol = "one-hop",
    episodes: int = 20,
    seed: int = 0,
    env: ExplorationSettings | None = None,
    progress: Callable[[str], None] | None = None,
    film: Film | None = None,
) -> list[dict[str, Any]]:
    """Fly one policy for `episodes` episodes on each level with each team size; return a row for each, none for `all`.

    Drones start at the level's launch point in the level as it is drawn. `env` gives what the rows do not (episode
    length, limits, radio); by default what the policy was made for. The deterministic policy flies. `progress` is told
    what comes next; `film` takes the first episode of the first row. Raises InputError where any level is wrong, or too
    small for the largest team, before anything is flown.
    """
    contender = contender_of(policy, seed)
    plan = Plan(tuple(levels), tuple(drones), (protocol,), episodes, seed)
    comparison = Comparison([contender], [env or evaluation_env(contender)], plan)
    for _ in comparison.fly(Progress(begins=progress) if progress is not None else None, film):
        pass
    return [row for row in comparison.rows if row["level"] != ALL_LEVELS]
