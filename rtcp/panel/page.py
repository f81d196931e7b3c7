"""Parts of every page: native HTML controls with labels, and commands whose refusals are shown."""

from __future__ import annotations

import asyncio
import contextlib
import inspect
import json
import sys
import threading
import time
from collections.abc import Awaitable, Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, Final, TypeVar

from nicegui import Client, ui
from nicegui.element import Element
from nicegui.elements.mixins.text_element import TextElement

from rtcp.api import AsyncRobot, ProgramFile, RtcpError, State
from rtcp.api.async_cell import AsyncCell
from rtcp.panel.arm_view import ArmView
from rtcp.panel.live import CLICK, TAKE_OVER_S, Click, EndedOnPurpose, HeldByAnother, Live, Page

T = TypeVar("T")
Handler = Callable[[], Awaitable[object] | object]
_BESIDE = "seamless position=bottom"
"""A dialog that covers nothing: STOP stays in reach."""
_PAUSE_S = 0.05
"""Interval between checks that a pause holds, s."""
_ABOVE: Final = "top-right"
"""Position of notifications: away from the pads and buttons of a tab."""
_COMMANDS = asyncio.Semaphore(2)
"""Limits the commands `rtcp` that run at once."""
_LONGEST_LINE = 1 << 22
Heading = str | tuple[str, str]
"""Heading of a column: its name, or name and unit."""
POSE = (("x", "m"), ("y", "m"), ("z", "m"), ("rx", "rad"), ("ry", "rad"), ("rz", "rad"))
ENABLED = "holding moving stopping"
"""States with torque, as `data-when` of a control has them."""


class Field:
    """A control with a label; `value` in SI units: the browser shows and reads it in the units chosen there."""

    def __init__(self, tag: str, label: str, value: str, unit: str = "", **attributes: str) -> None:
        self._name = label
        with ui.element("div").classes("field") as self.place:
            with ui.element("label") as heading:
                with_unit(label, unit, ", ")
            self.control = ui.element(tag)
        heading.props["for"] = self.control.html_id
        self.control.props.update(attributes)
        if unit:
            self.control.props["data-in"] = unit
        # An attribute: a property would overwrite typed text when a neighbour is drawn anew.
        self.control.props["^value"] = value
        self.control.on("input", self._changed, js_handler="(event) => emit(rtcp.typed(event.target))")
        self._value = value
        self._on_change: list[Callable[[], object]] = []

    def _changed(self, event: Any) -> None:
        self._value = str(event.args)  # the browser shows it already
        for handler in self._on_change:
            handler()

    def on_change(self, handler: Callable[[], object]) -> None:
        """Call `handler` when the person has changed it."""
        self._on_change.append(handler)

    @property
    def value(self) -> str:
        """Text of the control."""
        return self._value

    @value.setter
    def value(self, value: str) -> None:
        self._value = value
        # Not by its properties: only changes of these are sent, and typed text does not change them.
        self.control.client.run_javascript(f"rtcp.fill('{self.control.html_id}', {json.dumps(value)})")

    def number(self) -> float:
        """Return its number.

        Raises:
            Invalid: the text is no number.
        """
        try:
            return float(self._value)
        except ValueError:
            raise RtcpError("invalid", f'{self._name}: found the text "{self._value}", allowed is a number') from None


def field(label: str, value: str = "", **attributes: str) -> Field:
    """Return a line of text."""
    return Field("input", label, value, type="text", autocomplete="off", spellcheck="false", **attributes)


def number(label: str, value: str = "", unit: str = "", **attributes: str) -> Field:
    """Return a field for a number; `step` any."""
    options = {"type": "number", "step": "any", "inputmode": "decimal", **attributes}
    return Field("input", label, value, unit, **options)


def choice(label: str, options: Iterable[str] | Mapping[str, str], value: str) -> Field:
    """Return a field with options: values, or values and their labels."""
    select = Field("select", label, value)
    named = options if isinstance(options, Mapping) else {option: option for option in options}
    with select.control:
        for key, name in named.items():
            option = text("option", name)
            option.props["value"] = key
            if key == value:
                option.props["^selected"] = ""
    return select


def text(tag: str, content: str, classes: str = "", **attributes: str) -> TextElement:
    """Return an element with text, which is never read as HTML."""
    element = TextElement(tag=tag, text=content)
    element.props.update(attributes)
    if tag == "pre":
        element.props["tabindex"] = "0"  # a long text is scrolled, by keys too
    return element.classes(classes) if classes else element


def with_unit(label: str, unit: str, between: str = " ") -> None:
    """Write a label and the unit that the browser shows for a unit of the interfaces."""
    text("span", label + (between if unit else ""))
    if unit:
        text("span", unit, **{"data-unit": unit})


def live_value(name: str, digits: int | None = None, tag: str = "td", unit: str = "") -> Element:
    """Return a place for a value of the live state (`Live.state`): `message`, `actual_position.2`."""
    element = ui.element(tag)
    element.props["data-live"] = name
    if digits is not None:
        element.props["data-digits"] = str(digits)
    if unit:
        element.props["data-in"] = unit
    return element


def quantity(value: float, unit: str, digits: int | None = None) -> Element:
    """Return a constant value, in the unit that the browser shows."""
    element = text("span", f"{value:g}", **{"data-si": repr(value), "data-in": unit})
    if digits is not None:
        element.props["data-digits"] = str(digits)
    return element


def button(label: str, handler: Handler | None = None, *, when: str = "", plain: bool = False) -> TextElement:
    """Return a button; `when`: the states of the machine in which it can be used."""
    control = text("button", label, "act plain" if plain else "act", type="button")
    if when:
        control.props["data-when"] = when
    if handler is not None:
        on_click(control, handler)
    return control


def on_click(element: Element, handler: Handler) -> None:
    """Call `handler` for a click; its commands are judged by the instant of the click."""

    async def clicked(event: Any) -> None:
        remember_click(event.args)
        if inspect.iscoroutine(outcome := handler()):  # not a dialog that has closed, whose await opens it again
            await outcome

    element.on("click", clicked, js_handler="() => emit(rtcp.token)")


def remember_click(token_ns: object) -> None:
    """Judge the commands of the running code by the token that its page had at the click."""
    CLICK.set(Click(token_ns if type(token_ns) is int else 0, time.monotonic_ns()))


def table(headings: Sequence[Heading], caption: str, kind: str = "") -> Element:
    """Return the body of a new table, which the caller fills with rows.

    `kind`: `numbers`, columns align to the right; `stack`, on a narrow screen each row is a block.
    """
    with ui.element("div").classes("wide").props("tabindex=0 role=region") as region:
        region.props["aria-label"] = caption
        with ui.element("table").classes(f"figures {kind}"):
            text("caption", caption, "visually-hidden")
            with ui.element("thead"), ui.element("tr"):
                for heading in headings:
                    with ui.element("th").props("scope=col"):
                        with_unit(*((heading, "") if isinstance(heading, str) else heading))
            return ui.element("tbody")


def row(body: Element, first: str, *cells: str | tuple[float, str, int]) -> Element:
    """Add a row of text, or of values with unit and digits, and return it; its first cell is its heading."""
    with body, ui.element("tr") as line:
        text("th", first, scope="row")
        for cell in cells:
            if isinstance(cell, str):
                text("td", cell)
            else:
                with ui.element("td"):
                    quantity(*cell)
    return line


def tool_pose() -> None:
    """Show the pose of the tool, live."""
    with table(("", *POSE), "Pose of the tool", "numbers pose"), ui.element("tr"):
        text("th", "pose", scope="row")
        for at, (_, unit) in enumerate(POSE):
            live_value(f"tool.{at}", 4, unit=unit)


def no_platform() -> None:
    """Show on a page that needs a platform that none runs."""
    text("p", "No platform runs: start one on the tab Start.")


def no_geometry() -> None:
    """Show in the place of the arm that its geometry is unknown."""
    text("p", "The arm has no geometry (the key kinematics is missing): joints alone move, no pose is known.")


class ProgramSession:
    """A program on a page: the file that is open, the step that is next, its run. It outlives a change of the tab."""

    def __init__(self) -> None:
        self.file: ProgramFile | None = None
        self.at = 0
        """Step that is next, from 0."""
        self.running = False
        self.notice = ""
        self.changed: Callable[[], None] = lambda: None
        """Redraws the tab, where it is open."""
        self._go = threading.Event()
        self._ended = False

    def begin(self) -> None:
        """A run begins."""
        self.running, self._ended = True, False
        self._go.set()

    def end(self) -> None:
        """The run has ended, or has to."""
        self.running, self._ended = False, True

    @property
    def paused(self) -> bool:
        """Whether the next step waits for `resume`."""
        return self.running and not self._go.is_set()

    def pause(self) -> None:
        """Begin no further step."""
        self._go.clear()

    def resume(self) -> None:
        """Go on with the steps."""
        self._go.set()

    def between(self) -> None:
        """Wait in the thread of the run while it is paused; raises Refused where it has ended meanwhile."""
        while not self._go.wait(_PAUSE_S) and not self._ended:
            pass
        if self._ended:
            raise RtcpError("refused", "the program was ended: its page or STOP has ended the command")


class View:
    """One open page of the panel, to the functions that build it."""

    def __init__(self, live: Live, page: Page, client: Client) -> None:
        self.live = live
        self.page = page
        self.arm: ArmView | None = None
        self.leaving: list[Callable[[], None]] = []
        """Called by `leave`."""
        self.kept: dict[str, Any] = {}
        """State of each tab while another one is open, by name."""
        self._visit = 0
        """Number of the page of the panel that is shown."""
        self._client = client
        page.notify, page.asked = self.warn, self._ask

    def leave(self) -> None:
        """Called when another page is shown, or this one closes."""
        self._visit += 1
        while self.leaving:
            self.leaving.pop()()

    @contextlib.contextmanager
    def _visited(self) -> Iterator[None]:
        """End a handler whose page is left while it awaits inside: it would draw on removed elements."""
        visit = self._visit
        try:
            yield
        finally:
            if visit != self._visit:
                raise asyncio.CancelledError

    def say(self, message: str) -> None:
        """Show a success."""
        with self._client:
            ui.notify(message, type="positive", position=_ABOVE, timeout=3000)

    def warn(self, message: str) -> None:
        """Show a problem."""
        with self._client:
            ui.notify(message, type="negative", position=_ABOVE, timeout=10_000, close_button="Close", multi_line=True)

    async def act(
        self, command: Callable[[AsyncRobot], Awaitable[T]], done: str = "", *, instead: bool = False
    ) -> T | None:
        """Carry out a command; show its outcome. `instead`: stop the motion of this page first."""
        return await self._act(self.live.command(self.page, command, instead), done)

    async def act_in_cell(
        self, command: Callable[[AsyncCell], Awaitable[T]], done: str = "", *, instead: bool = False
    ) -> T | None:
        """Carry out a command of all arms of the cell, as `act`."""
        return await self._act(self.live.command_cell(self.page, command, instead), done)

    async def _act(self, command: Awaitable[T], done: str) -> T | None:
        with self._visited():
            return await self._show_outcome(command, done)

    async def act_beyond_visit(self, command: Callable[[AsyncRobot], Awaitable[T]]) -> T | None:
        """Carry out a command as `act`; its handler continues when its tab is left, and draws nothing of its own."""
        return await self._show_outcome(self.live.command(self.page, command, False), "")

    async def _show_outcome(self, command: Awaitable[T], done: str) -> T | None:
        try:
            answer = await command
        except HeldByAnother as holding:
            self._offer_to_take_over(holding.holder)
        except EndedOnPurpose:
            pass  # the header says that the arm has stopped
        except (RtcpError, OSError) as error:
            self.warn(str(error))
        else:
            if done:
                self.say(done)
            return answer
        return None

    async def set_speed_override(self, fraction: float) -> None:
        """Set the fraction of its speed at which the arm moves, also while this page moves it."""
        await self._act(self.live.set_speed_override(self.page, fraction), "")

    async def pause(self) -> None:
        """Pause the motion under way, and the program of this page before its next step."""
        session = self.kept.get("program")
        if isinstance(session, ProgramSession) and session.running:
            session.pause()
            # A motion that is being planned begins to move later.
            while session.paused:
                if self.live.moves_unpaused:
                    await self._pause_motion()
                await asyncio.sleep(_PAUSE_S)
        else:
            await self._pause_motion()

    async def _pause_motion(self) -> None:
        try:
            await self.live.pause(self.page)
        except RtcpError as error:
            self.warn(error.message)

    async def go_on(self) -> None:
        """Continue the motion, and the program of this page."""
        session = self.kept.get("program")
        if not isinstance(session, ProgramSession) or not session.paused:
            await self._act(self._resume(), "")
        elif self.live.status is None or self.live.status.state is not State.MOVING:
            if self.claim():
                session.resume()
        elif await self._act(self._resume(), ""):
            session.resume()

    async def _resume(self) -> bool:
        await self.live.resume(self.page)
        return True

    async def query(self, query: Callable[[AsyncRobot], Awaitable[T]]) -> T:
        """Send a query, which commands nothing; raises RtcpError."""
        with self._visited():
            return await self.live.view(query)

    async def ask(self, query: Callable[[AsyncRobot], Awaitable[T]]) -> T | None:
        """Return the answer of `query`; None: its error is shown."""
        try:
            return await self.query(query)
        except RtcpError as error:
            self.warn(error.message)
            return None

    async def halt(self) -> None:
        """Stop every motion."""
        if problem := await self.live.halt():
            self.warn(problem)
        else:
            self.say("The arm holds" if self.live.partners.cell is None else "All arms hold")

    def may_command(self) -> bool:
        """Return whether this person is an operator; else show that they are not."""
        try:
            self.page.check_may_command()
        except RtcpError as error:
            self.warn(error.message)
            return False
        return True

    def claim(self) -> bool:
        """Make this page the operator's; return False after showing why it cannot be."""
        try:
            self.live.check_click(self.page)
            self.live.claim(self.page)
        except HeldByAnother as holding:
            self._offer_to_take_over(holding.holder)
            return False
        except RtcpError as error:
            self.warn(error.message)
            return False
        return True

    async def rtcp(self, *arguments: str, show: Callable[[str], None] | None = None) -> tuple[int, str]:
        """Run the command `rtcp`; return its exit code and output; `show` gets each line. For operators alone."""
        if not self.may_command():
            return 3, "this is for operators"
        visit = self._visit
        with self._visited():
            return await self._run(arguments, lambda line: show(line) if show and visit == self._visit else None)

    @staticmethod
    async def _run(arguments: Sequence[str], show: Callable[[str], None]) -> tuple[int, str]:
        async with _COMMANDS:
            process = await asyncio.create_subprocess_exec(
                sys.executable, "-m", "rtcp.cli", *arguments, limit=_LONGEST_LINE,
                stdin=asyncio.subprocess.DEVNULL, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.STDOUT,
            )  # fmt: skip
            assert process.stdout is not None
            lines = []
            async for line in process.stdout:
                lines.append(line.decode(errors="replace").rstrip())
                show(lines[-1])
            return await process.wait(), "\n".join(lines)

    def _offer_to_take_over(self, holder: str) -> None:
        async def take() -> None:
            dialog.close()
            self.say(f"{holder} is asked; without an answer the arm is yours in {TAKE_OVER_S:g} s")
            try:
                has_it = await self.live.take_over(self.page)
            except (HeldByAnother, RtcpError) as error:
                self.warn(str(error))
                return
            if has_it:
                self.say("You operate the arm")
            else:
                self.warn(f"{holder} keeps the arm")

        with self.question(f"{holder} operates the arm", "Whoever takes over stops what moves.") as dialog:
            button("Ask to take over", take)
            button("Leave it", dialog.close, plain=True)

    def _ask(self, who: str, answer: asyncio.Future[bool]) -> None:
        def give(value: bool) -> None:
            dialog.close()
            if not answer.done():
                answer.set_result(value)

        note = f"Without an answer it changes hands in {TAKE_OVER_S:g} s. What moves is stopped first."
        with self.question(f"{who} asks for the arm", note) as dialog:
            button("Give it", lambda: give(True))
            button("Keep it", lambda: give(False), plain=True)
        answer.add_done_callback(lambda _: dialog.close())

    @contextlib.contextmanager
    def question(self, title: str, note: str) -> Iterator[ui.dialog]:
        """Ask the person, with the buttons that are made inside."""
        with self._client, ui.dialog().props(_BESIDE) as dialog, ui.card():
            dialog.props["aria-label"] = title
            text("h2", title)
            text("p", note)
            with ui.element("div").classes("buttons"):
                yield dialog
        dialog.on("hide", dialog.delete)
        dialog.open()
