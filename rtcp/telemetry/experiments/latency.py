"""The latency from a streamed command to the motion: a sine, fitted to the commands and to the actual positions.

The second thesis, on ABB arms under ROS-Industrial, streams a sine over a range of pi/8 rad with a period of 2 s at
30 Hz, and finds that the feedback lags by 455 ms, of which 33 ms are the period of the commands.
"""

from __future__ import annotations

import contextlib
import json
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from math import cos, pi, tau
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.optimize import curve_fit

from rtcp.api import Robot, RtcpError, State
from rtcp.config.buses import ControllerBus
from rtcp.config.model import ArmConfig
from rtcp.ipc import jsonrpc
from rtcp.ipc.observer import Observer
from rtcp.ipc.runtime_directory import blackboard_file, control_socket, irc5_control, runtime_directory
from rtcp.ipc.schema import identifier
from rtcp.telemetry.experiments.experiment import SPEED_RAD_S, Experiment, ExperimentFailed, Row, Setup
from rtcp.telemetry.reading import Recorded, read
from rtcp.virtual.request_socket import RequestClient

Array = npt.NDArray[np.float64]
Send = Callable[[Sequence[float]], bool]
"""Sends joint positions, rad; returns whether it did."""

AMPLITUDE_RAD, PERIOD_S = pi / 16, 2.0
_THESIS_MS: Mapping[str, float | str] = {"ethercat": 455.0, "rapid": 455.0, "egm": "8 to 20"}
"""Kind of bus -> latency in the second thesis, ms: measured over RAPID, quoted for EGM."""
_REPORTED_MS = "-5, -1, 12"
"""Lag of reported positions behind an accelerometer in the second thesis, ms: three runs over RAPID."""
_LARGEST_RATE_RATIO = 1.05
"""Greatest ratio of a stream's rate to the cycle's rate."""
AIM_CYCLES = 3.0
"""Aim for the time from a command to its frame, cycles."""
_JOINT = 0
_POLL_S = 0.2
_UNDER_WAY = 4
"""Most commands without an answer."""
_REFUSED = 10
"""Most refused commands of a stream: a host that stalls delays some too long."""
_MOST_BY_SOCKET_HZ = 1000.0
_REST_S = 10.0
_SPARE = 4.0
"""Ratio of the limits to the sine's needs: with less the motion to each target, not the platform, takes the time."""
_TRIES = 5
"""Attempts at a stream that this host held up."""
_MOST_POINTS = 500
"""Most points of a series in a picture."""
_PROBES, _PROBE_INTERVAL_S = 200, 0.02
_PROBE_TIMEOUT_NS = 1_000_000_000


@dataclass(frozen=True)
class Sine:
    """A fitted sine, amplitude * sin(tau * (t - delay_s) / period_s) + offset, and the standard error of its delay."""

    amplitude: float
    period_s: float
    delay_s: float
    offset: float
    error_s: float


def fit_sine(t: Array, y: Array, period_s: float, origin_s: float) -> Sine:
    """Fit a sine by least squares.

    Args:
        t: s, shape (n,), n of at least 5.
        y: shape (n,).
        period_s: estimate of the period.
        origin_s: origin of the delays, near the middle of the data, where they do not depend on the error of the
            period; the same for all sines that are compared.
    """
    x = t - origin_s
    w = tau / period_s
    (a, b, c), *_ = np.linalg.lstsq(np.column_stack((np.sin(w * x), np.cos(w * x), np.ones_like(x))), y, rcond=None)

    def model(x: Array, amplitude: float, period: float, delay: float, offset: float) -> Array:
        return amplitude * np.sin(tau * (x - delay) / period) + offset

    guess = (float(np.hypot(a, b)), period_s, float(np.arctan2(-b, a)) / w, float(c))
    (amplitude, period, delay, offset), covariance = curve_fit(model, x, y, guess)
    return Sine(amplitude, period, delay % period, offset, float(np.sqrt(covariance[2, 2])))


def behind(feedback: Sine, command: Sine) -> tuple[float, float]:
    """Return the lag of a sine behind another, s, from minus to plus half a period, and its standard error."""
    delay = (feedback.delay_s - command.delay_s + 0.5 * command.period_s) % command.period_s - 0.5 * command.period_s
    return delay, float(np.hypot(feedback.error_s, command.error_s))


@contextmanager
def _by_api(robot: Robot) -> Iterator[Send]:
    with robot.open_stream() as stream:

        def send(q: Sequence[float]) -> bool:
            stream.send(q)
            return True

        yield send


class _Answers(threading.Thread):
    """Counts the answers, one line each, from a socket."""

    def __init__(self, connection: socket.socket) -> None:
        super().__init__(daemon=True)
        self._connection = connection
        self.count = self.refused = 0

    def run(self) -> None:
        with contextlib.suppress(OSError):
            while data := self._connection.recv(65536):
                self.refused += data.count(b'"error"')
                self.count += data.count(b"\n")


@contextmanager
def _by_socket(robot: Robot) -> Iterator[Send]:
    """Write lines of JSON-RPC to the control socket, with up to `_UNDER_WAY` unanswered."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
        connection.connect(str(control_socket(runtime_directory())))
        answers = _Answers(connection)
        answers.start()
        number = 0

        def send(q: Sequence[float]) -> bool:
            nonlocal number
            # A command that waits in the socket would be late: a stream skips it.
            if number - answers.count >= _UNDER_WAY:
                return False
            if answers.refused > _REFUSED:
                raise ExperimentFailed(f"{answers.refused} of {number} commands of a stream were refused")
            number += 1
            params = {"q": list(q), "stamp_s": time.monotonic()}
            connection.sendall(jsonrpc.request(number, "stream_position", params))
            return True

        yield send
        connection.shutdown(socket.SHUT_RDWR)
        answers.join()


@contextmanager
def _accelerometer(setup: Setup) -> Iterator[list[tuple[float, float]]]:
    """Yield a list, filled when the block ends: CLOCK_MONOTONIC, s, and acceleration of the flange along y, m/s^2.

    Near its zero joint 1 moves the flange along y. The list stays empty without a virtual robot controller, which alone
    has an accelerometer.
    """
    samples: list[tuple[float, float]] = []
    if not (setup.is_virtual and isinstance(setup.arm.bus, ControllerBus)):
        yield samples
        return
    ended = threading.Event()

    def poll(client: RequestClient) -> None:
        while not ended.wait(_POLL_S):
            for newest in client.ask({"do": "accelerometer"}).values():
                samples.extend((stamp, y) for stamp, _, y, _ in newest)

    with RequestClient(irc5_control(runtime_directory()), server="virtual IRC5") as client:
        client.ask({"do": "accelerometer"})  # drops older samples
        polling = threading.Thread(target=poll, args=(client,), daemon=True)
        polling.start()
        try:
            yield samples
        finally:
            ended.set()
            polling.join()


INTERFACES: Mapping[str, Callable[[Robot], contextlib.AbstractContextManager[Send]]] = {
    "Python API": _by_api,
    "socket": _by_socket,
}


class LatencyExperiment(Experiment):
    """The sine, streamed through each interface at each rate.

    Args:
        rates_hz: rates of the commands, Hz.
        periods: number of periods of the sine; the first one is not evaluated.
        accelerometer: input channel with the acceleration of the flange in the direction in which joint 1 moves it,
            `SLAVE.CHANNEL`, m/s^2; empty: that of a virtual robot controller, else none.
    """

    name = "latency"
    title = "Latency of streamed joint commands"

    def __init__(
        self, rates_hz: Sequence[float] = (30.0, 250.0, 1000.0, 2000.0), periods: int = 6, accelerometer: str = ""
    ) -> None:
        self._rates_hz = rates_hz
        self._periods = periods
        self._accelerometer = accelerometer
        self._drive_us: Array = np.empty(0)
        """Lag of each actual position of the last stream behind the sent ones, us."""

    def run(self, setup: Setup) -> Iterator[Row]:
        """See `Experiment.run`; the rows before a failure stay."""
        self._check_accelerometer(setup.arm)
        w = tau / PERIOD_S
        needs = {"velocity": AMPLITUDE_RAD * w, "acceleration": AMPLITUDE_RAD * w**2, "jerk": 10 * AMPLITUDE_RAD * w**3}
        setup = setup.with_limits(_JOINT, **{key: _SPARE * value for key, value in needs.items()})
        limits = setup.arm.joints[_JOINT]
        share = min(1.0, *(getattr(limits, key) / (_SPARE * value) for key, value in needs.items()))
        if share < 1.0:
            setup.note(f"the sine has {share:.2f} of its amplitude: the limits of {limits.name} allow no more")
        fastest = _LARGEST_RATE_RATIO * 1e6 / setup.arm.cycle.period_us
        with setup.platform() as robot:
            for input_name in INTERFACES:
                for rate in self._rates_hz:
                    if rate > fastest or (input_name == "socket" and rate > _MOST_BY_SOCKET_HZ):
                        continue  # by the socket each command is a line of JSON, and answered
                    yield from self._repeated(setup, robot, input_name, rate, share * AMPLITUDE_RAD)
            yield from self._sine_by_ros(setup, robot, share * AMPLITUDE_RAD)
            if isinstance(setup.arm.bus, ControllerBus):
                return  # the rest is the platform's own, and the same on every bus
            yield from self._parts(setup, robot)
            yield from self._to_frame(robot)
            yield from self._by_ros(setup, robot)
            yield from _by_node(setup)

    def _check_accelerometer(self, arm: ArmConfig) -> None:
        slave, _, channel = self._accelerometer.partition(".")
        slaves = {each.name: each.device for each in arm.slaves}
        if not self._accelerometer:
            return
        inputs = [entry.name for pdo in slaves[slave].tpdo for entry in pdo.channels] if slave in slaves else []
        if channel not in inputs:
            allowed = ", ".join(inputs) if inputs else f"of one of the slaves {', '.join(slaves)}"
            raise ExperimentFailed(
                f"the accelerometer {self._accelerometer} is no input channel, SLAVE.CHANNEL: allowed is {allowed}"
            )

    def _repeated(self, setup: Setup, robot: Robot, input_name: str, rate: float, amplitude: float) -> list[Row]:
        """Stream the sine; begin anew where this host held up the sender or the platform for too long."""
        base = list(robot.status().positions)
        for _ in range(_TRIES - 1):
            try:
                return self._stream(setup, robot, input_name, rate, amplitude)
            except (RtcpError, ExperimentFailed) as error:
                state = robot.state
                if state not in (State.HOLDING, State.MOVING, State.STOPPING):
                    raise
                setup.note(f"{input_name}, {rate:g} Hz is repeated: {error}")
                _wait_until_it_rests(robot)
                robot.move_joints(base, speed=SPEED_RAD_S)
        return self._stream(setup, robot, input_name, rate, amplitude)

    def _stream(self, setup: Setup, robot: Robot, input_name: str, rate: float, amplitude: float) -> list[Row]:
        label, name = f"{input_name}, {rate:g} Hz", f"{input_name}-{rate:g}-Hz".replace(" ", "-")
        base = list(robot.status().positions)
        sign = 1.0 if base[_JOINT] + 2 * amplitude < setup.arm.joints[_JOINT].position.max else -1.0
        times: list[float] = []
        values: list[float] = []
        with setup.recording(robot, f"recording-{name}", ("*_position", *self._field())) as path:
            with INTERFACES[input_name](robot) as send, _accelerometer(setup) as accelerations:
                begun, number = time.monotonic(), 0
                while (now := time.monotonic() - begun) < self._periods * PERIOD_S:
                    q = base[_JOINT] + sign * amplitude * (1.0 - cos(tau * now / PERIOD_S))
                    if send([q, *base[1:]]):
                        times.append(begun + now)
                        values.append(q)
                    # A missed tick is skipped: commands are never sent in a burst.
                    number = max(number + 1, int((time.monotonic() - begun) * rate))
                    time.sleep(max(0.0, begun + number / rate - time.monotonic()))
            _wait_until_it_rests(robot)
        robot.move_joints(base, speed=SPEED_RAD_S)
        recorded = read(path, ("time_ns", "*_position", *self._field()))
        series = {"command": (np.array(times), np.array(values)), **_recorded_series(recorded)}
        for field in self._field():
            samples = recorded.records["time_ns"] * 1e-9, recorded.records[field]
            accelerations = list(zip(*(column.tolist() for column in samples), strict=True))
        # Evaluate only times within the sine, without its first period.
        first, last = begun + PERIOD_S, times[-1]
        sines = _fitted(series, first, last)
        command = sines["command"]
        latency, error = behind(sines["actual"], command)
        wire, _ = behind(sines["sent"], command)
        cycles = wire / recorded.period_s
        aim = (0.0, AIM_CYCLES) if rate >= 1000.0 else ()
        thesis_ms = _THESIS_MS.get(setup.arm.bus.kind) if rate == 30.0 else None
        self._drive_us = 1e6 * _behind_each(*series["sent"], *series["actual"], first, last)
        _draw(setup, name, f"{label}: actual {1e3 * latency:.1f} ms behind", series, sines, (first, last))
        of_robot = _beside_accelerometer(setup, name, label, series, sines, "actual", accelerations, (first, last))
        setup.report(
            f"{label}: {1e3 * latency:.2f} +- {1e3 * error:.2f} ms to the motion, {cycles:.1f} cycles to the wire"
        )
        return [
            Row(f"{label}: rate", "Hz", (len(times) - 1) / (times[-1] - times[0]), least=0.95 * rate),
            Row(f"{label}: latency to the motion", "ms", 1e3 * latency, thesis_ms),
            Row(f"{label}: its standard error", "ms", 1e3 * error),
            *of_robot,
            Row(f"{label}: command to the wire", "cycles", cycles, None, *aim),
            Row(f"{label}: sent to actual", "ms", 1e3 * behind(sines["actual"], sines["sent"])[0]),
            Row(f"{label}: amplitude, actual / command", "", sines["actual"].amplitude / command.amplitude),
        ]

    def _parts(self, setup: Setup, robot: Robot) -> list[Row]:
        """Measure the delays of single commands in socket, ring, cycle, wire and drive."""
        observer = Observer(blackboard_file(runtime_directory()))
        base = list(robot.status().positions)
        into_ring: list[float] = []
        read_delays: list[float] = []
        instants: list[int] = []
        begun = observer.head
        with contextlib.closing(observer), _by_socket(robot) as send:
            for _ in range(_PROBES):
                number = observer.commands_sent + 1
                sent = time.monotonic_ns()
                send(base)
                ringed = _spin_until(number, lambda: observer.commands_sent)
                arrived = _spin_until(number, lambda: observer.commands_taken)
                into_ring.append(1e-3 * (ringed - sent))
                read_delays.append(1e-3 * (arrived - ringed))
                instants.append(arrived)
                time.sleep(_PROBE_INTERVAL_S)
            records, _ = observer.since(begun)
        _wait_until_it_rests(robot)
        # The outputs of a cycle leave at the beginning of the next one.
        at = np.searchsorted(records["time_ns"], instants)
        known = at < len(records)
        left = records["time_ns"][at[known]] - np.array(instants)[known]
        parts = {
            "socket": np.array(into_ring),
            "ring": np.array(read_delays),
            "cycle": 1e-3 * left,
            "wire": 1e-3 * records["exchange_ns"][at[known]],
            "drive": self._drive_us,
        }
        return [
            Row(f"{name}: p{p}", "us", float(np.percentile(values, p)))
            for name, values in parts.items()
            for p in (50, 99)
        ]

    @staticmethod
    def _to_frame(robot: Robot) -> list[Row]:
        """Measure the time of an open stream's setpoints from `send` until the frame has left, in cycles."""
        observer = Observer(blackboard_file(runtime_directory()))
        base = list(robot.status().positions)
        sent_at, instants, begun = [], [], observer.head
        with contextlib.closing(observer), robot.open_stream() as stream:
            for _ in range(_PROBES):
                number = observer.setpoints_taken + 1
                sent_at.append(time.monotonic_ns())
                stream.send(base)
                instants.append(_spin_until(number, lambda: observer.setpoints_taken))
                time.sleep(_PROBE_INTERVAL_S)
            records, _ = observer.since(begun)
            period_ns = observer.period_ns
        _wait_until_it_rests(robot)
        at = np.searchsorted(records["time_ns"], instants)
        known = at < len(records)
        cycles = (records["time_ns"][at[known]] - np.array(sent_at)[known]) / period_ns
        return [
            Row(f"Python API: command to frame, p{p}", "cycles", float(np.percentile(cycles, p)), None, 0.0, AIM_CYCLES)
            for p in (50, 99)
        ]

    @staticmethod
    def _by_ros(setup: Setup, robot: Robot) -> list[Row]:
        """Measure the time of a ROS 1 client's commands until the frame has left, where ROS 1 is installed."""
        _wait_for_the_lease(robot)
        period_s = 1e-6 * setup.arm.cycle.period_us
        command = [sys.executable, "-m", "rtcp.ros.ros1_latency", "probe", str(_PROBES // 2)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            setup.note(f"no figures for ROS 1: {done.stderr.strip()}")
            return []
        return [
            Row(f"ROS 1 {input_name}: command to frame, p{p}", "cycles", float(np.percentile(seconds, p)) / period_s)
            for input_name, seconds in json.loads(done.stdout).items()
            for p in (50, 99)
        ]

    def _field(self) -> tuple[str, ...]:
        """Return the accelerometer's field of the record, where a slave has one."""
        slave, _, channel = self._accelerometer.partition(".")
        return (f"{identifier(slave)}_{channel}",) if channel else ()

    def _sine_by_ros(self, setup: Setup, robot: Robot, amplitude: float) -> list[Row]:
        """Stream the sine by `joint_command` of ROS 1 and log it from the topics, as the second thesis does."""
        label = "ROS 1 joint_command, 30 Hz"
        base = list(robot.status().positions)
        sign = 1.0 if base[_JOINT] + 2 * amplitude < setup.arm.joints[_JOINT].position.max else -1.0
        _wait_for_the_lease(robot)
        arguments = ("30", f"{sign * amplitude:g}", f"{PERIOD_S:g}", str(self._periods))
        command = [sys.executable, "-m", "rtcp.ros.ros1_latency", "sine", str(setup.folder), *arguments]
        with _accelerometer(setup) as accelerations:
            done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            setup.note(f"no sine through ROS 1: {done.stderr.strip()}")
            return []
        series = {
            topic: read_log(setup.folder / f"{topic}.csv", setup.arm.joints[_JOINT].name)
            for topic in ("joint_command", "joint_states")
        }
        begun = series["joint_command"][0][0]
        first, last = begun + PERIOD_S, begun + self._periods * PERIOD_S
        sines = _fitted(series, first, last)
        latency, error = behind(sines["joint_states"], sines["joint_command"])
        _draw(setup, "ros-1", f"{label}: joint_states {1e3 * latency:.1f} ms behind", series, sines, (first, last))
        origin = float(json.loads(done.stdout))
        samples = [(stamp - origin, y) for stamp, y in accelerations]
        of_robot = _beside_accelerometer(
            setup, "ros-1", label, series, sines, "joint_states", samples, (first, last)
        )  # fmt: skip
        setup.report(f"{label}: joint_states {1e3 * latency:.2f} +- {1e3 * error:.2f} ms behind")
        return [
            Row(f"{label}: joint_states behind", "ms", 1e3 * latency, _THESIS_MS.get(setup.arm.bus.kind)),
            Row(f"{label}: its standard error", "ms", 1e3 * error),
            *of_robot,
        ]


def read_log(path: Path, column: str) -> tuple[Array, Array]:
    """Return time, s, and a column of a log: one of `rtcp.ros.ros1_latency`, or of `abb/rapid/latency.mod`.

    Raises:
        ExperimentFailed: the file has no such column, or no line.
    """
    with path.open() as file:
        names = file.readline().strip().split(",")
        lines = file.readlines()
    if column not in names or not lines:
        raise ExperimentFailed(f"{path}: found {len(lines)} lines with {', '.join(names)}, needed is {column}")
    rows = np.loadtxt(lines, delimiter=",", ndmin=2)
    return rows[:, 0], rows[:, names.index(column)]


def lag_of_log(path: Path) -> tuple[float, float]:
    """Return the lag of `actual` behind `command` in a log of `abb/rapid/latency.mod`, s, and its standard error.

    Raises:
        ExperimentFailed: as `read_log`.
    """
    series = {name: read_log(path, name) for name in ("command", "actual")}
    t, _ = series["command"]
    sines = _fitted(series, t[0] + PERIOD_S, t[-1])
    return behind(sines["actual"], sines["command"])


def _fitted(series: Mapping[str, tuple[Array, Array]], first: float, last: float) -> dict[str, Sine]:
    """Return the fitted sine of each series, from its points between two instants, s."""
    sines = {}
    for signal, (t, y) in series.items():
        inside = (t >= first) & (t <= last)
        sines[signal] = fit_sine(t[inside], y[inside], PERIOD_S, 0.5 * (first + last))
    return sines


def _curve(sine: Sine, t: Array, first: float, last: float) -> Array:
    """Return the values of a sine that was fitted between two instants."""
    curve: Array = sine.amplitude * np.sin(tau * (t - 0.5 * (first + last) - sine.delay_s) / sine.period_s)
    return curve + sine.offset


def _draw(
    setup: Setup, name: str, title: str, series: Mapping[str, tuple[Array, Array]], sines: Mapping[str, Sine],
    window: tuple[float, float],
) -> None:  # fmt: skip
    """Draw each point of one period of all series, with the fitted curves between the two instants of `window`."""
    from matplotlib.figure import Figure

    first, last = window
    figure = Figure(figsize=(9.0, 4.5), layout="constrained")
    axes = figure.add_subplot()
    dense = np.linspace(first, min(first + PERIOD_S, last), 400)
    for number, (signal, (t, y)) in enumerate(series.items()):
        inside = (t >= dense[0]) & (t <= dense[-1])
        stride = max(1, int(inside.sum() // _MOST_POINTS))
        axes.plot(t[inside][::stride] - first, y[inside][::stride], ".", ms=4, color=f"C{number}", label=signal)
        curve = _curve(sines[signal], dense, first, last)
        axes.plot(dense - first, curve, "--", lw=1.0, color=f"C{number}", label=f"{signal}, fitted")
    axes.set(xlabel="time, s", ylabel="joint 1, rad", title=title)
    axes.legend()
    axes.grid(alpha=0.3)
    setup.draw(f"latency-{name}", figure)


def _beside_accelerometer(
    setup: Setup, name: str, label: str, series: Mapping[str, tuple[Array, Array]], sines: Mapping[str, Sine],
    reported: str, samples: Sequence[tuple[float, float]], window: tuple[float, float],
) -> list[Row]:  # fmt: skip
    """Compare a reported series with the accelerometer: rows, a picture, and the samples as accelerometer-NAME.csv."""
    if not samples:
        return []
    from matplotlib.figure import Figure

    first, last = window
    t, y = np.array(samples).T
    np.savetxt(
        setup.folder / f"accelerometer-{name}.csv", np.column_stack((t, y)), "%.6f,%.6g",
        header="time_s,acceleration_m_s2", comments="",
    )  # fmt: skip
    sine = _fitted({"": (t, y)}, first, last)[""]
    # The acceleration of a sine is the sine turned round.
    lag, error = behind(sines[reported], replace(sine, delay_s=sine.delay_s + 0.5 * sine.period_s))
    figure = Figure(figsize=(9.0, 4.5), layout="constrained")
    axes = figure.add_subplot()
    dense = np.linspace(first, min(first + 2 * PERIOD_S, last), 400)
    inside = (t >= dense[0]) & (t <= dense[-1])
    axes.plot(t[inside] - first, y[inside], ".", ms=3, color="C2", label="accelerometer")
    axes.plot(dense - first, _curve(sine, dense, first, last), "-", lw=1.0, color="C2", label="accelerometer, fitted")
    axes.set(
        xlabel="time, s",
        ylabel="acceleration of the flange, m/s$^2$",
        title=f"{label}: {reported} {1e3 * lag:.1f} ms behind",
    )
    beside = axes.twinx()
    at, q = series[reported]
    shown = (at >= dense[0]) & (at <= dense[-1])
    beside.plot(at[shown] - first, q[shown], ".", ms=2, color="C1", label=reported)
    beside.plot(
        dense - first, _curve(sines[reported], dense, first, last), "--", color="C1", label=f"{reported}, fitted"
    )
    beside.set_ylabel("joint 1, rad")
    figure.legend(loc="outside lower center", ncols=4)
    axes.grid(alpha=0.3)
    setup.draw(f"latency-{name}-accelerometer", figure)
    source = _REPORTED_MS if setup.arm.bus.kind == "rapid" else None
    return [
        Row(f"{label}: reported behind the accelerometer", "ms", 1e3 * lag, source),
        Row(f"{label}: at most its standard error", "ms", 1e3 * error),
    ]


def _wait_for_the_lease(robot: Robot) -> None:
    """Wait until the lease of the last stream has ended."""
    until = time.monotonic() + _REST_S
    while robot.status().holder and time.monotonic() < until:
        time.sleep(0.05)


def _by_node(setup: Setup) -> list[Row]:
    """Measure the time of commands by ROS 2 and Simple Message until the frame has left, over each installed wire."""
    rows: list[Row] = []
    for wire in ("DDS", "Zenoh", "Simple Message"):  # the last one leaves the drives disabled
        command = [sys.executable, "-m", "rtcp.ros.latency", wire.lower().replace(" ", "-")]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            setup.note(f"{wire} was not measured: {done.stderr.strip().rpartition(chr(10))[2]}")
            continue
        cycles = json.loads(done.stdout)
        rows += [Row(f"{wire}: publish to frame, p{p}", "cycles", float(np.percentile(cycles, p))) for p in (50, 99)]
    return rows


def _recorded_series(recorded: Recorded) -> dict[str, tuple[Array, Array]]:
    """Return sent and actual position over the time of CLOCK_MONOTONIC, s."""
    records = recorded.records
    t = records["time_ns"] * 1e-9
    # The sent values of a record leave at the beginning of the next cycle.
    leaves = np.append(t[1:], t[-1] + recorded.period_s)
    return {
        "sent": (leaves, records["sent_position"][:, _JOINT]),
        "actual": (t, records["actual_position"][:, _JOINT]),
    }


def _behind_each(sent_at: Array, sent: Array, at: Array, actual: Array, first: float, last: float) -> Array:
    """Return the lag of each actual position behind the sent ones, s, where the sent speed exceeds half its maximum."""
    speed = np.gradient(sent, sent_at)
    moves = (np.abs(speed) > 0.5 * np.abs(speed).max()) & (at > first) & (at < last)
    delays: Array = (np.interp(at, sent_at, sent) - actual)[moves] / speed[moves]
    return delays


def _spin_until(number: int, count: Callable[[], int]) -> int:
    """Poll until a count has reached a number; return the instant, ns."""
    until = time.monotonic_ns() + _PROBE_TIMEOUT_NS
    while count() < number:
        if time.monotonic_ns() > until:
            raise ExperimentFailed("a command did not reach the loop within 1 s")
    return time.monotonic_ns()


def _wait_until_it_rests(robot: Robot) -> None:
    until = time.monotonic() + _REST_S
    while (state := robot.state) is not State.HOLDING:
        if state not in (State.MOVING, State.STOPPING) or time.monotonic() > until:
            raise ExperimentFailed(f"the arm does not come to rest: the machine is {state.words}")
        time.sleep(0.02)
