"""Supervision of the measured speed, torque and following error, each against its limit in every cycle."""

from __future__ import annotations

from rtcp.config.model import ArmConfig
from rtcp.ipc.events import EmergencyStop, FollowingError, OverSpeed, OverTorque
from rtcp.ipc.refusals import ThresholdTooLow
from rtcp.motion.limits import Limits, Values
from rtcp.motion.state import ArmState


class Supervision:
    """Counts consecutive cycles in which a joint is beyond a limit.

    Args:
        config: allowed number of cycles, and time of a torque.
        limits: of the joints, with the thresholds.
        first: axis number of the first joint.
    """

    def __init__(self, config: ArmConfig, limits: Limits, first: int = 0) -> None:
        n = len(config.joints)
        self._first = first
        self._cycles = config.supervision.cycles
        self._torque_cycles = max(1, round(config.supervision.torque_s * 1e6 / config.cycle.period_us))
        self.following_error = 0.0
        """Limit in force, rad; infinite while a gripper holds an object."""
        self.take(limits)
        self._joints = range(n)
        self._counts = [[0] * n, [0] * n, [0] * n]
        self._counted = False
        """True while any count is above 0."""

    def take(self, limits: Limits) -> None:
        """Replace the limits."""
        by_speed, by_torque, self.following_error = limits.supervision
        self._fastest = [by_speed * velocity for velocity in limits.velocity]
        self._strongest = [by_torque * torque for torque in limits.torque]

    def first_exceeded(self, state: ArmState, new: Values) -> ThresholdTooLow | None:
        """Return the first measured value that is beyond a threshold which `new` lowers, as a refusal, or None."""
        by_speed, by_torque, error = new.supervision
        for i in self._joints:
            values = (
                abs(state.actual_velocity[i]),
                abs(state.actual_torque[i]),
                abs(state.actual[i] - state.commanded[i]),
            )
            lower = by_speed * new.velocity[i], by_torque * new.torque[i], error
            present = self._fastest[i], self._strongest[i], self.following_error
            for quantity in range(len(values)):
                if lower[quantity] < present[quantity] and values[quantity] > lower[quantity]:
                    return ThresholdTooLow(self._first + i, quantity, values[quantity], lower[quantity])
        return None

    def reset(self) -> None:
        """Reset all counts."""
        self._counted = False
        for counts in self._counts:
            for i in self._joints:
                counts[i] = 0

    def check(self, state: ArmState) -> EmergencyStop | None:
        """Check the measurements of a cycle; return the first fault, or None."""
        error, cycles, fastest, strongest = self.following_error, self._cycles, self._fastest, self._strongest
        speeds, torques, errors = self._counts
        actual, commanded = state.actual, state.commanded
        actual_velocity, actual_torque = state.actual_velocity, state.actual_torque
        if not self._counted:
            for i in self._joints:
                # NaN counts as beyond the limit.
                if not (
                    -fastest[i] <= actual_velocity[i] <= fastest[i]
                    and -strongest[i] <= actual_torque[i] <= strongest[i]
                    and -error <= actual[i] - commanded[i] <= error
                ):
                    self._counted = True
                    break
            else:
                return None
        counted = False
        for i in self._joints:
            bound = fastest[i]
            value = actual_velocity[i]
            if -bound <= value <= bound:
                speeds[i] = 0
            else:
                speeds[i] += 1
                counted = True
                if speeds[i] >= cycles:
                    return OverSpeed(self._first + i, value, bound)
            bound = strongest[i]
            value = actual_torque[i]
            if -bound <= value <= bound:
                torques[i] = 0
            else:
                torques[i] += 1
                counted = True
                if torques[i] >= self._torque_cycles:
                    return OverTorque(self._first + i, value, bound)
            value = actual[i] - commanded[i]
            if -error <= value <= error:
                errors[i] = 0
            else:
                errors[i] += 1
                counted = True
                if errors[i] >= cycles:
                    return FollowingError(self._first + i, value, error)
        self._counted = counted
        return None
