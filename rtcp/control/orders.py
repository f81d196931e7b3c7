"""Commands as the loop takes them: checked against lease, state and limits, then carried out or refused.

What sets the arm in motion is in `motion_orders`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from rtcp.config.model import ArmConfig
from rtcp.control.arm import RANGE_MARGIN_RAD, Arm
from rtcp.control.behaviour import Behaviour
from rtcp.control.bus_service import BusService
from rtcp.control.limit_orders import LimitOrders
from rtcp.control.motion_orders import MotionOrders
from rtcp.control.operator import Operator
from rtcp.control.verdict import DONE, Verdict
from rtcp.devices.io_box import IoBox
from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.codes import MotionMode
from rtcp.ipc.machine import ALLOWED, WITHOUT_LEASE, Code, Command, Event, Refusal, State
from rtcp.ipc.states import DriveMode

_WAITS_FOR_MODE = frozenset(
    {
        Command.MODE,
        Command.MOTION,
        Command.MOVE,
        Command.TRAJECTORY,
        Command.LINE,
        Command.STREAM,
        Command.JOG,
        Command.VELOCITY,
        Command.TORQUE,
        Command.HOME,
    }
)


class Orders:
    """Takes at most one command a cycle.

    Args:
        config: the arm.
        arm: the joints.
        box: the IO box, or None.
        operator: the inputs and outputs that have a meaning.
        behaviour: the machine's state.
        blackboard: where commands come from and answers go.
        service: the thread beside the cycle.
    """

    def __init__(
        self,
        config: ArmConfig,
        arm: Arm,
        box: IoBox | None,
        operator: Operator,
        behaviour: Behaviour,
        blackboard: Blackboard,
        service: BusService,
    ) -> None:
        self._arm = arm
        self._box = box
        self._operator = operator
        self._behaviour = behaviour
        self._blackboard = blackboard
        self._service = service
        motion = MotionOrders(config, arm, operator, behaviour, blackboard)
        self._answers: dict[Command, Callable[[int, Sequence[float]], Verdict]] = {
            Command.ENABLE: self._enable,
            Command.DISABLE: self._disable,
            Command.RESET: self._reset,
            Command.MODE: self._mode,
            Command.STOP: self._stop,
            Command.OUTPUT: self._output,
            Command.SHUTDOWN: self._shut_down,
            Command.MOTION: self._motion,
            Command.GRIPPER: self._gripper,
            Command.ZERO: self._zero,
            Command.LIMITS: LimitOrders(arm, blackboard).take,
            **motion.answers,
        }

    def take(self) -> None:
        """Take the next command and answer it. Only when one waits."""
        number, lease, kind, *numbers = self._blackboard.take_command()
        self._blackboard.answer(int(number), *self._judge(int(lease), int(kind), numbers))

    def _judge(self, lease: int, kind: int, numbers: Sequence[float]) -> Verdict:
        if kind not in self._answers:
            return Refusal.UNKNOWN, -1, float(kind)
        command = Command(kind)
        if command not in WITHOUT_LEASE and not self._holds(lease):
            return (Refusal.NO_LEASE,)
        state = self._behaviour.state
        if state not in ALLOWED[command]:
            return Refusal.NOT_IN_THIS_STATE, int(state), float(command)
        if self._behaviour.switching and command in _WAITS_FOR_MODE:
            return (Refusal.SWITCHING,)
        return self._answers[command](lease, numbers)

    def _holds(self, lease: int) -> bool:
        held, renewed, duration = self._blackboard.lease()
        return lease != 0 and held == lease and self._behaviour.now_ns - renewed <= duration

    def _enable(self, lease: int, numbers: Sequence[float]) -> Verdict:
        arm = self._arm
        if self._operator.emergency_stop:
            return (Refusal.PRESSED,)
        if not self._service.all_op:
            return (Refusal.NOT_IN_OP,)
        if not self._behaviour.clock_followed:
            return (Refusal.CLOCK,)
        axis = arm.first_moving()
        if axis >= 0:
            return Refusal.NOT_STILL, axis, arm.all_drives[axis].velocity
        for axis, drive in enumerate(arm.drives):
            low, high = arm.limits.low[axis], arm.limits.high[axis]
            if not low - RANGE_MARGIN_RAD <= drive.position <= high + RANGE_MARGIN_RAD:
                return Refusal.OUTSIDE_LIMITS, axis, drive.position, high if drive.position > high else low
        if arm.gripper is not None and arm.gripper.outside:
            return Refusal.OUTSIDE_LIMITS, len(arm.drives), arm.gripper.drive.position
        arm.set_mode(DriveMode.CSP)
        arm.hold_target()
        self._operator.wait_for_neutral()
        self._behaviour.enable()
        return DONE

    def _disable(self, lease: int, numbers: Sequence[float]) -> Verdict:
        behaviour = self._behaviour
        if behaviour.state in (State.FAULT, State.RESETTING):
            # The fault stays; only the torque goes.
            behaviour.torque_off = True
            behaviour.on(Event.DISABLE)
            self._blackboard.event(Code.TORQUE_OFF)
        elif behaviour.state not in (State.READY, State.DISABLING, State.EMERGENCY_STOP):
            self._arm.stop()
            behaviour.on(Event.DISABLE)
        # The emergency stop takes the torque by itself. Taken is not done: who asks looks at the drives.
        return DONE

    def _reset(self, lease: int, numbers: Sequence[float]) -> Verdict:
        behaviour = self._behaviour
        if behaviour.state is State.STOPPED_BY_LIMIT:
            behaviour.release()
            return DONE
        if self._operator.emergency_stop and behaviour.lost == 0:
            return (Refusal.PRESSED,)
        # Parked in PRE-OP the box says nothing: whether it is still pressed shows once the slaves are back in OP.
        self._operator.forget_press()
        self._service.recover()
        behaviour.on(Event.RESET)
        return DONE

    def _mode(self, lease: int, numbers: Sequence[float]) -> Verdict:
        wanted = numbers[0]
        if wanted not in (DriveMode.CSP, DriveMode.CSV, DriveMode.CST):
            return Refusal.MODE, -1, wanted
        motions = self._arm.motions
        if motions.mode in (MotionMode.VELOCITY, MotionMode.TORQUE):
            return Refusal.OTHER_MOTION, int(motions.mode), float(MotionMode.JOINT)
        if (axis := self._arm.first_without(DriveMode(int(wanted)))) >= 0:
            return Refusal.MODE, axis, wanted
        motions.drive_mode = DriveMode(int(wanted))
        self._change_mode(motions.drive_mode)
        return DONE

    def _motion(self, lease: int, numbers: Sequence[float]) -> Verdict:
        if numbers[0] not in tuple(MotionMode):
            return Refusal.MOTION, -1, numbers[0]
        wanted = MotionMode(int(numbers[0]))
        motions = self._arm.motions
        if wanted in (MotionMode.CARTESIAN, MotionMode.JOYSTICK) and not motions.has_geometry:
            return (Refusal.NO_GEOMETRY,)
        if (axis := self._arm.first_without(motions.drive_mode_of(wanted))) >= 0:
            return Refusal.MODE, axis, float(motions.drive_mode_of(wanted))
        motions.select(wanted)
        self._operator.wait_for_neutral()
        self._blackboard.event(Code.MOTION, int(wanted))
        if motions.drive_mode_of(wanted) is not self._arm.mode or self._behaviour.state is not State.HOLDING:
            self._change_mode(motions.drive_mode_of(wanted))
        else:
            self._arm.set_mode(self._arm.mode)
        return DONE

    def _change_mode(self, mode: DriveMode) -> None:
        behaviour = self._behaviour
        behaviour.wanted_mode = mode
        if behaviour.state is State.HOLDING:
            behaviour.change_mode(mode)
        else:
            self._arm.set_mode(mode)

    def _stop(self, lease: int, numbers: Sequence[float]) -> Verdict:
        if self._arm.gripper is not None:
            self._arm.gripper.stop()
        if self._behaviour.state is State.MOVING:
            self._behaviour.stop_motion()
        elif self._behaviour.state is State.HOMING:
            self._behaviour.homing.stop()
        return DONE

    def _output(self, lease: int, numbers: Sequence[float]) -> Verdict:
        if self._box is None:
            return (Refusal.NO_OUTPUTS,)
        number, value = numbers[0], numbers[1]
        highest = self._box.output_count
        if number not in range(1, highest + 1):
            return Refusal.OUTPUT, -1, number, float(highest)
        if value not in (0.0, 1.0):
            return Refusal.OUTPUT_VALUE, int(number), value
        if int(number) in self._operator.meant:
            return Refusal.MEANT, -1, number
        self._box.set_output(int(number), value == 1.0)
        return DONE

    def _gripper(self, lease: int, numbers: Sequence[float]) -> Verdict:
        if numbers[0] not in (0.0, 1.0):
            return Refusal.OUTPUT_VALUE, -1, numbers[0]
        if self._operator.emergency_stop:
            return (Refusal.PRESSED,)
        gripper = self._arm.gripper
        if gripper is not None:
            if not self._operator.permitted:
                return (Refusal.NOT_PERMITTED,)
            if not gripper.grip(numbers[0] == 0.0, lease):
                return (Refusal.GRIPPER_RESTS,)
        elif self._operator.has_gripper:
            self._operator.grip(numbers[0] == 0.0)
        else:
            return (Refusal.NO_GRIPPER,)
        self._blackboard.event(Code.GRIPPER, -1, numbers[0])
        return DONE

    def _zero(self, lease: int, numbers: Sequence[float]) -> Verdict:
        axis, offset = numbers[0], numbers[1]
        if axis not in range(len(self._arm.all_drives)):
            return Refusal.AXIS, -1, axis, float(len(self._arm.all_drives))
        if not abs(offset) <= 100.0:
            return Refusal.OFFSET, int(axis), offset, 100.0
        if self._arm.first_with_torque() >= 0:
            return (Refusal.HAS_TORQUE,)
        self._arm.all_drives[int(axis)].zero = offset
        self._blackboard.event(Code.ZERO, int(axis), offset)
        return DONE

    def _shut_down(self, lease: int, numbers: Sequence[float]) -> Verdict:
        self._behaviour.close()
        return DONE
