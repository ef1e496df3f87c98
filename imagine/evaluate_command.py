"""What `imagine evaluate` reads from its flags, and the table it shows."""

from __future__ import annotations

import functools
import sys
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from imagine.core.errors import InputError
from imagine.kernel_cache import announce_compiling
from imagine.mesh_comm.settings import Protocol
from imagine.onboard.settings import DEFAULT_POLICY
from imagine.outputs import write_json
from imagine.sim.film import Film
from imagine.sim.level_names import expand_level
from imagine.train.atomic_file import write_atomically
from imagine.train.evaluation import evaluate, named_policy
from imagine.train.evaluation_env import evaluation_env

_SHOWN = {
    "level": "level", "drones": "drones", "coverage_mean": "seen", "t90_mean": "T90", "t90_reached": "T90\nreached",
    "t95_mean": "T95", "t99_mean": "T99", "collisions_per_episode": "contacts", "path_m": "path,\nm",
    "bytes_per_drone": "bytes\na drone", "link_share": "linked", "productivity_ratio": "most /\nleast",
}  # fmt: skip
"""Keys of a row that the table shows, and how it names them."""


def evaluate_and_show(
    policy: str,
    levels: str,
    drones: str,
    protocol: Protocol,
    episodes: int,
    seed: int,
    json_file: Path | None,
    film_file: Path | None = None,
    overrides: Sequence[str] = (),
) -> None:
    """Measure a policy (empty: the shipped one), print a row per level and team size, film the first episode.

    `overrides` change the environment, see `evaluation_env`.
    Raises WorkError where the film cannot be written in the end; see `outputs.check_outputs` for before.
    """
    chosen_levels, sizes = level_list(levels), team_sizes(drones)
    chosen = named_policy(policy or str(DEFAULT_POLICY))
    env = evaluation_env(chosen, overrides)
    film = None if film_file is None else Film()
    rows = evaluate(
        chosen, chosen_levels, sizes, protocol, episodes, seed,
        env, _tell, film,
    )  # fmt: skip
    title = ", ".join([policy or "shipped policy", protocol, f"{episodes} episodes each", *overrides])
    table = Table(title=escape(title), box=None, padding=(0, 1, 0, 0))  # so that it fits into 80 columns
    for heading in _SHOWN.values():
        table.add_column(heading, justify="right")
    for row in rows:
        table.add_row(*(_cell(row[name]) for name in _SHOWN))
    Console().print(table)
    write_json(json_file, rows)
    if film is not None and film_file is not None:
        encoded = film.encode(film_file.suffix)
        write_atomically(film_file, lambda temporary: temporary.write_bytes(encoded))
        print(f"{film_file}: {len(film)} pictures, {len(encoded) / 1e6:.2f} MB", file=sys.stderr)


def _tell(text: str) -> None:
    _announce()  # not before: a wrong level is refused in one line
    _say(text)


@functools.cache
def _announce() -> None:
    announce_compiling(_say)


def _say(text: str) -> None:
    print(text, file=sys.stderr)


def _cell(value: object) -> str:
    """Return a number with three figures, thousands in full."""
    if isinstance(value, float):
        return f"{value:.0f}" if abs(value) >= 1000.0 else f"{value:.3g}"
    return str(value)


def level_list(text: str) -> list[str]:
    """Return the levels of a list such as 4, 0-6 or 1,3,house.yaml; house:0-9 and house:0-9:120 are ten houses each.

    Raises InputError as `expand_level` does, and where a name is missing.
    """
    levels: list[str] = []
    for part in (part.strip() for part in text.split(",")):
        if not part:
            raise InputError(f"--levels {text!r}: a level is missing: give such as 4, 0-6 or 1,3,house.yaml")
        levels += expand_level(part, "--levels")
    return levels


def team_sizes(text: str) -> list[int]:
    """Return the numbers of a list such as 3 or 1,2,3. Raises InputError past 1 to 16."""
    try:
        numbers = [int(part) for part in text.split(",")]
    except ValueError as error:
        raise InputError(f"--drones {text}: expected whole numbers such as 3 or 1,2,3") from error
    if not all(1 <= number <= 16 for number in numbers):
        raise InputError(f"--drones {text}: from 1 to 16 drones")
    return numbers
