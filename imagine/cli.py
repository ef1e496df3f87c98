"""The `imagine` command. Each command reads its flags, calls the part that does the work, and shows the outcome.

Exit status 0: done; 1: the work failed; 2: the input was wrong. Failures are one line on standard error.
"""

from __future__ import annotations

import contextlib
import json
import logging
import sys
import time
from pathlib import Path
from typing import Annotated, Any, cast, get_args

import click
import typer

from imagine import __version__
from imagine.core.errors import ImagineError, InputError
from imagine.mesh_comm.settings import Protocol

_BEGAN = time.monotonic()

app = typer.Typer(
    name="imagine",
    help="Small drones explore unknown indoor spaces together: train, export, fly, watch.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)
export_app = typer.Typer(help="Turn checkpoints into models that fly.", no_args_is_help=True, rich_markup_mode=None)
app.add_typer(export_app, name="export")

JsonFile = Annotated[Path | None, typer.Option("--json", metavar="FILE", help="write the results here as JSON")]
Overrides = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="override a setting; may be given many times")
]


def main() -> None:
    """Run the command line and exit with its status."""
    logging.basicConfig(level=logging.WARNING, format="imagine: %(message)s", stream=sys.stderr)
    try:
        status = app(standalone_mode=False)
    except ImagineError as error:
        print(f"imagine: {error}", file=sys.stderr)
        status = error.exit_status
    except click.UsageError as error:
        command = error.ctx.command_path if error.ctx is not None else "imagine"
        print(f"imagine: {error.format_message().rstrip('.')}; see {command} --help", file=sys.stderr)
        status = 2
    except (KeyboardInterrupt, click.Abort):
        print("imagine: interrupted", file=sys.stderr)
        status = 130
    sys.exit(status if isinstance(status, int) else 0)


@app.callback(invoke_without_command=True)
def _top(
    version: Annotated[bool, typer.Option("--version", help="print the version and exit")] = False,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="log what goes on")] = False,
) -> None:
    if version:
        print(f"imagine {__version__}")
        raise typer.Exit
    if verbose:
        logging.getLogger().setLevel(logging.INFO)


@app.command()
def fly(
    sim: Annotated[bool, typer.Option("--sim", help="fly in the twin: all drones on this machine")] = False,
    level: Annotated[str, typer.Option(help="with --sim: a level, 0 to 6, or a YAML file")] = "4",
    drones: Annotated[int, typer.Option(min=1, max=16, help="with --sim: how many drones")] = 3,
    policy: Annotated[str | None, typer.Option(help="ONNX file, or 'frontier' for the planner alone")] = None,
    protocol: Annotated[str, typer.Option(help="off, one-hop or multi-hop")] = "one-hop",
    ticks: Annotated[int, typer.Option(min=1, help="with --sim: fly so long at most, in tenths of a second")] = 1000,
    lockstep: Annotated[bool, typer.Option("--lockstep", help="repeatable, as fast as the machine")] = False,
    speed: Annotated[float, typer.Option(min=0.01, max=100.0, help="simulated seconds per second")] = 1.0,
    headless: Annotated[bool, typer.Option("--headless", help="without ground station")] = False,
    seed: Annotated[int, typer.Option(min=0, help="with --sim: of sensors, radio and vehicles")] = 0,
    port: Annotated[int, typer.Option(min=0, max=65535, help="of the ground station's page")] = 8770,
    map_file: Annotated[Path | None, typer.Option("--map", metavar="FILE.png", help="draw the flown map here")] = None,
    json_file: JsonFile = None,
    vehicle: Annotated[str | None, typer.Option(metavar="URL", help="on a drone: MAVLink, udpin://host:port")] = None,
    lidar: Annotated[str | None, typer.Option(metavar="URL", help="on a drone: LiDAR, udpin://host:port")] = None,
    mesh: Annotated[str | None, typer.Option(metavar="URL", help="on a drone: the swarm's radio link")] = None,
    config: Annotated[Path | None, typer.Option(metavar="FILE.yaml", help="on a drone: all settings")] = None,
    overrides: Overrides = None,
) -> None:
    """Fly the team: with --sim in the twin on this machine, with --vehicle one real (or served) drone."""
    if sim == (vehicle is not None or config is not None):
        raise InputError("fly: give --sim to fly in the twin, or --vehicle URL and --lidar URL on a drone")
    if not sim:
        _fly_vehicle(vehicle, lidar, mesh, policy, _protocol(protocol), config, overrides or [], json_file)
        return
    for flag, value in (("--lidar", lidar), ("--mesh", mesh), ("--set", overrides)):
        if value:
            raise InputError(f"{flag} is for a drone of its own; --sim wires its drones itself")
    from imagine.fly_command import fly_in_twin

    fly_in_twin(
        _BEGAN, level=level, drones=drones, policy=policy, protocol=_protocol(protocol), ticks=ticks, lockstep=lockstep,
        speed=speed, headless=headless, seed=seed, port=port, map_file=map_file, json_file=json_file,
    )  # fmt: skip


def _fly_vehicle(
    vehicle: str | None,
    lidar: str | None,
    mesh: str | None,
    policy: str | None,
    protocol: Protocol,
    config: Path | None,
    overrides: list[str],
    json_file: Path | None,
) -> None:
    from imagine.core.config import load_settings
    from imagine.onboard.process import run_drone
    from imagine.onboard.settings import DroneSettings

    given: dict[str, Any] = {"vehicle": vehicle, "lidar": lidar, "mesh": mesh, "report": json_file}
    flags = [f"{key}={json.dumps(str(value))}" for key, value in given.items() if value is not None]
    if policy is not None:
        flags.append("policy=null" if policy == "frontier" else f"policy={json.dumps(policy)}")
    if config is None:
        flags.append(f"radio.protocol={protocol}")
    logging.getLogger().setLevel(logging.INFO)
    status = run_drone(load_settings(DroneSettings, config, [*flags, *overrides]))
    if status:
        raise typer.Exit(status)


@app.command()
def replay(
    recording: Annotated[
        Path, typer.Argument(help="a LiDAR recording: CARMEN log, BreezySLAM .dat, scan CSV, YDLIDAR")
    ],
    json_file: JsonFile = None,
    map_file: Annotated[Path | None, typer.Option("--map", metavar="FILE.png", help="draw the map here")] = None,
    verify: Annotated[bool, typer.Option("--verify", help="replay twice and compare bit for bit")] = False,
) -> None:
    """Put a real LiDAR recording through the onboard code."""
    from rich.console import Console
    from rich.progress import Progress

    from imagine.onboard.replay import replay_file

    with Progress(transient=True, console=Console(stderr=True)) as bar:
        task = bar.add_task(recording.name, total=None)
        result = replay_file(
            recording,
            None,
            json_file,
            map_file,
            verify,
            lambda done, total: bar.update(task, completed=done, total=total),
        )
    found = result.as_json()
    _table(
        f"replay of {recording.name}",
        {
            "scans": found["scans"],
            "tracked": found["tracked"],
            "position error, rms": f"{found['ate_rmse_m']:.3f} m" if "ate_rmse_m" in found else "no reference",
            "time a scan": f"{found['scan_ms']['p50']:.1f} ms median, {found['scan_ms']['p99']:.1f} ms worst in 100",
            "verified": "the same, bit for bit" if verify else "not asked for",
        },
    )


@app.command()
def train(
    config: Annotated[Path | None, typer.Argument(help="YAML; without it the shipped policy's own recipe")] = None,
    overrides: Overrides = None,
    resume: Annotated[Path | None, typer.Option(metavar="RUN", help="go on with this run folder")] = None,
) -> None:
    """Train a policy: imitation of the frontier planner, then PPO."""
    _needs("torch", "train")
    from rich.console import Console

    from imagine.train.report import LiveReporter, LogReporter
    from imagine.train.trainer import train as run_training

    console = Console()
    with contextlib.ExitStack() as stack:
        report = stack.enter_context(LiveReporter(console)) if console.is_terminal else LogReporter()
        result = run_training(config, tuple(overrides or ()), resume, report)
    word = "finished" if result.finished else f"stopped; go on with: imagine train --resume {result.folder}"
    print(f"{result.folder}: {result.agent_steps} agent-steps, {word}")


@app.command()
def evaluate(
    policy: Annotated[str, typer.Option(help="ONNX file, checkpoint, run folder, 'frontier' or 'random'")] = "",
    levels: Annotated[str, typer.Option(help="such as 4, 0-6 or 1,3,5, or YAML files")] = "0-6",
    drones: Annotated[str, typer.Option(help="such as 3 or 1,2,3")] = "3",
    protocol: Annotated[str, typer.Option(help="off, one-hop or multi-hop")] = "one-hop",
    episodes: Annotated[int, typer.Option(min=1)] = 20,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    json_file: JsonFile = None,
) -> None:
    """Measure a policy in the batched twin: coverage, time to 90%, contacts, bytes."""
    _needs("torch", "train")
    from imagine.onboard.settings import DEFAULT_POLICY
    from imagine.train.evaluation import evaluate as measure
    from imagine.train.evaluation import named_policy

    chosen = named_policy(policy or str(DEFAULT_POLICY))
    rows = measure(
        chosen, _level_list(levels), _numbers("--drones", drones), _protocol(protocol), episodes, seed,
        progress=lambda text: print(text, file=sys.stderr),
    )  # fmt: skip
    from rich.console import Console
    from rich.table import Table

    table = Table(title=f"{policy or 'shipped policy'}, {protocol}, {episodes} episodes each")
    shown = (
        "level",
        "drones",
        "coverage_mean",
        "t90_mean",
        "t90_reached",
        "t95_mean",
        "collisions_per_episode",
        "path_m",
    )
    for name in shown:
        table.add_column(name, justify="right")
    for row in rows:
        table.add_row(*(f"{row[name]:.3g}" if isinstance(row[name], float) else str(row[name]) for name in shown))
    Console().print(table)
    _write_json(json_file, rows)


@export_app.command("onnx")
def export_onnx(
    checkpoint: Annotated[Path, typer.Argument(help="a checkpoint, or a run folder for its latest")],
    out: Annotated[Path, typer.Option("-o", "--out", metavar="FILE.onnx")],
    name: Annotated[str | None, typer.Option(help="the policy's name, in its contract")] = None,
) -> None:
    """Write a checkpoint's policy as ONNX with its contract, after proving that both give the same actions."""
    _needs("torch", "train")
    from imagine.export.onnx_export import export_onnx as write

    _show_inspection(write(checkpoint, out, name))


@export_app.command("inspect")
def export_inspect(model: Path) -> None:
    """Show a model's contract and check its hash."""
    _needs("onnx", "train")
    from imagine.export.onnx_export import inspect

    _show_inspection(inspect(model))


def _show_inspection(found: Any) -> None:
    print(json.dumps(found.contract.model_dump(mode="json"), indent=2))
    print(f"{found.path}: {found.size_bytes / 1e6:.2f} MB, {found.parameters} weights, hash matches")


@app.command()
def gcs(
    config: Annotated[Path | None, typer.Option(metavar="FILE.yaml")] = None,
    mesh: Annotated[str | None, typer.Option(metavar="URL", help="the swarm's radio link")] = None,
    key_file: Annotated[Path | None, typer.Option("--key", metavar="FILE", help="the swarm's key")] = None,
    port: Annotated[int | None, typer.Option(min=0, max=65535, help="of the page")] = None,
    overrides: Overrides = None,
) -> None:
    """Watch a real fleet: the page and a live table."""
    import os
    import threading

    from rich.console import Console
    from rich.live import Live

    from imagine.core.config import load_settings
    from imagine.gcs.station import StationSettings, run_station
    from imagine.gcs.table import render
    from imagine.mesh_comm.keys import find_key

    flags = [f"mesh={json.dumps(mesh)}"] if mesh is not None else []
    flags += [f"port={port}"] if port is not None else []
    settings = load_settings(StationSettings, config, [*flags, *(overrides or [])])
    key = find_key(key_file, os.environ)
    stop = threading.Event()
    with Live(console=Console(), auto_refresh=False) as live, contextlib.suppress(KeyboardInterrupt):
        run_station(
            settings,
            key,
            lambda url: live.console.print(f"ground station: {url}"),
            lambda snapshot: live.update(render(snapshot), refresh=True),
            stop,
        )


@app.command()
def keygen(out: Annotated[Path, typer.Argument(help="where the key goes; the file must not exist")]) -> None:
    """Make a key for a swarm's radio."""
    from imagine.mesh_comm.keys import write_new_key

    write_new_key(out)
    print(f"{out}: a new key, readable by you alone; copy it to every drone and the ground station")


def _needs(package: str, extra: str) -> None:
    from importlib.util import find_spec

    if find_spec(package) is None:
        raise InputError(f"this command needs {package}: pip install imagine-swarm[{extra}]")


def _protocol(name: str) -> Protocol:
    for known in get_args(Protocol):
        if name == known:
            return cast(Protocol, known)
    raise InputError(f"--protocol {name}: expected {', '.join(get_args(Protocol))}")


def _level_list(text: str) -> list[str]:
    levels: list[str] = []
    for part in text.split(","):
        first, dash, last = part.strip().partition("-")
        if dash and first.isdecimal() and last.isdecimal():
            levels += [str(number) for number in range(int(first), int(last) + 1)]
        else:
            levels.append(part.strip())
    return levels


def _numbers(flag: str, text: str) -> list[int]:
    try:
        numbers = [int(part) for part in text.split(",")]
    except ValueError as error:
        raise InputError(f"{flag} {text}: expected whole numbers such as 3 or 1,2,3") from error
    if not all(1 <= number <= 16 for number in numbers):
        raise InputError(f"{flag} {text}: from 1 to 16 drones")
    return numbers


def _table(title: str, rows: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(title=title, show_header=False, title_justify="left")
    for name, value in rows.items():
        table.add_row(name, str(value))
    Console().print(table)


def _write_json(path: Path | None, data: Any) -> None:
    if path is None:
        return
    try:
        path.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")
    except OSError as error:
        raise InputError(f"{path}: the results cannot be written: {error.strerror}") from error


if __name__ == "__main__":
    main()
