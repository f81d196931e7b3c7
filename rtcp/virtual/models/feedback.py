"""What a drive tells of itself: actual values every step, its condition now and then, its errors when they happen."""

from __future__ import annotations

from collections import deque

from rtcp.virtual.device import Emergency
from rtcp.virtual.models.axis import Axis
from rtcp.virtual.models.drive_objects import COUNTS, HISTORY_LENGTH
from rtcp.virtual.models.mechanics import INCREMENTS_PER_RAD
from rtcp.virtual.models.number import number
from rtcp.virtual.models.protection import Condition, error_register
from rtcp.virtual.objects import ObjectDictionary


class Feedback:
    """The actual and demand values of a drive: entries kept, nothing looked up in a step."""

    def __init__(self, objects: ObjectDictionary, rated_torque: float) -> None:
        self._rated_torque = rated_torque
        self._statusword = number(objects, 0x6041)
        self._position_demand = number(objects, 0x6062)
        self._increments = number(objects, 0x6063)
        self._position = number(objects, 0x6064)
        self._velocity_demand = number(objects, 0x606B)
        self._velocity = number(objects, 0x606C)
        self._torque_demand = number(objects, 0x6074)
        self._torque = number(objects, 0x6077)
        self._current = number(objects, 0x6078)
        self._following = number(objects, 0x60F4)
        self._temperature = number(objects, 0x2000, 1)
        self._bus_voltage = number(objects, 0x2000, 2)
        self._overload = number(objects, 0x2000, 3)

    def publish(self, status: int, axis: Axis, following: float) -> None:
        """Write the statusword and what is measured; `following` is the following error in rad."""
        mechanics = axis.mechanics
        increments = round(mechanics.position * INCREMENTS_PER_RAD)
        self._statusword.value = status
        self._increments.value = increments
        self._position.value = round((increments / INCREMENTS_PER_RAD + axis.offset) * COUNTS)
        self._velocity.value = round(mechanics.velocity * COUNTS)
        # The current loop is ideal: the torque demanded is there.
        self._torque.value = self._torque_demand.value = round(axis.torque * COUNTS)
        self._position_demand.value = round(axis.demand * COUNTS)
        self._velocity_demand.value = round(axis.reference_velocity * COUNTS)
        self._following.value = round(following * COUNTS)

    def publish_condition(self, condition: Condition, torque: float) -> None:
        """Write what changes slowly, and the current that goes with `torque` Nm."""
        self._temperature.value = round(condition.temperature * 10.0)
        self._bus_voltage.value = round(condition.bus_voltage * 100.0)
        self._overload.value = min(0xFFFF, round(condition.overload * 1000.0))
        self._current.value = round(1000.0 * torque / self._rated_torque)


class ErrorLog:
    """The errors of a drive: 0x603F, 0x1001, 0x1003 and the emergency messages that wait to be sent."""

    def __init__(self, objects: ObjectDictionary) -> None:
        # A mailbox that nobody reads must not grow: the oldest messages go first.
        self.emergencies: deque[Emergency] = deque(maxlen=16)
        self._code = number(objects, 0x603F)
        self._register = number(objects, 0x1001)
        self._count = number(objects, 0x1003)
        self._fields = [number(objects, 0x1003, place) for place in range(1, HISTORY_LENGTH + 1)]

    def add(self, code: int) -> None:
        """Tell of an error: the newest stands at 0x1003:1."""
        self._code.value = code
        self._register.value |= error_register(code)
        fields = self._fields
        for newer, older in zip(fields[-2::-1], fields[:0:-1], strict=True):
            older.value = newer.value
        fields[0].value = code
        self._count.value = min(len(fields), self._count.value + 1)
        self.emergencies.append(Emergency(code, self._register.value))

    def reset(self) -> None:
        """Tell that no error is left (emergency message 0x0000); the history stays."""
        self._code.value = self._register.value = 0
        self.emergencies.append(Emergency(0, 0))
