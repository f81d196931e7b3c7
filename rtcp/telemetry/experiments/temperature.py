"""Temperature accuracy of shape setting, which section 4.7 of the thesis leaves to future work."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from math import nan

import numpy as np

from rtcp.config.find import default_config
from rtcp.config.model import ArmConfig
from rtcp.processes.shape_setting.config import ShapeSettingConfig
from rtcp.processes.shape_setting.heat_profile import Limits, heat_command
from rtcp.processes.shape_setting.messages import HeaterState, HeatRod, RodPhase
from rtcp.processes.shape_setting.profile import read_profile
from rtcp.telemetry.experiments.experiment import Experiment, ExperimentFailed, Row, Setup
from rtcp.testing.simulation import Simulation
from rtcp.virtual.models.shape_setter import ShapeSetterBox

TARGETS_C = (200.0, 350.0, 510.0)
SOURCE_K = 10.0
"""Mean absolute error of Gilbert and Webster's system, K, by section 4.1 of the thesis."""
_MANUAL = 0x0E
"""Contacts of the virtual box: key at Manual, both channels of the button."""
_ROOM_C, _COOL_C = 20.0, 80.0
"""Temperature of the virtual room; temperature below which a heating is complete, C."""
_INTERVAL_S = 0.1
_WINDOW_S = 5.0
"""Last part of a hold that is evaluated, s."""
_LONGEST_RAMP_S = 120.0
_UNDER_WAY = {HeaterState.ARMED, HeaterState.MEASURING, HeaterState.HEATING, HeaterState.HOLDING}


@dataclass
class Heating:
    """Samples of a heating to a target: time, s; true and estimated temperature in the middle, C; whether it held."""

    target_c: float
    seconds: list[float] = field(default_factory=list)
    true_c: list[float] = field(default_factory=list)
    estimated_c: list[float] = field(default_factory=list)
    holds: list[bool] = field(default_factory=list)

    def errors(self) -> tuple[float, float]:
        """Return mean of true minus target, and of estimated minus true, at the end of the hold, K.

        Raises:
            ExperimentFailed: the rod did not hold.
        """
        is_holding = np.array(self.holds)
        if not is_holding.any():
            raise ExperimentFailed(f"{self.target_c:g} C: the rod did not reach its target")
        times = np.array(self.seconds)
        chosen = is_holding & (times > times[is_holding][-1] - _WINDOW_S)
        true, estimated = np.array(self.true_c)[chosen], np.array(self.estimated_c)[chosen]
        return float((true - self.target_c).mean()), float((estimated - true).mean())


class TemperatureExperiment(Experiment):
    """Heat virtual rods to several temperatures, and compare with their true ones.

    The time is simulated, with loop, slaves and rod in this process: no load of the host changes the figures.

    Args:
        targets_c: temperatures in the middle of the rod, C.
        hold_s: duration of each hold, s; the ends of the rod are steady after some 30.
    """

    name = "temperature"
    title = "Temperature in the middle of a rod that is heated for shape setting"

    def __init__(self, targets_c: Sequence[float] = TARGETS_C, hold_s: float = 30.0) -> None:
        self._targets_c = targets_c
        self._hold_s = hold_s

    def run(self, setup: Setup) -> Iterator[Row]:
        """See `Experiment.run`; without a configuration that of the shipped heater is used."""
        if setup.config is None:
            setup = replace(setup, config=default_config().with_name("heater.yaml"))
        kinds = {process.name: process for process in setup.arm.processes if isinstance(process, ShapeSettingConfig)}
        if not kinds:
            raise ExperimentFailed(f"{setup.arm.name} has no process of kind shape_setting: use config/heater.yaml")
        if not setup.is_virtual:
            raise ExperimentFailed(
                f"the bus is {setup.bus or setup.arm.bus.interface}: the true temperature is known of the virtual rod "
                "only. Hold a real rod at its target with a thermocouple at its middle (docs/shape_setting.md)"
            )
        (process,) = kinds.values()
        heatings = []
        for target_c in self._targets_c:
            heating = self._heat(replace(setup.arm, processes=(process,)), process.name, target_c)
            heatings.append(heating)
            error, estimate = heating.errors()
            yield Row(f"{target_c:g} C: true minus target", "K", error, least=-2 * SOURCE_K, most=2 * SOURCE_K)
            yield Row(f"{target_c:g} C: estimated minus true", "K", estimate)
            setup.report(f"{target_c:g} C: the middle has {target_c + error:.1f} C, {estimate:+.1f} K are estimated")
        errors = [abs(heating.errors()[0]) for heating in heatings]
        yield Row("mean absolute error", "K", float(np.mean(errors)), SOURCE_K, most=SOURCE_K)
        setup.note(
            "a virtual rod of the alloy that the profile states: the error of a real alloy is not in these figures"
        )
        self._draw(setup, heatings)

    def _heat(self, config: ArmConfig, name: str, target_c: float) -> Heating:
        shipped = read_profile(default_config().parent / "shape_setting" / "nitinol.yaml")
        profile = replace(
            shipped, target_c=target_c, hold_s=self._hold_s, cool_c=_COOL_C, initial_c=_ROOM_C, chuck_c=_ROOM_C,
            limits=Limits(shipped.limits.current),
        ).of_rod(shipped.ends.length, shipped.thermal.diameter)  # fmt: skip
        heating = Heating(target_c)
        with Simulation(config) as simulation:
            box = next(slave.device for slave in simulation.bus.slaves if isinstance(slave.device, ShapeSetterBox))
            box.contacts = _MANUAL
            simulation.hold()
            simulation.do(heat_command(profile))
            simulation.do(HeatRod(straight_and_unloaded=True, phase=RodPhase.AUSTENITE, is_cold=True))
            for sample in range(round((_LONGEST_RAMP_S + self._hold_s) / _INTERVAL_S)):
                simulation.run(_INTERVAL_S)
                record = simulation.observer.latest()
                assert record is not None
                state = HeaterState(int(record[f"{name}_state"][0]))
                if sample and state not in _UNDER_WAY:
                    break
                heating.seconds.append(sample * _INTERVAL_S)
                heating.true_c.append(box.rod.middle_temperature)
                heating.estimated_c.append(float(record[f"{name}_middle_temperature"][0]) or nan)
                heating.holds.append(state is HeaterState.HOLDING)
            if state is not HeaterState.COOLING:
                raise ExperimentFailed(f"{target_c:g} C: the heater is {state.name.lower()} after its heating")
        return heating

    def _draw(self, setup: Setup, heatings: Sequence[Heating]) -> None:
        from matplotlib.figure import Figure

        figure = Figure(figsize=(9.0, 5.0), layout="constrained")
        axes = figure.subplots()
        for number, heating in enumerate(heatings):
            color = f"C{number}"
            axes.plot(heating.seconds, heating.true_c, color=color, label=f"true, {heating.target_c:g} C")
            axes.plot(heating.seconds, heating.estimated_c, ":", color=color, label="estimated")
            axes.axhline(heating.target_c, color=color, alpha=0.3)
        axes.set(xlabel="time, s", ylabel="middle of the rod, C")
        axes.legend(ncols=max(len(heatings), 1), fontsize="small")
        axes.grid(alpha=0.3)
        setup.draw("temperature", figure)
