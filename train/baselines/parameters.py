"""What frontier baselines are tuned by: plain numbers, as their kernels take them."""

from __future__ import annotations

from typing import NamedTuple


class Parameters(NamedTuple):
    """How a drone values frontiers, deals them out, and holds on to its choice. Metres, ticks, shares."""

    replan_ticks: int = 5
    """A standing choice is thought over again after so many ticks, or when its frontier is gone."""
    least_ticks: int = 2
    """A gone frontier, too, waits for so many ticks since the last choice: the path to it is still good."""
    cluster_m: float = 1.2
    """Frontier cells within so much of each other, along the frontier, are one target."""
    gain_range_m: float = 6.0
    """How far into the unknown a target is taken to lead: what is seen from it, and a little on the way on."""
    gain_exponent: float = 1.0
    """Utility is (gain / area of the disc of `gain_range_m`) to this power; 0: all frontiers are worth the same."""
    cost_weight_per_m: float = 0.1
    """What a metre of way takes off the utility (see `form`): Burgard's beta."""
    form: int = 1
    """Worth, 0: utility less weighted way; 1: utility times exp(-weighted way); 2: utility over 1 + weighted way."""
    claimed_share: float = 1.0
    """So much of what is expected to be seen right at a target is taken off all others once it is dealt out."""
    peer_age_s: float = 1e9
    """A peer not heard for longer takes no part in the dealing."""
    stay_m: float = 0.6
    """The target chosen before counts as so much nearer than it is."""


NEAREST = Parameters(gain_exponent=0.0, form=0, claimed_share=0.0, peer_age_s=-1.0, cluster_m=0.4, stay_m=0.2)
"""Nearest frontier (Yamauchi 1997): the way alone counts, and peers do not."""
COORDINATED = Parameters()
"""Coordinated exploration (Burgard et al. 2005), with the expected gain as utility."""
HUNGARIAN = Parameters()
"""Assignment of the greatest total worth (Kuhn 1955), with the same worth."""
