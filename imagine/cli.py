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
from typing import TYPE_CHECKING, Annotated, Any, cast, get_args

import typer

from imagine import __version__
from imagine.core.errors import ImagineError, InputError
from imagine.outputs import check_outputs

if TYPE_CHECKING:  # a command imports what it runs when it runs, so that each starts fast
    from imagine.mesh_comm.settings import Frame, Protocol

_INTERRUPTED = 130
_BEGAN = time.monotonic()
_UsageError: type[Any] = typer.BadParameter.__mro__[1]  # click's, or that of the copy of click in newer typers

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
level_app = typer.Typer(
    help="Look at levels, check them, and generate houses.", no_args_is_help=True, rich_markup_mode=None
)
app.add_typer(level_app, name="level")
bench_app = typer.Typer(help="Measure how fast things are here.", no_args_is_help=True, rich_markup_mode=None)
app.add_typer(bench_app, name="bench")

_SIM_FLAGS = {"level", "drones", "ticks", "speed", "headless", "seed", "port", "map_file", "lockstep", "twin_file"}
_DRONE_FLAGS = {"vehicle", "lidar", "mesh", "config"}

JsonFile = Annotated[Path | None, typer.Option("--json", metavar="FILE", help="write the results here as JSON")]
Overrides = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="override a setting; may be given many times")
]
TwinFile = Annotated[
    Path | None, typer.Option("--twin", metavar="FILE.yaml", help="the twin's dynamics, sensing and radio")
]
LevelName = Annotated[
    str, typer.Argument(help="0 to 6, house:SEED, a level's YAML, a floor plan's JSON, plan.png@0.05")
]
LevelImage = Annotated[Path | None, typer.Option("--image", metavar="FILE.png", help="draw the level here")]


def main() -> None:
    """Run the command line and exit with its status."""
    logging.basicConfig(level=logging.WARNING, format="imagine: %(message)s", stream=sys.stderr)
    try:
        status = app(standalone_mode=False)
    except ImagineError as error:
        print(f"imagine: {' '.join(str(error).split())}", file=sys.stderr)  # one line, whatever is quoted in it
        status = error.exit_status
    except _UsageError as error:
        command = error.ctx.command_path if error.ctx is not None else "imagine"
        said = " ".join(error.format_message().split()).rstrip(".")
        print(f"imagine: {said}; see {command} --help", file=sys.stderr)
        status = 2
    except (KeyboardInterrupt, typer.Abort):
        status = _INTERRUPTED
    if status == _INTERRUPTED:  # which is also what typer makes of KeyboardInterrupt
        print("imagine: interrupted", file=sys.stderr)
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
    context: typer.Context,
    sim: Annotated[bool, typer.Option("--sim", help="fly in the twin: all drones on this machine")] = False,
    level: Annotated[str, typer.Option(help="with --sim: a level, 0 to 6, or a YAML file")] = "4",
    drones: Annotated[int, typer.Option(min=1, max=16, help="with --sim: how many drones")] = 3,
    policy: Annotated[str | None, typer.Option(help="ONNX file, or 'frontier' for the planner alone")] = None,
    protocol: Annotated[str | None, typer.Option(help="off, one-hop (the default) or multi-hop")] = None,
    frame: Annotated[str | None, typer.Option(help="the drones map in: shared, layout or unknown frames")] = None,
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
    twin_file: TwinFile = None,
    overrides: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="override a setting of the drone or the twin")
    ] = None,
) -> None:
    """Fly the team: with --sim in the twin on this machine, with --vehicle one real (or served) drone."""
    if sim == (vehicle is not None or config is not None):
        raise InputError("fly: give either --sim to fly in the twin, or --vehicle URL and --lidar URL on a drone")
    check_outputs(json_file, map_file)
    sources = {name: context.get_parameter_source(name) for name in context.params}
    given = {name for name, source in sources.items() if source is not None and source.name == "COMMANDLINE"}
    for name in sorted(given & (_DRONE_FLAGS if sim else _SIM_FLAGS)):
        flag = {"map_file": "--map", "twin_file": "--twin"}.get(name, f"--{name}")
        why = "is for a drone of its own; --sim wires its drones itself" if sim else "goes with --sim"
        raise InputError(f"fly: {flag} {why}")
    if not sim:
        _fly_vehicle(vehicle, lidar, mesh, policy, protocol, frame, config, overrides or [], json_file)
        return
    shared, begun = _protocol(protocol or "one-hop"), _frame(frame or "shared")  # refused before anything starts
    from imagine.runner_processes import RunnerProcesses

    with RunnerProcesses(drones) as processes:  # they load their code while this process loads its own
        from imagine.fly_command import fly_in_twin

        fly_in_twin(
            processes, _BEGAN, level=level, drones=drones, policy=policy, protocol=shared,
            frame=begun, ticks=ticks, lockstep=lockstep, speed=speed, headless=headless, seed=seed,
            port=port, map_file=map_file, json_file=json_file, twin_file=twin_file, overrides=overrides or [],
        )  # fmt: skip


def _fly_vehicle(
    vehicle: str | None,
    lidar: str | None,
    mesh: str | None,
    policy: str | None,
    protocol: str | None,
    frame: str | None,
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
    if protocol is not None:
        flags.append(f"radio.protocol={_protocol(protocol)}")
    if frame is not None:
        flags.append(f"radio.frame={_frame(frame)}")
    logging.getLogger().setLevel(logging.INFO)
    status = run_drone(load_settings(DroneSettings, config, [*flags, *overrides]))
    if status:
        raise typer.Exit(status)


@app.command()
def sim(
    level: Annotated[str, typer.Option(help="a level, 0 to 6, or a YAML file")] = "4",
    drones: Annotated[int, typer.Option(min=1, max=16)] = 3,
    base_port: Annotated[
        int, typer.Option(min=1024, max=60000, help="drone i is at this + i, its LiDAR 1000 and its radio 2000 above")
    ] = 14540,
    host: Annotated[str, typer.Option(help="address the twin listens on")] = "127.0.0.1",
    runners: Annotated[str, typer.Option(metavar="HOST", help="address of the runners")] = "127.0.0.1",
    lockstep: Annotated[bool, typer.Option("--lockstep", help="wait for every runner's setpoint")] = False,
    speed: Annotated[float, typer.Option(min=0.01, max=100.0, help="simulated seconds per second")] = 1.0,
    mesh: Annotated[bool, typer.Option(help="give each drone a radio modem")] = True,
    ticks: Annotated[int, typer.Option(min=0, help="serve so long, in tenths of a second; 0: until stopped")] = 0,
    seed: Annotated[int, typer.Option(min=0, help="of sensors, radio and vehicles")] = 0,
    wait: Annotated[float, typer.Option(min=0.1, help="seconds for the runners to connect")] = 600.0,
    twin_file: TwinFile = None,
    overrides: Overrides = None,
) -> None:
    """Serve the twin (vehicles, LiDARs, radio) for runners elsewhere: hardware in the loop."""
    from imagine.core.config import load_settings
    from imagine.sim.twin_settings import TwinSettings
    from imagine.sim_command import ServeOptions, serve_twin

    serve_twin(
        ServeOptions(
            level=level, drones=drones, base_port=base_port, host=host, runner_host=runners, lockstep=lockstep,
            speed=speed, mesh=mesh, ticks=ticks, seed=seed, wait_s=wait,
            twin=load_settings(TwinSettings, twin_file, overrides or []),
        )
    )  # fmt: skip


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
    check_outputs(json_file, map_file)
    from imagine.replay_command import replay_and_show

    replay_and_show(recording, json_file, map_file, verify)


@app.command()
def train(
    config: Annotated[Path | None, typer.Argument(help="YAML; without it the shipped policy's own recipe")] = None,
    overrides: Overrides = None,
    resume: Annotated[Path | None, typer.Option(metavar="RUN", help="go on with this run folder")] = None,
) -> None:
    """Train a policy: imitation of the frontier planner, then PPO."""
    _needs("torch", "train")
    from rich.console import Console

    from imagine.kernel_cache import announce_compiling
    from imagine.train.report import LiveReporter, LogReporter, Reporter
    from imagine.train.run import train as run_training

    announce_compiling(lambda text: print(text, file=sys.stderr))
    console = Console()
    with contextlib.ExitStack() as stack:
        if console.is_terminal:
            report: Reporter = stack.enter_context(LiveReporter(console))
        else:  # in a file or a job's log a line now and then is all there is to see
            logging.getLogger("imagine.train").setLevel(logging.INFO)
            report = LogReporter()
        result = run_training(config, tuple(overrides or ()), resume, report)
    word = "finished" if result.finished else f"stopped; go on with: imagine train --resume {result.folder}"
    print(f"{result.folder}: {result.agent_steps} agent-steps, {word}")


@app.command()
def study(
    file: Annotated[Path, typer.Argument(metavar="STUDY", help="a study's YAML, or a packaged one such as paradigms")],
    address: Annotated[
        str | None,
        typer.Option(metavar="HOST:PORT", help="head of a Ray cluster; by default one of this machine's own"),
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="keep the trials that ended, go on with the others")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="check and show the trials, run none")] = False,
    cpus: Annotated[int | None, typer.Option(min=1, help="of this machine; by default all")] = None,
    overrides: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="override a setting of the study")
    ] = None,
    json_file: JsonFile = None,
) -> None:
    """Train many policies that differ in chosen settings, on Ray, and compare them."""
    _needs("torch", "train")
    _needs("ray", "study")
    check_outputs(json_file)
    from imagine.study_command import study_and_show

    study_and_show(file, address, resume, dry_run, cpus, overrides or [], json_file)


@app.command()
def evaluate(
    policy: Annotated[
        list[str] | None,
        typer.Option(
            help="ONNX file, checkpoint, run folder or baseline (random, frontier, …); may be given many times"
        ),
    ] = None,
    against: Annotated[
        str | None, typer.Option(metavar="POLICY", help="whom the others are compared with, episode by episode")
    ] = None,
    levels: Annotated[str, typer.Option(help="such as 4, 0-6 or 1,3,5; files, folders, or patterns of files")] = "0-6",
    max_area: Annotated[float | None, typer.Option(metavar="M2", help="only levels with so much free space")] = None,
    drones: Annotated[str, typer.Option(help="such as 3 or 1,2,3")] = "3",
    protocol: Annotated[str, typer.Option(help="off, one-hop or multi-hop, or several")] = "one-hop",
    launch: Annotated[str, typer.Option(help="point: the level's own; random: anywhere, level mirrored")] = "point",
    episodes: Annotated[int, typer.Option(min=1, help="on each level, with each team and protocol")] = 20,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    plots: Annotated[Path | None, typer.Option(metavar="FOLDER", help="draw curves, times and a radar here")] = None,
    film: Annotated[Path | None, typer.Option(metavar="FILE.gif|FILE.mp4", help="film the first episode")] = None,
    json_file: JsonFile = None,
    episodes_file: Annotated[
        Path | None, typer.Option("--episodes-json", metavar="FILE", help="write every episode here, one a line")
    ] = None,
    overrides: Overrides = None,
) -> None:
    """Measure and compare policies in the batched twin: coverage, time to 90%, contacts, bytes."""
    _needs("torch", "train")
    check_outputs(json_file, film_file=film)
    from imagine.evaluate_command import EvaluateOptions, evaluate_and_show

    evaluate_and_show(
        EvaluateOptions(
            policies=tuple(policy or ()), against=against, levels=levels, max_area_m2=max_area, drones=drones,
            protocol=protocol, launch=launch, episodes=episodes, seed=seed, json_file=json_file,
            episodes_file=episodes_file, plots=plots, film_file=film, overrides=tuple(overrides or ()),
        )
    )  # fmt: skip


@export_app.command("onnx")
def export_onnx(
    checkpoint: Annotated[Path, typer.Argument(help="a checkpoint, or a run folder for its latest")],
    out: Annotated[Path, typer.Option("-o", "--out", metavar="FILE.onnx")],
    name: Annotated[str | None, typer.Option(help="the policy's name, in its contract")] = None,
) -> None:
    """Write a checkpoint's policy as ONNX with its contract, after proving that both give the same actions."""
    _needs("torch", "train")
    from imagine.export.onnx_export import export_onnx as write

    _show_inspection(out, write(checkpoint, out, name))


@export_app.command("inspect")
def export_inspect(model: Path) -> None:
    """Show a model's contract and check its hash."""
    _needs("onnx", "train")
    from imagine.export.onnx_export import inspect

    _show_inspection(model, inspect(model))


def _show_inspection(path: Path, found: Any) -> None:
    print(json.dumps(found.contract.model_dump(mode="json"), indent=2))
    print(f"{path}: {found.file_bytes / 1e6:.2f} MB, {found.parameters} weights, hash matches")


@level_app.command("list")
def level_list(json_file: JsonFile = None) -> None:
    """List the built-in levels."""
    check_outputs(json_file)
    from imagine.level_command import list_levels

    list_levels(json_file)


@level_app.command("show")
def level_show(name: LevelName, image: LevelImage = None, json_file: JsonFile = None) -> None:
    """Show a level's figures, and draw it."""
    check_outputs(json_file, image, map_flag="--image")
    from imagine.level_command import show_level

    show_level(name, image, json_file)


@level_app.command("check")
def level_check(
    names: Annotated[list[str], typer.Argument(metavar="NAME...", help="levels, or files")], json_file: JsonFile = None
) -> None:
    """Check that levels can be explored: connected, seen everywhere, with room to start."""
    check_outputs(json_file)
    from imagine.level_command import check_levels

    check_levels(names, json_file)


@level_app.command("floor")
def level_floor(
    names: Annotated[list[str], typer.Argument(metavar="NAME...", help="levels, or files")],
    drones: Annotated[int, typer.Option(min=1, max=16, help="in the team")] = 3,
    launches: Annotated[int, typer.Option(min=0, help="from so many random places as well")] = 0,
    share: Annotated[float, typer.Option(min=0.01, max=1.0, help="of the level that has to be seen")] = 0.9,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    json_file: JsonFile = None,
) -> None:
    """Tell how soon levels could be explored by drones that know them: no policy is quicker."""
    check_outputs(json_file)
    from imagine.floor_command import show_floors

    show_floors(names, drones, launches, share, seed, json_file)


@level_app.command("generate")
def level_generate(
    seed: Annotated[int, typer.Option(min=0, help="the house's number; with --count the first one's")] = 0,
    area: Annotated[float | None, typer.Option(help="floor area in m², 50 to 400; without it by chance")] = None,
    count: Annotated[int, typer.Option(min=1, help="so many houses, of this seed and those after it")] = 1,
    people: Annotated[int, typer.Option(min=0, max=20, help="so many people walk about")] = 0,
    crates: Annotated[int, typer.Option(min=0, max=50, help="so many boxes can be pushed")] = 0,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", metavar="FILE.yaml|FOLDER", help="without it to standard output")
    ] = None,
    image: LevelImage = None,
    json_file: JsonFile = None,
) -> None:
    """Generate furnished houses, the same for the same seed."""
    check_outputs(json_file, image, map_flag="--image")
    from imagine.level_command import generate_levels

    generate_levels(seed, area, count, people, crates, out, image, json_file)


@bench_app.command("train")
def bench_train(
    config: Annotated[Path | None, typer.Argument(help="a training configuration; by default `default`")] = None,
    worlds: Annotated[int | None, typer.Option(help="how many; by default 64")] = None,
    drones: Annotated[int | None, typer.Option(help="in each world; by default 3")] = None,
    rounds: Annotated[int | None, typer.Option(help="rollouts and updates to take medians of; by default 5")] = None,
    quick: Annotated[bool, typer.Option("--quick", help="small and rough, in seconds")] = False,
    overrides: Overrides = None,
    json_file: JsonFile = None,
) -> None:
    """Measure how fast training goes: rollout and update, and where the time goes."""
    _needs("torch", "train")
    check_outputs(json_file)
    from imagine.bench_train_command import bench_train_and_show

    bench_train_and_show(config, worlds, drones, rounds, quick, tuple(overrides or ()), json_file)


@bench_app.command("seal")
def bench_seal(
    datagrams: Annotated[int, typer.Option(min=100, max=1_000_000, help="of each kind")] = 20_000,
    json_file: JsonFile = None,
) -> None:
    """Measure how many datagrams a core seals, opens and refuses a second."""
    check_outputs(json_file)
    from imagine.bench_seal_command import bench_seal_and_show

    bench_seal_and_show(datagrams, json_file)


@bench_app.command("mesh")
def bench_mesh(
    level: Annotated[str | None, typer.Option(help="which level is explored; by default 6")] = None,
    flights: Annotated[int | None, typer.Option(help="how many, to compare schedulers on; by default 4")] = None,
    minutes: Annotated[float | None, typer.Option(help="a crowd flies to and fro for so long; by default 60")] = None,
    hostile: Annotated[int | None, typer.Option(help="so many false datagrams; by default 1000000")] = None,
    quick: Annotated[bool, typer.Option("--quick", help="small and rough, in seconds")] = False,
    json_file: JsonFile = None,
) -> None:
    """Measure the mesh on recorded explorations: agreement, bytes, schedulers, a crowd, speed, hostile datagrams."""
    _needs("torch", "train")
    check_outputs(json_file)
    from imagine.bench_mesh_command import bench_mesh_and_show

    bench_mesh_and_show(level, flights, minutes, hostile, quick, json_file)


@bench_app.command("twin")
def bench_twin(
    level: Annotated[str, typer.Option(help="a level, 0 to 6, or a YAML file")] = "6",
    beams: Annotated[str, typer.Option(help="LiDAR beams to compare at; growth is measured at the first")] = "64,360",
    worlds: Annotated[str | None, typer.Option(help="how many, for growth; by default 1,4,16,64,256,1024")] = None,
    drones: Annotated[str | None, typer.Option(help="how many, for growth; by default 1,2,3,4,8,16")] = None,
    seconds: Annotated[float | None, typer.Option(help="for each thing compared, 0.05 to 600; by default 3")] = None,
    quick: Annotated[bool, typer.Option("--quick", help="small and rough, in seconds")] = False,
    json_file: JsonFile = None,
    plot_file: Annotated[
        Path | None, typer.Option("--plot", metavar="FILE.png", help="draw here how the cost grows")
    ] = None,
) -> None:
    """Measure batched exploration in the twin against a plain implementation, and how its cost grows."""
    check_outputs(json_file)
    from imagine.bench_command import bench_twin_and_show

    bench_twin_and_show(level, beams, worlds, drones, seconds, quick, json_file, plot_file)


@app.command()
def gcs(
    config: Annotated[Path | None, typer.Option(metavar="FILE.yaml")] = None,
    mesh: Annotated[str | None, typer.Option(metavar="URL", help="the swarm's radio link")] = None,
    key_file: Annotated[Path | None, typer.Option("--key", metavar="FILE", help="the swarm's key")] = None,
    port: Annotated[int | None, typer.Option(min=0, max=65535, help="of the page")] = None,
    overrides: Overrides = None,
) -> None:
    """Watch a real fleet: the page and a live table."""
    from imagine.gcs_command import watch_fleet

    watch_fleet(config, mesh, key_file, port, overrides or [])


@app.command()
def doctor(json_file: JsonFile = None) -> None:
    """Look whether this machine has what each command needs."""
    check_outputs(json_file)
    from imagine.doctor_command import examine_and_show

    examine_and_show(json_file)


@app.command()
def keygen(
    out: Annotated[Path, typer.Argument(help="the drones' key file; it must not exist, or with --rotate must")],
    ground: Annotated[
        Path | None, typer.Option(metavar="FILE", help="the ground station's file: it alone can then give orders")
    ] = None,
    rotate: Annotated[bool, typer.Option("--rotate", help="add a new key to the file, and let the others end")] = False,
    after: Annotated[float, typer.Option(min=0.0, max=8760.0, help="hours until the new key sends")] = 24.0,
    overlap: Annotated[float, typer.Option(min=0.0, max=8760.0, help="hours the others are heard after that")] = 24.0,
) -> None:
    """Make a key for a swarm's radio, or change it."""
    from imagine.keygen_command import make_keys, renew_keys

    if rotate:
        renew_keys(out, ground, after, overlap)
    else:
        make_keys(out, ground)


def _needs(package: str, extra: str) -> None:
    from importlib.util import find_spec

    if find_spec(package) is None:
        raise InputError(f"this command needs {package}: pip install imagine-swarm[{extra}]")


def _protocol(name: str) -> Protocol:
    from imagine.mesh_comm.settings import Protocol

    for known in get_args(Protocol):
        if name == known:
            return cast(Protocol, known)
    raise InputError(f"--protocol {name}: expected {', '.join(get_args(Protocol))}")


def _frame(name: str) -> Frame:
    from imagine.mesh_comm.settings import Frame

    for known in get_args(Frame):
        if name == known:
            return cast(Frame, known)
    raise InputError(f"--frame {name}: expected {', '.join(get_args(Frame))}")


if __name__ == "__main__":
    main()
