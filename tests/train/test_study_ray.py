"""Studies on a real Ray of two CPUs: a worker is killed, the study is interrupted, and nothing is lost."""

import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from imagine.cli import main
from imagine.core.errors import InputError
from imagine.train.checkpoint import load_checkpoint
from imagine.train.study import cluster
from imagine.train.study.outcome import read_attempts
from imagine.train.study.results import study_data
from imagine.train.study.run import run_study
from imagine.train.study.settings import StudySettings
from imagine.train.study.trial import Watchdog

if find_spec("ray") is None:  # not importorskip: a study sets Ray up before it is imported
    pytest.skip("studies need the extra 'study'", allow_module_level=True)
pytestmark = pytest.mark.timeout(900)  # processes start slowly where other work has the cores

TINY = (
    "env.worlds=2", "env.episode_ticks=40", "env.observation.view_cells=16", "env.observation.lidar_sectors=16",
    'env.levels=["0"]', "imitation.agent_steps=128", "ppo.agent_steps=256", "run.checkpoint_every_s=0.001",
    "run.final_episodes=1",
)  # fmt: skip


def eight_trials(root):
    return StudySettings(
        name="eight", root=str(root), base="smoke", set=TINY, repeats=2,
        parameters={"grid": {"ppo.clip": [0.1, 0.2], "ppo.gamma": [0.98, 0.99]}},
    )  # fmt: skip


def ray_processes():
    """Return the command lines of Ray's processes that descend from this one."""
    parents, commands = {}, {}
    for path in Path("/proc").glob("[0-9]*"):
        try:
            parents[int(path.name)] = int((path / "stat").read_text().rpartition(")")[2].split()[1])
            commands[int(path.name)] = (path / "cmdline").read_bytes().replace(b"\0", b" ").decode()
        except OSError:  # it ended meanwhile
            continue
    found = []
    for pid, command in commands.items():
        above = parents[pid]
        while above > 1 and above != os.getpid():
            above = parents.get(above, 0)
        if above == os.getpid() and "ray" in command:
            found.append(command)
    return found


@pytest.fixture(scope="module")
def story(tmp_path_factory):
    """Interrupt a study of eight trials when its first has ended; go on, and kill the worker of another one."""
    study = eight_trials(tmp_path_factory.mktemp("runs"))
    first, second, killed, listening = [], [], {}, set()

    def interrupt(event):
        first.append(event)
        listening.update(listeners())
        if event.kind == "ended" and not any(e.kind == "ended" for e in first[:-1]):
            os.kill(os.getpid(), signal.SIGINT)

    def kill(event):
        second.append(event)
        run = Path(study.folder) / "trials" / event.trial
        fresh = len(read_attempts(run)) == 1
        if event.kind == "reported" and not killed and fresh and (run / "checkpoints" / "latest.pt").exists():
            killed.update(trial=event.trial, pid=event.pid, steps=int(event.numbers["agent_steps"]))
            os.kill(event.pid, signal.SIGKILL)

    began = time.monotonic()
    stopped = run_study(study, tell=interrupt, cpus=2)
    after_stop = ray_processes()
    done = run_study(study, resume=True, tell=kill, cpus=2)
    return {
        "study": study, "first": first, "second": second, "killed": killed, "stopped": stopped, "done": done,
        "left": after_stop + ray_processes(), "seconds": time.monotonic() - began, "listening": listening,
    }  # fmt: skip


def listeners():
    """Return the addresses that Ray's processes of this test listen at, as hexadecimal words of /proc/net/tcp."""
    inodes = set()
    for path in Path("/proc").glob("[0-9]*"):
        try:
            if b"imagine-ray-" not in (path / "cmdline").read_bytes():
                continue
            inodes |= {os.readlink(file) for file in (path / "fd").iterdir()}
        except OSError:
            continue
    found = set()
    for table in ("tcp", "tcp6"):
        for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]:
            words = line.split()
            if words[3] == "0A" and f"socket:[{words[9]}]" in inodes:
                found.add(words[1].partition(":")[0])
    return found


def test_all_eight_results_are_there(story):
    data = study_data(story["study"], story["done"])
    assert [row["status"] for row in data["trials"]] == ["finished"] * 8
    assert data["finished"]
    assert all(row["agent_steps"] == 384 for row in data["trials"])
    assert all(row["source"] == "evaluation" for row in data["trials"])
    assert all(0.0 < row["coverage"] <= 1.0 for row in data["trials"])
    assert [row["trials"] for row in data["conditions"]] == [2] * 4


def test_the_killed_worker_s_trial_was_resumed_by_another_and_not_restarted(story):
    killed = story["killed"]
    run = story["done"].folder.run(killed["trial"])
    before, after = read_attempts(run)
    assert (before.pid, before.resumed_from) == (killed["pid"], 0)
    assert after.pid != killed["pid"]
    assert 0 < after.resumed_from <= killed["steps"]
    reports = [
        (event.pid, event.numbers["agent_steps"])
        for event in story["second"]
        if event.trial == killed["trial"] and event.kind == "reported"
    ]
    by_second = [steps for pid, steps in reports if pid == after.pid]
    assert min(by_second) > after.resumed_from  # it did not do again what the checkpoint held
    assert max(by_second) == 384
    steps = [json.loads(line)["agent_steps"] for line in (run / "metrics.jsonl").read_text("utf-8").splitlines()]
    assert steps == sorted(set(steps))
    assert steps[0] <= after.resumed_from  # the first worker's metrics are kept
    assert steps[-1] == 384
    weights = load_checkpoint(run).actor
    assert all(np.isfinite(value.numpy()).all() for value in weights.values())


def test_an_interrupted_study_keeps_what_ended_and_goes_on_with_the_rest(story):
    stopped = story["stopped"]
    assert stopped.stopped == "the study was stopped"
    assert story["done"].stopped == ""
    kept = [name for name, outcome in stopped.outcomes.items() if outcome is not None]
    assert 1 <= len(kept) < 8
    assert all(stopped.outcomes[name].status == "finished" for name in kept)
    assert not {event.trial for event in story["second"]} & set(kept)
    for name in kept:
        assert len(read_attempts(stopped.folder.run(name))) == 1
    begun = {event.trial for event in story["first"] if event.kind == "reported"} - set(kept)
    for name in begun:
        saved = read_attempts(stopped.folder.run(name))
        assert saved[-1].resumed_from > 0


def test_ray_is_on_loopback_and_nothing_of_it_is_left(story):
    loopback = {"0100007F", "0000000000000000FFFF00000100007F"}
    assert story["listening"] & loopback
    assert story["listening"] <= loopback
    assert story["left"] == []
    assert not (story["study"].folder / ".tune").exists()


def test_a_finished_study_is_resumed_without_ray(story):
    began = time.monotonic()
    again = run_study(story["study"], resume=True, tell=lambda event: pytest.fail(str(event)))
    assert again.outcomes == story["done"].outcomes
    assert time.monotonic() - began < 5.0


def test_a_study_needs_a_name_of_its_own(story):
    with pytest.raises(InputError, match="there is a study of this name; go on with --resume"):
        run_study(story["study"])


def command(arguments, capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["imagine", "study", *map(str, arguments)])
    with pytest.raises(SystemExit) as exit_:
        main()
    return exit_.value.code, capsys.readouterr()


@pytest.fixture
def tiny_file(tmp_path):
    path = tmp_path / "tiny.yaml"
    path.write_text(f"name: tiny\nbase: smoke\nroot: {tmp_path}/runs\nparameters: {{grid: {{env.drones: [1, 2]}}}}\n")
    return path


@pytest.mark.parametrize("address", ["127.0.0.1:1", "nobody", "ray://127.0.0.1:1", "127.0.0.1:99999"])
def test_a_lost_cluster_address_is_told_in_seconds(tiny_file, capsys, monkeypatch, address):
    began = time.monotonic()
    status, said = command([tiny_file, "--address", address], capsys, monkeypatch)
    assert status == 2
    assert f"--address {address}" in said.err
    assert time.monotonic() - began < 20.0
    assert not (tiny_file.parent / "runs" / "tiny" / "study.yaml").exists()  # nothing to clear away before the next try


def test_what_listens_but_never_answers_is_told(tiny_file, capsys, monkeypatch):
    monkeypatch.setattr(cluster, "_ANSWER_S", 2.0)
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"127.0.0.1:{server.getsockname()[1]}"
        status, said = command([tiny_file, "--address", address], capsys, monkeypatch)
    assert status == 2
    assert f"--address {address}: what listens there is no Ray head" in said.err


def test_a_dry_run_shows_the_trials_and_starts_none(tiny_file, capsys, monkeypatch):
    status, said = command([tiny_file, "--dry-run"], capsys, monkeypatch)
    assert status == 0
    assert "tiny: 2 trials" in said.out
    assert not (tiny_file.parent / "runs").exists()


@pytest.fixture(scope="module")
def searched(tmp_path_factory):
    """A search by ASHA of good trials, of bad ones that see next to nothing, and of one that diverges."""
    study = StudySettings(
        name="search", root=str(tmp_path_factory.mktemp("runs")), base="smoke", search="asha",
        set=(*TINY, 'env.levels=["1"]', "ppo.agent_steps=384", "env.drones=3"),
        variants=[
            {"name": "wide"}, {"name": "wide-too", "set": ["ppo.gamma=0.9"]},
            {"name": "blind", "set": ["env.map.range_cap_m=0.6"]}, {"name": "sick", "set": ["imitation.lr=1e30"]},
        ],
        asha={"grace_agent_steps": 192, "reduction_factor": 2},
    )  # fmt: skip
    result = run_study(study, cpus=1)
    return {row["parameters"]["variant"]: row for row in study_data(study, result)["trials"]}, study, result


def test_asha_stops_what_is_worse_and_evaluates_what_came_to_its_end(searched):
    rows = searched[0]
    assert (rows["wide"]["status"], rows["wide"]["source"], rows["wide"]["agent_steps"]) == (
        "finished",
        "evaluation",
        576,
    )
    assert rows["blind"]["status"] == "pruned"
    assert rows["blind"]["agent_steps"] < 576
    ranked = [row["parameters"]["variant"] for row in study_data(searched[1], searched[2])["conditions"]]
    assert ranked[-2:] == ["blind", "sick"]


def test_a_trial_that_diverges_has_failed_and_says_why(searched):
    row = searched[0]["sick"]
    assert row["status"] == "failed"
    assert row["error"].startswith("imitation diverged")
    assert row["workers"] == 1  # a second try would diverge as well


def test_a_watchdog_kills_a_process_that_hangs(tmp_path):
    code = (
        "import sys, threading; from pathlib import Path; from imagine.train.study.trial import Watchdog\n"
        "with Watchdog(0.2, Path(sys.argv[1])): threading.Event().wait(60)"
    )
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path / "error.txt")], timeout=120, check=False)
    assert done.returncode == -signal.SIGKILL
    assert "nothing was reported for 0.2 s" in (tmp_path / "error.txt").read_text()


def test_a_watchdog_that_is_fed_does_nothing_and_ends(tmp_path):
    with Watchdog(10.0, tmp_path / "error.txt") as watchdog:
        watchdog.feed()
    assert not any(thread.name == "watchdog" for thread in threading.enumerate())
    assert not (tmp_path / "error.txt").exists()
