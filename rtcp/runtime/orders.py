"""Commands as the loop takes them: checked against lease, state and limits, then carried out or refused."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite

from rtcp.devices.io_box import IoBox
from rtcp.motion.generator import LONGEST_S
from rtcp.motion.modes import DriveMode
from rtcp.realtime.clock import monotonic_ns
from rtcp.runtime.arm import RANGE_MARGIN_RAD, Arm
from rtcp.runtime.behaviour import Behaviour
from rtcp.runtime.blackboard import Blackboard
from rtcp.runtime.machine import ALLOWED, WITHOUT_LEASE, Code, Command, Refusal, State
from rtcp.runtime.service import Service

Verdict = tuple[Refusal] | tuple[Refusal, int, float] | tuple[Refusal, int, float, float]
"""A refusal (or NONE), the axis that it is about, the value and the limit."""
_DONE: Verdict = (Refusal.NONE,)


class Orders:
    """Takes at most one command a cycle.

    Args:
        arm: the joints.
        box: the IO box, or None.
        behaviour: the machine's state.
        blackboard: where commands come from and answers go.
        service: the thread beside the cycle.
    """

    def __init__(
        self, arm: Arm, box: IoBox | None, behaviour: Behaviour, blackboard: Blackboard, service: Service
    ) -> None:
        self._arm = arm
        self._box = box
        self._behaviour = behaviour
        self._blackboard = blackboard
        self._service = service
        self._target = [0.0] * len(arm.drives)
        self._answers = {
            Command.ENABLE: self._enable,
            Command.DISABLE: self._disable,
            Command.RESET: self._reset,
            Command.MODE: self._mode,
            Command.MOVE: self._move,
            Command.STOP: self._stop,
            Command.OUTPUT: self._output,
            Command.SHUTDOWN: self._shut_down,
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
        if self._behaviour.switching and command in (Command.MODE, Command.MOVE):
            return (Refusal.SWITCHING,)
        return self._answers[command](lease, numbers)

    def _holds(self, lease: int) -> bool:
        held, renewed, duration = self._blackboard.lease()
        return lease != 0 and held == lease and monotonic_ns() - renewed <= duration

    def _enable(self, lease: int, numbers: Sequence[float]) -> Verdict:
        arm = self._arm
        if not self._service.all_op:
            return (Refusal.NOT_IN_OP,)
        if not self._behaviour.clock_followed:
            return (Refusal.CLOCK,)
        axis = arm.first_moving()
        if axis >= 0:
            return Refusal.NOT_STILL, axis, arm.drives[axis].velocity
        for axis, drive in enumerate(arm.drives):
            low, high = arm.low[axis], arm.high[axis]
            if not low - RANGE_MARGIN_RAD <= drive.position <= high + RANGE_MARGIN_RAD:
                return Refusal.OUTSIDE_LIMITS, axis, drive.position, high if drive.position > high else low
        arm.set_mode(DriveMode.CSP)
        arm.begin()
        self._behaviour.enter(State.ENABLING)
        return _DONE

    def _disable(self, lease: int, numbers: Sequence[float]) -> Verdict:
        behaviour = self._behaviour
        if behaviour.state in (State.FAULT, State.RESETTING):
            # The fault stays; only the torque goes.
            behaviour.torque_off = True
            behaviour.enter(State.FAULT)
            self._blackboard.event(Code.TORQUE_OFF)
        elif behaviour.state not in (State.READY, State.DISABLING):
            self._arm.generator.stop()
            behaviour.enter(State.DISABLING)
        return _DONE

    def _reset(self, lease: int, numbers: Sequence[float]) -> Verdict:
        self._service.recover()
        self._behaviour.enter(State.RESETTING)
        return _DONE

    def _mode(self, lease: int, numbers: Sequence[float]) -> Verdict:
        wanted = numbers[0]
        if wanted not in (DriveMode.CSP, DriveMode.CSV, DriveMode.CST):
            return Refusal.MODE, -1, wanted
        behaviour, mode = self._behaviour, DriveMode(int(wanted))
        behaviour.wanted_mode = mode
        if behaviour.state is State.HOLDING:
            behaviour.change_mode(mode)
        else:
            self._arm.set_mode(mode)
        return _DONE

    def _move(self, lease: int, numbers: Sequence[float]) -> Verdict:
        arm, target = self._arm, self._target
        speed = numbers[-1]
        if not isfinite(speed) or not 0.0 < speed <= arm.fastest:
            return Refusal.SPEED, -1, speed, arm.fastest
        for axis in range(len(target)):
            wanted, low, high = numbers[axis], arm.low[axis], arm.high[axis]
            if not isfinite(wanted):
                return Refusal.NOT_A_NUMBER, axis, wanted
            if not low <= wanted <= high:
                return Refusal.POSITION_LIMIT, axis, wanted, high if wanted > high else low
            target[axis] = wanted
        if not arm.generator.move_to(target, speed):
            return Refusal.NO_PLAN, -1, speed, LONGEST_S
        behaviour = self._behaviour
        behaviour.lease = lease
        behaviour.moves += 1
        behaviour.enter(State.MOVING)
        return _DONE

    def _stop(self, lease: int, numbers: Sequence[float]) -> Verdict:
        if self._behaviour.state is State.MOVING:
            self._arm.generator.stop()
            self._behaviour.enter(State.STOPPING)
        return _DONE

    def _output(self, lease: int, numbers: Sequence[float]) -> Verdict:
        if self._box is None:
            return (Refusal.NO_OUTPUTS,)
        number, value = numbers[0], numbers[1]
        highest = self._box.output_count
        if number not in range(1, highest + 1):
            return Refusal.OUTPUT, -1, number, float(highest)
        if value not in (0.0, 1.0):
            return Refusal.OUTPUT_VALUE, int(number), value
        self._box.set_output(int(number), value == 1.0)
        return _DONE

    def _shut_down(self, lease: int, numbers: Sequence[float]) -> Verdict:
        self._behaviour.enter(State.CLOSING)
        return _DONE
