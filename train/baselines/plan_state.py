"""What frontier baselines keep of every drone of a batch between decisions, and what their kernels work with."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from imagine.core.frontier_paths import search_scratch
from imagine.core.frontier_targets import MOST_TARGETS, gain_canvas

PATH_CELLS = 512
"""Cells of a way that are kept: the next hundred metres."""
BANNED = 8
"""Frontiers that are left alone at once."""
DUE = 1 << 20
"""Age of a choice that has to be made anew."""


class PlanState(NamedTuple):
    """Arrays `[worlds, drones, ...]`; cells are flat indices of the padded planning grid, -1 for none.

    The choice that stands: `goal`, its `path` and `length`, the point `at` of it last passed, its `age` in decisions;
    `due` says that it is to be made anew, and `dealt` which of the `targets` was drawn. What it is made from: `kinds`
    with gaps opened (see `gaps`), `cost` the own ways, `found` targets, their `utility`, and `ways`
    `[..., robots, targets]`, metres, from the drone itself and `robots` - 1 peers. The watchdog: `banned` frontiers
    `until` which decision by `clock`, where the drone was (`anchor`, metres) when it last got on, `still` decisions
    ago, and `told`, the intent that it was advised.
    """

    goal: NDArray[np.int32]
    path: NDArray[np.int32]
    length: NDArray[np.int32]
    at: NDArray[np.int32]
    age: NDArray[np.int32]
    due: NDArray[np.bool_]
    dealt: NDArray[np.int32]
    kinds: NDArray[np.uint8]
    cost: NDArray[np.int16]
    targets: NDArray[np.int32]
    found: NDArray[np.int32]
    ways: NDArray[np.float64]
    robots: NDArray[np.int32]
    utility: NDArray[np.float64]
    banned: NDArray[np.int32]
    until: NDArray[np.int64]
    clock: NDArray[np.int64]
    anchor: NDArray[np.float64]
    still: NDArray[np.int32]
    told: NDArray[np.float64]


def plan_state(worlds: int, drones: int, rows: int, columns: int) -> PlanState:
    """Return the state of drones that have chosen nothing yet, on padded planning grids of `rows` by `columns`."""
    size = (worlds, drones)
    state = PlanState(
        goal=np.empty(size, np.int32), path=np.empty((*size, PATH_CELLS), np.int32), length=np.empty(size, np.int32),
        at=np.empty(size, np.int32), age=np.empty(size, np.int32), due=np.empty(size, np.bool_),
        dealt=np.empty(size, np.int32), kinds=np.empty((*size, rows, columns), np.uint8),
        cost=np.empty((*size, rows, columns), np.int16), targets=np.empty((*size, MOST_TARGETS), np.int32),
        found=np.empty(size, np.int32), ways=np.empty((*size, drones, MOST_TARGETS)), robots=np.empty(size, np.int32),
        utility=np.empty((*size, MOST_TARGETS)), banned=np.empty((*size, BANNED), np.int32),
        until=np.empty((*size, BANNED), np.int64), clock=np.empty(size, np.int64), anchor=np.empty((*size, 2)),
        still=np.empty(size, np.int32), told=np.empty((*size, 2)),
    )  # fmt: skip
    forget(state, np.ones(worlds, np.bool_))
    return state


def forget(state: PlanState, worlds: NDArray[np.bool_]) -> None:
    """Let the drones of these worlds (bool `[worlds]`) have chosen nothing."""
    for array in state:
        array[worlds] = 0
    state.age[worlds] = DUE
    state.goal[worlds] = state.dealt[worlds] = -1
    state.banned[worlds] = -1
    state.anchor[worlds] = np.nan


class PlanScratch(NamedTuple):
    """What one thread works with: ways of a peer, what is left to see, marks and a queue of cells, the search's own."""

    cost: NDArray[np.int16]
    left: NDArray[np.float32]
    marks: NDArray[np.uint8]
    queue: NDArray[np.int32]
    search: tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int32]]


def plan_scratch(rows: int, columns: int) -> PlanScratch:
    """Return scratch for padded planning grids of this size."""
    cells = rows * columns
    return PlanScratch(
        np.empty((rows, columns), np.int16), gain_canvas(rows, columns), np.zeros(cells, np.uint8),
        np.empty(cells, np.int32), search_scratch(cells),
    )  # fmt: skip
