"""The arm that the drives of a segment turn: its weight at each joint, and what pushes at the tool do to them.

Each drive's model knows its own joint alone. Here are the torques that depend on all of them: the links' weights, and
a force and torque at the tool through the transpose of the Jacobian.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from kinematics.forward import frames
from kinematics.gravity import gravity_torques
from kinematics.jacobian import jacobian_columns
from kinematics.model import JOINTS, ArmModel
from rtcp.config.document import read
from rtcp.config.loader import load_kinematics
from rtcp.config.segment import SegmentConfig
from rtcp.virtual.device import DeviceModel
from rtcp.virtual.models.servo import ServoAxis

PERIOD = 5_000_000
"""ns between two looks at where the joints are: at 0.5 rad/s a weight changes by less than 0.1 Nm."""
_SAME_RAD = 1e-4
"""Joints that turned by less feel what they felt."""


class VirtualArm:
    """Adds to each drive's `external_torque` what the arm and pushes at its tool exert, Nm.

    Args:
        model: the geometry; without masses of its links it has no weight.
        drives: of joints 1 to 6.
    """

    def __init__(self, model: ArmModel, drives: Sequence[ServoAxis]) -> None:
        self._model = model
        self._mechanics = [drive.mechanics for drive in drives]
        self._wrench = [0.0] * 6
        self._given = [0.0] * JOINTS
        self._at: list[float] | None = None
        self._next = 0
        self.update(0)

    def push(self, wrench: Sequence[float]) -> Callable[[int], None]:
        """Push the tool from now on, also where others push; return what ends it.

        Args:
            wrench: force, N, and torque, Nm, along the axes of the base: x, y, z, rx, ry, rz.
        """
        self._add(wrench, 1.0)
        return lambda _: self._add(wrench, -1.0)

    def _add(self, wrench: Sequence[float], sign: float) -> None:
        self._wrench = [whole + sign * part for whole, part in zip(self._wrench, wrench, strict=True)]
        self._at = None
        self._next = 0

    def update(self, now: int) -> None:
        """Let the joints feel what belongs to where they are; does nothing most of the time."""
        if now < self._next:
            return
        self._next = now + PERIOD
        q = [mechanics.position for mechanics in self._mechanics]
        if self._at is not None and all(abs(a - b) < _SAME_RAD for a, b in zip(q, self._at, strict=True)):
            return
        self._at = q
        model = self._model
        torques = [-torque for torque in gravity_torques(model, q)] if model.links else [0.0] * JOINTS
        if any(self._wrench):
            for i, column in enumerate(jacobian_columns(frames(model, q))):
                torques[i] += sum(a * b for a, b in zip(column, self._wrench, strict=True))
        # What others have set, a test or a collision, stays.
        for mechanics, torque, before in zip(self._mechanics, torques, self._given, strict=True):
            mechanics.external_torque += torque - before
        self._given = torques


def make_arm(config: SegmentConfig, devices: Sequence[DeviceModel]) -> VirtualArm | None:
    """Return the arm of a segment's file; None: it names none, or one without geometry.

    Raises:
        ConfigError: of the arm's file.
    """
    drives: list[ServoAxis] = [servo for device in devices for servo in device.servos]
    file = config.arm
    if file is None or len(drives) < JOINTS or "kinematics" not in read(file).data:
        return None
    return VirtualArm(load_kinematics(file), drives[:JOINTS])
