import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from imagine.core.observation_spec import ObservationSpec
from imagine.train.networks import Actor, Critic, NetworkSettings, entropy, log_probability
from imagine.train.networks.encoders import LidarEncoder


def inputs(spec, batch):
    return [torch.rand((batch, *shape)) for shape in spec.shapes.values()]


@settings(max_examples=10, deadline=None)
@given(
    st.integers(4, 24).map(lambda half: 2 * half),
    st.integers(4, 90),
    st.sampled_from([2, 3]),
    st.integers(1, 5),
    st.integers(0, 3),
    st.booleans(),
    st.sampled_from(["off", "self", "team"]),
)
def test_any_observation_spec_gets_its_networks(cells, sectors, action_size, batch, peers, placed, visits):
    spec = ObservationSpec(
        view_cells=cells, lidar_sectors=sectors, peers=peers, position=placed, heading=placed, visits=visits
    )
    small = NetworkSettings(view_channels=(4, 4, 4), critic_channels=(4, 4), lidar_channels=2, hidden=16)
    mean = Actor(small, spec, action_size)(*inputs(spec, batch))
    assert mean.shape == (batch, action_size)
    assert mean.abs().max() < 1.0
    seen = {**dict(zip(spec.shapes, inputs(spec, batch), strict=True)), "level": torch.rand(batch, 5, 32, 32)}
    assert Critic(small, spec)(seen).shape == (batch,)


def test_an_untrained_policy_almost_stands_still():
    spec = ObservationSpec()
    assert Actor(NetworkSettings(), spec, 2)(*inputs(spec, 16)).abs().max() < 0.1


def test_actor_and_critic_share_no_weights():
    spec = ObservationSpec()
    actor, critic = Actor(NetworkSettings(), spec, 2), Critic(NetworkSettings(), spec)
    assert not {id(p) for p in actor.parameters()} & {id(p) for p in critic.parameters()}


def test_the_lidar_encoder_sees_no_seam():
    """Turning the scan by whole strides turns the feature maps, wherever the turn starts."""
    convolutions = LidarEncoder("conv2", 64, 4, 8).convolutions
    scan = torch.rand(1, 1, 64)
    turned = convolutions(scan.roll(20, dims=2))
    torch.testing.assert_close(turned, convolutions(scan).roll(5, dims=2))


def test_densities_are_those_of_a_gaussian():
    actions, mean, log_std = torch.randn(5, 3), torch.randn(5, 3), torch.tensor([-1.0, 0.0, 0.5])
    normal = torch.distributions.Normal(mean, log_std.exp())
    torch.testing.assert_close(log_probability(actions, mean, log_std), normal.log_prob(actions).sum(dim=1))
    assert entropy(log_std).item() == pytest.approx(normal.entropy().sum(dim=1)[0].item(), rel=1e-6)
