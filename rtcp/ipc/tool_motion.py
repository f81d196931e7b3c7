"""The motion of the tool: fields that a reader computes from a cycle record, beside those that the loop publishes.

In the loop this would add 164 to the 232 thousand instructions of a holding cycle (`benchmarks/instructions.py hold
--source`); a reader has the time.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from kinematics.forward import forward_batch, twist_batch
from kinematics.model import ArmModel
from kinematics.pose import rpy_batch
from rtcp.ipc.observer import numpy_fields, record_type
from rtcp.ipc.schema import Field, RecordSchema

POSE = ("tool_x", "tool_y", "tool_z", "tool_rx", "tool_ry", "tool_rz")
VELOCITY = ("tool_vx", "tool_vy", "tool_vz", "tool_wx", "tool_wy", "tool_wz")
_DESCRIPTIONS = ("Measured position of the tool.", "Measured angle of the tool, R = Rx Ry Rz.",
                 "Measured velocity of the tool.", "Measured angular velocity of the tool.")  # fmt: skip
FIELDS = tuple(
    Field(name, "float64", unit, f"{description[:-1]}, base frame.", part="tool")
    for at, (unit, description) in enumerate(zip(("m", "rad", "m/s", "rad/s"), _DESCRIPTIONS, strict=True))
    for name in (*POSE, *VELOCITY)[3 * at : 3 * at + 3]
)
_SOURCES = {"actual_position", "actual_velocity", "tool"}


class ToolMotion:
    """Adds the fields of the tool in use to cycle records; of an arm without geometry it adds none.

    Args:
        models: of the arm, one a tool; none: its geometry is unknown.
        schema: of the records.

    Attributes:
        schema: of the records with these fields.
    """

    def __init__(self, models: Sequence[ArmModel], schema: RecordSchema) -> None:
        self._models = models if set(schema.names) >= _SOURCES else ()
        self.schema = RecordSchema((*schema.fields, *FIELDS)) if self._models else schema
        self._kind = np.dtype([*record_type(schema).descr, *numpy_fields(RecordSchema(FIELDS))])

    def add(self, records: npt.NDArray[np.void]) -> npt.NDArray[np.void]:
        """Return records of the ring, shape (n,), with the fields of the tool."""
        if not self._models:
            return records
        before = records.dtype.itemsize
        extended = np.empty(len(records), self._kind)
        if len(records):
            rows = extended.view(np.uint8).reshape(len(records), -1)
            rows[:, :before] = np.ascontiguousarray(records).view(np.uint8).reshape(len(records), -1)
            motion = np.hstack(self.of(records["actual_position"], records["actual_velocity"], records["tool"]))
            rows[:, before:] = np.ascontiguousarray(motion, "<f8").view(np.uint8)
        return extended

    def of(
        self, q: npt.NDArray[np.float64], velocity: npt.NDArray[np.float64], tool: npt.NDArray[np.integer[Any]]
    ) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Return poses and velocities of the tool, both (n, 6), at joint positions, rad, and velocities, rad/s, (n, 6).

        NaN where a joint's value is not finite, or the arm has no tool of the number.
        """
        poses, twists = np.full((2, len(q), 6), np.nan)
        known = np.isfinite(np.hstack([q, velocity])).all(axis=1)
        for number, model in enumerate(self._models):
            rows = np.flatnonzero(known & (tool == number))
            if len(rows):
                positions, rotations = forward_batch(model, q[rows])
                poses[rows] = np.hstack([positions, rpy_batch(rotations)])
                twists[rows] = twist_batch(model, q[rows], velocity[rows])
        return poses, twists
