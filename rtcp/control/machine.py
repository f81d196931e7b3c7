"""The state machine, which alone changes the state. Actions and transitions of each state: `rtcp.control.states`."""

from __future__ import annotations

from rtcp.control.context import Context
from rtcp.control.partners import Partners
from rtcp.control.states import (
    Cause,
    Closing,
    Disabling,
    EmergencyStopState,
    Enabling,
    FaultReaction,
    FaultState,
    Holding,
    HomingState,
    MachineState,
    Moving,
    ReadyState,
    Resetting,
    Signal,
    Standstill,
    Starting,
    StoppedByLimitState,
    Stopping,
)
from rtcp.ipc.commands import Shutdown
from rtcp.ipc.events import (
    ClockLost,
    EmergencyStopActivated,
    Enabled,
    Event,
    LeaseExpired,
    MotionEnded,
    PartnerEmergencyStop,
    PartnerStopUnread,
    PermissionWithdrawn,
    ResetDone,
)
from rtcp.ipc.states import DriveMode, State
from rtcp.ipc.stop_reactions import StopReaction

STATES: tuple[type[MachineState], ...] = (
    Starting,
    ReadyState,
    Enabling,
    Holding,
    Moving,
    Stopping,
    StoppedByLimitState,
    HomingState,
    Disabling,
    FaultState,
    EmergencyStopState,
    Resetting,
    Closing,
)
_ENDED_BY_EMERGENCY_STOP = frozenset(
    {
        State.ENABLING,
        State.HOLDING,
        State.MOVING,
        State.STOPPING,
        State.STOPPED_BY_LIMIT,
        State.HOMING,
        State.DISABLING,
        State.FAULT,
        State.RESETTING,
    }
)
"""States that the input of the emergency stop ends: those with torque, and those after a fault. During the start the
inputs are not yet valid; in ready no drive has torque, and enabling is refused while the button is pressed."""
_ENDED_BY_PARTNER = _ENDED_BY_EMERGENCY_STOP - {State.FAULT, State.RESETTING}
"""States that the emergency stop of a partner ends: those with torque. It does not prevent a reset: with both buttons
pressed, or one button at both boxes, neither arm could be reset first."""
_SAFE = frozenset({State.FAULT, State.EMERGENCY_STOP, State.CLOSING})
"""States that set all outputs to their safe state when they begin. Stale inputs lead to the fault."""
_SLAVES_RETURN = frozenset({State.FAULT, State.RESETTING, State.EMERGENCY_STOP, State.CLOSING})
"""States in which a slave that has left OP may return to it."""


class StateMachine:
    """Runs the active state once a cycle and changes it.

    Args:
        ctx: shared data of the states.
        partners: the arm's partners in a cell.
    """

    def __init__(self, ctx: Context, partners: Partners | None = None) -> None:
        self.context = ctx
        self.partners = partners
        reaction = FaultReaction(ctx)
        self._holding = Holding()
        self._states: dict[State, MachineState] = {
            state.state: state
            for state in (
                Starting(),
                ReadyState(reaction),
                Enabling(),
                self._holding,
                Moving(),
                Stopping(),
                StoppedByLimitState(),
                HomingState(),
                Disabling(),
                FaultState(reaction),
                EmergencyStopState(reaction),
                Resetting(reaction),
                Closing(Standstill(ctx)),
            )
        }
        self._active = self._states[State.STARTING]
        self.fault = 0
        """Number of the event that began the present fault; 0: no fault."""
        self.limit = 0
        """Number of the event of the limit that ended the last motion; 0: none, or it was reset."""
        self.enables = 0
        """Number of times that the arm was enabled."""
        self.motions = 0
        """Number of motions begun."""

    @property
    def state(self) -> State:
        """The machine's state."""
        return self.context.state

    @property
    def closed(self) -> bool:
        """Whether the loop may end."""
        return self.context.state is State.OFF

    @property
    def changing_mode(self) -> bool:
        """Whether the drives are changing their mode."""
        return self.context.state is State.HOLDING and self._holding.changing_mode

    def update(self, good: bool) -> None:
        """Do one cycle; `good`: it had the expected working counter."""
        ctx, partners = self.context, self.partners
        ctx.begin_cycle(good)
        operator = ctx.operator
        if operator.emergency_stop and ctx.state in _ENDED_BY_EMERGENCY_STOP:
            self.change(EmergencyStopActivated())
        if partners is not None and ctx.state in _ENDED_BY_PARTNER:
            if partners.pressed >= 0:
                self.change(PartnerEmergencyStop(partners.pressed))
            elif partners.unread >= 0:
                self.change(PartnerStopUnread(partners.unread))
        event = self._active.update(ctx)
        if event is not None and self._handle(event):
            # The state ended before it commanded the arm: the next state commands it in this cycle.
            event = self._active.update(ctx)
            if event is not None:
                self._handle(event)
        if ctx.state in _SLAVES_RETURN:
            ctx.clear_lost_boxes()
        ctx.drop_reported(self.fault)

    def change(self, cause: Cause, lease: int | None = None) -> None:
        """Change to the state to which a command, an event or a signal leads; publish an event.

        Args:
            cause: the command, event or signal; no change where it leads nowhere from the present state.
            lease: lease of the commander of a motion; 0: the joystick.
        """
        ctx, before = self.context, self.context.state
        if isinstance(cause, Event) and cause is not ctx.pending:
            ctx.publish(cause)
        target = self._target(cause)
        if target is None:
            return
        if lease is not None:
            ctx.lease, ctx.unattended = lease, False
        self._count(cause, target)
        ctx.state, ctx.entered = target, ctx.cycle
        if target is not State.MOVING:
            ctx.arm.speed_override.resume()
        if target in _SAFE:
            ctx.make_safe()
        if target is not State.OFF:
            self._active = self._states[target]
            self._active.enter(ctx, cause, before)

    def change_drive_mode(self, mode: DriveMode) -> None:
        """Let the drives change their mode: now at standstill, or when they are next enabled."""
        self.context.arm.wanted_mode = mode
        if self.state is State.HOLDING:
            self._holding.change_mode(self.context, mode)
        else:
            self.context.arm.set_mode(mode)

    def close(self) -> None:
        """Stop, disable and end; final."""
        if self.state not in (State.CLOSING, State.OFF):
            self.change(Shutdown())

    def _handle(self, event: Event | Signal) -> bool:
        """Change the state by `event`; return whether the arm is still to be commanded in this cycle."""
        ctx = self.context
        if isinstance(event, ClockLost) and event is not ctx.pending and self._stops_for_clock(event):
            ctx.publish(event)
            ctx.pending, self.fault = event, event.number
            if ctx.state is not State.DISABLING:
                self.change(Signal.STOP_FOR_CLOCK)
            return True
        self.change(event, 0 if event is Signal.JOYSTICK_DEFLECTED else None)
        return ctx.state is State.STOPPING and isinstance(event, (LeaseExpired, PermissionWithdrawn))

    def _stops_for_clock(self, event: ClockLost) -> bool:
        """Return whether a lost clock leads to a controlled stop before the fault."""
        ctx = self.context
        if not ctx.is_controlled(event):
            return False
        # Disabling continues: after the command to remove the torque the arm must not hold.
        disabling = ctx.state is State.DISABLING
        return disabling or (Signal.STOP_FOR_CLOCK in self._active.leads_to and not ctx.joints.at_rest)

    def _target(self, cause: Cause) -> State | None:
        """Return the state to which a cause leads; an event with a harder configured reaction leads to the fault."""
        leads_to = self._active.leads_to
        if isinstance(cause, Signal):
            return leads_to.get(cause)
        if isinstance(cause, Event) and not cause.is_fault:
            reaction = self.context.reactions.get(type(cause), StopReaction.CONTROLLED_STOP)
            if reaction is not StopReaction.CONTROLLED_STOP:
                return State.FAULT
        return next((leads_to[kind] for kind in type(cause).__mro__ if kind in leads_to), None)

    def _count(self, cause: Cause, target: State) -> None:
        if target in (State.FAULT, State.EMERGENCY_STOP) and isinstance(cause, Event):
            self.fault = cause.number
        elif isinstance(cause, ResetDone):
            self.fault = 0
        elif isinstance(cause, MotionEnded) and self.context.limited:
            self.limit = cause.number
        elif self.state is State.STOPPED_BY_LIMIT and target is State.HOLDING:
            self.limit = 0
        elif isinstance(cause, Enabled):
            self.enables += 1
        elif target is State.MOVING:
            self.motions += 1
