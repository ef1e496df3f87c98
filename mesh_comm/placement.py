"""Where peers' frames lie in the own: estimated from overlapping maps, trusted once confirmed, withdrawn if denied.

One estimate is never believed. A place is trusted when it is unambiguous and later estimates, from maps that overlap
further than those before, find it again: then it has foretold evidence that it was not made from. A trusted place is
checked against the newest maps and moved with them; it is withdrawn when walls contradict it or another place explains
the maps nearly as well. Work is done in slices of a few milliseconds. No clock, no random number inside.
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from imagine.core.evidence import EvidenceMap
from imagine.core.frames import IDENTITY, Pose, compose, relative
from imagine.core.map_field import Field, Fit, field_of, judge
from imagine.core.registration import Hypothesis, Search, Within, are_apart, difference, refine
from imagine.mesh_comm.alignment import AlignmentSettings
from imagine.mesh_comm.messages import GROUND

Standing = Literal["given", "trusted", "candidate", "unknown"]
_log = logging.getLogger(__name__)


class Place(NamedTuple):
    """What is held of a peer's frame: `pose` is that of the trusted or given place, None while there is none."""

    standing: Standing
    pose: Pose | None
    confirmations: int
    fit: Fit | None


@dataclass
class _Track:
    """What has been found out of one peer's frame."""

    next_at: float = -math.inf
    candidate: Hypothesis | None = None
    confirmations: int = 0
    fit: Fit | None = None
    is_given: bool = False
    strikes: int = 0
    checks: int = 0
    seen: tuple[int, int] = (0, 0)


@dataclass(frozen=True)
class _Attempt:
    source: int
    search: Search


class Placements:
    """Places the layers of `evidence`, by `layout` where that names a peer, else by what the maps show.

    A drone measures against its own layer. The ground station (id 0) has none: the first drone whose walls it hears
    lends it its frame.
    """

    def __init__(
        self, evidence: EvidenceMap, settings: AlignmentSettings, layout: dict[int, Pose] | None = None
    ) -> None:
        """Begin; `layout` says where each drone's frame (its launch) lies in a common one, metres and radians.

        Drones that it names are placed at once, drones that it does not name are searched for.
        """
        self._evidence, self._settings = evidence, settings
        self._layout: dict[int, Pose] = {}
        self._tracks: dict[int, _Track] = {}
        self._attempt: _Attempt | None = None
        self._anchor = None if evidence.own == GROUND else evidence.own
        named = layout or {}
        if evidence.own == GROUND and named:
            self._anchor = min(named)
        if evidence.own == GROUND or evidence.own in named:
            home = named.get(evidence.own, IDENTITY)
            for source, pose in named.items():
                if source != evidence.own:
                    self._layout[source] = relative(home, pose)
                    self._tracks[source] = _Track(is_given=True)
                    evidence.place(source, self._layout[source])

    def place(self, source: int) -> Place:
        """Return what is held of a peer's frame."""
        track, pose = self._tracks.get(source, _Track()), self._evidence.placement(source)
        if pose is not None:
            return Place("given" if track.is_given else "trusted", pose, track.confirmations, track.fit)
        if track.candidate is None:
            return Place("unknown", None, 0, track.fit)
        return Place("candidate", None, track.confirmations, track.candidate.fit)

    def forget(self, source: int) -> None:
        """Take it that a peer has started anew, and with it its frame; a layout still says where that begins."""
        self._tracks.pop(source, None)
        if self._attempt is not None and self._attempt.source == source:
            self._attempt = None
        if source in self._layout:
            self._tracks[source] = _Track(is_given=True)
        elif source == self._anchor:  # only of the ground: a peer that has a place lends its frame from now on
            self._anchor = next((s for s in sorted(self._tracks) if self._evidence.placement(s) is not None), None)
            self._attempt = None
            for track in self._tracks.values():  # found in the frame that is gone
                track.candidate, track.confirmations = None, 0
        if source != self._anchor:
            self._evidence.place(source, self._layout.get(source))

    def advance(self, now: float) -> list[int]:
        """Do a slice of work at `now`, seconds; return the sources that were placed, moved or withdrawn by it."""
        if self._attempt is not None:
            attempt = self._attempt
            if not attempt.search.advance(self._settings.yaws_per_slice):
                return []
            self._attempt = None
            return self._conclude(attempt)
        source = self._due(now)
        return [] if source is None else self._begin(source, now)

    # --- which peer, and against what --------------------------------------------------------------------------

    def _due(self, now: float) -> int | None:
        """Return the peer that has waited longest for an estimate and whose map or whose reference has changed."""
        due = []
        for source in sorted(self._evidence.layers):
            if source in (self._evidence.own, self._anchor):
                continue
            track = self._tracks.setdefault(source, _Track())
            if track.next_at <= now:
                due.append((track.next_at, source))
        return min(due)[1] if due else None

    def _begin(self, source: int, now: float) -> list[int]:
        track = self._tracks[source]
        track.next_at = now + self._settings.period_s
        anchor = self._anchored(source)
        if anchor is None or anchor == source:
            return [] if anchor is None else [source]
        layers = self._evidence.layers
        known = int(np.count_nonzero(layers[anchor].cells)), int(np.count_nonzero(layers[source].cells))
        if known == track.seen or min(known) < self._settings.least_overlap:
            return []
        track.seen = known
        origin = self._evidence.origin_cells
        reference, peer = field_of(layers[anchor].cells, origin), field_of(layers[source].cells, origin)
        if reference is None or peer is None:
            return []
        if self._evidence.placement(source) is None:
            self._attempt = _Attempt(source, Search(reference, peer, self._within(source)))
            return []
        track.checks += 1
        if not track.is_given and track.checks % self._settings.search_every == 0:
            self._attempt = _Attempt(source, Search(reference, peer, self._within(source)))
            return []
        return self._check(source, reference, peer)

    def _anchored(self, source: int) -> int | None:
        """Return whose layer a peer's is measured against; the ground takes the first that has walls."""
        if self._anchor is None and np.count_nonzero(self._evidence.layers[source].cells) > 0:
            self._anchor = source
            self._evidence.place(source, IDENTITY)
            _log.info("the map is shown in the frame of drone %d", source)
        return self._anchor

    def _within(self, source: int) -> Within | None:
        """Return where a peer's frame can begin, in the anchor's."""
        radius_m = self._settings.launch_radius_m
        if radius_m is None:
            return None
        begun = relative(self._home(), self._layout.get(source, self._home()))
        return Within(begun.x, begun.y, radius_m)

    def _home(self) -> Pose:
        """Return the anchor's frame in the own."""
        anchor = self._anchor
        pose = IDENTITY if anchor is None or anchor == self._evidence.own else self._evidence.placement(anchor)
        return pose or IDENTITY

    def _put(self, source: int, pose: Pose) -> None:
        self._evidence.place(source, compose(self._home(), pose))

    def _held(self, source: int) -> Pose | None:
        """Return a peer's frame in the anchor's."""
        pose = self._evidence.placement(source)
        return None if pose is None else relative(self._home(), pose)

    # --- what an estimate does ---------------------------------------------------------------------------------

    def _conclude(self, attempt: _Attempt) -> list[int]:
        source, search = attempt.source, attempt.search
        hypotheses = search.found or []
        if self._held(source) is not None:
            return self._compare(source, search)
        track, settings = self._tracks[source], self._settings
        best = hypotheses[0] if hypotheses else None
        if best is None or not self.is_clear(hypotheses):
            track.candidate, track.confirmations = None, 0
            track.fit = None if best is None else best.fit
            return []
        last = track.candidate
        if last is None or not self._agree(last.pose, best.pose, search.peer):
            track.candidate, track.confirmations = best, 0
            return []
        if best.fit.overlap < last.fit.overlap + settings.more_overlap:
            return []  # the same evidence finds the same place: that says nothing new
        track.candidate = best
        track.confirmations += 1
        if track.confirmations < settings.confirmations:
            return []
        track.fit, track.strikes, track.checks = best.fit, 0, 0
        self._put(source, best.pose)
        _log.info("the frame of drone %d is known: %s", source, best.pose)
        return [source]

    def is_clear(self, hypotheses: list[Hypothesis]) -> bool:
        """Tell whether the first of the hypotheses, best first, could be believed for itself."""
        fit, settings = hypotheses[0].fit, self._settings
        rival = hypotheses[1].fit.score if len(hypotheses) > 1 else 0.0
        return self._is_sound(fit) and rival <= settings.most_rival * fit.score

    def _is_sound(self, fit: Fit) -> bool:
        settings = self._settings
        return (
            fit.overlap >= settings.least_overlap
            and fit.matched >= settings.least_matched
            and fit.hold >= settings.least_hold
            and fit.contradiction <= settings.most_contradiction
        )

    def _compare(self, source: int, search: Search) -> list[int]:
        """Look whether a trusted place is still the best of all."""
        held = self._held(source)
        hypotheses = search.found or []
        if held is None or not hypotheses:
            return []
        fit = judge(search.reference, search.peer, held)
        others = [h for h in hypotheses if are_apart(h.pose, held, search.peer.centre)]
        if others and others[0].fit.score > self._settings.withdraw_rival * fit.score:
            return self._strike(source, fit, "another place explains the maps as well")
        return self._check(source, search.reference, search.peer)

    def _check(self, source: int, reference: Field, peer: Field) -> list[int]:
        """Look whether the newest maps bear a place out, and move it to where they fit best."""
        held, track, settings = self._held(source), self._tracks[source], self._settings
        if held is None:
            return []
        fit = judge(reference, peer, held)
        if fit.matched + fit.contradicted < settings.least_matched:
            return []  # they overlap too little to tell
        pose = refine(reference, peer, held)
        moved = judge(reference, peer, pose)
        if max(moved, fit, key=lambda f: f.score).contradiction > settings.withdraw_contradiction:
            return self._strike(source, fit, "the maps contradict it")
        track.strikes, track.fit = 0, fit
        if are_apart(pose, held, peer.centre) or not self._is_sound(moved) or moved.score < fit.score:
            return []
        shift, turn = difference(pose, held, peer.centre)
        if shift < settings.move_m and turn < settings.move_rad:
            return []
        track.fit = moved
        self._put(source, pose)
        return [source]

    def _strike(self, source: int, fit: Fit, why: str) -> list[int]:
        track = self._tracks[source]
        track.strikes, track.fit = track.strikes + 1, fit
        track.seen = (0, 0)  # look again even if nothing comes
        if track.strikes < self._settings.strikes:
            track.checks = -1  # and search, since the check says that something is wrong
            return []
        self._tracks[source] = _Track(next_at=track.next_at, fit=fit)
        self._evidence.place(source, None)
        _log.warning("the frame of drone %d is not known any more: %s", source, why)
        return [source]

    def _agree(self, a: Pose, b: Pose, peer: Field) -> bool:
        shift, turn = difference(a, b, peer.centre)
        return shift <= self._settings.agree_m and turn <= self._settings.agree_rad
