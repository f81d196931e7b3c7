"""Instant of the next cycle after a late one, and number of skipped ticks; times in periods."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from random import Random

import pytest

from rtcp.control.cycle import ahead_of_sync0, make_discipline

from .rig import CONFIG, PERIOD_S, LoopRig

NewRig = Callable[..., LoopRig]
PERIOD_NS = round(PERIOD_S * 1e9)


class Late:
    """A rig with delays in its cycles.

    Args:
        phase: instant of the frame between two SYNC0.
    """

    def __init__(self, new_rig: NewRig, phase: float = 0.5) -> None:
        config = replace(CONFIG, bus=replace(CONFIG.ethercat, send_phase=phase))
        self.rig = rig = new_rig(config)
        self.sent: list[int] = []
        self.planned = rig.now_ns
        self._send, self._receive = rig.data.send, rig.data.receive
        rig.data.send, rig.data.receive = self._late_send, self._late_receive  # type: ignore[method-assign]

    def cycle(self, woken: float = 0.0, send: float = 0.0, busy: float = 0.0) -> None:
        """Do a cycle: its wake-up delay, then the delay until it sends, then the time until it ends."""
        self._before, self._after = round(send * PERIOD_NS), round(busy * PERIOD_NS)
        start = max(self.planned, self.rig.now_ns) + round(woken * PERIOD_NS)
        self.rig.now_ns = start
        self.planned = self.rig.loop.cycle(self.planned, start)

    def _late_send(self) -> None:
        self.rig.now_ns += self._before
        self.sent.append(self.rig.now_ns)
        self._send()

    def _late_receive(self) -> int:
        self.rig.now_ns += self._after
        return self._receive()


@pytest.mark.parametrize(
    ("woken", "send", "busy", "due", "skipped"),
    [
        (0.0, 0.0, 0.5, 1, 0),
        (0.4, 0.0, 0.2, 1, 0),
        # This frame comes after SYNC0, and that of the next tick would come before the same SYNC0.
        (0.6, 0.0, 0.1, 2, 1),
        (0.0, 0.6, 0.1, 2, 1),
        # The frame of the next tick still comes to the drives before their SYNC0, half a period after the tick.
        (0.0, 0.0, 1.2, 1, 0),
        (0.4, 0.0, 0.8, 1, 0),
        (0.0, 0.0, 1.3, 2, 1),
        (0.0, 0.0, 3.2, 3, 2),
        (3.2, 0.0, 0.1, 4, 3),
    ],
)
def test_a_late_cycle_skips_the_ticks_whose_frame_would_be_too_late(
    new_rig: NewRig, woken: float, send: float, busy: float, due: int, skipped: int
) -> None:
    late = Late(new_rig)
    began = late.planned
    late.cycle(woken, send, busy)
    assert late.planned == began + due * PERIOD_NS
    assert late.rig.loop.missed == skipped


@pytest.mark.parametrize("phase", [0.1, 0.3, 0.5, 0.8])
def test_no_drive_gets_two_frames_before_one_sync0_whatever_is_late(new_rig: NewRig, phase: float) -> None:
    late = Late(new_rig, phase)
    first = late.planned
    random = Random(1)
    for _ in range(3000):
        delays = [random.choice((0.0, 0.0, 0.0, random.random(), 3 * random.random())) for _ in range(3)]
        late.cycle(*delays)
    windows = [(sent - first - round((1 - phase) * PERIOD_NS)) // PERIOD_NS for sent in late.sent]
    assert all(after > before for before, after in pairwise(windows))
    assert min(b - a for a, b in pairwise(late.sent)) >= PERIOD_NS // 2


def test_while_the_clock_is_not_followed_no_cycle_begins_late(new_rig: NewRig) -> None:
    late = Late(new_rig)
    began = late.planned
    late.rig.discipline.locked = False
    late.cycle(busy=1.1)
    assert late.planned == began + 2 * PERIOD_NS


def test_of_several_sync0_the_first_after_the_frame_counts() -> None:
    slaves = list(CONFIG.slaves)
    assert sum(1 for slave in slaves if slave.device.assign_activate) >= 2
    last = slaves[-1]
    slaves[-1] = replace(last, device=replace(last.device, sync0_shift_us=-0.3 * PERIOD_NS / 1e3))
    shifted = replace(CONFIG, slaves=tuple(slaves), bus=replace(CONFIG.ethercat, send_phase=0.5))
    assert ahead_of_sync0(shifted) == pytest.approx(0.2 * PERIOD_NS, abs=1)
    none = tuple(replace(slave, device=replace(slave.device, assign_activate=0)) for slave in slaves)
    assert ahead_of_sync0(replace(shifted, slaves=none)) == PERIOD_NS // 2


@pytest.mark.parametrize("phase", [0.25, 0.7])
@pytest.mark.parametrize("shift_us", [0.0, 60.0, -40.0])
def test_frames_are_sent_at_their_phase_after_the_first_sync0(phase: float, shift_us: float) -> None:
    slaves = tuple(replace(slave, device=replace(slave.device, sync0_shift_us=shift_us)) for slave in CONFIG.slaves)
    config = replace(CONFIG, slaves=slaves, bus=replace(CONFIG.ethercat, send_phase=phase))
    discipline = make_discipline(config)
    wanted = 1000 * PERIOD_NS + round(1000.0 * shift_us + phase * PERIOD_NS)
    for late_ns in (0, 7000, -7000):
        discipline.observe(10**12, wanted + late_ns)
        assert discipline.raw_ns == late_ns
    none = tuple(replace(slave, device=replace(slave.device, assign_activate=0)) for slave in slaves)
    assert make_discipline(replace(config, slaves=none)) is None


class Paced:
    """Stands for a robot's controller, which sets the pace: a mock, as only the real one can be early or late."""

    def __init__(self, rig: LoopRig) -> None:
        self._rig = rig
        self.deadline = self.sent = 0
        self.arrives_after = 0.0
        """Time from the plan to the message, periods; greater than 0.5: it is lost."""

    def receive_until(self, deadline_ns: int) -> int:
        self.deadline = deadline_ns
        planned = deadline_ns - PERIOD_NS // 2
        self._rig.now_ns = planned + round(self.arrives_after * PERIOD_NS)
        return self._rig.data.receive() if self.arrives_after <= 0.5 else -1

    def send(self) -> None:
        self.sent += 1


@pytest.mark.parametrize(("arrives_after", "next_after"), [(0.0, 1.0), (0.25, 1.25), (0.6, 1.0), (2.5, 2.5)])
def test_the_next_message_of_a_bus_that_sets_the_pace_is_due_a_period_after_the_last_or_after_its_plan(
    rig: LoopRig, arrives_after: float, next_after: float
) -> None:
    paced, planned = Paced(rig.start()), rig.now_ns
    paced.arrives_after = arrives_after
    records = rig.observer.head
    rig.data.send()
    due = rig.loop.answer(paced, planned)  # type: ignore[arg-type]
    assert (paced.deadline, due) == (planned + PERIOD_NS // 2, planned + round(next_after * PERIOD_NS))
    assert (paced.sent, rig.observer.head) == (1, records + 1)
    assert rig.arm.state.now_ns == rig.now_ns
    assert rig.context.lost == (0 if arrives_after <= 0.5 else 1)
