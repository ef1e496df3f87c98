"""What learns is on one device: nothing of the processor's memory slips into what a GPU computes.

There need be no GPU for that. `Apart` tensors say that they are on the device `meta`, and hold their numbers in the
processor's memory: torch's own operations compute with them, and refuse to mix them with tensors that are not.
"""

import math

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map

from imagine.core.observation_spec import ObservationSpec
from imagine.sim.exploration import Exploration
from imagine.sim.exploration_settings import ExplorationSettings
from imagine.train.gae import advantages_and_returns
from imagine.train.networks import Actor, Critic, NetworkSettings
from imagine.train.ppo import Optimisers, PpoSettings, update
from imagine.train.rollout import collect
from imagine.train.values import values_of

AWAY = torch.device("meta")


class Apart(torch.Tensor):
    """A tensor on another device."""

    @staticmethod
    def __new__(cls, held):
        return torch.Tensor._make_wrapper_subclass(
            cls, held.shape, strides=held.stride(), storage_offset=held.storage_offset(), dtype=held.dtype,
            device=AWAY, requires_grad=held.requires_grad,
        )  # fmt: skip

    def __init__(self, held):
        self.held = held.detach()

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):
        return run(func, args, kwargs or {})


def run(func, args, kwargs):
    """Compute where the numbers are; refuse to mix, but for what torch lets pass: indices, scalars, copies."""
    name = func.overloadpacket._qualified_op_name
    flat, _ = tree_flatten((args, kwargs))
    tensors = [value for value in flat if isinstance(value, torch.Tensor)]
    away = [value for value in tensors if isinstance(value, Apart)]
    wanted = kwargs.get("device")
    copies = name in ("aten::_to_copy", "aten::copy_")
    indexes = name in ("aten::index", "aten::index_put_", "aten::index_put")
    if away and not copies and not indexes:
        others = [value for value in tensors if not isinstance(value, Apart) and value.dim() > 0]
        assert not others, f"{name} mixes devices: {[tuple(value.shape) for value in others]} are left behind"
    goes = wanted is not None and torch.device(wanted).type == AWAY.type
    stays = wanted is not None and not goes
    kwargs = {**kwargs, **({"device": torch.device("cpu")} if goes else {})}
    unwrap = lambda value: value.held if isinstance(value, Apart) else value  # noqa: E731
    args, kwargs = tree_map(unwrap, args), tree_map(unwrap, kwargs)
    out = func(*args, **kwargs)
    if name == "aten::_local_scalar_dense" or stays:
        return out
    if func._schema.is_mutable and isinstance(flat[0], torch.Tensor):
        return flat[0]
    if goes or away:
        return tree_map(lambda value: Apart(value) if isinstance(value, torch.Tensor) else value, out)
    return out


class Machine(TorchDispatchMode):
    """Makes tensors on the other device, and moves them there."""

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        return run(func, args, kwargs or {})


def moved(network):
    for module in network.modules():
        for name, weight in list(module.named_parameters(recurse=False)):
            setattr(module, name, torch.nn.Parameter(Apart(weight.detach())))
        for name, buffer in list(module.named_buffers(recurse=False)):
            setattr(module, name, Apart(buffer))
    return network


def test_mixing_is_noticed():
    with Machine():
        away = torch.zeros(3, device=AWAY)
        assert isinstance(away + 1.0, Apart)
        assert isinstance(torch.ones(3).to(AWAY), Apart)
        assert not isinstance(away.cpu(), Apart)
        with pytest.raises(AssertionError, match="mixes devices"):
            away + torch.ones(3)


@pytest.mark.parametrize("head", ["gaussian", "choice"])
def test_rollouts_and_values_stay_where_the_networks_are(head):
    spec = ObservationSpec(view_cells=16, lidar_sectors=16, frontiers=4)
    settings = NetworkSettings(head=head, hidden=16, view_channels=(4, 4), critic_channels=(4, 4))
    torch.manual_seed(0)
    actor, critic = moved(Actor(settings, spec, 2)), moved(Critic(settings, spec))
    env = Exploration(ExplorationSettings(levels=("1",), worlds=2, drones=2, observation=spec), seed=1)
    with Machine():
        rollout, _ = collect(env, env.reset(), actor, 4, torch.Generator().manual_seed(0))
        kept = (rollout.actions, rollout.rewards, rollout.dones, rollout.truncated, *rollout.observations.values())
        assert all(isinstance(tensor, Apart) for tensor in kept)
        values, last = values_of(actor, critic, rollout, 8)
        advantages, _ = advantages_and_returns(
            rollout.rewards, values, rollout.dones, last, 0.99, 0.95, rollout.truncated
        )
        assert isinstance(advantages, Apart)


@pytest.mark.parametrize("head", ["gaussian", "choice"])
def test_an_update_computes_where_the_networks_are(head):
    """With a shared encoder, whose losses are summed: of two networks each learns in a thread of its own."""
    spec = ObservationSpec(view_cells=16, lidar_sectors=16, frontiers=4)
    settings = NetworkSettings(head=head, encoder="shared", hidden=16, view_channels=(4, 4), critic_channels=(4, 4))
    torch.manual_seed(0)
    actor, critic = moved(Actor(settings, spec, 2)), moved(Critic(settings, spec))
    optimisers = Optimisers.__new__(Optimisers)  # Adam's fused kernels know no such device
    optimisers.actor = torch.optim.SGD(actor.parameters(), lr=0.1, foreach=False)
    optimisers.critic = torch.optim.SGD(critic.parameters(), lr=0.1, foreach=False)
    env = Exploration(ExplorationSettings(levels=("1",), worlds=2, drones=2, observation=spec), seed=1)
    generator = torch.Generator().manual_seed(0)
    before = critic.value.weight.held.clone()
    with Machine():
        rollout, _ = collect(env, env.reset(), actor, 8, generator)
        numbers = update(actor, critic, optimisers, rollout, PpoSettings(minibatch=16, precision="float32"), generator)
    assert all(math.isfinite(number) for number in numbers.values())
    assert not torch.equal(critic.value.weight.held, before)
