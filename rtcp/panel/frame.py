"""The frame around the tabs: the arm in space, its state and next step, its commands, its operator, STOP.

It is built once for a page of a browser; the tabs are exchanged inside it.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from nicegui import ui

from rtcp.api import AsyncRobot, Feed, RtcpError
from rtcp.panel.arm_view import ArmView
from rtcp.panel.page import ENABLED, View, button, live_value, no_geometry, remember_click, text
from rtcp.panel.pages.start import start_virtual

_UNITS = {"Angles": ("rad", {"rad": "rad", "deg": "degrees"}), "Lengths": ("m", {"m": "m", "mm": "mm"})}
"""Label -> unit of the interfaces, and those that a browser may choose."""
_FOLLOW_S = 0.5


@dataclass(frozen=True)
class Tab:
    """One of the pages; `build` makes it."""

    name: str
    build: Callable[[View], Any]


class Frame:
    """The frame of one page.

    Args:
        view: the page.
        tabs: by their paths.
        asks: whether visitors log in.
    """

    def __init__(self, view: View, tabs: Mapping[str, Tab], asks: bool) -> None:
        self._view, self._live, self._tabs = view, view.live, tabs
        self._feed: Feed | None = None
        """Feed of the platform for which the tab was built."""
        self._path = "/"
        self._drawn: object = None
        """What the arm view shows."""
        self._header()
        with ui.element("div").props("id=frame"):
            with ui.element("section").props('id=side aria-label="The arm and its commands"'):
                _commands(view)
                _override(view)
                self._space = ui.element("div").props("id=space")
            with ui.element("div").props("id=work"):
                with ui.element("nav").props('id=menu aria-label="Tabs"'):
                    for path, tab in tabs.items():
                        ui.link(tab.name, path).props["data-path"] = path
                with ui.element("main").props("id=main"):
                    _first_steps(view)
                    self._place = ui.sub_pages({path: self._builder(path) for path in tabs}, show_404=False)
                    self._place.classes("page")
                    _footer(asks)
        text("div", "", id="notes", role="status", **{"aria-live": "polite"})
        self._draw()
        ui.timer(_FOLLOW_S, self._follow)

    def _header(self) -> None:
        with ui.element("header").props("id=head") as head:
            head.props["data-page"] = self._view.page.key
            live_value("state", tag="span").props("role=status aria-live=polite")
            with ui.element("div").props("id=says role=status"):
                live_value("message", tag="span")
                live_value("next", tag="b")
            with ui.element("div").props("id=who"):
                text("span", "", id="operator")
                text("a", "", id="alarmed", href="/alarms", hidden="")
            with text("button", "STOP", "stop", type="button", **{"data-stop": ""}):
                text("small", "not the emergency stop")
        lost = "No connection to the panel: what this page moved has been stopped."
        text("div", lost, id="lost", role="alert", hidden="")
        text("div", "", id="old", role="status", hidden="")

    # -- tabs ---------------------------------------------------------------------------------------------------------

    def _builder(self, path: str) -> Callable[[], Any]:
        async def build() -> None:
            view = self._view
            view.page.scope = None
            view.leave()
            if view.arm is not None:
                view.arm.preview([], 0.0)  # planned on the tab that is left
            self._feed, self._path = self._known_feed(), path
            tab = self._tabs[path]
            ui.page_title(f"{tab.name} - rtcp panel")
            ui.run_javascript(f"rtcp.tab('{path}')")
            with ui.element("section").classes("page"):
                try:
                    if inspect.isawaitable(pending := tab.build(view)):
                        await pending
                except RtcpError as error:
                    text("p", error.message, "bad")

        return build

    def _known_feed(self) -> Feed | None:
        """Return the feed once the status is known too: a tab needs both."""
        return None if self._live.status is None else self._live.feed

    def _follow(self) -> None:
        """Draw the arm and rebuild the tab for a platform that has begun to run."""
        self._draw()
        feed = self._known_feed()
        if feed is not None and feed is not self._feed:
            self._feed = feed
            if self._path != "/":  # the tab Start reports the start itself
                self._place.refresh()

    def _draw(self) -> None:
        """Draw the arm that runs; it stays when tabs change."""
        view, live = self._view, self._live
        config, own, partners = shows = (live.config, live.partners.own, live.partners.members)
        tool = "" if live.status is None else str(live.status.raw["tool_name"])
        if config is None or not tool or self._drawn == (shows, tool):
            return
        self._drawn = shows, tool
        self._space.clear()
        view.arm = None
        with self._space:
            if config.arm is None:
                no_geometry()
            else:
                view.arm = ArmView(config, tool, own, partners)


def _commands(view: View) -> None:
    async def rest_pose() -> None:
        async def move() -> None:
            dialog.close()
            await view.act(lambda robot: robot.move_to_rest_pose(), "The arm is in its rest pose")

        with view.question(
            "Move the arm to its rest pose?", "All joints move there at once, from where they are."
        ) as dialog:
            button("Move to rest pose", move, when="holding")
            button("Leave it", dialog.close, plain=True)

    with ui.element("div").classes("commands").props('role=group aria-label="Machine"'):
        for label, handler, when in (
            ("Enable", lambda: view.act(lambda robot: robot.enable(), "The drives hold the arm"), "ready"),
            (
                "Disable",
                lambda: view.act(_disable, "The drives are without torque", instead=True),
                ENABLED + " stopped_by_limit",
            ),
            ("Reset", lambda: view.act(lambda robot: robot.reset(), "Reset"), "fault emergency_stop stopped_by_limit"),
            ("Halt", view.halt, "moving homing"),
            # Two buttons, each with one meaning: a second press of the first starts nothing.
            ("Pause", view.pause, "moving holding"),
            ("Go on", view.go_on, "moving holding"),
            ("Rest pose", rest_pose, "holding"),
        ):
            button(label, handler, when=when, plain=True).props["data-do"] = label.lower()


async def _disable(robot: AsyncRobot) -> None:
    await robot.disable()


def _override(view: View) -> None:
    """Show the speed override, which a slider sets, and the joystick's mode."""

    async def changed(event: Any) -> None:
        token_ns, percent = event.args
        remember_click(token_ns)
        await view.set_speed_override(float(percent) / 100.0)

    with ui.element("div").props("id=override"):
        slider = ui.element("input")
        heading = text("label", "Override", **{"for": slider.html_id})
        heading.move(target_index=0)
        slider.props.update({"type": "range", "min": "1", "max": "100", "step": "1", "data-override": ""})
        slider.on("change", changed, js_handler="(event) => emit([rtcp.token, +event.target.value])")
        live_value("speed_override", tag="output").props["data-suffix"] = " %"
        with ui.element("div").props("id=joystick hidden"):
            text("span", "Joystick ")
            live_value("joystick", tag="b")


def _first_steps(view: View) -> None:
    """Guide a person while no platform runs; `panel.js` shows the steps, and which are done."""
    with ui.element("section").props('id=lead hidden aria-label="First steps"'):
        with ui.element("ol"):
            with ui.element("li").props("data-step=start"):
                text("span", "Start the virtual arm: software drives on a virtual cable, no hardware.")
                button("Start the virtual arm", lambda: start_virtual(view), when="off")
            with ui.element("li").props("data-step=enable"):
                text("span", "Press Enable, above or beside the picture: the drives then hold the arm.")
            with ui.element("li").props("data-step=move"):
                text("span", "Move it: hold a pad")
                with ui.element("span").classes("elsewhere"):
                    text("span", " on the tab ")
                    text("a", "Jog", href="/jog").props["aria-label"] = "Pads that move the arm"
        text("button", "Hide these steps", "act plain", type="button", **{"data-lead-end": ""})


def _footer(asks: bool) -> None:
    with ui.element("footer").props("id=foot"):
        for label, (unit, names) in _UNITS.items():
            with ui.element("div").classes("field"):
                control = ui.element("select")
                control.props["data-units"] = unit
                text("label", label, **{"for": control.html_id}).move(target_index=0)
            with control:
                for value, name in names.items():
                    text("option", name).props["value"] = value
        if asks:
            with ui.element("form").props("method=post action=/logout"):
                text("button", "Log out", "act plain")
