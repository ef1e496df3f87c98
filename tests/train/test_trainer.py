import copy
import json
import os
import shutil
import signal
import threading
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from imagine.core.errors import InputError
from imagine.sim import level as sim_level
from imagine.sim.exploration import Exploration
from imagine.train import trainer
from imagine.train.checkpoint import actor_of, load_checkpoint
from imagine.train.evaluation import evaluate
from imagine.train.learner import Learner
from imagine.train.networks import Actor
from imagine.train.policies import load_policy
from imagine.train.ppo import update
from imagine.train.rollout import collect
from imagine.train.run import train
from imagine.train.run_folder import RunFolder
from imagine.train.settings import load_train_settings
from imagine.train.tracking.level_groups import MOST_FILES
from imagine.train.trainer import Trainer

TINY = (
    "env.worlds=2", "env.episode_ticks=40", "env.observation.view_cells=16", "env.observation.lidar_sectors=16",
    "imitation.agent_steps=256", "ppo.agent_steps=512", "run.threads=1",
)  # fmt: skip


def overrides(root, *more):
    return (*TINY, f"run.root={root}", *more)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    root = tmp_path_factory.mktemp("runs")
    reports = []
    result = train(Path("smoke"), overrides(root, "run.final_episodes=1"), report=reports.append)
    return result, reports


def test_a_run_goes_through_both_phases_and_leaves_everything_behind(finished):
    result, reports = finished
    assert result.finished
    assert [report.phase for report in reports] == ["imitation"] * 2 + ["ppo"] * 4
    assert result.agent_steps == 256 + 512
    assert all(np.isfinite(list(report.numbers.values())).all() for report in reports)
    assert reports[-1].coverage > 0.1
    rows = [json.loads(line) for line in (result.folder / "metrics.jsonl").read_text().splitlines()]
    assert [row["agent_steps"] for row in rows] == [128 * (i + 1) for i in range(6)]
    assert any((result.folder / "tensorboard").iterdir())
    assert load_train_settings(result.folder / "config.yaml").env.worlds == 2
    record = json.loads((result.folder / "record.json").read_text())
    assert record["seed"] == 0
    assert record["packages"]["torch"].startswith("2.")
    assert len(record["config_sha256"]) == 64
    assert [row["level"] for row in json.loads((result.folder / "evaluation.json").read_text())["rows"]] == ["0", "1"]
    assert {"latest.pt", "imitated.pt", "final.pt"} <= {path.name for path in (result.folder / "checkpoints").iterdir()}


def test_equal_seeds_give_equal_runs_and_other_seeds_others(finished, tmp_path):
    first = load_checkpoint(finished[0].folder)
    again = load_checkpoint(train(Path("smoke"), overrides(tmp_path)).folder)
    other = load_checkpoint(train(Path("smoke"), overrides(tmp_path, "run.name=other", "run.seed=1")).folder)
    assert all(torch.equal(value, again.actor[name]) for name, value in first.actor.items())
    assert not torch.equal(first.actor["mean.weight"], other.actor["mean.weight"])


def curve(folder):
    """Return a run's metrics, but for times and memory."""
    rows = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    return [{k: v for k, v in row.items() if k.split("/")[0] not in ("time", "speed", "memory")} for row in rows]


def test_sigterm_saves_and_the_resumed_run_goes_on_from_there(tmp_path):
    def terminate(report):
        if report.phase == "ppo" and report.phase_steps >= 256:
            os.kill(os.getpid(), signal.SIGTERM)

    stopped = train(Path("smoke"), overrides(tmp_path), report=terminate)
    assert not stopped.finished
    assert stopped.agent_steps == 256 + 256
    with (stopped.folder / "metrics.jsonl").open("a") as file:
        file.write('{"agent_steps": 99999}\n{"cut sho')
    reports = []
    copy = tmp_path / "copy"
    shutil.copytree(stopped.folder, copy)
    resumed = train(None, resume=stopped.folder, report=reports.append)
    assert resumed.finished
    assert [report.agent_steps for report in reports] == [640, 768]
    rows = [json.loads(line)["agent_steps"] for line in (resumed.folder / "metrics.jsonl").read_text().splitlines()]
    assert rows == [128 * (i + 1) for i in range(6)]
    train(None, resume=copy)
    straight = train(Path("smoke"), overrides(tmp_path, "run.name=straight"))
    for other in (copy, straight.folder):
        assert curve(other) == curve(resumed.folder)
        one, two = load_checkpoint(resumed.folder), load_checkpoint(other)
        assert all(torch.equal(value, two.actor[name]) for name, value in one.actor.items())
        assert all(torch.equal(value, two.critic[name]) for name, value in one.critic.items())


def test_a_run_stopped_while_it_imitates_begins_anew_and_comes_to_the_same(tmp_path, finished):
    def terminate(report):
        os.kill(os.getpid(), signal.SIGTERM)

    stopped = train(Path("smoke"), overrides(tmp_path), report=terminate)
    assert not stopped.finished
    assert not stopped.checkpoint.exists()
    resumed = train(None, resume=stopped.folder)
    assert curve(resumed.folder) == curve(finished[0].folder)


def test_a_restored_learner_learns_exactly_as_the_one_that_was_saved(finished):
    checkpoint = load_checkpoint(finished[0].folder)
    trainer = Trainer(checkpoint.settings, checkpoint)
    rollout, _ = collect(trainer.env, trainer._observation, trainer.learner.actor, 8, trainer.learner.generator)
    outcomes = []
    for _ in range(2):
        learner = Learner.create(checkpoint.settings)
        learner.restore(checkpoint)
        update(learner.actor, learner.critic, learner.ppo, rollout, checkpoint.settings.ppo, learner.generator)
        outcomes.append((learner.actor.state_dict(), learner.critic.state_dict(), learner.rng.random()))
    for first, second in zip(outcomes[0][:2], outcomes[1][:2], strict=True):
        assert all(torch.equal(value, second[name]) for name, value in first.items())
    assert outcomes[0][2] == outcomes[1][2]
    assert not torch.equal(outcomes[0][0]["mean.weight"], checkpoint.actor["mean.weight"])


def test_a_longer_run_is_asked_for_at_resume(finished, tmp_path):
    copy = tmp_path / "run"
    shutil.copytree(finished[0].folder, copy)
    result = train(None, ("ppo.agent_steps=640", "run.final_episodes=0"), resume=copy / "checkpoints" / "final.pt")
    assert result.agent_steps == 256 + 640


REHEARSED = ("rehearsal.agent_steps=384", "rehearsal.round_steps=32", "rehearsal.gradient_steps=2")


@pytest.fixture(scope="module")
def rehearsed(tmp_path_factory):
    return train(Path("smoke"), overrides(tmp_path_factory.mktemp("rehearsed"), *REHEARSED))


def test_rehearsal_follows_ppo_and_changes_the_policy_alone(rehearsed):
    rows = [json.loads(line) for line in (rehearsed.folder / "metrics.jsonl").read_text().splitlines()]
    assert rows[-1]["agent_steps"] == 256 + 512 + 384
    assert sum("rehearsal/loss" in row for row in rows) == 3
    before, after = (load_checkpoint(rehearsed.folder / "checkpoints" / name) for name in ("improved.pt", "final.pt"))
    assert not torch.equal(before.actor["mean.weight"], after.actor["mean.weight"])
    assert all(torch.equal(value, after.critic[name]) for name, value in before.critic.items())


def test_a_run_stopped_while_it_rehearses_rehearses_anew_and_comes_to_the_same(rehearsed, tmp_path):
    def terminate(report):
        if report.phase == "rehearsal":
            os.kill(os.getpid(), signal.SIGTERM)

    stopped = train(Path("smoke"), overrides(tmp_path, *REHEARSED), report=terminate)
    assert not stopped.finished
    resumed = train(None, resume=stopped.folder)
    assert resumed.finished
    one, two = load_checkpoint(rehearsed.folder), load_checkpoint(resumed.folder)
    assert all(torch.equal(value, two.actor[name]) for name, value in one.actor.items())
    assert curve(resumed.folder) == curve(rehearsed.folder)


def test_a_rehearsed_run_that_is_to_be_longer_goes_back_to_ppo_and_rehearses_again(rehearsed, tmp_path):
    copy = tmp_path / "run"
    shutil.copytree(rehearsed.folder, copy)
    phases = []
    with pytest.raises(InputError, match=r"improved\.pt"):
        train(None, ("ppo.agent_steps=640",), resume=copy)
    improved = copy / "checkpoints" / "improved.pt"
    longer = train(None, ("ppo.agent_steps=640",), resume=improved, report=lambda report: phases.append(report.phase))
    assert phases == ["ppo"] + ["rehearsal"] * 3
    assert longer.agent_steps == 256 + 640 + 384


def test_a_rehearsed_policy_is_not_rehearsed_on(rehearsed, tmp_path):
    copy = tmp_path / "run"
    shutil.copytree(rehearsed.folder, copy)
    with pytest.raises(InputError, match=r"^rehearsal\.agent_steps: .*improved\.pt"):
        train(None, ("rehearsal.agent_steps=768",), resume=copy)


def test_what_is_learned_and_what_is_flown_may_decide_at_other_intervals(tmp_path, monkeypatch):
    flown_in = []
    monkeypatch.setattr(
        trainer, "Exploration", lambda env, seed: flown_in.append(env.action.decision_ticks) or Exploration(env, seed)
    )
    run = train(Path("smoke"), overrides(tmp_path, *REHEARSED, "ppo.decision_ticks=3"))
    assert flown_in == [3, 1]
    assert load_policy(run.folder).env.action.decision_ticks == 1


def test_a_run_is_never_overwritten(finished, tmp_path):
    with pytest.raises(InputError, match=r"there is a run of this name; resume it"):
        train(Path("smoke"), overrides(finished[0].folder.parent))


def test_resume_takes_no_second_configuration(finished):
    with pytest.raises(InputError, match="not both"):
        train(Path("smoke"), resume=finished[0].folder)


def test_another_network_is_named(finished, tmp_path):
    copy = tmp_path / "run"
    shutil.copytree(finished[0].folder, copy)
    with pytest.raises(InputError, match=r"made for another network: network.hidden is 128 in it, 64 here"):
        train(None, ("network.hidden=64",), resume=copy)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("ppo.clipp=0.2", r"unknown key 'ppo.clipp'; did you mean 'clip'"),
        ("ppo.clip=2", r"ppo.clip: "),
        ("run.name=../elsewhere", r"run.name: "),
        ("env.levels=[]", r"env.levels: "),
    ],
)
def test_bad_settings_are_named(tmp_path, override, message):
    with pytest.raises(InputError, match=message):
        train(None, overrides(tmp_path, override))
    assert not list(tmp_path.iterdir())


def test_the_packaged_configurations_are_valid():
    default = load_train_settings(None)
    assert default.env.drones == 3
    assert set(default.env.levels) >= set("0123456")
    assert load_train_settings(Path("smoke")).ppo.agent_steps < 10_000


def test_a_file_of_ones_own_names_its_line(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(yaml.safe_dump({"run": {"name": "a"}, "ppo": {"gama": 0.9}}, sort_keys=False))
    with pytest.raises(InputError, match=r"mine\.yaml:4: unknown key 'ppo\.gama'; did you mean 'gamma'"):
        train(path)


def test_the_final_evaluation_does_not_end_where_training_episodes_do(tmp_path):
    """It is what `imagine evaluate` says of the policy, whatever the training's stop_coverage."""
    short = ("env.levels=['0']", "env.stop_coverage=0.3", "imitation.agent_steps=0", "run.final_episodes=1")
    result = train(Path("smoke"), overrides(tmp_path, *short))
    told = json.loads((result.folder / "evaluation.json").read_text())["rows"]
    rows = evaluate(load_policy(result.folder), ("0",), drones=(2,), episodes=1, seed=1)
    assert told == json.loads(json.dumps(rows))
    assert rows[0]["coverage_mean"] > 0.3


def test_a_stop_in_the_final_evaluation_is_heard(tmp_path, caplog):
    """What was trained is finished and kept; its evaluation ends before the next level."""
    settings = load_train_settings(Path("smoke"), overrides(tmp_path, "run.final_episodes=1", "ppo.agent_steps=128"))
    stop, folder = threading.Event(), RunFolder.create(settings)
    trainer = Trainer(settings)
    save = folder.save

    def save_then_stop(checkpoint, name=None):
        latest = save(checkpoint, name)
        if name == "final":
            stop.set()
        return latest

    folder.save = save_then_stop
    result = trainer.run(folder, lambda report: None, stop)
    folder.close()
    assert result.finished
    assert not (folder.path / "evaluation.json").exists()
    assert "evaluation was broken off" in caplog.text


@pytest.mark.parametrize("given", ["nowhere", "nowhere/checkpoints/latest.pt", "."])
def test_a_run_to_go_on_with_that_is_none_is_named(tmp_path, given):
    with pytest.raises(InputError, match=r"--resume .*: no run to go on with: give a run's folder"):
        train(None, resume=tmp_path / given)


def test_an_unknown_configuration_is_named_with_those_there_are(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match="no packaged configuration; these are curriculum, default, parallel, smoke"):
        train(Path("smok"))


def test_the_files_of_all_lessons_decide_how_episodes_are_grouped(tmp_path):
    level = Path(sim_level.__file__).parent / "levels" / "0.yaml"
    files = [tmp_path / f"plan{number}.yaml" for number in range(MOST_FILES + 1)]
    for file in files:
        shutil.copy(level, file)
    lessons = json.dumps([{"levels": [str(file) for file in files]}])
    settings = load_train_settings(
        Path("smoke"), overrides(tmp_path, "curriculum.mode=parallel", f"curriculum.lessons={lessons}")
    )
    assert Trainer(settings).episodes.group_of("plan3") == "files"


CHOICE = (
    "network.head=choice", "env.observation.frontiers=4", "network.choice_momentum=5", "ppo.choice_momentum=1"
)  # fmt: skip


def test_a_choice_is_held_to_by_other_weights_while_it_is_learned_and_when_it_is_flown(tmp_path, monkeypatch):
    held = {}

    def look(report):
        held[report.phase] = run.learner.actor.choice.momentum

    def look_last(*arguments):
        held["flown"] = run.learner.actor.choice.momentum

    monkeypatch.setattr(trainer, "write_final_evaluation", look_last)
    settings = load_train_settings(Path("smoke"), (*overrides(tmp_path, *CHOICE), "run.final_episodes=1"))
    run = Trainer(settings)
    run.run(RunFolder.create(settings), look, threading.Event())
    assert held == {"imitation": 1.0, "ppo": 1.0, "flown": 5.0}
    assert actor_of(load_checkpoint(tmp_path / settings.run.name), "it").choice.momentum == 5.0


def test_in_rehearsal_a_choice_is_held_to_as_in_flight_by_teacher_and_student(tmp_path, monkeypatch):
    held, copied = {}, copy.deepcopy

    def look(report):
        held[report.phase] = run.learner.actor.choice.momentum

    def look_at_copies(thing, *more):
        if isinstance(thing, Actor):
            held["teacher"] = thing.choice.momentum
        return copied(thing, *more)

    monkeypatch.setattr(trainer.copy, "deepcopy", look_at_copies)
    settings = load_train_settings(Path("smoke"), overrides(tmp_path, *REHEARSED, *CHOICE))
    run = Trainer(settings)
    run.run(RunFolder.create(settings), look, threading.Event())
    assert held == {"imitation": 1.0, "ppo": 1.0, "teacher": 5.0, "rehearsal": 5.0}


@pytest.mark.parametrize("key", ["ppo.decision_ticks=2", "ppo.choice_momentum=3"])
def test_a_run_goes_on_learning_as_it_began(finished, tmp_path, key):
    folder = tmp_path / "run"
    shutil.copytree(finished[0].folder, folder)
    name = key.partition("=")[0].replace(".", r"\.")
    with pytest.raises(InputError, match=rf"^checkpoint: learned with {name} .*leave it as it was, or begin a new run"):
        train(None, (key, "ppo.agent_steps=640"), resume=folder)


def test_a_memory_that_counts_other_decisions_in_flight_is_refused():
    with pytest.raises(InputError, match=r"ppo\.decision_ticks 4 is not env\.action\.decision_ticks, 1: .*null"):
        load_train_settings(Path("smoke"), ("network.memory=gru", "ppo.decision_ticks=4"))
