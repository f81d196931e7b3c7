"""How much faster than real time the in-process bus is: alone, and with the whole loop on it.

`python benchmarks/inprocess.py` moves the default arm at cycles of 0.5, 1 and 2 ms and prints simulated by real time:
of all cycles, and of the best batch of 0.2 s (what the machine does when nobody else uses it). `--profile` shows where
the time goes.
"""

from __future__ import annotations

import argparse
import cProfile
import pstats
import struct
import time
from collections.abc import Callable
from dataclasses import replace

from rtcp.config import default_config, load
from rtcp.ipc.commands import MoveJoints
from rtcp.testing.simulation import Simulation

START = [0.3, 0.2, 0.9, 0.2, 0.6, 0.1]
TARGET = (1.3, -0.4, 1.5, 1.2, -0.4, 1.1)
INPUTS = 0x033F
"""Joystick neutral, emergency stop not pressed."""
BATCH_S = 0.2
DRIVE = struct.Struct("<Hiiib")


def factors(simulated_s: float, one: Callable[[], None]) -> tuple[float, float]:
    """Return simulated by real time of all cycles and of the best batch; `one` is a batch."""
    batches = round(simulated_s / BATCH_S)
    spent = []
    for _ in range(batches):
        began = time.perf_counter()
        one()
        spent.append(time.perf_counter() - began)
    return batches * BATCH_S / sum(spent), BATCH_S / min(spent)


def moving(period_us: int) -> Simulation:
    config = load(default_config())
    config = replace(config, cycle=replace(config.cycle, period_us=period_us))
    simulation = Simulation(config, 1, positions=START)
    if simulation.box is not None:
        simulation.box.inputs = INPUTS
    simulation.hold()
    refusal = simulation.send(MoveJoints(TARGET, 0.1, True)).refusal
    assert refusal is None, refusal
    return simulation


def whole(period_us: int, seconds: float) -> tuple[float, float]:
    with moving(period_us) as simulation:
        return factors(seconds, lambda: simulation.run(BATCH_S))


def bus_alone(period_us: int, seconds: float) -> tuple[float, float]:
    with moving(period_us) as simulation:
        simulation.run(0.5)
        bus, data = simulation.bus, simulation.data
        period_ns = period_us * 1000
        cycles = round(BATCH_S * 1e6 / period_us)
        now = simulation.now_ns
        # Outputs of a motion, made beforehand: the drives' work is that of a motion, the loop's is not there.
        told = [DRIVE.unpack(output) for output in data.outputs[1:]]
        step = round(0.1 * period_us * 1e-6 * 1e4) or 1
        made = [
            [DRIVE.pack(word, position + sign * step * n, *rest) for word, position, *rest in told]
            for sign in (1, -1)
            for n in range(cycles // 2)
        ]
        made[cycles // 2 :] = reversed(made[: cycles // 2])

        def batch() -> None:
            nonlocal now
            for outputs in made:
                now += period_ns
                for slot, output in enumerate(outputs, 1):
                    data.set_output(slot, output)
                bus.advance_to(now)
                data.send()
                data.receive()

        return factors(seconds, batch)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=6.0, help="simulated time of each figure")
    parser.add_argument("--profile", action="store_true")
    given = parser.parse_args()
    if given.profile:
        with moving(1000) as simulation:
            profile = cProfile.Profile()
            profile.runcall(simulation.run, given.seconds)
        pstats.Stats(profile).sort_stats("tottime").print_stats(30)
        return
    print("cycle us   bus alone, times real time (best)   with the loop (best)")
    for period_us in (500, 1000, 2000):
        alone, best_alone = bus_alone(period_us, given.seconds)
        loop, best_loop = whole(period_us, given.seconds)
        print(f"{period_us:8}   {alone:9.1f} ({best_alone:.1f}) {'':16}   {loop:9.1f} ({best_loop:.1f})")


if __name__ == "__main__":
    main()
