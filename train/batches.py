"""How a rollout is cut into what is learned from together: single steps, sequences of steps, whole teams."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from imagine.train.networks import Actor, Decisions
from imagine.train.networks.actor import Seen


@dataclass(frozen=True)
class Batch:
    """Some units of a rollout; tensors `[rows, ...]`, rows = steps * agents, step by step.

    `counted` are the rows to learn from (None: all of them). For actors with a
    memory, `state` is what was remembered before the first step, and `starts` `[steps, agents]` tells where episodes
    begin.
    """

    samples: Seen
    drones: int
    counted: Tensor | None = None
    state: Tensor | None = None
    starts: Tensor | None = None

    def decide(self, actor: Actor) -> Decisions:
        """Return the actor's decisions in all rows."""
        return actor.decide(self.samples, self.state, self.starts, self.drones)

    def of_counted(self, rows: Tensor) -> Tensor:
        """Return what belongs to the rows that count."""
        return rows if self.counted is None else rows.index_select(0, self.counted)

    def __getitem__(self, key: str) -> Tensor:
        """Return a sample's part, of the rows that count."""
        return self.of_counted(self.samples[key])


def take(samples: Seen, at: Tensor) -> Seen:
    """Return the samples at these indices; images stay channels last, gathered as whole rows."""
    return {
        key: value.permute(0, 2, 3, 1).index_select(0, at).permute(0, 3, 1, 2)
        if value.ndim == 4
        else value.index_select(0, at)
        for key, value in samples.items()
    }


class Cut:
    """A stretch of steps, `[steps, agents, ...]`, cut into units of `length` steps and teams of `drones` agents.

    `alive` bool `[steps, agents]`, and so is `counts`, which rows are learned from (None: those alive); `states`
    `[steps / length, agents, size]` and `starts` `[steps, agents]` where units are sequences for a memory. Samples
    come by name, `[steps * agents, ...]`.
    """

    def __init__(
        self,
        samples: Seen,
        alive: Tensor,
        drones: int = 1,
        length: int = 1,
        states: Tensor | None = None,
        starts: Tensor | None = None,
        counts: Tensor | None = None,
    ) -> None:
        self.counts = alive.flatten() if counts is None else counts.flatten()
        self.samples, self.alive, self.drones, self.length = samples, alive.flatten(), drones, length
        self.states = None if states is None else states.flatten(0, 1)
        self.starts = None if starts is None else starts.flatten()
        steps, agents = alive.shape
        device = alive.device
        first = torch.arange(0, steps, length, device=device)[:, None] * agents
        units = (first + torch.arange(0, agents, drones, device=device)).flatten()
        self._offsets = torch.arange(length, device=device)[:, None, None] * agents + torch.arange(
            drones, device=device
        )
        self._agents = agents
        any_counts = self.counts[self._rows(units)].view(length, -1, drones).any(dim=2).any(dim=0)
        self.units = units[any_counts]

    def __len__(self) -> int:
        """Units with rows that count."""
        return len(self.units)

    def shuffled(self, rows: int, generator: torch.Generator) -> list[Tensor]:
        """Return all units once, in a random order, cut into batches of about `rows` rows and of almost equal size."""
        order = self.units[torch.randperm(len(self.units), generator=generator).to(self.units.device)]
        pieces = max(1, round(len(order) * self.length * self.drones / rows))
        return list(torch.tensor_split(order, min(pieces, len(order))))

    def in_order(self, rows: int) -> Iterator[tuple[Tensor, Batch]]:
        """Go through all units in batches of about `rows` rows, each with the indices of its rows."""
        for units in torch.split(self.units, max(1, rows // (self.length * self.drones))):
            yield self._rows(units), self.batch(units)

    def drawn(self, rows: int, generator: torch.Generator) -> Batch:
        """Return about `rows` rows of randomly drawn units, with replacement."""
        count = max(1, rows // (self.length * self.drones))
        return self.batch(self.units[torch.randint(len(self.units), (count,), generator=generator)])

    def batch(self, units: Tensor) -> Batch:
        """Return the batch of these units."""
        rows = self._rows(units)
        samples = take(self.samples, rows)
        alone = self.length * self.drones == 1
        if not alone:
            samples["alive"] = self.alive[rows]
        state = starts = None
        if self.states is not None and self.starts is not None:
            starts = self.starts[rows].view(self.length, -1)
            at_first = rows[: starts.shape[1]]
            chunk = at_first // (self._agents * self.length)
            state = self.states[chunk * self._agents + at_first % self._agents]
        counted = None if alone else self.counts[rows].nonzero().squeeze(1)
        return Batch(samples, self.drones, counted, state, starts)

    def _rows(self, units: Tensor) -> Tensor:
        """Return the rows of units: step by step, and in a step unit by unit."""
        return (units[None, :, None] + self._offsets).flatten()
