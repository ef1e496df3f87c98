"""`imagine doctor` tells what this machine lacks, and fails only for what every flight needs."""

from __future__ import annotations

import json
from pathlib import Path

from command_line import SHIPPED_POLICY, environment, run_imagine

from imagine.doctor import package_finding


def test_it_shows_a_row_for_everything_and_says_whether_drones_can_fly(tmp_path: Path) -> None:
    out = tmp_path / "doctor.json"
    done = run_imagine("doctor", "--json", out)
    found = {finding["name"]: finding for finding in json.loads(out.read_text())}
    assert {"Python", "numba", "kernel cache", "shipped policy", "UDP loopback", "Chromium", "GPU"} <= set(found)
    assert all(name in done.stdout for name in found)
    faults = [name for name, finding in found.items() if finding["state"] == "fault"]
    assert faults == ([] if SHIPPED_POLICY else ["shipped policy"])
    assert done.returncode == (1 if faults else 0)
    assert found["UDP loopback"]["state"] == "ok"
    assert found["kernel cache"]["state"] == "ok"


def test_a_kernel_cache_that_cannot_be_written_is_a_fault(tmp_path: Path) -> None:
    gone = tmp_path / "gone"
    done = run_imagine("doctor", env=environment(NUMBA_CACHE_DIR=str(gone)))
    assert done.returncode == 1
    assert "kernel cache" in done.stderr
    assert len(done.stderr.splitlines()) == 1


def test_missing_and_old_packages_are_named_with_the_remedy() -> None:
    absent = package_finding("no-such-package-anywhere", None, None, None)
    assert (absent.state, absent.detail) == ("fault", "not installed: pip install imagine-swarm")
    optional = package_finding("no-such-package-anywhere", ">=", "1.0", "gcs")
    assert (optional.state, optional.detail) == ("missing", "not installed: pip install 'imagine-swarm[gcs]'")
    old = package_finding("numpy", ">=", "99", None)
    assert old.state == "fault"
    assert "needs >=99" in old.detail
    assert package_finding("numpy", ">=", "2", None).state == "ok"
    assert package_finding("numpy", "==", "1.0", "train").state == "missing"
