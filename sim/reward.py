"""What exploring earns: newly seen area, less what it costs to touch things, for each drone and each step."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from imagine.core.config import Settings
from imagine.core.raster import CELL

_MOST = 1e6  # of a weight: rewards are float32, and larger ones would round away the area's small shares


class RewardSettings(Settings):
    """Weights of the reward's terms; by default new area alone counts."""

    area_weight: float = Field(
        default=5.0, ge=0.0, le=_MOST, description="of the newly seen area, as `normalise` measures it"
    )
    normalise: Literal["level", "sweep"] = Field(
        default="level",
        description="area as a share of the level's, or of what the sensor sweeps in a step at full speed",
    )
    own_credit: float = Field(default=0.5, ge=0.0, le=1.0, description="share for own discoveries, rest: the team's")
    collision_penalty: float = Field(
        default=0.0, ge=0.0, le=_MOST, description="for each contact begun, of whatever kind"
    )
    kill_on_collision: bool = Field(default=False, description="a drone that touches anything is out of the episode")
    step_cost: float = Field(default=0.0, ge=0.0, le=_MOST, description="for each step of a living drone")
    completion_bonus: float = Field(
        default=0.0, ge=0.0, le=_MOST, description="for each living drone when the level is covered"
    )


def sweep_cells(range_m: float, speed_mps: float, step_s: float) -> float:
    """Return the cells that a sensor of range r sweeps in a step at full speed: 2 r v dt, the front of its disc."""
    return 2.0 * range_m * speed_mps * step_s / (CELL * CELL)


def rewards(
    gained_cells: NDArray[np.int64],
    contacts_begun: NDArray[np.int64],
    alive: NDArray[np.bool_],
    coverable_cells: NDArray[np.int64],
    settings: RewardSettings,
    swept_cells: float,
    completed: NDArray[np.bool_] | None = None,
) -> NDArray[np.float32]:
    """Return the reward of a step, float32 `[worlds, drones]`.

    `gained_cells` and `contacts_begun` `[worlds, drones]` of this step; `alive` bool `[worlds, drones]` at its
    beginning: a drone that dies in it still gets its area and its penalty, the dead get nothing. `coverable_cells`
    `[worlds]` of the level, `swept_cells` as `sweep_cells`, `completed` bool `[worlds]` where the level was covered
    in this step. The team's part is the mean over all drones, the dead ones too, so a death raises nobody's share.
    """
    whole = coverable_cells[:, None] if settings.normalise == "level" else swept_cells
    share = gained_cells / whole
    own, team = settings.own_credit, 1.0 - settings.own_credit
    reward = settings.area_weight * (own * share + team * share.mean(axis=1, keepdims=True))
    reward = reward - settings.collision_penalty * contacts_begun - settings.step_cost
    if completed is not None:
        reward = reward + settings.completion_bonus * completed[:, None]
    return np.where(alive, reward, 0.0).astype(np.float32)


def survivors(
    alive: NDArray[np.bool_], contacts_begun: NDArray[np.int64], settings: RewardSettings
) -> NDArray[np.bool_]:
    """Return who is alive after a step, bool `[worlds, drones]`; an episode ends where nobody is."""
    if not settings.kill_on_collision:
        return alive.copy()
    remaining: NDArray[np.bool_] = alive & (contacts_begun == 0)
    return remaining
