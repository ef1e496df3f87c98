"""What the page tells of a cell, of what drones taught each other, and of drones without a place; in real Chromium."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from typing import Any

import pytest
from headless import DEADLINE_MS, NEEDS_CHROMIUM, opened_page
from small_swarm import Swarm

from imagine.gcs.server import GroundServer

pytest.importorskip("uvicorn", reason="the gcs extra is not installed")
api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
expect = api.expect

pytestmark = NEEDS_CHROMIUM


@pytest.fixture
def page(browser: Any, server: GroundServer) -> Iterator[Any]:
    """An open page; fails the test on any script error or foreign request."""
    with opened_page(browser, server.url) as opened:
        yield opened


@pytest.fixture
def swarm(server: GroundServer, page: Any) -> Swarm:
    flying = Swarm(server)
    flying.run(4.0)
    expect(page.get_by_test_id("drone-card-3")).to_be_visible()
    return flying


def run_until(swarm: Swarm, page: Any, selector: str) -> None:
    """Let simulated time pass until the page shows `selector`: the ground answers as it flies."""
    end = time.monotonic() + DEADLINE_MS / 1000
    while page.locator(selector).count() == 0:
        assert time.monotonic() < end, f"the page never showed {selector}"
        swarm.run(0.1)
        page.wait_for_timeout(30)


def click_at_drone(page: Any, swarm: Swarm, drone: int) -> tuple[float, float]:
    """Click on the map where a drone hovers, and return the point, metres, that the pointer's read-out tells."""
    follow = page.get_by_role("button", name=f"Follow drone {drone} on the map")
    if follow.get_attribute("aria-pressed") == "false":
        follow.click()
    canvas = page.get_by_test_id("map")
    box = canvas.bounding_box()
    at = {"x": box["width"] / 2 + 2, "y": box["height"] / 2 + 2}
    canvas.hover(position=at)
    cursor = page.locator("#cursor").inner_text()
    canvas.click(position=at)
    x, y = map(float, re.findall(r"-?\d+\.\d+", cursor))
    return x, y


def test_a_click_tells_who_saw_the_cell_and_by_which_way_it_came(page: Any, swarm: Swarm) -> None:
    panel = page.get_by_test_id("cell")
    expect(panel).to_be_hidden()
    click_at_drone(page, swarm, 2)
    expect(panel).to_be_visible()
    run_until(swarm, page, "#cell li")
    x, y = map(float, re.findall(r"-?\d+\.\d+", page.get_by_test_id("cell-title").inner_text()))
    known = swarm.fleet.provenance(x, y)
    rows = page.locator("#cell li")
    assert known.belief < 0
    expect(page.get_by_test_id("cell-told")).to_contain_text("Free, −")
    assert {int(rows.nth(i).get_attribute("data-source")) for i in range(rows.count())} == {
        s.source for s in known.sightings
    }
    for sighting in known.sightings:
        row = page.locator(f"#cell li[data-source='{sighting.source}']")
        expect(row).to_contain_text(f"Drone {sighting.source} says")
        expect(row).to_contain_text(re.compile(r"\d+\.\d s ago"))
        expect(row.locator("small")).to_contain_text("tile" if row.get_attribute("data-way") != "scan" else "scan of")


def test_another_click_escape_and_the_button_close_it(page: Any, swarm: Swarm) -> None:
    panel, canvas = page.get_by_test_id("cell"), page.get_by_test_id("map")
    for close in ("click", "Escape", "button"):
        click_at_drone(page, swarm, 1)
        expect(panel).to_be_visible()
        if close == "click":
            canvas.click(position={"x": 200, "y": 300})
        elif close == "Escape":
            page.keyboard.press("Escape")
        else:
            page.get_by_test_id("cell-close").click()
        expect(panel).to_be_hidden()


def test_the_keyboard_asks_about_the_middle_and_a_drag_asks_about_nothing(page: Any, swarm: Swarm) -> None:
    panel, canvas = page.get_by_test_id("cell"), page.get_by_test_id("map")
    canvas.press("Enter")
    expect(panel).to_be_visible()
    run_until(swarm, page, "#cell .told p:not(:has-text('Asking'))")
    page.keyboard.press("Escape")
    expect(panel).to_be_hidden()
    canvas.hover(position={"x": 300, "y": 300})
    page.mouse.down()
    page.mouse.move(420, 420, steps=4)
    page.mouse.up()
    expect(page.locator("#fit")).to_have_attribute("aria-pressed", "false")  # it was panned
    expect(panel).to_be_hidden()


def test_a_place_that_nobody_has_seen_is_said_to_be_unknown(page: Any, swarm: Swarm) -> None:
    page.get_by_test_id("map").press("f")
    page.get_by_test_id("map").click(position={"x": 3, "y": 300})
    run_until(swarm, page, "#cell .told p:has-text('nobody has seen it')")
    expect(page.get_by_test_id("cell-told")).to_have_text("Unknown: nobody has seen it")
    assert page.locator("#cell li").count() == 0


def test_a_ground_that_does_not_answer_is_said_not_to(page: Any, server: GroundServer, swarm: Swarm) -> None:
    told = page.get_by_test_id("cell-told")
    click_at_drone(page, swarm, 1)  # no time passes: the flight's loop takes no question
    expect(told).to_have_text("The ground station did not answer: the flight's loop does not answer.")
    page.keyboard.press("Escape")
    server.stop()
    click_at_drone(page, swarm, 1)
    expect(told).to_have_text("The ground station did not answer: it cannot be reached.")


def test_a_card_tells_what_the_drone_taught_its_peers(page: Any, swarm: Swarm) -> None:
    swarm.run(2.0)
    told = swarm.fleet.node.peers(swarm.now)[2].status
    assert told is not None
    cells = told.taught["scan"] + told.taught["tile"]
    assert cells > 1000
    share = cells / (told.bytes_sent["scan"] + told.bytes_sent["tile"])
    shown = page.get_by_test_id("drone-2-taught")
    expect(shown).to_have_text(f"{cells // 1000}\u202f{cells % 1000:03d} cells, {share:.1f} a byte")


def test_a_drone_whose_frame_is_not_known_wears_a_badge_and_is_not_drawn(page: Any, server: GroundServer) -> None:
    swarm = Swarm(server, frame="unknown")
    swarm.run(2.0)
    expect(page.get_by_test_id("drone-3-place")).to_have_text("Not placed")
    expect(page.get_by_test_id("drone-1-place")).to_be_hidden()  # the map is shown in its frame
    expect(page.get_by_test_id("events")).to_contain_text("joined the swarm")
    shown = {drone.id: drone for drone in swarm.fleet.snapshot(swarm.now).drones}
    assert [drone.located for _, drone in sorted(shown.items())] == [True, False, False]
