"""Make the pictures of the documentation by flying: `python docs/make_pictures.py` writes page.png and flown-map.png.

Needs the extras gcs and dev, and Chromium on PATH or named by IMAGINE_CHROMIUM.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

from PIL import Image
from playwright.sync_api import Page, sync_playwright

FOLDER = Path(__file__).resolve().parent
LARGEST_BYTES = 300_000
DEADLINE_S = 180.0


def main() -> None:
    """Fly once, photograph the page on the way, keep the map at the end."""
    flags = argparse.ArgumentParser(description=__doc__)
    flags.add_argument("--level", default="6")
    flags.add_argument("--drones", default="3")
    flags.add_argument("--seed", default="1")
    flags.add_argument("--policy", help="ONNX file or 'frontier'; the shipped policy by default")
    flags.add_argument("--coverage", type=float, default=0.6, help="photograph the page when so much is seen, 0 to 1")
    flags.add_argument("--out", type=Path, default=FOLDER, help="folder for the pictures")
    wanted = flags.parse_args()
    command = [
        sys.executable, "-m", "imagine", "fly", "--sim", "--level", wanted.level, "--drones", wanted.drones,
        "--seed", wanted.seed, "--port", "0", "--map", str(wanted.out / "flown-map.png"),
        *(["--policy", wanted.policy] if wanted.policy else []),
    ]  # fmt: skip
    chromium = os.environ.get("IMAGINE_CHROMIUM") or shutil.which("chromium") or shutil.which("chromium-browser")
    with sync_playwright() as playwright, subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as flight:
        try:
            browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
            page = browser.new_page(viewport={"width": 1280, "height": 800})
            page.goto(_address(flight))
            _wait_coverage(page, wanted.coverage)
            page.screenshot(path=wanted.out / "page.png")
            browser.close()
            assert flight.stdout is not None
            print(flight.stdout.read(), end="")
            if flight.wait(DEADLINE_S):
                raise SystemExit("the flight failed")
        finally:
            flight.terminate()
    for name in ("page.png", "flown-map.png"):
        _shrink(wanted.out / name)


def _address(flight: subprocess.Popen[str]) -> str:
    assert flight.stdout is not None
    for line in flight.stdout:
        if "ground station:" in line:
            return line.split()[-1]
    raise SystemExit("the flight ended before it served its page")


def _wait_coverage(page: Page, share: float) -> None:
    end = time.monotonic() + DEADLINE_S
    while not page.evaluate(f"(window.imagineState?.coverage ?? 0) >= {share}"):
        if time.monotonic() > end:
            raise SystemExit(f"the team never saw {share:.0%}")
        page.wait_for_timeout(50)


def _shrink(path: Path) -> None:
    """Write a picture again with 256 colours where that makes it smaller."""
    with Image.open(path) as picture:
        few = picture.convert("RGB").quantize(256, dither=Image.Dither.NONE)
    smaller = path.with_suffix(".small.png")
    few.save(smaller, optimize=True)
    if smaller.stat().st_size < path.stat().st_size:
        smaller.replace(path)
    else:
        smaller.unlink()
    size = path.stat().st_size
    if size > LARGEST_BYTES:
        raise SystemExit(f"{path}: {size} bytes, more than {LARGEST_BYTES}")
    print(f"{path}: {size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
