"""The frame around the tabs, used as a person would: guidance, units, override, steps, alarms, trends."""

from __future__ import annotations

import itertools
import math
import re
import time
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, ViewportSize, expect

from kinematics.forward import forward
from rtcp.api import EventRecord, State
from rtcp.config.loader import load
from rtcp.panel.live import NEXT, Live, sentence
from rtcp.panel.server import PAGES
from rtcp.panel.trends import KEPT_S, SAMPLE_S, Trends
from tests.e2e.conftest import Platform
from tests.panel.conftest import BENT, begun, show, until, visitor

pytestmark = [pytest.mark.platform, pytest.mark.browser]
PHONE: ViewportSize = {"width": 400, "height": 844}


def tool_of(platform: Platform) -> tuple[float, ...]:
    arm = load(Path(platform.environment["RTCP_CONFIG"])).arm
    assert arm is not None
    return forward(arm, platform.status()["joints"]["commanded_position"]).position


def test_whoever_comes_first_is_led_from_start_to_motion_on_a_phone(browser: Browser) -> None:
    platform = Platform()
    platform.be_patient(lost_ms=2000)
    try:
        with begun(platform) as (_, url), visitor(browser, url) as page:
            page.set_viewport_size(PHONE)
            show(page, "/jog")
            step = page.locator("#lead li[aria-current]")
            expect(step).to_contain_text("Start the virtual arm")
            step.get_by_role("button").click()
            expect(step).to_contain_text("Enable", timeout=60_000)
            expect(page.locator(".arm-view canvas")).to_be_visible()  # without a reload
            page.get_by_role("button", name="Enable").click()
            expect(step).to_contain_text("Move it", timeout=20_000)
            page.get_by_label("Frame").select_option("joints")  # straight up the tool has no way to go
            page.get_by_role("button", name="joint1 +").hover()
            page.mouse.down()
            platform.until(lambda status: status["state"] == "moving", "the jog")
            page.mouse.up()
            expect(page.locator("#lead")).to_be_hidden(timeout=20_000)
            show(page, "/jog")
            for name in ("Forward, +X", "Back, \N{MINUS SIGN}X", "Yaw +", "Pitch \N{MINUS SIGN}", "Close gripper"):
                expect(page.get_by_role("button", name=name)).to_be_in_viewport(ratio=1)
            page.evaluate("scrollTo(0, document.body.scrollHeight)")
            expect(page.get_by_role("button", name="STOP not the emergency stop")).to_be_in_viewport(ratio=1)
            show(page, "/alarms")
            tab = page.get_by_role("link", name="Alarms", exact=True)
            expect(tab).to_be_in_viewport(ratio=1)
            assert tab.evaluate("tab => tab.parentElement.clientHeight") < 60
    finally:
        platform.end_commands()
        platform.rtcp("stop", check=None)


def test_the_arm_and_what_a_tab_was_set_to_stay_while_others_are_shown(page: Page, holding: Platform) -> None:
    show(page, "/jog")
    page.get_by_label("Frame").select_option("joints")
    page.evaluate("window.canvas = document.querySelector('.arm-view canvas')")
    for path, tab in PAGES.items():
        if path not in ("/cell", "/processes"):
            page.get_by_role("link", name=tab.name, exact=True).click()
            expect(page.get_by_role("heading", level=1)).to_have_text(tab.name)
            expect(page).to_have_url(re.compile(f"{path}$"))
            assert page.evaluate("canvas.isConnected && canvas.clientHeight > 100")
            expect(page.get_by_role("button", name="Home", exact=True)).to_be_in_viewport()
    page.get_by_role("link", name="Jog", exact=True).click()
    expect(page.get_by_label("Frame")).to_have_value("joints")
    expect(page.get_by_role("button", name="joint1 +")).to_be_visible()


def test_every_state_has_words_for_what_to_do_next() -> None:
    assert set(NEXT) == {state.name.lower() for state in State}


def test_home_is_asked_for_and_then_reached(page: Page, holding: Platform) -> None:
    holding.call("move_joints", q=[0.3, *BENT[1:]])
    show(page, "/health")
    page.get_by_role("button", name="Home", exact=True).click()
    page.get_by_role("button", name="Leave it").click()
    expect(page.get_by_role("button", name="Leave it")).to_have_count(0)
    page.get_by_role("button", name="Home", exact=True).click()
    page.get_by_role("button", name="Move home").click()
    holding.until(lambda status: status["state"] == "moving", "on the way")
    home = load(Path(holding.environment["RTCP_CONFIG"])).home
    assert home is not None
    expect(page.get_by_text("The arm is at home")).to_be_visible(timeout=20_000)
    assert holding.status()["joints"]["actual_position"] == pytest.approx(home, abs=1e-3)


def test_the_override_slows_what_the_page_moves_and_others_may_only_lower_it(
    browser: Browser, panel: str, page: Page, holding: Platform
) -> None:
    show(page, "/targets")
    page.get_by_label("joint1, rad").fill("1.2")
    page.get_by_role("spinbutton", name="Speed").fill("0.1")
    page.get_by_role("button", name="Plan").click()
    page.get_by_role("button", name="Send", exact=True).click()
    holding.until_moving()
    slider = page.get_by_role("slider", name="Override", exact=True)
    for _ in range(3):
        slider.press("PageDown")
    holding.until(lambda status: status["speed_override"] < 0.9, "slower")
    assert holding.status()["state"] == "moving"
    with visitor(browser, panel) as second:
        show(second, "/health")
        second.get_by_role("slider", name="Override", exact=True).press("Home")
        holding.until(lambda status: status["speed_override"] == pytest.approx(0.01), "as slow as can be")
        expect(page.locator("output")).to_have_text("1 %")
        second.get_by_role("slider", name="Override", exact=True).press("End")
        expect(second.get_by_role("button", name="Ask to take over")).to_be_visible()
    assert holding.status()["speed_override"] == pytest.approx(0.01)
    slider.press("End")
    holding.until(lambda status: status["speed_override"] == 1.0, "at full speed")
    page.keyboard.press("Escape")
    holding.until(lambda status: status["state"] == "holding", "standstill")


def test_values_are_shown_and_typed_in_the_units_that_the_browser_keeps(page: Page, holding: Platform) -> None:
    show(page, "/targets")
    page.get_by_label("Angles").select_option("deg")
    page.get_by_label("Lengths").select_option("mm")
    expect(page.get_by_label("joint3, deg")).to_have_value(re.compile(r"^(89\.9|90)"))
    page.get_by_label("joint1, deg").fill("10")
    page.get_by_label("joint4, slider").press("ArrowRight")
    page.get_by_role("spinbutton", name="Speed (empty: the limit), deg/s").fill("20")
    page.get_by_role("button", name="Plan").click()
    page.get_by_role("button", name="Send", exact=True).click()
    until(lambda: abs(holding.status()["joints"]["actual_position"][0] - math.radians(10)) < 1e-4, "10 degrees")
    assert holding.status()["joints"]["commanded_position"][3] == pytest.approx(0.001, abs=1e-6)
    show(page, "/arm")  # a page of its own: the browser has kept them
    expect(page.locator("[data-live='actual_position.0']")).to_have_text("10.00")
    expect(page.locator("[data-live='tool.2']")).to_have_text(f"{1000 * tool_of(holding)[2]:.1f}")
    expect(page.locator("[data-bar='actual_position.0']")).to_have_attribute("title", "-177.6 to 177.6 deg")
    show(page, "/limits")
    expect(page.get_by_label("box max z, mm")).to_have_value("1400")
    page.get_by_label("Lengths").select_option("m")
    expect(page.get_by_label("box max z, m")).to_have_value("1.4")
    page.get_by_label("Angles").select_option("rad")
    expect(page.get_by_label("joint2 max, rad")).to_have_value("2")


def test_a_click_or_a_key_moves_one_step_and_holding_does_not_go_on(page: Page, holding: Platform) -> None:
    holding.call("mode", name="joint")
    show(page, "/jog")
    page.get_by_label("Movement").select_option("coarse")
    before = tool_of(holding)[2]
    up = page.get_by_role("button", name="Up, +Z")
    expect(page.locator("[data-jog-step=coarse]")).to_be_visible()
    up.hover()
    page.mouse.down()
    page.wait_for_timeout(800)
    assert tool_of(holding)[2] == pytest.approx(before, abs=1e-6)
    page.mouse.up()
    until(lambda: tool_of(holding)[2] == pytest.approx(before + 0.01, abs=1e-5), "one step")
    holding.until(lambda status: status["state"] == "holding", "rest")
    page.get_by_label("Movement").select_option("fine")
    expect(page.locator("[data-jog-step=fine]")).to_be_visible()
    page.locator(".jog-area").focus()
    page.keyboard.press("PageDown")
    until(lambda: tool_of(holding)[2] == pytest.approx(before + 0.009, abs=1e-5), "one step back")
    holding.until(lambda status: status["state"] == "holding", "rest")
    page.get_by_label("Frame").select_option("joints")
    page.get_by_role("button", name="joint1 +").click()
    until(
        lambda: holding.status()["joints"]["commanded_position"][0] == pytest.approx(math.radians(1), abs=1e-4), "1 deg"
    )


def test_terminals_have_their_names_and_outputs_are_set_by_hand(page: Page, holding: Platform) -> None:
    show(page, "/io")
    expect(page.get_by_role("listitem").filter(has_text="emergency stop")).to_contain_text(re.compile(r"io\.10.*high"))
    output = page.get_by_role("switch", name="io.12")

    def is_on() -> bool:
        return bool(holding.status()["devices"]["io"]["outputs"]["value"] >> 11 & 1)

    for value in (True, False):
        output.click()
        until(is_on if value else lambda: not is_on(), "set")
        expect(output).to_have_attribute("aria-checked", str(value).lower())
    holding.rtcp("segment", "fault", "input", "number=1", "how=low")
    expect(page.get_by_role("listitem").filter(has_text="forward")).to_contain_text("low")
    holding.rtcp("segment", "clear")


def test_an_alarm_says_what_to_do_until_somebody_acknowledges_it(
    browser: Browser, panel: str, page: Page, holding: Platform
) -> None:
    show(page, "/alarms")
    if page.locator("tr.waits").count():
        page.get_by_role("button", name=re.compile("^Acknowledge")).first.click()
    expect(page.locator("#alarmed")).to_be_hidden()
    holding.rtcp("segment", "fault", "drive", "slave=3", "error=encoder")
    with visitor(browser, panel) as second:
        show(second, "/jog")
        second.get_by_role("link", name="1 alarm").click()
        alarm = second.locator("tr.waits")
        expect(alarm).to_contain_text(
            re.compile("joint2: the drive is in fault.*Remove the cause, then Reset and Enable")
        )
        alarm.get_by_role("button", name="Acknowledge").click()
        expect(alarm).to_have_count(0)
    expect(page.get_by_role("row", name=re.compile("by local"))).not_to_have_count(0)
    expect(page.locator("#alarmed")).to_be_hidden()
    page.get_by_role("button", name="Reset").click()
    holding.until(lambda status: status["state"] == "ready", "reset")


def test_alarms_that_nobody_has_acknowledged_are_kept_longest() -> None:
    live = Live(lambda secret: True)
    events = [
        EventRecord(number, f"2026-11-26T00:{number:04}", "drive_fault", {}, "", "fault") for number in range(1, 252)
    ]
    live._keep_alarms(events[:200])
    live.acknowledge(events[100:150], "Ada")
    live._keep_alarms(events[200:250])
    assert live.alarms == [*events[:100], *events[150:250]]
    assert live._acknowledged == {}
    live._keep_alarms(events[250:])
    assert live.alarms == [*events[1:100], *events[150:]]


@pytest.mark.parametrize(
    ("message", "text"),
    [
        ("paused: `rtcp resume` continues the motion", "Paused."),
        (
            "the emergency stop is pressed (inputs.emergency_stop in arm.yaml): release it, then `rtcp reset`",
            "The emergency stop is pressed: release it.",
        ),
        (
            "slave 3 (drive2) does not answer: torque off; `rtcp reset` when it is back",
            "Slave 3 (drive2) does not answer: torque off.",
        ),
        ("", ""),
    ],
)
def test_the_header_says_in_sentences_what_needs_no_terminal(message: str, text: str) -> None:
    assert sentence(message) == text


def test_health_draws_the_last_hour(page: Page, holding: Platform) -> None:
    show(page, "/health")
    line = page.get_by_role("row", name=re.compile("^joint3 torque")).locator("polyline")
    expect(line).to_have_attribute("points", re.compile(r"^\d"), timeout=20_000)
    expect(page.get_by_role("row", name=re.compile(r"^wake-up p99 [\d.]+ [\d.]+ [\d.]+ us"))).to_be_visible()


def test_a_trend_keeps_an_hour_and_the_largest_of_each_interval(monkeypatch: pytest.MonkeyPatch) -> None:
    now = itertools.count()
    monkeypatch.setattr(time, "monotonic", lambda: float(next(now)))
    status = {
        "joint_names": ["joint1"],
        "joints": {"actual_torque": [0.0]},
        "wakeup_us": {"p99": 1.0},
        "exchange_us": {"p99": 1.0},
        "compute_us": {"p99": 1.0},
        "dc": None,
        "missed": 7,
    }
    hour = Trends()
    for at in range(2 * int(KEPT_S)):
        status["joints"] = {"actual_torque": [-5.0 if at == KEPT_S + 2 else 1.0]}
        hour.read(status, [10.0], [None])
    trend = hour.all["joint1 torque"]
    assert len(trend.samples) == KEPT_S / SAMPLE_S
    line = trend.line(2 * KEPT_S)
    assert len(line) <= 181
    assert max(line, key=lambda point: point[1]) == (pytest.approx(1.0, abs=0.01), 50.0)
    assert line[-1] == (pytest.approx(0.0, abs=0.01), 10.0)
    assert "joint1 temperature" not in hour.all
    assert {value for _, value in hour.all["skipped cycles"].samples} == {0.0}
