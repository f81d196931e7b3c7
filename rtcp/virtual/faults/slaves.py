"""Faults of slaves and of the cables between them."""

from __future__ import annotations

from collections.abc import Callable
from types import MappingProxyType
from typing import Any, TypeVar

from rtcp.config.fault_kinds import PluginFault
from rtcp.config.faults import (
    AlFall,
    AlHang,
    AlRefuse,
    CableFault,
    ClockDrift,
    ClockJump,
    Corrupt,
    DriveFault,
    Fault,
    InputsFrozen,
    PowerFault,
    SdoAbort,
    SdoLate,
    StickCode,
    Sync0Lost,
    TerminalFault,
    WorkingCounter,
)
from rtcp.virtual.distributed_clock import Clock, SyncGenerator
from rtcp.virtual.faults import devices
from rtcp.virtual.faults.devices import FaultRefused
from rtcp.virtual.faults.selector import FrameSelector
from rtcp.virtual.protocol import State
from rtcp.virtual.segment import Damage, Segment
from rtcp.virtual.slave import Slave
from rtcp.virtual.wire import Miscount

__all__ = ["FaultRefused", "SlaveUndo", "Undo", "begin"]

_T = TypeVar("_T")

Undo = Callable[[int], None]
"""Ends a fault at an instant; it may have `over`, whether it has passed by itself."""


class SlaveUndo:
    """Ends one of these faults, once."""

    def __init__(self, segment: Segment, end: Undo | None, strikes: _Counted | None = None) -> None:
        self._segment = segment
        self._end = end
        self._strikes = strikes

    @property
    def over(self) -> bool:
        """Whether the fault has passed by itself: it happened once, or its burst is at its end."""
        return self._end is None or (self._strikes is not None and self._strikes.passed)

    @property
    def counts(self) -> dict[str, int]:
        """What was done to frames."""
        return {} if self._strikes is None else {self._strikes.what: self._strikes.count}

    def __call__(self, t: int) -> None:
        """End the fault at instant `t`."""
        over = self.over
        end, self._end = self._end, None
        if end is not None and not over:
            _catch_up(self._segment, t)
            end(t)
            self._segment.look_at(t)


class _Counted:
    """The frames that a fault strikes, counted."""

    def __init__(self, what: str, fault: Corrupt | WorkingCounter) -> None:
        self.what = what
        self.count = 0
        self.when_passed: Callable[[], object] | None = None
        """Called when the burst has passed: it costs nothing any more."""
        self._strikes = FrameSelector(fault)

    @property
    def passed(self) -> bool:
        return self._strikes.passed

    def __call__(self) -> bool:
        struck = self._strikes.next()
        self.count += struck
        if struck and self.passed and self.when_passed is not None:
            self.when_passed()
        return struck


def begin(segment: Segment, fault: Fault, t: int, lasts: float | None = None) -> SlaveUndo:
    """Let `fault` begin at instant `t`; return what ends it.

    `lasts` (s) is what was planned: the fault of a drive without it is a single occurrence and over at once.

    Raises:
        FaultRefused: the segment has no such slave, or it is not of the kind that can have this fault.
    """
    make: Callable[[Segment, Any, int], SlaveUndo] | None = _KINDS.get(type(fault))
    if isinstance(fault, PluginFault):
        make = _plugin
    if make is None:
        raise FaultRefused(f"{fault.name} is no fault of a slave or a cable")
    _catch_up(segment, t)
    undo = make(segment, fault, t)
    if isinstance(fault, DriveFault) and lasts is None:
        undo(t)
    segment.look_at(t)
    return undo


def _catch_up(segment: Segment, t: int) -> None:
    """What is due before `t` happens before what is to come."""
    if segment.next_event <= t:
        segment.tick(t)


def _slave(segment: Segment, number: int) -> Slave:
    if number > len(segment.slaves):
        raise FaultRefused(f"there is no slave {number}: the segment has slaves 1 to {len(segment.slaves)}")
    return segment.slaves[number - 1]


def _cable(segment: Segment, after: int) -> int:
    last = len(segment.slaves)
    if after >= last:
        raise FaultRefused(
            f"there is no cable behind slave {after}: cables lie behind slaves 0 (the master) to {last - 1}"
        )
    return after


def _cut(segment: Segment, fault: CableFault, t: int) -> SlaveUndo:
    cable = _cable(segment, fault.after)

    def join(_: int) -> None:
        segment.chain.join(cable)
        segment.rewire()

    segment.chain.cut(cable)
    segment.rewire()
    return SlaveUndo(segment, join)


def _power(segment: Segment, fault: PowerFault, t: int) -> SlaveUndo:
    _slave(segment, fault.slave)

    def on(t: int) -> None:
        segment.chain.power_on(fault.slave, t)
        segment.rewire()

    segment.chain.power_off(fault.slave, t)
    segment.rewire()
    return SlaveUndo(segment, on)


def _refuse(segment: Segment, fault: AlRefuse, t: int) -> SlaveUndo:
    refusals = _slave(segment, fault.slave).faults.refusals
    state = State[fault.state.replace("-", "_")]
    refusals.append((state, fault.code))
    return SlaveUndo(segment, lambda _: refusals.remove((state, fault.code)))


def _hang(segment: Segment, fault: AlHang, t: int) -> SlaveUndo:
    slave = _slave(segment, fault.slave)

    def go_on(t: int) -> None:
        slave.faults.hangs -= 1
        slave.application.attend(t)

    slave.faults.hangs += 1
    return SlaveUndo(segment, go_on)


def _fall(segment: Segment, fault: AlFall, t: int) -> SlaveUndo:
    slave = _slave(segment, fault.slave)
    if slave.application.state != State.OP:
        state = slave.application.state.name.replace("_", "-")
        raise FaultRefused(f"slave {fault.slave} is in {state}: al_fall takes a slave out of OP")
    slave.application.fall(State[fault.state.replace("-", "_")], fault.code)
    return SlaveUndo(segment, None)


def _late(segment: Segment, fault: SdoLate, t: int) -> SlaveUndo:
    delays = _slave(segment, fault.slave).faults.sdo_delays
    delay = round(fault.ms * 1e6)
    delays.append(delay)
    return SlaveUndo(segment, lambda _: delays.remove(delay))


def _abort(segment: Segment, fault: SdoAbort, t: int) -> SlaveUndo:
    aborts = _slave(segment, fault.slave).faults.sdo_aborts
    aborts.append((fault.index, fault.code))
    return SlaveUndo(segment, lambda _: aborts.remove((fault.index, fault.code)))


def _corrupt(segment: Segment, fault: Corrupt, t: int) -> SlaveUndo:
    strikes = _Counted("corrupted", fault)
    damage = Damage(_cable(segment, fault.after), strikes, fault.way == "back")
    return _list(segment, segment.damages, damage, strikes)


def _miscount(segment: Segment, fault: WorkingCounter, t: int) -> SlaveUndo:
    strikes = _Counted("not_counted", fault)
    miscount: Miscount = (_slave(segment, fault.slave), strikes)
    return _list(segment, segment.miscounts, miscount, strikes)


def _list(segment: Segment, listed: list[_T], entry: _T, strikes: _Counted) -> SlaveUndo:
    """Put `entry`, which calls `strikes`, on a list of the segment until its burst has passed or it is cleared."""

    def leave() -> None:
        listed.remove(entry)
        # entry -> strikes -> leave -> entry is a ring, and the segment's process collects none.
        strikes.when_passed = None

    listed.append(entry)
    strikes.when_passed = leave
    return SlaveUndo(segment, lambda _: leave(), strikes)


def _sync0(slave: Slave) -> SyncGenerator | None:
    return None if slave.esc.dc is None else slave.esc.dc.sync0


def _clock(segment: Segment, number: int) -> tuple[Slave, Clock]:
    slave = _slave(segment, number)
    if slave.clock is None:
        raise FaultRefused(f"slave {number} ({slave.device.identity.name}) has no distributed clock")
    return slave, slave.clock


def _lose_sync0(segment: Segment, fault: Sync0Lost, t: int) -> SlaveUndo:
    slave, _ = _clock(segment, fault.slave)

    def resume(t: int) -> None:
        slave.faults.sync0_losses -= 1
        if not slave.faults.sync0_losses and (sync0 := _sync0(slave)) is not None:
            sync0.resume(t)

    slave.faults.sync0_losses += 1
    if (sync0 := _sync0(slave)) is not None:
        sync0.suspend()
    return SlaveUndo(segment, resume)


def _jump(segment: Segment, fault: ClockJump, t: int) -> SlaveUndo:
    slave, clock = _clock(segment, fault.slave)
    clock.jump(round(fault.us * 1000))
    if (sync0 := _sync0(slave)) is not None and sync0.due is not None:
        sync0.schedule(t)
    return SlaveUndo(segment, None)


def _drift(segment: Segment, fault: ClockDrift, t: int) -> SlaveUndo:
    slave, _ = _clock(segment, fault.slave)

    def change(ppm: float, t: int) -> None:
        slave.faults.drift_ppm += ppm
        # Not the clock of before: the supply may have been away meanwhile.
        if slave.clock is not None:
            slave.clock.change_drift(ppm, t)

    change(fault.ppm, t)
    return SlaveUndo(segment, lambda t: change(-fault.ppm, t))


def _device(segment: Segment, fault: devices.DeviceFault, t: int) -> SlaveUndo:
    return SlaveUndo(segment, devices.begin([slave.device for slave in segment.slaves], fault))


def _plugin(segment: Segment, fault: PluginFault, t: int) -> SlaveUndo:
    return SlaveUndo(segment, fault.begin([slave.device for slave in segment.slaves]))


_KINDS: MappingProxyType[type[Fault], Callable[[Segment, Any, int], SlaveUndo]] = MappingProxyType({
    CableFault: _cut,
    PowerFault: _power,
    AlRefuse: _refuse,
    AlHang: _hang,
    AlFall: _fall,
    SdoLate: _late,
    SdoAbort: _abort,
    Corrupt: _corrupt,
    WorkingCounter: _miscount,
    DriveFault: _device,
    Sync0Lost: _lose_sync0,
    ClockJump: _jump,
    ClockDrift: _drift,
    TerminalFault: _device,
    InputsFrozen: _device,
    StickCode: _device,
})  # fmt: skip
