"""The cycle record: gathered once a cycle into one preallocated list, in the order of the layout."""

from __future__ import annotations

from rtcp.control.arm import Arm
from rtcp.control.behaviour import Behaviour
from rtcp.control.bus_service import BusService
from rtcp.control.operator import Operator
from rtcp.devices.io_box import IoBox
from rtcp.fieldbus.bus import ProcessData
from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.layout import (
    FLAG_ALL_OP,
    FLAG_ARM_HAS_STICK,
    FLAG_DC_LOCKED,
    FLAG_EMERGENCY_STOP,
    FLAG_ENABLED,
    FLAG_MOTION_ALLOWED,
    FLAG_SWITCHING,
    PER_JOINT,
    SCALARS,
)
from rtcp.ipc.machine import Code
from rtcp.realtime.discipline import Discipline

_LARGEST_COUNTER = 0x7FFF
"""What a damaged frame may bring is more than any segment has."""
_LONGEST_NS = 2_000_000_000
_AT = {name: at for at, (name, _) in enumerate(SCALARS[1:])}


class Recorder:
    """Publishes a record a cycle.

    Args:
        data: the process image.
        arm: the joints.
        box: the IO box, or None.
        operator: the inputs that have a meaning.
        behaviour: the machine's state.
        blackboard: where the records go.
        service: knows whether all slaves are in OP.
        discipline: knows the clock's offset, or None.
    """

    def __init__(
        self,
        data: ProcessData,
        arm: Arm,
        box: IoBox | None,
        operator: Operator,
        behaviour: Behaviour,
        blackboard: Blackboard,
        service: BusService,
        discipline: Discipline | None,
    ) -> None:
        self._data = data
        self._arm = arm
        self._box = box
        self._operator = operator
        self._behaviour = behaviour
        self._blackboard = blackboard
        self._service = service
        self._discipline = discipline
        self._values: list[float] = [0] * (len(SCALARS) - 1 + len(PER_JOINT) * len(arm.drives))
        self._values[_AT["wkc_expected"]] = data.expected_wkc
        self._locked = False
        self.missed = 0
        """Ticks of the grid at which no frame was sent."""
        self.compute_ns = 0
        """From an answer to the end of its cycle: known only after that cycle's record, so the next one carries it."""

    def publish(self, woken: int, planned: int, received: int, wkc: int) -> None:
        """Publish the cycle that was planned at `planned`, woke at `woken` and had its answer at `received` (ns)."""
        values, behaviour, discipline, box = self._values, self._behaviour, self._discipline, self._box
        arm, operator = self._arm, self._operator
        flags = FLAG_ALL_OP if self._service.all_op else 0
        offset = filtered = 0
        if discipline is not None:
            offset, filtered = discipline.raw_ns, int(discipline.filtered_ns)
            if discipline.locked:
                flags |= FLAG_DC_LOCKED
            if discipline.locked is not self._locked:
                self._locked = discipline.locked
                self._blackboard.event(Code.DC_LOCKED if self._locked else Code.DC_UNLOCKED)
        if behaviour.all_enabled:
            flags |= FLAG_ENABLED
        if behaviour.switching:
            flags |= FLAG_SWITCHING
        if operator.emergency_stop:
            flags |= FLAG_EMERGENCY_STOP
        if operator.permitted:
            flags |= FLAG_MOTION_ALLOWED
        if operator.arm_has_stick:
            flags |= FLAG_ARM_HAS_STICK
        inputs = outputs = counter = 0
        if box is not None:
            inputs, outputs, counter = box.inputs, box.outputs, box.counter
        mode = arm.motions.active
        # One slice, in the order of layout.SCALARS: cheaper than an index a field.
        values[: len(_AT)] = (
            behaviour.cycle,
            woken,
            self._data.dc_time,
            behaviour.state,
            arm.mode,
            arm.motions.mode,
            operator.stick_mode,
            flags,
            min(wkc, _LARGEST_COUNTER),
            self._data.expected_wkc,
            self.missed,
            behaviour.lost,
            min(woken - planned, _LONGEST_NS),
            min(received - woken, _LONGEST_NS),
            min(self.compute_ns, _LONGEST_NS),
            offset,
            filtered,
            inputs,
            outputs,
            counter,
            behaviour.fault,
            behaviour.limit,
            arm.output_limiter.held | arm.trajectory_guard.held,
            behaviour.enables,
            behaviour.moves,
            mode.elapsed_s,
            mode.duration_s,
        )
        at = len(_AT)
        n = len(arm.drives)
        target = arm.state.commanded
        for i, drive in enumerate(arm.drives):
            values[at + i] = drive.position
            values[at + n + i] = drive.velocity
            values[at + 2 * n + i] = drive.torque
            values[at + 3 * n + i] = target[i]
            values[at + 4 * n + i] = drive.statusword
        self._blackboard.publish(values)
