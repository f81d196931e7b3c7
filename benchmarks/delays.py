"""How often propagation delays are wrong when frames get lost: `python benchmarks/delays.py [--starts 1000]`.

The slaves of the shipped arm run in a process of their own. They are found once, because that takes most of a start;
from then on a share of all frames gets lost, and the delays are measured as each start measures them. A delay is wrong
where it differs by more than 100 ns from the segment's own, and such a delay stays: nothing later notices it. The exit
code is 1 where one was wrong. `--soem` lets SOEM measure instead, until each delay was found twice.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Callable
from datetime import date
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from rtcp.fieldbus.bus import slave_label, station_of
from rtcp.fieldbus.clocks import clocks_of, measure_delays
from rtcp.fieldbus.errors import BusError
from rtcp.fieldbus.registers import Register
from rtcp.fieldbus.soem import SoemBus
from rtcp.virtual.faults.control import SegmentClient
from rtcp.virtual.segment import default_delays
from tests.forked import Forked

MODELS = ("diewu-io", *("cubemars-orh70",) * 3, "cubemars-orh60", "cubemars-orh50", "cubemars-orh40")
SAME_NS = 100


def main() -> int:
    """Run the starts and print the figures."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--starts", type=int, default=1000)
    parser.add_argument("--rate", type=float, default=0.02, help="share of frames that get lost")
    parser.add_argument("--soem", action="store_true", help="SOEM measures")
    parser.add_argument("--longest", type=float, default=550.0, help="begin no start after this time, s")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="rtcp-delays-", dir="/tmp") as folder:
        file, control = Path(folder) / "segment.yaml", Path(folder) / "segment.sock"
        file.write_text("slaves:\n" + "".join(f"  - model: {model}\n" for model in MODELS))
        segment = Forked("rtcp.virtual", "--config", str(file), "--control", str(control))
        try:
            ready = json.loads(segment.line())
            return run(given.starts, given.rate, given.longest, ready["pid"], control, by_soem if given.soem else by_us)
        finally:
            segment.end()


Measurement = Callable[[SoemBus, dict[int, str]], dict[int, int]]
"""Returns the delays of the slaves with these labels, ns."""


def by_us(bus: SoemBus, labels: dict[int, str]) -> dict[int, int]:
    """Measure as a start does."""
    return measure_delays(bus.port, labels, clocks_of(bus.port, labels))


def by_soem(bus: SoemBus, labels: dict[int, str]) -> dict[int, int]:
    """Let SOEM measure; a delay counts once two measurements agree."""
    found: dict[int, list[int]] = {position: [] for position in labels}
    delays: dict[int, int] = {}
    while len(delays) < len(labels):
        for position, label in labels.items():
            bus.port.put(station_of(position), Register.DC_DELAY, bytes(4), label)
        bus._master.config_dc()
        for position in labels.keys() - delays.keys():
            register = bus.port.read(station_of(position), Register.DC_DELAY, 4)
            delay = int.from_bytes(register or b"", "little", signed=True)
            if any(abs(delay - before) <= SAME_NS for before in found[position]):
                delays[position] = delay
            found[position].append(delay)
    return delays


def run(starts: int, rate: float, longest_s: float, pid: int, control: Path, measure: Measurement) -> int:
    """Start again and again on the segment of process `pid`; return the exit code."""
    expected = dict(enumerate(default_delays(len(MODELS)), 1))
    labels = {position: slave_label(position, model) for position, model in enumerate(MODELS, 1)}
    right = wrong = refused = done = 0
    largest = 0
    with SoemBus("ecat0", namespace_pid=pid) as bus, SegmentClient(control) as client:
        bus.discover()
        client.fault({"fault": "loss", "rate": rate, "seed": 1})
        began = time.monotonic()
        while done < starts and time.monotonic() < began + longest_s:
            done += 1
            try:
                delays = measure(bus, labels)
            except BusError as error:
                refused += 1
                print(f"start {done} refused: {error}")
                continue
            errors = {position: delays.get(position, 0) - delay for position, delay in expected.items()}
            error = max(map(abs, errors.values()))
            largest = max(largest, error)
            if error <= SAME_NS:
                right += 1
            else:
                wrong += 1
                print(f"start {done} wrong, ns: {errors}")
        passed_s = time.monotonic() - began
    print(
        f"{date.today()}: {done} starts of {len(MODELS)} slaves at {100 * rate:g} % loss: {right} right, {wrong} wrong "
        f"in silence, {refused} refused; largest error {largest} ns; {passed_s / done:.2f} s each"
    )
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
