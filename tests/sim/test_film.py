"""Films hold an episode evenly from its first moment to its last, and open in other programs."""

from __future__ import annotations

import io
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from imagine.core.errors import InputError
from imagine.sim import film as films
from imagine.sim import render
from imagine.sim.exploration import Exploration
from imagine.sim.exploration_settings import ExplorationSettings
from imagine.sim.film import Film, check_film, encode_gif
from imagine.sim.render import draw_scene, frame_of


def small_world(level: str = "1") -> Exploration:
    settings = ExplorationSettings(
        levels=(level,), worlds=1, drones=2, mirror=False, random_launch=False, stop_coverage=1.0, episode_ticks=1000
    )
    env = Exploration(settings, seed=0, restart=False)
    env.reset()
    return env


def film_of(env: Exploration, ticks: int, size_px: int = 200) -> Film:
    film = Film(size_px)
    film.take(env)
    for _ in range(ticks):
        env.step(np.nan_to_num(env.planner_actions()))
        film.take(env)
    return film


def test_a_short_episode_is_filmed_tick_by_tick() -> None:
    film = film_of(small_world(), 7)
    assert [scene.tick for scene in film.scenes] == list(range(8))
    assert len(film) == 8
    assert film.frame_s == 0.2


@pytest.mark.parametrize("ticks", [8, 9, 16, 17, 31, 40, 63, 64, 65])
def test_a_long_episode_keeps_even_distances_and_its_end(ticks: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(films, "MOST_FRAMES", 8)
    film = film_of(small_world(), ticks)
    shown = [scene.tick for scene in film.scenes]
    assert shown[0] == 0
    assert shown[-1] == ticks
    steps = np.diff(shown)
    assert (steps[:-1] == steps[0]).all()
    assert 0 < steps[-1] <= steps[0]
    assert 5 <= len(shown) == len(film) <= 9


def test_kept_scenes_are_those_that_were_taken() -> None:
    env = small_world()
    film = film_of(env, 5, 300)
    *_, last = film.scenes
    np.testing.assert_array_equal(draw_scene(last, 300), render.render_world(env, 0, 300, last.trails))
    assert [len(trail) for trail in last.trails] == [6, 6]
    first = next(film.scenes)
    assert [len(trail) for trail in first.trails] == [1, 1]
    assert 0.0 < first.coverage < last.coverage


def test_a_gif_holds_every_picture_for_its_time() -> None:
    film = film_of(small_world(), 20)
    frames = list(film.frames())
    with Image.open(io.BytesIO(film.encode(".gif"))) as gif:
        assert gif.format == "GIF"
        assert gif.n_frames == len(film) == 21
        assert gif.info["loop"] == 0
        durations = []
        for index, frame in enumerate(frames):
            gif.seek(index)
            durations.append(gif.info["duration"])
            shown = np.asarray(gif.convert("RGB")).astype(int)
            assert shown.shape == frame.shape
            assert np.abs(shown - frame).mean() < 2.0  # one palette for all, and no leftovers of earlier pictures
        assert durations == [200] * 20 + [2000]


def test_a_gif_keeps_the_colours_that_matter() -> None:
    env = small_world()
    film = film_of(env, 30, 400)
    *_, scene = film.scenes
    frame = frame_of(scene.level, 400)
    with Image.open(io.BytesIO(film.encode(".GIF"))) as gif:
        gif.seek(gif.n_frames - 1)
        shown = np.asarray(gif.convert("RGB")).astype(int)
    for drone in range(2):
        row, column = frame.pixel(*scene.poses[drone, :2])
        patch = shown[row - 6 : row + 7, column - 6 : column + 7]
        assert np.abs(patch - np.array(render.DRONES[drone])).sum(axis=-1).min() < 30
    row, column = frame.pixel(*np.array(scene.level.launch) + 0.25)
    assert np.abs(shown[row, column] - np.array(render.SEEN_FLOOR)).sum() < 12


def test_a_film_of_the_furnished_house_stays_under_three_megabytes() -> None:
    settings = ExplorationSettings(levels=("6",), worlds=1, drones=3, mirror=False, random_launch=False)
    env = Exploration(settings, seed=0, restart=False)
    env.reset()
    film = Film()
    film.take(env)
    while True:
        done = env.step(np.nan_to_num(env.planner_actions())).done[0]
        film.take(env)
        if done:
            break
    assert env.maps.coverage()[0] >= 0.99
    assert 80 <= len(film) <= 201
    assert 13.0 <= film.frame_s * (len(film) - 1) <= 17.0
    data = film.encode(".gif")
    assert len(data) < 3_000_000
    with Image.open(io.BytesIO(data)) as gif:
        assert gif.n_frames == len(film)
        assert gif.width >= 800


def test_a_video_holds_the_episode_and_a_rest_on_its_end() -> None:
    av = pytest.importorskip("av", reason="PyAV is not installed: it comes with the extra 'film'")
    film = film_of(small_world(), 12, 301)
    frames = list(film.frames())
    with av.open(io.BytesIO(film.encode(".mp4"))) as video:
        stream = video.streams.video[0]
        assert stream.codec_context.name == "h264"
        assert float(stream.average_rate) == pytest.approx(1.0 / film.frame_s)
        shown = [picture.to_ndarray(format="rgb24").astype(int) for picture in video.decode(stream)]
    assert len(shown) == len(film) + 9  # 2 s in pictures of 0.2 s, the last one among them
    height, width = (side // 2 * 2 for side in frames[0].shape[:2])
    for index in (0, 6, 12, -1):
        wanted = frames[min(index, 12)][:height, :width]
        assert shown[index].shape == wanted.shape
        assert np.abs(shown[index] - wanted).mean() < 6.0


def test_equal_pictures_are_one_that_is_shown_longer() -> None:
    picture = np.zeros((20, 30, 3), np.uint8)
    other = picture + np.uint8(200)
    with Image.open(io.BytesIO(encode_gif([picture, other, other, picture], 0.1, 1.0))) as gif:
        assert gif.n_frames == 3
        gif.seek(1)
        assert gif.info["duration"] == 200


@pytest.mark.parametrize("name", ["film", "film.avi", "film.png", "gif"])
def test_other_names_are_refused(name: str) -> None:
    with pytest.raises(InputError, match=rf"{name}.*\.gif or \.mp4"):
        check_film(Path(name))


def test_without_pyav_the_message_tells_the_extra_and_the_way_round(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    check_film(Path("film.gif"))
    with pytest.raises(InputError, match=r"imagine-swarm\[film\].*\.gif"):
        check_film(Path("film.mp4"))
    with pytest.raises(InputError, match=r"imagine-swarm\[film\]"):
        film_of(small_world(), 1).encode(".mp4")


def test_an_empty_film_is_refused() -> None:
    assert len(Film()) == 0
    with pytest.raises(InputError, match="empty"):
        Film().encode(".gif")
