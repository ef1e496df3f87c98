import pytest
import torch

from imagine.core.observation_spec import ObservationSpec
from imagine.sim.exploration import Exploration
from imagine.sim.exploration_settings import ExplorationSettings
from imagine.train.joined_rollouts import joined
from imagine.train.networks import Actor, NetworkSettings
from imagine.train.rollout import Recall, Rollout, collect
from imagine.train.rollout_workers import on_cpu

SPEC = ObservationSpec(view_cells=16, lidar_sectors=16)
SETTINGS = ExplorationSettings(levels=("1",), worlds=2, drones=2, episode_ticks=5, observation=SPEC)


@pytest.mark.parametrize("memory", ["none", "gru"])
def test_worlds_flown_apart_are_a_rollout_like_those_flown_together(memory, monkeypatch):
    """With the same noise, which whoever flies them together would have drawn for all."""
    torch.manual_seed(0)
    actor = Actor(NetworkSettings(memory=memory, hidden=16, memory_size=8, view_channels=(4, 4)), SPEC, 2)
    torch.nn.init.normal_(actor.mean.weight)
    monkeypatch.setattr(torch, "randn", lambda size, generator: torch.full(tuple(size), 0.25))
    generator = torch.Generator()

    def fly(settings, keys):
        env = Exploration(settings, seed=3, world_keys=keys)
        recall = Recall.nothing(actor, env.worlds * env.drones)
        return collect(env, env.reset(), actor, 8, generator, recall=recall, sequence_steps=4)[0]

    whole = fly(SETTINGS, [0, 1])
    alone = SETTINGS.model_copy(update={"worlds": 1})
    again = joined([fly(alone, [0]), fly(alone, [1])])
    for name in ("actions", "log_probs", "rewards", "dones", "alive", "truncated"):
        torch.testing.assert_close(getattr(again, name), getattr(whole, name), rtol=1e-4, atol=1e-5)
    for key, value in whole.observations.items():
        torch.testing.assert_close(again.observations[key], value, rtol=1e-3, atol=1e-3)
        torch.testing.assert_close(again.last[key], whole.last[key], rtol=1e-3, atol=1e-3)
    assert again.observations["views"].flatten(0, 1).is_contiguous(memory_format=torch.channels_last)
    assert len(again.episodes) == len(whole.episodes) == 2
    assert (again.drones, again.sequence_steps) == (whole.drones, whole.sequence_steps)
    torch.testing.assert_close(again.recall.state, whole.recall.state, rtol=1e-4, atol=1e-5)
    assert torch.equal(again.recall.starts, whole.recall.starts)
    if memory == "gru":
        torch.testing.assert_close(again.states, whole.states, rtol=1e-4, atol=1e-5)
        assert torch.equal(again.starts, whole.starts)


def test_all_of_a_rollout_goes_to_another_device():
    agents = Recall(torch.zeros(4, 8), torch.ones(4, dtype=torch.bool))
    steps = torch.zeros(2, 4)
    rollout = Rollout({}, steps, steps, steps, steps.bool(), {"motion": steps}, steps.bool(), recall=agents)
    moved = rollout.to(torch.device("meta"))
    places = (moved.actions, moved.last["motion"], moved.recall.state, moved.recall.starts)
    assert {place.device.type for place in places} == {"meta"}


def test_workers_get_a_copy_and_the_network_that_learns_stays_where_it_is():
    actor = Actor(NetworkSettings(hidden=16, view_channels=(4, 4)), SPEC, 2)
    pairs = list(zip(actor.parameters(), on_cpu(actor).parameters(), strict=True))
    assert all(torch.equal(own, other) and own.data_ptr() != other.data_ptr() for own, other in pairs)
