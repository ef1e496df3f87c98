"""All that learns in a run: networks, their optimisers, and the draws they depend on."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from imagine.train.checkpoint import Checkpoint, load_weights
from imagine.train.networks import Actor, Critic, chosen_device, steers
from imagine.train.ppo import Optimisers
from imagine.train.settings import TrainSettings


@dataclass
class Learner:
    """All that learns and all that is random in a run, but for the environment."""

    actor: Actor
    critic: Critic
    ppo: Optimisers
    imitation: torch.optim.Optimizer
    generator: torch.Generator
    rng: np.random.Generator

    @staticmethod
    def create(settings: TrainSettings) -> Learner:
        """Return a fresh learner, of imitation and PPO; the seed decides its weights and draws."""
        torch.manual_seed(settings.run.seed)  # layers initialise from the global generator
        observation, action = settings.env.observation, settings.env.action
        device = chosen_device(settings.run.device)
        actor = Actor(settings.network, observation, action.size, steers(observation, action)).to(device)
        actor.set_momentum(settings.practice_momentum)
        critic = Critic(settings.network, observation).to(device)
        return Learner(
            actor,
            critic,
            Optimisers(actor, critic),
            torch.optim.Adam(actor.parameters(), lr=settings.imitation.lr),
            torch.Generator().manual_seed(settings.run.seed),
            np.random.default_rng(settings.run.seed),
        )

    def restore(self, checkpoint: Checkpoint) -> None:
        """Go on from a checkpoint. Raises InputError when it is of another network."""
        load_weights(self.actor, checkpoint.actor, "checkpoint: actor")
        load_weights(self.critic, checkpoint.critic, "checkpoint: critic")
        optimisers = copy.deepcopy(checkpoint.optimisers)  # Adam would go on in the checkpoint's own tensors
        self.ppo.actor.load_state_dict(optimisers["actor"])
        self.ppo.critic.load_state_dict(optimisers["critic"])
        self.imitation.load_state_dict(optimisers["imitation"])
        self.generator.set_state(checkpoint.rngs["torch"])
        self.rng.bit_generator.state = checkpoint.rngs["numpy"]

    def optimiser_states(self) -> dict[str, dict[str, Any]]:
        """Return the optimisers' states, by what they optimise."""
        return {
            "actor": self.ppo.actor.state_dict(),
            "critic": self.ppo.critic.state_dict(),
            "imitation": self.imitation.state_dict(),
        }

    def draws(self) -> dict[str, Any]:
        """Return the states of the generators."""
        return {"torch": self.generator.get_state(), "numpy": self.rng.bit_generator.state}
