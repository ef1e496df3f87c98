"""What an actor remembers from one decision to the next: a flat `state`, `[batch, state size]`, zero at the beginning.

Both memories do the same two things: a step, which is what flies, and a sequence of steps, which is what learns. In a
sequence, `starts` bool `[steps, batch]` tells where an episode begins: nothing from before it is remembered.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from imagine.train.networks.encoders import orthogonal


class GatedMemory(nn.Module):
    """A gated recurrent unit (Cho et al. 2014, in the form of torch's GRU); its state is what it puts out.

    Written out in linear layers, which export to plain operators and compute in whatever precision is asked for; the
    state itself stays float32.
    """

    def __init__(self, features: int, size: int) -> None:
        super().__init__()
        self.size = size
        self.of_input = orthogonal(nn.Linear(features, 3 * size), gain=1.0)
        self.of_state = orthogonal(nn.Linear(size, 3 * size), gain=1.0)

    def step(self, features: Tensor, state: Tensor) -> Tensor:
        """Return the next state, `[batch, size]`, from features `[batch, features]`."""
        return self._gate(self.of_input(features), state)

    def sequence(self, features: Tensor, state: Tensor, starts: Tensor) -> tuple[Tensor, Tensor]:
        """Return the state after each step, `[steps * batch, size]`, and after the last, from features of all steps."""
        steps = starts.shape[0]
        gates = self.of_input(features).view(*starts.shape, -1)  # in one product: only the state has to wait
        goes_on = (~starts).to(state.dtype).unsqueeze(2)
        states = []
        for t in range(steps):
            state = self._gate(gates[t], state * goes_on[t])
            states.append(state)
        return torch.cat(states), state

    def _gate(self, gates: Tensor, state: Tensor) -> Tensor:
        reset, update, new = gates.float().chunk(3, dim=1)
        of_reset, of_update, of_new = self.of_state(state).float().chunk(3, dim=1)
        update = torch.sigmoid(update + of_update)
        new = torch.tanh(new + torch.sigmoid(reset + of_reset) * of_new)
        return (1.0 - update) * new + update * state


class FrameStack(nn.Module):
    """The newest `frames` views, oldest first; its state is all of them but the present one. Missing ones are zero."""

    def __init__(self, shape: tuple[int, ...], frames: int) -> None:
        """`shape` is that of views, `(channels, n, n)`."""
        super().__init__()
        self.shape, self.frames = tuple(shape), frames
        self.size = (frames - 1) * shape[0] * shape[1] * shape[2]

    def step(self, views: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Return the stack, `[batch, channels, frames, n, n]`, and the next state."""
        before = state.to(views.dtype).reshape(-1, self.frames - 1, *self.shape)
        stack = torch.cat([before, views.unsqueeze(1)], dim=1)
        return stack.transpose(1, 2), stack[:, 1:].flatten(1).to(state.dtype)

    def sequence(self, views: Tensor, state: Tensor, starts: Tensor) -> tuple[Tensor, Tensor]:
        """Return the stacks of all steps, `[steps * batch, channels, frames, n, n]`, and the state after the last."""
        steps, batch = starts.shape
        earlier = self.frames - 1
        before = state.to(views.dtype).reshape(-1, earlier, *self.shape).transpose(0, 1)
        frames = torch.cat([before, views.reshape(steps, batch, *self.shape)])  # [earlier + steps, batch, ...]
        episode = torch.cat([torch.zeros((earlier, batch), device=starts.device), starts.float()]).cumsum(0)
        stacks = []
        for t in range(steps):
            window = slice(t, t + self.frames)
            same = (episode[window] == episode[t + earlier]).to(frames.dtype)
            stacks.append((frames[window] * same[:, :, None, None, None]).permute(1, 2, 0, 3, 4))
        last = stacks[-1].transpose(1, 2)[:, 1:]
        return torch.cat(stacks), last.flatten(1).to(state.dtype)
