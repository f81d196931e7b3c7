"""The tests' own reading of what goes over the bus: bytes by the facts' table, the arm's bodies by its DH table.

Process data are 15 bytes a drive, 10000 counts to the rad, rad/s and Nm. Nothing of ours decodes or computes here.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import Any

from rtcp.config import default_config, load
from rtcp.config.model import ArmConfig
from rtcp.testing.sessions.checker import (
    ENABLE_OPERATION,
    OPERATION_ENABLED,
    STATE_MASK,
    Bounds,
    FrameChecker,
    JointReading,
    Reading,
    Sample,
    Workspace,
)
from rtcp.testing.sessions.commander import Commander
from tests.arm_geometry import L2, L3, L4, L5, box_gaps, depth, own_gap, points

WIRE = struct.Struct("<Hiiib")
"""Controlword or statusword, position, velocity, torque, mode: the same both ways."""
COUNTS = 10_000.0
PERIODS_US = (1000, 1250, 1500, 2000)
REACH = (L2 + L3 + L4 + L5, L2 + L3 + L4 + L5, L3 + L4 + L5, L5, L5, 0.0)
"""m a rad: how far a point of the arm moves at most when the joint turns."""


@cache
def configuration() -> ArmConfig:
    """The default arm."""
    return load(default_config())


def with_start(config: ArmConfig, period_us: float, mode: Any) -> ArmConfig:
    """Return the configuration with another cycle and drive mode."""
    return replace(config, cycle=replace(config.cycle, period_us=period_us), drive_mode=mode, control_mode="joint")


def decode(sent: bytes, received: bytes) -> Sample:
    """Decode outputs and inputs of a drive."""
    control, position, velocity, torque, mode = WIRE.unpack(sent)
    status, actual, _, _, shown = WIRE.unpack(received)
    return Sample(
        control & ENABLE_OPERATION == ENABLE_OPERATION, position / COUNTS, velocity / COUNTS, torque / COUNTS, mode,
        status & STATE_MASK == OPERATION_ENABLED, actual / COUNTS, shown,
    )  # fmt: skip


def deepest(bounds: Bounds, q: Sequence[float]) -> float:
    """Return how deep the arm is in what it keeps clear of, m."""
    inner = [max(-gap for gap in box_gaps(q, box)) for box in bounds.keep_out]
    if bounds.box is not None:
        inner.append(-depth(points(q)[0], bounds.box))
    return max([*inner, -own_gap(q)])


def is_free(bounds: Bounds, q: Sequence[float], clearance: float = 0.0) -> bool:
    """Whether all bodies are off each keep-out box and each other, and the tool inside the box, by `clearance` m."""
    return deepest(bounds, q) < -clearance


def reading(slots: Sequence[int] = range(1, 7)) -> Reading:
    """Return the reading; `slots`: index of each joint's slave."""
    count = 1.0 / COUNTS
    return Reading([JointReading(slot, decode, (count, count, count)) for slot in slots], [Workspace(deepest, REACH)])


def checker_of(config: ArmConfig, period_s: float, expected_wkc: int) -> FrameChecker:
    """Return a checker of the arm's frames."""
    slots = {slave.name: slot for slot, slave in enumerate(config.slaves)}
    return FrameChecker(
        Bounds.configured(config), period_s, reading([slots[joint.slave] for joint in config.joints]), expected_wkc
    )  # fmt: skip


def commander_of(config: ArmConfig, seed: int, positions: Sequence[float]) -> Commander:
    """Return a commander whose frames are read here."""
    return Commander(config, seed, positions, reading())
