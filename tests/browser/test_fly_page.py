"""A whole flight watched in real Chromium: the map grows, three drones move, a killed one is shown with its reason."""

from __future__ import annotations

import os
import re
import signal
import time
from pathlib import Path
from typing import Any

import pytest
from command_line import POLICY, Running
from headless import ARGUMENTS, CHROMIUM, NEEDS_CHROMIUM

pytest.importorskip("uvicorn", reason="the gcs extra is not installed")
api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
expect = api.expect

pytestmark = [
    *NEEDS_CHROMIUM,
    pytest.mark.sitl,
    pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="finds runners in /proc"),
]
DEADLINE_S = 60.0
ALL_MOVE = "[1, 2, 3].every((i) => (window.imagineState?.trailPoints?.[i] ?? 0) >= 4)"


def wait(page: Any, condition: str) -> dict[str, Any]:
    """Poll a script expression until it holds; return the page's state then."""
    end = time.monotonic() + DEADLINE_S
    while not page.evaluate(condition):
        assert time.monotonic() < end, f"never came true: {condition}; {page.evaluate('window.imagineState')}"
        page.wait_for_timeout(30)
    told: dict[str, Any] = page.evaluate("window.imagineState")
    return told


def test_a_flight_on_the_page() -> None:
    command = ["fly", "--sim", "--level", "4", "--drones", "3", "--ticks", "600", "--port", "0", *POLICY]
    with api.sync_playwright() as playwright, Running(*command) as flight:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
        page = browser.new_page(viewport={"width": 1280, "height": 800})
        page.set_default_timeout(DEADLINE_S * 1000)
        problems: list[str] = []
        page.on("pageerror", lambda error: problems.append(str(error)))
        address = flight.page()
        page.on("request", lambda r: None if r.url.startswith(address) else problems.append(f"foreign: {r.url}"))
        page.goto(address)
        before = wait(page, ALL_MOVE)
        after = wait(page, f"window.imagineState.knownCells > {before['knownCells']} + 300")
        for drone, was in before["drones"].items():
            x, y = was["x"], was["y"]
            wait(page, f"((d) => Math.hypot(d.x - {x}, d.y - {y}) > 0.4)(window.imagineState.drones['{drone}'])")
        assert after["coverage"] > before["coverage"]
        expect(page.get_by_test_id("flying")).to_have_text("3 of 3")

        os.kill(flight.runners()[3], signal.SIGKILL)
        killed = time.monotonic()
        wait(page, "window.imagineState.drones['3'].stale")
        assert time.monotonic() - killed < 2.0
        expect(page.get_by_test_id("drone-card-3")).to_have_attribute("data-stale", "true")
        expect(page.get_by_test_id("drone-3-note")).to_contain_text("runner process killed by SIGKILL")
        expect(page.get_by_test_id("drone-3-note")).to_contain_text(re.compile("offboard stream lost, land(ing|ed)"))
        expect(page.get_by_test_id("drone-3-state")).to_have_text("Lost")
        expect(page.get_by_test_id("flying")).to_have_text("2 of 3")
        expect(page.get_by_test_id("drone-card-1")).to_have_attribute("data-stale", "false")
        assert problems == []
        browser.close()
        flight.process.send_signal(signal.SIGINT)
        assert flight.end() == 1  # it lands the rest, and does not forget the loss
        assert flight.errors == ["imagine: drone 3: runner process killed by SIGKILL"]
