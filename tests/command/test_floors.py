"""The house's floors: each part imports only from the parts below it."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
CORE, MESH = {"core"}, {"core", "mesh_comm"}
BELOW = {
    "core": CORE,
    "mesh_comm": MESH,
    "onboard": MESH | {"onboard"},
    "sim": MESH | {"sim"},
    "gcs": MESH | {"gcs"},
    "train": MESH | {"onboard", "sim", "gcs", "train"},
    "export": MESH | {"onboard", "sim", "gcs", "train", "export"},
}
PARTS = set(BELOW)


def sources(part: str) -> list[Path]:
    return sorted((ROOT / part).rglob("*.py"))


def imports(source: str) -> Iterator[tuple[int, str]]:
    """Yield the line and the full dotted name of everything a module imports, anywhere in it."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            module = "." * node.level + (node.module or "")
            yield from ((node.lineno, f"{module}.{alias.name}") for alias in node.names)
        elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith("import_module"):
            yield from ((node.lineno, str(name.value)) for name in node.args[:1] if isinstance(name, ast.Constant))


def breaches(source: str, allowed: set[str]) -> list[str]:
    """Return what a module imports that its floor forbids."""
    found = []
    for line, name in imports(source):
        first, *rest = name.split(".")
        if first == "":
            found.append(f"{line}: relative import of {name}")
        elif first in PARTS:
            found.append(f"{line}: bare import of {name}, write imagine.{name}")
        elif first == "imagine" and rest and (rest[0] not in allowed and rest != ["__version__"]):
            found.append(f"{line}: imports {name}")
    return found


@pytest.mark.parametrize("part", BELOW)
def test_a_part_imports_only_from_the_floors_below(part: str) -> None:
    files = sources(part)
    assert files
    wrong = [f"{f.relative_to(ROOT)}:{b}" for f in files for b in breaches(f.read_text("utf-8"), BELOW[part])]
    assert wrong == []


def test_the_command_imports_no_part_by_its_bare_name() -> None:
    files = sorted((ROOT / "imagine").glob("*.py"))
    allowed = PARTS | {file.stem for file in files}
    assert [f"{f.name}:{b}" for f in files for b in breaches(f.read_text("utf-8"), allowed)] == []


def test_the_tests_import_parts_as_users_do() -> None:
    wrong = []
    for file in sorted((ROOT / "tests").rglob("*.py")):
        found = breaches(file.read_text("utf-8"), PARTS | {f.stem for f in (ROOT / "imagine").glob("*.py")})
        wrong += [f"{file.relative_to(ROOT)}:{b}" for b in found if "bare" in b]
    assert wrong == []


@pytest.mark.parametrize(
    "source",
    [
        "import imagine.sim.twin",
        "from imagine.sim import twin",
        "from imagine import sim",
        "def f():\n    from imagine.train.run import train",
        "import core",
        "from core.frames import Pose",
        "from ..core import frames",
        "import importlib\nimportlib.import_module('imagine.sim.twin')",
    ],
)
def test_every_kind_of_breach_is_seen(source: str) -> None:
    assert breaches(source, BELOW["onboard"])


def test_each_part_is_linked_into_the_package() -> None:
    for part in PARTS:
        assert (ROOT / "imagine" / part).resolve() == ROOT / part
