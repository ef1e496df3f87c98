"""The curriculum inside a training run: the packaged configurations, and what a run makes of lessons."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from imagine.core.errors import InputError
from imagine.sim.level import BUILT_IN, load_level
from imagine.train.checkpoint import load_checkpoint
from imagine.train.curriculum import Curriculum
from imagine.train.run import train
from imagine.train.settings import load_train_settings
from imagine.train.trainer import Trainer

TINY = (
    "env.worlds=2", "env.episode_ticks=40", "env.observation.view_cells=16", "env.observation.lidar_sectors=16",
    "imitation.agent_steps=256", "ppo.agent_steps=512", "run.threads=1",
)  # fmt: skip
LESSONS = (
    'curriculum={mode: sequential, pass_area: 0.02, pass_x_times: 2, keep_earlier: 0.0, '
    'lessons: [{levels: ["0"]}, {houses: {count: 3, area_m2: [50, 60]}, pass_x_times: 1000}]}'
)  # fmt: skip


@pytest.mark.parametrize("name", ["curriculum", "parallel"])
def test_the_packaged_curricula_load_and_name_levels_that_exist(name: str) -> None:
    settings = load_train_settings(Path(name))
    assert settings.run.name == name
    course = Curriculum(settings.curriculum, settings.env)
    assert set(BUILT_IN) <= set(course.levels)
    for level in course.levels:
        load_level(level).launch_poses(settings.env.drones)
    if settings.curriculum.mode == "sequential":
        assert [lesson.levels for lesson in settings.curriculum.lessons] == [(level,) for level in BUILT_IN]
        assert course.level_weights() == (1.0, *[0.0] * 6)
    else:
        assert min(course.level_weights()) > 0.0


def test_a_wrong_key_of_a_lesson_is_refused_with_its_line(tmp_path: Path) -> None:
    config = tmp_path / "c.yaml"
    config.write_text('curriculum:\n  mode: sequential\n  lessons:\n    - levels: ["0"]\n      pass_areas: 0.9\n')
    with pytest.raises(InputError, match=r"c\.yaml:5: unknown key 'curriculum\.lessons\.0\.pass_areas'"):
        load_train_settings(config)


def test_a_run_goes_from_lesson_to_lesson_and_resumes_in_its_lesson(tmp_path: Path) -> None:
    told: list[Any] = []
    run = train(Path("smoke"), (*TINY, f"run.root={tmp_path}", LESSONS), report=told.append)
    saved = load_checkpoint(run.folder)
    history = saved.progress["curriculum"]["history"]
    assert [(event["kind"], event["name"]) for event in history] == [("passed", "1"), ("begun", "2")]
    flown = [set(report.levels) for report in told]
    assert flown[0] == {"0"}
    assert any(level.startswith("house") for level in flown[-1])
    rows = [json.loads(line) for line in (run.folder / "metrics.jsonl").read_text().splitlines()]
    assert rows[-1]["agent_steps"] == 768
    resumed = Trainer(saved.settings, saved)
    assert resumed.curriculum.scalars()["curriculum/lesson"] == 2.0
    assert resumed.env.level_weights.tolist() == pytest.approx([0.0, 1 / 3, 1 / 3, 1 / 3])
    assert all(level.name.startswith("house:") for level in resumed.env.twin.levels)
