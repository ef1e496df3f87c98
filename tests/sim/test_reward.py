"""Each term of the reward, by numbers worked out by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from imagine.sim.reward import RewardSettings, rewards, survivors, sweep_cells

GAINED = np.array([[40, 0], [10, 30]])
COVERABLE = np.array([400, 100])
NO_CONTACTS = np.zeros((2, 2), np.int64)
CONTACTS = np.array([[0, 1], [2, 0]])
ALIVE = np.ones((2, 2), bool)


def earned(
    contacts: NDArray[np.int64] = NO_CONTACTS,
    alive: NDArray[np.bool_] = ALIVE,
    swept: float = 64.0,
    completed: NDArray[np.bool_] | None = None,
    **settings: Any,
) -> NDArray[np.float32]:
    return rewards(GAINED, contacts, alive, COVERABLE, RewardSettings(**settings), swept, completed)


def test_by_default_new_area_pays_half_to_the_finder_and_half_to_the_team() -> None:
    # world 0: 40 of 400 cells, a tenth: 5 x (0.5 x 0.1 + 0.5 x 0.05); the other gets the team's part alone
    assert earned() == pytest.approx(np.array([[0.375, 0.125], [0.75, 1.25]]))
    assert earned().dtype == np.float32


def test_credit_goes_all_to_the_finder_or_all_to_the_team() -> None:
    assert earned(own_credit=1.0) == pytest.approx(np.array([[0.5, 0.0], [0.5, 1.5]]))
    assert earned(own_credit=0.0) == pytest.approx(np.array([[0.25, 0.25], [1.0, 1.0]]))


def test_a_sweep_is_what_the_sensor_passes_over_in_a_step_at_full_speed() -> None:
    # 2 x 4 m x 0.8 m/s x 0.1 s = 0.64 m², of cells of 0.01 m²
    assert sweep_cells(4.0, 0.8, 0.1) == pytest.approx(64.0)
    assert earned(normalise="sweep", area_weight=1.0, own_credit=1.0) == pytest.approx(
        np.array([[0.625, 0.0], [0.15625, 0.46875]])
    )
    assert earned(normalise="sweep", area_weight=2.0, own_credit=0.0) == pytest.approx(
        np.array([[0.625, 0.625], [0.625, 0.625]])
    )


def test_every_contact_begun_costs_whoever_touched() -> None:
    paid = earned() - earned(contacts=CONTACTS, collision_penalty=0.3)
    assert paid == pytest.approx(np.array([[0.0, 0.3], [0.6, 0.0]]))
    assert earned(contacts=CONTACTS) == pytest.approx(earned())  # free by default


def test_time_costs_and_a_covered_level_pays() -> None:
    assert earned() - earned(step_cost=0.01) == pytest.approx(np.full((2, 2), 0.01))
    bonus = earned(completion_bonus=2.0, completed=np.array([False, True])) - earned()
    assert bonus == pytest.approx(np.array([[0.0, 0.0], [2.0, 2.0]]))


def test_the_dead_get_nothing_and_raise_nobodys_share() -> None:
    alive = np.array([[True, False], [True, True]])
    all_terms: dict[str, Any] = {"collision_penalty": 0.3, "step_cost": 0.1, "completion_bonus": 1.0}
    paid = earned(contacts=CONTACTS, alive=alive, completed=np.array([True, True]), **all_terms)
    assert paid[0, 1] == 0.0
    assert paid[0, 0] == pytest.approx(0.375 - 0.1 + 1.0)


def test_who_touches_anything_dies_with_its_penalty_and_stays_dead() -> None:
    settings = RewardSettings(kill_on_collision=True, collision_penalty=1.0)
    after = survivors(ALIVE, CONTACTS, settings)
    assert after.tolist() == [[True, False], [False, True]]
    assert rewards(GAINED, CONTACTS, ALIVE, COVERABLE, settings, 64.0)[0, 1] == pytest.approx(0.125 - 1.0)
    assert rewards(GAINED, CONTACTS, after, COVERABLE, settings, 64.0)[0, 1] == 0.0
    assert survivors(after, NO_CONTACTS, settings).tolist() == after.tolist()
    assert survivors(ALIVE, CONTACTS, RewardSettings()).all()  # by default a contact kills nobody


@pytest.mark.parametrize("weight", ["area_weight", "collision_penalty", "step_cost", "completion_bonus"])
def test_weights_beyond_a_million_are_refused(weight: str) -> None:
    assert getattr(RewardSettings(**{weight: 1e6}), weight) == 1e6
    with pytest.raises(ValueError, match=weight):
        RewardSettings(**{weight: 1.1e6})
