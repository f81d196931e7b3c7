"""The arm in space, as an element of a page: the links of its URDF, and the boxes of the limits in force."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import nicegui
from nicegui.element import Element

from kinematics.pose import Pose
from kinematics.urdf import to_urdf
from rtcp.config.cell import Base, Member
from rtcp.config.model import ArmConfig

_THREE = Path(nicegui.__file__).parent / "elements" / "scene" / "dist"
Json = dict[str, Any]


class ArmView(Element, component="static/arm_view.js", esm={"nicegui-scene": str(_THREE)}):
    """The arm, live, and its partners in a cell; `preview` shows a ghost.

    Args:
        config: the arm; its geometry must be known.
        tool: the tool in use.
        own: the arm in its cell; None: it is in none.
        partners: the others; one whose geometry is not known is not drawn.
    """

    def __init__(self, config: ArmConfig, tool: str, own: Member | None, partners: Sequence[Member]) -> None:
        super().__init__()
        model = config.model_of(tool)
        assert model is not None
        self._props["links"] = links(to_urdf(model))
        self._props["partners"] = [] if own is None else [
            {"name": partner.name, **_between(own.base, partner.base), "links": links(to_urdf(partner.config.arm))}
            for partner in partners
            if partner.config.arm is not None
        ]  # fmt: skip

    def preview(self, path: list[list[float]], duration_s: float) -> None:
        """Move a ghost along joint positions, rad; none: remove it."""
        self.run_method("preview", path, duration_s)


def _between(own: Base, partner: Base) -> Json:
    """Return the pose of a partner's base in the frame of the own one; R = Rx Ry Rz."""
    pose = _pose(own).inverse() @ _pose(partner)
    return {"position": pose.position, "rpy": pose.rpy}


def _pose(base: Base) -> Pose:
    return Pose.from_xyzrpy(*base.position, *base.rpy)


def links(urdf: str) -> list[Json]:
    """Return the links of a URDF document, each after its parent: its place in that, its joint's number and solids."""
    robot = ET.fromstring(urdf)
    joints = {_attribute(joint.find("child"), "link"): joint for joint in robot.iter("joint")}
    numbers = {
        name: at for at, name in enumerate(key for key, joint in joints.items() if joint.get("type") == "revolute")
    }
    tree = []
    for link in robot.iter("link"):
        name = link.get("name", "")
        joint = joints.get(name)
        axis = None if joint is None else joint.find("axis")
        tree.append(
            {
                "name": name,
                "parent": "" if joint is None else _attribute(joint.find("parent"), "link"),
                **_origin(joint),
                "joint": numbers.get(name, -1),
                "axis": [1.0, 0.0, 0.0] if axis is None else _numbers(axis.get("xyz", "1 0 0")),
                "visuals": [_visual(visual) for visual in link.iter("visual")],
            }
        )
    return tree


def _visual(visual: ET.Element) -> Json:
    solid = next(iter(visual.find("geometry") or []))
    size = {
        "cylinder": lambda: [float(solid.get("radius", 0)), float(solid.get("length", 0))],
        "sphere": lambda: [float(solid.get("radius", 0))],
        "box": lambda: _numbers(solid.get("size", "0 0 0")),
    }[solid.tag]()
    return {
        **_origin(visual),
        "kind": solid.tag,
        "size": size,
        "drawn": _attribute(visual.find("material"), "name") == "grey",
    }


def _origin(parent: ET.Element | None) -> Json:
    origin = None if parent is None else parent.find("origin")
    if origin is None:
        return {"xyz": [0.0] * 3, "rpy": [0.0] * 3}
    return {"xyz": _numbers(origin.get("xyz", "0 0 0")), "rpy": _numbers(origin.get("rpy", "0 0 0"))}


def _attribute(element: ET.Element | None, name: str) -> str:
    return "" if element is None else element.get(name, "")


def _numbers(text: str) -> list[float]:
    return [float(number) for number in text.split()]
