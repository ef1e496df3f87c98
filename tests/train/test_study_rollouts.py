"""Rollouts by workers of a real Ray equal those of one process."""

from importlib.util import find_spec

import pytest
import torch

from imagine.core.errors import InputError
from imagine.sim.exploration import Exploration
from imagine.train.learner import Learner
from imagine.train.ppo import update
from imagine.train.rollout import Recall, collect
from imagine.train.rollout_source import OwnRollouts
from imagine.train.rollout_workers import RolloutWorkerLost, RolloutWorkers, rollout_workers
from imagine.train.settings import load_train_settings
from imagine.train.study.cluster import ray_connection

if find_spec("ray") is None:
    pytest.skip("rollout workers need the extra 'study'", allow_module_level=True)

pytestmark = pytest.mark.timeout(900)  # processes start slowly where other work has the cores

SETTINGS = load_train_settings(
    None,
    (
        "env.worlds=3", "env.drones=2", 'env.levels=["1"]', "env.level_weights=null", "env.stagger=false",
        "env.episode_ticks=30", "env.observation.view_cells=16", "env.observation.lidar_sectors=16", "ppo.minibatch=64",
        "ppo.rollout_steps=20", "ppo.precision=float32", "env.action.decision_ticks=1",
    ),
)  # fmt: skip


@pytest.fixture(scope="module")
def flown():
    """Two rollouts and a policy update between them: by one process, by two workers; then a worker is killed."""
    learners = [Learner.create(SETTINGS) for _ in range(2)]
    env = Exploration(SETTINGS.env, 7)
    own = OwnRollouts(env, env.reset(), Recall.nothing(learners[0].actor, 6), SETTINGS.ppo)
    rollouts, lost = {"own": [], "workers": []}, None
    with rollout_workers(SETTINGS.env, 7, SETTINGS.ppo, learners[1].actor, 2) as workers:
        import ray

        for name, source, learner in (("own", own, learners[0]), ("workers", workers, learners[1])):
            for _ in range(2):
                rollout = source.collect(learner.actor, learner.generator)
                rollouts[name].append(rollout)
                update(learner.actor, learner.critic, learner.ppo, rollout, SETTINGS.ppo, learner.generator)
        state = workers.state_dict()
        with pytest.raises(InputError, match="saved with 2 workers, not 3"):
            RolloutWorkers(SETTINGS.env, 7, SETTINGS.ppo, learners[1].actor, 3, state)
        with pytest.raises(InputError, match="4 workers cannot share 3 worlds"):
            RolloutWorkers(SETTINGS.env, 7, SETTINGS.ppo, learners[1].actor, 4)
        ray.kill(workers._workers[1])
        try:
            workers.collect(learners[1].actor, torch.Generator())
        except RolloutWorkerLost as error:
            lost = error
    return rollouts, state, own.state_dict(), lost


def test_workers_fly_what_one_process_flies(flown):
    own, workers = flown[0]["own"], flown[0]["workers"]
    for one, two in zip(own, workers, strict=True):
        assert one.rewards.shape == two.rewards.shape == (20, 6)
        for name in ("rewards", "actions", "log_probs"):
            torch.testing.assert_close(getattr(one, name), getattr(two, name), rtol=1e-3, atol=1e-4)
        assert torch.equal(one.dones, two.dones)
        assert torch.equal(one.alive, two.alive)
        for key, value in one.observations.items():
            torch.testing.assert_close(value, two.observations[key], rtol=1e-3, atol=1e-2)
            torch.testing.assert_close(one.last[key], two.last[key], rtol=1e-3, atol=1e-2)
        assert {e.world: e.coverage for e in two.episodes} == pytest.approx({e.world: e.coverage for e in one.episodes})
    assert sum(len(rollout.episodes) for rollout in own) == 3  # all worlds began again in the second rollout
    assert not torch.equal(own[0].rewards, own[1].rewards)


def test_the_workers_states_are_those_of_the_worlds(flown):
    _, state, own, _ = flown
    places = [place for part in state["workers"] for place in part["env"]["poses"][:, 0, 0].tolist()]
    assert places == own["env"]["poses"][:, 0, 0].tolist()


def test_a_worker_s_death_is_told(flown):
    assert "a rollout worker died" in str(flown[3])


def test_given_noise_is_taken_in_place_of_draws():
    learner = Learner.create(SETTINGS)
    flights = []
    for given in (False, True):
        env = Exploration(SETTINGS.env, 3)
        generator = torch.Generator().manual_seed(5)
        noise = learner.actor.noise(4, 6, generator) if given else None
        flights.append(collect(env, env.reset(), learner.actor, 4, generator, noise=noise)[0])
    assert torch.equal(flights[0].actions, flights[1].actions)
    assert torch.equal(flights[0].rewards, flights[1].rewards)


def test_a_cluster_s_cpus_are_not_chosen():
    with pytest.raises(InputError, match="leave the number out"), ray_connection("127.0.0.1:1", cpus=2):
        pass
