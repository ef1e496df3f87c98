"""A message on its way out, in the batched air: paid from the byte budget, and put behind its sender's others."""

from __future__ import annotations

import numba

from imagine.sim.air import BYTES_SENT, MESSAGES_SENT


@numba.njit(cache=True, nogil=True)
def can_send(node, messages, size):  # type: ignore[no-untyped-def]
    """Tell whether the byte budget and the ring of messages have room."""
    return size <= node.tokens and node.messages < messages.shape[0]


@numba.njit(cache=True, nogil=True)
def transmit(rules, now, node, messages, counters, kind, size):  # type: ignore[no-untyped-def]
    """Spend the bytes and put a message behind the sender's others on air; return its place in the ring, or -1.

    The radio drops what its queue does not hold, as `RadioMedium.send`; the node does not know, and has paid.
    """
    node.tokens -= size
    counters[BYTES_SENT + kind] += size
    counters[MESSAGES_SENT + kind] += 1
    start = max(now, node.busy_until)
    if (start - now) * rules.air_rate + size > rules.queue_bytes:
        node.dropped += 1
        return -1
    place = (node.first_message + node.messages) % messages.shape[0]
    message = messages[place]
    node.busy_until = start + size / rules.air_rate
    message.arrival = node.busy_until + rules.latency
    message.kind, message.size, message.sequence = kind, size, node.sequence
    node.sequence += 1
    node.messages += 1
    return place
