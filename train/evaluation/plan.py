"""What is flown in an evaluation: every combination of levels, team sizes and protocols, and how often."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from imagine.core.errors import InputError
from imagine.mesh_comm.settings import Protocol
from imagine.sim.exploration_settings import ExplorationSettings
from imagine.sim.level import load_level

Launch = Literal["point", "random"]
ALL_LEVELS = "all"
"""The level of a row over all levels."""


@dataclass(frozen=True)
class Group:
    """What rows over all levels are made of: one team size under one protocol."""

    protocol: Protocol
    drones: int


@dataclass(frozen=True)
class Plan:
    """Levels by name, team sizes, protocols; `episodes` on each combination.

    `launch` is `point`, the level's own launch point in the level as it is drawn, or `random`: anywhere, with random
    headings, in the level turned and mirrored by chance. Episode e is drawn from `seed` and e alone.
    """

    levels: tuple[str, ...]
    drones: tuple[int, ...] = (3,)
    protocols: tuple[Protocol, ...] = ("one-hop",)
    episodes: int = 20
    seed: int = 0
    launch: Launch = "point"

    def groups(self) -> Iterator[Group]:
        """Yield the groups in the order in which they fly."""
        for protocol in self.protocols:
            for drones in self.drones:
                yield Group(protocol, drones)

    def check(self) -> None:
        """Raise InputError where there is nothing to fly, or a level is wrong or too small for the largest team."""
        if self.episodes < 1:
            raise InputError(f"--episodes {self.episodes}: give 1 or more")
        if not (self.levels and self.drones and self.protocols):
            raise InputError("there is nothing to evaluate: give a level, a team size and a protocol")
        for level in self.levels:
            load_level(level).launch_poses(max(self.drones), None)

    def settings(self, env: ExplorationSettings, level: str, group: Group) -> ExplorationSettings:
        """Return `env` with what this plan decides itself."""
        anywhere = self.launch == "random"
        return env.model_copy(
            update={
                "levels": (level,), "level_weights": None, "drones": group.drones, "protocol": group.protocol,
                "mirror": anywhere, "random_launch": anywhere, "as_designed": 0.0, "stagger": False,
            }
        )  # fmt: skip
