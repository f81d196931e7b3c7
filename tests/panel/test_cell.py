"""The panel of an arm that belongs to a cell: all arms in one space, one STOP for all, the page Cell."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import time
from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
import pytest
from playwright.sync_api import Browser, Page, expect

from kinematics.forward import forward
from kinematics.pose import Pose
from rtcp.api import Feed, Robot, State
from rtcp.api.cell import Cell
from rtcp.ipc.runtime_directory import control_socket, irc5_control
from rtcp.ipc.session import read_processes, read_session
from rtcp.panel.live import JOG_S, PRESENCE_S
from rtcp.virtual.request_socket import RequestClient
from tests.cell.running import ABB_HOME, CONFIG, RunningCell, put_in_order, restore
from tests.panel.conftest import barriers, begun, show, until, visitor

pytestmark = [pytest.mark.platform, pytest.mark.browser]
SLACK_S = 0.6
"""Allowance for braking, 0.22 s along a common path, and a shared host, s."""
FAR = {"left": "0.9, 0.2, 0.1, 0, 0.5, 0.3", "right": "-0.9, 0.1, -0.1, 0.1, 0.6, 0"}
"""Seconds away at 0.15 rad/s."""


@pytest.fixture(scope="module")
def running() -> Iterator[RunningCell]:
    """Two virtual IRB 120; their loops may be later than shipped, as a browser draws beside them."""
    pytest.importorskip("google.protobuf", reason="protobuf is not installed: pip install 'rtcp[abb]'")
    file, count = re.subn(r"^silence_s: \S+", "silence_s: 0.2", (CONFIG / "cell.yaml").read_text(), flags=re.MULTILINE)
    assert count == 1
    cell = RunningCell(file)
    cell.platform.environment["RTCP_NAME"] = "left"
    yield cell
    cell.end()


@pytest.fixture(scope="module")
def panel(running: RunningCell) -> Iterator[str]:
    """The address of the panel of the arm `left`."""
    with begun(running.platform) as (_, url):
        yield url


@pytest.fixture
def cell(running: RunningCell) -> Iterator[Cell]:
    """Both arms run, are enabled and at their home."""
    for name in ("left", "right"):
        if not control_socket(running.of(name)).exists():
            running.platform.rtcp("--name", name, "start", "--detach", "--cell", str(file_of(running)))
    with running.connect() as connected:
        for name in connected.arms:
            with RequestClient(irc5_control(running.of(name)), server="virtual IRC5") as operator:
                put_in_order(operator)
        restore(connected)
        yield connected
    running.platform.end_commands()


def file_of(running: RunningCell) -> str:
    return str(running.directory / "config/cell.yaml")


def states(cell: Cell) -> dict[str, State]:
    return {name: status.state for name, status in cell.status().items()}


def drawn(page: Page) -> dict[str, list[float]]:
    """Return the drawn tool positions of the partners, m, in this arm's base."""
    positions: dict[str, list[float]] = json.loads(page.locator(".arm-view").get_attribute("data-partners") or "{}")
    return positions


def stood_after(feed: Feed, since_ns: int) -> float:
    """Return the time from an instant to the last cycle in motion, s."""
    time.sleep(PRESENCE_S + SLACK_S + 0.5)
    records, _ = feed.records()
    moving = records[np.abs(records["commanded_velocity"]).max(axis=1) > 0.0]
    return float(moving["time_ns"][-1] - since_ns) * 1e-9


def begin(page: Page, running: RunningCell) -> dict[str, Feed]:
    """Begin a motion in step on the page Cell; return the feeds of both arms when both move."""
    show(page, "/cell")
    for name, q in FAR.items():
        page.get_by_label(f"Joints of {name}, rad").fill(q)
    page.get_by_label("Speed (empty: the limit), rad/s").fill("0.15")
    page.get_by_role("button", name="Move in step").click()
    feeds = {name: Feed(running.of(name)) for name in FAR}
    for feed in feeds.values():
        until(partial(moves, feed), "motion")
    return feeds


def speed(feed: Feed) -> float:
    record = feed.latest()
    return 0.0 if record is None else float(np.abs(record["commanded_velocity"]).max())


def moves(feed: Feed) -> bool:
    return speed(feed) > 0.05


# -- one space --------------------------------------------------------------------------------------------------------


def test_partners_are_drawn_where_they_stand_live_and_only_while_they_run(
    page: Page, running: RunningCell, cell: Cell
) -> None:
    def expected() -> tuple[float, ...]:
        own, partner = (Pose.from_xyzrpy(*arm.base.position, *arm.base.rpy) for arm in cell.config.arms)
        arm = cell.config.arms[1].config.arm
        assert arm is not None
        return (own.inverse() @ partner @ forward(arm, cell.arms["right"].status().positions)).position

    show(page, "/arm")
    expect(page.get_by_role("link", name="Cell")).to_be_visible()
    until(lambda: drawn(page), "the partner is drawn")
    assert drawn(page)["right"] == pytest.approx(expected(), abs=2e-3)
    before = expected()
    cell.arms["right"].move_joints([0.5, *ABB_HOME[1:]])
    assert np.abs(np.subtract(expected(), before)).max() > 0.1
    until(lambda: drawn(page)["right"] == pytest.approx(expected(), abs=2e-3), "the partner is drawn anew")
    running.platform.rtcp("--name", "right", "stop")
    until(lambda: not drawn(page), "the partner is gone")
    assert page.evaluate("rtcp.state.partners.right.state") == "off"
    running.platform.rtcp("--name", "right", "start", "--detach", "--cell", file_of(running))
    until(lambda: "right" in drawn(page), "the partner is back")


# -- STOP -------------------------------------------------------------------------------------------------------------


def test_stop_ends_what_anybody_moves_at_any_arm(page: Page, running: RunningCell, cell: Cell) -> None:
    show(page, "/health")
    feeds = {name: Feed(running.of(name)) for name in cell.arms}
    for name in cell.arms:
        running.platform.background("--name", name, "move", "1.2", "0", "0", "0", "0.5", "0", "--speed", "0.15")
    for feed in feeds.values():
        until(partial(moves, feed), "motion")
    now = time.monotonic_ns()
    page.get_by_role("button", name="STOP not the emergency stop").click()
    assert max(stood_after(feed, now) for feed in feeds.values()) < JOG_S + SLACK_S
    assert states(cell) == {"left": State.HOLDING, "right": State.HOLDING}


@pytest.mark.parametrize("hanging", ["left", "right"])
def test_stop_reaches_an_arm_while_the_platform_of_another_hangs(
    page: Page, running: RunningCell, cell: Cell, hanging: str
) -> None:
    show(page, "/health")
    moving = "right" if hanging == "left" else "left"
    feed = Feed(running.of(moving))
    gateway = read_processes(running.of(hanging)).gateway
    os.kill(gateway, signal.SIGSTOP)
    try:
        for target in ("1.2", "0"):  # the first STOP still waits for the arm that hangs when the second comes
            running.platform.background("--name", moving, "move", target, "0", "0", "0", "0.5", "0", "--speed", "0.15")
            until(lambda: speed(feed) > 0.05, "motion")
            time.sleep(1.5)
            now = time.monotonic_ns()
            page.get_by_role("button", name="STOP not the emergency stop").click()
            assert stood_after(feed, now) < JOG_S + SLACK_S
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.kill(gateway, signal.SIGCONT)


def test_an_arm_that_does_not_run_is_named_and_keeps_nothing_from_the_others(
    page: Page, running: RunningCell, cell: Cell
) -> None:
    show(page, "/cell")
    cell.arms["left"].disable()
    running.platform.rtcp("--name", "right", "stop")
    expect(page.locator("[data-arm=right] [data-live$=state]")).to_have_text("off")
    answer = page.request.post("/stop", headers={"Origin": page.url.rpartition("/")[0]})
    assert answer.status == 503
    assert answer.text().startswith("right: no platform is running")
    page.get_by_role("button", name="Enable all").click()
    expect(page.get_by_text(re.compile("^right: .*rtcp --name right start"))).to_be_visible()
    with Robot("the tests", control_socket(running.of("left"))) as left:
        until(lambda: left.state is State.READY, "left is without torque again")


def test_the_page_start_starts_the_arm_in_its_cell_again(page: Page, running: RunningCell, cell: Cell) -> None:
    show(page, "/")
    page.get_by_role("button", name="Stop the platform").click()
    state = page.locator("header [data-live=state]")
    expect(state).to_have_text("off", timeout=30_000)
    page.get_by_role("button", name="Start", exact=True).click()
    expect(state).to_have_text("ready", timeout=30_000)
    expect(page.get_by_role("link", name="Cell")).to_be_visible()
    assert read_session(running.of("left")).partners == ("right",)


# -- the page Cell ----------------------------------------------------------------------------------------------------


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
        put_in_order(operator)
    until(lambda: cell_text("right", "state") == "fault", "the table says so")
    page.get_by_role("button", name="Reset all").click()
    until(lambda: states(cell)["right"] is State.READY, "reset")
    page.get_by_role("button", name="Disable all").click()
    until(lambda: states(cell) == dict.fromkeys(cell.arms, State.READY), "no arm has torque")


@pytest.mark.parametrize("how", ["overloaded", "closed", "stop", "disable"])
def test_a_motion_in_step_ends_with_its_page(
    browser: Browser, panel: str, running: RunningCell, cell: Cell, how: str
) -> None:
    with visitor(browser, panel) as page:
        feeds = begin(page, running)
        now = time.monotonic_ns()
        end: dict[str, Callable[[], object]] = {
            "overloaded": lambda: page.evaluate(
                "setTimeout(() => { const end = Date.now() + 3000; while (Date.now() < end) ; }, 0)"
            ),
            "closed": page.close,
            "stop": page.get_by_role("button", name="STOP not the emergency stop").click,
            "disable": page.get_by_role("button", name="Disable all").click,
        }
        end[how]()
        longest = (PRESENCE_S if how == "overloaded" else JOG_S) + SLACK_S
        assert max(stood_after(feed, now) for feed in feeds.values()) < longest
    state = State.READY if how == "disable" else State.HOLDING
    assert states(cell) == dict.fromkeys(cell.arms, state)


def test_another_page_commands_nothing_while_one_operates(
    browser: Browser, panel: str, running: RunningCell, cell: Cell
) -> None:
    with visitor(browser, panel) as page, visitor(browser, panel) as second:
        show(page, "/cell").get_by_role("button", name="Disable all").click()
        until(lambda: states(cell) == dict.fromkeys(cell.arms, State.READY), "no arm has torque")
        show(second, "/cell").get_by_role("button", name="Enable all").click()
        expect(second.get_by_role("button", name="Ask to take over")).to_be_visible()
        assert states(cell) == dict.fromkeys(cell.arms, State.READY)
