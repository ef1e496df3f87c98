import numpy as np
import pytest
import yaml

from imagine.core.errors import InputError
from imagine.train.study.folder import StudyFolder
from imagine.train.study.plan import plan_trials, total_steps
from imagine.train.study.settings import STUDIES, StudySettings, load_study_settings
from imagine.train.study.space import Distribution


def study(**changes):
    return StudySettings(**{"name": "s", "base": "smoke", **changes})


def test_every_combination_of_variants_grid_and_repeats_is_a_trial_of_its_own():
    trials = plan_trials(
        study(
            variants=[
                {"name": "near", "set": ["env.radio.range_m=2"]},
                {"name": "far", "set": ["env.radio.range_m=9"]},
            ],
            parameters={"grid": {"env.drones": [1, 2, 3], "env.levels": [["0"], ["0", "1"]]}},
            repeats=2,
            seed=5,
            resources={"cpus": 2},
        )
    )
    assert len(trials) == len({trial.name for trial in trials}) == 2 * 3 * 2 * 2
    told = {
        (t.parameters["variant"], t.settings.env.radio.range_m, t.settings.env.drones, t.settings.env.levels, t.seed)
        for t in trials
    }
    assert told == {
        (variant, reach, drones, levels, seed)
        for variant, reach in (("near", 2.0), ("far", 9.0))
        for drones in (1, 2, 3)
        for levels in (("0",), ("0", "1"))
        for seed in (5, 6)
    }
    assert all(trial.settings.run.seed == trial.seed and trial.settings.run.threads == 2 for trial in trials)
    assert {trial.seed for trial in trials[:12]} == {5}  # a study that is cut short has whole repeats
    assert trials[7].condition == "far, env.drones=1, env.levels=0+1"


def test_draws_are_of_the_space_the_same_for_the_same_seed_and_for_all_repeats():
    wanted = {
        "search": "random",
        "samples": 20,
        "repeats": 2,
        "parameters": {
            "space": {
                "ppo.actor_lr": {"loguniform": [1e-5, 1e-3]},
                "ppo.epochs": {"randint": [1, 3]},
                "network.hidden": {"choice": [64, 128]},
                "ppo.clip": {"uniform": [0.1, 0.3]},
            }
        },
    }
    trials = plan_trials(study(**wanted))
    assert len(trials) == 40
    rates = np.array([trial.settings.ppo.actor_lr.start for trial in trials[:20]])
    assert ((rates >= 1e-5) & (rates <= 1e-3)).all()
    assert len(set(rates)) == 20
    assert 4 <= (rates < 1e-4).sum() <= 16  # half of a loguniform's draws lie below the geometric middle
    assert {trial.settings.ppo.epochs for trial in trials} == {1, 2, 3}
    assert {trial.settings.network.hidden for trial in trials} == {64, 128}
    assert [t.parameters for t in trials[:20]] == [t.parameters for t in trials[20:]]
    assert [t.settings for t in plan_trials(study(**wanted))] == [t.settings for t in trials]
    assert plan_trials(study(**wanted, seed=1))[0].parameters != trials[0].parameters


def test_a_study_stops_its_trials_at_so_many_steps_of_both_phases_without_rehearsal():
    rehearsed = ["rehearsal.agent_steps=5000"]
    assert total_steps(plan_trials(study(set=rehearsed))[0].settings) > 5000
    for steps, imitated in ((2000, 512), (300, 300)):
        settings = plan_trials(study(set=rehearsed, stop={"agent_steps": steps}))[0].settings
        assert (settings.imitation.agent_steps, settings.ppo.agent_steps) == (imitated, steps - imitated)
        assert total_steps(settings) == steps


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"parameters": {"grid": {"ppo.clipp": [0.1]}}}, r"ppo\.clipp=0\.1: .*unknown key 'ppo\.clipp'.*'clip'"),
        ({"parameters": {"grid": {"ppo.clip": [0.1, 2]}}}, r"study s: ppo\.clip=2: .*ppo\.clip: "),
        ({"variants": [{"name": "a", "set": ["env.drone=2"]}]}, r"study s: a: .*did you mean 'drones'"),
        ({"base": "nowhere"}, "nowhere"),
        (
            {"parameters": {"grid": {"ppo.epochs": list(range(1, 200)), "run.keep_checkpoints": list(range(1, 60))}}},
            "10000",
        ),
    ],
)
def test_a_wrong_setting_of_any_trial_is_refused_before_the_first_starts(changes, message):
    with pytest.raises(InputError, match=message):
        plan_trials(study(**changes))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("name: s\nrepeat: 2\n", r"mine\.yaml:2: unknown key 'repeat'; did you mean 'repeats'"),
        ("name: s\nparameters: {grit: {}}\n", r"unknown key 'parameters\.grit'; did you mean 'grid'"),
        (
            "name: s\nparameters: {grid: {run.seed: [1, 2]}}\n",
            "run.seed cannot be set by a study: use seed and repeats",
        ),
        ("name: s\nparameters: {space: {ppo.clip: {uniform: [0.1, 0.2]}}}\n", "say random or asha"),
        ("name: s\nsamples: 3\n", "no parameters.space to draw from"),
        ("name: s\nvariants: [{name: a}, {name: a}]\n", "two are called a"),
        ("name: s\nmetric: speed\n", "metric"),
        ("name: ../s\n", "name"),
        ("repeats: 2\n", "'name' is missing"),
        ("name: s\nparameters: {grid: {ppo.clip: []}}\n", "ppo.clip has no values"),
        ("name: s\nsearch: random\nparameters: {space: {ppo.clip: {uniform: [0.2, 0.1]}}}\n", "less than the second"),
        ("name: s\nsearch: random\nparameters: {space: {ppo.clip: {uniform: [0, 1], choice: [1]}}}\n", "exactly one"),
    ],
)
def test_a_wrong_study_is_refused_with_file_and_key(tmp_path, text, message):
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=message):
        load_study_settings(path)


def test_numbers_in_scientific_notation_are_numbers(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("name: s\nbase: smoke\nparameters: {grid: {ppo.actor_lr: [1e-4, 3e-4]}}\n")
    assert [t.settings.ppo.actor_lr.start for t in plan_trials(load_study_settings(path))] == [1e-4, 3e-4]


def test_a_base_beside_the_study_is_taken(tmp_path):
    (tmp_path / "base.yaml").write_text("env: {drones: 5}\n")
    (tmp_path / "mine.yaml").write_text("name: s\nbase: base.yaml\n")
    assert plan_trials(load_study_settings(tmp_path / "mine.yaml"))[0].settings.env.drones == 5


def test_whole_numbers_are_drawn_with_both_ends():
    drawn = Distribution(randint=(2, 4))
    rng = np.random.default_rng(0)
    assert {drawn.draw(rng) for _ in range(100)} == {2, 3, 4}


def test_a_changed_study_is_not_resumed_and_a_longer_one_is(tmp_path):
    def planned(**changes):
        grown = study(root=str(tmp_path), parameters={"grid": {"env.drones": [1, 2]}}, **changes)
        return grown, plan_trials(grown)

    first, trials = planned()
    folder = StudyFolder(first)
    with pytest.raises(InputError, match="no study to resume"):
        folder.check_known(trials)
    with folder.locked():
        folder.write(first, trials)
        with pytest.raises(InputError, match="runs this study"), folder.locked():
            pass
    folder.check_known(trials)
    folder.check_known(planned(repeats=2)[1])
    with pytest.raises(InputError, match="there is a study of this name"):
        folder.check_new()
    with pytest.raises(InputError, match="has other settings now"):
        folder.check_known(planned(set=["ppo.clip=0.3"])[1])
    with pytest.raises(InputError, match="is not in it any more"):
        folder.check_known(trials[:1])


@pytest.mark.parametrize("name", sorted(path.stem for path in STUDIES.glob("*.yaml")))
def test_every_trial_of_a_packaged_study_is_valid_and_it_says_what_it_asks(name):
    text = (STUDIES / f"{name}.yaml").read_text("utf-8")
    comment = [line for line in text.splitlines() if line.startswith("#")]
    assert "?" in " ".join(comment)
    trials = plan_trials(load_study_settings(STUDIES / f"{name}.yaml"))
    assert f"{len(trials)} trials" in " ".join(line.lstrip("# ") for line in comment)
    assert len({yaml.safe_dump(trial.settings.model_dump(mode="json")) for trial in trials}) == len(trials)
    for trial in trials:
        assert trial.settings.run.final_episodes >= 20
        assert not trial.settings.env.action.turns or trial.settings.env.observation.axes == "heading"


def test_the_papers_experiments_are_there():
    assert {path.stem for path in STUDIES.glob("*.yaml")} >= {
        "paradigms", "communication", "kill_on_collision", "curriculum", "actions_observations", "lidar_convolution",
        "rnn", "asha",
    }  # fmt: skip


def test_lessons_that_no_episode_could_pass_are_refused_before_any_trial_starts():
    lessons = 'curriculum.lessons=[{levels: ["0"], pass_area: 0.98}]'
    with pytest.raises(InputError, match=r"pass_area is 0.98, but an episode ends at env.stop_coverage, 0.9"):
        plan_trials(study(set=["curriculum.mode=sequential", lessons, "env.stop_coverage=0.9"]))


def test_values_of_a_parameter_may_be_set_on_the_command_line():
    wanted = ("repeats=1", 'parameters.grid.env.levels=[["4"], ["6"]]', "parameters.grid.env.drones=[2]")
    trials = plan_trials(load_study_settings(STUDIES / "paradigms.yaml", wanted))
    assert {(t.settings.env.levels, t.settings.env.drones) for t in trials} == {(("4",), 2), (("6",), 2)}
    drawn = ("parameters.space.ppo.actor_lr={uniform: [0.5, 0.6]}", "samples=2", "repeats=1")
    rates = [t.settings.ppo.actor_lr.start for t in plan_trials(load_study_settings(STUDIES / "asha.yaml", drawn))]
    assert all(0.5 <= rate <= 0.6 for rate in rates)
