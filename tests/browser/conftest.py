"""A browser for each file of tests, and a ground station's server for each test."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import pytest
from headless import ARGUMENTS, CHROMIUM

if TYPE_CHECKING:
    from imagine.gcs.server import GroundServer


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    with api.sync_playwright() as playwright:
        running = playwright.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
        yield running
        running.close()


@pytest.fixture
def server() -> Iterator[GroundServer]:
    pytest.importorskip("uvicorn", reason="the gcs extra is not installed")
    from imagine.gcs.server import GroundServer

    with GroundServer(port=0) as running:
        yield running
