"""Names of joints, slaves and boxes as sentences need them."""

from __future__ import annotations

from typing import NamedTuple

from rtcp.config.model import ArmConfig
from rtcp.ipc.codes import Code
from rtcp.ipc.stops import KEYS, Rung, rungs


class Matter(NamedTuple):
    """What a refusal or an event is about."""

    axis: int
    value: float
    limit: float


def number(value: float) -> str:
    """Return a number as sentences show it."""
    return f"{value:.6g}"


class Naming:
    """Puts numbers of joints and boxes into words.

    Args:
        config: names the joints and the file in which limits stand.
    """

    def __init__(self, config: ArmConfig) -> None:
        self.config = config
        self.rungs = rungs(config.stops)
        """The rung of the ladder of stops that each event takes."""

    @property
    def file(self) -> str:
        """The configuration's file, without its folder."""
        return self.config.source.name or "the configuration"

    def joint(self, axis: int) -> str:
        """Return the name of a joint."""
        joints = self.config.axes
        return joints[axis].name if 0 <= axis < len(joints) else f"joint {axis + 1}"

    def key(self, axis: int) -> str:
        """Return where a joint stands in the file."""
        return f"joints[{axis}]" if axis < len(self.config.joints) else "gripper.joint"

    def slave(self, position: int) -> str:
        """Return the name of the slave at `position`, from 1."""
        slaves = self.config.slaves
        return slaves[position - 1].name if 1 <= position <= len(slaves) else "not configured"

    def stop(self, code: Code, then: str = "") -> str:
        """Return the rung that an event takes, what comes `then`, and the key that sets it, where one does."""
        key = f" (stops.{KEYS[code]} in {self.file})" if code in KEYS else ""
        return f"{self.rungs[code].words}{then}{key}"

    def end(self, code: Code) -> str:
        """Return the rung of an event after which the arm may go on by itself, and what goes on where it may not."""
        return self.stop(code) + ("" if self.rungs[code] is Rung.CONTROLLED_STOP else ", `rtcp reset` goes on")

    def box(self, which: int) -> str:
        """Return what the box number `which` is called, -1 for the one that the tool stays in, and its key."""
        boxes = self.config.cartesian.keep_out
        if 0 <= which < len(boxes):
            return f"the keep-out box {boxes[which].name} (cartesian.keep_out[{which}] in {self.file})"
        return f"the box that the tool stays in (cartesian.box in {self.file})"
