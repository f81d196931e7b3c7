"""The cycle.

wake -> send the outputs of the last cycle -> receive -> decode -> machine state -> mode -> guard -> encode -> publish
-> clock discipline. Nothing in here logs, blocks, opens or grows.
"""

from __future__ import annotations

from rtcp.devices.io_box import IoBox
from rtcp.fieldbus.bus import ProcessData
from rtcp.realtime.clock import Sleeper, monotonic_ns
from rtcp.realtime.discipline import Discipline
from rtcp.runtime.arm import Arm
from rtcp.runtime.behaviour import Behaviour
from rtcp.runtime.blackboard import Blackboard
from rtcp.runtime.machine import State
from rtcp.runtime.orders import Orders
from rtcp.runtime.record import Recorder


class Loop:
    """Everything that happens once a cycle.

    Args:
        period_ns: the cycle.
        spin_ns: how long before the tick the timer wakes; the rest is waited for awake.
        data: the process image, slaves in SAFE-OP.
        arm: the joints.
        box: the IO box and the index of its slave, or None.
        behaviour: the machine's state.
        orders: takes commands.
        recorder: publishes what happened.
        blackboard: where commands come from.
        discipline: follows the reference clock, or None without distributed clocks.
    """

    def __init__(
        self,
        period_ns: int,
        spin_ns: int,
        data: ProcessData,
        arm: Arm,
        box: tuple[int, IoBox] | None,
        behaviour: Behaviour,
        orders: Orders,
        recorder: Recorder,
        blackboard: Blackboard,
        discipline: Discipline | None,
    ) -> None:
        self._period_ns = period_ns
        self._spin_ns = spin_ns
        self._data = data
        self._arm = arm
        self._box_slot = -1 if box is None else box[0]
        self._box = None if box is None else box[1]
        self._behaviour = behaviour
        self._orders = orders
        self._recorder = recorder
        self._blackboard = blackboard
        self._discipline = discipline
        self._shutdown = False

    def shut_down(self) -> None:
        """Ask for a controlled stop, drives disabled, and the end of `run`. Safe from a signal handler or a thread."""
        self._shutdown = True

    def run(self) -> None:
        """Run the cycle until it is asked to end and the drives are disabled (or 2 s have passed)."""
        data, arm, box, box_slot = self._data, self._arm, self._box, self._box_slot
        behaviour, orders, recorder = self._behaviour, self._orders, self._recorder
        discipline, command_waits = self._discipline, self._blackboard.command_waits
        period, spin, expected = self._period_ns, self._spin_ns, data.expected_wkc
        sleep = Sleeper().until
        half = period // 2
        planned = monotonic_ns() + period
        while not behaviour.done:
            sleep(planned - spin)
            while (woken := monotonic_ns()) < planned:
                pass
            data.send()
            wkc = data.receive()
            received = monotonic_ns()
            good = wkc == expected
            if good:
                arm.decode(data)
                if box is not None:
                    box.decode(data.input(box_slot))
            if command_waits():
                orders.take()
            if self._shutdown and behaviour.state is not State.CLOSING:
                behaviour.enter(State.CLOSING)
            behaviour.step(good)
            arm.encode(data)
            if box is not None:
                data.set_output(box_slot, box.encode())
            recorder.publish(woken, planned, received, wkc)
            if discipline is None:
                planned += period
            else:
                if wkc >= 0:
                    discipline.observe(woken, data.dc_time)
                else:
                    discipline.coast()
                planned = discipline.next_wakeup(planned)
            finished = monotonic_ns()
            recorder.compute_ns = finished - received
            # Late: whole ticks are skipped, never replayed in a burst; two frames are never closer than half a period.
            earliest = max(woken + half, finished)
            if planned < earliest:
                skipped = (earliest - planned + period - 1) // period
                recorder.missed += skipped
                planned += skipped * period
