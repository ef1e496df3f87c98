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


class PolicyDecisions:
    """What a policy wants, tick by tick; remembers the decision that stands."""

    def __init__(self, policy: Policy) -> None:
        """Start without a decision."""
        self.policy = policy
        self._held: Held | None = None

    def next_velocity(self, look: Look, pose: Pose, is_flying: bool) -> tuple[Velocity | None, str]:
        """Return the body velocity that the policy wants of the drone at `pose`, or None and why it has none.

        `look` makes the observation, where one is needed. While the policy is not the one who flies, each tick is
        decided anew: a decision from before a rescue would be stale.
        """
        contract = self.policy.contract
        axes = contract.observation.axes
        if self._held is None or not is_flying:
            self._held = None
            action, failure = self._ask(look)
            if action is None:
                return None, failure
            self._held = Held(to_intent(action, contract.action, axes, pose), contract.action.decision_ticks)
        velocity = intended_velocity(self._held.intent, contract.action, axes, pose)
        self._held = self._held.passed()
        return velocity, ""

    def _ask(self, look: Look) -> tuple[NDArray[np.float32] | None, str]:
        size = self.policy.contract.action.size
        try:
            action = self.policy.infer(look())
        except WorkError as error:
            return None, str(error)
        if action.shape != (size,):
            return None, f"the policy's output has shape {action.shape}, expected ({size},)"
        if not np.isfinite(action).all():
            return None, "the policy's output is not finite"
        return action, ""
