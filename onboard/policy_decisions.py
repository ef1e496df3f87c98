"""The policy's decisions: each is asked for once and then stands for the ticks that its contract says."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from imagine.core.action import Held, intended_velocity, to_intent
from imagine.core.errors import WorkError
from imagine.core.frames import Pose
from imagine.onboard.ladder import Velocity
from imagine.onboard.policy import Policy

Look = Callable[[], dict[str, NDArray[np.float32]]]
_BRIDGED_TICKS = 5
"""Ticks in which another decides, half a second, over which a policy keeps its memory."""


class PolicyDecisions:
    """What a policy wants, tick by tick; keeps the decision that stands, and what the policy remembers.

    A policy's memory begins anew where it begins to explore, and after every rescue: in training it never remembers how
    something else flew it, and what led into a rescue is best forgotten. Where the drone merely held for some ticks,
    for want of a scan or a frontier, it goes on.
    """

    def __init__(self, policy: Policy) -> None:
        """Start without a decision."""
        self.policy = policy
        self._held: Held | None = None
        self._state = self._nothing()
        self._unflown_ticks = _BRIDGED_TICKS

    def next_velocity(self, look: Look, pose: Pose, is_flying: bool) -> tuple[Velocity | None, str]:
        """Return the body velocity that the policy wants of the drone at `pose`, or None and why it has none.

        `look` makes the observation, where one is needed. While the policy is not the one who flies, each tick is
        decided anew: a decision from before a rescue would be stale.
        """
        contract = self.policy.contract
        axes = contract.observation.axes
        self._unflown_ticks = 0 if is_flying else self._unflown_ticks + 1
        if self._unflown_ticks > _BRIDGED_TICKS:
            self._state = self._nothing()
        if self._held is None or not is_flying:
            self._held = None
            action, failure = self._ask(look)
            if action is None:
                return None, failure
            self._held = Held(to_intent(action, contract.action, axes, pose), contract.action.decision_ticks)
        velocity = intended_velocity(self._held.intent, contract.action, axes, pose)
        self._held = self._held.passed()
        return velocity, ""

    def _nothing(self) -> NDArray[np.float32]:
        return np.zeros(self.policy.contract.state_size, np.float32)

    def _ask(self, look: Look) -> tuple[NDArray[np.float32] | None, str]:
        """Ask for a decision and take up what it leaves to remember, or return why there is none."""
        contract = self.policy.contract
        try:
            action, state = self.policy.infer(look(), self._state)
        except WorkError as error:
            return None, str(error)
        for name, array, size in (("output", action, contract.action.size), ("state", state, contract.state_size)):
            if array.shape != (size,):
                return None, f"the policy's {name} has shape {array.shape}, expected ({size},)"
            if not np.isfinite(array).all():
                return None, f"the policy's {name} is not finite"
        self._state = state
        return action, ""
