"""The panel of an arm that belongs to a cell: all arms in one space, one STOP for all, the page Cell."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Browser, Page, expect

from kinematics.forward import forward
from kinematics.pose import Pose
from rtcp.api import Feed, Robot, State
from rtcp.api.cell import Cell
from rtcp.ipc.runtime_directory import control_socket, irc5_control
from rtcp.ipc.session import read_processes, read_session
from rtcp.virtual.request_socket import RequestClient
from tests.cell.running import ABB_HOME, RunningCell, leftovers_of, put_in_order, restore, shipped_cell
from tests.leftovers import Leftovers
from tests.panel.conftest import barriers, begun, show, visitor
from tests.waiting import until

pytestmark = [pytest.mark.platform, pytest.mark.browser]
FAR = {"left": "0.9, 0.2, 0.1, 0, 0.5, 0.3", "right": "-0.9, 0.1, -0.1, 0.1, 0.6, 0"}
"""Seconds away at 0.15 rad/s."""


@pytest.fixture(scope="module")
def running(leftovers: Leftovers) -> Iterator[RunningCell]:
    """Two virtual IRB 120; their loops may be later than shipped, as a browser draws beside them."""
    pytest.importorskip("google.protobuf", reason="protobuf is not installed: pip install 'rtcp[abb]'")
    with leftovers_of(leftovers, "left", "right") as platform:
        cell = RunningCell(shipped_cell(), platform)
        platform.environment["RTCP_NAME"] = "left"
        yield cell


@pytest.fixture(scope="module")
def panel(running: RunningCell) -> Iterator[str]:
    """The address of the panel of the arm `left`."""
    with begun(running.platform) as (_, url):
        yield url


@pytest.fixture
def cell(running: RunningCell) -> Iterator[Cell]:
    """Both arms run, are enabled and at their home."""
    running.start_ended("left", "right")
    with running.connect() as connected:
        for name in connected.arms:
            with RequestClient(irc5_control(running.of(name)), server="virtual IRC5") as operator:
                put_in_order(operator)
        restore(connected)
        yield connected
    running.platform.end_commands()


def states(cell: Cell) -> dict[str, State]:
    return {name: status.state for name, status in cell.status().items()}


def drawn(page: Page) -> dict[str, list[float]]:
    """Return the drawn tool positions of the partners, m, in this arm's base."""
    positions: dict[str, list[float]] = json.loads(page.locator(".arm-view").get_attribute("data-partners") or "{}")
    return positions


def stopped(cell: Cell, running: RunningCell, state: State = State.HOLDING) -> None:
    """Wait until all arms are in a state; no arm has reached its goal, and none moves in the records after it."""
    until(lambda: states(cell) == dict.fromkeys(cell.arms, state), f"state {state.words} of all arms")
    for name, status in cell.status().items():
        assert abs(status.positions[0]) < 0.85
        with contextlib.closing(Feed(running.of(name))) as feed:
            rest: list[Any] = []
            while len(rest) < 50:
                feed.ended(0.05)
                rest += list(feed.records()[0]["commanded_position"])
            # Without torque the commanded position follows the settling arm; a motion is 60 times farther.
            assert np.ptp(rest, axis=0).max() < 1e-3


def begin(page: Page, running: RunningCell) -> None:
    """Begin a motion in step on the page Cell; return when both arms move."""
    show(page, "/cell")
    for name, q in FAR.items():
        page.get_by_label(f"Joints of {name}, rad").fill(q)
    page.get_by_label("Speed (empty: the limit), rad/s").fill("0.15")
    page.get_by_role("button", name="Move in step").click()
    for name in FAR:
        with contextlib.closing(Feed(running.of(name))) as feed:
            until(partial(moves, feed), "motion")


def robot_event(cell: Cell) -> str:
    """Return the last event about the controller of the right arm."""
    names = [event.name for event in cell.arms["right"].events()]
    return next((name for name in reversed(names) if name in ("waiting_for_robot", "robot_ready")), "")


def speed(feed: Feed) -> float:
    record = feed.latest()
    return 0.0 if record is None else float(np.abs(record["commanded_velocity"]).max())


def moves(feed: Feed) -> bool:
    return speed(feed) > 0.05


def stands(feed: Feed) -> bool:
    return speed(feed) == 0.0


# -- one space --------------------------------------------------------------------------------------------------------


def test_partners_are_drawn_live_while_they_run_and_a_missing_one_is_named(
    drawing: Page, running: RunningCell, cell: Cell
) -> None:
    def expected() -> tuple[float, ...]:
        own, partner = (Pose.from_xyzrpy(*arm.base.position, *arm.base.rpy) for arm in cell.config.arms)
        arm = cell.config.arms[1].config.arm
        assert arm is not None
        return (own.inverse() @ partner @ forward(arm, cell.arms["right"].status().positions)).position

    show(drawing, "/arm")
    expect(drawing.get_by_role("link", name="Cell")).to_be_visible()
    until(lambda: drawn(drawing), "the partner is drawn")
    assert drawn(drawing)["right"] == pytest.approx(expected(), abs=2e-3)
    before = expected()
    cell.arms["right"].move_joints([0.5, *ABB_HOME[1:]])
    assert np.abs(np.subtract(expected(), before)).max() > 0.1
    until(lambda: drawn(drawing)["right"] == pytest.approx(expected(), abs=2e-3), "the partner is drawn anew")
    running.platform.rtcp("--name", "right", "stop")
    until(lambda: not drawn(drawing), "the partner is gone")
    assert drawing.evaluate("rtcp.state.partners.right.state") == "off"
    drawing.get_by_role("link", name="Cell").click()
    cell.arms["left"].disable()
    expect(drawing.locator("[data-arm=right] [data-live$=state]")).to_have_text("off")
    answer = drawing.request.post("/stop", headers={"Origin": drawing.url.rpartition("/")[0]})
    assert answer.status == 503
    assert answer.text().startswith("right: no platform is running")
    drawing.get_by_role("button", name="Enable all").click()
    expect(drawing.get_by_text(re.compile("^right: .*rtcp --name right start"))).to_be_visible()
    with Robot("the tests", control_socket(running.of("left"))) as left:
        until(lambda: left.state is State.READY, "left is without torque again")
    running.platform.rtcp("--name", "right", "start", "--detach", "--cell", str(running.file))
    until(lambda: "right" in drawn(drawing), "the partner is back")


def test_the_page_start_starts_the_arm_in_its_cell_again(page: Page, running: RunningCell, cell: Cell) -> None:
    show(page, "/")
    page.get_by_role("button", name="Stop the platform").click()
    state = page.locator("header [data-live=state]")
    expect(state).to_have_text("off")
    page.get_by_role("button", name="Start", exact=True).click()
    expect(state).to_have_text("ready")
    expect(page.get_by_role("link", name="Cell")).to_be_visible()
    assert read_session(running.of("left")).partners == ("right",)


def test_stop_ends_what_anybody_moves_at_any_arm_also_while_the_platform_of_another_hangs(
    page: Page, running: RunningCell, cell: Cell
) -> None:
    show(page, "/health")
    stop = page.get_by_role("button", name="STOP not the emergency stop")

    def move(name: str, target: str) -> None:
        running.platform.background("--name", name, "move", target, "0", "0", "0", "0.5", "0", "--speed", "0.15")

    for name in cell.arms:
        move(name, "1.2")
    with contextlib.ExitStack() as feeds:
        opened = {name: feeds.enter_context(contextlib.closing(Feed(running.of(name)))) for name in cell.arms}
        for feed in opened.values():
            until(partial(moves, feed), "motion")
        stop.click()
        stopped(cell, running)
        running.platform.end_commands()
        for hanging, moving in (("left", "right"), ("right", "left")):
            gateway = read_processes(running.of(hanging)).gateway
            os.kill(gateway, signal.SIGSTOP)
            try:
                for target in ("1.2", "-1"):  # the first STOP still waits for the arm that hangs when the second comes
                    move(moving, target)
                    until(partial(moves, opened[moving]), "motion")
                    stop.click()
                    until(partial(stands, opened[moving]), "standstill")
                    running.platform.end_commands()
            finally:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(gateway, signal.SIGCONT)


def test_all_arms_are_enabled_moved_in_step_and_disabled(page: Page, running: RunningCell, cell: Cell) -> None:
    cell.disable()
    show(page, "/cell")

    def cell_text(name: str, key: str) -> str:
        return page.locator(f"[data-arm={name}] [data-live$={key}]").text_content() or ""

    page.get_by_role("button", name="Enable all").click()
    until(lambda: states(cell) == dict.fromkeys(cell.arms, State.HOLDING), "all arms hold")
    until(lambda: [cell_text(name, "state") for name in cell.arms] == ["holding"] * 2, "the table says so")
    page.get_by_role("button", name="Here").click()
    expect(page.get_by_label("Joints of right, rad")).to_have_value(re.compile(r"^-?[\d.e-]+(, -?[\d.e-]+){5}$"))
    page.get_by_label("Joints of left, rad").fill("0.2, 0, 0, 0, 0.5, 0")
    page.get_by_label("Joints of right, rad").fill("-pi/12, 0, 0, 0, 0.5, 0")
    page.get_by_label("Speed (empty: the limit), rad/s").fill("0.15")
    page.get_by_role("button", name="Move in step").click()
    until(lambda: [cell_text(name, "step") for name in cell.arms] == ["moves"] * 2, "in step")
    assert all(cell_text(name, "holder").startswith("panel: ") for name in cell.arms)
    expect(page.get_by_text(re.compile("^There; largest errors"))).to_be_visible()
    positions = {name: status.positions for name, status in cell.status().items()}
    assert positions["left"][0] == pytest.approx(0.2, abs=2e-3)
    assert positions["right"][0] == pytest.approx(-np.pi / 12, abs=2e-3)
    expect(page.locator(".q-notification")).to_have_count(0)
    assert barriers(page) == {}
    page.get_by_label("Joints of right, rad").fill("9, 0, 0, 0, 0.5, 0")
    page.get_by_role("button", name="Move in step").click()
    expect(page.get_by_text(re.compile("right: joint 1: found 9 rad"))).to_be_visible()
    page.get_by_label("Joints of right, rad").fill("home")
    page.get_by_role("button", name="Move in step").click()
    expect(page.get_by_text(re.compile('joints of right: found "home"'))).to_be_visible()
    with RequestClient(irc5_control(running.of("right")), server="virtual IRC5") as operator:
        operator.ask({"do": "stop", "circuit": "emergency"})
        until(lambda: states(cell)["right"] is State.FAULT, "fault")
        until(lambda: robot_event(cell) == "waiting_for_robot", "the loop notices the controller")
        put_in_order(operator)
    until(lambda: robot_event(cell) == "robot_ready", "the controller is ready")
    until(lambda: cell_text("right", "state") == "fault", "the table says so")
    page.get_by_role("button", name="Reset all").click()
    until(lambda: states(cell)["right"] is State.READY, "reset")
    page.get_by_role("button", name="Disable all").click()
    until(lambda: states(cell) == dict.fromkeys(cell.arms, State.READY), "no arm has torque")


def test_a_motion_in_step_ends_with_its_page_by_stop_and_by_disabling_and_no_other_page_begins_one(
    browser: Browser, panel: str, running: RunningCell, cell: Cell
) -> None:
    with visitor(browser, panel) as second:
        with visitor(browser, panel) as page:
            begin(page, running)
            page.get_by_role("button", name="Disable all").click()
            stopped(cell, running, State.READY)
            show(second, "/cell").get_by_role("button", name="Enable all").click()
            expect(second.get_by_role("button", name="Ask to take over")).to_be_visible()
            assert states(cell) == dict.fromkeys(cell.arms, State.READY)
            page.get_by_role("button", name="Enable all").click()
            until(lambda: states(cell) == dict.fromkeys(cell.arms, State.HOLDING), "all arms hold")
            begin(page, running)
            second.get_by_role("button", name="STOP not the emergency stop").click()
            stopped(cell, running)
            begin(page, running)
        stopped(cell, running)
