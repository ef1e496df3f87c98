"""Every hyperparameter of PPO, and why it is what it is."""

from __future__ import annotations

from pydantic import Field

from imagine.core.config import Settings
from imagine.train.networks import Precision
from imagine.train.schedules import PositiveSchedule, WeightSchedule


class PpoSettings(Settings):
    """Every hyperparameter of PPO. Those that are schedules take a number, or `start`, `end`, `shape` and `until`."""

    agent_steps: int = Field(default=2_500_000, ge=0, description="decisions of all drones; where training ends")
    decision_ticks: int | None = Field(
        default=None, ge=1, le=100,
        description="ticks that a decision stands for in imitation and PPO; none: as in flight, env.action's",
    )  # fmt: skip
    choice_momentum: float | None = Field(
        default=None, ge=0.0, le=20.0,
        description="in imitation and PPO, where chance stays with a choice as well; none: network.choice_momentum",
    )  # fmt: skip
    rollout_steps: int = Field(default=64, ge=2, description="steps of every world between two updates")
    epochs: int = Field(default=2, ge=1, description="passes over a rollout; more drift from the policy that flew it")
    minibatch: int = Field(default=1152, ge=2, description="samples a gradient step, about; a quarter of 24 x 64 x 3")
    actor_lr: PositiveSchedule = Field(
        default=PositiveSchedule(start=1e-4), description="Adam's step; small, since imitation did the big ones"
    )
    critic_lr: PositiveSchedule = Field(
        default=PositiveSchedule(start=5e-4), description="Adam's step; larger, for values must follow the policy"
    )
    clip: float = Field(default=0.15, gt=0.0, lt=1.0, description="how far a probability ratio may move with gain")
    gamma: float = Field(default=0.99, ge=0.0, le=1.0, description="discount a step: sees about 10 s ahead at 10 Hz")
    gae_lambda: float = Field(default=0.95, ge=0.0, le=1.0, description="0 trusts the critic, 1 only the rewards")
    critic_warmup_updates: int = Field(default=30, ge=0, description="updates before the policy moves: values first")
    gradient_norm: float = Field(default=0.5, gt=0.0, description="longer gradients are shortened to this, per network")
    entropy_weight: WeightSchedule = Field(
        default=WeightSchedule(start=0.0), description="0: noise that imitation needs not must not grow"
    )
    action_std: PositiveSchedule | None = Field(
        default=None, description="deviation that actions are drawn with; none: the policy learns it"
    )
    kl_stop: float | None = Field(default=0.03, gt=0.0, description="divergence that ends a rollout's policy steps")
    value_normalisation: bool = Field(default=True, description="the critic learns returns less their mean, over std")
    value_clip: float | None = Field(
        default=None, gt=0.0, description="how far a value may move with gain, in deviations of returns"
    )
    value_weight: float = Field(default=0.5, gt=0.0, description="of the value loss, where the encoder is shared")
    sequence_steps: int = Field(
        default=16, ge=1, description="steps that a memory is trained over; at most so many, as divide rollout_steps"
    )
    precision: Precision = Field(
        default="auto", description="of layers, in rollouts and updates; auto: what is quicker"
    )
