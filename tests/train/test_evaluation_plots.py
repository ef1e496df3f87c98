"""Pictures of an evaluation: that they show what was measured, and fit what they are given."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from imagine.core.errors import InputError
from imagine.train.evaluation import Comparison, Plan, contender_of, shared_envs
from imagine.train.evaluation.plan import Group
from imagine.train.evaluation.plots import (
    check_plots,
    coverage_figure,
    curve_band,
    panels_of,
    t90_figure,
    telling_ticks,
    write_plots,
)
from imagine.train.evaluation.radar import AXES, radar_of

pytest.importorskip("matplotlib")
TEAM = Group("one-hop", 2)


@pytest.fixture(scope="module")
def comparison():
    contenders = [contender_of("frontier"), contender_of("random")]
    envs = shared_envs(contenders, ["env.episode_ticks=120"])
    flown = Comparison(contenders, envs, Plan(("0", "1"), drones=(2,), episodes=3), 1)
    assert len(list(flown.fly())) == 4
    return flown


def test_three_pictures_with_something_on_them(comparison, tmp_path):
    written = write_plots(comparison, tmp_path / "plots")
    assert [path.name for path in written] == ["coverage.png", "t90.png", "radar.png"]
    for path in written:
        with Image.open(path) as picture:
            pixels = np.asarray(picture.convert("RGB")).reshape(-1, 3)
        colours = {tuple(colour) for colour in pixels[::7].tolist()}
        assert {(0, 114, 178), (122, 122, 122)} <= colours  # the policy's blue and the reference's grey
        assert (pixels == 255).all(axis=1).mean() > 0.4
    assert sorted(path.name for path in (tmp_path / "plots").iterdir()) == ["coverage.png", "radar.png", "t90.png"]


def test_curves_are_the_means_of_the_episodes(comparison):
    panels = coverage_figure(comparison, TEAM).axes
    assert [panel.get_title(loc="left") for panel in panels] == ["level 0", "level 1"]
    lines = {line.get_label(): line for line in panels[1].lines if not line.get_label().startswith("_")}
    assert list(lines) == ["frontier", "random"]
    drawn = lines["frontier"].get_ydata()
    episodes = comparison.by_level(0, TEAM, "1")[0]
    assert drawn[9] == pytest.approx(np.mean([episode.curve[9] for episode in episodes]), abs=1e-6)
    assert drawn[-1] == pytest.approx(np.mean([episode.coverage for episode in episodes]), abs=1e-6)


def test_bars_are_the_rows_times_in_seconds(comparison):
    (axes,) = t90_figure(comparison, TEAM).axes
    heights = [patch.get_height() for patch in axes.patches]
    rows = comparison.rows
    assert heights == pytest.approx([0.1 * row["t90_mean"] for row in rows])
    assert [text.get_text() for text in axes.get_xticklabels()] == ["0", "1", "all 2 levels"]
    ratio = rows[1]["paired"]["t90_ratio"]
    assert f"×{ratio:.2f}" in [text.get_text() for text in axes.texts]


def test_a_band_holds_the_mean_and_narrows_with_more_episodes():
    rng = np.random.default_rng(0)
    few, many = (rng.uniform(0.0, 1.0, (count, 20)).astype(np.float32) for count in (10, 1000))
    for curves in (few, many):
        mean, low, high = curve_band([curves], 0)
        assert ((low <= mean) & (mean <= high)).all()
    widths = [np.mean(np.subtract(*curve_band([curves], 0)[:0:-1])) for curves in (few, many)]
    assert widths[1] < 0.2 * widths[0]


def test_a_band_over_levels_counts_them_alike_and_is_of_their_episodes_alone():
    one, other = np.full((9, 5), 0.2, np.float32), np.full((1, 5), 0.8, np.float32)
    for told in curve_band([one, other], 0):
        np.testing.assert_allclose(told, 0.5, atol=1e-6)


def test_the_time_shown_ends_when_the_last_of_those_who_see_all_has():
    quick, slow, never = (
        np.clip(np.arange(1, 1001) / ticks, 0.0, end) for ticks, end in ((100, 1), (400, 1), (5000, 1))
    )
    assert 400 <= telling_ticks([quick, slow, never]) <= 480
    assert telling_ticks([never]) == 1000


def test_many_levels_share_a_panel(comparison):
    assert panels_of(comparison) == ["0", "1"]
    many = Comparison(comparison.contenders, comparison._envs, Plan(tuple(f"house:{k}:60" for k in range(13))))
    assert panels_of(many) == ["all"]


def radar_row(**changes):
    given = {
        "coverage_mean": 0.9, "t90_mean": 200.0, "overlap": 2.0, "drones": 3, "collisions_per_drone": 1.0,
        "bytes_per_drone": 500.0, "productivity_ratio": 4.0,
    }  # fmt: skip
    return given | changes


def test_a_radar_is_one_scale_on_which_more_is_better():
    one, other = radar_of([radar_row(), radar_row(t90_mean=400.0, bytes_per_drone=250.0, overlap=1.0)])
    assert dict(zip(AXES, one, strict=True)) == pytest.approx(
        {"coverage": 0.9, "speed": 1.0, "little overlap": 0.5, "few contacts": 0.5, "few bytes": 0.5,
         "balanced work": 0.25}
    )  # fmt: skip
    assert other[:3] == pytest.approx([0.9, 0.5, 1.0])
    assert other[4] == 1.0
    assert radar_of([radar_row(drones=1, overlap=1.0, bytes_per_drone=0.0)])[0, [2, 4]].tolist() == [1.0, 1.0]


def test_folders_that_cannot_be_drawn_into_are_refused(tmp_path):
    check_plots(tmp_path / "new")
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="is a file; name a folder"):
        check_plots(tmp_path / "file")
    with pytest.raises(InputError, match="does not exist"):
        check_plots(tmp_path / "no" / "such")
