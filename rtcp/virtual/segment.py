"""A chain of virtual slaves: frames in and out, and the events that time brings."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

from rtcp.config.document import Finding, read
from rtcp.config.model import ConfigError
from rtcp.config.segment import SegmentConfig, load_segment
from rtcp.virtual.arm import VirtualArm, make_arm
from rtcp.virtual.device import DeviceModel, OptionError, create
from rtcp.virtual.objects import SdoAbort
from rtcp.virtual.pdo import RX_ASSIGN, TX_ASSIGN, PdoImage
from rtcp.virtual.protocol import Register
from rtcp.virtual.slave import Slave, make_slaves
from rtcp.virtual.wire import Miscount, Wire


class Chain:
    """Cable n lies behind slave n (0: between the master and slave 1); slaves count from 1.

    What is broken twice must be joined twice.
    """

    def __init__(self, slaves: Sequence[Slave]) -> None:
        self._slaves = tuple(slaves)
        self._cuts = [0] * len(self._slaves)
        self._outages = [0] * len(self._slaves)
        self.reach = len(self._slaves)
        """Number of slaves that a frame reaches."""
        self.returns = True
        """Whether frames come back: False where the loop of a port without a link is open."""

    def cut(self, cable: int) -> None:
        """Break a cable."""
        self._cuts[cable] += 1
        self.update()

    def join(self, cable: int) -> None:
        """Join a cable again."""
        self._cuts[cable] -= 1
        self.update()

    def power_off(self, number: int, t: int) -> None:
        """Switch a slave's supply off."""
        self._outages[number - 1] += 1
        if self._outages[number - 1] == 1:
            self._slaves[number - 1].power_off(t)
        self.update()

    def power_on(self, number: int, t: int) -> None:
        """Switch a slave's supply on again."""
        self._outages[number - 1] -= 1
        if not self._outages[number - 1]:
            self._slaves[number - 1].power_on(t)
        self.update()

    def _linked(self, cable: int) -> bool:
        """Whether the cable is whole and what is at both of its ends has supply."""
        if cable == len(self._slaves) or self._cuts[cable] or self._outages[cable]:
            return False
        return cable == 0 or not self._outages[cable - 1]

    def update(self) -> None:
        """Update ports and turnaround times to the state of the chain."""
        links = [self._linked(cable) for cable in range(len(self._slaves) + 1)]
        self.reach, self.returns = 0, True
        blocked = False
        for place, slave in enumerate(self._slaves):
            if self._outages[place]:
                blocked = True
                continue
            esc = slave.esc
            esc.set_links(links[place], links[place + 1])
            blocked = blocked or not links[place] or esc.closed(0, links[place])
            esc.loops_written = False
            if blocked:
                continue
            self.reach = place + 1
            if esc.closed(1, links[place + 1]):
                blocked = True
            elif not links[place + 1]:
                self.returns, blocked = False, True
        if self.reach:
            self._turn_round(self._slaves[: self.reach])

    def restart(self, slave: Slave, t: int) -> None:
        """Reset a slave's controller and device, as its supply going and coming back would."""
        slave.power_off(t)
        slave.power_on(t)
        self.update()

    @staticmethod
    def _turn_round(reached: Sequence[Slave]) -> None:
        last = reached[-1]
        for slave in reached:
            if slave.esc.dc is not None:
                slave.esc.dc.turnaround = None if slave is last else 2 * (last.delay - slave.delay)


DELAYS = (0, 820, 1660, 2500, 3320, 4160, 5020)
"""Propagation delays in ns from the master to the slaves of the robot."""
FURTHER_DELAY = 840
"""What every slave after these adds, in ns."""
IDLE_TICK = 1_000_000
"""Longest time in ns between two looks at watchdogs and devices."""
TOGETHER = 2_000
"""SYNC0 pulses that lie within this many ns are handled at once."""
REPLAYED_PULSES = 20
"""SYNC0 pulses made up for after the process was stopped; older ones pass unseen."""
BREATH = 50_000
"""SYNC0 that comes faster than it can be followed is looked at again after so many ns: frames come first."""


class Damage(NamedTuple):
    """A cable that damages a frame when `strikes` says so; the cable's number is that of the slave before it."""

    cable: int
    strikes: Callable[[], bool]
    back: bool = False
    """Whether frames are damaged on their way back to the master."""


class Segment:
    """The slaves of a segment, driven by three calls.

    `process` answers a frame in place, `settle` does what the frame asked of the slaves once the answer is on its way,
    `tick` lets events in time happen. What takes long, the steps of the devices, waits in `step_one`, one at a time, so
    that frames come in between. Instants are ns of the host's monotonic clock.
    """

    def __init__(self, slaves: Sequence[Slave], t: int) -> None:
        self.slaves = tuple(slaves)
        self.chain = Chain(self.slaves)
        self.miscounts: list[Miscount] = []
        self.damages: list[Damage] = []
        self.arm: VirtualArm | None = None
        """What the drives turn; None: each has its own load alone."""
        self._attention: list[Slave] = []
        self._waiting: deque[Slave] = deque()
        self._next_tick = t + IDLE_TICK
        self.next_event = t + IDLE_TICK
        """Instant of the next call of `tick` that is needed."""
        self.rewire()

    def rewire(self) -> None:
        """Route frames to the slaves that they reach now."""
        self._wire = Wire(self.slaves[: self.chain.reach], self.miscounts)
        for slave in self.slaves:
            slave.esc.on_attention = self._attention_of(slave)

    def _attention_of(self, slave: Slave) -> Callable[[], None]:
        def call() -> None:
            if slave not in self._attention:
                self._attention.append(slave)

        return call

    def process(self, frame: bytearray, size: int, t: int) -> bool:
        """Answer a frame in place, see `Wire.process`; False: nothing comes back of it."""
        if self.damages or not self._wire.slaves or not self.chain.returns:
            return self._process_faulty(frame, size, t)
        return self._wire.process(frame, size, t)

    def _process_faulty(self, frame: bytearray, size: int, t: int) -> bool:
        """Answer a frame that may not come back, or not come far."""
        reach = self.chain.reach
        struck = [damage for damage in tuple(self.damages) if damage.cable < reach and damage.strikes()]
        if not struck:
            return bool(reach) and self._wire.process(frame, size, t) and self.chain.returns
        out = [damage.cable for damage in struck if not damage.back]
        if out:
            self._damage_out(frame, size, t, min(out))
        else:
            self._wire.process(frame, size, t)
            self.settle(t)
            # The first that it meets on its way back.
            self._count_back(max(damage.cable for damage in struck))
        return False

    def _damage_out(self, frame: bytearray, size: int, t: int, far: int) -> None:
        """Let a frame be sound up to slave `far` only."""
        whole, self._wire = self._wire, Wire(self.slaves[:far], self.miscounts, passing=True)
        self._wire.process(frame, size, t)
        self.settle(t)
        self._wire = whole
        first = self.slaves[far].esc
        first.count(Register.RX_ERRORS)
        first.count(Register.RX_ERRORS + 1)
        for slave in self.slaves[far + 1 : self.chain.reach]:
            slave.esc.count(Register.FORWARDED_RX_ERRORS)

    def _count_back(self, cable: int) -> None:
        """Let the slaves count a frame that was damaged on its way back over `cable`; they get it at port 1."""
        if cable:
            last = self.slaves[cable - 1].esc
            last.count(Register.RX_ERRORS + 2)
            last.count(Register.RX_ERRORS + 3)
        for slave in self.slaves[: max(0, cable - 1)]:
            slave.esc.count(Register.FORWARDED_RX_ERRORS + 1)

    def settle(self, t: int) -> None:
        """Do what the frames since the last call, the last of which arrived at `t`, asked of the slaves."""
        for followers, reference, at in self._wire.references:
            for slave in followers:
                if slave.clock is not None:
                    slave.clock.follow(at + slave.delay, reference)
        self._wire.references.clear()
        if self._wire.done:
            # A SYNC0 before this frame that nobody has noticed yet comes first.
            if self.next_event <= t:
                self.tick(t)
            for plan in self._wire.done:
                for esc, manager in plan.written:
                    esc.on_outputs(manager, t)
            self._wire.done.clear()
            for slave in self._wire.slaves:
                if not slave.application.by_sync0:
                    slave.application.latch()
                    self._queue(slave, t)
        if self._attention:
            asking, self._attention = self._attention, []
            for slave in asking:
                slave.application.attend(t)
                if slave.esc.reset_requested:
                    self.chain.restart(slave, t)
                    self.rewire()
                elif slave.esc.loops_written:
                    self.chain.update()
                    self.rewire()
            self.look_at(t)

    def look_at(self, t: int) -> None:
        """See to it that a `tick` comes at `t`: something has changed that it has to follow."""
        self._next_tick = min(self._next_tick, t)
        self.next_event = min(self.next_event, self._next_tick)

    def tick(self, now: int) -> None:
        """Handle every SYNC0 up to `now`, and once a millisecond watchdogs and the devices that no SYNC0 steps."""
        earliest = now + IDLE_TICK
        idle = now >= self._next_tick
        for slave in self.slaves:
            application = slave.application
            dc = slave.esc.dc
            if dc is not None and (due := dc.sync0.due) is not None:
                if due <= now + TOGETHER:
                    due = self._pulse(slave, now)
                if due is not None and due < earliest:
                    earliest = due
            if idle:
                application.watch(now)
                if not application.by_sync0 or not application.sync.running:
                    application.latch()
                    self._queue(slave, now)
        if idle:
            if self.arm is not None:
                self.arm.update(now)
            self._next_tick = now + IDLE_TICK
        self.next_event = min(earliest, self._next_tick)

    def _pulse(self, slave: Slave, now: int) -> int | None:
        """Handle the SYNC0 pulses of `slave` that are due at `now`; return the instant of its next one."""
        dc = slave.esc.dc
        if dc is None:
            return None
        sync0 = dc.sync0
        cycle = sync0.cycle
        if sync0.due is not None and cycle and now - sync0.due > REPLAYED_PULSES * cycle:
            sync0.skip_to(now - REPLAYED_PULSES * cycle)
        for _ in range(REPLAYED_PULSES + 2):
            due = sync0.due
            if due is None or due > now + TOGETHER:
                return due
            sync0.fire()
            if slave.application.by_sync0:
                slave.application.pulse(now - due < cycle)
                self._queue(slave, due)
        return now + BREATH

    def _queue(self, slave: Slave, t: int) -> None:
        if slave.queued_until is None:
            self._waiting.append(slave)
        slave.queued_until = t

    @property
    def busy(self) -> bool:
        """Whether devices wait to be stepped."""
        return bool(self._waiting)

    def step_one(self) -> Slave | None:
        """Step the device that has waited longest; return its slave."""
        if not self._waiting:
            return None
        slave = self._waiting.popleft()
        until, slave.queued_until = slave.queued_until, None
        if until is not None:
            slave.application.advance(until)
        return slave


def default_delays(count: int) -> tuple[int, ...]:
    """Propagation delays in ns for a chain of `count` slaves."""
    further = range(max(0, count - len(DELAYS)))
    return (DELAYS + tuple(DELAYS[-1] + FURTHER_DELAY * (n + 1) for n in further))[:count]


def make_segment(config: SegmentConfig, t: int) -> Segment:
    """Build the slaves that `config` lists; their clocks start at instant `t` (ns, CLOCK_MONOTONIC).

    Raises:
        ConfigError: one sentence for each mistake: an unknown model or option, process data that are too long or map
            what does not exist, or delays that fall along the chain.
    """
    devices: list[DeviceModel] = []
    findings: list[Finding] = []
    for i, entry in enumerate(config.slaves):
        try:
            device = create(entry.model, **entry.options)
            for assignment in (RX_ASSIGN, TX_ASSIGN):
                PdoImage.from_assignment(device.objects, assignment)
            devices.append(device)
        except OptionError as error:
            findings += [(("slaves", i, *where), text) for where, text in error.findings]
        except (SdoAbort, ValueError) as error:
            findings.append((("slaves", i, "model"), f"the process data of {entry.model} cannot be laid out: {error}"))
    delays = [
        usual if entry.delay_ns is None else entry.delay_ns
        for entry, usual in zip(config.slaves, default_delays(len(config.slaves)), strict=True)
    ]
    for i, (before, delay) in enumerate(pairwise(delays), 1):
        if delay < before:
            text = f"found {delay} ns, allowed is at least the {before} ns of the slave before it"
            findings.append((("slaves", i, "delay_ns"), text))
    if findings:
        raise ConfigError(read(config.source).sentences(findings))
    drifts = [entry.drift_ppm for entry in config.slaves]
    aliases = [entry.alias for entry in config.slaves]
    segment = Segment(make_slaves(devices, drifts, delays, aliases, t), t)
    segment.arm = make_arm(config, devices)
    return segment


def check_segment(path: Path) -> None:
    """Check that a segment can be made of the file.

    Raises:
        ConfigError: one sentence for each mistake: file, line, key, what was found and what is allowed.
    """
    make_segment(load_segment(path), 0)
