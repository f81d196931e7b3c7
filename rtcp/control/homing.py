"""The homing of one joint: its drive homes by itself, its setpoint follows, those of the other joints stand."""

from __future__ import annotations

from rtcp.control.arm import Arm
from rtcp.devices.homing import Homing, HomingPhase
from rtcp.ipc.events import Event, Homed, HomingFailed, Stopped


class HomingSequence:
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
        """Bring the drive to rest and back to CSP."""
        self._homing.stop()

    def abandon(self) -> None:
        """Release the drive, which is commanded elsewhere."""
        self._homing.abandon()

    def returned_to_range(self) -> bool:
        """Move a joint whose home is a little outside its range to the edge; return whether it is there."""
        arm, axis = self._arm, self.axis
        if arm.beyond_range(axis) > 0.0:
            low, high, position = arm.limits.low[axis], arm.limits.high[axis], arm.state.commanded
            position[axis] = min(max(position[axis], low), high)
            arm.trajectory_guard.latch(arm.state)
            arm.command()
        return arm.first_returning() < 0

    def step(self) -> None:
        """Run a cycle; the setpoint of the joint is where its drive shows it, those of the others stand."""
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
    def still_moving(self) -> bool:
        """Whether the drive does not come to rest."""
        return self._homing.phase is HomingPhase.RUNNING

    @property
    def leaving(self) -> bool:
        """Whether the drive no longer searches: it comes to rest, or returns to CSP."""
        return self._homing.phase not in (HomingPhase.ENTERING, HomingPhase.SEARCHING)

    @property
    def ended(self) -> bool:
        """Whether it is over."""
        return self._homing.ended

    @property
    def outcome(self) -> Event:
        """How it ended."""
        homing = self._homing
        if homing.phase is HomingPhase.HOMED:
            return Homed(self.axis, homing.position)
        return HomingFailed(self.axis, homing.shown) if homing.phase is HomingPhase.FAILED else Stopped()
