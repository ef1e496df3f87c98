"""Wrong input to the command: one clear line, exit 2, no traceback, nothing left running.

Most cases call the command's `main` in this process; the kinds that matter most run the real command.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import socket
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest
from command_line import environment, run_imagine

from imagine.cli import main

ROOT = Path(__file__).resolve().parents[2]
DATA = Path(os.environ.get("IMAGINE_DATA", ROOT.parent / "shared" / "data")) / "lidar"
MARK = "IMAGINE_TEST_RUN"
HEADLESS = ["fly", "--sim", "--drones", "1", "--headless", "--policy", "frontier", "--ticks", "20"]


def refused(arguments: Sequence[str | Path], *said: str, status: int = 2, real: bool = False, **variables: str) -> None:
    """Run the command, expect it to refuse in one line that holds every pattern of `said`."""
    mark = f"test-{os.getpid()}-{os.urandom(6).hex()}"
    run = run_really if real else run_here
    found, stderr = run([str(argument) for argument in arguments], {**variables, MARK: mark})
    assert found == status, stderr
    lines = stderr.strip().splitlines()
    assert len(lines) == 1, stderr
    assert lines[0].startswith("imagine: ")
    for pattern in said:
        assert re.search(pattern, lines[0]), f"{pattern!r} is not in: {lines[0]}"
    assert left_running(mark) == []


def run_really(arguments: list[str], variables: dict[str, str]) -> tuple[int, str]:
    done = run_imagine(*arguments, env=environment(**variables))
    return done.returncode, done.stderr


def run_here(arguments: list[str], variables: dict[str, str]) -> tuple[int, str]:
    stderr = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stderr(stderr):
        patch.delenv("IMAGINE_MESH_KEY", raising=False)
        for name, value in variables.items():
            patch.setenv(name, value)
        patch.setattr(sys, "argv", ["imagine", *arguments])
        with pytest.raises(SystemExit) as exit_:
            main()
    assert isinstance(exit_.value.code, int)
    return exit_.value.code, stderr.getvalue()


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
    return port


def on_a_drone() -> list[str]:
    urls = [f"udpin://127.0.0.1:{free_port()}" for _ in range(2)]
    return ["fly", "--vehicle", urls[0], "--lidar", urls[1], "--policy", "frontier"]


def left_running(marker: str) -> list[str]:
    """The processes that carry a mark in their environment."""
    if not Path("/proc/self/environ").exists():
        return []
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            if marker.encode() in (process / "environ").read_bytes():
                found.append((process / "cmdline").read_bytes().decode())
        except OSError:  # it has ended meanwhile, or is somebody else's
            continue
    return found


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["fly"], ["--sim", "--vehicle"]),
        (["fly", "--sim", "--bogus"], ["--bogus", "imagine fly --help"]),
        (["fly", "--sim", "--drones", "17"], ["--drones", "16"]),
        (["fly", "--sim", "--ticks", "many"], ["--ticks", "integer"]),
        (["fly", "--sim", "--lidar", "udpin://127.0.0.1:1"], ["--lidar", "--sim"]),
        (["fly", "--vehicle", "udpin://127.0.0.1:1", "--level", "3"], ["--level", "--sim"]),
        (["fly", "--vehicle", "tcp://nowhere", "--policy", "frontier"], ["tcp://nowhere"]),
        (["fly", "--vehicle", "udpin://127.0.0.1:1", "--twin", "twin.yaml"], ["--twin", "--sim"]),
        ([*HEADLESS, "--set", "sensing.skw=true"], [r"unknown key 'sensing\.skw'", "did you mean 'skew'"]),
        ([*HEADLESS, "--set", "radio"], ["--set radio", "key=value"]),
        (["sim", "--set", "dynamics.lag_s=[0.3, 0.1]"], [r"dynamics\.lag_s", "range"]),
        (["sim", "--twin", "missing.yaml"], [r"missing\.yaml", "No such file"]),
        (["nonsense"], ["nonsense"]),
        (["export", "nonsense"], ["nonsense"]),
        (["replay"], ["recording"]),
        (["evaluate", "--levels", "6-0"], ["--levels 6-0", "0-6"]),
        (["evaluate", "--drones", "0"], ["--drones 0", "1 to 16"]),
        (["evaluate", "--levels", ""], ["--levels ''", "missing"]),
        (["evaluate", "--policy", "frontier", "--levels", "0,9"], ["unknown level '9'"]),
        (["evaluate", "--set", "env.dynamics.wind_mp=0.5"], [r"env\.dynamics\.wind_mp'", "did you mean 'wind_mps'"]),
        (["evaluate", "--set", "dynamics.wind_mps=0.5"], ["unknown key 'dynamics'", "valid keys: env"]),
        (["evaluate", "--policy", "frontir"], ["frontir: no such policy", "did you mean 'frontier'"]),
        (["evaluate", "--policy", "frontier", "--against", "randm"], ["--against randm", "did you mean 'random'"]),
        (["evaluate", "--policy", "frontier,frontier"], ["frontier: is given twice"]),
        (["evaluate", "--policy", "frontier", "--episodes", "0"], ["--episodes", "1"]),
        (["evaluate", "--policy", "frontier", "--launch", "high"], ["--launch high", "point or random"]),
        (["evaluate", "--policy", "frontier", "--max-area", "0"], ["--max-area 0", "more than 0"]),
        (["evaluate", "--policy", "frontier", "--protocol", "off,two-hop"], ["--protocol two-hop"]),
        (["evaluate", "--policy", "frontier", "--plots", "no/such"], ["--plots no/such", "does not exist"]),
        (["evaluate", "--policy", "frontier", "--levels", "*.plan"], ["no file fits"]),
        (["gcs", "--port", "70000"], ["--port", "65535"]),
        ([*HEADLESS, "--protocol", "two-hop"], ["--protocol two-hop", "off, one-hop, multi-hop"]),
        ([*HEADLESS, "--level", "7"], ["unknown level '7'", "0, 1, 2, 3, 4, 5, 6"]),
        ([*HEADLESS, "--level", "missing.yaml"], [r"missing\.yaml"]),
    ],
    ids=lambda value: " ".join(value[-2:]).strip("-") if value and isinstance(value, list) else None,
)
def test_bad_flags(arguments: list[str], said: list[str]) -> None:
    if arguments[0] == "evaluate":
        pytest.importorskip("torch", reason="the train extra is not installed")
    refused(arguments, *said)


def test_bad_flags_of_the_real_command() -> None:
    refused(["fly", "--sim", "--drones", "many"], "--drones", "integer", real=True)


def test_bad_settings_on_a_drone() -> None:
    refused([*on_a_drone(), "--set", "flight.hieght_m=2"], r"flight\.hieght_m", "did you mean 'height_m'")
    refused([*on_a_drone(), "--set", "flight"], "--set flight", "key=value")
    refused([*on_a_drone(), "--mesh", "udpout://127.0.0.1:9"], "no mesh key", "IMAGINE_MESH_KEY", "imagine keygen")


def test_outputs_that_cannot_be_written_are_refused_before_the_flight(tmp_path: Path) -> None:
    refused([*HEADLESS, "--json", tmp_path / "no" / "out.json"], r"out\.json", "folder does not exist")
    refused([*HEADLESS, "--json", tmp_path], "is a folder")
    refused([*HEADLESS, "--map", tmp_path / "map.xyz"], r"map\.xyz", r"\.png")


LEVEL = "size_m: [6.0, 6.0]\nlaunch: [3.0, 3.0]\n"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (LEVEL + "wals:\n  - [[1, 1], [2, 2]]\n", [r"level\.yaml:3: unknown key 'wals'", "did you mean 'walls'"]),
        (LEVEL + "boxes:\n  - center: [1, 1]\n    size: [wide, 1]\n", [r"level\.yaml:5: boxes\.0\.size\.0", "wide"]),
        (LEVEL + "walls: [[1, 1\n", [r"level\.yaml:\d+: not valid YAML"]),
        ("size_m: [6.0, 6.0]\nlaunch: [9.0, 3.0]\n", [r"level\.yaml:2: launch"]),
        ("launch: [3.0, 3.0]\n", [r"level\.yaml", "size_m or outline"]),
    ],
)
def test_a_malformed_level_is_named_by_file_line_and_key(text: str, said: list[str], tmp_path: Path) -> None:
    path = tmp_path / "level.yaml"
    path.write_text(text)
    refused([*HEADLESS, "--level", path], *said, real="wals" in text)


def test_a_malformed_config_is_named_by_file_line_and_nearest_key(tmp_path: Path) -> None:
    path = tmp_path / "drone.yaml"
    path.write_text("drone_id: 2\nflight:\n  hieght_m: 1.0\n")
    refused(
        ["fly", "--config", path], r"drone\.yaml:3: unknown key 'flight\.hieght_m'; did you mean 'height_m'", real=True
    )
    path.write_text("drone_id: 2\nmax_flight_s: -1.0\n")
    refused(["fly", "--config", path], r"drone\.yaml:2: max_flight_s", "greater than 0")
    refused(["fly", "--config", tmp_path / "none.yaml"], r"none\.yaml", "No such file")


def test_a_malformed_twin_is_named_by_file_line_and_nearest_key(tmp_path: Path) -> None:
    path = tmp_path / "twin.yaml"
    path.write_text("dynamics:\n  lag_s: 0.2\n  winds_mps: 0.1\n")
    refused([*HEADLESS, "--twin", path], r"twin\.yaml:3: unknown key 'dynamics\.winds_mps'; did you mean 'wind_mps'")
    path.write_text("radio:\n  loss: 1.5\n")
    refused(["sim", "--twin", path], r"twin\.yaml:2: radio\.loss", "within 0 and 1")


def test_models_that_cannot_fly_are_refused(tmp_path: Path) -> None:
    pytest.importorskip("onnx", reason="the train extra is not installed")
    from tiny_policy import make_contract, write_policy

    from imagine.core.contract import LidarContract
    from imagine.core.lidar import LD19

    flight = [*HEADLESS, "--policy"]
    refused([*flight, tmp_path / "none.onnx"], r"none\.onnx", "No such file")
    corrupt = tmp_path / "corrupt.onnx"
    corrupt.write_bytes(write_policy(tmp_path / "good.onnx").read_bytes()[:-200])
    refused([*flight, corrupt], r"corrupt\.onnx")
    corrupt.write_bytes(b"this is no model\n")
    refused([*flight, corrupt], r"corrupt\.onnx: is not a usable ONNX model")
    bare = write_policy(tmp_path / "bare.onnx", text="")
    refused([*flight, bare], r"bare\.onnx: has no policy contract", "imagine export onnx")
    wanted = LidarContract.of(LD19).model_copy(update={"beams": 720})
    unfit = write_policy(tmp_path / "unfit.onnx", make_contract(lidar=wanted))
    refused(
        [*flight, unfit], r"unfit\.onnx: contract: lidar\.beams: the model wants 720, this drone has 360", real=True
    )
    garbled = write_policy(tmp_path / "garbled.onnx", text='{"name": "garbled"}')
    refused([*flight, garbled], r"garbled\.onnx", "is missing")


def test_ports_in_use_are_named() -> None:
    with socket.socket() as page, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as lidar:
        page.bind(("127.0.0.1", 0))
        page.listen()
        port = page.getsockname()[1]
        flight = ["fly", "--sim", "--drones", "1", "--policy", "frontier", "--port", str(port)]
        refused(flight, rf"port {port}", "in use", "--port", real=True)
        lidar.bind(("127.0.0.1", 0))
        taken = lidar.getsockname()[1]
        drone = ["fly", "--vehicle", f"udpin://127.0.0.1:{free_port()}", "--policy", "frontier"]
        refused([*drone, "--lidar", f"udpin://127.0.0.1:{taken}"], str(taken), "in use")
        served = ["sim", "--level", "0", "--drones", "1", "--base-port", str(taken - 2001)]  # its radio modem's port
        refused(served, str(taken), "in use")


def test_recordings_that_are_none_are_refused(tmp_path: Path) -> None:
    unknown = tmp_path / "notes.txt"
    unknown.write_text("dear diary,\ntoday the drone flew\n")
    refused(["replay", unknown], r"notes\.txt: not a LiDAR recording", "CARMEN")
    refused(["replay", tmp_path / "none.log"], r"none\.log")
    empty = tmp_path / "empty.dat"
    empty.touch()
    refused(["replay", empty], r"empty\.dat: the file is empty")


@pytest.mark.skipif(not DATA.is_dir(), reason=f"no recordings at {DATA} (set IMAGINE_DATA)")
def test_a_truncated_recording_is_refused_and_a_sparse_one_fails(tmp_path: Path) -> None:
    cut = tmp_path / "cut.log.gz"
    cut.write_bytes((DATA / "freiburg-079-first-1200.log.gz").read_bytes()[:50_000])
    refused(["replay", cut], r"cut\.log\.gz", "truncated|cut short|ends", real=True)
    refused(["replay", DATA / "ydlidar-x4-sparse.dat"], "too sparse to track", status=1, real=True)


def test_a_damaged_key_is_refused(tmp_path: Path) -> None:
    key = tmp_path / "swarm.key"
    key.write_text("not a key\n")
    key.chmod(0o644)
    refused(["gcs", "--key", key, "--port", "0"], r"swarm\.key: others .* can read", "chmod 600")
    key.chmod(0o600)
    refused(["gcs", "--key", key, "--port", "0"], r"swarm\.key: the mesh key is not hexadecimal")
    refused(["keygen", key], r"swarm\.key: exists already")
    refused([*on_a_drone(), "--mesh", "udpout://127.0.0.1:9"], "IMAGINE_MESH_KEY", "digits", IMAGINE_MESH_KEY="abcd")
