"""The pages that move the arm, used as a person would; the API and the files show the result."""

from __future__ import annotations

import math
import re
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, expect

from kinematics.forward import forward
from rtcp.config.loader import load
from rtcp.config.motion_file import read_motion
from tests.e2e.conftest import Platform
from tests.panel.conftest import BENT, barriers, show, show_targets, visitor
from tests.waiting import until

pytestmark = [pytest.mark.platform, pytest.mark.browser]
GRIPPER = 1 << 3
"""Mask of the gripper's output, number 4."""


def tool_of(platform: Platform) -> tuple[float, ...]:
    arm = load(Path(platform.environment["RTCP_CONFIG"])).arm
    assert arm is not None
    return forward(arm, platform.status()["joints"]["commanded_position"]).position


def test_targets_are_planned_sent_or_refused_and_kept_under_names(drawing: Page, holding: Platform) -> None:
    show_targets(drawing)
    send = drawing.get_by_role("button", name="Send", exact=True)
    drawing.get_by_label("joint1, rad").press("Control+a")
    drawing.keyboard.type("0.2")
    expect(send).to_be_disabled()
    drawing.get_by_role("button", name="Plan").press("Enter")
    expect(drawing.locator(".arm-view")).to_have_attribute("data-ghost", "plan")
    assert holding.status()["joints"]["actual_position"][0] == pytest.approx(0.0, abs=1e-3)
    send.press("Enter")
    expect(drawing.get_by_text("There; largest error")).to_be_visible()
    assert holding.status()["joints"]["actual_position"][0] == pytest.approx(0.2, abs=1e-3)
    drawing.get_by_label("joint1, rad").fill("9")
    drawing.get_by_role("button", name="Plan").click()
    expect(
        drawing.get_by_text(re.compile("No: joint1: target 9 rad is outside its range, beyond 3.1 rad"))
    ).to_be_visible()
    drawing.get_by_label("Target").select_option("pose")
    drawing.get_by_label("x, m").fill("5")
    drawing.get_by_role("button", name="Plan").click()
    expect(drawing.get_by_text(re.compile("No: the pose cannot be reached.* m"))).to_be_visible()
    drawing.get_by_label("Target").select_option("joints")
    drawing.get_by_label("joint1, rad").fill("3")
    drawing.get_by_label("joint2, rad").fill("0.1")
    drawing.get_by_role("button", name="Plan").click()
    expect(drawing.get_by_text(re.compile("No: .*keep-out box user"))).to_be_visible()
    expect(drawing.get_by_role("button", name="Send", exact=True)).to_be_disabled()
    holding.call("move_joints", q=BENT)
    show_targets(drawing)
    expect(drawing.get_by_role("button", name="Solutions")).to_be_hidden()  # its pose would be too
    drawing.get_by_label("Target").select_option("line")
    expect(drawing.get_by_label("y, m")).not_to_have_value("")
    y = float(drawing.get_by_label("y, m").input_value())
    drawing.get_by_label("y, m").fill(f"{y + 0.05}")
    drawing.get_by_role("button", name="Solutions").click()
    expect(drawing.get_by_role("row", name=re.compile("inside"))).not_to_have_count(0)
    drawing.get_by_role("button", name="Plan").click()
    expect(drawing.get_by_text(re.compile(r"0\.050 m: look at the ghost"))).to_be_visible()
    drawing.get_by_role("button", name="Send", exact=True).click()
    expect(drawing.get_by_text("There; largest error")).to_be_visible()
    expect(drawing.locator("[data-live=state]")).to_have_text("holding")
    until(lambda: "arrived" in holding.events(), "it has arrived")
    drawing.get_by_role("button", name="Use solution 1").click()
    expect(drawing.get_by_label("Target")).to_have_value("joints")
    drawing.get_by_label("joint1, rad").fill("0.125")
    drawing.get_by_label("Name", exact=True).fill("<b>beside</b> the cup")
    drawing.get_by_role("button", name="Keep these joint positions").click()
    use = drawing.get_by_role("button", name="<b>beside</b> the cup", exact=True)
    expect(use).to_be_visible()
    assert "beside" in Path(holding.environment["RTCP_STATE_DIR"], "poses.yaml").read_text()
    drawing.get_by_role("button", name="Here").click()
    expect(drawing.get_by_label("joint1, rad")).to_have_value(re.compile(r"^-?\d"))
    use.click()
    expect(drawing.get_by_label("joint1, rad")).to_have_value("0.125")
    drawing.get_by_role("button", name="Remove <b>beside</b> the cup").click()
    expect(use).to_have_count(0)
    field, slider = drawing.get_by_label("joint4, rad"), drawing.get_by_label("joint4, slider")
    before = float(field.input_value())
    slider.focus()
    for _ in range(10):
        slider.press("ArrowRight")
    until(lambda: float(field.input_value()) == pytest.approx(before + 0.01, abs=2e-3), "the field follows the slider")


def test_the_rest_pose_is_reached_when_it_is_confirmed_and_the_override_slows_what_the_page_moves(
    browser: Browser, panel: str, page: Page, holding: Platform
) -> None:
    holding.call("move_joints", q=[0.3, *BENT[1:]])
    show(page, "/health")
    page.get_by_role("button", name="Rest pose", exact=True).click()
    page.get_by_role("button", name="Leave it").click()
    expect(page.get_by_role("button", name="Leave it")).to_have_count(0)
    page.get_by_role("button", name="Rest pose", exact=True).click()
    page.get_by_role("button", name="Move to rest pose").click()
    holding.until(lambda status: status["state"] == "moving", "on the way")
    rest_pose = load(Path(holding.environment["RTCP_CONFIG"])).rest_pose
    assert rest_pose is not None
    expect(page.get_by_text("The arm is in its rest pose")).to_be_visible()
    assert holding.status()["joints"]["actual_position"] == pytest.approx(rest_pose, abs=1e-3)
    show_targets(page)
    page.get_by_label("joint1, rad").fill("1.2")
    page.get_by_role("spinbutton", name="Speed").fill("0.02")  # a minute
    page.get_by_role("button", name="Plan").click()
    with visitor(browser, panel) as second:
        show(second, "/health")
        page.get_by_role("button", name="Send", exact=True).click()
        holding.until_moving()
        slider = page.get_by_role("slider", name="Override", exact=True)
        for _ in range(3):
            slider.press("PageDown")
        holding.until(lambda status: status["speed_override"] < 0.9, "slower")
        assert holding.status()["state"] == "moving"
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


def test_the_page_jog_steps_guides_by_hand_and_shows_what_holds_a_jog_back(page: Page, holding: Platform) -> None:
    holding.call("mode", name="joint")
    show(page, "/jog")
    page.get_by_label("Movement").select_option("coarse")
    before = tool_of(holding)[2]
    up = page.get_by_role("button", name="Up, +Z")
    expect(page.locator("[data-jog-step=coarse]")).to_be_visible()
    up.hover()
    page.mouse.down()
    page.wait_for_timeout(500)
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
    page.get_by_role("button", name="Close gripper").click()
    holding.until(lambda status: status["devices"]["io"]["outputs"]["value"] & GRIPPER, "closed")
    expect(page.get_by_text("The gripper has closed")).to_be_visible()
    page.locator(".jog-area").focus()
    page.keyboard.press("o")
    holding.until(lambda status: not status["devices"]["io"]["outputs"]["value"] & GRIPPER, "open")
    holding.call("move_joints", q=[0.0] * 6)
    holding.call("mode", name="cartesian")
    page.get_by_label("Movement").select_option("")
    page.get_by_label("Frame").select_option("base")
    held = re.compile("Moving, limited: the elbow is 0.000 rad from its singularity, limit 0.08 rad: jog away from it")
    page.get_by_role("button", name="Up, +Z").hover()

    def is_held() -> bool:
        page.mouse.up()
        page.mouse.down()
        page.wait_for_timeout(500)
        return bool(held.search(page.locator("[data-live=message]").first.inner_text()))

    until(is_held, "what holds the jog back")
    page.mouse.up()
    holding.until(lambda status: not status["lease"]["holder"], "the end of the jog's lease")
    holding.call("move_joints", q=BENT)
    page.get_by_label("Payload, at the tool's point").fill("0.2")
    page.get_by_role("button", name="Set the payload").click()
    until(lambda: holding.status()["payload"]["mass"] == pytest.approx(0.2), "the payload")
    page.get_by_role("button", name="Use this tool").click()
    expect(page.get_by_text("The tool is tool; it holds nothing")).to_be_visible()
    page.get_by_label("Payload, at the tool's point").fill("0")
    page.get_by_role("button", name="Set the payload").click()
    until(lambda: holding.status()["payload"]["mass"] == 0.0, "no payload")
    before = holding.status()["joints"]["actual_position"][0]
    page.get_by_role("button", name="Guide by hand").click()
    until(lambda: holding.status()["state"] == "moving", "guiding")
    holding.rtcp("segment", "push", "0", "25", "0", "--seconds", "20")
    until(lambda: abs(holding.status()["joints"]["actual_position"][0] - before) > 0.05, "it follows")
    page.get_by_role("button", name="Halt").click()
    until(lambda: holding.status()["control_mode"] == "cartesian", "the mode before")
    holding.rtcp("segment", "clear")


# -- the page Program


def file_of(platform: Platform, name: str) -> Path:
    (path,) = platform.directory.rglob(f"programs/{name}.yaml")
    return path


def click(page: Page, name: str) -> None:
    page.get_by_role("button", name=name, exact=True).click()


def opened(page: Page, platform: Platform, name: str) -> None:
    for file in platform.directory.rglob(f"programs/{name}.yaml"):
        file.unlink()  # of a test that is repeated
    show(page, "/program")
    page.get_by_label("Program", exact=True).fill(name)
    click(page, "Open")
    expect(page.get_by_text(re.compile("^New; saved as"))).to_be_visible()


def expect_notice(page: Page, text: str) -> None:
    """Wait until the page has the text, possibly after a motion."""
    expect(page.get_by_text(text, exact=True)).to_be_visible()


def kind(page: Page, name: str, its_field: str) -> None:
    """Choose the kind of the new step; its fields follow."""
    page.get_by_label("Kind").select_option(name)
    expect(page.get_by_label(its_field)).to_be_visible()


def keep(page: Page, name: str, kind: str = "q") -> None:
    page.get_by_label("Name of the pose").fill(name)
    page.get_by_label("Kept as").select_option(kind)
    click(page, "Keep where the arm is")
    expect(page.get_by_role("row", name=re.compile(f"^{name} "))).to_be_visible()


def test_a_program_taught_by_clicks_is_checked_stepped_paused_run_stepped_back_and_stopped(
    page: Page, holding: Platform
) -> None:
    there = [0.5, *BENT[1:]]
    opened(page, holding, "clicks")
    keep(page, "here")
    holding.call("move_joints", q=there)
    until(lambda: holding.status()["joints"]["commanded_position"][0] == pytest.approx(0.5), "there")
    keep(page, "there")
    page.get_by_label("Pose", exact=True).select_option("here")
    click(page, "Add the step")
    expect(page.get_by_role("row", name=re.compile("move to here"))).to_be_visible()
    kind(page, "wait_s", "Time, s")
    page.get_by_label("Time, s").fill("0.2")
    click(page, "Add the step")
    expect(page.get_by_role("row", name=re.compile("wait 0.2 s"))).to_be_visible()
    page.get_by_label("Pose", exact=True).select_option("there")
    page.get_by_label(re.compile("^Speed .*, rad/s$")).fill("0.2")
    page.get_by_label("Where").select_option("before step 2")
    click(page, "Add the step")
    expect(page.get_by_role("row", name=re.compile("^2 move to there at 0.2 rad"))).to_be_visible()
    # The wait moves between both and back; then one undo too many.
    click(page, "Move step 3 up")
    expect(page.get_by_role("row", name=re.compile("^2 wait 0.2 s"))).to_be_visible()
    click(page, "Delete step 2")
    expect(page.get_by_role("row", name=re.compile("^2 move to there"))).to_be_visible()
    click(page, "Undo")
    expect(page.get_by_role("row", name=re.compile("^2 wait 0.2 s"))).to_be_visible()
    expect(page.locator(".q-notification")).to_have_count(0)  # one that fades has no contrast
    assert barriers(page) == {}
    steps = read_motion(file_of(holding, "clicks")).program
    assert [(step.move, step.wait_s, step.speed) for step in steps] == [
        ("here", None, None),
        (None, 0.2, None),
        ("there", None, 0.2),
    ]

    click(page, "Check")
    expect(page.get_by_text(re.compile(r"^It can be run: 2 motions"))).to_be_visible()
    for number in (1, 2):
        click(page, "Step")
        expect_notice(page, f"Step {number} is done")
    assert holding.status()["joints"]["actual_position"] == pytest.approx(BENT, abs=2e-3)
    click(page, "Step")
    holding.until_moving()
    click(page, "Pause")
    until(lambda: holding.status()["speed_override"] == 0.0, "paused")
    click(page, "Pause")  # a second press starts nothing
    expect(page.get_by_text("paused: the motion rests on its path")).to_be_visible()
    assert holding.status()["speed_override"] == 0.0
    # Another tab keeps the run.
    page.get_by_role("link", name="Jog", exact=True).click()
    expect(page.get_by_label("Movement")).to_be_visible()
    page.get_by_role("link", name="Program", exact=True).click()
    expect(page.get_by_label("Movement")).to_have_count(0)
    click(page, "Go on")
    expect_notice(page, "Step 3 is done")
    assert holding.status()["joints"]["actual_position"] == pytest.approx(there, abs=2e-3)
    click(page, "Step back")
    expect_notice(page, "Step 3 is next")
    assert holding.status()["joints"]["actual_position"] == pytest.approx(BENT, abs=2e-3)
    click(page, "Run from step 1")
    expect_notice(page, "Done")
    assert holding.status()["joints"]["actual_position"] == pytest.approx(there, abs=2e-3)
    keep(page, "pose", "pose")
    kind(page, "line", "Speed (empty: the program's), m/s")
    page.get_by_label("Pose", exact=True).select_option("pose")
    page.get_by_label("Where").select_option("")
    click(page, "Add the step")
    expect(page.get_by_role("row", name=re.compile("line to pose"))).to_be_visible()
    click(page, "Run from step 1")
    holding.until_moving()
    page.get_by_role("button", name="STOP").click()
    expect_notice(page, "It has ended early")
    until(lambda: holding.status()["state"] == "holding", "held")
