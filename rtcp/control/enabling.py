"""The way to Operation Enabled: target = actual until every drive is there, in the mode that was asked for.

A joint that stands a little beyond its range is then led back to the edge before anything may move the arm: a motion,
or another mode of the drives, begins with every target where its set-point is.

A drive obeys its target some frames before it shows that it does, and what it is followed to no clamp cuts: a place to
which it cannot have turned is not followed.
"""

from __future__ import annotations

from rtcp.config.model import ArmConfig
from rtcp.control.arm import Arm
from rtcp.control.failing import Failing
from rtcp.devices.cia402 import DriveState, TargetState
from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.codes import Code
from rtcp.motion.guards.output_limiter import BACK_RAD_S
from rtcp.motion.guards.supervision import Supervision

_TOLD_RAD = 0.001
"""A joint that stands less beyond its range is led back without a word: it was at the edge, and sagged as it rested."""


class Enabling:
    """Led once a cycle while the machine is in the state enabling.

    Args:
        config: how long it may take, and how many cycles a drive may say what cannot be.
        arm: the joints.
        watch: of what is measured; it begins to count anew.
        failing: where an enabling ends that does not succeed.
        blackboard: where it is told.
    """

    def __init__(
        self, config: ArmConfig, arm: Arm, watch: Supervision, failing: Failing, blackboard: Blackboard
    ) -> None:
        self._patience = round(config.enable_timeout_s / (config.cycle.period_us * 1e-6))
        self._false_cycles = config.watch.cycles
        self._false = 0
        """Cycles in a row in which a drive said that it is where it cannot be."""
        self._were_enabled = 0
        """Drives that were enabled since it began, a bit each."""
        self._all_enabled = False
        """Whether all were, in their mode: what is still to come is the way back into the range."""
        self._arm = arm
        self._watch = watch
        self._failing = failing
        self._blackboard = blackboard

    def begin(self) -> None:
        """Begin anew, in the cycle in which it is asked for."""
        self._false = self._were_enabled = 0
        self._all_enabled = False
        self._count_anew()

    def lead(self, waited: int) -> bool:
        """Do the part of a cycle in which the drives have answered; return whether all are enabled and in their range.

        Args:
            waited: cycles since it began.
        """
        arm, failing = self._arm, self._failing
        axis = arm.first_outside()
        if axis >= 0:
            failing.fail(Code.LEFT_RANGE, axis, arm.all_drives[axis].position)
            return False
        axis = arm.first_in_fault()
        if axis >= 0:
            failing.fail_drive(Code.DRIVE_FAULT, axis)
            return False
        axis = self._first_that_left()
        if axis >= 0:
            failing.fail_drive(Code.DRIVE_LEFT_ENABLED, axis)
            return False
        if self._jumps() or failing.watch_stops():
            return False
        if self._false:
            # The last targets are sent again.
            return False
        arm.lead(TargetState.ENABLED)
        arm.follow()
        arm.command()
        axis = arm.first_not_enabled()
        elsewhere = arm.first_in_another_mode() if axis < 0 else -1
        if axis < 0 and elsewhere < 0 and (arm.gripper is None or arm.gripper.enabled):
            if not self._all_enabled:
                self._all_enabled = True
                self._tell_beyond()
            if arm.first_led_back() >= 0:
                return False
            self._end()
            return True
        if waited > self._patience:
            if axis >= 0:
                failing.fail_drive(Code.ENABLE_STUCK, axis)
            else:
                failing.fail_mode(elsewhere if elsewhere >= 0 else len(arm.drives))
        return False

    def _first_that_left(self) -> int:
        """Return the first drive that was enabled since it began and is not any more, or -1."""
        for axis, drive in enumerate(self._arm.all_drives):
            if drive.state is DriveState.OPERATION_ENABLED:
                self._were_enabled |= 1 << axis
            elif self._were_enabled >> axis & 1:
                return axis
        return -1

    def _jumps(self) -> bool:
        """Count the cycles in which a drive says that it is where it cannot be; return whether they ended it."""
        arm = self._arm
        axis = arm.first_off_target()
        self._false = 0 if axis < 0 else self._false + 1
        if self._false < self._false_cycles:
            return False
        self._failing.fail(Code.POSITION_JUMPED, axis, arm.all_drives[axis].position, arm.followed_to(axis))
        return True

    def _tell_beyond(self) -> None:
        """Say which joints are now led back into their range, from how far beyond it and how fast."""
        arm = self._arm
        for axis, fastest in enumerate(arm.limits.velocity):
            beyond = arm.beyond_range(axis)
            if beyond > _TOLD_RAD:
                self._blackboard.event(Code.LED_BACK, axis, beyond, min(BACK_RAD_S, fastest))

    def _count_anew(self) -> None:
        self._watch.reset()
        if self._arm.gripper is not None:
            self._arm.gripper.watch.reset()

    def _end(self) -> None:
        """Let what is measured count from now on, and say that the arm holds."""
        arm = self._arm
        self._count_anew()
        self._blackboard.event(Code.ENABLED)
        distance, box = arm.trajectory_guard.nearest_box(arm.state.actual)
        if distance < 0.0:
            self._blackboard.event(Code.STANDS_IN, box, distance)
