"""What the planner said in the states that a student came to: single labels, or whole rounds of them."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import torch
from torch import Tensor

from imagine.train.batches import Batch, Cut
from imagine.train.networks.actor import Seen
from imagine.train.rollout import Recall, room_for


@dataclass
class LabelBuffer:
    """The newest labelled observations, in a ring; in half precision, for images are what costs memory."""

    capacity: int
    arrays: Seen = field(default_factory=dict)
    labels: Tensor = field(default_factory=lambda: torch.empty(0))
    written: int = 0

    def __len__(self) -> int:
        """Labels held."""
        return min(self.written, self.capacity)

    def add(self, observations: Seen, labels: Tensor) -> None:
        """Take labelled observations `[samples, ...]`; the oldest give way."""
        if not len(labels):
            return
        if not self.arrays:
            halves = {key: value[:1].half() for key, value in observations.items()}
            self.arrays = {key: value[:, 0] for key, value in room_for(self.capacity, halves).items()}
            self.labels = torch.empty((self.capacity, labels.shape[1]))
        labels = labels[-self.capacity :]
        at = (self.written + torch.arange(len(labels))) % self.capacity
        for key, array in self.arrays.items():
            array[at] = observations[key][-self.capacity :].to(array.dtype)
        self.labels[at] = labels
        self.written += len(labels)

    def sample(self, rows: int, generator: torch.Generator) -> Batch:
        """Return a random minibatch, with replacement; its labels are `labels`."""
        at = torch.randint(len(self), (rows,), generator=generator)
        device = next(iter(self.arrays.values())).device
        samples = {key: array[at.to(device)] for key, array in self.arrays.items()}
        samples = {key: value if value.ndim == 4 else value.float() for key, value in samples.items()}
        return Batch({**samples, "labels": self.labels[at].to(device)}, drones=1)


@dataclass
class Round:
    """A stretch of flight, step by step: what was seen, labels (nan where there is none), and what was remembered."""

    state: Tensor
    seen: list[Seen] = field(default_factory=list)
    labels: list[Tensor] = field(default_factory=list)
    starts: list[Tensor] = field(default_factory=list)
    alive: list[Tensor] = field(default_factory=list)

    @staticmethod
    def empty(recall: Recall) -> Round:
        """Return one that begins with what is remembered now."""
        return Round(recall.state.clone())

    def add(self, seen: Seen, labels: Tensor, alive: Tensor, starts: Tensor) -> None:
        """Take a step of all agents."""
        self.seen.append(seen)
        self.labels.append(labels)
        self.alive.append(alive)
        self.starts.append(starts.clone())


class RoundBuffer:
    """The newest rounds, of `capacity` agent-steps together; sampled as teams, or as whole sequences of agents."""

    def __init__(self, capacity: int, sequences: bool) -> None:
        self.capacity, self._sequences = capacity, sequences
        self._rounds: deque[Cut] = deque()

    def __len__(self) -> int:
        """Agent-steps held."""
        return sum(cut.alive.numel() for cut in self._rounds)

    def add_round(self, flown: Round, drones: int) -> None:
        """Take a round, of teams of `drones` that belong together; the oldest give way."""
        steps = len(flown.seen)
        room = room_for(steps, flown.seen[0])
        for t, seen in enumerate(flown.seen):
            for key, value in seen.items():
                room[key][t] = value
        samples = {key: value.flatten(0, 1) for key, value in room.items()}
        device = samples["motion"].device
        labels, alive = torch.stack(flown.labels).to(device), torch.stack(flown.alive).to(device)
        samples["labels"] = labels.flatten(0, 1)
        labelled = torch.isfinite(labels).all(dim=2)
        if not bool(labelled.any()):
            return
        if self._sequences:
            starts = torch.stack(flown.starts).to(device)
            cut = Cut(samples, alive, drones, steps, flown.state[None], starts, labelled)
        else:
            cut = Cut(samples, alive, drones, counts=labelled)
        self._rounds.append(cut)
        while len(self._rounds) > 1 and len(self) > self.capacity:
            self._rounds.popleft()

    def sample(self, rows: int, generator: torch.Generator) -> Batch:
        """Return a random minibatch of about `rows` rows of one round; its labels are `labels`."""
        cut = self._rounds[int(torch.randint(len(self._rounds), (1,), generator=generator))]
        return cut.drawn(rows, generator)
