"""Who can be evaluated: baselines by their names, networks by their files; each a pilot, and what it was made for."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from imagine.core.errors import InputError
from imagine.onboard.settings import DEFAULT_POLICY
from imagine.sim.exploration_settings import ExplorationSettings
from imagine.train.baselines import BASELINES, baseline
from imagine.train.pilots import Pilot
from imagine.train.policies import Policy, PolicyPilot, load_policy

STRONGEST = "coordinated"
"""The baseline that others are compared with where none is named."""


@dataclass(frozen=True)
class Contender:
    """Who flies, and under what name.

    `env` is the environment a network was made for, None for planners and chance, which take any; `given` is what it
    was asked for by.
    """

    name: str
    pilot: Pilot
    env: ExplorationSettings | None = None
    given: str = ""

    @property
    def is_baseline(self) -> bool:
        """Whether it is a planner or chance, not a network."""
        return self.env is None


def contender_of(who: Pilot | Policy | str, seed: int = 0) -> Contender:
    """Return a pilot, a network's policy, or a baseline given by its name, as a contender."""
    if isinstance(who, str):
        return Contender(who, baseline(who, seed), given=who)
    if isinstance(who, Policy):
        return Contender(who.name, PolicyPilot(who), who.env or ExplorationSettings(), who.name)
    return Contender(who.name, who, given=who.name)


def named_contender(given: str, seed: int = 0) -> Contender:
    """Return a baseline by its name, a policy in a file (ONNX, checkpoint, run folder), or a shipped one by its name.

    A file goes before a shipped policy of that name. Raises InputError when it is none of these, with the nearest name.
    """
    if given in BASELINES:
        return contender_of(given, seed)
    path = Path(given)
    shipped = DEFAULT_POLICY.parent / f"{given}.onnx"
    if not path.exists() and path.name == given and shipped.exists():
        path = shipped
    if not path.exists():
        raise InputError(f"{given}: no such policy{_nearest(given)}")
    return replace(contender_of(load_policy(path)), given=given)


def _nearest(given: str) -> str:
    """Say what may have been meant."""
    names = [*BASELINES, *sorted(path.stem for path in DEFAULT_POLICY.parent.glob("*.onnx"))]
    close = difflib.get_close_matches(given, names, n=1, cutoff=0.5)
    if close:
        return f"; did you mean '{close[0]}'?"
    return f": give an ONNX file, a checkpoint, a run's folder, or one of {', '.join(names)}"


def distinct(contenders: Sequence[Contender]) -> list[Contender]:
    """Return the contenders under names of their own: those with a common one go by what they were asked for by.

    Raises InputError where one is asked for twice.
    """
    names = [contender.name for contender in contenders]
    renamed = [replace(c, name=c.given) if names.count(c.name) > 1 else c for c in contenders]
    for number, contender in enumerate(renamed):
        if any(contender.name == other.name for other in renamed[:number]):
            raise InputError(f"--policy {contender.given}: is given twice")
    return renamed


def reference_of(
    contenders: Sequence[Contender], against: str | None, seed: int = 0
) -> tuple[list[Contender], int | None]:
    """Return who flies, and which of them the others are compared with; None where one flies alone.

    `against` names one of the contenders, or else anyone, who then flies as well. Without it the last baseline is the
    reference (chance only where there is no planner); where several networks and no baseline are given, the strongest
    baseline flies as well. Raises InputError on an unknown name.
    """
    flown = list(contenders)
    if against is None and len(flown) < 2:
        return flown, None
    if against is None:
        baselines = [number for number, contender in enumerate(flown) if contender.is_baseline]
        if baselines:
            planners = [number for number in baselines if flown[number].name != "random"]
            return flown, (planners or baselines)[-1]
        against = STRONGEST
    for number, contender in enumerate(flown):
        if against in (contender.name, contender.given):
            return flown, number
    try:
        reference = named_contender(against, seed)
    except InputError as error:
        raise InputError(f"--against {error}") from error
    return distinct([*flown, reference]), len(flown)
