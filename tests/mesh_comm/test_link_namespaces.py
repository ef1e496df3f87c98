"""Links between two network namespaces, joined by two virtual cables: real interfaces, real routing, no loopback."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

_NODE = Path(__file__).with_name("namespace_drone.py")
_SCRIPT = """
set -e
ip link set lo up
unshare -n sleep 60 & other=$!
trap 'kill $other' EXIT
while [ "$(readlink /proc/$other/ns/net)" = "$(readlink /proc/self/ns/net)" ]; do :; done
for n in 0 1; do
    ip link add radio$n type veth peer name radio$n netns $other
    ip addr add 10.7.$n.1/24 dev radio$n
    nsenter -n -t $other ip addr add 10.7.$n.2/24 dev radio$n
    ip link set radio$n up
    nsenter -n -t $other ip link set radio$n up
done
nsenter -n -t $other timeout 30 "$PYTHON" "$NODE" 2 $THERE & second=$!
timeout 30 "$PYTHON" "$NODE" 1 $HERE
wait $second
"""


def _unshared(script: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ["unshare", "-rn", "timeout", "50", "sh", "-c", script], capture_output=True, text=True, timeout=60.0,
        env={**os.environ, **environment}, check=False,
    )  # fmt: skip


@pytest.fixture(scope="module", autouse=True)
def _may_make_namespaces() -> None:
    if not all(map(shutil.which, ("unshare", "nsenter", "ip"))):
        pytest.skip("this machine has no unshare, nsenter or ip")
    probe = _unshared("ip link add radio0 type veth peer name radio1 && unshare -n true")
    if probe.returncode != 0:
        pytest.skip(f"no network namespaces for us here: {probe.stderr.strip()}")


def fly(here: str, there: str) -> dict[int, dict[str, Any]]:
    """Run drone 1 with the links `here` and drone 2, in the other namespace, with those of `there`."""
    done = _unshared(_SCRIPT, PYTHON=sys.executable, NODE=str(_NODE), HERE=here, THERE=there)
    assert done.returncode == 0, done.stderr
    return {record["id"]: record for record in map(json.loads, done.stdout.splitlines())}


@pytest.mark.parametrize(
    "url",
    [
        "udpbcast://239.255.77.77:17700?interface=radio1",
        "udpbcast://[ff02::4d:31%25radio1]:17700",
        "udpbcast://[ff15::4d:31]:17700?interface=radio1",
        "udpbcast://10.7.1.255:17700?interface=radio1",
        "udpbcast://10.7.1.255:17700",
        "udppeers://10.7.1.1:17700,10.7.1.2:17700",
    ],
)
def test_two_drones_share_their_maps_over_a_cable(url: str) -> None:
    told = fly(url, url)
    assert [set(told[own]["tiles"]) for own in (1, 2)] == [{"2"}, {"1"}]
    assert told[1]["tiles"]["2"] > 0
    assert told[2]["tiles"]["1"] > 0
    assert set(told[1]["stats"]) | set(told[2]["stats"]) <= {"echo"}


def test_what_is_said_on_one_interface_is_not_heard_on_the_other() -> None:
    first, second = (f"udpbcast://239.255.77.77:17700?interface=radio{n}" for n in (0, 1))
    told = fly(f"{first} {second}", f"{first} {second}")  # both speak on the second only
    for record in told.values():
        assert record["heard"][0] == 0
        assert record["heard"][1] > 0


def test_without_a_route_for_the_group_an_interface_is_asked_for() -> None:
    ask = (
        "from imagine.mesh_comm.links import open_link\n"
        "try: open_link('udpbcast://239.255.77.77:17700')\n"
        "except ValueError as error: print(error)"
    )
    done = _unshared(
        'ip link add radio0 type veth peer name radio1; "$PYTHON" -c "$ASK"', PYTHON=sys.executable, ASK=ask
    )
    assert "name an interface, ?interface=NAME" in done.stdout, done.stderr
    assert "radio0" in done.stdout
