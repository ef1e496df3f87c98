"""Headless Chromium as the tests of the page use it; without it they skip."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

CHROMIUM = os.environ.get("IMAGINE_CHROMIUM") or shutil.which("chromium") or shutil.which("chromium-browser")
NEEDS_CHROMIUM = [
    pytest.mark.browser,
    pytest.mark.skipif(not CHROMIUM, reason="no chromium on PATH; set IMAGINE_CHROMIUM to one"),
]
ARGUMENTS = [
    "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync",
]  # fmt: skip
DEADLINE_MS = 10_000


@contextmanager
def opened_page(browser: Any, url: str) -> Iterator[Any]:
    """Open a page; fail on leaving it if a script failed, or if it asked another host for anything."""
    context = browser.new_context(viewport={"width": 1280, "height": 800})
    context.set_default_timeout(DEADLINE_MS)
    page = context.new_page()
    problems: list[str] = []
    page.on("pageerror", lambda error: problems.append(f"script error: {error}"))
    page.on("request", lambda r: None if r.url.startswith(url) else problems.append(f"foreign: {r.url}"))
    page.goto(url)
    yield page
    context.close()
    assert problems == []
