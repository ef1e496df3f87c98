import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from imagine.train.gae import advantages_and_returns


def slow_advantages(rewards, values, dones, last_values, gamma, lam):
    """The definition: a sum over all later surprises, up to the episode's end, for each step on its own."""
    steps, agents = rewards.shape
    following = np.vstack([values[1:], last_values[None]])
    advantages = np.zeros_like(rewards)
    for agent in range(agents):
        for t in range(steps):
            for k in range(t, steps):
                goes_on = 0.0 if dones[k, agent] else 1.0
                surprise = rewards[k, agent] + gamma * following[k, agent] * goes_on - values[k, agent]
                advantages[t, agent] += (gamma * lam) ** (k - t) * surprise
                if dones[k, agent]:
                    break
    return advantages


@given(st.integers(1, 12), st.integers(1, 3), st.floats(0, 1), st.floats(0, 1), st.integers(0, 2**32 - 1))
def test_equals_the_definition(steps, agents, gamma, lam, seed):
    rng = np.random.default_rng(seed)
    rewards, values = rng.normal(size=(2, steps, agents))
    dones, last = rng.random((steps, agents)) < 0.3, rng.normal(size=agents)
    tensors = [torch.from_numpy(array) for array in (rewards, values, dones, last)]
    advantages, returns = advantages_and_returns(*tensors, gamma, lam)
    np.testing.assert_allclose(advantages, slow_advantages(rewards, values, dones, last, gamma, lam), atol=1e-9)
    np.testing.assert_allclose(returns, advantages + tensors[1], atol=1e-12)


def test_nothing_after_an_episodes_end_counts():
    rewards = torch.tensor([[1.0], [100.0]])
    values = torch.zeros((2, 1))
    dones = torch.tensor([[True], [False]])
    advantages, _ = advantages_and_returns(rewards, values, dones, torch.tensor([50.0]), 0.99, 0.95)
    assert advantages[0].item() == pytest.approx(1.0)
