"""`imagine evaluate`: from its flags to the table, the files and the pictures."""

from __future__ import annotations

import contextlib
import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as Bar

from imagine.core.errors import InputError, WorkError
from imagine.evaluate_lists import level_list, policy_list, protocol_list, team_sizes, within_area
from imagine.evaluate_table import table_of, title_of
from imagine.kernel_cache import announce_compiling
from imagine.onboard.settings import DEFAULT_POLICY
from imagine.outputs import check_outputs
from imagine.sim.film import Film
from imagine.stop_signals import StopSignals
from imagine.train.atomic_file import write_atomically, write_failure
from imagine.train.evaluation.comparison import Comparison, Flight, Progress
from imagine.train.evaluation.contenders import distinct, named_contender, reference_of
from imagine.train.evaluation.env import shared_envs
from imagine.train.evaluation.plan import Launch, Plan


@dataclass(frozen=True)
class EvaluateOptions:
    """What the flags say, lists still as they were given; no `policies` is the shipped one."""

    policies: Sequence[str] = ()
    against: str | None = None
    levels: str = "0-6"
    max_area_m2: float | None = None
    drones: str = "3"
    protocol: str = "one-hop"
    launch: str = "point"
    episodes: int = 20
    seed: int = 0
    json_file: Path | None = None
    episodes_file: Path | None = None
    plots: Path | None = None
    film_file: Path | None = None
    overrides: Sequence[str] = ()


def evaluate_and_show(options: EvaluateOptions) -> None:
    """Fly every policy over the same episodes; show a row each, write what is wanted, row by row as they come.

    Raises InputError before anything is flown where a flag is wrong; WorkError where a file cannot be written in the
    end, or the work was interrupted: then all finished rows have been shown and written.
    """
    _check_files(options)
    comparison = _comparison(options)
    film = None if options.film_file is None else Film()
    try:
        with StopSignals(), _progress(comparison) as progress:
            for flight in comparison.fly(progress, film):
                _write_rows(options.json_file, comparison)
                _append_episodes(options.episodes_file, comparison, flight)
    except KeyboardInterrupt as error:
        done = len(comparison.flown)
        kept = f", kept in {options.json_file}" if done and options.json_file is not None else ""
        raise WorkError(f"evaluate: interrupted; {done} of {comparison.flights} rows were done{kept}") from error
    finally:
        if comparison.rows:
            Console().print(table_of(comparison.rows, title_of(comparison.rows, options.launch, options.overrides)))
    if options.plots is not None:
        from imagine.train.evaluation.plots import write_plots

        for path in write_plots(comparison, options.plots):
            _say(f"{path}")
    if film is not None and options.film_file is not None:
        encoded = film.encode(options.film_file.suffix)
        write_atomically(options.film_file, lambda temporary: temporary.write_bytes(encoded))
        _say(f"{options.film_file}: {len(film)} pictures, {len(encoded) / 1e6:.2f} MB")


def _comparison(options: EvaluateOptions) -> Comparison:
    """Return what the flags ask for, ready to fly. Raises InputError."""
    if options.launch not in ("point", "random"):
        raise InputError(f"--launch {options.launch}: expected point or random")
    launch: Launch = "point" if options.launch == "point" else "random"
    if options.max_area_m2 is not None and not options.max_area_m2 > 0.0:
        raise InputError(f"--max-area {options.max_area_m2:g}: give square metres, more than 0")
    levels, sizes, protocols = level_list(options.levels), team_sizes(options.drones), protocol_list(options.protocol)
    given = policy_list(options.policies) or [str(DEFAULT_POLICY)]
    named = distinct([named_contender(name, options.seed) for name in given])
    contenders, reference = reference_of(named, options.against, options.seed)
    envs = shared_envs(contenders, options.overrides)
    kept = within_area(levels, options.max_area_m2)
    plan = Plan(tuple(kept), tuple(sizes), tuple(protocols), options.episodes, options.seed, launch)
    comparison = Comparison(contenders, envs, plan, reference)
    if options.max_area_m2 is not None:  # not before: what is refused is refused in one line
        _say(f"{len(kept)} of {len(levels)} levels have at most {options.max_area_m2:g} m² of free space")
    return comparison


def _check_files(options: EvaluateOptions) -> None:
    """Raise InputError naming a file or folder that cannot be written, or lacks what draws it."""
    check_outputs(options.json_file, film_file=options.film_file)
    check_outputs(options.episodes_file)
    if options.episodes_file is not None and options.episodes_file == options.json_file:
        raise InputError("--episodes-json and --json are the same file: give two")
    if options.plots is not None:
        from imagine.train.evaluation.plots import check_plots

        check_plots(options.plots)


@contextlib.contextmanager
def _progress(comparison: Comparison) -> Iterator[Progress]:
    """Tell how far it is: by a bar on a terminal, else by a line for each row that begins."""
    announce_compiling(_say)
    console = Console(stderr=True)
    if not console.is_terminal:
        yield Progress(begins=_say)
        return
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Bar(*columns, console=console, transient=True) as bar:
        task = bar.add_task("episodes", total=comparison.flights * comparison.plan.episodes)
        yield Progress(lambda text: bar.update(task, description=text), lambda ended: bar.advance(task, ended))


def _write_rows(path: Path | None, comparison: Comparison) -> None:
    """Write all rows so far anew, so that the file is whole whatever happens next."""
    if path is not None:
        text = json.dumps(comparison.rows, indent=1) + "\n"
        write_atomically(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def _append_episodes(path: Path | None, comparison: Comparison, flight: Flight) -> None:
    """Add a flight's episodes, one JSON object a line; the first flight begins the file anew."""
    if path is None:
        return
    lines = "".join(json.dumps(told) + "\n" for told in comparison.records(flight))
    try:
        with path.open("w" if len(comparison.flown) == 1 else "a", encoding="utf-8") as file:
            file.write(lines)
    except OSError as error:
        raise write_failure(path, error) from error


def _say(text: str) -> None:
    print(text, file=sys.stderr)
