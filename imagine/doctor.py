"""`imagine doctor`: whether this machine has what each command needs, and what to do where it has not."""

from __future__ import annotations

import os
import platform
import re
import select
import shutil
import socket
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Literal

from imagine import __version__
from imagine.core.errors import InputError

State = Literal["ok", "missing", "fault"]
_DISTRIBUTION = "imagine-swarm"
_REQUIREMENT = re.compile(
    r"^([A-Za-z0-9_.-]+)\s*(?:\[[^\]]*\])?\s*(?:(>=|==)\s*([0-9.]+))?.*?(?:extra == ['\"](\w+)['\"])?$"
)
_LEAST_PYTHON = (3, 11)
_LOOPBACK_S = 1.0


@dataclass(frozen=True)
class Finding:
    """One thing looked at; `missing` is optional and does without, a `fault` keeps drones from flying."""

    name: str
    state: State
    detail: str


def examine() -> list[Finding]:
    """Look at everything; nothing is changed, no network is used beyond this machine's loopback."""
    found = [_python(), *_packages()]
    for name, check in _CHECKS.items():
        try:
            found.append(check(name))
        except (OSError, InputError, subprocess.TimeoutExpired) as error:
            found.append(Finding(name, "fault", str(error)))
    return found


def _python() -> Finding:
    version = platform.python_version()
    if _numbers(version) < _LEAST_PYTHON:
        return Finding("Python", "fault", f"{version}; needs 3.11 or newer")
    return Finding("Python", "ok", f"{version}, {os.cpu_count()} cores, imagine {__version__}")


def _packages() -> Iterator[Finding]:
    try:
        required = metadata.requires(_DISTRIBUTION) or []
    except metadata.PackageNotFoundError:
        yield Finding("packages", "missing", f"{_DISTRIBUTION} is not installed as a package: its needs are unknown")
        return
    for text in required:
        match = _REQUIREMENT.match(text)
        if match is not None:
            yield package_finding(*match.groups())


def package_finding(name: str, relation: str | None, least: str | None, extra: str | None) -> Finding:
    """Return whether a required distribution is installed in a fitting version (`relation` is >= or ==)."""
    label = f"{name} [{extra}]" if extra else name
    remedy = f"pip install '{_DISTRIBUTION}[{extra}]'" if extra else f"pip install {_DISTRIBUTION}"
    absent: State = "missing" if extra else "fault"
    try:
        version = metadata.version(name)
    except metadata.PackageNotFoundError:
        return Finding(label, absent, f"not installed: {remedy}")
    if least is not None:
        has, wants = _numbers(version), _numbers(least)
        if (has[: len(wants)] != wants) if relation == "==" else (has < wants):
            return Finding(label, absent, f"{version}, needs {relation}{least}: {remedy}")
    return Finding(label, "ok", version)


def _numbers(version: str) -> tuple[int, ...]:
    return tuple(int(part) for part in re.findall(r"\d+", version.partition("+")[0]))


def _kernel_cache(name: str) -> Finding:
    folder = Path(os.environ["NUMBA_CACHE_DIR"])
    with tempfile.TemporaryFile(dir=folder):
        pass
    kernels = len(list(folder.glob("**/*.nbc")))
    return Finding(name, "ok", f"{folder}: {kernels} kernels" + ("" if kernels else ", the first flight compiles them"))


def _policy(name: str) -> Finding:
    from imagine.onboard.build import load_policy
    from imagine.onboard.settings import DEFAULT_POLICY, DroneSettings

    loaded = load_policy(DroneSettings())
    assert loaded is not None  # the default settings name one
    return Finding(name, "ok", f"{loaded.contract.name}, {DEFAULT_POLICY.stat().st_size / 1e6:.2f} MB")


def _udp(name: str) -> Finding:
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
    ):
        listener.bind(("127.0.0.1", 0))
        listener.settimeout(_LOOPBACK_S)
        sender.sendto(b"doctor", listener.getsockname())
        listener.recvfrom(64)
    return Finding(name, "ok", "datagrams arrive")


def _multicast(name: str) -> Finding:
    from imagine.mesh_comm.links import open_link
    from imagine.mesh_comm.udp_sockets import interfaces

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("", 0))
        port = probe.getsockname()[1]
    try:
        link = open_link(f"udpbcast://239.255.77.77:{port}?interface=lo")
    except InputError as error:
        return Finding(name, "missing", f"{error}; udppeers:// does without")
    try:
        link.send(b"doctor")
        heard = bool(select.select([link], [], [], _LOOPBACK_S)[0])
    finally:
        link.close()
    there = ", ".join(interfaces())
    if not heard:
        return Finding(name, "missing", f"not heard on lo; udppeers:// does without; interfaces: {there}")
    return Finding(name, "ok", f"heard on lo; interfaces: {there}")


def _mesh_key(name: str) -> Finding:
    from imagine.mesh_comm.keys import KEY_VARIABLE, find_keys

    if not os.environ.get(KEY_VARIABLE):
        return Finding(name, "missing", f"{KEY_VARIABLE} is not set; key_file in the settings does as well")
    ring = find_keys(None, os.environ)
    return Finding(name, "ok", f"{KEY_VARIABLE} holds " + ", ".join(f"key {key.id:02x}" for key in ring.keys))


def _px4_port(name: str) -> Finding:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(("127.0.0.1", 14541))
        except OSError as error:
            return Finding(name, "missing", f"{error.strerror}; `imagine sim --base-port` takes others")
    return Finding(name, "ok", "free")


def _browser(name: str) -> Finding:
    path = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if path is None:
        return Finding(name, "missing", "only the browser tests need it")
    return Finding(name, "ok", path)


def _gpu(name: str) -> Finding:
    tool = shutil.which("nvidia-smi")
    if tool is None:
        return Finding(name, "missing", "training runs on the CPU")
    asked = subprocess.run(
        [tool, "--query-gpu=name,memory.total", "--format=csv,noheader"],
        capture_output=True, text=True, timeout=10.0, check=False,
    )  # fmt: skip
    if asked.returncode or not asked.stdout.strip():
        return Finding(name, "missing", "nvidia-smi finds none; training runs on the CPU")
    return Finding(name, "ok", asked.stdout.strip().splitlines()[0])


_CHECKS: dict[str, Callable[[str], Finding]] = {
    "kernel cache": _kernel_cache,
    "shipped policy": _policy,
    "UDP loopback": _udp,
    "mesh multicast": _multicast,
    "mesh key": _mesh_key,
    "UDP port 14541": _px4_port,
    "Chromium": _browser,
    "GPU": _gpu,
}
