"""The policy: what a drone sees, and may remember, to the mean of its action."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from imagine.core.contract import LEVEL, NEXT_STATE, STATE, ActionSpec
from imagine.core.errors import InputError
from imagine.core.observation_spec import ObservationSpec
from imagine.train.networks.choice import (
    ChoiceHead,
    choice_entropy,
    choice_log_probability,
    direction_of,
    draw_choice,
    draw_coherent,
    places_of,
)
from imagine.train.networks.coherent import coherent_noise
from imagine.train.networks.computing import Computing, autocast
from imagine.train.networks.encoders import LEVEL_CELLS, LEVEL_CHANNELS, Encoder, orthogonal
from imagine.train.networks.gaussian import LOG_STD_RANGE, entropy, log_probability
from imagine.train.networks.memory import FrameStack, GatedMemory
from imagine.train.networks.settings import NetworkSettings
from imagine.train.networks.team import TeamPooling

_STEERING = 1.5  # how far along the chosen frontiers' direction an untrained policy flies, before the tanh
Seen = dict[str, Tensor]
"""What networks are shown, `[rows, ...]` by name: the observation's parts, `level` where it is seen, `alive`."""


class Decisions(NamedTuple):
    """Means of actions `[rows, action size]`, the features they came from, and the state after the last step.

    With a choice among frontiers, `scores` `[rows, n]` are theirs, and the mean is the direction of the best.
    """

    mean: Tensor
    features: Tensor
    state: Tensor
    scores: Tensor | None = None


class Actor(Computing):
    """The policy that all drones share; the spread of its actions is one number per component.

    `inputs` and `outputs` name what `forward` takes and gives, which is what an exported model takes and gives:
    `views`, `lidar`, `motion`, `frontiers` where they are seen, then `level` under ctce and `state` where there is a
    memory; `action`, then `next_state`. `state_size` is 0 without memory.
    """

    def __init__(self, settings: NetworkSettings, spec: ObservationSpec, action_size: int, steers: bool = True) -> None:
        """`steers`: the action begins with a direction along the axes of the observation, as frontiers are shown."""
        super().__init__()
        self.settings, self.action_size = settings, action_size
        self.paradigm = settings.paradigm
        hidden, kind = settings.hidden, settings.memory
        views = spec.shapes["views"]
        self.stack = FrameStack(views, settings.stack_frames) if kind == "stack" else None
        self.encoder = Encoder(
            spec, settings.views, settings.view_channels, settings.lidar, settings.lidar_channels,
            (hidden, hidden // 2), self.is_central, settings.critic_channels,
            settings.stack_frames if kind == "stack" else 1,
        )  # fmt: skip
        self.team = TeamPooling(hidden) if self.is_central else None
        self.gated = GatedMemory(hidden, settings.memory_size) if kind == "gru" else None
        self.feature_size = hidden if self.gated is None else settings.memory_size
        self.mean = orthogonal(nn.Linear(self.feature_size, action_size), gain=0.01)  # begin near standing still
        self.steering: nn.Parameter | None = None
        if spec.frontiers and steers:
            self.steering = nn.Parameter(torch.tensor(_STEERING))
        self.choice: ChoiceHead | None = None
        if settings.head == "choice":
            if self.steering is None:
                raise InputError(
                    "network.head: choice needs env.observation.frontiers above 0, and actions that are a direction "
                    "along the observation's axes: env.action.mode plane or waypoint"
                )
            numbers = spec.shapes["frontiers"][1]
            self.choice = ChoiceHead(numbers, self.feature_size, hidden // 2, settings.choice_momentum)
        self.taken_size = action_size if self.choice is None else 1
        self.is_coherent = self.choice is not None and settings.choice_noise == "coherent"
        self._along_heading = spec.axes == "heading"
        self.log_std = nn.Parameter(torch.full((action_size,), settings.log_std))
        memory = self.gated or self.stack
        self.state_size = 0 if memory is None else memory.size
        self.shapes = dict(spec.shapes)
        if self.is_central:
            self.shapes[LEVEL] = (LEVEL_CHANNELS, LEVEL_CELLS, LEVEL_CELLS)
        if self.state_size:
            self.shapes[STATE] = (self.state_size,)
        self.inputs = tuple(self.shapes)
        self.outputs = ("action", NEXT_STATE) if self.state_size else ("action",)

    @property
    def is_central(self) -> bool:
        """Whether it decides for a whole team by what the whole team sees."""
        return self.paradigm == "ctce"

    def set_momentum(self, momentum: float) -> None:
        """Let a choice be held to by so much, see `ChoiceHead`; without that head it is nothing."""
        if self.choice is not None:
            self.choice.momentum = momentum

    def forward(self, *inputs: Tensor) -> Tensor | tuple[Tensor, Tensor]:
        """Return the action's mean, `[batch, action size]` in (-1, 1), and the next state where there is a memory.

        This is what flies. `inputs` come in the order of `self.inputs`; under ctce the batch is one team.
        """
        seen = dict(zip(self.inputs, inputs, strict=True))
        decisions = self.decide(seen, seen.pop(STATE, None), drones=inputs[0].shape[0] if self.is_central else 1)
        return (decisions.mean, decisions.state) if self.state_size else decisions.mean

    def decide(
        self, seen: Seen, state: Tensor | None = None, starts: Tensor | None = None, drones: int = 1
    ) -> Decisions:
        """Return the decisions of one step, or of a sequence of steps for each row of `state`.

        `starts` bool `[steps, batch]` makes it a sequence: `seen` then has steps * batch rows, step by step, and it
        tells where episodes begin, so that nothing of before is remembered. `state` `[batch, state size]` is that
        before the first step; none: nothing is remembered. Under ctce rows are whole teams of `drones` in order, and
        `alive` tells who of them still flies.
        """
        views = seen["views"].to(self.dtype)
        if state is None:
            state = torch.zeros(
                (views.shape[0] if starts is None else starts.shape[1], self.state_size), device=views.device
            )
        with autocast(self.dtype, views.device):
            if self.stack is not None:
                views, state = (
                    self.stack.step(views, state) if starts is None else self.stack.sequence(views, state, starts)
                )
            features, direction = self.encoder(seen, views, self._level(seen))
            if self.team is not None:
                features = self.team(features, seen.get("alive"), drones)
            if self.gated is not None:
                if starts is None:
                    features = state = self.gated.step(features, state)
                else:
                    features, state = self.gated.sequence(features, state, starts)
        features = features.float()
        if self.choice is not None:
            scores = self.choice(seen["frontiers"], features, seen["motion"][:, :2])
            return Decisions(self.flown(seen, scores.argmax(dim=1, keepdim=True)), features, state, scores)
        wanted = self.mean(features)
        if self.steering is not None:
            steered = direction.float() * self.steering
            wanted = wanted + nn.functional.pad(steered, (0, self.action_size - steered.shape[1]))
        return Decisions(torch.tanh(wanted), features, state)

    def noise(self, steps: int, agents: int, generator: torch.Generator) -> Tensor:
        """Return what `draw` needs of chance in so many steps, `[steps, agents, n]`: the same whoever flies them."""
        if self.is_coherent:
            return coherent_noise(steps, agents, generator).to(self.device)
        size = (steps, agents, self.taken_size)
        drawn = torch.randn(size, generator=generator) if self.choice is None else torch.rand(size, generator=generator)
        return drawn.to(self.device)

    def draw(self, decisions: Decisions, noise: Tensor, seen: Seen, poses: Tensor) -> tuple[Tensor, Tensor]:
        """Return what is done in training, `[rows, taken size]`, and its log density, `[rows]`.

        It is an action, or the number of a frontier; `flown` makes either an action. `noise` is of as many rows, and so
        are `poses`, `[rows, 3]`: where drones take themselves to be.
        """
        if decisions.scores is not None:
            if self.is_coherent:
                places = places_of(seen["frontiers"], poses.to(self.device, torch.float32), self._along_heading)
                choice = draw_coherent(decisions.scores, noise, places)
            else:
                choice = draw_choice(decisions.scores, noise.squeeze(1))
            return choice.unsqueeze(1).float(), choice_log_probability(decisions.scores, choice)
        taken = decisions.mean + self.spread().exp() * noise
        return taken, self.log_probability(decisions.mean, None, taken)

    def flown(self, seen: Seen, taken: Tensor) -> Tensor:
        """Return the actions, `[rows, action size]`, that what was drawn stands for."""
        if self.choice is None:
            return taken
        direction = direction_of(seen["frontiers"], taken.squeeze(1).long())
        return nn.functional.pad(direction, (0, self.action_size - 2))

    def log_probability(self, mean: Tensor, scores: Tensor | None, taken: Tensor) -> Tensor:
        """Return the log density of what was drawn, `[rows]`, by decisions' means and scores."""
        if scores is not None:
            return choice_log_probability(scores, taken.squeeze(1).long())
        return log_probability(taken, mean, self.spread())

    def entropy(self, scores: Tensor | None) -> Tensor:
        """Return the entropy of what is drawn: of each row's choice, `[rows]`, or of all rows' actions, `[]`."""
        return entropy(self.spread()) if scores is None else choice_entropy(scores)

    def _level(self, seen: Seen) -> Tensor | None:
        return seen[LEVEL].to(self.dtype) if self.is_central else None

    def spread(self) -> Tensor:
        """Return the logarithm of the standard deviation with which training draws actions, `[action size]`."""
        return self.log_std.clamp(*LOG_STD_RANGE)


def steers(observation: ObservationSpec, action: ActionSpec) -> bool:
    """Tell whether an action's first two numbers are a direction along the observation's axes."""
    return action.mode in ("plane", "waypoint") or (action.mode == "body" and observation.axes == "heading")
