"""Where numba keeps compiled kernels: a folder of its own for every state of the kernels' sources.

Numba notices a change in the file of a cached function, but not in the files of the functions it calls. A kernel of
the twin would go on flying an old map kernel, silently. Naming the folder after all kernel sources, and whatever
they may take constants from, prevents that.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import shutil
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

_KEPT = 8  # folders of other versions and checkouts that stay for a while


def use_kernel_cache() -> None:
    """Point numba at the folder of this version's kernels, unless NUMBA_CACHE_DIR says otherwise.

    Must run before numba is imported; costs about a millisecond.
    """
    if "NUMBA_CACHE_DIR" in os.environ:
        return
    root = _cache_root()
    folder = root / kernel_digest(Path(__file__).resolve().parent)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        os.utime(folder)
        _forget_oldest(root)
    except OSError:
        folder = Path(tempfile.mkdtemp(prefix="imagine-kernels-"))
    os.environ["NUMBA_CACHE_DIR"] = str(folder)


def announce_compiling(say: Callable[[str], None]) -> None:
    """Tell whoever waits at a terminal, the first time that this version's batched twin runs, why nothing moves yet."""
    marker = Path(os.environ["NUMBA_CACHE_DIR"]) / "exploration-kernels"
    if marker.exists() or not sys.stderr.isatty():
        return
    say("first start: compiling the twin's kernels, which takes about a minute once")
    with contextlib.suppress(OSError):  # without a cache everybody compiles for himself, and is told so
        marker.touch()


def kernel_digest(package: Path) -> str:
    """Return a name for the state of a package's kernels: its place and every source that they are compiled from."""
    digest = hashlib.sha256(str(package).encode())
    for source in sorted((*package.glob("*/*.py"), *package.glob("*/*/*.py"))):
        text = source.read_bytes()
        # constants of files without kernels are frozen into the kernels of those that import them
        if source.parent.name in ("core", "sim") or b"njit" in text:
            digest.update(text)
    return digest.hexdigest()[:16]


def _cache_root() -> Path:
    base = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    return Path(base) / "imagine" / "kernels"


def _forget_oldest(root: Path) -> None:
    folders = sorted((f for f in root.iterdir() if f.is_dir()), key=lambda f: f.stat().st_mtime, reverse=True)
    for folder in folders[_KEPT:]:
        shutil.rmtree(folder, ignore_errors=True)
