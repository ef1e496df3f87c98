"""The folder of a run: what it records of code, command and resumptions."""

import dataclasses
import json
import subprocess
from pathlib import Path

import pytest

from imagine.core.errors import InputError
from imagine.train.run_folder import RunFolder, config_hash
from imagine.train.run_record import shown_command
from imagine.train.settings import load_train_settings
from imagine.train.tracking import code_state
from imagine.train.tracking.code_state import code_state as state_of
from imagine.train.trainer import Trainer


def git(where, *arguments):
    author = ("-c", "user.name=test", "-c", "user.email=test@example.org", "-c", "commit.gpgsign=false")
    done = subprocess.run(["git", *author, *arguments], cwd=where, check=True, capture_output=True)
    return done.stdout.decode().strip()


@pytest.fixture
def checkout(tmp_path):
    root = tmp_path / "checkout"
    (root / "train").mkdir(parents=True)
    git(root, "init", "--initial-branch", "work")
    (root / "train" / "here.py").write_text("SPEED = 1\n")
    (root / ".gitignore").write_text("runs/\n")
    git(root, "add", ".")
    git(root, "commit", "-m", "one")
    return root


def test_a_clean_checkout_is_its_commit(checkout):
    state = state_of(checkout / "train" / "here.py")
    assert state.commit == git(checkout, "rev-parse", "HEAD")
    assert (state.branch, state.dirty, state.patch) == ("work", False, b"")


def test_commit_and_patch_give_the_code_back(checkout, tmp_path):
    (checkout / "train" / "here.py").write_text("SPEED = 2\n")
    (checkout / "train" / "new.py").write_text("NEW = True\n")
    (checkout / "secret.txt").write_text("not a source\n")
    (checkout / "runs").mkdir()
    (checkout / "runs" / "config.yaml").write_text("ignored: true\n")
    before = git(checkout, "status", "--porcelain")
    state = state_of(checkout / "train" / "here.py")
    assert state.dirty
    assert git(checkout, "status", "--porcelain") == before
    clone = tmp_path / "clone"
    git(tmp_path, "clone", str(checkout), str(clone))
    (tmp_path / "changes.patch").write_bytes(state.patch)
    git(clone, "checkout", state.commit)
    git(clone, "apply", str(tmp_path / "changes.patch"))
    assert (clone / "train" / "here.py").read_text() == "SPEED = 2\n"
    assert (clone / "train" / "new.py").read_text() == "NEW = True\n"
    assert not (clone / "secret.txt").exists()
    assert not (clone / "runs").exists()


def test_a_patch_too_long_is_not_kept(checkout, monkeypatch):
    monkeypatch.setattr(code_state, "MOST_PATCH_BYTES", 1000)
    (checkout / "train" / "here.py").write_text("".join(f"A{k} = {k}\n" for k in range(1000)))
    state = state_of(checkout / "train" / "here.py")
    assert state.dirty
    assert state.patch is None


def test_code_installed_into_somebodys_checkout_is_not_that_checkout(checkout, tmp_path):
    (checkout / "runs").mkdir()
    (checkout / "runs" / "installed.py").write_text("")
    assert state_of(checkout / "runs" / "installed.py") is None
    (tmp_path / "alone.py").write_text("")
    assert state_of(tmp_path / "alone.py") is None


def test_the_command_is_shown_without_where_it_ran(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    given = ["/opt/bin/imagine", "train", f"{tmp_path}/mine.yaml", "--set", "run.root=/data/me/runs", "--set", "a=1=2"]
    assert shown_command(given) == ["imagine", "train", "mine.yaml", "--set", "run.root=runs", "--set", "a=1=2"]
    assert shown_command(["/somewhere/imagine/__main__.py", "train"]) == ["imagine", "train"]
    assert shown_command(["imagine", "--resume=~/runs/a"]) == ["imagine", "--resume=a"]


def test_what_a_run_is_resumed_with_is_taken_down(tmp_path):
    settings = load_train_settings(None, (f"run.root={tmp_path}", "run.name=mine"))
    folder = RunFolder.create(settings)
    for step in (10, 20, 30):
        folder.log(step, {"ppo/kl": 0.1})
    folder.close()
    folder.checkpoints.mkdir()
    (folder.checkpoints / ".latest.pt.1234.tmp").write_text("half of a checkpoint, by a process that was killed")
    longer = load_train_settings(folder.path / "config.yaml", ("ppo.agent_steps=7",))
    again = RunFolder.reopen(folder.path, 20, longer)
    again.log(25, {"ppo/kl": 0.2})
    again.close()
    record = json.loads((folder.path / "record.json").read_text())
    assert record["config_sha256"] == config_hash(settings)
    [resumed] = record["resumed"]
    assert resumed["agent_steps"] == 20
    assert resumed["config_sha256"] == config_hash(longer) != config_hash(settings)
    assert resumed["changed"] == {"ppo.agent_steps": [settings.ppo.agent_steps, 7]}
    rows = [json.loads(line) for line in (folder.path / "metrics.jsonl").read_text().splitlines()]
    assert [row["agent_steps"] for row in rows] == [10, 20, 25]
    assert not list(folder.checkpoints.iterdir())


def test_what_a_run_is_resumed_with_stays_at_the_next_resumption(tmp_path, caplog):
    settings = load_train_settings(None, (f"run.root={tmp_path}", "run.name=mine"))
    folder = RunFolder.create(settings)
    folder.close()
    caplog.set_level("INFO")
    for override in ("ppo.agent_steps=7", "ppo.clip=0.3"):
        RunFolder.reopen(folder.path, 0, load_train_settings(folder.path / "config.yaml", (override,))).close()
    kept = load_train_settings(folder.path / "config.yaml")
    assert (kept.ppo.agent_steps, kept.ppo.clip) == (7, 0.3)
    assert kept.model_copy(update={"ppo": settings.ppo}) == settings
    RunFolder.reopen(folder.path, 0, kept).close()
    resumed = json.loads((folder.path / "record.json").read_text())["resumed"]
    assert [session["changed"] for session in resumed] == [
        {"ppo.agent_steps": [settings.ppo.agent_steps, 7]}, {"ppo.clip": [settings.ppo.clip, 0.3]}, {},
    ]  # fmt: skip
    assert "keeps what was changed: ppo.clip" in caplog.text


def test_a_damaged_record_is_named(tmp_path):
    settings = load_train_settings(None, (f"run.root={tmp_path}", "run.name=mine"))
    folder = RunFolder.create(settings)
    folder.close()
    (folder.path / "record.json").write_text("{")
    with pytest.raises(InputError, match=r"record\.json: cannot be read as JSON.*mend or delete it"):
        RunFolder.reopen(folder.path, 0, settings)


def test_the_folder_names_no_host(tmp_path):
    folder = RunFolder.create(load_train_settings(None, (f"run.root={tmp_path}",)))
    folder.close()
    assert [Path(path).name for path in (folder.path / "tensorboard").iterdir()] == [
        "events.out.tfevents.000000000000.imagine"
    ]


def test_the_newest_checkpoints_are_kept_and_those_of_a_given_up_future_too(tmp_path):
    settings = load_train_settings(Path("smoke"), (f"run.root={tmp_path}", "run.keep_checkpoints=2"))
    folder = RunFolder.create(settings)
    whole = Trainer(settings).checkpoint()
    for steps in (100, 200, 300, 400, 150):  # the last of a run that went on from an earlier one
        folder.save(dataclasses.replace(whole, agent_steps={"imitation": 0, "ppo": steps}))
    folder.close()
    kept = sorted(path.stem for path in folder.checkpoints.glob("step-*.pt"))
    assert kept == ["step-000000150", "step-000000300", "step-000000400"]
