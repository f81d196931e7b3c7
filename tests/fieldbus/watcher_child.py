"""The master's side of the watcher's tests: a process of its own, as `master_child`."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from rtcp.config import default_config, load
from rtcp.config.model import SlaveConfig
from rtcp.fieldbus import AlState
from rtcp.fieldbus.bus import station_of
from rtcp.fieldbus.slave_setup import SlaveRestorer, read_set_up
from rtcp.fieldbus.soem import SoemBus
from rtcp.fieldbus.supervision import SlaveWatcher
from rtcp.ipc.codes import state_name
from rtcp.ipc.events import Event
from rtcp.ipc.names import Names
from rtcp.virtual.faults.control import SegmentClient
from tests.fieldbus import master_child, terminals
from tests.fieldbus.master_child import Cycle, arm, patient, to_op
from tests.waiting import HANG_S

PERIOD = 2_000_000
PATIENCE_S = HANG_S
"""Limit that keeps a broken watcher from blocking the tests."""
SM_STATUS = 5
WATCHDOG_MS = 600
BESIDE = 15
BURSTS, BURST = 4, 100
MISSED = 2
"""Frames that may be damaged between the reading of a counter and its clearing."""


def registers(bus: SoemBus, position: int) -> dict[str, str]:
    """Return the registers that a restoration must bring back."""
    station = station_of(position)
    managers = bytearray(bus.port.read(station, 0x0800, 0x40) or b"")
    for at in range(SM_STATUS, len(managers), 8):
        managers[at] = 0
    values = {"managers": bytes(managers)}
    for name, address, length in (
        ("station", 0x0010, 2),
        ("fmmus", 0x0600, 0x80),
        ("watchdog", 0x0420, 2),
        ("delay", 0x0928, 4),
        ("activation", 0x0981, 1),
        ("cycle", 0x09A0, 4),
    ):
        values[name] = bus.port.read(station, address, length) or b""
    return {name: data.hex() for name, data in values.items()}


def clocks(bus: SoemBus, count: int) -> list[tuple[int, int]]:
    """Return for each slave its clock's difference from the reference's and its SYNC0's phase in the cycle, ns."""
    rows = []
    for position in range(1, count + 1):
        station = station_of(position)
        difference = int.from_bytes(bus.port.read(station, 0x092C, 4) or b"", "little")
        start = int.from_bytes(bus.port.read(station, 0x0990, 8) or b"", "little")
        sign = -1 if difference >> 31 else 1
        rows.append((sign * (difference & 0x7FFF_FFFF), start % PERIOD))
    return rows


class Watching:
    """Runs the watcher every 10 ms, as the service thread does."""

    def __init__(self, watcher: SlaveWatcher) -> None:
        self.watcher = watcher
        self.left: list[int] = []
        self.longest_s = 0.0
        self.seen: list[list[str]] = [[] for _ in watcher.slaves]

    def until(self, met: Any) -> None:
        end = time.monotonic() + PATIENCE_S
        while not met() and time.monotonic() < end:
            self.turn()

    def during(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        self.until(lambda: time.monotonic() >= end)

    def turn(self) -> None:
        began = time.monotonic()
        if position := self.watcher.turn():
            self.left.append(position)
        self.longest_s = max(self.longest_s, time.monotonic() - began)
        for states, slave in zip(self.seen, self.watcher.slaves, strict=True):
            words = state_name(slave.al_status)
            if states[-1:] != [words]:
                states.append(words)
        time.sleep(0.01)


class Watched:
    """A segment in OP with its cycle and its watcher; an episode is a fault and its recovery."""

    def __init__(
        self, bus: SoemBus, count: int, client: SegmentClient, slaves: Sequence[SlaveConfig] | None = None
    ) -> None:  # fmt: skip
        self.bus = bus
        self.count = count
        self.client = client
        self.slaves = [patient(config, WATCHDOG_MS) for config in slaves or arm(count)]
        self.names = Names(replace(load(default_config()), slaves=tuple(self.slaves)))
        self.data = bus.configure(self.slaves, PERIOD)
        self.cycle = Cycle(self.data, PERIOD)
        to_op(bus, self.cycle)
        self.before = self.registers()

    def registers(self) -> list[dict[str, str]]:
        return [registers(self.bus, position) for position in range(1, self.count + 1)]

    def strange_watcher(self, position: int, report: Any, serial: int) -> SlaveWatcher:
        """Return a watcher that expects another device at `position`; `serial`: of the same kind, with this number."""
        own = self.slaves[position - 1].device
        other = own if serial else replace(own, product_id=0x4711)
        changed = [
            replace(config, device=other) if at == position else config for at, config in enumerate(self.slaves, 1)
        ]
        set_ups = [read_set_up(self.bus.port, at, config.name, serial) for at, config in enumerate(self.slaves, 1)]
        restorer = SlaveRestorer(self.bus.port, changed, set_ups, self.bus.sdo, PERIOD, self.bus.system_time)
        return SlaveWatcher(self.bus.port, self.count, restorer, report)

    def episode(
        self, faults: list[dict[str, Any]], act: Any = None, foreign: int = 0, serial: int = 0
    ) -> dict[str, Any]:  # fmt: skip
        """Begin faults, watch until every slave is in OP again, and return the results.

        `act` runs meanwhile, and its result is among them; `foreign` and `serial`: see `strange_watcher`.
        """
        reported: list[str] = []

        def report(event: Event) -> None:
            reported.append(self.names.message(event))

        watcher = self.strange_watcher(foreign, report, serial) if foreign else self.bus.watcher(report)
        watching = Watching(watcher)

        def watch() -> dict[str, Any]:
            began = time.monotonic()
            for fault in faults:
                self.client.fault(fault)
            acted = act(watching) if act is not None else None
            lost = faults and act is None
            watching.until(lambda: watcher.all_op and (not lost or any(slave.recovered for slave in watcher.slaves)))
            took_s = time.monotonic() - began
            # Drift compensation ends before the clocks are compared.
            watching.during(0.6 if any(fault["fault"] in ("power", "clock_jump") for fault in faults) else 0.0)
            return {
                "reported": reported, "left": watching.left, "took_s": took_s, "longest_s": watching.longest_s,
                "states": [state_name(slave.al_status) for slave in watcher.slaves],
                "seen": watching.seen, "acted": acted,
                "lost": [slave.lost for slave in watcher.slaves],
                "recovered": [slave.recovered for slave in watcher.slaves],
                "errors": [[sum(slave.rx), sum(slave.forwarded), sum(slave.links)] for slave in watcher.errors.of],
                "before": self.before, "after": self.registers(), "clocks": clocks(self.bus, self.count),
            }  # fmt: skip

        result: dict[str, Any] = self.cycle.run(watch)
        self.cycle.wkcs.clear()
        self.cycle.for_cycles(20)
        result["whole"] = self.data.expected_wkc in self.cycle.wkcs
        return result

    # -- actions during an episode --------------------------------------------------------------------------------

    def al_states(self) -> list[str]:
        return [slave["al"] for slave in self.client.truth()["slaves"]]

    def leave_alone(self, watching: Watching) -> list[str]:
        """Watch for a while; then let the watcher that expects the right device recover it."""
        watching.during(0.5)
        states = self.al_states()
        right = Watching(self.bus.watcher(lambda event: None))
        right.turn()
        right.until(lambda: right.watcher.all_op)
        watching.turn()
        return states

    def park(self, watching: Watching) -> list[str]:
        watching.watcher.park()
        watching.until(lambda: all(slave.state is AlState.PREOP for slave in watching.watcher.slaves))
        watching.during(0.3)
        states = self.al_states()
        watching.watcher.resume()
        return states

    def read_beside(self, watching: Watching) -> dict[str, Any]:
        """Read an object of slave 3 again and again while slave 2 is being set up."""
        watching.until(lambda: watching.watcher.slaves[1].work is not None)
        names, count = set(), 0
        while watching.watcher.slaves[1].work is not None and count < BESIDE:
            watching.turn()
            names.add(self.bus.sdo(3).read(0x1008, 0).decode())
            count += 1
        return {"names": sorted(names), "count": count}

    def count_damage(self, watching: Watching) -> None:
        """Damage more frames than a counter holds, in bursts that it holds."""
        errors = watching.watcher.errors.of
        for number in range(1, BURSTS + 1):
            self.client.fault({"fault": "corrupt", "after": 1, "burst": BURST})
            least = number * (BURST - MISSED)
            watching.until(lambda least=least: sum(errors[1].rx) >= least and sum(errors[2].forwarded) >= least)

    def count_links(self, watching: Watching) -> None:
        watching.until(lambda: all(any(slave.links) for slave in watching.watcher.errors.of[1:]))


def episodes(bus: SoemBus, count: int, control: str) -> Any:
    """Cause one fault after the other on one segment; return the results."""
    with SegmentClient(Path(control)) as client:
        watched = Watched(bus, count, client)
        return {
            "supply": watched.episode([{"fault": "power", "slave": 2, "lasts": 0.05}]),
            "reference": watched.episode([{"fault": "power", "slave": 1, "lasts": 0.05}]),
            "cable": watched.episode([{"fault": "cable", "after": 1, "lasts": 1.2}]),
            "SAFE-OP": watched.episode([{"fault": "al_fall", "slave": 3, "state": "SAFE-OP", "code": 0x1B}]),
            "PRE-OP": watched.episode([{"fault": "al_fall", "slave": 3, "state": "PRE-OP", "code": 0x1B}]),
            "refusal": watched.episode(
                [
                    {"fault": "al_refuse", "slave": 2, "code": 0x52, "lasts": 1.2},
                    {"fault": "al_fall", "slave": 2},
                    {"fault": "al_fall", "slave": 3},
                ]
            ),
            "clock": watched.episode([{"fault": "clock_jump", "slave": 3, "us": 20_000}]),
            "late": watched.episode(
                [
                    {"fault": "sdo_late", "slave": 2, "ms": 600, "lasts": 2.0},
                    {"fault": "al_fall", "slave": 2, "state": "PRE-OP"},
                ],
                watched.read_beside,
            ),
            "foreign": watched.episode([{"fault": "power", "slave": 3, "lasts": 0.05}], watched.leave_alone, foreign=3),
            "swapped": watched.episode(
                [{"fault": "power", "slave": 3, "lasts": 0.05}], watched.leave_alone, foreign=3, serial=0x4711
            ),
            "parked": watched.episode([], watched.park),
            "damage": watched.episode([], watched.count_damage),
            "link": watched.episode([{"fault": "cable", "after": 2, "lasts": 0.05}], watched.count_links),
        }


def branches(bus: SoemBus, count: int, control: str, kinds: list[str]) -> Any:
    """Break the cable to the branch that frames pass first, and the supply of the other one's first slave."""
    with SegmentClient(Path(control)) as client:
        watched = Watched(bus, count, client, [terminals.slave(f"t{n}", kind) for n, kind in enumerate(kinds, 1)])

        def other_branch(watching: Watching) -> list[str]:
            watching.until(lambda: watching.watcher.slaves[3].recovered)
            states = [state_name(slave.al_status) for slave in watching.watcher.slaves]
            client.clear(cable)
            return states

        cable = client.fault({"fault": "cable", "after": 1, "port": 3})
        return watched.episode([{"fault": "power", "slave": 4, "lasts": 0.05}], other_branch)


def other_master(bus: SoemBus, count: int, control: str) -> Any:
    """Watch a sound segment, then one with a second master's frames; return both reports."""
    with SegmentClient(Path(control)) as client:
        watched = Watched(bus, count, client)
        alone = watched.episode([], lambda watching: watching.during(0.5))
        noise = [{"fault": "noise", "rate_hz": 2000}, {"fault": "noise", "protocol": "other_master", "rate_hz": 1000}]
        joined = watched.episode(noise, lambda watching: watching.during(0.5))
        return {"alone": alone["reported"], "joined": joined["reported"]}


master_child.SCENARIOS["other master"] = other_master
master_child.SCENARIOS["episodes"] = episodes
master_child.SCENARIOS["branches"] = branches

if __name__ == "__main__":
    master_child.main()
