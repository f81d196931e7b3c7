"""Jogging by hand: every failure of the operator, the browser or the network ends the motion.

The network is a real one: Chromium in a namespace of its own, at the far end of a cable of `tests/panel/cable.py`.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import psutil
import pytest
from playwright.sync_api import Browser, BrowserType, Error, Page, expect

from kinematics.forward import forward
from rtcp.api import Feed
from rtcp.config.loader import load
from rtcp.panel import access
from rtcp.panel.live import JOG_S, PRESENCE_S
from tests.e2e.conftest import Platform
from tests.panel.cable import NEAR, Cable
from tests.panel.conftest import (
    BENT,
    CHROMIUM,
    FLAGS,
    PASSWORD,
    VIEWERS_PASSWORD,
    barriers,
    begun,
    log_in,
    ready,
    show,
    until,
    visitor,
)

pytestmark = [pytest.mark.platform, pytest.mark.browser]
NAMESPACE = f"rtcp-net-{os.getpid()}"
GRIPPER = 1 << 3
"""Mask of the gripper's output, number 4."""
SLACK_S = 0.35
"""Allowance for braking, the screen's frame and a shared host: figures without it are those of benchmarks/panel.py."""


def jogging(page: Page, platform: Platform) -> None:
    """Hold a pad until the arm moves."""
    show(page, "/jog")
    page.get_by_label("Frame").select_option("joints")
    page.get_by_role("button", name="joint1 +").hover()
    page.mouse.down()
    platform.until(lambda status: status["state"] == "moving", "the jog")
    time.sleep(0.5)


def moved_after(platform: Platform, feed: Feed, instant_ns: int) -> float:
    """Wait for standstill; return for how long the arm has moved since an instant, s."""
    until(lambda: platform.status()["state"] in ("holding", "ready"), "standstill")
    time.sleep(0.2)
    records, missing = feed.records()
    assert missing == 0
    commanded = records["commanded_position"]
    moving = np.flatnonzero(np.abs(np.diff(commanded, axis=0)).max(axis=1) > 1e-9)
    return max(0.0, (int(records["time_ns"][moving[-1] + 1]) - instant_ns) * 1e-9) if len(moving) else 0.0


@pytest.fixture
def feed(holding: Platform) -> Iterator[Feed]:
    records = Feed(holding.directory)
    yield records
    records.close()


def test_a_jog_lasts_as_long_as_it_is_held(page: Page, holding: Platform, feed: Feed) -> None:
    jogging(page, holding)
    assert holding.status()["lease"]["holder"].startswith("panel: local at this machine (page ")
    expect(page.locator("#operator")).to_have_text("You operate the arm")
    now = time.monotonic_ns()
    page.mouse.up()
    assert moved_after(holding, feed, now) < JOG_S + SLACK_S
    assert holding.status()["joints"]["actual_position"][0] > 0.02


def test_keys_jog_the_tool_while_they_are_held(page: Page, holding: Platform, feed: Feed) -> None:
    holding.call("mode", name="cartesian")
    show(page, "/jog")
    before = [float(page.locator(f"[data-live='tool.{at}']").inner_text()) for at in range(3)]
    page.locator(".jog-area").focus()
    page.keyboard.down("PageUp")
    holding.until(lambda status: status["state"] == "moving", "the jog")
    time.sleep(1.0)
    page.keyboard.up("PageUp")
    assert moved_after(holding, feed, time.monotonic_ns()) < JOG_S + SLACK_S
    page.wait_for_timeout(300)
    after = [float(page.locator(f"[data-live='tool.{at}']").inner_text()) for at in range(3)]
    assert after[2] - before[2] > 0.02
    assert after[:2] == pytest.approx(before[:2], abs=5e-3)


def test_what_holds_a_jog_back_is_shown_while_the_pad_is_held(page: Page, holding: Platform) -> None:
    holding.call("move_joints", q=[0.0] * 6)
    holding.call("mode", name="cartesian")
    show(page, "/jog")
    page.get_by_role("button", name="Up, +Z").hover()
    page.mouse.down()
    expect(page.locator("[data-live=message]").first).to_contain_text(
        "Moving, limited: the elbow is 0.000 rad from its singularity, limit 0.08 rad: jog away from it"
    )
    page.mouse.up()
    holding.until(lambda status: status["state"] == "holding", "standstill")


def test_the_gripper_is_opened_and_closed_by_its_buttons_and_keys(page: Page, holding: Platform) -> None:
    show(page, "/jog")
    page.get_by_role("button", name="Close gripper").click()
    holding.until(lambda status: status["devices"]["io"]["outputs"]["value"] & GRIPPER, "closed")
    expect(page.get_by_text("The gripper has closed")).to_be_visible()
    page.locator(".jog-area").focus()
    page.keyboard.press("o")
    holding.until(lambda status: not status["devices"]["io"]["outputs"]["value"] & GRIPPER, "open")


def test_a_key_ends_its_jog_also_where_its_letter_has_changed(page: Page, holding: Platform, feed: Feed) -> None:
    holding.call("mode", name="cartesian")
    show(page, "/jog")
    page.locator(".jog-area").focus()
    page.keyboard.down("w")
    holding.until(lambda status: status["state"] == "moving", "the jog")
    page.keyboard.down("Shift")
    page.keyboard.up("W")
    assert moved_after(holding, feed, time.monotonic_ns()) < JOG_S + SLACK_S
    page.keyboard.up("Shift")


def test_what_is_typed_into_a_field_jogs_nothing(page: Page, holding: Platform, feed: Feed) -> None:
    holding.call("mode", name="cartesian")
    show(page, "/jog")
    feed.records()
    for name in ("Speed, m/s", "Frame"):
        page.get_by_label(name).focus()
        page.keyboard.press("ArrowUp", delay=300)
    page.get_by_label("Speed, m/s").press_sequentially("1e-2", delay=100)
    records, _ = feed.records()
    assert np.ptp(records["commanded_position"], axis=0).max() < 1e-9


def test_a_gamepad_jogs_while_its_shoulder_button_is_held(
    browser: Browser, panel: str, holding: Platform, feed: Feed
) -> None:
    holding.call("mode", name="cartesian")
    with visitor(browser, panel) as page:
        # A mock: no gamepad can be plugged in here.
        page.add_init_script(
            "window.pad = { connected: true, axes: [0, 0, 0, 0],"
            " buttons: Array.from({length: 16}, () => ({ pressed: false })) };"
            "navigator.getGamepads = () => [window.pad];"
        )
        show(page, "/jog")
        page.evaluate("pad.axes[0] = -1")
        time.sleep(0.4)
        assert holding.status()["state"] == "holding"
        page.evaluate("pad.buttons[4].pressed = true")
        holding.until(lambda status: status["state"] == "moving", "the jog")
        now = time.monotonic_ns()
        page.evaluate("pad.buttons[4].pressed = false")
        assert moved_after(holding, feed, now) < JOG_S + SLACK_S
        page.evaluate("pad.buttons[4].pressed = true")
        holding.until(lambda status: status["state"] == "moving", "the jog")
        # The gripper ends the jog, which does not begin again by itself.
        now = time.monotonic_ns()
        page.evaluate("pad.buttons[0].pressed = true")
        holding.until(lambda status: status["devices"]["io"]["outputs"]["value"] & GRIPPER, "closed")
        assert moved_after(holding, feed, now) < JOG_S + SLACK_S
        page.evaluate("pad.buttons[0].pressed = pad.buttons[4].pressed = false")
        page.wait_for_timeout(200)
        page.evaluate("pad.buttons[4].pressed = true")
        holding.until(lambda status: status["state"] == "moving", "the jog")
        now = time.monotonic_ns()
        page.keyboard.press("Escape")
        assert moved_after(holding, feed, now) < JOG_S + SLACK_S
        time.sleep(0.5)
        page.keyboard.press("Escape")  # a second time starts nothing
        time.sleep(0.5)
        records, _ = feed.records()
        assert np.ptp(records["commanded_position"], axis=0).max() < 1e-9


@pytest.mark.parametrize("how", ["blur", "hidden", "overloaded", "left", "closed"])
def test_a_jog_ends_with_the_attention_of_its_page(
    browser: Browser, panel: str, holding: Platform, feed: Feed, how: str
) -> None:
    with visitor(browser, panel) as page:
        jogging(page, holding)
        now = time.monotonic_ns()
        if how == "blur":
            page.evaluate("window.dispatchEvent(new Event('blur'))")
        elif how == "hidden":
            # A mock: a headless browser hides no tab.
            page.evaluate(
                "Object.defineProperty(document, 'hidden', { value: true });"
                "document.dispatchEvent(new Event('visibilitychange'))"
            )
        elif how == "overloaded":
            page.evaluate("setTimeout(() => { const end = Date.now() + 3000; while (Date.now() < end) ; }, 0)")
        elif how == "left":
            page.goto("about:blank")
        else:
            page.close()
        assert moved_after(holding, feed, now) < JOG_S + SLACK_S
        if how in ("blur", "hidden", "overloaded"):
            # Still pressed: it does not begin again by itself.
            time.sleep(3.5 if how == "overloaded" else 0.5)
            assert holding.status()["state"] == "holding"
            records, _ = feed.records()
            assert np.ptp(records["commanded_position"][:, 0]) < 1e-9


@pytest.mark.parametrize("motion", ["jog", "move"])
@pytest.mark.parametrize("loss", ["browser killed", "browser stopped", "panel killed"])
def test_the_arm_stops_when_browser_or_panel_does(
    chromium: BrowserType, platform: Platform, motion: str, loss: str
) -> None:
    """A machine whose lid is closed hangs with open connections, as a browser after SIGSTOP does."""
    with begun(platform) as (panel, url):
        ready(platform)
        before = set(psutil.Process().children(recursive=True))
        own = chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        with contextlib.suppress(Error), visitor(own, url) as page:
            begin(page, platform, motion)
            browser = set(psutil.Process().children(recursive=True)) - before
            with contextlib.closing(Feed(platform.directory)) as feed:
                now = time.monotonic_ns()
                for process in [psutil.Process(panel.pid)] if loss == "panel killed" else browser:
                    with contextlib.suppress(psutil.Error):
                        process.suspend() if loss == "browser stopped" else process.kill()
                try:
                    took = moved_after(platform, feed, now)
                finally:
                    for process in browser:
                        with contextlib.suppress(psutil.Error):
                            process.resume()
                time.sleep(1.0)  # keys pressed before move nothing
                assert np.ptp(feed.records()[0]["commanded_position"][:, 0]) < 1e-9
        with contextlib.suppress(Error):
            own.close()
    assert took < (PRESENCE_S if (motion, loss) == ("move", "browser stopped") else JOG_S) + SLACK_S
    assert platform.status()["state"] == "holding"


def begin(page: Page, platform: Platform, motion: str) -> None:
    """Jog, or send a long move."""
    if motion == "jog":
        jogging(page, platform)
        return
    show(page, "/targets")
    expect(page.get_by_label("joint1, rad")).to_have_value("0")
    page.get_by_label("joint1, rad").fill("1.5")
    page.get_by_role("spinbutton", name="Speed").fill("0.1")
    page.get_by_role("button", name="Plan").click()
    page.get_by_role("button", name="Send", exact=True).click()
    platform.until_moving()


def test_the_stop_button_ends_a_move_of_anybody(browser: Browser, panel: str, holding: Platform, feed: Feed) -> None:
    with visitor(browser, panel) as page:
        begin(page, holding, "move")
        with visitor(browser, panel) as second:
            show(second, "/health")
            now = time.monotonic_ns()
            second.get_by_role("button", name="STOP not the emergency stop").click()
            assert moved_after(holding, feed, now) < JOG_S + SLACK_S
        assert abs(holding.status()["joints"]["actual_position"][0]) < 1.4


@pytest.mark.parametrize("how", ["blur", "overloaded", "closed"])
def test_a_move_ends_with_its_page_and_not_with_the_focus(
    browser: Browser, panel: str, holding: Platform, feed: Feed, how: str
) -> None:
    with visitor(browser, panel) as page:
        begin(page, holding, "move")
        now = time.monotonic_ns()
        if how == "blur":
            page.evaluate("window.dispatchEvent(new Event('blur'))")
            time.sleep(PRESENCE_S + SLACK_S)
            assert holding.status()["state"] == "moving"
            return
        if how == "overloaded":
            page.evaluate("setTimeout(() => { const end = Date.now() + 3000; while (Date.now() < end) ; }, 0)")
        else:
            page.close()
        assert moved_after(holding, feed, now) < (PRESENCE_S if how == "overloaded" else JOG_S) + SLACK_S
        assert abs(holding.status()["joints"]["actual_position"][0]) < 1.4


@pytest.mark.parametrize("how", ["finger", "space bar"])
def test_a_pad_of_the_tool_frame_is_held_by(
    browser: Browser, panel: str, holding: Platform, feed: Feed, how: str
) -> None:
    holding.call("mode", name="cartesian")
    with visitor(browser, panel, has_touch=True) as page:
        show(page, "/jog")
        page.get_by_label("Frame").select_option("tool")
        pad = page.get_by_role("button", name="Up, +Z")
        arm = load(Path(holding.environment["RTCP_CONFIG"])).arm
        assert arm is not None
        before = forward(arm, holding.status()["joints"]["actual_position"])
        if how == "finger":
            box = pad.bounding_box()
            assert box is not None
            at = {"x": box["x"] + box["width"] / 2, "y": box["y"] + box["height"] / 2}
            hand = page.context.new_cdp_session(page)
            hand.send("Input.dispatchTouchEvent", {"type": "touchStart", "touchPoints": [at]})
        else:
            pad.focus()
            page.keyboard.down("Space")
        holding.until(lambda status: status["state"] == "moving", "the jog")
        time.sleep(1.0)
        now = time.monotonic_ns()
        if how == "finger":
            hand.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
        else:
            page.keyboard.up("Space")
        assert moved_after(holding, feed, now) < JOG_S + SLACK_S
        after = forward(arm, holding.status()["joints"]["actual_position"])
        x, y, z = (before.inverse() @ after).position
        assert z > 0.01
        assert max(abs(x), abs(y)) < 0.1 * z + 1e-3


def test_a_viewer_looks_and_stops_and_commands_nothing(browser: Browser, holding: Platform, feed: Feed) -> None:
    passwords = Path(holding.environment["RTCP_STATE_DIR"], "panel.json")
    access.set_password(passwords, "operator", PASSWORD)
    access.set_password(passwords, "viewer", VIEWERS_PASSWORD)
    holding.call("move_gripper", open=True)
    since, limits = holding.last_event(), holding.call("limits")
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
            page.wait_for_timeout(700)
            page.mouse.up()
            status = holding.status()
            assert (status["state"], status["drive_mode"], status["lease"]["holder"]) == ("holding", "csp", "")
            assert holding.events(since) == []
            assert holding.call("limits") == limits
            assert holding.call("record_status")["recordings"] == []
            assert not status["devices"]["io"]["outputs"]["value"] & GRIPPER
            records, _ = feed.records()
            assert np.ptp(records["commanded_position"], axis=0).max() < 1e-9
            holding.background("move", "1.5", *map(str, BENT[1:]), "--speed", "0.1")
            holding.until_moving()
            page.get_by_role("button", name="STOP not the emergency stop").click()
            holding.until(lambda now: now["state"] == "holding", "standstill")
    finally:
        passwords.unlink()
        holding.end_commands()


def test_nothing_moves_after_stop_that_was_clicked_before(browser: Browser, panel: str, holding: Platform) -> None:
    with visitor(browser, panel) as page:
        begin(page, holding, "move")
        since = holding.last_event()
        # A click that takes longer to the panel than STOP: it has an earlier token.
        page.evaluate("Object.defineProperty(rtcp, 'token', { value: rtcp.token })")
        page.keyboard.press("Escape")
        holding.until(lambda status: status["state"] == "holding", "standstill")
        page.get_by_role("button", name="Plan").click()
        page.get_by_role("button", name="Send", exact=True).click()
        expect(page.get_by_text("STOP was pressed after this click")).to_be_visible()
        page.wait_for_timeout(1500)
        page.get_by_role("button", name="Plan").click()
        page.get_by_role("button", name="Send", exact=True).click()
        expect(page.get_by_text(re.compile(r"the click came \d\.\d s late"))).to_be_visible()
        assert "moving" not in holding.events(since)
        assert holding.status()["state"] == "holding"


def test_the_arm_is_handed_over_only_when_asked(browser: Browser, panel: str, holding: Platform) -> None:
    with visitor(browser, panel) as first, visitor(browser, panel) as second:
        begin(first, holding, "move")
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
        assert holding.status()["state"] == "moving"
        second.get_by_role("button", name="Disable").click()
        second.get_by_role("button", name="Ask to take over").click()
        first.get_by_role("button", name="Give it").click()
        expect(second.locator("#operator")).to_have_text("You operate the arm")
        expect(first.get_by_text("has taken over the arm")).to_be_visible()
        holding.until(lambda status: status["state"] == "holding", "what moved has stopped")
        # Without an answer the lease passes on after 10 s.
        show(first, "/")
        first.get_by_role("button", name="Disable").click()
        expect(first.get_by_role("button", name="Ask to take over")).to_be_visible()
        assert barriers(first) == {}
        began = time.monotonic()
        first.get_by_role("button", name="Ask to take over").click()
        expect(second.get_by_role("button", name="Keep it")).to_be_visible()
        assert barriers(second) == {}
        expect(first.locator("#operator")).to_have_text("You operate the arm", timeout=20_000)
        assert time.monotonic() - began > 9.0


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
        browser = chromium.launch(executable_path=cable.far(CHROMIUM, tmp_path), args=FLAGS)
        ready(platform)
        with contextlib.suppress(Error), visitor(browser, url) as page:
            log_in(page)
            yield page
        with contextlib.suppress(Error):
            browser.close()


@pytest.mark.parametrize(("motion", "how"), [("jog", "cut"), ("move", "cut"), ("jog", "slow")])
def test_a_network_that_fails_stops_the_arm(
    platform: Platform, cable: Cable, far_page: Page, motion: str, how: str
) -> None:
    begin(far_page, platform, motion)
    with contextlib.closing(Feed(platform.directory)) as feed:
        now = time.monotonic_ns()
        if how == "cut":
            cable.cut()
        else:
            cable.delay_s = 0.15
        took = moved_after(platform, feed, now)
    assert took < (JOG_S if motion == "jog" else PRESENCE_S) + SLACK_S


@pytest.mark.parametrize(("delay_s", "loss"), [(0.15, 0.0), (0.0, 0.2)])
def test_stop_ends_a_move_over_a_bad_network(
    platform: Platform, cable: Cable, far_page: Page, delay_s: float, loss: float
) -> None:
    begin(far_page, platform, "move")
    cable.delay_s, cable.loss = delay_s, loss
    time.sleep(1.5)
    assert platform.status()["state"] == "moving"
    with contextlib.closing(Feed(platform.directory)) as feed:
        now = time.monotonic_ns()
        far_page.get_by_role("button", name="STOP not the emergency stop").click()
        # If STOP itself is lost, all later messages wait for it: the presence expires.
        assert moved_after(platform, feed, now) < PRESENCE_S + SLACK_S


def test_a_slow_network_does_not_jog(platform: Platform, cable: Cable, far_page: Page) -> None:
    show(far_page, "/jog")
    far_page.get_by_label("Frame").select_option("joints")
    far_page.get_by_role("button", name="joint1 +").hover()
    cable.delay_s = 0.15
    far_page.wait_for_timeout(1500)
    far_page.mouse.down()
    expect(far_page.locator("#notes")).to_contain_text("no jog: to this browser and back it takes 0.3")
    far_page.mouse.up()
    assert platform.status()["joints"]["actual_position"][0] == pytest.approx(0.0, abs=1e-3)


def test_a_lossy_network_never_jogs_on(platform: Platform, cable: Cable, far_page: Page) -> None:
    show(far_page, "/jog")
    far_page.get_by_label("Frame").select_option("joints")
    pad = far_page.get_by_role("button", name="joint1 +")
    cable.loss = 0.2
    presses = 0
    # Some presses come too late to move the arm; at least one must move it.
    while presses < 5 or (presses < 30 and platform.status()["joints"]["actual_position"][0] < 1e-3):
        presses += 1
        with contextlib.closing(Feed(platform.directory)) as feed:
            pad.hover()
            far_page.mouse.down()
            time.sleep(0.7)
            now = time.monotonic_ns()
            far_page.mouse.up()
            assert moved_after(platform, feed, now) < JOG_S + SLACK_S
    assert platform.status()["joints"]["actual_position"][0] > 1e-3
