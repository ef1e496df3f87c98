"""One process at a time trains in a run's folder."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from imagine.core.errors import InputError
from imagine.train.folder_lock import locked
from imagine.train.run import train

HOLD = """
import sys
from pathlib import Path
from imagine.train.folder_lock import locked
with locked(Path(sys.argv[1]), "is at work"):
    print("locked", flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def holder(tmp_path):
    """Another process that holds the folder `run`."""
    command = [sys.executable, "-c", HOLD, str(tmp_path / "run")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "locked\n"
        yield process
        process.kill()


def test_a_second_process_is_refused_and_told_who_is_there(tmp_path, holder):
    with (
        pytest.raises(InputError, match=rf"run: process {holder.pid} is here$"),
        locked(tmp_path / "run", "is here"),
    ):
        pytest.fail("two hold the same folder")


def test_a_killed_process_leaves_no_lock(tmp_path, holder):
    holder.kill()
    holder.wait(timeout=30)
    with locked(tmp_path / "run", "is here"):
        assert (tmp_path / "run" / ".lock").read_text() == f"{os.getpid()}\n"


def test_who_is_done_lets_others_in(tmp_path):
    for _ in range(2):
        with locked(tmp_path, "is here"):
            pass
    with pytest.raises(ZeroDivisionError), locked(tmp_path, "is here"):
        raise ZeroDivisionError
    with locked(tmp_path, "is here"):
        pass


def test_two_trainings_into_one_folder_are_refused_and_nothing_is_touched(tmp_path):
    small = (
        "env.worlds=2", "env.observation.view_cells=16", "env.observation.lidar_sectors=16", "run.threads=1",
        f"run.root={tmp_path}", "run.name=mine",
    )  # fmt: skip
    with locked(tmp_path / "mine", "is training"):
        with pytest.raises(InputError, match=rf"mine: process {os.getpid()} is training"):
            train(Path("smoke"), small)
        assert [path.name for path in (tmp_path / "mine").iterdir()] == [".lock"]
        (tmp_path / "mine" / "config.yaml").write_text("{}")
        with pytest.raises(InputError, match=rf"mine: process {os.getpid()} is training"):
            train(None, resume=tmp_path / "mine")
