"""The master's side of a test, a process of its own: only a process of one thread may join a user namespace.

Reads a scenario and its arguments as JSON from its first argument; writes the result as JSON to standard output.
"""

from __future__ import annotations

import contextlib
import ctypes
import dataclasses
import fcntl
import json
import os
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from rtcp.config.loader import load, load_device
from rtcp.config.model import Pdo, PdoEntry, SlaveConfig, StartupSdo
from rtcp.devices import Cia402Drive, TargetState
from rtcp.fieldbus import AlState, BusError, SdoAborted
from rtcp.fieldbus.bus import ProcessData, station_of
from rtcp.fieldbus.eeprom import is_sound, with_alias
from rtcp.fieldbus.interface import enter
from rtcp.fieldbus.pdo import layout
from rtcp.fieldbus.registers import RegisterPort
from rtcp.fieldbus.soem import SoemBus
from tests.fieldbus.terminals import slave
from tests.waiting import HANG_S

ARM = Path(__file__).parents[2] / "config" / "assistive_arm.yaml"
INTERFACE = "ecat0"
PERIOD_NS = 4_000_000
WATCHDOG_MS = 5000
"""Watchdog of a slave, so that a busy host takes none out of OP, ms."""
SYNC_LIMIT = 0x10F1
GET_FLAGS, SET_FLAGS, PROMISCUOUS = 0x8913, 0x8914, 0x100
"""ioctl requests and IFF_PROMISC, netdevice(7)."""


def arm(count: int, watchdog_ms: float = WATCHDOG_MS) -> list[SlaveConfig]:
    """Return the first slaves of the shipped arm."""
    return [patient(config, watchdog_ms) for config in load(ARM).slaves[:count]]


def patient(config: SlaveConfig, watchdog_ms: float = WATCHDOG_MS) -> SlaveConfig:
    """Adapt a slave to a busy host: a longer watchdog, and no sync error without outputs."""
    sdo = tuple(replace(entry, value=0) if entry.index == SYNC_LIMIT else entry for entry in config.device.sdo)
    return with_device(config, watchdog_ms=watchdog_ms, sdo=sdo)


def with_device(config: SlaveConfig, **changes: Any) -> SlaveConfig:
    return dataclasses.replace(config, device=dataclasses.replace(config.device, **changes))


class Cycle:
    """Exchanges process data on a grid while `beside` runs in a second thread, as the loop and its service do."""

    def __init__(self, data: ProcessData, period_ns: int) -> None:
        self.data = data
        self.period_ns = period_ns
        self.wkcs: list[int] = []
        self.before: Any = lambda: None

    def once(self) -> int:
        self.data.send()
        self.wkcs.append(self.data.receive())
        self.before()
        return self.wkcs[-1]

    def run(self, beside: Any) -> Any:
        result: list[Any] = []
        thread = threading.Thread(target=lambda: result.append(beside()))
        thread.start()
        due = time.monotonic_ns()
        while thread.is_alive():
            self.once()
            due = max(due + self.period_ns, time.monotonic_ns() - self.period_ns)
            time.sleep(max(due - time.monotonic_ns(), 0) * 1e-9)
        thread.join()
        return result[0]

    def for_cycles(self, count: int) -> None:
        """Exchange until this number of answers has come."""
        answered = count
        while answered:
            answered -= self.once() >= 0
            time.sleep(self.period_ns * 1e-9)


def to_op(bus: SoemBus, cycle: Cycle) -> None:
    def request() -> Sequence[str]:
        bus.request_state(AlState.OP)
        return bus.wait_for_state(AlState.OP, HANG_S)

    if refused := cycle.run(request):
        raise BusError(*refused)


def fresh(cycle: Cycle) -> tuple[int, int, int]:
    """Exchange until an answer comes; return the host's time before, the reference clock's in it, the host's after."""
    while True:
        before = time.monotonic_ns()
        if cycle.once() >= 0:
            return before, cycle.data.dc_time, time.monotonic_ns()
        time.sleep(0.001)


class AlStatusListener:
    """Records every AL status that a frame brings back to the master, SOEM's frames included."""

    def __init__(self) -> None:
        self.socket = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0)
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 23)
        # Classic BPF: accept frames whose first datagram addresses register 0x0130.
        lines = ((0x28, 0, 0, 20), (0x15, 0, 1, 0x3001), (0x06, 0, 0, 0xFFFF), (0x06, 0, 0, 0))
        program = ctypes.create_string_buffer(b"".join(struct.pack("=HBBI", *line) for line in lines))
        attach = struct.pack("@HP", len(lines), ctypes.addressof(program))
        self.socket.setsockopt(socket.SOL_SOCKET, 26, attach)
        self.socket.bind((INTERFACE, 0x88A4))
        self.socket.setblocking(False)

    def errors(self) -> list[str]:
        """Return the AL status of each answer that shows an error, in hexadecimal."""
        errors: list[str] = []
        while True:
            try:
                frame = self.socket.recv(1518)
            except BlockingIOError:
                self.socket.close()
                return errors
            length = int.from_bytes(frame[22:24], "little") & 0x07FF
            wkc = int.from_bytes(frame[26 + length : 28 + length], "little")
            if wkc and frame[26] & 0x10:
                errors.append(frame[26 : 26 + length].hex())


def registers_after() -> dict[str, Any]:
    """Return what the segment's registers say once the bus is closed."""
    port = RegisterPort(INTERFACE)
    try:
        return {"al_status": port.read_all(0x0130, 2).data[:1].hex(), "sync": port.read_all(0x0981, 1).data.hex()}
    finally:
        port.close()


def interface_flags(set_bits: int = 0) -> int:
    """Return the interface's flags, after setting some."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        name = INTERFACE.encode()
        (flags,) = struct.unpack_from("16xH", fcntl.ioctl(probe, GET_FLAGS, struct.pack("16s24x", name)))
        if set_bits:
            fcntl.ioctl(probe, SET_FLAGS, struct.pack("16sH22x", name, flags | set_bits))
        return flags | set_bits


def scan(bus: SoemBus, count: int) -> Any:
    return [dataclasses.asdict(info) for info in bus.scan()]


def op(bus: SoemBus, count: int, period_ns: int) -> Any:
    data = bus.configure(arm(count), period_ns)
    safe_op = [state.words() for state in bus.read_states()]
    cycle = Cycle(data, period_ns)
    to_op(bus, cycle)
    cycle.wkcs.clear()
    first = fresh(cycle)
    result = cycle.run(
        lambda: {
            "mapping": [
                bus.sdo(2).read(0x1600, i).hex() for i in range(bus.sdo(2).read(0x1600, 0)[0] + 1)
            ],
            "assigned": [bus.sdo(2).read(0x1C12, 0).hex(), bus.sdo(2).read(0x1C12, 1).hex()],
            "following_window": int.from_bytes(bus.sdo(2).read(0x6065, 0), "little"),
            "watchdog": int.from_bytes(bus.port.read(station_of(2), 0x0420, 2) or b"", "little"),
            "sync0_cycle_ns": int.from_bytes(bus.port.read(station_of(2), 0x09A0, 4) or b"", "little"),
            "states": [state.words() for state in bus.read_states()],
        }
    )  # fmt: skip
    last = fresh(cycle)
    return {
        **result, "safe_op": safe_op, "notes": bus.notes, "expected_wkc": data.expected_wkc, "wkcs": cycle.wkcs,
        "dc_passed_ns": last[1] - first[1], "host_passed_ns": [last[0] - first[2], last[2] - first[0]],
    }  # fmt: skip


def refused(bus: SoemBus, count: int, how: str) -> Any:
    slaves = arm(count)
    if how == "swapped":
        slaves[0], slaves[1] = slaves[1], slaves[0]
    elif how == "missing":
        slaves = arm(count + 1)
    elif how == "surplus":
        slaves.pop()
    elif how == "longer":
        pdo = slaves[0].device.tpdo[0]
        slaves[0] = with_device(
            slaves[0], tpdo=(Pdo(pdo.index, (*pdo.channels, PdoEntry(0x6020, 1, "uint16", "more"))),)
        )  # fmt: skip
    elif how == "unmappable":
        slaves[1] = with_device(slaves[1], rpdo=(Pdo(0x1600, (PdoEntry(0x1018, 1, "uint32", "vendor"),)),))
    elif how == "absent objects":
        absent = StartupSdo(0x5FFF, 1, "uint16", 7, "no such thing")
        slaves[1] = with_device(slaves[1], sdo=(absent,))
        slaves[2] = with_device(slaves[2], sdo=(absent,))
    bus.configure(slaves, PERIOD_NS)
    return None


def up(bus: SoemBus, count: int, complete_access: bool = True) -> Any:
    """Configure the slaves up to SAFE-OP, as the loop's process does; latch what their clocks show."""
    bus.scan()
    make, attempts = bus._map, []

    def count_attempt(slaves: Sequence[SlaveConfig]) -> dict[int, list[str]]:
        attempts.append(len(slaves))
        return make(slaves)

    bus._map = count_attempt  # type: ignore[method-assign]
    data = bus.configure([with_device(config, complete_access=complete_access) for config in arm(count)], PERIOD_NS)
    tries = bus.port.tries
    bus.port.tries = 25
    bus.port.write_all(0x0900, bytes(4))
    read = bus.port.read
    delays = [int.from_bytes(read(station_of(i), 0x0928, 4) or b"", "little") for i in range(1, count + 1)]
    times = [
        sum(int.from_bytes(read(station_of(i), at, 8) or b"", "little") for at in (0x0918, 0x0920)) - delay
        for i, delay in enumerate(delays, 1)
    ]
    return {"expected_wkc": data.expected_wkc, "tries": tries, "attempts": len(attempts), "delays": delays,
            "apart_ns": max(times) - min(times)}  # fmt: skip


def misread(bus: SoemBus, count: int, times: int) -> Any:
    """Let SOEM's map fail `times` times, as after a lost frame; then bring the slaves to OP."""
    make, left, tries = bus._map, iter(range(times)), []

    def fails(slaves: Any) -> dict[int, list[str]]:
        faults = make(slaves)
        tries.append(len(slaves))
        return faults if next(left, None) is None else {1: ["slave 1: SOEM could not read the PDO mapping"]}

    bus._map = fails  # type: ignore[method-assign]
    result = op(bus, count, PERIOD_NS)
    return {"tries": len(tries), "states": result["states"], "wkcs": sorted(set(result["wkcs"]))}


def optional(bus: SoemBus, count: int) -> Any:
    slaves = arm(count)
    slaves[1] = with_device(slaves[1], sdo=(StartupSdo(0x5FFF, 1, "uint16", 7, "a luxury", optional=True),))
    bus.configure(slaves, PERIOD_NS)
    return bus.notes


def straight_to_op(bus: SoemBus, count: int) -> Any:
    bus.scan()
    bus.request_state(AlState.OP, [2])
    sentences = bus.wait_for_state(AlState.OP, HANG_S, [2])
    bus.acknowledge(2)
    return {"sentences": sentences, "after": [state.words() for state in bus.read_states()]}


def sdo(bus: SoemBus, count: int) -> Any:
    bus.scan()
    aborted, absent = "", ""
    try:
        bus.sdo(2).read(0x5FFF, 0)
    except SdoAborted as error:
        aborted = f"{error} / {error.code:08X}"
    try:
        bus.sdo(9).read(0x1000, 0)
    except BusError as error:
        absent = str(error)
    bus.sdo(2).write(0x6065, 0, (1234).to_bytes(4, "little"))
    return {"name": bus.sdo(2).read(0x1008, 0).decode(), "kept": bus.sdo(2).read(0x6065, 0).hex(),
            "aborted": aborted, "absent": absent}  # fmt: skip


def failing(bus: SoemBus, count: int) -> Any:
    data = bus.configure(arm(count), PERIOD_NS)
    to_op(bus, Cycle(data, PERIOD_NS))
    raise BusError("something broke in the cycle")


def abandoned(bus: SoemBus, count: int) -> Any:
    data = bus.configure(arm(count), PERIOD_NS)
    to_op(bus, Cycle(data, PERIOD_NS))
    os.kill(os.getpid(), signal.SIGKILL)


def stopped(bus: SoemBus, count: int, pid: int, period_ns: int) -> Any:
    """Stop the segment for 50 ms and let the cycle go on; return the age of each answer, by the reference clock."""
    data = bus.configure(arm(count), period_ns)
    cycle = Cycle(data, period_ns)
    to_op(bus, cycle)
    rows = []
    due = time.monotonic_ns()
    stop, go = 200, 200 + 50_000_000 // period_ns
    for n in range(go + 300):
        if n in {stop, go}:
            os.kill(pid, signal.SIGSTOP if n == stop else signal.SIGCONT)
        due += period_ns
        time.sleep(max(due - time.monotonic_ns(), 0) * 1e-9)
        sent = time.monotonic_ns()
        wkc = cycle.once()
        rows.append((wkc, data.dc_time - sent, time.monotonic_ns() - sent, data.dc_time))
    return {"rows": rows, "stop": stop, "go": go, "stale": data.stale, "missed": data.missed,
            "expected_wkc": data.expected_wkc}  # fmt: skip


def beside(bus: SoemBus, count: int) -> Any:
    """Read registers and SDOs from a second thread while the cycle runs."""
    data = bus.configure(arm(count), PERIOD_NS)
    cycle = Cycle(data, PERIOD_NS)
    to_op(bus, cycle)
    cycle.wkcs.clear()

    def reads() -> Any:
        aliases = [bus.port.read(station_of(p), 0x0010, 2) for _ in range(100) for p in range(1, count + 1)]
        names = [bus.sdo(2).read(0x1008, 0).decode() for _ in range(20)]
        return {"stations": sorted({int.from_bytes(a or b"", "little") for a in aliases}), "names": sorted(set(names))}

    return {**cycle.run(reads), "wkcs": sorted(set(cycle.wkcs)), "expected_wkc": data.expected_wkc}


def outputs(bus: SoemBus, count: int) -> Any:
    """Set outputs of a wrong length, which must not reach this slave or the next."""
    data = bus.configure(arm(count), PERIOD_NS)
    cycle = Cycle(data, PERIOD_NS)
    to_op(bus, cycle)
    data.set_output(0, b"\x34\x12")
    data.set_output(0, b"\xff" * 40)
    data.set_output(0, b"\xff")
    # A drive's mode of operation is the last byte of its outputs, shown among its inputs.
    data.set_output(1, bytes(14) + b"\x09")
    cycle.for_cycles(20)
    return {"box": bus.sdo(1).read(0x7000, 1).hex(), "display": data.input(1)[14]}


def terminals(bus: SoemBus, count: int, kinds: list[str]) -> Any:
    """Bring slaves of `terminals` to OP; send patterns, and return the answers to each."""
    slaves = [patient(slave(f"t{n}", kind), 2000) for n, kind in enumerate(kinds)]
    data = bus.configure(slaves, PERIOD_NS)
    cycle = Cycle(data, PERIOD_NS)
    to_op(bus, cycle)
    patterns = []
    for pattern in (0xFF, 0x00, 0x55, 0xAA, 0x13):
        sent = []
        for index, config in enumerate(slaves):
            image = layout(config.device.rpdo)
            value = int.from_bytes(bytes((pattern + 7 * index & 0xFF,)) * image.bytes, "little") & (1 << image.bits) - 1
            sent.append(value.to_bytes(image.bytes, "little"))
            data.set_output(index, sent[-1])
        cycle.for_cycles(40)
        patterns.append(([output.hex() for output in sent], [data.input(index).hex() for index in range(count)]))
    return {
        "states": [state.words() for state in bus.read_states()], "expected_wkc": data.expected_wkc,
        "soem_expected": bus._master.expected_wkc, "wkcs": cycle.wkcs, "patterns": patterns,
        "objects": [bus.sdo(1).read(0x7000, n).hex() for n in (1, 2, 3)] if kinds[0] == "areas" else [],
        "sync": (bus.port.read(station_of(2), 0x0980, 2) or b"").hex(),
    }  # fmt: skip


def repeated(bus: SoemBus, count: int) -> Any:
    """Lose one answer on its way back; return the value, and the number of requests and answers."""
    bus.scan()
    info = bus._infos[0]
    assert info is not None
    port, requests, answers = bus.port, [], []
    read, exchange = port.read, port.exchange

    def losing(station: int, address: int, size: int, **more: Any) -> bytes | None:
        data = read(station, address, size, **more)
        if address == info.send_start:
            answers.append(data)
            return None if len(answers) == 1 else data
        return data

    def counting(command: Any, station: int, address: int, *more: Any, **others: Any) -> Any:
        requests.append(address == info.receive_start)
        return exchange(command, station, address, *more, **others)

    port.read, port.exchange = losing, counting  # type: ignore[assignment,method-assign]
    value = bus.sdo(1).read(0x1008, 0).decode()
    return {"value": value, "requests": sum(requests), "answers": len(answers), "same": len(set(answers)) == 1}


def described(bus: SoemBus, count: int, file: str) -> Any:
    """Set a slave up by its device's file; return what its start-up SDOs have written."""
    bus.configure([SlaveConfig("aio", load_device(Path(file)), file)], PERIOD_NS)
    return [bus.sdo(1).read(0x8001, 0).hex(), *(bus.sdo(1).read(0x8000, n).hex() for n in (1, 2, 3))]


def contradicted(bus: SoemBus, count: int) -> None:
    """Configure a terminal whose file maps other objects than its EEPROM, of as many bits."""
    slaves = [slave("t1", "input"), slave("t2", "bits4")]
    (pdo,) = slaves[1].device.rpdo
    other = replace(pdo, channels=(replace(pdo.channels[0], sub_index=9),))
    bus.configure([slaves[0], with_device(slaves[1], rpdo=(other,))], PERIOD_NS)


def dies(bus: SoemBus, count: int, kinds: list[str]) -> Any:
    """Bring slaves of `terminals` to OP, set all bits of their outputs, and die."""
    slaves = [patient(slave(f"t{n}", kind), 2000) for n, kind in enumerate(kinds)]
    data = bus.configure(slaves, PERIOD_NS)
    cycle = Cycle(data, PERIOD_NS)
    to_op(bus, cycle)
    for index, config in enumerate(slaves):
        image = layout(config.device.rpdo)
        data.set_output(index, ((1 << image.bits) - 1).to_bytes(image.bytes, "little"))
    cycle.for_cycles(40)
    print(json.dumps([state.words() for state in cycle.run(bus.read_states)]), flush=True)
    os.kill(os.getpid(), signal.SIGKILL)


def files(bus: SoemBus, count: int) -> Any:
    """Write and read files, also in BOOT; return the refusals."""
    bus.scan()
    refused: list[str] = []
    done: list[int] = []
    foe = bus.foe(1)
    for size in (0, 5, 116, 1000):
        data = os.urandom(size)
        foe.write("settings", data, 0, done.append)
        if foe.read("settings", 0, lambda count: None) != data:
            refused.append(f"{size} bytes came back differently")
    attempts: tuple[Callable[[], object], ...] = (
        lambda: foe.read("nothing", 0, done.append), lambda: foe.write("firmware", b"x", 0, done.append),
        lambda: bus.foe(2).read("settings", 0, done.append), lambda: bus.boot(2),
        lambda: foe.read("n" * 300, 0, done.append),
    )  # fmt: skip
    for attempt in attempts:
        try:
            attempt()
        except BusError as error:
            refused.append(str(error))
    firmware = os.urandom(2000)
    bus.boot(1)
    in_boot = bus.read_states()[0].words()
    bus.foe(1).write("firmware", firmware, 0, done.append)
    kept = bus.foe(1).read("firmware", 0, lambda count: None) == firmware
    return {"refused": refused, "done": done, "in_boot": in_boot, "kept": kept}


def eeprom(bus: SoemBus, count: int) -> Any:
    """Read an EEPROM, write it with one word changed, and interrupt writes after each word."""
    bus.discover()
    parts: list[float] = []
    before = bus.read_eeprom(1, parts.append)
    changed = before[:0x1C] + b"\x07\x00" + before[0x1E:]
    written = [bus.write_eeprom(1, changed, parts.append) for _ in range(2)]
    after = bus.read_eeprom(1, parts.append)
    # Words 0x20 and 0x3F, and the alias with its checksum.
    other = bytearray(with_alias(before, 7))
    other[0x40:0x42] = other[0x7E:0x80] = b"\x55\xaa"
    sound = []
    for last in (0.6, 0.7, 0.8, 1.0):

        def interrupts(part: float, last: float = last) -> None:
            if part > last:
                raise TimeoutError

        bus.write_eeprom(1, before, parts.append)
        with contextlib.suppress(TimeoutError):
            bus.write_eeprom(1, bytes(other), interrupts)
        sound.append(is_sound(bus.read_eeprom(1, parts.append, 16)))
    whole = bus.read_eeprom(1, parts.append) == other
    bus.release()
    return {"before": before.hex(), "written": written, "same": after == changed, "parts": [parts[0], parts[-1]],
            "sound": sound, "whole": whole}  # fmt: skip


def emergency(bus: SoemBus, count: int) -> Any:
    """An enabled drive loses its outputs: it faults and sends an emergency message."""
    slaves = arm(count, watchdog_ms=500)
    data = bus.configure(slaves, PERIOD_NS)
    cycle = Cycle(data, PERIOD_NS)
    drive = Cia402Drive(slaves[1], PERIOD_NS * 1e-9)
    steps: list[str] = []

    def control() -> None:
        drive.decode(data.input(1))
        drive.advance(TargetState.ENABLED)
        data.set_output(1, drive.encode())
        if not steps or steps[-1] != drive.state.words:
            steps.append(drive.state.words)

    to_op(bus, cycle)
    cycle.before = control
    cycle.run(lambda: wait(lambda: steps[-1:] == ["operation enabled"]))
    senders: list[int] = []

    def receives() -> bool:
        senders.extend(message.slave for message in bus.emergencies())
        return bool(senders)

    wait(receives)
    return {"steps": steps, "slaves": senders,
            "states": [state.words() for state in bus.read_states()]}  # fmt: skip


def killed(bus: SoemBus, count: int, pid: int) -> Any:
    """Kill the segment while the cycle runs."""
    cycle = Cycle(bus.configure(arm(count), PERIOD_NS), PERIOD_NS)
    to_op(bus, cycle)
    os.kill(pid, signal.SIGKILL)
    for _ in range(30):
        cycle.once()
    return {"wkc": cycle.wkcs[-1], "states": cycle.run(lambda: [state.words() for state in bus.read_states()])}


def interrupted(bus: SoemBus, count: int, pid: int, child: subprocess.Popen[bytes]) -> Any:
    """End a scan in a process of its own by a signal, as `rtcp scan` does on Ctrl-C; only it opens the bus."""
    bus.close()
    assert child.stdin is not None
    child.stdin.write(json.dumps({"do": "scan", "interface": INTERFACE, "namespace_pid": pid}).encode())
    child.stdin.close()
    wait(lambda: child.poll() is not None or interface_flags() & PROMISCUOUS)
    child.terminate()
    return child.wait()


def wait(condition: Any, timeout_s: float = HANG_S) -> None:
    deadline = time.monotonic() + timeout_s
    while not condition() and time.monotonic() < deadline:
        time.sleep(0.005)


SCENARIOS: dict[str, Callable[..., Any]] = {
    f.__name__: f
    for f in (
        scan,
        op,
        refused,
        up,
        misread,
        optional,
        straight_to_op,
        sdo,
        failing,
        abandoned,
        stopped,
        beside,
        outputs,
        terminals,
        dies,
        files,
        repeated,
        described,
        contradicted,
        eeprom,
        emergency,
        killed,
        interrupted,
    )
}


def main() -> None:
    question = json.loads(sys.argv[1])
    bus = SoemBus(INTERFACE, question.get("receive_fraction", 0.3), namespace_pid=question["pid"])
    answer: dict[str, Any] = {}
    if question["scenario"] == "interrupted":
        # Outside, as `rtcp scan` starts it: an ordinary user's program that begins inside has no rights there.
        command = [sys.executable, "-m", "rtcp.launch.offline"]
        question["arguments"]["child"] = subprocess.Popen(command, stdin=subprocess.PIPE)
    enter(question["pid"])
    flags = interface_flags(PROMISCUOUS if question["promiscuous"] else 0)
    listener = AlStatusListener()
    try:
        with bus:
            answer["result"] = SCENARIOS[question["scenario"]](bus, question["count"], **question["arguments"])
    except BusError as error:
        answer["error"] = error.sentences
    answer["left"] = bus.notes
    bus.close()
    answer["flags"] = [flags, interface_flags()]
    answer["al_errors"] = listener.errors()
    answer["after"] = registers_after()
    print(json.dumps(answer))


if __name__ == "__main__":
    main()
