"""A page's motion is bounded in time by tokens, presence, STOP and take-over. The arm is fake, the time simulated."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import time
from collections.abc import Awaitable, Callable
from types import SimpleNamespace
from typing import Any, cast

import pytest
from starlette.websockets import WebSocketDisconnect

from rtcp.api import RtcpError
from rtcp.panel import live
from rtcp.panel.access import Role, Visitor
from rtcp.panel.live import (
    CLICK,
    JOG_S,
    LEAST_HOLD_S,
    PRESENCE_S,
    STATE_S,
    TAKE_OVER_S,
    Click,
    EndedOnPurpose,
    HeldByAnother,
    Live,
    Page,
)
from tests import simulated_time
from tests.waiting import HANG_S

FORWARD = [0.05, 0.0, 0.0, 0.0, 0.0, 0.0]


class FakeRobot:
    """A connection that records its jogs; closing it ends what it moves."""

    made: list[FakeRobot]

    def __init__(self, name: str) -> None:
        self.name, self.is_open = name, True
        self.jogs: list[tuple[Any, ...]] = []
        self.halts = 0
        FakeRobot.made.append(self)

    async def __aenter__(self) -> FakeRobot:
        return self

    async def __aexit__(self, *error: object) -> None:
        await self.close()

    async def close(self) -> None:
        self.is_open = False

    async def jog(self, *arguments: Any) -> None:
        self.jogs.append(arguments)

    async def halt(self) -> None:
        self.halts += 1

    async def move(self) -> None:
        await asyncio.sleep(60.0)


class Panel:
    """The pages of a panel; every message takes `delay_s` to a page and as long back."""

    def __init__(self) -> None:
        self.live = Live(lambda secret: True)
        self.delay_s = 0.0
        self._press = 0

    def page(self, role: Role = "operator") -> Page:
        page = self.live.open(str(len(self.live.pages)), Visitor("Ada", role, "here", 0.0), "")
        page.socket = cast(Any, object())
        self.answer(page)
        return page

    def answer(self, page: Page, visible: bool = True, **message: Any) -> None:
        """Send a message to a page, which answers it at once."""
        page.sent_ns = time.monotonic_ns()
        time.sleep(2 * self.delay_s)
        self.live._receive(page, {"seen": page.sent_ns, "visible": visible, **message})

    async def jog(self, page: Page, press: int, velocity: Any = FORWARD) -> None:
        self.answer(page, jog=velocity, frame="base", press=press)
        await asyncio.sleep(0)
        await asyncio.sleep(0)

    def click(self, page: Page) -> None:
        """A click on the newest message of a page."""
        CLICK.set(Click(page.sent_ns, time.monotonic_ns()))

    async def begin_move(self, page: Page) -> asyncio.Task[None]:
        page.sent_ns = time.monotonic_ns()
        self.click(page)
        moving = asyncio.create_task(self.live.command(page, lambda robot: cast(FakeRobot, robot).move()))
        await asyncio.sleep(0.001)
        assert self.live.operator is not None
        assert self.live.operator.moves
        return moving


def run(test: Callable[[Panel], Awaitable[None]], monkeypatch: pytest.MonkeyPatch) -> list[FakeRobot]:
    FakeRobot.made = []
    monkeypatch.setattr(live, "AsyncRobot", FakeRobot)

    async def whole() -> None:
        panel = Panel()
        watching = asyncio.create_task(panel.live.watch())
        await test(panel)
        watching.cancel()

    simulated_time.run(whole())
    return FakeRobot.made


def jogs() -> list[tuple[Any, ...]]:
    return [jog for robot in FakeRobot.made for jog in robot.jogs]


def test_a_jog_lasts_for_a_time_from_the_message_that_the_page_answered(monkeypatch: pytest.MonkeyPatch) -> None:
    async def test(panel: Panel) -> None:
        page, panel.delay_s = panel.page(), 0.05
        await panel.jog(page, 1)
        assert jogs() == [(FORWARD, "base", JOG_S, page.sent_ns * 1e-9)]
        assert time.monotonic() == pytest.approx(page.sent_ns * 1e-9 + 0.1)

    run(test, monkeypatch)


def test_over_a_slow_network_nothing_is_jogged_and_the_page_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    async def test(panel: Panel) -> None:
        page, panel.delay_s = panel.page(), 0.15
        await panel.jog(page, 1)
        assert page.notes == ["no jog: to this browser and back it takes 0.30 s, allowed are 0.17 s"]
        panel.delay_s = (JOG_S - LEAST_HOLD_S) / 2 - 0.001
        await panel.jog(page, 1)  # the same press goes on: it has ended
        assert jogs() == []
        await panel.jog(page, 2)
        assert len(jogs()) == 1

    run(test, monkeypatch)


def test_a_press_whose_next_command_is_late_has_ended_for_good(monkeypatch: pytest.MonkeyPatch) -> None:
    async def test(panel: Panel) -> None:
        page = panel.page()
        for _ in range(3):
            await panel.jog(page, 1)
            await asyncio.sleep(JOG_S - 0.01)
        await asyncio.sleep(0.02)
        for _ in range(3):
            await panel.jog(page, 1)
        assert len(jogs()) == 3
        assert page.notes == ["the jog has ended, nothing was heard for a while: release, then press again"]
        await panel.jog(page, 2)
        assert len(jogs()) == 4

    run(test, monkeypatch)


@pytest.mark.parametrize("is_visible", [True, False])
def test_a_move_lasts_while_its_page_answers_and_is_visible(monkeypatch: pytest.MonkeyPatch, is_visible: bool) -> None:
    async def test(panel: Panel) -> None:
        page = panel.page()
        moving = await panel.begin_move(page)
        for _ in range(int(3 * PRESENCE_S / STATE_S)):
            panel.answer(page)
            await asyncio.sleep(STATE_S)
        silent_at = page.sent_ns * 1e-9
        while not moving.done():
            if not is_visible:
                panel.answer(page, visible=False)
            await asyncio.sleep(STATE_S)
        with pytest.raises(EndedOnPurpose):
            await moving
        assert PRESENCE_S < time.monotonic() - silent_at < PRESENCE_S + 3 * STATE_S
        assert page.notes == ["the motion was ended: nothing was heard of this page for 1.0 s"]

    (robot,) = run(test, monkeypatch)
    assert not robot.is_open


def test_a_page_whose_socket_closes_has_lost_the_arm_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    async def test(panel: Panel) -> None:
        page, closes = panel.page(), asyncio.Event()

        async def receive() -> Any:
            await closes.wait()
            raise WebSocketDisconnect

        async def accept() -> None: ...

        socket = SimpleNamespace(query_params={"page": page.key}, accept=accept, receive_json=receive)
        serving = asyncio.create_task(panel.live.serve(cast(Any, socket), page.visitor))
        await asyncio.sleep(0)
        moving, at = await panel.begin_move(page), time.monotonic()
        closes.set()
        await serving
        with pytest.raises(EndedOnPurpose):
            await moving
        assert panel.live.operator is None
        assert time.monotonic() == at

    (robot,) = run(test, monkeypatch)
    assert not robot.is_open


def test_nothing_moves_that_was_asked_for_before_stop_or_came_late(monkeypatch: pytest.MonkeyPatch) -> None:
    async def test(panel: Panel) -> None:
        page, other = panel.page(), panel.page()
        moving = await panel.begin_move(page)
        click = CLICK.get()
        panel.answer(other, stop=True)
        with pytest.raises(EndedOnPurpose):
            await moving
        panel.live._receive(page, {"seen": page.sent_ns, "visible": True, "jog": FORWARD, "frame": "base", "press": 1})
        assert page.notes == ["no jog: STOP was pressed after this: release, then press again"]
        CLICK.set(Click(click.token_ns, click.came_ns))
        with pytest.raises(RtcpError, match="STOP was pressed after this click"):
            await panel.live.command(page, lambda robot: robot.halt())
        await asyncio.sleep(0.1)
        panel.answer(page)
        await asyncio.sleep(1.5)
        panel.click(page)
        with pytest.raises(RtcpError, match=r"the click came 1\.5 s late, allowed are 1 s"):
            await panel.live.command(page, lambda robot: robot.halt())
        panel.answer(page)
        await panel.begin_move(page)

    assert [robot.halts for robot in run(test, monkeypatch) if robot.name == "panel: stop"] == [1]


def test_a_viewer_has_no_arm_and_stops_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    async def test(panel: Panel) -> None:
        page = panel.page("viewer")
        await panel.jog(page, 1)
        panel.click(page)
        with pytest.raises(RtcpError, match="Ada may look, and not command"):
            await panel.live.command(page, lambda robot: robot.halt())
        assert FakeRobot.made == []
        panel.answer(page, stop=True)
        await asyncio.sleep(0.001)

    assert [robot.halts for robot in run(test, monkeypatch)] == [1]


class FakeFeed:
    """Shared memory of a platform whose loop takes every halt."""

    def __init__(self) -> None:
        self.halts = 0

    def halt(self) -> int:
        self.halts += 1
        return self.halts

    def has_taken(self, requested_ns: int) -> bool:
        return requested_ns <= self.halts


def test_stop_needs_no_new_connection_and_waits_for_none(monkeypatch: pytest.MonkeyPatch) -> None:
    async def test(panel: Panel) -> None:
        async def no_descriptor(robot: FakeRobot) -> FakeRobot:
            raise OSError(errno.EMFILE, "Too many open files")

        monkeypatch.setattr(FakeRobot, "__aenter__", no_descriptor)
        own, partner = FakeFeed(), FakeFeed()
        panel.live.feed, panel.live.partners._feeds["left"] = cast(Any, own), cast(Any, partner)
        panel.answer(panel.page(), stop=True)
        assert (own.halts, partner.halts) == (1, 1)  # before anything else runs
        assert await panel.live.halt() == ""
        panel.live.feed = None
        panel.live.partners._feeds.clear()
        assert "Too many open files" in await panel.live.halt()

    run(test, monkeypatch)


def test_a_page_whose_session_has_expired_shows_nothing_moves_nothing_and_stops(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async def test(panel: Panel) -> None:
        page, feed = panel.page(), FakeFeed()
        panel.live.feed = cast(Any, feed)
        moving = await panel.begin_move(page)
        panel.live._is_session = lambda secret: False
        await panel.live._end_sessions()
        with pytest.raises(EndedOnPurpose):
            await moving
        panel.live._send_all()
        assert page.sending is None
        await panel.jog(page, 1)
        assert panel.live.operator is None
        panel.answer(page, stop=True)
        assert feed.halts == 1
        await asyncio.sleep(0.001)

    run(test, monkeypatch)


@pytest.mark.parametrize("answer", [True, False, None])
def test_the_arm_is_handed_over_by_its_operator_or_after_ten_seconds_without_an_answer(
    monkeypatch: pytest.MonkeyPatch, answer: bool | None
) -> None:
    async def test(panel: Panel) -> None:
        page, other = panel.page(), panel.page()
        asked: list[asyncio.Future[bool]] = []
        page.asked = lambda who, future: asked.append(future)
        moving, at = await panel.begin_move(page), time.monotonic()
        panel.click(other)
        with pytest.raises(HeldByAnother):
            await panel.live.command(other, lambda robot: robot.halt())
        taking = asyncio.create_task(panel.live.take_over(other))
        while not taking.done():
            if answer is not None and asked and not asked[0].done():
                asked[0].set_result(answer)
            panel.answer(page)
            panel.answer(other)
            await asyncio.sleep(STATE_S)
        assert await taking is (answer is not False)
        assert panel.live.operator is not None
        assert panel.live.operator.page is (page if answer is False else other)
        ended, _ = await asyncio.wait([moving], timeout=0.0 if answer is False else HANG_S)
        assert bool(ended) is (answer is not False)
        assert answer is not None or time.monotonic() - at >= TAKE_OVER_S
        with contextlib.suppress(EndedOnPurpose, asyncio.CancelledError):
            moving.cancel()
            await moving

    run(test, monkeypatch)
