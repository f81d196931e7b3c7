"""The homing of one joint as the machine leads it: its drive homes by itself, the arm's set-points follow or stand."""

from __future__ import annotations

from rtcp.control.arm import Arm
from rtcp.devices.homing import Homing, HomingPhase
from rtcp.ipc.codes import Code

_CODES = {
    HomingPhase.HOMED: Code.HOMED,
    HomingPhase.FAILED: Code.HOMING_FAILED,
    HomingPhase.STOPPED: Code.STOPPED,
}


class HomingArm:
    """One homing at a time; `step` once a cycle until it has `ended`.

    Args:
        arm: enabled, at rest, in CSP.
        period_s: the cycle, s.
    """

    def __init__(self, arm: Arm, period_s: float) -> None:
        self._arm = arm
        self._homing = Homing(period_s)
        self.axis = 0

    def begin(self, axis: int) -> None:
        """Let the drive of a joint begin."""
        self.axis = axis
        self._homing.start(self._arm.drives[axis])

    def stop(self) -> None:
        """Let the drive come to rest and go back to CSP."""
        self._homing.stop()

    def abandon(self) -> None:
        """Let go of the drive, which is led elsewhere."""
        self._homing.abandon()

    def leads_back(self) -> bool:
        """Lead a joint whose home is a little beyond its range back to the edge; return whether it is there."""
        arm, axis = self._arm, self.axis
        if arm.beyond_range(axis) > 0.0:
            low, high, position = arm.limits.low[axis], arm.limits.high[axis], arm.state.commanded
            position[axis] = min(max(position[axis], low), high)
            arm.trajectory_guard.latch(arm.state)
            arm.command()
        return arm.first_led_back() < 0

    def step(self) -> None:
        """Let the drive go on; its set-point is where it says it is, the other joints' stand, the gripper's go on."""
        arm, axis, homing = self._arm, self.axis, self._homing
        if homing.ended:
            return
        homing.step()
        arm.state.commanded[axis] = homing.position
        arm.output_limiter.latch(axis, homing.position)
        arm.trajectory_guard.latch(arm.state)
        if arm.gripper is not None:
            arm.gripper.command()

    @property
    def under_way(self) -> bool:
        """Whether it has begun and is not over."""
        return self._homing.phase is not HomingPhase.IDLE and not self._homing.ended

    @property
    def stuck(self) -> bool:
        """Whether the drive does not change its mode."""
        return self._homing.phase is HomingPhase.STUCK

    @property
    def running(self) -> bool:
        """Whether the drive does not come to rest."""
        return self._homing.phase is HomingPhase.RUNNING

    @property
    def leaves(self) -> bool:
        """Whether the drive no longer searches: it comes to rest, or goes back to CSP."""
        return self._homing.phase not in (HomingPhase.ENTERING, HomingPhase.SEARCHING)

    @property
    def ended(self) -> bool:
        """Whether it is over."""
        return self._homing.ended

    @property
    def homed(self) -> bool:
        """Whether it has succeeded."""
        return self._homing.phase is HomingPhase.HOMED

    @property
    def outcome(self) -> tuple[Code, int, float]:
        """How it ended: an event, its joint, and the position (rad) or the statusword that it is told with."""
        homing = self._homing
        return _CODES[homing.phase], self.axis, homing.position if self.homed else float(homing.shown)
