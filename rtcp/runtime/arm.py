"""The joints as one: their drives, the generator of their set-points, the law of the mode, the guard."""

from __future__ import annotations

from collections.abc import Sequence

from rtcp.config.model import ArmConfig
from rtcp.devices.cia402 import Cia402Drive, DriveGoal, DriveState
from rtcp.fieldbus.bus import ProcessData
from rtcp.motion.generator import JointGenerator, Motion
from rtcp.motion.guard import Guard
from rtcp.motion.modes import DriveMode, ModeLaw, PositionLaw, TorqueLaw, VelocityLaw

MODES = {"csp": DriveMode.CSP, "csv": DriveMode.CSV, "cst": DriveMode.CST}
WITH_TORQUE = frozenset({DriveState.OPERATION_ENABLED, DriveState.QUICK_STOP_ACTIVE, DriveState.FAULT_REACTION_ACTIVE})
RESTING = frozenset({DriveState.SWITCH_ON_DISABLED, DriveState.READY_TO_SWITCH_ON, DriveState.SWITCHED_ON})
"""Drive states without torque and without a fault."""
_ENABLED = DriveState.OPERATION_ENABLED
_HOLDING = (DriveState.OPERATION_ENABLED, DriveState.QUICK_STOP_ACTIVE)
"""Drive states with torque: the target stands."""
_STILL_RAD_S = 0.01
RANGE_MARGIN_RAD = 0.02
"""So far beyond its range a joint may stand and still be enabled, to be brought back to the edge: an overshoot in CST
must not leave an arm that no command can move."""


class Arm:
    """What a cycle does with the joints.

    Args:
        config: joints, limits, cycle, the mode at the start.
        drives: one a joint, in the order of the joints, with the index of its slave.
    """

    def __init__(self, config: ArmConfig, drives: Sequence[tuple[int, Cia402Drive]]) -> None:
        joints = config.joints
        period_s = config.cycle.period_us * 1e-6
        self.drives = [drive for _, drive in drives]
        self._pairs = list(drives)
        self.low = [joint.position.min for joint in joints]
        self.high = [joint.position.max for joint in joints]
        self.fastest = max(joint.velocity for joint in joints)
        self.generator = JointGenerator(
            period_s,
            [joint.velocity for joint in joints],
            [joint.acceleration for joint in joints],
            [joint.jerk for joint in joints],
        )
        self.guard = Guard(joints, period_s)
        self._laws: dict[DriveMode, ModeLaw] = {
            DriveMode.CSP: PositionLaw(),
            DriveMode.CSV: VelocityLaw(joints),
            DriveMode.CST: TorqueLaw(joints, period_s),
        }
        self.set_mode(MODES[config.mode])

    def set_mode(self, mode: DriveMode) -> None:
        """Let the drives change to `mode`; only at standstill."""
        self.mode = mode
        self._law = self._laws[mode]
        self._law.start(self.drives)
        for drive in self.drives:
            drive.mode = mode

    def decode(self, data: ProcessData) -> None:
        """Take the drives' inputs."""
        for slot, drive in self._pairs:
            drive.decode(data.input(slot))

    def encode(self, data: ProcessData) -> None:
        """Hand over the drives' outputs."""
        for slot, drive in self._pairs:
            data.set_output(slot, drive.encode())

    def lead(self, goal: DriveGoal) -> None:
        """Lead every drive one step towards `goal`."""
        for drive in self.drives:
            drive.advance(goal)

    def begin(self) -> None:
        """Hold where the joints are, from standstill without torque; `follow` has seen to that each cycle."""
        self.generator.latch(self.generator.position)

    def hold_target(self) -> None:
        """Hold at the set-point that was made last."""
        self.generator.latch(self.generator.position)

    def follow(self) -> None:
        """Let set-point and guard follow the drives that have no torque: their target is where they are.

        A joint that stands outside its range is followed to the edge of it only; it is not enabled there.
        """
        position, latch = self.generator.position, self.guard.latch
        for i, drive in enumerate(self.drives):
            if drive.state not in _HOLDING:
                low, high, here = self.low[i], self.high[i], drive.position
                position[i] = drive.target_position = high if here > high else low if here < low else here
                latch(i, drive.target_position)

    def command(self) -> None:
        """Write the targets of this cycle: set-point, law, guard."""
        generator, drives = self.generator, self.drives
        self._law.update(generator.position, generator.velocity, drives)
        self.guard.check(drives)

    def first_not_enabled(self) -> int:
        """Return the first joint whose drive is not enabled, or -1."""
        for axis, drive in enumerate(self.drives):
            if drive.state is not _ENABLED:
                return axis
        return -1

    def first_with_torque(self) -> int:
        """Return the first joint whose drive gives torque: enabled, in a quick stop or reacting to a fault; or -1."""
        for axis, drive in enumerate(self.drives):
            if drive.state in WITH_TORQUE:
                return axis
        return -1

    def first_in_another_mode(self) -> int:
        """Return the first joint whose drive does not show the commanded mode, or -1."""
        mode = self.mode
        for axis, drive in enumerate(self.drives):
            if drive.mode_display != mode:
                return axis
        return -1

    def first_in_fault(self) -> int:
        """Return the first joint whose drive is in fault, or -1."""
        for axis, drive in enumerate(self.drives):
            if drive.state is DriveState.FAULT:
                return axis
        return -1

    def first_moving(self) -> int:
        """Return the first joint that does not stand still, or -1."""
        for axis, drive in enumerate(self.drives):
            if abs(drive.velocity) > _STILL_RAD_S:
                return axis
        return -1

    def first_outside(self) -> int:
        """Return the first joint that stands outside its range, or -1."""
        for axis, drive in enumerate(self.drives):
            here = drive.position
            if not self.low[axis] - RANGE_MARGIN_RAD <= here <= self.high[axis] + RANGE_MARGIN_RAD:
                return axis
        return -1

    def first_not_resting(self) -> int:
        """Return the first joint whose drive is in fault or enabled, or -1."""
        for axis, drive in enumerate(self.drives):
            if drive.state not in RESTING:
                return axis
        return -1

    @property
    def still(self) -> bool:
        """Whether the set-points stand still."""
        return self.generator.motion is Motion.HOLD
