"""A run on all levels with three drones: which scalars it leaves behind, where, and whether it can be run again."""

import json
import math
import re
import socket
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from imagine.core.errors import InputError
from imagine.train.run import train
from imagine.train.settings import load_train_settings
from imagine.train.tracking.curves import plot_run, read_curves, smoothed

DOCS = Path(__file__).resolve().parents[2] / "docs" / "tracking.md"
OVERRIDES = (
    'env.levels=["0","1","2","3","4","5","6"]', "env.worlds=8", "env.drones=3", "env.episode_ticks=20",
    "env.observation.view_cells=16", "env.observation.lidar_sectors=16", "imitation.agent_steps=768",
    "ppo.agent_steps=2304", "run.threads=1", "ppo.critic_warmup_updates=0",
)  # fmt: skip
OF_TIME = ("time/", "speed/", "memory/")


def rows_of(folder):
    return [json.loads(line) for line in (folder / "metrics.jsonl").read_text("utf-8").splitlines()]


def documented():
    """The names in the table of docs/tracking.md, as patterns."""
    table = DOCS.read_text("utf-8").partition("| name | what |")[2].partition("\n\n")[0]
    cells = [line.split("|")[1] for line in table.splitlines() if line.startswith("| `")]
    return [name for cell in cells for name in re.findall(r"`([^`]+)`", cell)]


def pattern(name):
    return re.compile(re.sub(r"<\w+>", r"[\\w.-]+", name) + "$")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    root = tmp_path_factory.mktemp("runs")
    reports = []
    result = train(Path("smoke"), (*OVERRIDES, f"run.root={root}"), report=reports.append)
    return result.folder, reports


def test_a_trial_leaves_about_two_hundred_finite_scalars(run):
    folder, _ = run
    last = rows_of(folder)[-1]
    levels = {name.split("/")[1] for name in last if name.startswith("episode/")}
    assert levels == set("0123456")
    assert 150 <= len(last) <= 300
    assert all(math.isfinite(value) for value in last.values())


def test_every_scalar_is_documented_and_every_documented_one_is_there(run):
    folder, _ = run
    names = {name for row in rows_of(folder) for name in row} - {"agent_steps"}
    patterns = [pattern(name) for name in documented()]
    assert sorted(name for name in names if not any(p.match(name) for p in patterns)) == []
    certain = [n for n in documented() if not n.startswith(("ppo/", "imitation/<other>", "memory/gpu"))]
    assert [name for name in certain if not any(pattern(name).match(n) for n in names)] == []


def test_metrics_hold_what_was_reported_to_the_last_bit(run):
    folder, reports = run
    assert rows_of(folder) == [json.loads(json.dumps(report.row())) for report in reports]
    assert [name for name in reports[0].numbers if "/" in name] == []


def test_tensorboard_shows_the_same_scalars_and_the_settings(run):
    folder, reports = run
    events = EventAccumulator(str(folder / "tensorboard"))
    events.Reload()
    scalars = reports[-1].scalars()
    assert set(scalars) <= set(events.Tags()["scalars"])
    for name, value in scalars.items():
        last = events.Scalars(name)[-1]
        assert (last.step, last.value) == (reports[-1].agent_steps, float(np.float32(value)))
    assert len(events.Scalars("speed/agent_steps_per_s")) == len(reports)
    [config] = events.Tensors("config/text_summary")
    assert "episode_ticks: 20" in config.tensor_proto.string_val[0].decode()


def test_the_configuration_in_the_folder_gives_the_same_run_again(run):
    folder, _ = run
    again = train(folder / "config.yaml", ("run.name=again",)).folder
    assert again == folder.parent / "again"
    first, second = rows_of(folder), rows_of(again)
    assert len(first) == len(second) == 4
    for one, two in zip(first, second, strict=True):
        assert list(one) == list(two)
        assert {n: v for n, v in one.items() if not n.startswith(OF_TIME)} == {
            n: v for n, v in two.items() if not n.startswith(OF_TIME)
        }


def test_the_record_says_what_ran_and_not_where(run):
    folder, _ = run
    text = (folder / "record.json").read_text("utf-8")
    record = json.loads(text)
    assert record["seed"] == 0
    assert record["machine"]["cpu"]
    assert record["machine"]["cores"] >= 1
    assert record["threads"] == 1
    assert record["packages"]["torch"].startswith("2.")
    assert record["command"]
    assert not re.search(r'"[^"]*(^|[=" ])/[^"]*"', text), "an absolute path"
    assert str(Path.home()) not in text
    names = [str(path) for path in folder.rglob("*")]
    assert not any(socket.gethostname() in Path(name).name.split(".") for name in names)


def test_curves_are_read_and_drawn(run, tmp_path):
    folder, reports = run
    steps, curves = read_curves(folder)
    assert steps.tolist() == [report.agent_steps for report in reports]
    assert np.isnan(curves["ppo/value_loss"][0])
    assert curves["ppo/value_loss"][-1] == reports[-1].numbers["value_loss"]
    plot_run(folder, tmp_path / "curves.png")
    with Image.open(tmp_path / "curves.png") as image:
        assert image.size[0] > 1000
        colours = {colour for _, colour in image.convert("RGB").getcolors(1 << 24)}
    assert {(0x1B, 0x6C, 0xA8), (0xC8, 0x55, 0x3D)} <= colours


def test_curves_of_what_is_no_run_are_refused(tmp_path):
    with pytest.raises(InputError, match=r"metrics\.jsonl: cannot be read.*give the folder of a run"):
        plot_run(tmp_path, tmp_path / "curves.png")
    (tmp_path / "metrics.jsonl").write_text('{"agent_')
    with pytest.raises(InputError, match="no update is in it yet"):
        plot_run(tmp_path, tmp_path / "curves.png")


def test_smoothing_is_a_mean_over_what_came_before():
    values = np.array([np.nan, 1.0, 3.0, np.nan, 5.0, 7.0])
    np.testing.assert_allclose(smoothed(values, 3), [np.nan, 1.0, 2.0, np.nan, 4.0, 6.0])
    np.testing.assert_array_equal(smoothed(values, 1), values)


def test_tracking_can_be_turned_off_but_for_the_metrics(tmp_path):
    more = ("tracking.tensorboard=false", "imitation.agent_steps=0", "ppo.agent_steps=200", f"run.root={tmp_path}")
    folder = train(Path("smoke"), (*OVERRIDES, *more)).folder
    assert not (folder / "tensorboard").exists()
    assert rows_of(folder)
    assert load_train_settings(folder / "config.yaml").tracking.tensorboard is False
