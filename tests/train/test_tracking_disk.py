"""A disk that is full ends a run with the name of the file, and takes nothing that was there."""

import contextlib
import os
import shutil
import subprocess
from pathlib import Path

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from imagine.core.errors import WorkError
from imagine.train.atomic_file import append_whole
from imagine.train.checkpoint import load_checkpoint
from imagine.train.run import train
from imagine.train.tracking.json_lines import JsonLinesTracker, drop_after, read_rows
from imagine.train.tracking.tensorboard_events import TensorBoardTracker

FULL = Path("/dev/full")
DISK_BYTES = 32_000_000
needs_full = pytest.mark.skipif(not FULL.is_char_device(), reason="the system has no /dev/full")


@pytest.fixture
def small_disk(tmp_path):
    """A file system of its own, of DISK_BYTES."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={DISK_BYTES}", "tmpfs", str(folder)], capture_output=True, text=True
    )
    if mounted.returncode:
        pytest.skip(f"no file system of its own can be mounted: {mounted.stderr.strip()}")
    yield folder
    subprocess.run(["umount", "--lazy", str(folder)], check=True)


def fill(folder, leave):
    """Write until only `leave` bytes are free."""
    with (folder / "filler").open("wb", buffering=0) as file, contextlib.suppress(OSError):
        while True:
            file.write(bytes(1 << 16))
    assert shutil.disk_usage(folder).free == 0
    os.truncate(folder / "filler", (folder / "filler").stat().st_size - leave)


@needs_full
def test_metrics_on_a_full_disk_are_work_that_failed(tmp_path):
    (tmp_path / "metrics.jsonl").symlink_to(FULL)
    with pytest.raises(WorkError, match=r"metrics\.jsonl: cannot be written: the disk is full"):
        JsonLinesTracker(tmp_path / "metrics.jsonl").log(1, {"ppo/kl": 0.1})


@needs_full
def test_events_on_a_full_disk_are_noticed_at_once(tmp_path):
    tracker = TensorBoardTracker(tmp_path)
    tracker.path.unlink()
    tracker.path.symlink_to(FULL)
    with pytest.raises(WorkError, match=r"tfevents.*: cannot be written: the disk is full"):
        tracker.log(1, {"ppo/kl": 0.1})
    with pytest.raises(WorkError, match="the disk is full"):
        tracker.config({"seed": 0})


def test_what_a_full_disk_cuts_short_is_taken_back(small_disk):
    path = small_disk / "metrics.jsonl"
    append_whole(path, b"x" * 100)
    fill(small_disk, leave=8192)
    with pytest.raises(WorkError, match=r"metrics\.jsonl: cannot be written: the disk is full"):
        append_whole(path, b"y" * 100_000)
    assert path.read_bytes() == b"x" * 100
    (small_disk / "filler").unlink()
    append_whole(path, b"z")
    assert path.read_bytes() == b"x" * 100 + b"z"


@pytest.mark.parametrize(
    ("leave", "every_s", "file"),
    [(0, 3600.0, r"metrics\.jsonl|tfevents"), (100_000, 0.001, r"latest\.pt|step-\d+\.pt")],
)
def test_a_run_on_a_full_disk_ends_and_goes_on_from_its_checkpoint(small_disk, leave, every_s, file):
    tiny = (
        "env.worlds=2", "env.episode_ticks=40", "env.observation.view_cells=16", "env.observation.lidar_sectors=16",
        "imitation.agent_steps=128", "ppo.agent_steps=512", "run.threads=1", f"run.checkpoint_every_s={every_s}",
        "run.keep_checkpoints=2", f"run.root={small_disk}", "imitation.buffer_samples=1000",
    )  # fmt: skip
    good = []

    def fill_in_the_middle(report):
        if report.phase == "ppo" and report.phase_steps == 256:
            good.append(load_checkpoint(small_disk / "smoke"))
            fill(small_disk, leave)

    with pytest.raises(WorkError, match=rf"({file}): cannot be written: the disk is full; free some space"):
        train(Path("smoke"), tiny, report=fill_in_the_middle)
    kept = load_checkpoint(small_disk / "smoke")
    assert kept.agent_steps == good[0].agent_steps
    assert not list((small_disk / "smoke").rglob("*.tmp"))
    steps = [row["agent_steps"] for row in read_rows(small_disk / "smoke" / "metrics.jsonl")]
    assert steps == [128 * (k + 1) for k in range(len(steps))]
    (small_disk / "filler").unlink()
    assert train(None, resume=small_disk / "smoke").agent_steps == 128 + 512


def test_metrics_go_on_from_a_checkpoint(tmp_path):
    path = tmp_path / "metrics.jsonl"
    tracker = JsonLinesTracker(path)
    for step in (10, 20, 30):
        tracker.log(step, {"ppo/kl": step / 3, "ppo/value_loss": float("nan")})
    with path.open("a") as file:
        file.write('{"agent_steps": 40, "ppo/k')
    drop_after(path, 20)
    assert read_rows(path) == [{"agent_steps": s, "ppo/kl": s / 3, "ppo/value_loss": None} for s in (10, 20)]
    drop_after(tmp_path / "none.jsonl", 0)
    assert not (tmp_path / "none.jsonl").exists()


def test_events_go_on_from_a_checkpoint(tmp_path):
    def steps():
        events = EventAccumulator(str(tmp_path))
        events.Reload()
        return [(event.step, event.value) for event in events.Scalars("a")]

    first = TensorBoardTracker(tmp_path)
    for step in (10, 20, 30):
        first.log(step, {"a": 1.0})
    second = TensorBoardTracker(tmp_path, start_step=20)
    second.log(25, {"a": 2.0})
    assert steps() == [(10, 1.0), (20, 1.0), (25, 2.0)]
    TensorBoardTracker(tmp_path, start_step=25).log(40, {"a": 3.0})
    TensorBoardTracker(tmp_path, start_step=20).log(22, {"a": 4.0})  # from the earlier checkpoint once more
    assert steps() == [(10, 1.0), (20, 1.0), (22, 4.0)]
