"""A platform on its virtual segment, the panel beside it, and real Chromium in front of that."""

from __future__ import annotations

import contextlib
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from functools import partial
from http import HTTPStatus
from typing import Any
from urllib.error import HTTPError
from urllib.request import urlopen

import pytest
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Browser, BrowserType, Dialog, Error, Page, expect, sync_playwright

from rtcp.api import RtcpError
from rtcp.ipc.session import read_processes
from tests.e2e.conftest import Platform
from tests.leftovers import FoundAtTheEnd, Leftovers
from tests.waiting import HANG_S, until

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
FLAGS = [
    "--no-sandbox",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]
WITHOUT_GPU = [*FLAGS, "--disable-gpu", "--disable-3d-apis"]
"""For pages that draw no arm: where nothing imitates a GPU or WebGL, they cost a fraction of the time."""
WITH_GPU = [*FLAGS, "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
PASSWORD, VIEWERS_PASSWORD = "correct horse", "battery staple"
PERIOD_US = 8000
"""Cycle of the platform, us: what a person does takes no shorter one, and the browser needs the time."""
_PATIENT_PANEL = """
from rtcp.panel import live

# Shipped: 1 s and 10 s. On a busy host a browser takes longer for some of its answers.
live.PRESENCE_S, live.TAKE_OVER_S = 5.0, 60.0

from rtcp.cli.__main__ import main

main()
"""
LIVE = "[data-live=state][data-state]:not([data-state='no connection'])"
"""Selector of a state that is live."""
HOSTILE = "<img src=x onerror=alert(1)>"


@contextlib.contextmanager
def begun(platform: Platform, *arguments: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Run a panel on a free port; yield its process and address."""
    # Not started as a command of the platform, as those end with each test.
    command = [sys.executable, "-c", _PATIENT_PANEL, "panel", "--port", "0", *arguments]
    panel = subprocess.Popen(
        command, env=platform.environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    assert panel.stdout is not None
    try:
        url = panel.stdout.readline().partition(": ")[0].rstrip("/")
        if read_processes(platform.directory / platform.environment.get("RTCP_NAME", "")).loop:
            # A page that is opened earlier starts again when the panel finds the platform.
            until(partial(knows_the_platform, url), "the platform in the panel")
        yield panel, url
    finally:
        if panel.poll() is None:
            panel.terminate()
        _, complaints = panel.communicate(timeout=HANG_S)
        if "most recent call last" in complaints:
            raise FoundAtTheEnd(complaints)


def knows_the_platform(url: str) -> bool:
    """Whether a panel shows the platform, or answers 401 because the visitor has not logged in."""
    try:
        with urlopen(f"{url}/metrics") as answer:
            return b"rtcp_up 1" in answer.read()
    except HTTPError as error:
        return error.code == HTTPStatus.UNAUTHORIZED


@pytest.fixture(scope="module")
def chromium() -> Iterator[BrowserType]:
    """Chromium for one module: until Playwright ends, no other test of this process can run an event loop."""
    if CHROMIUM is None:
        pytest.skip("no Chromium is installed (Debian: apt install chromium)")
    expect.set_options(timeout=HANG_S * 1000)
    with sync_playwright() as playwright:
        yield playwright.chromium


@pytest.fixture(scope="module")
def browser(leftovers: Leftovers, chromium: BrowserType) -> Iterator[Browser]:
    chrome = chromium.launch(executable_path=CHROMIUM, args=WITHOUT_GPU)
    yield chrome
    chrome.close()


@pytest.fixture(scope="module")
def drawing_browser(leftovers: Leftovers, chromium: BrowserType) -> Iterator[Browser]:
    """A browser that draws the arm."""
    chrome = chromium.launch(executable_path=CHROMIUM, args=WITH_GPU)
    yield chrome
    chrome.close()


@pytest.fixture(scope="session")
def kept(leftovers: Leftovers) -> Iterator[tuple[Platform, subprocess.Popen[str], str]]:
    """A started platform, a panel beside it and its address, for the tests of this worker.

    The sixth joint and its drive have names that are scripts; the drives have their temperature in the process data. A
    cone limits the tool, and the second joint has limits beyond those of the file.
    """
    made = Platform()
    leftovers.shared.add(str(made.directory))
    made.be_patient(lost_ms=2000, period_us=PERIOD_US)
    arm, drive = made.directory / "config/assistive_arm.yaml", made.directory / "config/devices/cubemars-orh.yaml"
    text = re.sub(r"\b(drive6|joint6)\b", rf'"\g<1> {HOSTILE}"', arm.read_text())
    text = re.sub(
        r"(?m)^cartesian:.*$", r"\g<0>\n  cones: [{name: cup, axis: z, direction: [0, 0, 1], angle: 3.0}]", text
    )
    wider = "    absolute: {position: {min: -2.0, max: 2.1}}"
    arm.write_text(re.sub(r"(?m)^    slave: drive2$", rf"\g<0>\n{wider}", text))
    temperature = "- {index: 0x2000, sub_index: 1, type: int16, name: temperature, factor: 0.1}"
    drive.write_text(re.sub(r"( *)- \{index: 0x6061.*", rf"\g<0>\n\1{temperature}", drive.read_text()))
    try:
        made.rtcp("start", "--detach")
        with begun(made) as (process, url):
            yield made, process, url
            process.send_signal(signal.SIGCONT)
        made.thaw()
    finally:
        made.end()
        leftovers.shared.discard(str(made.directory))


@pytest.fixture(scope="module")
def platform(kept: tuple[Platform, subprocess.Popen[str], str]) -> Iterator[Platform]:
    """The started platform of this worker, which takes no time between two modules."""
    made, process, _ = kept
    process.send_signal(signal.SIGCONT)
    made.thaw()
    yield made
    made.freeze()
    process.send_signal(signal.SIGSTOP)


@pytest.fixture(scope="module")
def panel(platform: Platform, kept: tuple[Platform, subprocess.Popen[str], str]) -> str:
    """The address of the panel."""
    return kept[2]


@pytest.fixture
def page(browser: Browser, panel: str) -> Iterator[Page]:
    with visitor(browser, panel) as opened:
        yield opened


@pytest.fixture
def drawing(drawing_browser: Browser, panel: str) -> Iterator[Page]:
    """A page that draws the arm."""
    with visitor(drawing_browser, panel) as opened:
        yield opened


@contextlib.contextmanager
def visitor(browser: Browser, url: str, **options: Any) -> Iterator[Page]:
    """A browser window of its own; an error of the panel's scripts, or a name that runs as one, fails the test.

    Args:
        browser: where.
        url: the panel.
        options: of the window.
    """
    complaints: list[str] = []

    def dismiss(dialog: Dialog) -> None:
        complaints.append(f"a name ran as a script: {dialog.message}")
        dialog.dismiss()

    context = browser.new_context(base_url=url, viewport={"width": 1200, "height": 700}, **options)
    page = context.new_page()
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("dialog", dismiss)
    page.set_default_timeout(HANG_S * 1000)
    try:
        yield page
    finally:
        with contextlib.suppress(Error):  # a browser that was killed
            context.close()
    assert complaints == []


def show(page: Page, path: str) -> Page:
    """Open a page of the panel and wait until its state is live."""
    page.goto(path)
    page.wait_for_selector(LIVE)
    return page


def show_targets(page: Page) -> None:
    """Open the tab Targets and wait until its fields have the position of the arm; the last two are filled last."""
    show(page, "/targets")
    expect(page.get_by_label("joint5, rad")).to_have_value(re.compile(r"^0\.[45]"))


def log_in(page: Page, password: str = PASSWORD) -> None:
    """Log in."""
    page.goto("/")
    page.get_by_label("Your name").fill("Ada")
    page.get_by_label("Password").fill(password)
    page.get_by_role("button", name="Log in").click()
    page.wait_for_selector(LIVE)


_AT_REST = """() => !document.querySelector('[class*="-enter-active"], [class*="-leave-active"]')
    && ![...document.querySelectorAll('.q-loading-bar, .nicegui-error-popup')]
        .some(shown => getComputedStyle(shown).opacity > 0)"""
"""Whether nothing fades in or out, no page loads and none has lost its connection: none has its colours then."""


def barriers(page: Page, *rules: str) -> dict[str, list[str]]:
    """Return the serious and critical findings of axe-core, by rule; of some rules, or of all."""
    page.wait_for_function(_AT_REST)
    is_live = page.evaluate("Boolean(window.rtcp?.token)")
    options: dict[str, Any] = {"resultTypes": ["violations"], **({"runOnly": list(rules)} if rules else {})}
    found = {
        rule["id"]: [f"{node['html'][:150]}: {node['any'] and node['any'][0]['message']}" for node in rule["nodes"][:3]]
        for rule in Axe().run(page, options=options).response["violations"]
        if rule["impact"] in ("serious", "critical")
    }
    if is_live:
        # axe-core holds the page up for seconds, and a click with what it showed before is refused as late.
        page.wait_for_function("now => rtcp.token > now", arg=time.monotonic_ns())
    return found


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
