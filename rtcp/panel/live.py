"""WebSocket traffic: state out to every page at 20 Hz, the operator's input in.

Each message to a page carries a token: the instant at which it left. The page answers with the token of the newest
message that it has processed. An input counts from that instant, on this machine's clock, so that its age is bounded
however long the network, the browser or a queue has delayed it. That bounds three things:

- a jog command is valid until `JOG_S` after its token; a press ends where its next command comes later;
- a motion continues while a visible page answers with a token not older than `PRESENCE_S`;
- the operator of a page that closes is gone at once.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import logging
import math
import re
import time
from collections.abc import Awaitable, Callable, Coroutine, Mapping, Sequence
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import Any, TypeVar

from starlette.websockets import WebSocket, WebSocketDisconnect

from kinematics.forward import forward
from kinematics.jacobian import singularity_distances
from rtcp.api import AsyncRobot, EventRecord, Feed, NotRunning, RtcpError, State, Status
from rtcp.api.async_cell import AsyncCell
from rtcp.config.cell import CellConfig
from rtcp.config.model import ArmConfig
from rtcp.panel.access import Bucket, Visitor
from rtcp.panel.partners import Partners, arm_state
from rtcp.panel.scope import Scope
from rtcp.panel.trends import Trends

T = TypeVar("T")
Json = dict[str, Any]

STATE_S = 0.05
"""Interval of messages to a page, s."""
JOG_S = 0.25
"""Time from the operator's last input to the end of a jog, s."""
LEAST_HOLD_S = 0.08
"""Shortest validity of a jog command, s: below it the round trip to the browser takes too long."""
PRESENCE_S = 1.0
"""Time from the last answer of the operator's page to the end of a motion, s."""
TAKE_OVER_S = 10.0
"""Time after which an operator who does not answer a take-over loses the arm, s."""
_RETRY_S = 0.5
_LOG_S = 10.0
"""Interval between reports of a defect, s."""
_MESSAGES = 200.0
"""Messages accepted from a page: burst, and per second."""
_MOST_UNSEEN = 32
"""Limit of pages that no browser has shown yet."""
_SCOPE_UPDATES = 2
"""The scopes are read in every second update."""
_LIMIT_UPDATES = 10
"""The limits are read in every tenth."""
_PARTNER_UPDATES = 20
"""Partners that have started are looked up in every twentieth."""
_EVENT_UPDATES = 10
"""New events are read in every tenth."""
_MOST_EVENTS = 1000
_MOST_ALARMS = 200
_STOP = "panel: stop"
_TAKEN_S, _POLL_S = 0.1, 0.005
"""Time for a loop to take a stop, s, and interval of looking whether it has, s."""
NEXT = {
    "off": "Start a platform on the tab Start",
    "starting": "Wait until it runs",
    "ready": "Press Enable: the drives then hold the arm",
    "enabling": "Wait until the drives hold the arm",
    "holding": "Jog, send a target or run a program",
    "moving": "Halt or STOP ends the motion",
    "stopping": "Wait until the arm stands",
    "disabling": "Wait until the drives are without torque",
    "homing": "Halt or STOP ends the homing",
    "fault": "Remove the cause, then press Reset",
    "emergency_stop": "Release the emergency stop, then press Reset",
    "stopped_by_limit": "Press Reset, then move away from the limit",
    "resetting": "Wait until the fault is cleared",
    "closing": "Wait until the platform has ended",
}
"""The next step of a person, by the state of the machine."""
_ASIDE = re.compile(
    r"[;,:][^;,:`()]*`rtcp [^`]*`[^;,.]*"  # what to type
    r"| \((?:[\w.\[\]]+ in \S+|\w+\.[\w.]+)\)"  # the key that sets a limit
)
"""Parts that the header leaves out of a message; the tab Alarms shows the whole one."""
_JOINTS = ("actual_position", "actual_velocity", "actual_torque", "commanded_position")
log = logging.getLogger("rtcp.panel")


@dataclass(frozen=True)
class Click:
    """A click: the token that its page had then, and the instant of its arrival."""

    token_ns: int
    came_ns: int


_NO_CLICK = Click(0, 0)
CLICK: ContextVar[Click] = ContextVar("click", default=_NO_CLICK)
"""The click that the running code handles."""


class HeldByAnother(Exception):
    """Another page has the arm; `holder` names it."""

    def __init__(self, holder: str) -> None:
        super().__init__(f"{holder} operates the arm")
        self.holder = holder


class EndedOnPurpose(Exception):
    """STOP, a take-over or the end of a page has ended the command."""


@dataclass(eq=False)
class Page:
    """One open page: a tab of a browser."""

    key: str
    visitor: Visitor
    number: int = 0
    """Counted from the panel's start: tells two tabs of one person apart."""
    secret: str = ""
    """Secret of its session."""
    socket: WebSocket | None = None
    has_expired: bool = False
    """Whether its session has ended: it is shown nothing more and commands nothing, and its STOP is carried out."""
    sent_ns: int = 0
    """Token of the last message to it."""
    seen_ns: int = 0
    """Newest token that it has answered with while it was visible."""
    notes: list[str] = field(default_factory=list)
    """Notes for its next message."""
    press: int = 0
    """Number of the press that jogs."""
    ended: int = 0
    """Newest press that has ended: its further commands move nothing."""
    jogged_ns: int = 0
    """Instant at which the jog of that press ends."""
    sending: asyncio.Task[None] | None = None
    scope: Scope | None = None
    """The picture that it shows."""
    block: Json | None = None
    """Block of the scope, for its next message."""
    notify: Callable[[str], None] = lambda message: None
    asked: Callable[[str, asyncio.Future[bool]], None] = lambda who, answer: answer.set_result(True)
    """Asks the person whether another may take over."""

    def __str__(self) -> str:
        return f"{self.visitor} (page {self.number})"

    def check_may_command(self) -> None:
        """Raise Refused where its visitor is a viewer."""
        if self.visitor.role != "operator":
            raise RtcpError("refused", f"{self.visitor.name} may look, and not command: log in as an operator")

    def age_s(self, now_ns: int) -> float:
        """Return the time since the page last answered while it was visible, s."""
        return (now_ns - self.seen_ns) * 1e-9 if self.socket is not None else math.inf


def operator_name(page: str) -> str:
    """Return the name under which a page commands the platform."""
    return f"panel: {page}"


class Operator:
    """The one page that may move the arm, with a connection of its own: closing it stops its motions."""

    def __init__(self, page: Page) -> None:
        self.page = page
        self._robot: AsyncRobot | None = None
        self._connecting = asyncio.Lock()
        self._motions: set[asyncio.Task[Any]] = set()
        self._pending: tuple[Sequence[float], str, int] | None = None
        self._jogging: asyncio.Task[None] | None = None
        self._has_ended = False

    async def robot(self) -> AsyncRobot:
        """Return the connection; connect again where it was lost."""
        async with self._connecting:
            if not self._has_ended and (self._robot is None or not self._robot.is_open):
                connection = AsyncRobot(operator_name(str(self.page)))
                await connection.__aenter__()
                self._robot = connection
            robot = self._robot
            if self._has_ended or robot is None:
                if robot is not None:
                    await robot.close()
                raise RtcpError("refused", "this page does not operate the arm any more: nothing was sent")
        return robot

    @property
    def moves(self) -> bool:
        """Whether a command of this page may move the arm."""
        return bool(self._motions)

    async def run(self, command: Callable[[AsyncRobot], Awaitable[T]]) -> T:
        """Carry out a command of the arm; leaving, or `end`, ends its motion.

        Raises:
            EndedOnPurpose: `end` was called.
            RtcpError: as the command; Refused while another one is carried out.
        """

        async def run() -> T:
            return await command(await self.robot())

        return await self._carry_out(run())

    async def run_in_cell(self, cell: CellConfig, command: Callable[[AsyncCell], Awaitable[T]]) -> T:
        """Carry out a command of all arms of the cell, as `run`."""

        async def run() -> T:
            return await command(AsyncCell(cell, operator_name(str(self.page))))

        return await self._carry_out(run())

    async def _carry_out(self, command: Coroutine[Any, Any, T]) -> T:
        if self._motions:
            command.close()
            raise RtcpError("refused", "the last command of this page is still carried out: wait, or STOP")
        task = asyncio.ensure_future(command)
        self._motions.add(task)
        try:
            return await task
        except asyncio.CancelledError:
            if not self._has_ended:
                raise
            raise EndedOnPurpose from None
        finally:
            self._motions.discard(task)

    def jog(self, velocity: Sequence[float], frame: str, token_ns: int) -> None:
        """Move with a velocity until `JOG_S` after `token_ns`; only the newest command waits for its turn."""
        self._pending = (velocity, frame, token_ns)
        if self._jogging is None or self._jogging.done():
            self._jogging = asyncio.create_task(self._jog())

    async def _jog(self) -> None:
        while self._pending is not None:
            (velocity, frame, token_ns), self._pending = self._pending, None
            try:
                robot = await self.robot()
                await robot.jog(velocity, frame, JOG_S, token_ns * 1e-9)
            except RtcpError as error:
                self.page.notes.append(error.message)
                self.page.ended = self.page.press

    async def end(self) -> None:
        """Close the connection for good: its motions come to a controlled stop, waiting commands are not sent."""
        self._has_ended = True
        self._pending = None
        for motion in self._motions:
            motion.cancel()
        robot, self._robot = self._robot, None
        if robot is not None:
            await robot.close()


class Live:
    """Follows the platform and serves the pages.

    Args:
        is_session: whether the session with this secret still lasts.
    """

    def __init__(self, is_session: Callable[[str], bool]) -> None:
        self._is_session = is_session
        self.status: Status | None = None
        """Newest status; None: no platform runs."""
        self.problem = "no platform has been looked for yet"
        """Why there is no status."""
        self.config: ArmConfig | None = None
        self.limits: Json | None = None
        """Limits in force, as `Robot.limits` has them."""
        self.feed: Feed | None = None
        self.events: list[EventRecord] = []
        """Of the platform that runs, or ran last; oldest first."""
        self.alarms: list[EventRecord] = []
        """Events that a person has to know of, oldest first."""
        self.starting = 0
        """Commands under way that start a platform."""
        self._acknowledged: dict[tuple[int, str], str] = {}
        """The person who has acknowledged an alarm, by its number and time: numbers restart with each platform."""
        self.trends = Trends()
        self.partners = Partners()
        self.pages: dict[str, Page] = {}
        self.operator: Operator | None = None
        self._viewing: AsyncRobot | None = None
        self._retry_at = 0.0
        self._updates = 0
        self._scoped = False
        self._last_event = 0
        self._halting: asyncio.Task[str] | None = None
        self._leaving: set[asyncio.Task[None]] = set()
        self._halted_ns = 0
        """When STOP was pressed last."""
        self._asking = False
        self._numbers = itertools.count(1)

    # -- pages --------------------------------------------------------------------------------------------------------

    def open(self, key: str, visitor: Visitor, secret: str) -> Page:
        """Return a page that is being made.

        Raises:
            Refused: too many were requested and not shown.
        """
        if sum(page.sent_ns == 0 for page in self.pages.values()) >= _MOST_UNSEEN:
            raise RtcpError("refused", f"{_MOST_UNSEEN} pages wait for a browser already")
        page = self.pages[key] = Page(key, visitor, next(self._numbers), secret)
        return page

    async def close(self, page: Page) -> None:
        """A page has gone for good."""
        self.pages.pop(page.key, None)
        await self.leave(page)

    async def serve(self, socket: WebSocket, visitor: Visitor) -> None:
        """Serve the socket of one page until it closes."""
        page = self.pages.get(socket.query_params.get("page", ""))
        if page is None or page.visitor is not visitor:
            await socket.close(1008, "no such page")
            return
        await socket.accept()
        page.socket = socket
        bucket = Bucket(_MESSAGES, _MESSAGES)
        try:
            while True:
                if not bucket.allows():
                    raise ValueError("too many messages")
                self._receive(page, await socket.receive_json())
        except (ValueError, LookupError, TypeError, OverflowError):
            # The panel's own pages never send this.
            with contextlib.suppress(WebSocketDisconnect, RuntimeError):
                await socket.close(1003, "not a message of a page")
        except (WebSocketDisconnect, RuntimeError):
            pass  # it has closed, or was closed
        finally:
            if page.socket is socket:
                page.socket = None
                await self.leave(page)

    def _receive(self, page: Page, message: Json) -> None:
        token_ns = message["seen"]
        if type(token_ns) is not int or not 0 <= token_ns <= page.sent_ns:
            raise ValueError("a token that was never sent")
        if message.get("stop"):
            self._begin_halt()
        if page.has_expired:
            return
        if message.get("visible") is True:
            page.seen_ns = max(page.seen_ns, token_ns)
        if "jog" in message:
            self._jog(page, message, token_ns)

    def _jog(self, page: Page, message: Json, token_ns: int) -> None:
        if page.visitor.role != "operator":
            return
        press, velocity, frame = message["press"], message["jog"], message["frame"]
        if type(press) is not int or frame not in ("base", "tool", "joints") or len(velocity) > 16:
            raise ValueError("jog")
        velocity = [float(value) for value in velocity]
        if press <= page.ended:
            return
        now_ns = time.monotonic_ns()
        age_s = (now_ns - token_ns) * 1e-9
        if press == page.press and now_ns > page.jogged_ns:
            # The jog has stopped already: continuing it would be an unexpected start.
            self._end_press(page, press, "the jog has ended, nothing was heard for a while: release, then press again")
        elif token_ns <= self._halted_ns:
            self._end_press(page, press, "no jog: STOP was pressed after this: release, then press again")
        elif JOG_S - age_s < LEAST_HOLD_S:
            allowed = f"allowed are {JOG_S - LEAST_HOLD_S:g} s"
            self._end_press(page, press, f"no jog: to this browser and back it takes {age_s:.2f} s, {allowed}")
        elif press == page.press or any(velocity):
            try:
                operator = self.claim(page)
            except (HeldByAnother, RtcpError) as error:
                self._end_press(page, press, str(error))
                return
            page.press, page.jogged_ns = press, token_ns + int(JOG_S * 1e9)
            operator.jog(velocity, frame, token_ns)

    @staticmethod
    def _end_press(page: Page, press: int, why: str) -> None:
        page.ended = press
        page.notes.append(why)

    # -- who operates -------------------------------------------------------------------------------------------------

    def claim(self, page: Page) -> Operator:
        """Make a page the operator's, where no other page is.

        Raises:
            HeldByAnother: another page has the arm.
            Refused: the visitor is a viewer.
        """
        page.check_may_command()
        if page.age_s(time.monotonic_ns()) > PRESENCE_S:
            raise RtcpError("refused", f"nothing is heard of this page: {page}")
        if self.operator is None:
            self.operator = Operator(page)
        elif self.operator.page is not page:
            raise HeldByAnother(str(self.operator.page))
        return self.operator

    async def take_over(self, page: Page) -> bool:
        """Ask the operator for the arm; return whether `page` has it now. The operator's motion is stopped first."""
        current = self.operator
        if current is None or current.page is page:
            self.claim(page)
            return True
        if self._asking:
            raise RtcpError("refused", "another page is asking for the arm: try again when the operator has answered")
        self._asking = True
        try:
            answer: asyncio.Future[bool] = asyncio.get_running_loop().create_future()
            current.page.asked(str(page), answer)
            done, _ = await asyncio.wait([answer], timeout=TAKE_OVER_S)
            if done and not answer.result():
                return False
            answer.cancel()
        finally:
            self._asking = False
        if page.age_s(time.monotonic_ns()) > PRESENCE_S:
            return False  # the page that asked is gone
        # No await in between: nobody else can claim it.
        before, self.operator = self.operator, Operator(page)
        if before is not None:
            before.page.notify(f"{page} has taken over the arm")
            await before.end()
        return True

    async def leave(self, page: Page) -> None:
        """Take the arm from a page and stop its motion."""
        if self.operator is not None and self.operator.page is page:
            operator, self.operator = self.operator, None
            await operator.end()

    def check_click(self, page: Page) -> None:
        """Raise Refused for a click that arrived late, has no valid token, or was made before STOP."""
        click = CLICK.get()
        late_s = (click.came_ns - click.token_ns) * 1e-9
        if not 0 < click.token_ns <= page.sent_ns or late_s > PRESENCE_S:
            raise RtcpError("refused", f"the click came {late_s:.1f} s late, allowed are {PRESENCE_S:g} s: click again")
        if click.token_ns <= self._halted_ns:
            raise RtcpError("refused", "STOP was pressed after this click: click again")

    async def command(self, page: Page, command: Callable[[AsyncRobot], Awaitable[T]], instead: bool = False) -> T:
        """Carry out a command as `Operator.run`; raises HeldByAnother too. `instead`: stop the page's motion first."""
        return await (await self._operator(page, instead)).run(command)

    async def command_cell(self, page: Page, command: Callable[[AsyncCell], Awaitable[T]], instead: bool = False) -> T:
        """Carry out a command of all arms of the cell as `command`; raises Refused where there is none."""
        operator = await self._operator(page, instead)
        if self.partners.cell is None:
            raise RtcpError("refused", "this arm is in no cell that runs")
        return await operator.run_in_cell(self.partners.cell, command)

    async def _operator(self, page: Page, instead: bool) -> Operator:
        """Make a page that was clicked the operator's; return the operator."""
        self.check_click(page)
        operator = self.claim(page)
        if instead and operator.moves:
            await self.leave(page)
            operator = self.claim(page)
        return operator

    async def halt(self) -> str:
        """Stop all motions and waiting commands of all arms of the cell, for any visitor; return what failed and why.

        The loops are reached at once and each by itself. A STOP while another one waits for its end has the same
        outcome.
        """
        return await asyncio.shield(self._begin_halt())

    def _begin_halt(self) -> asyncio.Task[str]:
        """Request the stop of each loop now; return the task that waits for the end of all motions."""
        requested = [(feed, feed.halt()) for feed in (self.feed, *self.partners.feeds) if feed is not None]
        self._halted_ns = time.monotonic_ns()
        for page in self.pages.values():
            page.ended = page.press
        if self.operator is not None:
            leaving = asyncio.create_task(self.leave(self.operator.page))
            self._leaving.add(leaving)
            leaving.add_done_callback(self._leaving.discard)
        if self._halting is None or self._halting.done():
            self._halting = asyncio.create_task(self._halt(requested))
        return self._halting

    async def _halt(self, requested: Sequence[tuple[Feed, int]]) -> str:
        try:
            if self.partners.cell is not None:
                failed = await AsyncCell(self.partners.cell, _STOP).halt()
                # Arms without torque have nothing to stop.
                errors = {name: e for name, e in failed.items() if getattr(e, "reason", "") != "wrong_state"}
                if not errors:
                    return ""
                message = "; ".join(f"{name}: {error}" for name, error in errors.items())
                # An arm whose records nobody finds may move.
                is_missing = len(requested) <= len(self.partners.members)
                has_reason = is_missing or any(getattr(error, "reason", "") for error in errors.values())
                return message if has_reason or not await self._all_stopped(requested) else ""
            async with AsyncRobot(_STOP) as robot:
                await robot.halt()
        except (RtcpError, OSError) as error:
            # Without a reason of the loop only the way to the gateway is missing.
            return str(error) if getattr(error, "reason", "") or not await self._all_stopped(requested) else ""
        finally:
            await asyncio.gather(*self._leaving)
        return ""

    async def _all_stopped(self, requested: Sequence[tuple[Feed, int]]) -> bool:
        """Return whether every loop has taken its stop, within `_TAKEN_S`."""
        for _ in range(round(_TAKEN_S / _POLL_S)):
            # The records of an arm are closed when it ends, which may happen while this waits.
            with contextlib.suppress(ValueError):
                if all(feed.has_taken(requested_ns) for feed, requested_ns in requested):
                    return bool(requested)
            await asyncio.sleep(_POLL_S)
        return False

    async def set_speed_override(self, page: Page, fraction: float) -> None:
        """Set it, also while this page moves the arm; anyone who may command lowers it.

        Raises:
            HeldByAnother: another page has the arm, and it would be raised.
            RtcpError: as the command.
        """
        self.check_click(page)
        page.check_may_command()
        if self.status is not None and fraction <= self.status.speed_override:
            await self.view(lambda robot: robot.set_speed_override(fraction))
        else:
            await (await self.claim(page).robot()).set_speed_override(fraction)

    @property
    def moves_unpaused(self) -> bool:
        """Whether the arm is on its way and not paused, by the newest status."""
        return self.status is not None and self.status.state is State.MOVING and self.status.speed_override > 0.0

    async def pause(self, page: Page) -> None:
        """Pause the motion under way, whoever began it; raises RtcpError.

        Over the connection of the operator, who may then resume it; for another page over a connection of nobody's.
        """
        page.check_may_command()
        try:
            operator = self.claim(page)
        except HeldByAnother:
            await self.view(lambda robot: robot.pause())
        else:
            await (await operator.robot()).pause()

    async def resume(self, page: Page) -> None:
        """Continue the motion that is paused.

        Raises:
            HeldByAnother: another page has the arm.
            RtcpError: as the command.
        """
        self.check_click(page)
        await (await self.claim(page).robot()).resume()

    async def view(self, query: Callable[[AsyncRobot], Awaitable[T]]) -> T:
        """Send a query, which commands nothing.

        Raises:
            NotRunning: no platform runs.
        """
        if self._viewing is None:
            raise RtcpError("not running", self.problem)
        return await query(self._viewing)

    # -- the platform -------------------------------------------------------------------------------------------------

    async def follow(self) -> None:
        """Follow the platform for as long as the panel runs."""
        due, log_at = time.monotonic(), 0.0
        while True:
            self._updates += 1
            try:
                await self._read_status()
                self._send_all()
                await self._end_sessions()
            except Exception:
                # Pages are served further; a lasting defect is logged every `_LOG_S`.
                if time.monotonic() >= log_at:
                    log_at = time.monotonic() + _LOG_S
                    log.exception("a turn of the panel")
            due = max(due + STATE_S, time.monotonic() - STATE_S)
            await asyncio.sleep(max(0.0, due - time.monotonic()))

    async def watch(self) -> None:
        """Watch over the operator, whatever else waits."""
        while True:
            await asyncio.sleep(STATE_S)
            await self._watch_operator()

    async def _end_sessions(self) -> None:
        for page in list(self.pages.values()):
            if not page.has_expired and not self._is_session(page.secret):
                page.has_expired = True
                await self.leave(page)

    async def _read_status(self) -> None:
        try:
            if self._viewing is None or not self._viewing.is_open:
                if time.monotonic() < self._retry_at:
                    return
                self._retry_at = time.monotonic() + _RETRY_S
                self.partners.find_cell()
                connection = AsyncRobot("panel: view")
                await connection.__aenter__()
                self._viewing = connection
                self.feed = Feed()
                self.config = self.feed.config
            self.status = await asyncio.wait_for(self._viewing.status(), 2.0)
            if self.limits is None or self._updates % _LIMIT_UPDATES == 0:
                self.limits = (await asyncio.wait_for(self._viewing.limits(), 2.0))["limits"]
            if self._updates % _EVENT_UPDATES == 0:
                await self._read_events(self._viewing)
            raw = self.status.raw
            self.trends.read(raw, self.limits["torque"], self._temperatures(raw))
        except (RtcpError, OSError, asyncio.TimeoutError) as error:
            self.problem = "no platform runs" if isinstance(error, NotRunning) else str(error) or "it does not answer"
            await self._lost()

    async def _read_events(self, robot: AsyncRobot) -> None:
        events = await asyncio.wait_for(robot.events(self._last_event), 2.0)
        if events and not self._last_event:
            self.events, self.alarms = [], []  # of the platform before
        self._last_event = events[-1].number if events else self._last_event
        self.events = [*self.events, *events][-_MOST_EVENTS:]
        if events:
            self._keep_alarms([event for event in events if event.severity != "note"])

    def _keep_alarms(self, events: Sequence[EventRecord]) -> None:
        """Add alarms; acknowledged ones are dropped first."""
        alarms = [*self.alarms, *events]
        dropped = sorted(alarms, key=lambda e: not self.acknowledged_by(e))[: max(0, len(alarms) - _MOST_ALARMS)]
        self.alarms = [alarm for alarm in alarms if alarm not in dropped]
        kept = {(alarm.number, alarm.time) for alarm in self.alarms}
        self._acknowledged = {key: by for key, by in self._acknowledged.items() if key in kept}

    def _temperatures(self, raw: Mapping[str, Any]) -> list[float | None]:
        """Return the temperatures of the drives, C, one a joint; None: its drive maps none."""
        temperatures = {slave["name"]: slave["temperature"] for slave in raw["slaves"]}
        return [] if self.config is None else [temperatures.get(joint.slave) for joint in self.config.joints]

    def acknowledged_by(self, alarm: EventRecord) -> str:
        """Return the person who has acknowledged an alarm; empty: nobody."""
        return self._acknowledged.get((alarm.number, alarm.time), "")

    def acknowledge(self, alarms: Sequence[EventRecord], by: str) -> None:
        """Mark alarms as acknowledged, for all pages."""
        for alarm in alarms:
            self._acknowledged.setdefault((alarm.number, alarm.time), by)

    async def _lost(self) -> None:
        self.status = self.limits = None
        self._last_event = 0
        robot, self._viewing = self._viewing, None
        feed, self.feed = self.feed, None
        self.config = None
        for page in self.pages.values():
            page.scope = None
        if feed is not None:
            feed.close()
        if robot is not None:
            await robot.close()

    async def _watch_operator(self) -> None:
        operator = self.operator
        if operator is None or not operator.moves:
            return
        age_s = operator.page.age_s(time.monotonic_ns())
        if age_s > PRESENCE_S:
            operator.page.notes.append(f"the motion was ended: nothing was heard of this page for {age_s:.1f} s")
            log.warning("nothing heard of %s for %.1f s: its motion is ended", operator.page, age_s)
            await self.leave(operator.page)

    # -- messages -----------------------------------------------------------------------------------------------------

    def _send_all(self) -> None:
        if not any(page.socket for page in self.pages.values()):
            return
        if self._updates % _PARTNER_UPDATES == 0:
            self.partners.find()
        state = self.state()
        if self._updates % _SCOPE_UPDATES == 0:
            self._read_scopes()
        for page in list(self.pages.values()):
            # A page that is slow to receive gets the newest message when it is ready.
            is_ready = page.sending is None or page.sending.done()
            if page.socket is not None and not page.has_expired and is_ready:
                page.sending = asyncio.create_task(self._send(page, page.socket, state))

    def _read_scopes(self) -> None:
        """Pass the cycles since the last call to every scope that a page shows."""
        watching = [page for page in self.pages.values() if page.scope is not None and page.socket is not None]
        if self.feed is None:
            return
        records, _ = self.feed.records() if watching or self._scoped else (None, 0)
        self._scoped = bool(watching)
        for page in watching:
            if records is not None and page.scope is not None:
                page.scope.read(records)
                page.block = page.scope.block() or page.block

    async def _send(self, page: Page, socket: WebSocket, state: Json) -> None:
        page.sent_ns = time.monotonic_ns()
        notes, page.notes = page.notes, []
        operator, holder = self.operator, str(state.get("holder", ""))
        mine = operator is not None and operator.page is page
        who = "" if operator is None else str(operator.page)
        if holder and not (who and operator_name(who).startswith(holder)):  # a long name is cut off
            who, mine = holder, False  # a command line, a program, another panel
        block, page.block = page.block, None
        with contextlib.suppress(WebSocketDisconnect, RuntimeError):  # closed: `serve` handles that
            if block is not None:
                await socket.send_json({"scope": block})
            await socket.send_json({"token": page.sent_ns, **state, "operator": who, "mine": mine, "notes": notes})

    def state(self) -> Json:
        """Return the values that every page shows, SI units."""
        everywhere: Json = {"alarms": sum(not self.acknowledged_by(alarm) for alarm in self.alarms)}
        if self.partners.cell is not None:
            everywhere |= {
                "partners": self.partners.state(),
                "step": arm_state(self.feed).get("step"),
                "rod": self.partners.rod,
            }
        if self.status is None:
            state, message = ("starting", "the platform starts") if self.starting else ("off", self.problem)
            return {"state": state, "message": sentence(message), "next": NEXT[state], **everywhere}
        raw = self.status.raw
        joints = raw["joints"]
        values: Json = {
            "state": raw["state"],
            "message": sentence(raw["message"]),
            "next": NEXT[raw["state"]],
            "drive_mode": raw["drive_mode"],
            "control_mode": raw["control_mode"],
            "speed_override": round(100.0 * raw["speed_override"], 1),
            "tool_name": raw["tool_name"],
            "joystick": _joystick(raw["joystick"]),
            "holder": raw["lease"]["holder"],
            "age_s": round(raw["lost_s"] + max(0, time.monotonic_ns() - raw["time_ns"]) * 1e-9, 1),
            "bus": raw["bus"],
            "joints": {name: [_number(value, 5) for value in joints[name]] for name in _JOINTS},
            "goal": raw["goal"],
            "statuswords": raw["statuswords"],
            "wkc": raw["wkc"],
            "missed": raw["missed"],
            "cycles": raw["cycles"],
            "limits": self.limits,
            **everywhere,
        }
        if raw["processes"]:
            values["processes"] = {name: self._process(name, raw) for name in raw["processes"]}
        values["temperature"] = self._temperatures(raw)
        q = joints["actual_position"]
        model = None if self.config is None else self.config.model_of(raw["tool_name"])
        if model is not None and all(map(math.isfinite, q)):
            pose = forward(model, q)
            distances = singularity_distances(model, q)
            values["tool"] = [round(value, 5) for value in (*pose.position, *pose.rpy)]
            values["singular"] = [None if distance is None else round(distance, 4) for distance in distances]
        return values

    def _process(self, name: str, raw: Mapping[str, Any]) -> Json:
        """Return state, fields and lamps of a process."""
        devices = raw["devices"]
        lamps: Json = {}
        for process in () if self.config is None else self.config.processes:
            if process.name == name:
                for key in process.LAMPS.values():
                    slave, _, channel = str(getattr(process, key)).partition(".")
                    lamps[key] = "on" if devices[slave][channel]["value"] else "off"
        fields = {
            field: None if entry["value"] is None else _number(entry["value"], 5)
            for field, entry in devices.get(name, {}).items()
            if not isinstance(entry["value"], list)
        }
        return {"state": raw["processes"][name]["state"] or "", "fields": fields, "lamps": lamps}


def sentence(message: str) -> str:
    """Return a message as a sentence for a person without terminal and files."""
    short = _ASIDE.sub("", message).replace("`", "").rstrip(".")
    return short and f"{short[0].upper()}{short[1:]}."


def _joystick(joystick: Mapping[str, Any] | None) -> str:
    """Return the mode of the joystick and what it controls; empty: there is none."""
    if joystick is None:
        return ""
    return f"{joystick['mode']}, controls the {'arm' if joystick['controls_arm'] else 'chair'}"


def _number(value: float, digits: int) -> float | None:
    """Return a number for JSON, which has none that is not finite."""
    return round(value, digits) + 0.0 if math.isfinite(value) else None  # fields show no -0
