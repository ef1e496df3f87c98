"""The ground station's page in real Chromium, fed by a real fleet of mesh nodes through the real server."""

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
WALL, FREE = [216, 226, 235], [49, 66, 84]


@pytest.fixture
def swarm(server: GroundServer) -> Swarm:
    flying = Swarm(server)
    flying.run(2.0)
    return flying


@pytest.fixture
def page(browser: Any, server: GroundServer, swarm: Swarm) -> Iterator[Any]:
    """The page, open and showing three drones; fails the test on any script error or foreign request."""
    with opened_page(browser, server.url) as opened:
        wait(opened, "Object.keys(window.imagineState?.drones ?? {}).length === 3")
        swarm.run(0.1)  # opening takes long on a busy machine: what it shows shall be fresh
        yield opened


def state(page: Any) -> dict[str, Any]:
    value: dict[str, Any] = page.evaluate("window.imagineState")
    return value


def wait(page: Any, condition: str) -> None:
    """Poll a script expression; the page's security policy forbids playwright's own polling of strings."""
    end = time.monotonic() + DEADLINE_MS / 1000
    while not page.evaluate(condition):
        assert time.monotonic() < end, f"never came true: {condition}; the page has {state(page)}"
        page.wait_for_timeout(50)


def painted(page: Any) -> dict[str, int]:
    """Count the canvas's pixels that are painted as walls and as free space."""
    counts: dict[str, int] = page.evaluate(
        """([wall, free]) => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => {
            const canvas = document.querySelector("canvas");
            const data = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
            const count = { walls: 0, free: 0 };
            for (let i = 0; i < data.length; i += 4) {
              const is = (c) => data[i] === c[0] && data[i + 1] === c[1] && data[i + 2] === c[2];
              if (is(wall)) count.walls++;
              if (is(free)) count.free++;
            }
            done(count);
          })))""",
        [WALL, FREE],
    )
    return counts


def run_until_ordered(swarm: Swarm, orders: int) -> None:
    """Let simulated time pass until every drone has had so many orders; the page's click takes its time to arrive."""
    end = time.monotonic() + DEADLINE_MS / 1000
    while any(len(drone.orders) < orders for drone in swarm.drones.values()):
        assert time.monotonic() < end, "the order did not reach every drone"
        swarm.run(0.1)


def test_the_map_grows_and_three_drones_move(page: Any, swarm: Swarm) -> None:
    before = state(page)
    pixels = painted(page)
    assert pixels["walls"] > 500
    assert pixels["free"] > 20_000
    swarm.run(8.0)
    wait(page, f"window.imagineState.knownCells > {before['knownCells']} + 500")
    after = state(page)
    for drone in ("1", "2", "3"):
        a, b = before["drones"][drone], after["drones"][drone]
        assert abs(a["x"] - b["x"]) + abs(a["y"] - b["y"]) > 0.3
        assert after["trailPoints"][drone] > before["trailPoints"][drone]
    shown = swarm.fleet.snapshot(swarm.now)
    assert after["knownCells"] == shown.map.known_cells
    assert after["tiles"] == len(shown.map.tiles)
    expect(page.get_by_test_id("flying")).to_have_text("3 of 3")
    expect(page.get_by_test_id("elapsed")).to_have_text(f"0:{int(round(shown.elapsed_s, 1)):02d}")
    expect(page.get_by_test_id("drone-2-state")).to_have_text("Exploring")
    expect(page.get_by_test_id("drone-2-hears")).to_have_text("D1, D3")
    expect(page.get_by_test_id("drone-1-radio")).to_have_text(re.compile(r"^\d+\.\d kB$"))


def test_the_map_shows_walls_where_they_are(page: Any, swarm: Swarm) -> None:
    """What a person sees at a point of the map is what the fleet knows of it, the right way up."""
    swarm.run(12.0)
    wait(page, f"window.imagineState.knownCells === {swarm.fleet.snapshot(swarm.now).map.known_cells}")
    canvas = page.get_by_test_id("map")
    box = canvas.bounding_box()
    # the pointer's read-out gives two points of the map frame, hence the whole view
    places = []
    for share in (0.25, 0.75):
        px, py = box["width"] * share, box["height"] * share
        canvas.hover(position={"x": px, "y": py})
        x, y = map(float, re.findall(r"-?\d+\.\d+", page.locator("#cursor").inner_text()))
        places.append((px, py, x, y))
    (px0, py0, x0, y0), (px1, py1, x1, y1) = places
    scale = (px1 - px0) / (x1 - x0)
    assert (py1 - py0) / (y1 - y0) == pytest.approx(-scale, rel=0.02), "north is up"
    belief, (column, row) = swarm.fleet.evidence.belief(), swarm.fleet.evidence.origin_cells
    places_px: list[tuple[int, int]] = []
    wanted: list[list[int]] = []
    for i in range(-52, 52, 2):
        for j in range(-37, 37, 2):
            value = belief[j - row, i - column]
            if abs(value) >= 4:
                places_px.append(
                    (round(px0 + ((i + 0.5) * 0.1 - x0) * scale), round(py0 - ((j + 0.5) * 0.1 - y0) * scale))
                )
                wanted.append(FREE if value < 0 else WALL)
    seen = page.evaluate(
        """(places) => { const g = document.querySelector("canvas").getContext("2d");
                         return places.map(([x, y]) => [...g.getImageData(x, y, 1, 1).data.slice(0, 3)]); }""",
        places_px,
    )
    for colour, least in ((FREE, 300), (WALL, 60)):
        agree = [a == b for a, b in zip(seen, wanted, strict=True) if b == colour]
        assert len(agree) > least
        assert sum(agree) > 0.85 * len(agree)  # drones, trails and labels lie over some


def test_a_drone_that_stops_sending_turns_stale_within_two_seconds(page: Any, swarm: Swarm) -> None:
    card = page.get_by_test_id("drone-card-3")
    expect(card).to_have_attribute("data-stale", "false")
    swarm.drones[3].sends = False
    swarm.run(2.0)
    expect(card).to_have_attribute("data-stale", "true")
    expect(page.get_by_test_id("drone-3-state")).to_have_text("No data")
    expect(page.get_by_test_id("drone-3-reason")).to_contain_text("Not heard for")
    expect(page.get_by_test_id("flying")).to_have_text("2 of 3")
    expect(page.get_by_test_id("events")).to_contain_text("not heard for 1.5 s")
    assert state(page)["drones"]["3"]["stale"] is True
    assert state(page)["drones"]["1"]["stale"] is False
    swarm.drones[3].sends = True
    swarm.run(1.0)
    expect(card).to_have_attribute("data-stale", "false")


def test_the_page_says_why_a_drone_is_lost_and_never_as_markup(page: Any, swarm: Swarm) -> None:
    reason = "runner process ended (killed by SIGKILL) <img src=x onerror=alert(1)>"
    swarm.fleet.note(2, reason, lost=True)
    swarm.run(0.2)
    expect(page.get_by_test_id("drone-2-note")).to_have_text(reason)
    expect(page.get_by_test_id("drone-2-state")).to_have_text("Lost")
    expect(page.get_by_test_id("events")).to_contain_text(reason)
    assert page.locator("aside img").count() == 0


@pytest.mark.parametrize(("button", "action"), [("hold-all", "hold"), ("land-all", "land")])
def test_an_order_to_all_asks_first_and_arrives_sealed(page: Any, swarm: Swarm, button: str, action: str) -> None:
    dialog = page.get_by_test_id("confirm-dialog")
    page.get_by_test_id(button).click()
    expect(dialog).to_be_visible()
    expect(dialog).to_contain_text("All 3 drones")
    page.get_by_test_id("confirm-no").click()
    expect(dialog).to_be_hidden()
    page.get_by_test_id(button).press("Enter")  # by keyboard too; Escape is no
    expect(dialog).to_be_visible()
    page.keyboard.press("Escape")
    expect(dialog).to_be_hidden()
    swarm.run(1.0)
    assert all(drone.orders == [] for drone in swarm.drones.values())

    page.get_by_test_id(button).click()
    page.get_by_test_id("confirm-yes").click()
    expect(dialog).to_be_hidden()
    run_until_ordered(swarm, 1)
    assert all(drone.orders == [action] for drone in swarm.drones.values())
    swarm.run(2.0)
    expect(page.get_by_test_id("notice")).to_contain_text("confirmed by all")
    word = {"hold": "Holding", "land": "Landing"}[action]
    expect(page.get_by_test_id("drone-1-state")).to_have_text(word)
    expect(page.get_by_test_id("drone-1-reason")).to_have_text(f"the pilot orders to {action}")

    page.get_by_test_id("resume").click()
    expect(dialog).to_be_hidden()
    run_until_ordered(swarm, 2)
    assert swarm.drones[3].orders == [action, "resume"]


def test_a_lost_server_is_shown_and_the_page_comes_back_by_itself(
    page: Any, server: GroundServer, swarm: Swarm
) -> None:
    port = int(server.url.rstrip("/").rsplit(":", 1)[1])
    known = state(page)["knownCells"]
    server.stop()
    expect(page.get_by_test_id("banner")).to_contain_text("Connection to the ground station lost")
    expect(page.get_by_test_id("connection")).to_contain_text("Disconnected")
    expect(page.get_by_test_id("hold-all")).to_be_disabled()
    expect(page.get_by_test_id("drone-card-1")).to_have_attribute("data-stale", "true")
    with GroundServer(port=port) as again:
        expect(page.get_by_test_id("connection")).to_contain_text("Connected", timeout=DEADLINE_MS)
        expect(page.get_by_test_id("drone-card-1")).to_have_count(0)  # the new one has told nothing yet
        swarm.server = again
        swarm.run(0.2)
        wait(page, f"window.imagineState.knownCells >= {known}")
        expect(page.get_by_test_id("banner")).to_be_hidden()
        expect(page.get_by_test_id("hold-all")).to_be_enabled()


def test_zoom_pan_fit_and_follow_by_mouse_and_keyboard(page: Any, swarm: Swarm) -> None:
    canvas, fit, scale = page.get_by_test_id("map"), page.locator("#fit"), page.locator("#scale-bar")
    expect(fit).to_have_attribute("aria-pressed", "true")
    before = scale.bounding_box()["width"]
    canvas.hover(position={"x": 300, "y": 300})
    page.mouse.wheel(0, -100)
    expect(fit).to_have_attribute("aria-pressed", "false")
    assert scale.bounding_box()["width"] != before
    cursor = page.locator("#cursor")
    at = cursor.inner_text()
    canvas.press("ArrowLeft")
    canvas.hover(position={"x": 301, "y": 300})
    assert cursor.inner_text() != at
    canvas.press("f")
    expect(fit).to_have_attribute("aria-pressed", "true")
    follow = page.get_by_role("button", name="Follow drone 2 on the map")
    follow.click()
    expect(follow).to_have_attribute("aria-pressed", "true")
    expect(fit).to_have_attribute("aria-pressed", "false")
    swarm.run(1.0)
    box = canvas.bounding_box()
    canvas.hover(position={"x": box["width"] / 2, "y": box["height"] / 2})
    drone = swarm.fleet.snapshot(swarm.now).drones[1]
    wait(page, f"Math.abs(window.imagineState.drones['2'].y - {drone.y}) < 0.01")
    canvas.hover(position={"x": box["width"] / 2 + 1, "y": box["height"] / 2})
    x, y = map(float, re.findall(r"-?\d+\.\d+", cursor.inner_text()))
    assert (x, y) == pytest.approx((drone.x, drone.y), abs=0.06)
