"""The joints as one: their drives, the active mode and its guards, the law of the drive mode, the last clamp."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from rtcp.config.model import ArmConfig
from rtcp.control.gripper import FOLLOWED_RAD, DrivenGripper
from rtcp.control.motions import Motions
from rtcp.devices.cia402 import Cia402Drive, DriveState, TargetState
from rtcp.fieldbus.bus import ProcessData
from rtcp.ipc.codes import Code
from rtcp.ipc.states import DriveMode
from rtcp.motion.controllers import ControllerSetup
from rtcp.motion.drive_writers import CspWriter, CstWriter, CsvWriter, DriveWriter
from rtcp.motion.guards.output_limiter import OutputLimiter
from rtcp.motion.guards.supervision import Supervision
from rtcp.motion.guards.trajectory_guard import GuardResult, TrajectoryGuard
from rtcp.motion.limits import Limits
from rtcp.motion.state import ArmState, Phase

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


def _no_plan(slot: int) -> memoryview[float]:
    raise LookupError(slot)


class Arm:
    """What a cycle does with the joints.

    Args:
        config: joints, limits, cycle, the mode at the start.
        drives: one a joint, in the order of the joints, with the index of its slave.
        gripper: one with a drive of its own, or None. What is asked of all drives below is asked of its drive too, as
            the one after the joints'.
    """

    def __init__(
        self,
        config: ArmConfig,
        drives: Sequence[tuple[int, Cia402Drive]],
        gripper: DrivenGripper | None = None,
        plan: Callable[[int], memoryview[float]] = _no_plan,
    ) -> None:
        joints = config.joints
        self.period_s = config.cycle.period_us * 1e-6
        self.drives = [drive for _, drive in drives]
        self.pairs = list(drives)
        self.gripper = gripper
        self.all_drives = self.drives if gripper is None else [*self.drives, gripper.drive]
        self.state = ArmState(len(joints))
        self.limits = Limits(config)
        self.trajectory_guard = TrajectoryGuard(config, self.limits, self.period_s)
        self.output_limiter = OutputLimiter(self.limits, self.period_s)
        self.motions = Motions(ControllerSetup(config, self.limits, self.trajectory_guard, self.period_s, plan))
        self._torque_law = CstWriter(joints, self.period_s)
        self._laws: dict[DriveMode, DriveWriter] = {
            DriveMode.CSP: CspWriter(),
            DriveMode.CSV: CsvWriter(joints, self.period_s),
            DriveMode.CST: self._torque_law,
        }
        self.set_mode(self.motions.drive_mode_of(self.motions.mode))

    def set_mode(self, mode: DriveMode) -> None:
        """Let the drives change to `mode`; only at standstill."""
        self.mode = mode
        self._law = self._laws[mode]
        self._law.start(self.drives)
        for drive in self.drives:
            drive.mode = mode

    def decode(self, data: ProcessData) -> None:
        """Take the drives' inputs."""
        state = self.state
        actual, speed, torque = state.actual, state.actual_velocity, state.actual_torque
        for axis, (slot, drive) in enumerate(self.pairs):
            drive.decode(data.input(slot))
            actual[axis] = drive.position
            speed[axis] = drive.velocity
            torque[axis] = drive.torque
        if self.gripper is not None:
            self.gripper.decode(data)

    def encode(self, data: ProcessData) -> None:
        """Hand over the drives' outputs."""
        for slot, drive in self.pairs:
            data.set_output(slot, drive.encode())
        if self.gripper is not None:
            self.gripper.encode(data)

    def lead(self, goal: TargetState) -> None:
        """Lead every drive one step towards `goal`."""
        for drive in self.all_drives:
            drive.advance(goal)

    def stop(self) -> None:
        """Let all that moves come to rest, the gripper too."""
        self.motions.stop(self.state)
        if self.gripper is not None:
            self.gripper.stop()

    def hold_target(self) -> None:
        """Hold at the set-point that was made last, at rest from now on."""
        self.motions.rest()
        self.trajectory_guard.latch(self.state)

    def follow(self) -> None:
        """Let set-point and guard follow the drives that have no torque: their target is where they are.

        The set-point of a joint that stands outside its range is the edge of it, so that every mode begins inside; from
        where the joint is to there the guard leads its target, once the drive obeys it.
        """
        position, latch, limits = self.state.commanded, self.output_limiter.latch, self.limits
        for i, drive in enumerate(self.drives):
            if drive.state not in _HOLDING:
                low, high, here = limits.low[i], limits.high[i], drive.position
                position[i] = high if here > high else low if here < low else here
                drive.target_position = here
                latch(i, here)
        self.trajectory_guard.latch(self.state)
        if self.gripper is not None:
            self.gripper.follow()

    def command(self) -> GuardResult:
        """Write the targets of this cycle: the active mode, its guards, the law, the last clamp."""
        state, drives, mode = self.state, self.drives, self.motions.active
        target = mode.update(state)
        verdict = self.trajectory_guard.apply(state, target, mode.tolerates_saturation)
        if target.direct:
            self._torque_law.pass_on(state.commanded, target.torque, drives)
        else:
            self._law.update(state.commanded, state.commanded_velocity, drives)
        self.output_limiter.check(drives)
        if self.gripper is not None:
            self.gripper.command()
        return verdict

    def beyond(self, watch: Supervision) -> tuple[Code, int, float, float] | None:
        """Look at what is measured of joints and gripper; return what is beyond its limit for too long, or None."""
        found = watch.look(self.state)
        if found is None and self.gripper is not None:
            found = self.gripper.look()
        # Codes follow the kinds: speed, torque, following error.
        return None if found is None else (Code(Code.OVER_SPEED + found.kind), found.axis, found.value, found.limit)

    def first_not_enabled(self) -> int:
        """Return the first joint whose drive is not enabled, or -1."""
        for axis, drive in enumerate(self.all_drives):
            if drive.state is not _ENABLED:
                return axis
        return -1

    def first_with_torque(self) -> int:
        """Return the first joint whose drive gives torque: enabled, in a quick stop or reacting to a fault; or -1."""
        for axis, drive in enumerate(self.all_drives):
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
        for axis, drive in enumerate(self.all_drives):
            if drive.state is DriveState.FAULT:
                return axis
        return -1

    def first_moving(self) -> int:
        """Return the first joint that does not stand still, or -1."""
        for axis, drive in enumerate(self.all_drives):
            if abs(drive.velocity) > _STILL_RAD_S:
                return axis
        return -1

    def first_without(self, mode: DriveMode) -> int:
        """Return the first joint whose drive does not map what `mode` needs, or -1."""
        return next((axis for axis, drive in enumerate(self.drives) if not drive.supports(mode)), -1)

    def first_outside(self) -> int:
        """Return the first joint that stands outside its range, or -1."""
        low, high = self.limits.low, self.limits.high
        for axis, drive in enumerate(self.drives):
            if not low[axis] - RANGE_MARGIN_RAD <= drive.position <= high[axis] + RANGE_MARGIN_RAD:
                return axis
        return len(self.drives) if self.gripper is not None and self.gripper.outside else -1

    def first_off_target(self) -> int:
        """Return the first joint that `follow` would take further than it can have turned since the last, or -1."""
        followed = self.output_limiter.sent
        for axis, drive in enumerate(self.drives):
            if drive.state not in _HOLDING and not abs(drive.position - followed[axis]) <= FOLLOWED_RAD:
                return axis
        return len(self.drives) if self.gripper is not None and self.gripper.off_target else -1

    def followed_to(self, axis: int) -> float:
        """Return where the drive of a joint, or of the gripper, was followed to, rad."""
        if axis < len(self.drives) or self.gripper is None:
            return self.output_limiter.sent[axis]
        return self.gripper.motion.position

    def beyond_range(self, axis: int) -> float:
        """Return how far beyond its range the target of a joint is, from where the guard leads it back, rad, or 0."""
        last, limits = self.output_limiter.sent[axis], self.limits
        return max(last - limits.high[axis], limits.low[axis] - last, 0.0)

    def first_led_back(self) -> int:
        """Return the first joint whose target the guard still leads back into its range, or -1."""
        for axis in range(len(self.drives)):
            if self.beyond_range(axis) > 0.0:
                return axis
        return -1

    def first_not_resting(self) -> int:
        """Return the first joint whose drive is in fault or enabled, or -1."""
        for axis, drive in enumerate(self.all_drives):
            if drive.state not in RESTING:
                return axis
        return -1

    @property
    def still(self) -> bool:
        """Whether the set-points stand still."""
        return self.motions.active.phase is Phase.HOLD

    @property
    def all_still(self) -> bool:
        """Whether the gripper's set-point stands still too, and no guard brakes: the torque may go."""
        gripper = self.gripper
        return self.still and not self.trajectory_guard.stopping and (gripper is None or not gripper.motion.moving)
