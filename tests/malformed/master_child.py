"""A real master on the answerer's cable, SOEM and RegisterPort as the platform uses them, in a process of its own.

    python master_child.py PID SCENARIO AMOUNT

Prints one JSON object. What is no BusError ends it with a traceback; a crash of SOEM with a signal.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

# Run as a file by the tests.
sys.path.insert(0, str(Path(__file__).parents[2]))

from rtcp.config import default_config, load
from rtcp.fieldbus import AlState, BusError
from rtcp.fieldbus.bus import station_of
from rtcp.fieldbus.interface import enter
from rtcp.fieldbus.process_data import SoemProcessData
from rtcp.fieldbus.soem import SoemBus
from tests.malformed.answerer import ask
from tests.malformed.mutated_frames import resident_kb

INTERFACE = "ecat0"
PERIOD_NS = 1_000_000
PATIENCE_S = 30.0
SLAVES = load(default_config()).slaves


def to_op(bus: SoemBus) -> SoemProcessData:
    data = bus.configure(SLAVES, PERIOD_NS)
    refused: list[tuple[str, ...]] = []

    def lead() -> None:
        bus.request_state(AlState.OP)
        refused.append(bus.wait_for_state(AlState.OP, 10.0))

    leading = threading.Thread(target=lead)
    leading.start()
    while leading.is_alive():
        data.send()
        data.receive()
        time.sleep(0.0005)
    if refused[0]:
        raise BusError(*refused[0])
    return data


def recovered(data: SoemProcessData) -> bool:
    """Whether ten right answers come without a wrong one between them; a busy machine may lose some."""
    good = 0
    until = time.monotonic() + PATIENCE_S
    while good < 10 and time.monotonic() < until:
        data.send()
        wkc = data.receive()
        if wkc >= 0:
            good = good + 1 if wkc == data.expected_wkc else 0
        time.sleep(0.0005)
    return good == 10


def record(bus: SoemBus, amount: int) -> dict[str, Any]:
    """Run a master from the scan to the end."""
    bus.scan()
    data = to_op(bus)
    for _ in range(amount):
        data.send()
        data.receive()
    bus.read_states()
    bus.emergencies()
    bus.sdo(2).read(0x1008, 0)
    bus.sdo(2).write(0x6065, 0, (2000).to_bytes(4, "little"))
    bus.port.read(station_of(2), 0x0300, 20)
    bus.port.write_all(0x0300, bytes(20))
    return {}


def exchange(bus: SoemBus, amount: int) -> dict[str, Any]:
    """Exchange process data at full speed, every second answer mutated and a few lost."""
    data = to_op(bus)
    before = ask(INTERFACE, garble=0.5, hide=0.01)
    counters: Counter[str] = Counter()
    lengths = [len(data.input(at)) for at in range(len(SLAVES))]
    began, memory_kb = time.monotonic(), resident_kb()
    for number in range(amount):
        data.set_output(number % len(SLAVES), bytes(len(data.input(0))))
        data.send()
        wkc = data.receive()
        counters["none" if wkc < 0 else "good" if wkc == data.expected_wkc else "other"] += 1
        assert [len(data.input(at)) for at in range(len(SLAVES))] == lengths
    seconds, kilobytes = time.monotonic() - began, resident_kb() - memory_kb
    after = ask(INTERFACE, garble=0, hide=0)
    mutated = int(str(after["mutated"])) - int(str(before["mutated"]))
    return {
        "counters": counters,
        "mutated": mutated,
        "seconds": seconds,
        "kilobytes": kilobytes,
        "recovered": recovered(data),
    }


def services(bus: SoemBus, amount: int) -> dict[str, Any]:
    """States, registers, SDOs and mailboxes, while one answer in five is mutated."""
    bus.scan()
    before = ask(INTERFACE, garble=0.2)
    actions: tuple[Callable[[], Any], ...] = (
        bus.read_states,
        bus.emergencies,
        lambda: bus.sdo(2).read(0x1008, 0),
        lambda: bus.sdo(3).read(0x6064, 0),
        lambda: bus.sdo(2).write(0x6065, 0, (2000).to_bytes(4, "little")),
        lambda: bus.port.read(station_of(2), 0x0130, 6),
        lambda: bus.wait_for_state(AlState.PREOP, 0.01),
    )
    sentences: Counter[str] = Counter()
    for number in range(amount):
        try:
            actions[number % len(actions)]()
        except BusError as error:
            sentences[str(error).partition(":")[0]] += 1
    after = ask(INTERFACE, garble=0)
    mutated = int(str(after["mutated"])) - int(str(before["mutated"]))
    return {"refused": sum(sentences.values()), "mutated": mutated, "name": name_of(bus).hex()}


def name_of(bus: SoemBus) -> bytes:
    """Return the name of the first drive; a busy machine may lose a frame of a transfer, which is then begun again."""
    until = time.monotonic() + PATIENCE_S
    while True:
        try:
            return bus.sdo(2).read(0x1008, 0)
        except BusError:
            if time.monotonic() > until:
                raise


def scans(bus: SoemBus, amount: int) -> dict[str, Any]:
    """Scan and configure while answers are mutated, from one in a thousand to one in three."""
    sentences: Counter[str] = Counter()
    before = ask(INTERFACE)
    for number in range(amount):
        ask(INTERFACE, garble=(0.001, 0.01, 0.1, 0.3)[number % 4])
        try:
            bus.scan() if number % 2 else bus.configure(SLAVES, PERIOD_NS)
            sentences["done"] += 1
        except BusError as error:
            sentences["refused"] += 1
            sys.stderr.write(f"{number}: {error}\n")
    after = ask(INTERFACE, garble=0)
    mutated = int(str(after["mutated"])) - int(str(before["mutated"]))
    return {"ends": sentences, "mutated": mutated, "slaves": len(bus.scan())}


SCENARIOS = {action.__name__: action for action in (record, exchange, services, scans)}


def main() -> None:
    enter(int(sys.argv[1]))
    with SoemBus(INTERFACE, state_timeout_s=0.3) as bus:
        print(json.dumps(SCENARIOS[sys.argv[2]](bus, int(sys.argv[3]))), flush=True)
    if sys.argv[2] == "record":
        ask(INTERFACE, keep=sys.argv[4])


if __name__ == "__main__":
    main()
