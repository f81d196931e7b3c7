"""Experiments on time: the cycle, measured inside, at an output of the IO box, or by an oscilloscope; the delays.

The thesis measured three setups: one actuator, six on a bench, and the arm. Each has a file in `config/`.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from math import nan
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt

from rtcp.api import RtcpError
from rtcp.config.model import ArmConfig
from rtcp.ipc.runtime_directory import runtime_directory
from rtcp.ipc.session import read_session
from rtcp.telemetry.experiments.experiment import Experiment, ExperimentFailed, Row, Setup
from rtcp.telemetry.experiments.oscilloscope import CaptureError, read_capture, toggles
from rtcp.telemetry.reading import read
from rtcp.virtual.faults.control import EDGES, SegmentClient

Array = npt.NDArray[np.float64]

SOURCE_CYCLES = {
    200.0: (218.1, 9.0, 21.4), 300.0: (274.0, 8.6, 23.0), 400.0: (372.0, 7.0, 39.0), 500.0: (463.0, 7.4, 46.0),
    600.0: (558.0, 7.0, 67.0), 700.0: (654.0, 6.57, 40.0), 800.0: (758.0, 6.5, 42.0), 900.0: (843.0, 6.33, 56.0),
    1000.0: (940.0, 6.0, 60.0), 2000.0: (1879.0, 6.04, 120.0),
}  # fmt: skip
"""Target -> mean, us, percent error, average deviation, us: the thesis' table 8, and its 1000 samples at 200 us."""
Actuators = Literal["single", "multiple", "robot"]
SOURCE_READINGS: Mapping[Actuators, Mapping[float, float]] = {
    "single": {300: 260, 400: 360, 500: 450, 600: 560, 700: 660, 800: 750, 900: 860, 1000: 980, 2000: 1940},
    "multiple": {300: 250, 400: 350, 500: 460, 600: 550, 700: 660, 800: 760, 900: 870, 1000: 960, 2000: 1920},
    "robot": {300: 256, 400: 354, 500: 460, 600: 570, 700: 650, 800: 750, 900: 872, 1000: 953, 2000: 1922},
}
"""Setup -> target -> cycle as read at the oscilloscope, us: the thesis' table 7."""
SOURCE_DELAYS_NS: Mapping[Actuators, Sequence[int]] = {
    "single": (0, 880),
    "multiple": (0, 840, 1680, 2520, 3340, 4030, 4960),
    "robot": (0, 820, 1660, 2500, 3320, 4160, 5020),
}
"""Setup -> delay of each slave, ns, mean of five measurements: the thesis' table 6."""
_READ_INTERVAL_S = 0.1
"""Interval of reading, s: the segment keeps 1024 edges, 0.2 s at 200 us."""


def actuators(arm: ArmConfig) -> Actuators:
    """Return which of the thesis' setups an arm's file describes."""
    if len(arm.joints) == 1:
        return "single"
    return "robot" if arm.arm is not None else "multiple"


def spread(intervals_us: Array, target_us: float) -> tuple[float, float, float]:
    """Return mean, us, percent error of the mean, and average deviation from the mean, us."""
    mean = float(intervals_us.mean())
    return mean, 100.0 * abs(mean - target_us) / target_us, float(np.abs(intervals_us - mean).mean())


class CycleExperiment(Experiment):
    """The ten cycle targets of the thesis, six drives enabled, measured inside and outside.

    Args:
        targets_us: periods of the cycle, us.
        seconds: duration of each, s.
    """

    name = "cycle"
    title = "Cycle time: mean, error and average deviation"

    def __init__(self, targets_us: Sequence[float] = tuple(SOURCE_CYCLES), seconds: float = 5.0) -> None:
        self._targets_us = targets_us
        self._seconds = seconds

    def run(self, setup: Setup) -> Iterator[Row]:
        """See `Experiment.run`; a target that the host cannot keep is a note."""
        readings = SOURCE_READINGS[actuators(setup.arm)]
        times: dict[float, dict[str, Array]] = {}
        for target in self._targets_us:
            source = SOURCE_CYCLES.get(target, (None, None, None))
            try:
                times[target] = self._measure(setup, target)
            except CaptureError:
                raise
            except (RtcpError, ExperimentFailed) as error:
                setup.note(f"{target:g} us: not measured: {error}")
                yield Row(f"{target:g} us: mean", "us", nan, source[0], least=0.0)
                continue
            for side, intervals in times[target].items():
                mean, percent, deviation = spread(intervals, target)
                label = f"{target:g} us, {side}"
                yield Row(f"{label}: mean", "us", mean, source[0])
                if side != "inside" and target in readings:
                    yield Row(f"{label}: mean, {actuators(setup.arm)} in table 7", "us", mean, readings[target])
                yield Row(f"{label}: error of the mean", "%", percent, source[1], most=source[1])
                yield Row(f"{label}: average deviation", "us", deviation, source[2], most=source[2])
                setup.report(
                    f"{label}: mean {mean:.2f} us, error {percent:.3f} %, average deviation {deviation:.2f} us"
                )
        if not times:
            raise ExperimentFailed("no cycle could be measured: " + "; ".join(setup.notes))
        self._draw(setup, times)

    def _measure(self, setup: Setup, target_us: float) -> dict[str, Array]:
        output = setup.arm.outputs.heartbeat
        with (
            setup.platform(target_us) as robot,
            setup.recording(robot, f"recording-{target_us:g}us", ("*_ns", "wkc")) as path,
        ):
            edges = self._edges(setup, output) if setup.is_virtual and output else self._wait()
        inside = np.diff(read(path, ("time_ns",)).column("time_ns")) * 1e-3
        return {"inside": inside, **({"outside": np.diff(edges) * 1e-3} if len(edges) > 1 else {})}

    def _wait(self) -> Array:
        time.sleep(self._seconds)
        return np.empty(0)

    def _edges(self, setup: Setup, output: int) -> Array:
        """Return the instants of the output's edges, ns of the IO box's own clock."""
        arm = setup.arm
        slave = next(at for at, entry in enumerate(arm.slaves, 1) if entry.device.is_box)
        stamps: list[int] = []
        control = read_session(runtime_directory()).segment_control
        assert control is not None
        with SegmentClient(control) as segment:
            segment.edges(slave, output)  # the segment records edges from the first request on
            until = time.monotonic() + self._seconds
            while time.monotonic() < until:
                time.sleep(_READ_INTERVAL_S)
                edges = segment.edges(slave, output)
                if len(edges) >= EDGES:
                    raise ExperimentFailed("this process was kept waiting: edges of the output were not read in time")
                stamps += edges
        return np.array(stamps, np.float64)

    @staticmethod
    def _draw(setup: Setup, times: dict[float, dict[str, Array]]) -> None:
        from matplotlib.figure import Figure

        figure = Figure(figsize=(11.0, 5.0), layout="constrained")
        means, spreads = figure.subplots(1, 2)
        targets = [target for target in times if target in SOURCE_CYCLES]
        for at, (axes, unit) in enumerate(((means, "error of the mean, %"), (spreads, "average deviation, us")), 1):
            axes.plot(targets, [SOURCE_CYCLES[target][at] for target in targets], "o--", label="thesis")
            for side in dict.fromkeys(side for sides in times.values() for side in sides):
                known = sorted(target for target in times if side in times[target])
                if known:
                    axes.plot(known, [spread(times[target][side], target)[at] for target in known], "o-", label=side)
            axes.set(xlabel="target, us", ylabel=unit, yscale="log")
            axes.grid(alpha=0.3)
            axes.legend()
        setup.draw("cycle", figure)


class OscilloscopeExperiment(CycleExperiment):
    """The same figures from files that an oscilloscope at the heartbeat output exported; no platform is started.

    Args:
        captures: period of the cycle, us -> file.
        channel: column of levels in the files, from 1.
    """

    def __init__(self, captures: Mapping[float, Path], channel: int = 1) -> None:
        super().__init__(tuple(captures))
        self._captures = captures
        self._channel = channel

    def _measure(self, setup: Setup, target_us: float) -> dict[str, Array]:
        capture = read_capture(self._captures[target_us], self._channel)
        edges, rises = toggles(capture)
        setup.note(
            f"{capture.path.name}: {len(edges)} edges in {1e3 * np.ptp(capture.seconds):.3g} ms, one sample each "
            f"{capture.resolution_us:.3g} us; a high level lasts {_high_us(edges, rises):.1f} us on average"
        )
        return {"oscilloscope": np.diff(edges) * 1e6}


def _high_us(edges: Array, rises: bool) -> float:
    """Return the mean duration of a high level, us; an output that switches off slowly makes it longer or shorter."""
    return float(np.diff(edges)[0 if rises else 1 :: 2].mean() * 1e6) if len(edges) > 2 else nan


class DelaysExperiment(Experiment):
    """The propagation delay from the master to each slave, as the distributed clocks measure it at the start.

    Args:
        measurements: starts of the platform, over which the mean is taken.
    """

    name = "delays"
    title = "Propagation delay to each slave"

    def __init__(self, measurements: int = 5) -> None:
        self._measurements = measurements

    def run(self, setup: Setup) -> list[Row]:
        """See `Experiment.run`."""
        scans = []
        for _ in range(self._measurements):
            with setup.platform(enabled=False) as robot:
                scans.append(robot.scan())
        rows = []
        clocks: dict[int, float] = {}
        sources = SOURCE_DELAYS_NS[actuators(setup.arm)]
        for at, slave in enumerate(scans[0]):
            source = sources[at] if at < len(sources) else None
            # The virtual cable has the thesis' delays; a real one has its own.
            bounds = {} if source is None or not setup.is_virtual else {"least": source - 20.0, "most": source + 20.0}
            if slave["dc"]:
                delays = [float(slaves[at]["delay_ns"]) for slaves in scans]
                clocks[at + 1] = float(np.mean(delays))
                figure = f"{actuators(setup.arm)}: {at + 1} {slave['name']}"
                rows.append(Row(figure, "ns", clocks[at + 1], source, **bounds))
                if np.ptp(delays):
                    setup.note(f"{figure}: {min(delays):g} to {max(delays):g} ns in {len(delays)} starts")
        if not rows:
            raise ExperimentFailed("no slave has a distributed clock")
        self._draw(setup, clocks, sources)
        return rows

    @staticmethod
    def _draw(setup: Setup, clocks: dict[int, float], sources: Sequence[int]) -> None:
        from matplotlib.figure import Figure

        figure = Figure(figsize=(7.0, 4.5), layout="constrained")
        axes = figure.subplots()
        axes.bar(list(clocks), list(clocks.values()), width=0.5, label="here")
        axes.plot(range(1, len(sources) + 1), sources, "o", color="tab:orange", label="thesis")
        axes.set(xlabel="slave, in the order of the cable", ylabel="propagation delay, ns")
        axes.grid(axis="y", alpha=0.3)
        axes.legend()
        setup.draw("delays", figure)
