"""The arm moved by the drives of a segment: joint torques of its weight and of forces at the tool.

Each drive's model knows only its own joint. This module computes the torques that depend on all joints: the weight of
the links, and a force and torque at the tool through the transposed Jacobian.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path

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
"""Update interval, ns: at 0.5 rad/s a weight torque changes by less than 0.1 Nm."""
_SAME_RAD = 1e-4
"""Joint motion below which the torques are kept, rad."""


class VirtualArm:
    """Adds the torques of the arm's weight and of forces at its tool to each drive's `external_torque`, Nm.

    Args:
        model: the geometry; without link masses there is no weight.
        drives: of joints 1 to 6.
    """

    def __init__(self, model: ArmModel, drives: Sequence[ServoAxis]) -> None:
        self._model = model
        self._mechanics = [drive.mechanics for drive in drives]
        self._wrench = [0.0] * 6
        self._applied = [0.0] * JOINTS
        self._at: list[float] | None = None
        self._next = 0
        self.update(0)

    def push(self, wrench: Sequence[float]) -> Callable[[int], None]:
        """Apply a wrench at the tool, in addition to others; return the function that ends it.

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
        """Update the joint torques if the interval is over and a joint has moved."""
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
        # Keep torques of other origin, as of a test or a collision.
        for mechanics, torque, before in zip(self._mechanics, torques, self._applied, strict=True):
            mechanics.external_torque += torque - before
        self._applied = torques


def make_arm(config: SegmentConfig, devices: Sequence[DeviceModel]) -> VirtualArm | None:
    """Return the arm of a segment's file; None: no arm, or one without geometry.

    Raises:
        ConfigError: in the arm's file.
    """
    drives: list[ServoAxis] = [servo for device in devices for servo in device.servos]
    file = config.arm
    model = None if file is None or len(drives) < JOINTS else _model_of(file, file.stat().st_mtime_ns)
    return None if model is None else VirtualArm(model, drives[:JOINTS])


@lru_cache(maxsize=4)
def _model_of(file: Path, changed_ns: int) -> ArmModel | None:
    """Return the geometry in an arm's file; simulations of many episodes read it once."""
    return load_kinematics(file) if "kinematics" in read(file).data else None
