"""The shipped layouts against the existing topics and fields."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from typing import Any
from xml.etree import ElementTree

from rtcp.config import default_config
from rtcp.ipc.schema import PER_JOINT, arm_schema

LAYOUTS = default_config().parent / "layouts"
FIELDS = {f"/cycle {name}" for name in arm_schema(6).names} | {
    f"/cycle {name}[{j}]" for name in PER_JOINT for j in range(6)
}
MACHINE = {f"/machine {name}" for name in ("state", "drive_mode", "control_mode")}


def values(node: Any, key: str) -> Iterator[Any]:
    """Yield what stands at `key` anywhere in a JSON value."""
    for inner in node.values() if isinstance(node, dict) else node if isinstance(node, list) else ():
        yield from values(inner, key)
    if isinstance(node, dict) and key in node:
        yield node[key]


def test_the_layout_of_foxglove_shows_panels_and_fields_that_exist() -> None:
    layout = json.loads((LAYOUTS / "foxglove.json").read_text())
    panels = layout["configById"]
    placed = [value for key in ("first", "second") for value in values(layout["layout"], key) if isinstance(value, str)]
    assert sorted(placed) == sorted(panels)
    shown = [value.replace(".", " ", 1) for value in values(panels, "value")]
    assert len(shown) == 24
    assert set(shown) <= FIELDS | MACHINE
    assert set(panels["3D!arm"]["topics"]) == {"/robot_description", "/tf"}
    assert panels["RosOut!log"]["topicToRender"] == "/log"


def test_the_layout_of_plotjuggler_shows_fields_that_exist() -> None:
    root = ElementTree.parse(LAYOUTS / "plotjuggler.xml").getroot()
    curves = [re.sub(r"^(/cycle)/", r"\1 ", curve.get("name", "")) for curve in root.iter("curve")]
    assert len(curves) == 36
    assert set(curves) <= FIELDS
    for splitter in root.iter("DockSplitter"):
        assert splitter.get("count") == str(len(splitter)) == str(len(splitter.get("sizes", "").split(";")))
