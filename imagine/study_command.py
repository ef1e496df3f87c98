"""What `imagine study` reads from its flags, how it shows what goes on, and the tables at the end."""

from __future__ import annotations

import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from imagine.core.errors import InputError, WorkError
from imagine.outputs import write_json
from imagine.train.study.events import Event
from imagine.train.study.folder import StudyFolder
from imagine.train.study.plan import Trial, plan_trials, total_steps
from imagine.train.study.plot import plot_summary
from imagine.train.study.results import study_data, write_results
from imagine.train.study.run import run_study
from imagine.train.study.settings import STUDIES, StudySettings, load_study_settings
from imagine.train.study.trial import METRICS

_MOST_ROWS = 40
_TELL_EVERY_S = 30.0


def study_and_show(
    file: Path,
    address: str | None,
    resume: bool,
    dry_run: bool,
    cpus: int | None,
    overrides: list[str],
    json_file: Path | None,
) -> None:
    """Run a study, print its conditions and write all results; with `dry_run` only check and show its trials.

    Raises InputError for what is wrong before the first trial; WorkError when trials failed or the study was stopped,
    after the results so far are written.
    """
    try:
        study = load_study_settings(file, overrides)
    except InputError as error:
        raise InputError(f"{error}{_packaged(file)}") from error
    trials = plan_trials(study)
    if dry_run:
        if resume:
            StudyFolder(study).check_known(trials)
        _show_plan(study, trials)
        return
    print(f"{study.folder}: {len(trials)} trials", file=sys.stderr)
    result = run_study(study, address, resume, _Progress(trials), cpus)
    data = study_data(study, result)
    write_results(result.folder.path, data)
    plot_summary(result.folder.path / "summary.png", data)
    write_json(json_file, data)
    _show(data)
    counts = Counter(row["status"] for row in data["trials"])
    told = ", ".join(f"{count} {status}" for status, count in counts.items())
    print(f"{result.folder.path}: {told}; results.json, results.csv, summary.png")
    again = f"go on with: imagine study {file} --resume"
    if result.stopped:
        raise WorkError(f"{result.stopped}; {again}")
    if counts["failed"]:
        first = next(row for row in data["trials"] if row["status"] == "failed")
        raise WorkError(f"{counts['failed']} trials failed, such as {first['trial']}: {first['error']}; {again}")


def _packaged(file: Path) -> str:
    if file.exists() or file.parent != Path() or (STUDIES / f"{file.name}.yaml").exists():
        return ""
    return f"; packaged studies: {', '.join(sorted(path.stem for path in STUDIES.glob('*.yaml')))}"


def _show_plan(study: StudySettings, trials: list[Trial]) -> None:
    for trial in trials:
        print(f"{trial.name}  {total_steps(trial.settings):,} agent-steps  {trial.condition}")
    print(f"{study.name}: {len(trials)} trials, {sum(total_steps(t.settings) for t in trials):,} agent-steps")


class _Progress:
    """Says on standard error what happens to trials, and now and then how far they are."""

    def __init__(self, trials: list[Trial]) -> None:
        self._total = sum(total_steps(trial.settings) for trial in trials)
        self._steps: dict[str, float] = {}
        self._told = time.monotonic()

    def __call__(self, event: Event) -> None:
        """Take one event."""
        if "agent_steps" in event.numbers:
            self._steps[event.trial] = event.numbers["agent_steps"]
        if event.kind != "reported":
            at = f" at {event.numbers['agent_steps']:,.0f} agent-steps" if "agent_steps" in event.numbers else ""
            print(f"{event.trial}: {event.kind}{at}{f': {event.error}' if event.error else ''}", file=sys.stderr)
        elif time.monotonic() - self._told >= _TELL_EVERY_S:
            self._told = time.monotonic()
            done = sum(self._steps.values())
            print(f"{done:,.0f} of {self._total:,} agent-steps, {done / self._total:.0%}", file=sys.stderr)


def _show(data: dict[str, Any]) -> None:
    """Print the conditions, best first."""
    title = f"{data['study']}, best {data['metric']} first"
    table = Table(title=escape(title), box=None, title_justify="left", pad_edge=False)
    table.add_column("condition")
    table.add_column("ended", justify="right")
    for name in METRICS:
        table.add_column(name, justify="right")
    for row in data["conditions"][:_MOST_ROWS]:
        ended = f"{row['ended']}/{row['trials']}" + (f", {row['pruned']} early" if row["pruned"] else "")
        table.add_row(escape(row["condition"]), ended, *(_cell(row, name) for name in METRICS))
    if len(data["conditions"]) > _MOST_ROWS:
        table.caption = f"and {len(data['conditions']) - _MOST_ROWS} more in results.json"
    Console().print(table)


def _cell(row: dict[str, Any], name: str) -> str:
    """Return a mean, with half the width of its interval where there is one."""
    if row[name] is None:
        return "–"
    interval = row[f"{name}_ci95"]
    return f"{row[name]:.3g}" + (f" ± {(interval[1] - interval[0]) / 2.0:.2g}" if interval else "")
