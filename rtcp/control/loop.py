"""The cycle.

wake -> send the outputs of the last cycle -> receive -> decode -> machine state -> mode -> guard -> encode -> publish
-> clock discipline. Nothing in here logs, blocks, opens or grows.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from rtcp.control.arm import Arm
from rtcp.control.behaviour import Behaviour
from rtcp.control.orders import Orders
from rtcp.control.record import Recorder
from rtcp.devices.driver import Driver
from rtcp.devices.io_box import IoBox
from rtcp.fieldbus.bus import ProcessData
from rtcp.ipc.blackboard import Blackboard
from rtcp.realtime.clock import Sleeper, monotonic_ns
from rtcp.realtime.discipline import Discipline


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
        now: the clock, ns; another one where time is simulated.
        others: drivers of slaves that are neither drives nor the IO box, with the indices of the slaves.
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
        now: Callable[[], int] = monotonic_ns,
        others: Sequence[tuple[int, Driver]] = (),
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
        self._command_waits = blackboard.command_waits
        self._discipline = discipline
        self._now = now
        self._others = tuple(others)
        self._half_ns = period_ns // 2
        self._expected = data.expected_wkc
        self._shutdown = False

    def shut_down(self) -> None:
        """Ask for a controlled stop, drives disabled, and the end of `run`. Safe from a signal handler or a thread."""
        self._shutdown = True

    def run(self) -> None:
        """Run the cycle until it is asked to end and the drives are disabled (or 2 s have passed)."""
        behaviour, cycle, spin = self._behaviour, self.cycle, self._spin_ns
        sleep = Sleeper().until
        planned = monotonic_ns() + self._period_ns
        while not behaviour.done:
            sleep(planned - spin)
            while (woken := monotonic_ns()) < planned:
                pass
            planned = cycle(planned, woken)

    def cycle(self, planned: int, woken: int) -> int:
        """Do one cycle, planned at `planned` and begun at `woken` (ns of the clock); return when the next is due."""
        data, arm, behaviour, recorder, now = self._data, self._arm, self._behaviour, self._recorder, self._now
        data.send()
        wkc = data.receive()
        received = now()
        good = wkc == self._expected
        behaviour.now_ns = woken
        if good:
            arm.decode(data)
            if self._box is not None:
                self._box.decode(data.input(self._box_slot))
            for slot, driver in self._others:
                driver.decode(data.input(slot))
        elif wkc > 0 and self._box is not None and behaviour.box_in_op:
            # Another slave is missing, and which ones were in the frame is not known. SOEM gives what a slave did not
            # fill in back as it was, so that the inputs are the box's, of now or of before.
            self._box.decode(data.input(self._box_slot))
            behaviour.hear_press()
        if self._command_waits():
            self._orders.take()
        if self._shutdown:
            behaviour.close()
        behaviour.step(good)
        arm.encode(data)
        if self._box is not None:
            data.set_output(self._box_slot, self._box.encode())
        for slot, driver in self._others:
            data.set_output(slot, driver.encode())
        recorder.publish(woken, planned, received, wkc)
        discipline = self._discipline
        if discipline is None:
            planned += self._period_ns
        else:
            if wkc >= 0:
                discipline.observe(woken, data.dc_time)
            else:
                discipline.holdover()
            planned = discipline.next_wakeup(planned)
        finished = now()
        recorder.compute_ns = finished - received
        # Late: whole ticks are skipped, never replayed in a burst; two frames are never closer than half a period.
        earliest = max(woken + self._half_ns, finished)
        if planned < earliest:
            period = self._period_ns
            skipped = (earliest - planned + period - 1) // period
            recorder.missed += skipped
            planned += skipped * period
        return planned
