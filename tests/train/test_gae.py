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


def test_what_the_clock_ends_goes_on_being_worth_something():
    """At a limit the value of the last state stands for all that would still have come; at a death nothing does."""
    rewards, values = torch.tensor([[1.0, 1.0], [1.0, 1.0]]), torch.full((2, 2), 10.0)
    dones = torch.tensor([[True, True], [False, False]])
    truncated = torch.tensor([[True, False], [False, False]])
    last = torch.tensor([10.0, 10.0])
    advantages, returns = advantages_and_returns(rewards, values, dones, last, 0.9, 0.95, truncated)
    assert advantages[0].tolist() == pytest.approx([1.0 + 0.9 * 10.0 - 10.0, 1.0 - 10.0])
    assert returns[0].tolist() == pytest.approx([10.0, 1.0])
    assert advantages[1].tolist() == pytest.approx([0.0, 0.0])


def test_a_limit_that_is_far_enough_changes_nothing():
    """Rewards of 1 for ever are worth 1 / (1 - gamma), whether rollouts are cut by clocks or not."""
    gamma, worth = 0.9, 1.0 / (1.0 - 0.9)
    rewards, values = torch.ones((6, 1)), torch.full((6, 1), worth)
    dones = torch.tensor([[False], [False], [True], [False], [False], [True]])
    advantages, _ = advantages_and_returns(rewards, values, dones, torch.tensor([worth]), gamma, 0.95, dones)
    torch.testing.assert_close(advantages, torch.zeros((6, 1)), atol=1e-5, rtol=0)
