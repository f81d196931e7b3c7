"""One cycle of an enabled arm: what is lost or measured first, then the active mode, its guards, what ends a motion."""

from __future__ import annotations

from dataclasses import astuple
from typing import TYPE_CHECKING

from rtcp.control.arm import Arm
from rtcp.control.failing import Failing
from rtcp.control.homing_arm import HomingArm
from rtcp.control.operator import Operator
from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.codes import Reason
from rtcp.ipc.events import ControllerFailed, MotionEnded, NotLeavingBox, OutOfReach
from rtcp.ipc.machine import Code, Event, State
from rtcp.ipc.stops import Rung
from rtcp.motion.guards.trajectory_guard import GuardResult

if TYPE_CHECKING:
    from rtcp.control.behaviour import Behaviour


class Tracking:
    """Moves the set-points on by one cycle, or the homing.

    Args:
        behaviour: the machine's state, which it changes.
        arm: the joints.
        operator: the enabling switch and the stick.
        homing: one that may be under way.
        failing: what goes wrong.
        blackboard: where it is told, and where the lease is.
    """

    def __init__(
        self,
        behaviour: Behaviour,
        arm: Arm,
        operator: Operator,
        homing: HomingArm,
        failing: Failing,
        blackboard: Blackboard,
    ) -> None:
        self._behaviour = behaviour
        self._arm = arm
        self._operator = operator
        self._homing = homing
        self._failing = failing
        self._blackboard = blackboard
        self.limited = False
        """Whether the stop that is under way ends in `stopped by limit`."""

    def leased(self, lease: int) -> bool:
        """Whether the commander of `lease` still holds it; 0: the stick, which needs none."""
        if not lease:
            return True
        held, renewed, duration = self._blackboard.lease()
        return held == lease and self._behaviour.now_ns - renewed <= duration

    def unled(self, lease: int) -> Code:
        """Return why what moves for the commander of `lease` must stop, or `NONE`."""
        if not self._operator.permitted:
            return Code.NOT_PERMITTED
        return Code.NONE if self.leased(lease) else Code.LEASE_ENDED

    def track(self, good: bool) -> bool:
        """Move on by one cycle while enabled; return False when the state has changed by it."""
        arm, failing = self._arm, self._failing
        if failing.bus_fails(good):
            return False
        if not good:
            # The slaves did not see the last targets: time stands still for the set-points too.
            return True
        axis = arm.first_not_enabled()
        if axis >= 0:
            failing.fail_drive(Code.DRIVE_LEFT_ENABLED, axis)
            return False
        if failing.watch_stops() or self._gripper_fails():
            return False
        # Every drive is enabled: its controlword stays what it was, there is nothing to lead.
        verdict = arm.command()
        if verdict is GuardResult.PASS and arm.motions.active.ended is None:
            return True
        return self._cut(verdict)

    def track_homing(self, good: bool) -> bool:
        """Do a homing's part of the cycle, watched as any motion; return False where it broke, or no frame came."""
        arm, homing, failing = self._arm, self._homing, self._failing
        if failing.bus_fails(good) or not good:
            return False
        left = arm.first_not_enabled()
        if left >= 0:
            failing.fail_drive(Code.DRIVE_LEFT_ENABLED, left)
            return False
        unled = self.unled(self._behaviour.lease)
        if unled is not Code.NONE:
            if failing.rungs[unled] is not Rung.CONTROLLED_STOP:
                failing.fail(unled)
                return False
            homing.stop()
        homing.step()
        if failing.watch_stops() or self._gripper_fails():
            return False
        outside = arm.first_outside()
        if homing.stuck:
            failing.fail_mode(homing.axis)
        elif homing.running:
            failing.fail(Code.HOMING_RUNNING, homing.axis, arm.drives[homing.axis].velocity)
        elif outside >= 0:
            # While it searches, and where it begins to count anew: also a stop after the index was found does.
            failing.fail(Code.LEFT_RANGE, outside, arm.all_drives[outside].position)
        else:
            # Before its home a drive does not know where it is: what can be told from its old zero is kept to.
            if not homing.leaves and (box := arm.trajectory_guard.zone_at(arm.state.actual)) is not None:
                self._blackboard.event(Code.HOMING_ZONE, box)
                homing.stop()
            return True
        return False

    def _gripper_fails(self) -> bool:
        """Stop a gripper that nobody leads any more, and say why; return whether that ended in a fault."""
        gripper, operator, failing = self._arm.gripper, self._operator, self._failing
        if gripper is None or not gripper.motion.moving or gripper.motion.stops:
            return False
        unled = self.unled(gripper.lease)
        if unled is not Code.NONE:
            if failing.rungs[unled] is not Rung.CONTROLLED_STOP:
                failing.fail(unled)
                return True
            self._blackboard.event(unled)
        elif gripper.lease or operator.holds_grip:
            return False
        gripper.stop()
        return False

    def _cut(self, verdict: GuardResult) -> bool:
        """Deal with a guard that cut the target, or a mode that ends by itself; return False when the state changed."""
        arm, mode, state = self._arm, self._arm.motions.active, self._behaviour.state
        ended = mode.ended
        if isinstance(ended, ControllerFailed):
            self._failing.fail(Code.GENERATOR)
            return False
        if verdict is GuardResult.STOPPING or verdict is GuardResult.STOPPED:
            cause = arm.trajectory_guard.ended
            limited = not mode.tolerates_saturation
            if cause is not None and (state in (State.MOVING, State.HOLDING) or (limited and not self.limited)):
                self._end(cause, limited)
            if verdict is GuardResult.STOPPED:
                arm.motions.rest()
            return False
        if ended is not None and state is State.MOVING:
            self._end(ended, ended.by_limit and not mode.tolerates_saturation)
            return False
        return True

    def _end(self, ended: MotionEnded, limited: bool) -> None:
        behaviour = self._behaviour
        self._operator.wait_for_neutral()
        reason, axis, value, limit = _in_numbers(ended)
        self._blackboard.event(Code.ENDED + reason, axis, value, limit)
        self.limited = limited
        if limited:
            behaviour.limit = reason
            if self._arm.gripper is not None:
                self._arm.gripper.stop()
        if behaviour.state in (State.MOVING, State.HOLDING, State.STOPPING):
            behaviour.on(Event.GUARD)


def _in_numbers(ended: MotionEnded) -> tuple[Reason, int, float, float]:
    """Return reason, axis, value and limit of the record."""
    if isinstance(ended, NotLeavingBox):
        return Reason.KEEP_OUT, ended.box, -ended.depth, 0.0
    fields = astuple(ended)
    if isinstance(ended, OutOfReach):
        fields = (-1, *fields)
    axis, value, limit = [*fields, 0.0, 0.0][:3] if fields else [-1, 0.0, 0.0]
    return Reason(ended.number - Code.ENDED), int(axis), value, limit
