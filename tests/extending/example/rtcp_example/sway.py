"""A motion command, its refusal, and its controller."""

from math import cos, isfinite, pi, sin

from rtcp.ipc.commands import Command, MotionCommand
from rtcp.ipc.refusals import Refusal, UnknownAxis
from rtcp.motion.controllers import Controller, ControllerSetup
from rtcp.motion.state import ArmState, Phase, Setpoint


class Sway(MotionCommand):
    """Swing a joint about its position: `amplitude`, rad, at `frequency`, Hz, for `duration_s`."""

    axis: int
    amplitude: float
    frequency: float
    duration_s: float


class SwayTooFast(Refusal):
    """{joint}: {amplitude:.6g} rad at {frequency:.6g} Hz exceeds its velocity or acceleration: reduce one of them"""

    axis: int
    amplitude: float
    frequency: float


class SwayController(Controller):
    """Accepts `Sway`: q(t) = q(0) + amplitude sin(w t) sin^2(e t), at rest at both ends."""

    name = "sway"
    commands = (Sway,)

    def __init__(self, setup: ControllerSetup) -> None:
        super().__init__(setup)
        joints = len(self.limits.velocity)
        self._start, self._position, self._velocity = [0.0] * joints, [0.0] * joints, [0.0] * joints
        self._axis, self._amplitude, self._w, self._e = 0, 0.0, 0.0, 0.0

    def accept(self, command: Command, state: ArmState, continues: bool) -> Refusal | None:
        assert isinstance(command, Sway)
        axis, a, frequency, limits = command.axis, command.amplitude, command.frequency, self.limits
        if not 0 <= axis < len(self._start):
            return UnknownAxis(axis, len(self._start) - 1)
        sound = all(isfinite(x) and x > 0.0 for x in (a, frequency, command.duration_s))
        w, e = 2.0 * pi * frequency, pi / command.duration_s if sound else 0.0
        fastest, steepest = a * (w + e), a * (w * w + 2.0 * w * e + 2.0 * e * e)
        if continues or not sound or fastest > limits.velocity[axis] or steepest > limits.acceleration[axis]:
            return SwayTooFast(axis, a, frequency)
        for end in (-a, a):
            q = list(state.commanded)
            q[axis] += end
            if (refusal := self.not_in_range(q)) is not None:
                return refusal
        self.begin()
        self.duration_s = command.duration_s
        self._axis, self._amplitude, self._w, self._e = axis, a, w, e
        self._start[:] = self._position[:] = state.commanded
        self._velocity[:] = self._zero
        return None

    def advance(self, state: ArmState) -> Setpoint:
        axis, a, w, e = self._axis, self._amplitude, self._w, self._e
        self.elapsed_s += self.period_s
        t, offset, velocity = self.elapsed_s, 0.0, 0.0
        if t < self.duration_s:
            envelope = sin(e * t) ** 2
            offset = a * sin(w * t) * envelope
            velocity = a * (w * cos(w * t) * envelope + e * sin(w * t) * sin(2.0 * e * t))
        else:
            self.phase = Phase.HOLD
        self._position[axis], self._velocity[axis] = self._start[axis] + offset, velocity
        self.setpoint.position, self.setpoint.velocity = self._position, self._velocity
        return self.setpoint
