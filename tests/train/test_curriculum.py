"""The curriculum as a state machine: what is counted, what is never skipped, and that it resumes as it was."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from imagine.core.config import check_settings, parse_yaml
from imagine.core.errors import InputError
from imagine.sim.exploration import Exploration
from imagine.sim.exploration_settings import ExplorationSettings
from imagine.sim.level_names import expand_level
from imagine.sim.metrics import EpisodeMetrics
from imagine.train.curriculum import Curriculum
from imagine.train.curriculum_settings import CurriculumSettings

LONGEST = 100
POOL = ("0", "1", "2", "house:3:60", "house:4:60")


def episode(world: int, level: str, coverage: float, ticks: int = LONGEST, seed: int = 7) -> EpisodeMetrics:
    """Return an episode of which level, length and coverage matter."""
    none, nobody = np.zeros(1, np.int64), np.zeros((1, 1), np.float32)
    return EpisodeMetrics(
        world=world, seed=seed, level=level, ticks=ticks, coverage=coverage, curve=np.full(ticks, coverage, np.float32),
        t90=None, t95=None, t99=None, overlap=1.0, path_m=none.astype(float), discovered=none, drone_curves=nobody,
        known=none, contacts=0, link_ticks=none, pair_ticks=none[None], alive_ticks=none, contacts_by=none[None],
        bytes_by=none[None], cells_by=none[None],
    )  # fmt: skip


def curriculum(worlds: int = 1, **settings: Any) -> Curriculum:
    env = ExplorationSettings(worlds=worlds, episode_ticks=LONGEST)
    return Curriculum(check_settings(CurriculumSettings, settings, "curriculum"), env)


def run_through(worlds: int, flown: list[tuple[int, float, int]]) -> Iterator[list[EpisodeMetrics]]:
    """Fly episodes (level of POOL, coverage, ticks), each in the world that is free first; yield those of each tick."""
    queue = iter(flown)
    ends = [(0, world, next(queue, None)) for world in range(worlds)]
    while any(job is not None for _, _, job in ends):
        due = min(began + job[2] for began, _, job in ends if job is not None)
        ended = []
        for world, (began, _, job) in enumerate(ends):
            if job is not None and began + job[2] == due:
                ended.append(episode(world, POOL[job[0]], job[1], job[2]))
                ends[world] = (due, world, next(queue, None))
        yield ended


lessons = st.lists(
    st.fixed_dictionaries(
        {"levels": st.lists(st.sampled_from(POOL), min_size=1, max_size=3), "weight": st.floats(0.1, 5.0)},
        optional={
            "pass_area": st.floats(0.3, 0.95), "pass_x_times": st.integers(1, 4),
            "max_agent_steps": st.integers(1, 2000),
        },
    ),
    min_size=1, max_size=4,
)  # fmt: skip
anything = st.fixed_dictionaries(
    {
        "mode": st.sampled_from(["sequential", "parallel"]), "lessons": lessons, "pass_x_times": st.integers(1, 5),
        "pass_area": st.floats(0.3, 0.95), "keep_earlier": st.floats(0.0, 0.9),
    },
    optional={"max_agent_steps": st.integers(1, 5000)},
)  # fmt: skip
flights = st.lists(st.tuples(st.integers(0, len(POOL) - 1), st.floats(0.0, 1.0), st.integers(1, LONGEST)), max_size=60)


@given(anything, flights, st.integers(1, 5))
def test_lessons_go_on_and_never_back_and_none_is_skipped(
    settings: dict[str, Any], flown: list[tuple[int, float, int]], worlds: int
) -> None:
    course = curriculum(worlds, **settings)
    over: list[int] = []
    for tick, ended in enumerate(run_through(worlds, flown)):
        events = course.observe(ended, 100 * tick)
        over += [event.lesson for event in events if event.kind != "begun"]
        weights, shares = course.level_weights(), course.lesson_weights()
        assert len(weights) == len(course.levels)
        assert min(weights) >= 0.0
        assert sum(weights) == pytest.approx(1.0, abs=1e-12)
        assert sum(shares) == pytest.approx(1.0, abs=1e-12)
        count = len(settings["lessons"])
        if len(over) == count:
            base = np.array([lesson["weight"] for lesson in settings["lessons"]])
            assert shares == pytest.approx(base / base.sum())
        elif settings["mode"] == "sequential":
            assert shares[len(over)] == pytest.approx(1.0 - (settings["keep_earlier"] if over else 0.0))
            assert all(share == 0.0 for share in shares[len(over) + 1 :])  # what lies ahead is not shown
        else:
            base = np.array([lesson["weight"] for lesson in settings["lessons"]])
            base /= base.sum()
            kept = [settings["keep_earlier"] * base[lesson] for lesson in over]
            assert [shares[lesson] for lesson in over] == pytest.approx(kept)
            assert all(shares[lesson] >= base[lesson] - 1e-12 for lesson in range(count) if lesson not in over)
    assert len(set(over)) == len(over)
    if settings["mode"] == "sequential":
        assert over == list(range(len(over)))
    assert [event["lesson"] for event in course.history if event["kind"] != "begun"] == over


@given(anything, flights, st.integers(1, 5), st.integers(0, 60))
def test_a_resumed_curriculum_goes_on_as_if_it_had_not_stopped(
    settings: dict[str, Any], flown: list[tuple[int, float, int]], worlds: int, stop: int
) -> None:
    whole, part = curriculum(worlds, **settings), curriculum(worlds, **settings)
    for tick, ended in enumerate(run_through(worlds, flown)):
        if tick == stop:
            saved = json.loads(json.dumps(part.state_dict()))
            part = curriculum(worlds, **settings)
            part.load_state_dict(saved)
            assert part.level_weights() == whole.level_weights()
        assert part.observe(ended, 100 * tick) == whole.observe(ended, 100 * tick)
        assert part.level_weights() == whole.level_weights()
        assert part.scalars() == whole.scalars()
    assert part.state_dict() == whole.state_dict()
    assert part.history == whole.history


@given(st.lists(st.floats(0.0, 1.0), max_size=60), st.integers(1, 5), st.floats(0.1, 0.99))
def test_a_lesson_is_passed_by_the_first_so_many_in_a_row(coverages: list[float], times: int, area: float) -> None:
    course = curriculum(mode="sequential", lessons=[{"levels": ["0"]}], pass_area=area, pass_x_times=times)
    passed = [np.float32(coverage) >= np.float32(area) for coverage in coverages]
    rows = (end for end in range(times, len(passed) + 1) if all(passed[end - times : end]))
    expected = next(rows, None)
    found = None
    for number, coverage in enumerate(coverages, 1):
        if course.observe([episode(0, "0", coverage)], number):
            found = number
            break
    assert found == expected


@given(flights, st.integers(1, 6), st.integers(1, 4))
def test_episodes_count_in_the_order_in_which_they_began(
    flown: list[tuple[int, float, int]], worlds: int, times: int
) -> None:
    rule = {"mode": "sequential", "pass_area": 0.5, "pass_x_times": times, "lessons": [{"levels": list(POOL)}]}
    course = curriculum(worlds, **rule)
    ended, passed = 0, False
    for episodes in run_through(worlds, flown):
        ended += len(episodes)
        passed = any(event.kind == "passed" for event in course.observe(episodes, 0))
        if passed:
            break
    # a world takes the next episode when it is free, so the order of `flown` is that of beginnings
    rows = [all(job[1] >= np.float32(0.5) for job in flown[k : k + times]) for k in range(len(flown) - times + 1)]
    if passed:
        assert ended >= rows.index(True) + times
    elif any(rows):
        assert len(flown) < worlds  # somebody still flies the first one


def test_quick_successes_do_not_overtake_slow_failures() -> None:
    rng = np.random.default_rng(0)
    rule = {"mode": "sequential", "lessons": [{"levels": ["0"]}], "pass_x_times": 16}
    course, overtaken = curriculum(64, **rule), 0
    fair = [(0, 0.95, 20) if success else (0, 0.5, LONGEST) for success in rng.random(1000) < 0.5]
    in_a_row = 0
    for ended in run_through(64, fair):
        for one in ended:
            in_a_row = in_a_row + 1 if one.coverage > 0.9 else 0
            overtaken = max(overtaken, in_a_row)
        assert not course.observe(ended, 0)
    assert overtaken > 16  # by the order in which they end it would have been passed
    good = itertools.chain.from_iterable(run_through(64, [(0, 0.95, 20)] * 200))
    assert [event.kind for event in course.observe(good, 0)] == ["passed"]


def test_a_world_that_is_gone_does_not_hold_up_the_others() -> None:
    course = curriculum(2, mode="sequential", lessons=[{"levels": ["0"]}], pass_x_times=2)
    assert not course.observe([episode(0, "0", 1.0), episode(0, "0", 1.0)], 0)  # world 1 may fly its first still
    assert course.observe([episode(0, "0", 1.0)], 0)


def test_a_lesson_is_given_up_after_its_decisions() -> None:
    course = curriculum(
        mode="sequential", lessons=[{"levels": ["0"]}, {"name": "hard", "levels": ["6"], "max_agent_steps": 50}],
        max_agent_steps=200,
    )  # fmt: skip
    assert course.observe([], 199) == []
    assert [str(event) for event in course.observe([], 230)] == [
        "lesson 1: given up after 230 agent steps",
        "lesson hard: begun after 230 agent steps",
    ]
    assert course.observe([], 279) == []
    assert [event.kind for event in course.observe([], 280)] == ["given up"]
    assert course.scalars()["curriculum/lessons_given_up"] == 2.0
    assert course.level_weights() == (0.5, 0.5)


def test_levels_share_what_their_lesson_has() -> None:
    houses = {"count": 4, "first_seed": 10, "area_m2": [50, 90], "weight": 3.0}
    course = curriculum(
        mode="parallel", pass_x_times=1, keep_earlier=0.5,
        lessons=[{"levels": ["4", "5"], "level_weights": [2, 1], "houses": houses}, {"levels": ["5"], "weight": 3}],
    )  # fmt: skip
    plans = expand_level("house:10-13:50-90")
    assert course.levels == ("4", "5", *plans)
    quarter = 0.25
    assert course.level_weights() == pytest.approx((quarter / 3, quarter / 6 + 0.75, *[quarter / 8] * 4))
    assert [event.lesson for event in course.observe([episode(0, plans[2], 0.95)], 0)] == [0]
    eighth = 0.125
    assert course.level_weights() == pytest.approx((eighth / 3, eighth / 6 + 0.875, *[eighth / 8] * 4))


def test_without_a_curriculum_the_environment_stays_as_it_is() -> None:
    env = ExplorationSettings(levels=("4", "house:0-1:50-60"), level_weights=(1.0, 3.0))
    course = Curriculum(CurriculumSettings(), env)
    assert course.environment is env
    assert course.levels == ("4", "house:0:50", "house:1:56.2")
    assert course.level_weights() == (0.25, 0.375, 0.375)
    assert course.observe([episode(0, "4", 1.0)] * 100, 5) == []
    assert course.scalars() == {}
    Curriculum(CurriculumSettings(), env).load_state_dict(course.state_dict())


def test_a_curriculum_steers_the_batch_that_it_watches(tmp_path: Any) -> None:
    rooms = tmp_path / "two rooms.yaml"
    rooms.write_text("size_m: [9, 5]\nlaunch: [1, 1]\nwalls: [[[4.5, 0], [4.5, 3.6]]]\n")
    settings = CurriculumSettings.model_validate(
        {
            "mode": "sequential", "pass_x_times": 3, "keep_earlier": 0.0,
            "lessons": [{"levels": ["0"]}, {"levels": [str(rooms)]}, {"houses": {"count": 2, "area_m2": [50, 60]}}],
        }
    )  # fmt: skip
    course = Curriculum(settings, ExplorationSettings(worlds=4, drones=3, episode_ticks=400, stop_coverage=0.92))
    env = Exploration(course.environment, seed=1)
    env.reset()
    shown, taught = [], []
    for step in range(3000):
        taken = env.step(np.nan_to_num(env.planner_actions()))
        shown += [one.level for one in taken.episodes]
        taught += [event.name for event in course.observe(taken.episodes, 12 * step) if event.kind == "passed"]
        env.set_level_weights(course.level_weights())
        if len(taught) == 3:
            break
    assert taught == ["1", "2", "3"]
    first = [shown.index(level) for level in ("0", "two rooms")]
    houses = [number for number, level in enumerate(shown) if level.startswith("house:")]
    assert first[0] < first[1] < min(houses)
    assert "0" not in shown[min(houses) :]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("mode: sequential", "a sequential curriculum needs at least one lesson"),
        ("{mode: parallel, lessons: [{}]}", "a lesson needs levels, or houses"),
        ("{mode: parallel, lessons: [{levels: [6-4]}]}", "c:1: lessons.0: level 6-4: the range is empty; write 4-6"),
        ("{lessons: [{levels: ['4'], level_weights: [1, 2]}]}", "one weight for each of the lesson's levels"),
        ("{lessons: [{houses: {count: 3, area_m2: [20, 90]}}]}", "the areas 20-90 m² are not within 50 to 400"),
        ("{lessons: [{houses: {count: 1001}}]}", "lessons.0.houses.count"),
        ("{lessons: [{name: a, levels: ['4']}, {name: a, levels: ['5']}]}", "two are called 'a'"),
        ("keep_earlier: 1.0", "keep_earlier"),
        ("pass_area: 1.2", "pass_area"),
        ("pass_x_time: 3", "did you mean 'pass_x_times'?"),
    ],
)
def test_wrong_settings_are_refused(text: str, message: str) -> None:
    data, lines = parse_yaml(text, "c")
    with pytest.raises(InputError) as error:
        check_settings(CurriculumSettings, data, "c", lines)
    assert message in str(error.value)


def test_a_bare_off_in_yaml_is_off() -> None:
    assert check_settings(CurriculumSettings, parse_yaml("mode: off", "c")[0], "c").mode == "off"


def test_what_cannot_be_told_apart_or_reached_is_refused() -> None:
    with pytest.raises(InputError, match=r"levels a/room.yaml and b/room.yaml are both reported as 'room'"):
        curriculum(mode="parallel", lessons=[{"levels": ["a/room.yaml"]}, {"levels": ["b/room.yaml"]}])
    with pytest.raises(InputError, match=r"pass_area is 0.999, but an episode ends at env.stop_coverage, 0.995"):
        curriculum(mode="sequential", lessons=[{"levels": ["0"], "pass_area": 0.999}])
    course = curriculum(mode="sequential", lessons=[{"levels": ["0"]}])
    with pytest.raises(InputError, match="other levels in its lessons"):
        curriculum(mode="sequential", lessons=[{"levels": ["1"]}]).load_state_dict(course.state_dict())
    course.observe([], 10)
    with pytest.raises(InputError, match="9 agent steps after 10"):
        course.observe([], 9)
