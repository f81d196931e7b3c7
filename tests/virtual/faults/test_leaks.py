"""The segment's process runs without a garbage collector: faults must leave no reference cycles."""

from __future__ import annotations

import gc
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from rtcp.virtual.faults.control import Control, GroundTruth
from rtcp.virtual.faults.fault import FaultRefused
from rtcp.virtual.faults.registry import FaultRegistry, installed, load_script, parse
from rtcp.virtual.protocol import DatagramCommand
from rtcp.virtual.request_socket import control_socket
from tests.malformed.line import ACK, OP, SAFE_OP, STATION, Line
from tests.virtual.frames import Datagram, build

ROUNDS = 8
MS = 1_000_000
KINDS: dict[str, dict[str, Any]] = {
    "cable": {"after": 3},
    "power": {"slave": 3},
    "al_refuse": {"slave": 2, "state": "OP"},
    "al_hang": {"slave": 2},
    "al_fall": {"slave": 2},
    "sdo_late": {"slave": 2, "ms": 5},
    "sdo_abort": {"slave": 2},
    "loss": {"rate": 0.5},
    "delay": {"ms": 1, "rate": 0.5},
    "duplicate": {"rate": 0.5},
    "reorder": {"rate": 0.5},
    "corrupt": {"after": 3, "rate": 0.5},
    "garble": {"rate": 0.5},
    "wkc": {"slave": 2, "rate": 0.5},
    "drive": {"slave": 2, "error": "encoder"},
    "sync0": {"slave": 2},
    "clock_jump": {"slave": 2, "us": 1},
    "clock_drift": {"slave": 2},
    "input": {"number": 3, "how": "bounce"},
    "input_frozen": {"slave": 1},
    "joystick_code": {"value": 9},
    "push": {"y": 10},
    "noise": {"rate_hz": 2000},
}
BY_RATE = [name for name, keys in KINDS.items() if "rate" in keys]
WRONG: list[bytes] = [
    b'{"do":"fault","fault":{"fault":"corupt","after":1}}', b'{"do":"fault","fault":{"fault":"corrupt","after":"x"}}',
    b'{"do":"fault","fault":{"fault":"corrupt","after":1,"rate":2,"way":7}}', b'{"do":"fault"}',
    b'{"do":"clear","id":9999}',
    b'{"do":"fault","fault":{"fault":"drive","slave":1,"error":"encoder"}}', b"{", b"[]", b"\xff", b'{"do":"dance"}',
    b'{"do":"faults","x":1}', b"[" * 900, b'{"do":"fault","fault":{"fault":"cable","after":99,"lasts":1e99}}',
]  # fmt: skip


class Bench:
    """The shipped segment in OP, its registry, and a master's frames through both, as in the server."""

    def __init__(self) -> None:
        self.line = Line()
        self.line.start(OP)
        self.sent = 0
        self.registry = FaultRegistry(self.line.segment, self._send, self.line.now)
        self._frame = build(
            Datagram(DatagramCommand.LRW, 0, 0, 0, bytes(184)), Datagram(DatagramCommand.BRD, 0, 0, 0x0130, bytes(2))
        )

    def _send(self, frame: bytes) -> None:
        self.sent += 1

    def frames(self, count: int) -> None:
        line, registry = self.line, self.registry
        for _ in range(count):
            line.pass_time(MS)
            if registry.due <= line.now:
                registry.tick(line.now)
            size = len(self._frame)
            line.buffer[:size] = self._frame
            if not registry.frames.active:
                line.segment.process(line.buffer, size, line.now)
                line.segment.settle(line.now)
            elif registry.frames.arrives() and line.segment.process(line.buffer, size, line.now):
                registry.answers(bytes(line.buffer[:size]), line.now)
                line.segment.settle(line.now)

    def begin(self, name: str, **more: Any) -> int:
        planned, findings = parse({"fault": name, **KINDS[name], **more})
        assert planned is not None, findings
        return self.registry.begin(planned, self.line.now)

    def again_in_op(self) -> None:
        for state in (ACK | SAFE_OP, OP):
            self.line.ask(DatagramCommand.FPWR, STATION + 1, 0x0120, bytes((state, 0)))
            self.line.pass_time(MS)
            self.frames(1)


@pytest.fixture(scope="module")
def _bench() -> Iterator[Bench]:
    shared = Bench()
    gc.collect()
    gc.freeze()  # the collections need not examine the objects of other tests
    yield shared
    gc.unfreeze()


@pytest.fixture
def bench(_bench: Bench) -> Iterator[Bench]:
    """The file's bench, with the collector off as in the segment's process."""
    gc.disable()
    try:
        yield _bench
    finally:
        gc.enable()


def left_by(play: Callable[[], object]) -> int:
    """Return the number of objects that only a collector would free."""
    play()
    gc.collect()
    for _ in range(ROUNDS):
        play()
    return gc.collect()


def test_every_kind_of_fault_is_tried_here() -> None:
    # Those of the shape setter need its box: test_shape_setter.py.
    assert set(KINDS) == set(installed()) - {"circuit", "contacts"}


@pytest.mark.parametrize("name", KINDS)
def test_a_fault_that_is_cleared_or_ends_at_its_time_leaves_nothing_to_collect(bench: Bench, name: str) -> None:
    once = installed()[name].once

    def play() -> None:
        bench.again_in_op()
        number = bench.begin(name)
        bench.frames(3)
        if not once and name != "drive":
            bench.registry.clear(number, bench.line.now)
            bench.begin(name, lasts=0.002)
            bench.frames(4)
        elif name == "drive":
            bench.begin(name, lasts=0.002)
            bench.frames(4)
        assert bench.registry.listing(bench.line.now) == []

    assert left_by(play) == 0


@pytest.mark.parametrize("way", ["out", "back"])
def test_damage_on_either_way_leaves_nothing_to_collect(bench: Bench, way: str) -> None:
    def play() -> None:
        number = bench.begin("corrupt", way=way)
        bench.frames(3)
        bench.registry.clear(number, bench.line.now)

    assert left_by(play) == 0


@pytest.mark.parametrize("name", BY_RATE)
def test_a_burst_that_has_passed_leaves_nothing_to_collect(bench: Bench, name: str) -> None:
    keys = {key: value for key, value in KINDS[name].items() if key != "rate"}
    planned, _ = parse({"fault": name, **keys, "burst": 2})

    def play() -> None:
        bench.registry.begin(planned, bench.line.now)
        bench.frames(5)
        assert bench.registry.listing(bench.line.now) == []

    assert left_by(play) == 0


def test_a_script_leaves_nothing_to_collect(bench: Bench, tmp_path: Path) -> None:
    script = tmp_path / "script.yaml"
    entries = [json.dumps({"fault": name, **keys, "at": 0.001}) for name, keys in KINDS.items() if name != "al_fall"]
    script.write_text("faults:\n" + "".join(f"  - {entry}\n" for entry in entries))
    planned = load_script(script, len(bench.line.segment.slaves))

    def play() -> None:
        bench.registry = FaultRegistry(bench.line.segment, bench._send, bench.line.now, planned)
        bench.frames(3)
        # All but those that are over at once: the drive's single occurrence, the clock's jump.
        assert len(bench.registry.clear(None, bench.line.now)) == len(entries) - 2

    assert left_by(play) == 0


def test_what_is_refused_leaves_nothing_to_collect(bench: Bench, tmp_path: Path) -> None:
    with control_socket(tmp_path / "segment.sock") as listener:
        control = Control(
            listener, bench.registry, GroundTruth(bench.line.segment, ["x"] * len(bench.line.segment.slaves))
        )
        assert left_by(lambda: [control._answer(packet)["ok"] for packet in WRONG].index(False)) == 0
        assert not any(control._answer(packet)["ok"] for packet in WRONG)
        control.close()


def test_a_full_registry_leaves_nothing_to_collect(bench: Bench) -> None:
    def play() -> None:
        refused = False
        while not refused:
            try:
                bench.begin("corrupt")
            except FaultRefused:
                refused = True
        bench.registry.clear(None, bench.line.now)

    assert left_by(play) == 0
