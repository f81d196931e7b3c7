"""What every state does in a cycle, and how it is left. One method a state; the tables are in `machine`.

In a fault every drive is told to quick-stop: it ramps down by itself and holds (0x605A = 6), whatever the mode, whether
or not frames come back, and comes back to Operation Enabled only by reset and enable.
"""

from __future__ import annotations

from rtcp.config.model import ArmConfig
from rtcp.devices.cia402 import DriveGoal
from rtcp.motion.generator import Motion
from rtcp.motion.modes import DriveMode
from rtcp.realtime.clock import monotonic_ns
from rtcp.realtime.discipline import Discipline
from rtcp.runtime.arm import Arm
from rtcp.runtime.blackboard import Blackboard
from rtcp.runtime.machine import Code, State
from rtcp.runtime.service import Service

_CLOSING_S = 2.0
_RESET_S = 3.0
_MODE_S = 1.0
_CLOCK_S = 1.0
_TOLD_CYCLES = 5
"""What a drive shows is older than what it was told: so many cycles later it shows what it has made of it."""
_FAREWELL_CYCLES = 20
"""Frames with quick stop for slaves that still listen when the bus is given up."""


class Behaviour:
    """The machine's state and what it does with the arm.

    Args:
        config: timeouts and how many cycles may be lost.
        arm: the joints.
        blackboard: where events go, and where the lease is.
        service: the thread beside the cycle.
        discipline: follows the reference clock, or None without distributed clocks.
    """

    def __init__(
        self, config: ArmConfig, arm: Arm, blackboard: Blackboard, service: Service, discipline: Discipline | None
    ) -> None:
        period_s = config.cycle.period_us * 1e-6
        self._arm = arm
        self._blackboard = blackboard
        self._service = service
        self._discipline = discipline
        self._lost_limit = config.bus.lost_cycles
        self._enable_cycles = round(config.enable_timeout_s / period_s)
        self._reset_cycles = round(_RESET_S / period_s)
        self._closing_cycles = round(_CLOSING_S / period_s)
        self._mode_cycles = round(_MODE_S / period_s)
        self._clock_cycles = round(_CLOCK_S / period_s)
        self._unlocked = 0
        self._since = 0
        self._told = 0
        self.state = State.STARTING
        self.cycle = 0
        self.lost = 0
        """Cycles in a row without the expected working counter."""
        self.fault = Code.NONE
        self.enables = 0
        self.moves = 0
        self.all_enabled = False
        self.switching = False
        """Whether a mode change is under way."""
        self.torque_off = False
        """Whether the torque was asked to be taken off in a fault."""
        self.wanted_mode = arm.mode
        """The mode to hold in: drives are enabled in CSP, where target = actual means standstill, and change then."""
        self.lease = 0
        """Lease of the commander whose move is carried out."""
        self.done = False
        """Whether the loop may end."""
        self._steps = {
            State.STARTING: self._starting,
            State.READY: self._ready,
            State.ENABLING: self._enabling,
            State.HOLDING: self._holding,
            State.MOVING: self._moving,
            State.STOPPING: self._stopping,
            State.DISABLING: self._disabling,
            State.FAULT: self._faulted,
            State.RESETTING: self._resetting,
            State.CLOSING: self._closing,
        }

    def step(self, good: bool) -> None:
        """Do one cycle of the present state; `good`: the exchange had the expected working counter."""
        self.cycle += 1
        self.lost = 0 if good else self.lost + 1
        self._steps[self.state](good)

    def enter(self, state: State) -> None:
        """Change to `state`."""
        self.state = state
        self._told = 0
        self._since = self.cycle
        self.switching = False

    @property
    def clock_followed(self) -> bool:
        """Whether there is no reference clock to follow, or it is followed."""
        return self._discipline is None or self._discipline.locked

    @property
    def _waited(self) -> int:
        return self.cycle - self._since

    def _fail(self, code: Code, axis: int = -1, value: float = 0.0, limit: float = 0.0) -> None:
        self.fault = code
        self.torque_off = False
        self.all_enabled = False
        self._arm.hold_target()
        self._arm.lead(DriveGoal.QUICK_STOPPED)
        self._blackboard.event(code, axis, value, limit)
        self.enter(State.FAULT)

    def _fail_drive(self, code: Code, axis: int) -> None:
        self._service.explain_drive(axis)
        self._fail(code, axis, float(self._arm.drives[axis].statusword))

    def _fail_mode(self, axis: int) -> None:
        self._fail(Code.MODE_STUCK, axis, float(self._arm.drives[axis].mode_display), float(self._arm.mode))

    def _bus_fails(self, good: bool) -> bool:
        if not good and self.lost >= self._lost_limit:
            self._fail(Code.BUS_LOST, -1, float(self.lost), float(self._lost_limit))
            return True
        if self._service.lost_slave:
            self._fail(Code.SLAVE_NOT_OP, self._service.lost_slave)
            return True
        self._unlocked = 0 if self.clock_followed else self._unlocked + 1
        if self._unlocked > self._clock_cycles:
            self._unlocked = 0
            self._fail(Code.CLOCK_LOST)
            return True
        return False

    def _track(self, good: bool) -> bool:
        """Move on by one cycle while enabled; return False when the state has changed to a fault."""
        arm = self._arm
        if self._bus_fails(good):
            return False
        if not good:
            # The slaves did not see the last targets: time stands still for the set-points too.
            return True
        axis = arm.first_not_enabled()
        if axis >= 0:
            self._fail_drive(Code.DRIVE_LEFT_ENABLED, axis)
            return False
        if not arm.generator.update():
            self._fail(Code.GENERATOR)
            return False
        # Every drive is enabled: its controlword stays what it was, there is nothing to lead.
        arm.command()
        return True

    # -- one method a state -------------------------------------------------------------------------------------

    def _starting(self, good: bool) -> None:
        service = self._service
        if self.clock_followed:
            service.want_op()
        self._arm.lead(DriveGoal.DISABLED)
        if good:
            self._arm.follow()
            if service.all_op:
                self._blackboard.event(Code.READY)
                self.enter(State.READY)

    def _ready(self, good: bool) -> None:
        arm = self._arm
        if self._bus_fails(good) or not good:
            return
        axis = arm.first_in_fault()
        if axis >= 0:
            self._fail_drive(Code.DRIVE_FAULT, axis)
            return
        arm.lead(DriveGoal.DISABLED)
        arm.follow()

    def _enabling(self, good: bool) -> None:
        arm = self._arm
        if self._bus_fails(good) or not good:
            return
        axis = arm.first_outside()
        if axis >= 0:
            self._fail(Code.LEFT_RANGE, axis, arm.drives[axis].position)
            return
        axis = arm.first_in_fault()
        if axis >= 0:
            self._fail_drive(Code.DRIVE_FAULT, axis)
            return
        arm.lead(DriveGoal.ENABLED)
        arm.follow()
        arm.command()
        axis = arm.first_not_enabled()
        elsewhere = arm.first_in_another_mode() if axis < 0 else -1
        if axis < 0 and elsewhere < 0:
            self.enables += 1
            self.all_enabled = True
            self._blackboard.event(Code.ENABLED)
            self.enter(State.HOLDING)
            if self.wanted_mode is not DriveMode.CSP:
                self.change_mode(self.wanted_mode)
        elif self._waited > self._enable_cycles:
            if axis >= 0:
                self._fail_drive(Code.ENABLE_STUCK, axis)
            else:
                self._fail_mode(elsewhere)

    def change_mode(self, mode: DriveMode) -> None:
        """Let the enabled drives, at standstill, change to `mode`."""
        self._arm.set_mode(mode)
        self.enter(State.HOLDING)
        self.switching = True

    def _holding(self, good: bool) -> None:
        if not self._track(good) or not self.switching:
            return
        axis = self._arm.first_in_another_mode()
        if axis < 0:
            self.switching = False
        elif self._waited > self._mode_cycles:
            self._fail_mode(axis)

    def _moving(self, good: bool) -> None:
        lease, renewed, duration = self._blackboard.lease()
        if lease != self.lease or monotonic_ns() - renewed > duration:
            self._blackboard.event(Code.LEASE_ENDED)
            self._arm.generator.stop()
            self.enter(State.STOPPING)
            self._stopping(good)
        elif self._track(good) and self._arm.still:
            self._blackboard.event(Code.ARRIVED)
            self.enter(State.HOLDING)

    def _stopping(self, good: bool) -> None:
        if self._track(good) and self._arm.still:
            self._blackboard.event(Code.STOPPED)
            self.enter(State.HOLDING)

    def _disabling(self, good: bool) -> None:
        arm = self._arm
        if not arm.still:
            # The time for disabling begins when the arm stands.
            self._since = self.cycle
            self._track(good)
            return
        if self._bus_fails(good) or not good:
            return
        self.all_enabled = False
        arm.lead(DriveGoal.DISABLED)
        arm.follow()
        self._told += 1
        axis = arm.first_with_torque()
        if axis < 0 and self._told > _TOLD_CYCLES:
            self._blackboard.event(Code.DISABLED)
            self.enter(State.READY)
        elif axis >= 0 and self._waited > self._enable_cycles:
            self._fail_drive(Code.DISABLE_STUCK, axis)

    def _faulted(self, good: bool) -> None:
        # Also without frames that come back: slaves that still hear must not go on with the last speed or torque.
        self._arm.lead(DriveGoal.DISABLED if self.torque_off else DriveGoal.QUICK_STOPPED)
        if good:
            self._arm.follow()

    def _resetting(self, good: bool) -> None:
        arm = self._arm
        if not (good and self._service.all_op and self.clock_followed):
            self._faulted(good)
        else:
            # What still moves is let come to rest first: its torque goes with the reset.
            arm.lead(DriveGoal.RESET if arm.first_moving() < 0 else DriveGoal.QUICK_STOPPED)
            arm.follow()
            if arm.first_not_resting() < 0:
                self.fault = Code.NONE
                self._blackboard.event(Code.RESET)
                self.enter(State.READY)
                return
        if self._waited > self._reset_cycles:
            axis = arm.first_moving()
            if axis >= 0 and good and self._service.all_op:
                self._fail(Code.RESET_MOVING, axis, arm.drives[axis].velocity)
                return
            axis = arm.first_not_resting()
            if axis >= 0 and self._service.all_op:
                self._fail_drive(Code.RESET_STUCK, axis)
            else:
                self._fail(Code.RESET_STUCK)

    def _closing(self, good: bool) -> None:
        arm = self._arm
        if self.lost >= self._lost_limit:
            arm.lead(DriveGoal.QUICK_STOPPED)
            self.done = self.lost >= self._lost_limit + _FAREWELL_CYCLES
            return
        if self._waited > self._closing_cycles:
            self.done = True
            return
        if not good:
            return
        if arm.generator.motion is Motion.MOVE:
            arm.generator.stop()
        if not arm.still and arm.first_not_enabled() < 0:
            self._since = self.cycle
            arm.generator.update()
            arm.command()
            return
        # In a fault the drives ramp down by themselves: their torque goes when they stand.
        ramping = arm.first_with_torque() >= 0 and arm.first_not_enabled() >= 0 and arm.first_moving() >= 0
        arm.lead(DriveGoal.QUICK_STOPPED if ramping else DriveGoal.DISABLED)
        arm.follow()
        self._told = 0 if ramping else self._told + 1
        self.done = self._told > _TOLD_CYCLES and arm.first_with_torque() < 0
