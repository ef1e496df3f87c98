"""Statuses and poses in the batched air: where each drone says it is, as `Speaking` does."""

from __future__ import annotations

import numba
import numpy as np

from imagine.sim.air import MESSAGES_SENT, STATUS
from imagine.sim.air_costs import here_bytes, status_bytes
from imagine.sim.air_receive import peer_place
from imagine.sim.air_transmit import can_send, transmit

# these are those of mesh_comm.speaking
_STATUS_SHARE, _MOST_STATUS_S = 0.125, 2.0
_HERE_SHARE, _MOST_HERE_S = 0.2, 1.0
_EPSILON_S = 1e-6


@numba.njit(cache=True, nogil=True)
def _is_near(peers, pose, tick, rules):  # type: ignore[no-untyped-def]
    """Tell whether a peer in touch is taken to be near."""
    for peer in range(peers.shape[0]):
        x, y, found = peer_place(peers[peer], tick, rules)
        if found and np.hypot(x - pose[0], y - pose[1]) <= rules.near:
            return True
    return False


@numba.njit(cache=True, nogil=True)
def send_status(rules, now, node, messages, counters, peers, pose, velocity, live, budget):  # type: ignore[no-untyped-def]
    """Send where the drone is and whom it hears; False when bytes run short."""
    heard = 0
    for peer in range(peers.shape[0]):
        heard += peers[peer].heard_tick >= 0
    size = status_bytes(counters[:MESSAGES_SENT], heard)
    if not can_send(node, messages, size):
        return False
    place = transmit(rules, now, node, messages, counters, STATUS, size)
    if place >= 0:
        message = messages[place]
        message.x, message.y, message.yaw = pose[0], pose[1], pose[2]
        message.vx, message.vy, message.hears, message.slot = velocity[0], velocity[1], live, 0
    spread = min(_MOST_STATUS_S, size / (_STATUS_SHARE * budget))
    node.next_status, node.pose_told_at = now + max(rules.status_period, spread), now
    return True


@numba.njit(cache=True, nogil=True)
def is_here_due(rules, tick, node, peers, pose, budget):  # type: ignore[no-untyped-def]
    """Tell whether the pose was not told for so long that it is due: sooner where peers are near."""
    period = rules.pose_period
    if node.pending_clock == 0 and _is_near(peers, pose, tick, rules):
        period = min(period, rules.near_pose_period)  # a scan that waits will tell it
    period = max(period, min(_MOST_HERE_S, here_bytes() / (_HERE_SHARE * budget)))
    return tick / rules.ticks_per_s >= node.pose_told_at + period - _EPSILON_S


@numba.njit(cache=True, nogil=True)
def send_here(rules, now, node, messages, counters, pose, velocity):  # type: ignore[no-untyped-def]
    """Send where the drone is; False when bytes run short."""
    size = here_bytes()
    if not can_send(node, messages, size):
        return False
    place = transmit(rules, now, node, messages, counters, STATUS, size)
    if place >= 0:
        message = messages[place]
        message.x, message.y, message.yaw = pose[0], pose[1], pose[2]
        message.vx, message.vy, message.slot = velocity[0], velocity[1], 1
    node.pose_told_at = now
    return True
