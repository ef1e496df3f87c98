import pytest
from hypothesis import given
from hypothesis import strategies as st

from imagine.core.config import check_settings
from imagine.core.errors import InputError
from imagine.train.ppo_settings import PpoSettings
from imagine.train.schedules import Schedule

numbers = st.floats(-1e3, 1e3)
schedules = st.builds(
    Schedule, start=numbers, end=numbers, shape=st.sampled_from(["linear", "cosine"]), until=st.floats(0.01, 1.0)
)


@given(schedules, st.floats(0.0, 1.0), st.floats(0.0, 1.0))
def test_a_schedule_goes_from_start_to_end_without_turning_back(schedule, one, other):
    low, high = sorted((schedule.start, schedule.end))
    assert schedule.at(0.0) == schedule.start
    assert schedule.at(schedule.until) == pytest.approx(schedule.end, abs=1e-9)
    assert schedule.at(1.0) == pytest.approx(schedule.end, abs=1e-9)
    early, late = schedule.at(min(one, other)), schedule.at(max(one, other))
    assert low - 1e-9 <= early <= high + 1e-9
    assert (late - early) * (schedule.end - schedule.start) >= -1e-9


def test_halfway_linear_and_cosine_meet_and_in_between_they_do_not():
    linear, cosine = (Schedule(start=1.0, end=0.0, shape=shape) for shape in ("linear", "cosine"))
    assert linear.at(0.5) == cosine.at(0.5) == pytest.approx(0.5)
    assert linear.at(0.25) == pytest.approx(0.75)
    assert cosine.at(0.25) == pytest.approx(0.8536, abs=1e-4)


def test_a_number_is_a_constant():
    settings = check_settings(PpoSettings, {"actor_lr": 2e-4}, "config")
    assert settings.actor_lr.at(0.0) == settings.actor_lr.at(0.7) == 2e-4
    assert check_settings(PpoSettings, settings.model_dump(), "config") == settings


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"actor_lr": {"start": 1e-4, "ende": 1e-5}}, r"unknown key 'actor_lr\.ende'; did you mean 'end'"),
        ({"actor_lr": {"start": 1e-4, "end": 0.0}}, "above 0"),
        ({"critic_lr": -1.0}, "above 0"),
        ({"entropy_weight": {"start": 0.01, "end": -0.1}}, "0 or above"),
        ({"actor_lr": {"end": 1e-5}}, r"'actor_lr\.start' is missing"),
        ({"action_std": {"start": 0.3, "until": 0.0}}, r"action_std\.until"),
        ({"actor_lr": "fast"}, "actor_lr"),
    ],
)
def test_a_wrong_schedule_is_refused_by_its_key(data, message):
    with pytest.raises(InputError, match=message):
        check_settings(PpoSettings, data, "config")
