"""Which levels a policy learns when: lessons one after another or side by side, passed by what episodes cover.

Pure: finished episodes go in, events and shares of levels come out; the trainer hands them to the environment.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np

from imagine.core.errors import InputError
from imagine.sim.exploration_settings import ExplorationSettings
from imagine.sim.level_names import expand_levels, reported_name
from imagine.sim.metrics import EpisodeMetrics
from imagine.train.curriculum_settings import CurriculumSettings
from imagine.train.episode_order import EpisodeOrder, Outcome

State = Literal["ahead", "open", "passed", "given up"]


@dataclass(frozen=True)
class LessonEvent:
    """A lesson, counted from 0, that has begun, or is over, after so many decisions of all drones."""

    kind: Literal["begun", "passed", "given up"]
    lesson: int
    name: str
    agent_steps: int

    def __str__(self) -> str:
        """Return a line for the log."""
        return f"lesson {self.name}: {self.kind} after {self.agent_steps} agent steps"


class Curriculum:
    """Where a run stands in its lessons.

    `levels` are all lessons' levels, each once, and `level_weights` their shares of the episodes that begin now. An
    episode is passed with a coverage of `pass_area`. A lesson is passed when `pass_x_times` episodes on its levels were
    passed in a row, counted in the order in which they began (`train/episode_order.py`), while the lesson was open; one
    that is not passed sets the count to 0. A lesson that is over stays over. Without a curriculum (mode off) levels and
    shares are those of `env` and nothing happens.
    """

    def __init__(self, settings: CurriculumSettings, env: ExplorationSettings) -> None:
        """Start with the first lesson (sequential) or with all (parallel).

        Raises InputError where no episode could pass since it ends before, and where two levels would report episodes
        under the same name.
        """
        self.settings = settings
        self._env = env
        self._lessons = () if settings.mode == "off" else settings.lessons
        self._shares = [lesson.shares() for lesson in self._lessons]
        union: dict[str, None] = dict.fromkeys(level for shares in self._shares for level in shares)
        base = expand_levels(env.levels, env.level_weights)
        self.levels: tuple[str, ...] = tuple(union) if self._lessons else base[0]
        self._plain_weights = base[1]
        self._reported = _reported_by_lesson(self._shares)
        for number in range(len(self._lessons)):
            self._check_area(number)
        count = len(self._lessons)
        self._states: list[State] = ["ahead"] * count
        self._begun_at, self._streaks, self._passes, self._episodes = ([0] * count for _ in range(4))
        self._order = EpisodeOrder(env.worlds, env.episode_ticks)
        self._agent_steps = 0
        self.history: list[dict[str, Any]] = []
        """What has happened so far, as plain records of LessonEvents."""
        if self._lessons:
            self._open_next(0)

    @property
    def environment(self) -> ExplorationSettings:
        """The environment with the curriculum's levels and present shares; as given where there is no curriculum."""
        if not self._lessons:
            return self._env
        return self._env.model_copy(update={"levels": self.levels, "level_weights": self.level_weights()})

    def observe(self, episodes: Iterable[EpisodeMetrics], agent_steps: int) -> list[LessonEvent]:
        """Take the episodes that ended since the last call; `agent_steps` are the run's decisions until now.

        Return what has happened; if anything has, `level_weights` may be other ones. Raises InputError where
        `agent_steps` went back.
        """
        if agent_steps < self._agent_steps:
            raise InputError(f"curriculum: {agent_steps} agent steps after {self._agent_steps}: they only grow")
        self._agent_steps = agent_steps
        if not self._lessons:
            return []
        for episode in episodes:
            self._order.add(episode)
        events: list[LessonEvent] = []
        for outcome in self._order.ready():
            events += self._count(outcome, agent_steps)
        for number, state in enumerate(list(self._states)):
            most = self._rule(number, "max_agent_steps")
            if state == "open" and most is not None and agent_steps - self._begun_at[number] >= most:
                events += self._close(number, "given up", agent_steps)
        self.history += [asdict(event) for event in events]
        return events

    def level_weights(self) -> tuple[float, ...]:
        """Return each of `levels`' share of the episodes that begin now; they add up to 1."""
        if not self._lessons:
            return self._plain_weights
        weights = dict.fromkeys(self.levels, 0.0)
        for share, levels in zip(self.lesson_weights(), self._shares, strict=True):
            for level, part in levels.items():
                weights[level] += share * part
        total = math.fsum(weights.values())
        return tuple(weight / total for weight in weights.values())

    def lesson_weights(self) -> tuple[float, ...]:
        """Return each lesson's share of the episodes; they add up to 1.

        Sequential: `keep_earlier` for the lessons that are over together, by their weights, the rest for the open one.
        Parallel: `keep_earlier` of its own weight for each that is over, what that frees for the open ones, by their
        weights. When all are over, each has its own weight.
        """
        own = np.array([lesson.weight for lesson in self._lessons])
        own /= own.sum()
        opened = np.array([state == "open" for state in self._states])
        over = np.array([state in ("passed", "given up") for state in self._states])
        if over.all():
            return tuple(own.tolist())
        kept = self.settings.keep_earlier * (own[over].sum() if self.settings.mode == "parallel" else float(over.any()))
        share = np.zeros(len(own))
        if over.any():
            share[over] = kept * own[over] / own[over].sum()
        share[opened] = (1.0 - kept) * own[opened] / own[opened].sum()
        return tuple(share.tolist())

    def scalars(self) -> dict[str, float]:
        """Return names and values for tracking: the first open lesson, and the count and share of each."""
        if not self._lessons:
            return {}
        over = [state in ("passed", "given up") for state in self._states]
        scalars = {
            "curriculum/lesson": float(over.index(False) + 1 if False in over else len(over)),
            "curriculum/lessons_passed": float(self._states.count("passed")),
            "curriculum/lessons_given_up": float(self._states.count("given up")),
        }
        for number, share in enumerate(self.lesson_weights()):
            name = self.settings.name_of(number)
            scalars[f"curriculum/share_{name}"] = share
            scalars[f"curriculum/passed_in_a_row_{name}"] = float(self._streaks[number])
            if self._episodes[number]:
                scalars[f"curriculum/pass_rate_{name}"] = self._passes[number] / self._episodes[number]
        return scalars

    def state_dict(self) -> dict[str, Any]:
        """Return all that decides what follows, in plain containers; a curriculum that loads it goes on exactly so."""
        return {
            "lessons": [sorted(shares) for shares in self._shares],
            "states": list(self._states),
            "begun_at": list(self._begun_at),
            "streaks": list(self._streaks),
            "passes": list(self._passes),
            "episodes": list(self._episodes),
            "agent_steps": self._agent_steps,
            "order": self._order.state_dict(),
            "history": [dict(event) for event in self.history],
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from a state. Raises InputError where it is of other lessons."""
        if state["lessons"] != [sorted(shares) for shares in self._shares]:
            raise InputError(
                "curriculum.lessons: the run was begun with other levels in its lessons: leave them, or begin a new run"
            )
        self._states = list(state["states"])
        self._begun_at, self._streaks = list(state["begun_at"]), list(state["streaks"])
        self._passes, self._episodes = list(state["passes"]), list(state["episodes"])
        self._agent_steps = state["agent_steps"]
        self._order.load_state_dict(state["order"])
        self.history = [dict(event) for event in state["history"]]

    def _count(self, outcome: Outcome, agent_steps: int) -> list[LessonEvent]:
        """Count an episode for the open lessons that its level belongs to."""
        events: list[LessonEvent] = []
        for number in self._reported.get(outcome.level, ()):
            if self._states[number] != "open":
                continue
            passed = np.float32(outcome.coverage) >= np.float32(self._rule(number, "pass_area"))  # coverage is float32
            self._episodes[number] += 1
            self._passes[number] += int(passed)
            self._streaks[number] = self._streaks[number] + 1 if passed else 0
            if self._streaks[number] >= self._rule(number, "pass_x_times"):
                events += self._close(number, "passed", agent_steps)
                if self.settings.mode == "sequential":
                    break  # an episode counts for one lesson after another, not for two
        return events

    def _close(self, number: int, kind: Literal["passed", "given up"], agent_steps: int) -> list[LessonEvent]:
        self._states[number] = kind
        over = LessonEvent(kind, number, self.settings.name_of(number), agent_steps)
        return [over, *self._open_next(agent_steps)]

    def _open_next(self, agent_steps: int) -> list[LessonEvent]:
        """Open the first lesson that lies ahead, or all of them, unless one is open still and they go one by one."""
        events: list[LessonEvent] = []
        for number, state in enumerate(self._states):
            if self.settings.mode == "sequential" and "open" in self._states:
                break
            if state == "ahead":
                self._states[number] = "open"
                self._begun_at[number] = agent_steps
                events.append(LessonEvent("begun", number, self.settings.name_of(number), agent_steps))
        return events

    def _rule(self, number: int, key: Literal["pass_area", "pass_x_times", "max_agent_steps"]) -> Any:
        """Return what holds for a lesson: its own, or else the curriculum's."""
        own = getattr(self._lessons[number], key)
        return getattr(self.settings, key) if own is None else own

    def _check_area(self, number: int) -> None:
        area = self._rule(number, "pass_area")
        if area > self._env.stop_coverage:
            raise InputError(
                f"curriculum: lesson {self.settings.name_of(number)}: pass_area is {area:g}, but an episode ends at "
                f"env.stop_coverage, {self._env.stop_coverage:g}: lower the one or raise the other"
            )


def _reported_by_lesson(lessons: list[dict[str, float]]) -> dict[str, list[int]]:
    """Return the lessons that a level belongs to, by the name under which its episodes are reported."""
    names: dict[str, str] = {}
    numbers: dict[str, list[int]] = {}
    for number, levels in enumerate(lessons):
        for level in levels:
            reported = reported_name(level)
            if names.setdefault(reported, level) != level:
                raise InputError(
                    f"curriculum: the levels {names[reported]} and {level} are both reported as '{reported}': "
                    "rename one of the files"
                )
            numbers.setdefault(reported, []).append(number)
    return numbers
