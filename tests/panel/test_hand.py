"""Jogging by hand: every failure of the operator, the browser or the network ends the motion, and it does not resume.

How soon a motion ends: tests/panel/test_live.py, and benchmarks/panel.py. The network is a real one: Chromium in a
namespace of its own, at the far end of a cable of `tests/panel/cable.py`.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import psutil
import pytest
from playwright.sync_api import Browser, BrowserType, Error, Page, expect

from kinematics.forward import forward
from rtcp.api import Feed
from rtcp.config.loader import load
from rtcp.panel import access
from tests.e2e.conftest import Platform
from tests.panel.cable import NEAR, Cable
from tests.panel.conftest import (
    BENT,
    CHROMIUM,
    PASSWORD,
    VIEWERS_PASSWORD,
    WITHOUT_GPU,
    barriers,
    begun,
    log_in,
    ready,
    show,
    show_targets,
    visitor,
)
from tests.waiting import until

pytestmark = [pytest.mark.platform, pytest.mark.browser]
NAMESPACE = f"rtcp-net-{os.getpid()}"
GRIPPER = 1 << 3
"""Mask of the gripper's output, number 4."""
AT_REST_S = 0.4
"""Cycles of this time without motion prove that a motion has ended for good: a jog resumes with the next message."""


def hold(press: Callable[[], object], release: Callable[[], object], met: Callable[[], bool]) -> None:
    """Hold a pad or key until `met`; press it anew where the jog has ended by itself, as it does on a busy host."""

    def pressed() -> bool:
        press()
        for _ in range(20):
            if met():
                return True
            time.sleep(0.05)
        release()
        return False

    until(pressed, "the jog")


def moves(platform: Platform) -> bool:
    return bool(platform.status()["state"] == "moving")


def press(page: Page, platform: Platform) -> None:
    """Hold a pad until the arm moves."""
    page.get_by_role("button", name="joint1 +").hover()
    hold(page.mouse.down, page.mouse.up, lambda: moves(platform))


def jogging(page: Page, platform: Platform) -> None:
    """Open the tab Jog, and hold a pad until the arm moves."""
    show(page, "/jog")
    page.get_by_label("Frame").select_option("joints")
    press(page, platform)


def stands(platform: Platform, page: Page | None = None) -> None:
    """Wait until the arm holds; from then on no cycle moves it, also while the page, if given, goes on answering."""
    platform.until(lambda status: status["state"] in ("holding", "ready"), "standstill")
    token = page.evaluate("rtcp.token") if page else 0
    parts = []

    def over() -> bool:
        parts.append(feed.records()[0])
        answered = not page or page.evaluate("rtcp.token") > token + AT_REST_S * 1e9
        return bool(answered and sum(map(len, parts)) * feed.period_ns > AT_REST_S * 1e9)

    with contextlib.closing(Feed(platform.directory)) as feed:
        until(over, "cycles at rest")
    assert np.ptp(np.concatenate(parts)["commanded_position"], axis=0).max() < 1e-9


def tool_at(page: Page) -> list[float]:
    return [float(page.locator(f"[data-live='tool.{at}']").inner_text()) for at in range(3)]


def test_a_jog_lasts_as_long_as_it_is_held_and_ends_without_the_attention_of_its_page(
    browser: Browser, panel: str, holding: Platform
) -> None:
    with visitor(browser, panel) as page:
        jogging(page, holding)
        assert holding.status()["lease"]["holder"].startswith("panel: local at this machine (page ")
        expect(page.locator("#operator")).to_have_text("You operate the arm")
        page.mouse.up()
        stands(holding, page)
        endings: dict[str, Callable[[], object]] = {
            "blur": lambda: page.evaluate("window.dispatchEvent(new Event('blur'))"),
            # A mock: a headless browser hides no tab.
            "hidden": lambda: page.evaluate(
                "Object.defineProperty(document, 'hidden', { value: true, configurable: true });"
                "document.dispatchEvent(new Event('visibilitychange')); delete document.hidden"
            ),
            "STOP": lambda: page.keyboard.press("Escape"),
        }
        for end in endings.values():
            press(page, holding)
            end()
            stands(holding, page)  # the pad is still pressed: nothing begins again by itself
            page.mouse.up()
        press(page, holding)
        page.goto("about:blank")
        stands(holding)
        jogging(page, holding)
        page.close()
        stands(holding)


def test_keys_jog_the_tool_while_they_are_held_and_move_nothing_in_a_field(page: Page, holding: Platform) -> None:
    holding.call("mode", name="cartesian")
    show(page, "/jog")
    before = tool_at(page)
    page.locator(".jog-area").focus()
    down, up = page.keyboard.down, page.keyboard.up
    hold(lambda: down("PageUp"), lambda: up("PageUp"), lambda: tool_at(page)[2] > before[2] + 0.02)
    up("PageUp")
    stands(holding, page)
    assert tool_at(page)[:2] == pytest.approx(before[:2], abs=5e-3)
    hold(lambda: down("w"), lambda: up("w"), lambda: moves(holding))
    down("Shift")
    up("W")  # its letter has changed
    up("Shift")
    stands(holding, page)
    rest = holding.status()["joints"]["commanded_position"]
    for name in ("Speed, m/s", "Frame"):
        page.get_by_label(name).focus()
        page.keyboard.press("ArrowUp", delay=300)
    page.get_by_label("Speed, m/s").press_sequentially("1e-2", delay=100)
    assert holding.status()["joints"]["commanded_position"] == rest


def test_a_gamepad_jogs_while_its_shoulder_button_is_held(browser: Browser, panel: str, holding: Platform) -> None:
    holding.call("mode", name="cartesian")
    with visitor(browser, panel) as page:
        # A mock: no gamepad can be plugged in here.
        page.add_init_script(
            "window.pad = { connected: true, axes: [0, 0, 0, 0],"
            " buttons: Array.from({length: 16}, () => ({ pressed: false })) };"
            "navigator.getGamepads = () => [window.pad];"
        )

        def enable(is_pressed: str) -> Callable[[], object]:
            return lambda: page.evaluate(
                f"pad.buttons[4].pressed = {is_pressed};"
                "new Promise((seen) => { const end = rtcp.listen(() => { end(); seen(); }); })"
            )

        def jogs() -> None:
            hold(enable("true"), enable("false"), lambda: moves(holding))

        show(page, "/jog")
        page.evaluate("pad.axes[0] = -1")
        stands(holding, page)
        jogs()
        enable("false")()
        stands(holding, page)
        jogs()
        # The gripper ends the jog, which does not begin again by itself.
        page.evaluate("pad.buttons[0].pressed = true")
        holding.until(lambda status: status["devices"]["io"]["outputs"]["value"] & GRIPPER, "closed")
        stands(holding, page)
        page.evaluate("pad.buttons[0].pressed = false")
        jogs()
        for _ in range(2):  # the second time it starts nothing
            page.keyboard.press("Escape")
            stands(holding, page)


def test_a_pad_of_the_tool_frame_is_held_by_a_finger_or_the_space_bar(
    browser: Browser, panel: str, holding: Platform
) -> None:
    holding.call("mode", name="cartesian")
    arm = load(Path(holding.environment["RTCP_CONFIG"])).arm
    assert arm is not None
    before = forward(arm, holding.status()["joints"]["actual_position"])
    with visitor(browser, panel, has_touch=True) as page:

        def tool() -> tuple[float, ...]:
            return (before.inverse() @ forward(arm, holding.status()["joints"]["actual_position"])).position

        def touch(kind: str, *points: dict[str, float]) -> object:
            return hand.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": list(points)})

        show(page, "/jog")
        page.get_by_label("Frame").select_option("tool")
        pad = page.get_by_role("button", name="Up, +Z")
        box = pad.bounding_box()
        assert box is not None
        at = {"x": box["x"] + box["width"] / 2, "y": box["y"] + box["height"] / 2}
        hand = page.context.new_cdp_session(page)
        hold(lambda: touch("touchStart", at), lambda: touch("touchEnd"), lambda: tool()[2] > 0.01)
        touch("touchEnd")
        stands(holding, page)
        pad.focus()
        hold(lambda: page.keyboard.down("Space"), lambda: page.keyboard.up("Space"), lambda: tool()[2] > 0.03)
        page.keyboard.up("Space")
        stands(holding, page)
        x, y, z = tool()
        assert max(abs(x), abs(y)) < 0.1 * z + 1e-3


def test_a_jog_ends_when_its_browser_hangs_or_is_killed_and_does_not_resume(
    chromium: BrowserType, panel: str, holding: Platform
) -> None:
    """A machine whose lid is closed hangs with open connections, as a browser after SIGSTOP does."""
    before = set(psutil.Process().children(recursive=True))
    own = chromium.launch(executable_path=CHROMIUM, args=WITHOUT_GPU)
    with contextlib.suppress(Error), visitor(own, panel) as page:
        jogging(page, holding)
        browser = set(psutil.Process().children(recursive=True)) - before
        try:
            each(browser, psutil.Process.suspend)
            stands(holding)
        finally:
            each(browser, psutil.Process.resume)
        stands(holding, page)  # the pad is still pressed
        page.mouse.up()
        press(page, holding)
        each(browser, psutil.Process.kill)
        stands(holding)
    with contextlib.suppress(Error):
        own.close()


def each(processes: set[psutil.Process], do: Callable[[psutil.Process], None]) -> None:
    for process in processes:
        with contextlib.suppress(psutil.Error):
            do(process)


def test_a_jog_ends_when_its_panel_is_killed(browser: Browser, holding: Platform) -> None:
    with begun(holding) as (process, url), visitor(browser, url) as page:
        jogging(page, holding)
        process.kill()
        stands(holding)


def begin(page: Page, platform: Platform) -> None:
    """Send a move of more than a minute."""
    show_targets(page)
    page.get_by_label("joint1, rad").fill("1.5")
    page.get_by_role("spinbutton", name="Speed").fill("0.02")
    page.get_by_role("button", name="Plan").click()
    page.get_by_role("button", name="Send", exact=True).click()
    platform.until(lambda status: status["state"] == "moving", "motion")


def test_a_move_goes_on_without_the_focus_and_ends_with_its_page_or_by_stop_of_anybody(
    browser: Browser, panel: str, holding: Platform
) -> None:
    with visitor(browser, panel) as page, visitor(browser, panel) as second:
        begin(page, holding)
        token = page.evaluate("window.dispatchEvent(new Event('blur')); rtcp.token")
        until(lambda: page.evaluate("rtcp.token") > token + 1.3e9, "more messages than its presence lasts")
        assert holding.status()["state"] == "moving"
        show(second, "/health")
        second.get_by_role("button", name="STOP not the emergency stop").click()
        stands(holding)
        begin(page, holding)
        page.close()
        stands(holding)
        assert abs(holding.status()["joints"]["actual_position"][0]) < 1.4


def test_a_click_that_comes_after_a_later_stop_does_nothing(page: Page, holding: Platform) -> None:
    show(page, "/")
    # A click that takes longer to the panel than STOP: it has an earlier token.
    page.evaluate("Object.defineProperty(rtcp, 'token', { value: rtcp.token })")
    page.keyboard.press("Escape")
    stands(holding)
    page.get_by_role("button", name="Disable", exact=True).click()
    refusal = re.compile(r"STOP was pressed after this click|the click came \d+\.\d s late")
    expect(page.get_by_text(refusal)).to_be_visible()
    assert holding.status()["state"] == "holding"


def recordings(platform: Platform) -> list[list[str]]:
    """Return the files of each recording since the start of the platform, also of those that tests before have made."""
    return [recording["files"] for recording in platform.call("record_status")["recordings"]]


def test_a_viewer_looks_and_stops_and_commands_nothing(browser: Browser, holding: Platform) -> None:
    passwords = Path(holding.environment["RTCP_STATE_DIR"], "panel.json")
    access.set_password(passwords, "operator", PASSWORD)
    access.set_password(passwords, "viewer", VIEWERS_PASSWORD)
    holding.call("move_gripper", open=True)
    since, limits = holding.last_event(), holding.call("limits")
    recorded = recordings(holding)
    rest = holding.status()["joints"]["commanded_position"]
    try:
        with begun(holding) as (_, url), visitor(browser, url) as page:
            page.goto("/")
            assert barriers(page) == {}
            log_in(page, VIEWERS_PASSWORD)
            refused = page.get_by_text("Ada may look, and not command: log in as an operator")
            for path, name in (
                ("/", "Disable"),
                ("/", "Set drive mode"),
                ("/", "Stop the platform"),
                ("/targets", "Send"),
                ("/jog", "Close gripper"),
                ("/limits", "Set the limits"),
                ("/recorder", "Record"),
            ):
                show(page, path)
                if path == "/targets":
                    page.get_by_label("joint1, rad").fill("0.5")
                    page.get_by_role("button", name="Plan").click()
                if path == "/limits":
                    page.get_by_label("joint2 max").fill("1.5")
                page.get_by_role("button", name=name, exact=True).click()
                expect(refused).not_to_have_count(0)
            show(page, "/segment")
            expect(page.get_by_role("heading", name="Objects (SDO)")).to_be_visible()
            assert page.get_by_role("button", name="Make the fault").count() == 0
            show(page, "/jog")
            page.get_by_label("Frame").select_option("joints")
            page.get_by_role("button", name="joint1 +").hover()
            page.mouse.down()
            stands(holding, page)
            page.mouse.up()
            status = holding.status()
            assert (status["state"], status["drive_mode"], status["lease"]["holder"]) == ("holding", "csp", "")
            assert holding.events(since) == []
            assert holding.call("limits") == limits
            assert recordings(holding) == recorded
            assert not status["devices"]["io"]["outputs"]["value"] & GRIPPER
            assert status["joints"]["commanded_position"] == rest
            holding.background("move", "1.5", *map(str, BENT[1:]), "--speed", "0.02")
            holding.until(lambda now: now["state"] == "moving", "motion")
            page.get_by_role("button", name="STOP not the emergency stop").click()
            holding.until(lambda now: now["state"] == "holding", "standstill")
    finally:
        passwords.unlink()
        holding.end_commands()


def test_the_arm_is_handed_over_only_when_asked(browser: Browser, panel: str, holding: Platform) -> None:
    with visitor(browser, panel) as first, visitor(browser, panel) as second:
        begin(first, holding)
        show(second, "/")
        expect(second.locator("#operator")).to_have_text(
            re.compile(r"local at this machine \(page \d+\) operates the arm")
        )
        second.get_by_role("button", name="Disable").click()
        second.get_by_role("button", name="Ask to take over").click()
        expect(first.get_by_role("button", name="Keep it")).to_be_visible()
        # The question covers nothing.
        first.get_by_role("button", name="STOP not the emergency stop").click(trial=True)
        first.get_by_role("button", name="Keep it").click()
        expect(second.get_by_text("keeps the arm")).to_be_visible()
        expect(first.locator("#operator")).to_have_text("You operate the arm")
        second.get_by_role("button", name="Disable").click()
        assert barriers(second) == {}
        second.get_by_role("button", name="Ask to take over").click()
        first.get_by_role("button", name="Give it").click()
        expect(second.locator("#operator")).to_have_text("You operate the arm")
        expect(first.get_by_text("has taken over the arm")).to_be_visible()
        holding.until(lambda status: status["state"] == "holding", "what moved has stopped")


# -- over a network -------------------------------------------------------------------------------------------------


@pytest.fixture
def cable(platform: Platform) -> Iterator[Cable]:
    """From the panel to a namespace for the browser."""
    if os.geteuid() or not (shutil.which("ip") and CHROMIUM):
        pytest.skip("needs root, iproute2 and Chromium")
    far = Cable(NAMESPACE)
    try:
        yield far
    finally:
        far.close()
        Path(platform.environment["RTCP_STATE_DIR"], "panel.json").unlink(missing_ok=True)


@pytest.fixture
def far_page(chromium: BrowserType, platform: Platform, cable: Cable, tmp_path: Path) -> Iterator[Page]:
    """A page at the far end of the cable, logged in; the platform holds."""
    access.set_password(Path(platform.environment["RTCP_STATE_DIR"], "panel.json"), "operator", PASSWORD)
    with begun(platform, "--host", NEAR) as (_, url):
        browser = chromium.launch(executable_path=cable.far(CHROMIUM, tmp_path), args=WITHOUT_GPU)
        ready(platform)
        with contextlib.suppress(Error), visitor(browser, url) as page:
            log_in(page)
            yield page
        with contextlib.suppress(Error):
            browser.close()


def test_over_a_network_that_is_slow_lossy_or_cut_no_jog_goes_on(
    platform: Platform, cable: Cable, far_page: Page
) -> None:
    jogging(far_page, platform)
    cable.delay_s = 0.15
    stands(platform)
    far_page.mouse.up()
    far_page.mouse.down()
    expect(far_page.locator("#notes")).to_contain_text(
        re.compile(r"no jog: to this browser and back it takes 0\.[3-9]")
    )
    far_page.mouse.up()
    stands(platform, far_page)
    cable.delay_s, cable.loss = 0.0, 0.2
    far_page.mouse.down()
    far_page.mouse.up()
    stands(platform, far_page)
    cable.loss = 0.0
    begin(far_page, platform)
    cable.loss = 0.2
    far_page.get_by_role("button", name="STOP not the emergency stop").click()
    # If STOP itself is lost, all later messages wait for it: the presence expires.
    stands(platform)
    cable.loss = 0.0
    jogging(far_page, platform)
    cable.cut()
    stands(platform)
