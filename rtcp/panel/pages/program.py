"""Program: a stub until `rtcp.Program` is edited and run here."""

from __future__ import annotations

from nicegui import ui

from rtcp.panel.page import View, text


def build(view: View) -> None:
    """Build the page; what it edits stands in `view.kept` while other tabs are shown."""
    text("h1", "Program")
    with ui.element("p"):
        text("span", "Motion files are checked and run on the tab ")
        ui.link("Recorder", "/recorder")
        text("span", ".")
