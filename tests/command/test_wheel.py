"""The wheel: it carries all that the command needs, and works far from the checkout."""

from __future__ import annotations

import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from imagine.onboard.settings import DEFAULT_POLICY

ROOT = Path(__file__).resolve().parents[2]
DATA = (
    "mesh_comm/chances.json",
    "core/*.py",
    "sim/levels/*.yaml",
    "gcs/web/*",
    "train/configs/*.yaml",
    "train/studies/*.yaml",
    "train/slurm/*",
    "onboard/policies/*",
)
NOT_BUILT = shutil.ignore_patterns(".*", "build", "runs", "tests", "docs", "__pycache__", "*.egg-info")
TRY_IT = """
import sys, urllib.request
import imagine
from imagine.gcs.server import GroundServer
from imagine.onboard.settings import DEFAULT_POLICY
from imagine.sim.level import load_level
from imagine.train.settings import CONFIGS

assert imagine.__file__.startswith(sys.argv[1]), imagine.__file__
assert len(load_level("4").segments) > 4
assert (CONFIGS / "default.yaml").is_file()
assert DEFAULT_POLICY.is_file() or sys.argv[2] == "no policy yet"
with GroundServer(port=0) as server:
    for name in ("index.html", "app.js", "map.js", "style.css", "icon.svg"):
        assert len(urllib.request.urlopen(f"{server.url.rstrip('/')}/{name}").read()) > 100
print("works")
"""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A wheel built from what the checkout holds now, in a copy: the build writes beside its sources."""
    folder = tmp_path_factory.mktemp("wheel")
    shutil.copytree(ROOT, folder / "copy", symlinks=True, ignore=NOT_BUILT)
    built = subprocess.run(
        [
            sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", "--no-index",
            "--disable-pip-version-check", "--wheel-dir", str(folder), str(folder / "copy"),
        ],
        capture_output=True, text=True, timeout=120, check=False, cwd=folder,
    )  # fmt: skip
    assert built.returncode == 0, built.stderr
    (path,) = folder.glob("imagine_swarm-*.whl")
    return path


def test_it_holds_every_module_and_all_data_and_nothing_else(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        held = {name for name in archive.namelist() if ".dist-info/" not in name}
    parts = ("core", "mesh_comm", "onboard", "sim", "gcs", "train", "export")
    wanted = {f"imagine/{f.relative_to(ROOT)}" for part in parts for f in (ROOT / part).rglob("*.py")}
    wanted |= {f"imagine/{f.name}" for f in (ROOT / "imagine").glob("*.py")} | {"imagine/py.typed"}
    for pattern in DATA:
        wanted |= {f"imagine/{f.relative_to(ROOT)}" for f in ROOT.glob(pattern)}
    assert held == wanted


def test_it_works_outside_the_checkout(wheel: Path, tmp_path: Path) -> None:
    pytest.importorskip("uvicorn", reason="the gcs extra is not installed")
    unpacked = tmp_path / "site"
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(unpacked)
    # -P and a path of its own: neither the checkout nor its editable installation may help
    done = subprocess.run(
        [sys.executable, "-P", "-c", TRY_IT, str(unpacked), "" if DEFAULT_POLICY.exists() else "no policy yet"],
        capture_output=True, text=True, timeout=120, check=False, cwd=tmp_path,
        env={"PATH": "/usr/bin:/bin", "PYTHONPATH": str(unpacked), "HOME": str(tmp_path)},
    )  # fmt: skip
    assert (done.returncode, done.stdout.strip()) == (0, "works"), done.stderr
