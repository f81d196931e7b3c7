"""Noise of an analog terminal with one value a cycle, and with several (oversampling), averaged over 10 ms.

Section 4.5 of the second thesis samples voltage and current 30 000 times a second, and averages over 10 ms.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from math import sqrt

import numpy as np
import numpy.typing as npt

from rtcp.config.find import default_config
from rtcp.config.loader import load_device
from rtcp.config.segment import load_segment
from rtcp.telemetry.experiments.experiment import Experiment, ExperimentFailed, Row, Setup
from rtcp.testing.simulation import Simulation

SAMPLES_A_SECOND = 30_000.0
AVERAGE_S = 0.01
_SECONDS = 5.0
_METER = "shape-setter-meter"
_UNITS = {"voltage": ("uV", 1e6), "current": ("mA", 1e3)}


class OversamplingExperiment(Experiment):
    """Record the virtual meter of the shape setter at rest with one conversion a cycle and with several.

    The time is simulated. The noise of each conversion is white, so the standard deviation of a mean falls with the
    root of their number; a real converter has noise of its own.

    Args:
        seconds: duration of each recording, s.
    """

    name = "oversampling"
    title = "Noise with one conversion a cycle and with 30 000 a second"

    def __init__(self, seconds: float = _SECONDS) -> None:
        self._seconds = seconds

    def run(self, setup: Setup) -> Iterator[Row]:
        """See `Experiment.run`; without a configuration that of the shipped heater is used."""
        if setup.config is None:
            setup = replace(setup, config=default_config().with_name("heater.yaml"))
        if not setup.is_virtual:
            raise ExperimentFailed(f"the bus is {setup.bus or setup.arm.bus.interface}: this needs the virtual meter")
        period_s = 1e-6 * setup.arm.cycle.period_us
        samples = round(SAMPLES_A_SECOND * period_s)
        if samples < 2:
            raise ExperimentFailed(f"a cycle of {1e6 * period_s:g} us has {samples} conversions of 30 000 a second")
        single, several = (self._recorded(setup, count) for count in (1, samples))
        averaged = max(1, round(AVERAGE_S / period_s))
        for name, (unit, factor) in _UNITS.items():
            spread = [factor * float(np.std(recorded[name])) for recorded in (single, several)]
            means = [factor * float(np.std(_means(recorded[name], averaged))) for recorded in (single, several)]
            yield Row(f"{name}: one conversion a cycle, standard deviation", unit, spread[0])
            yield Row(f"{name}: mean of {samples} conversions a cycle", unit, spread[1])
            ratio = sqrt(samples)
            yield Row(f"{name}: ratio of the two", "", spread[0] / spread[1], None, 0.8 * ratio, 1.25 * ratio)
            yield Row(f"{name}: one conversion a cycle, averaged over 10 ms", unit, means[0])
            yield Row(f"{name}: {samples} conversions a cycle, averaged over 10 ms", unit, means[1])
        setup.note("virtual converters with white noise: of a real terminal only its own noise is known")

    def _recorded(self, setup: Setup, samples: int) -> dict[str, npt.NDArray[np.float64]]:
        config = replace(setup.arm, processes=())
        source = config.source.parent
        segment = load_segment(source / config.bus.segment)
        if samples > 1:
            device = load_device(default_config().parent / "devices" / f"{_METER}-oversampling.yaml")
            tpdo = tuple(replace(pdo, samples=samples) if pdo.samples > 1 else pdo for pdo in device.tpdo)
            slaves = tuple(
                replace(slave, device=replace(device, tpdo=tpdo))
                if slave.device.product_id == device.product_id
                else slave
                for slave in config.slaves
            )
            config = replace(config, slaves=slaves)
            models = tuple(
                replace(slave, options={**slave.options, "samples": samples}) if slave.model == _METER else slave
                for slave in segment.slaves
            )
            segment = replace(segment, slaves=models)
        with Simulation(config, segment=segment) as simulation:
            before = simulation.observer.head
            simulation.run(self._seconds)
            records, missing = simulation.observer.since(before)
        if missing == len(records) or not len(records):
            raise ExperimentFailed("the simulation has published no cycles")
        return {name: records[f"measure_{name}"] for name in _UNITS}


def _means(values: npt.NDArray[np.float64], count: int) -> npt.NDArray[np.float64]:
    """Return the means of `count` values each."""
    whole = len(values) // count * count
    means: npt.NDArray[np.float64] = values[:whole].reshape(-1, count).mean(axis=1)
    return means
