"""The actions of the episodes in progress, kept so that they can be flown again."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

_FIRST_CAPACITY = 256  # decisions of an episode that there is room for before it grows


class ActionLog:
    """Actions float32 `[worlds, drones, size]` by world and decision since its episode began."""

    def __init__(self, worlds: int, drones: int, size: int) -> None:
        """Start with no decision taken."""
        self._counts = np.zeros(worlds, np.int64)
        self._actions = np.zeros((worlds, _FIRST_CAPACITY, drones, size), np.float32)

    def clear(self, world: int) -> None:
        """Forget a world's decisions."""
        self._counts[world] = 0

    def add(self, running: NDArray[np.bool_], actions: NDArray[np.float32]) -> None:
        """Keep a decision of the worlds that are `running` (bool `[worlds]`)."""
        worlds = np.flatnonzero(running)
        places = self._counts[worlds]
        self._make_room(int(places.max(initial=-1)) + 1)
        self._actions[worlds, places] = actions[worlds]
        self._counts[worlds] += 1

    def _make_room(self, decisions: int) -> None:
        while decisions > self._actions.shape[1]:
            self._actions = np.concatenate((self._actions, np.zeros_like(self._actions)), axis=1)

    def decisions(self) -> Iterator[NDArray[np.float32]]:
        """Yield the first decision of every world, the second, and so on, `[worlds, drones, size]`.

        What they hold for a world that had no such decision means nothing.
        """
        for decision in range(int(self._counts.max(initial=0))):
            yield np.ascontiguousarray(self._actions[:, decision])

    def state_dict(self) -> dict[str, Any]:
        """Return how many `decisions` `[worlds]` there were and their `actions`, one world's after the other's."""
        parts = [self._actions[world, :count] for world, count in enumerate(self._counts.tolist())]
        return {"decisions": self._counts.copy(), "actions": np.concatenate(parts)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take up what `state_dict` gave."""
        self._counts[...] = state["decisions"]
        self._make_room(int(self._counts.max(initial=0)))
        parts = np.split(state["actions"], np.cumsum(self._counts)[:-1])
        for world, part in enumerate(parts):
            self._actions[world, : len(part)] = part
