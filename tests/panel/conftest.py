"""A platform on its virtual segment, the panel beside it, and real Chromium in front of that."""

from __future__ import annotations

import contextlib
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Browser, BrowserType, Error, Page, sync_playwright

from rtcp.api import RtcpError
from tests.e2e.conftest import Platform

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
FLAGS = [
    "--no-sandbox",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
]
PASSWORD, VIEWERS_PASSWORD = "correct horse", "battery staple"


@contextlib.contextmanager
def begun(platform: Platform, *arguments: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Run a panel on a free port; yield its process and address."""
    # Not started as a command of the platform, as those end with each test.
    command = [sys.executable, "-m", "rtcp.cli", "panel", "--port", "0", *arguments]
    panel = subprocess.Popen(
        command, env=platform.environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    assert panel.stdout is not None
    try:
        yield panel, panel.stdout.readline().partition(": ")[0].rstrip("/")
    finally:
        if panel.poll() is None:
            panel.terminate()
        _, complaints = panel.communicate(timeout=20)
        assert "most recent call last" not in complaints, complaints


@pytest.fixture(scope="module")
def chromium() -> Iterator[BrowserType]:
    if CHROMIUM is None:
        pytest.skip("no Chromium is installed (Debian: apt install chromium)")
    with sync_playwright() as playwright:
        yield playwright.chromium


@pytest.fixture(scope="module")
def browser(chromium: BrowserType) -> Iterator[Browser]:
    chrome = chromium.launch(executable_path=CHROMIUM, args=FLAGS)
    yield chrome
    chrome.close()


@pytest.fixture(scope="module")
def platform() -> Iterator[Platform]:
    """A platform that does not run yet."""
    started = Platform()
    started.be_patient(lost_ms=2000)
    try:
        yield started
    finally:
        started.end_commands()
        started.rtcp("stop", check=None)
        shutil.rmtree(started.directory, ignore_errors=True)


@pytest.fixture(scope="module")
def panel(platform: Platform) -> Iterator[str]:
    """Its address."""
    with begun(platform) as (_, url):
        yield url


@pytest.fixture
def page(browser: Browser, panel: str) -> Iterator[Page]:
    with visitor(browser, panel) as opened:
        yield opened


@contextlib.contextmanager
def visitor(browser: Browser, url: str, **options: Any) -> Iterator[Page]:
    """A browser window of its own; an error of the panel's scripts fails the test."""
    complaints: list[str] = []
    context = browser.new_context(base_url=url, viewport={"width": 1200, "height": 700}, **options)
    page = context.new_page()
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.set_default_timeout(15_000)
    try:
        yield page
    finally:
        with contextlib.suppress(Error):  # a browser that was killed
            context.close()
    assert complaints == []


def show(page: Page, path: str) -> Page:
    """Open a page of the panel and wait until its state is live."""
    page.goto(path)
    page.wait_for_selector("[data-live=state][data-state]:not([data-state='no connection'])")
    return page


def log_in(page: Page, password: str = PASSWORD) -> None:
    """Log in."""
    page.goto("/")
    page.get_by_label("Your name").fill("Ada")
    page.get_by_label("Password").fill(password)
    page.get_by_role("button", name="Log in").click()
    page.wait_for_selector("[data-live=state][data-state]")


def barriers(page: Page) -> dict[str, list[str]]:
    """Return the serious and critical findings of axe-core, by rule."""
    return {
        rule["id"]: [f"{node['html'][:150]}: {node['any'] and node['any'][0]['message']}" for node in rule["nodes"][:3]]
        for rule in Axe().run(page).response["violations"]
        if rule["impact"] in ("serious", "critical")
    }


def until(met: Callable[[], Any], goal: str, patience_s: float = 20.0) -> Any:
    """Wait until `met` returns a true value; return it."""
    end = time.monotonic() + patience_s
    while time.monotonic() < end:
        if result := met():
            return result
        time.sleep(0.05)
    raise AssertionError(f"not within {patience_s:g} s: {goal}")


BENT = [0.0, 0.3, 1.57, 0.0, 0.5, 0.0]


@pytest.fixture
def holding(platform: Platform, panel: str) -> Platform:
    """The platform, enabled, bent and at rest, as its file has it."""
    ready(platform)
    return platform


def ready(platform: Platform) -> None:
    """Bring the arm to `BENT`, holding, in mode joint and csp; do only the missing steps."""
    with contextlib.suppress(RtcpError):
        platform.call("halt")
        status = platform.status()
        if status["state"] == "holding" and status["drive_mode"] == "csp":
            platform.call("mode", name="joint")
            platform.call("move_joints", q=BENT)
            return
    platform.restore()
    platform.call("enable")
    platform.call("move_joints", q=BENT)
