"""A connection to Ray: a cluster of this machine's own for as long as it lasts, or one at an address."""

from __future__ import annotations

import contextlib
import logging
import os
import secrets
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from importlib.util import find_spec

from imagine.core.errors import InputError, WorkError

_LOOPBACK = "127.0.0.1"
_REACH_S = 5.0
_ANSWER_S = 20.0
_STARTS = 3
_ENVIRONMENT = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",  # Ray's coming default, which it asks to be chosen
    "RAY_worker_niceness": "0",  # by default 15, and trials starve beside anything else; nice the command instead
    "RAY_AIR_NEW_OUTPUT": "0",  # the command prints, not Tune
    "TUNE_DISABLE_AUTO_CALLBACK_LOGGERS": "1",  # run folders hold metrics already
    "TUNE_DISABLE_STRICT_METRIC_CHECKING": "1",  # a trial that fails before its first report has no metric
    "TUNE_FORCE_TRIAL_CLEANUP_S": "20",  # trials that do not stop by then are killed; by default it waits 10 minutes
}


@contextlib.contextmanager
def ray_connection(address: str | None = None, cpus: int | None = None) -> Iterator[None]:
    """Connect to the cluster whose head listens at `address` (HOST:PORT), or start one here and end it afterwards.

    One's own listens on loopback only, asks for a token that only this process and its workers know, sends no usage
    statistics, and leaves neither processes nor files. `cpus`: how many it has, by default this process's cores. Raises
    InputError where Ray is missing or nothing answers at the address, within half a minute; WorkError where Ray does
    not start here.
    """
    if find_spec("ray") is None:
        raise InputError("studies need Ray: pip install imagine-swarm[study]")
    os.environ.update(_ENVIRONMENT)
    if address is None:
        with _own_cluster(cpus or len(os.sched_getaffinity(0))):
            yield
    else:
        if cpus is not None:
            raise InputError(f"--address {address}: a cluster has the CPUs it has; leave the number out")
        with _cluster_at(address):
            yield


@contextlib.contextmanager
def _own_cluster(cpus: int) -> Iterator[None]:
    # Ray turns 127.0.0.1 into the machine's address, and listens on every interface, unless it takes itself for a
    # single machine, as it does by default only on other systems. Read when ray is imported.
    os.environ["RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"] = "0"
    os.environ.setdefault("RAY_AUTH_MODE", "token")
    if not {"RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH"} & os.environ.keys():
        os.environ["RAY_AUTH_TOKEN"] = secrets.token_hex(32)
    import ray

    if ray._private.ray_constants.ENABLE_RAY_CLUSTER:
        raise WorkError("ray was imported before it could be bound to loopback; start studies in a new process")
    with tempfile.TemporaryDirectory(prefix="imagine-ray-", ignore_cleanup_errors=True) as folder:
        for attempt in range(1, _STARTS + 1):
            try:
                ray.init(
                    address="local", num_cpus=cpus, include_dashboard=False, log_to_driver=False,
                    logging_level=logging.ERROR, _node_ip_address=_LOOPBACK, _temp_dir=folder,
                )  # fmt: skip
                break
            except Exception as error:  # what Ray raises when a busy machine takes more than its 30 s is a plain one
                ray.shutdown()
                if attempt == _STARTS:
                    raise WorkError(f"Ray does not start here: {error}") from error
        try:
            _keep_off_the_terminal()
            yield
        finally:
            ray.shutdown()


@contextlib.contextmanager
def _cluster_at(address: str) -> Iterator[None]:
    check_address(address)
    import ray

    try:
        ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
    except (OSError, RuntimeError, ValueError) as error:
        raise InputError(f"--address {address}: Ray cannot join this cluster from here: {error}") from error
    try:
        _keep_off_the_terminal()
        yield
    finally:
        ray.shutdown()


def _keep_off_the_terminal() -> None:
    """Take away what prints the raylets' remarks on standard output, whatever log_to_driver says."""
    from ray._private.ray_logging import global_worker_stdstream_dispatcher

    global_worker_stdstream_dispatcher.remove_handler("ray_print_logs")


def check_address(address: str) -> None:
    """Raise InputError unless a Ray head of this version answers at `address`, HOST:PORT, in time."""
    host, colon, port = address.rpartition(":")
    if "://" in address or not colon or not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise InputError(f"--address {address}: expected the head's HOST:PORT, such as node1:6379")
    if not reachable(address, _REACH_S):
        raise InputError(f"--address {address}: nothing answers there; is the head running (ray start --head)?")
    command = [sys.executable, "-m", "ray.scripts.scripts", "health-check", "--address", address]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=_ANSWER_S, check=False)
    except subprocess.TimeoutExpired as error:
        raise InputError(f"--address {address}: what listens there is no Ray head") from error
    if done.returncode != 0:
        said = (done.stderr.strip() or done.stdout.strip() or "it does not say why").splitlines()[-1]
        raise InputError(f"--address {address}: no healthy Ray head there: {said}")


def reachable(address: str, timeout_s: float) -> bool:
    """Tell whether something takes connections at HOST:PORT."""
    host, _, port = address.rpartition(":")
    try:
        with socket.create_connection((host.strip("[]"), int(port)), timeout_s):
            return True
    except OSError:
        return False
