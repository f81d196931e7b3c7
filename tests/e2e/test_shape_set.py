"""`rtcp shape-set` on the virtual cell: a rod is bent; every early end ends the heat before the motion."""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import re
import shutil
import signal
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import pytest

from rtcp.api import Robot, RtcpError, State
from rtcp.api.cell import Cell
from rtcp.cli.__main__ import main
from rtcp.config.find import default_config
from rtcp.ipc.runtime_directory import control_socket, irc5_control, segment_control
from rtcp.ipc.session import read_processes
from rtcp.processes.shape_setting.heat_profile import heat_command
from rtcp.processes.shape_setting.job import read_job
from rtcp.processes.shape_setting.run import VirtualRod
from rtcp.virtual.faults.control import SegmentClient
from rtcp.virtual.request_socket import RequestClient, RequestRefused
from tests.cell.running import leftovers_of, put_in_order
from tests.e2e.conftest import Platform, kill, lives
from tests.leftovers import Leftovers
from tests.ros1.conftest import Ros, begin_node, ros, ros_on_the_path  # noqa: F401  # fixtures
from tests.waiting import until

pytestmark = pytest.mark.platform

CONFIG = default_config().parent
EXAMPLE = CONFIG.parent / "examples" / "shape_setting_ros.py"
AWAY = (0.2, -0.6, 0.5, 0.0, 0.3, 0.0)
BEGINS = {
    "approaching": "arms are enabled",
    "bending": "the rod is bent",
    "heating": "heating to",
    "holding": "heating to",
}
"""Message of the command at the beginning of each phase."""


ENDED_OTHERWISE = pytest.mark.long("test_a_command_that_is_ended_anywhere_leaves_no_heat_and_arms_at_rest")
OTHER_CAUSE = pytest.mark.long(
    "test_by_hand_in_auto_with_each_arm_in_its_hand_mode_a_released_enabling_device_ends_the_heat"
)


class HeaterCell:
    """The virtual cell with a profile of seconds; its heater has a cycle that a shared host holds."""

    def __init__(self, platform: Platform) -> None:
        self.platform = platform
        self.directory = platform.directory
        self.config = config = platform.directory / "config"
        shutil.copytree(CONFIG, config)
        in_cycles = {"period_us": 4000, "lost_cycles": 50, "stale_cycles": 50, "gate_cycles": 100}
        self._set(config / "heater.yaml", **in_cycles)
        self._set(config / "devices" / "shape-setter-box.yaml", watchdog_ms=20)
        self._set(config / "shape_setting" / "nitinol.yaml", hold_s=1, ramp_k_s=200, cool_c=400)
        self.job = config / "shape_setting" / "arc.yaml"
        self._set(self.job, approach_speed=1.0)
        self.run: Run | None = None
        self._runs = 0
        self.start()

    @staticmethod
    def _set(file: Path, **values: float) -> None:
        text = file.read_text()
        for key, value in values.items():
            text, count = re.subn(rf"\b{key}: [0-9.]+", f"{key}: {value}", text)
            assert count == 1, key
        file.write_text(text)

    def start(self) -> None:
        """Start the processes that do not run."""
        self.platform.rtcp("cell", "start", "--detach", "--config", str(self.config / "cell_shape_setting.yaml"))

    def connect(self) -> Cell:
        return Cell("the tests", directory=self.directory)

    def heater(self) -> Robot:
        return Robot("the tests", control_socket(self.directory / "heater"))

    def begin(self) -> Run:
        """Begin `rtcp shape-set`."""
        self._runs += 1
        folder = self.directory / f"report{self._runs}"
        arguments = ("shape-set", str(self.job), "--yes", "--out", str(folder))
        self.run = Run(arguments, self.platform.environment, folder)
        return self.run

    def truth(self) -> dict[str, Any]:
        """Return the state of the virtual control box, read without the bus."""
        with SegmentClient(segment_control(self.directory / "heater")) as segment:
            box: dict[str, Any] = segment.truth()["slaves"][0]
        return box

    def until(self, met: Callable[[dict[str, Any]], bool], what: str) -> None:
        until(lambda: met(self.truth()), what)

    def assert_cold(self) -> None:
        """Gate and relay go off, and the rod only cools from then on."""
        self.until(lambda truth: not (truth["gate"] or truth["relay"]), "heat off")
        before = self.truth()["middle_temperature"]
        for _ in range(20):
            truth = self.truth()
            assert not truth["gate"]
            assert not truth["relay"]
            assert truth["middle_temperature"] <= before + 0.1
            time.sleep(0.02)

    def restore(self) -> None:
        """Restart what a test has ended; reset and enable all."""
        ended = False
        for name in ("left", "right", "heater"):
            processes = read_processes(self.directory / name)
            if not lives(processes.loop):
                self.platform.rtcp("--name", name, "stop", check=None)
                ended = True
            elif not lives(processes.gateway):
                # Any command starts it again.
                self.platform.rtcp("--name", name, "status")
        if ended:
            self.start()
        for name in ("left", "right"):
            with RequestClient(irc5_control(self.directory / name), server="virtual IRC5") as operator:
                put_in_order(operator)
        with self.connect() as cell:
            rest(cell, State.STOPPING, State.STARTING)
            cell.reset()
            cell.processes["heater"].command("reset_trips")
            for name, status in cell.status().items():
                if status.state is State.READY and name != "heater":
                    cell.arms[name].enable()

    def end(self) -> None:
        self.platform.rtcp("cell", "stop", check=None)
        self.platform.end()


def rest(cell: Cell, *not_at_rest: State) -> None:
    """Wait until no part of the cell is in one of these states."""
    until(lambda: not any(status.state in not_at_rest for status in cell.status().values()), "rest")


class Run:
    """A running command, forked from this process so that it need not load scipy and matplotlib."""

    def __init__(self, arguments: Sequence[str], environment: Mapping[str, str], folder: Path) -> None:
        self.folder = folder
        self.code: int | None = None
        reading, writing = os.pipe()
        self._errors = folder.with_suffix(".errors")
        self.pid = os.fork()
        if not self.pid:
            _become_command(arguments, environment, writing, self._errors)
        os.close(writing)
        self._lines = os.fdopen(reading)

    def await_line(self, text: str) -> None:
        """Read its output until a line has the text."""
        said = []
        for line in self._lines:
            said.append(line)
            if text in line:
                return
        raise AssertionError(f"{text!r} was not said: {''.join(said)}{self._errors.read_text()}")

    def finish(self) -> str:
        """Wait for its end; return its standard error."""
        self._lines.read()
        self.end()
        errors = self._errors.read_text()
        assert "Traceback" not in errors, errors
        return errors

    def end(self, number: signal.Signals | None = None) -> None:
        """Send it a signal, and wait for its end."""
        if self.code is None:
            if number is not None:
                os.kill(self.pid, number)
            self.code = os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])
            self._lines.close()

    def facts(self) -> dict[str, str]:
        """Return the table of its report."""
        facts: dict[str, str] = json.loads((self.folder / "report.json").read_text())["facts"]
        return facts


def _become_command(arguments: Sequence[str], environment: Mapping[str, str], out: int, errors: Path) -> NoReturn:
    code = 1
    try:
        os.environ.update(environment)
        os.dup2(out, 1)
        os.dup2(os.open(errors, os.O_WRONLY | os.O_CREAT), 2)
        sys.stdout, sys.stderr = os.fdopen(1, "w", closefd=False), os.fdopen(2, "w", closefd=False)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        code = main(arguments)
    finally:
        os._exit(code)


@pytest.fixture(scope="module")
def started(leftovers: Leftovers) -> Iterator[HeaterCell]:
    pytest.importorskip("google.protobuf", reason="protobuf is not installed: pip install 'rtcp[abb]'")
    for name in ("matplotlib.pyplot", "rtcp.processes.shape_setting.report"):
        importlib.import_module(name)
    with leftovers_of(leftovers, "left", "right", "heater") as platform:
        made = HeaterCell(platform)
        yield made
        made.end()


@pytest.fixture
def cell(started: HeaterCell) -> Iterator[HeaterCell]:
    """The running cell, without trips, arms enabled."""
    started.restore()
    yield started
    if started.run is not None:
        started.run.end(signal.SIGKILL)


def begin(cell: HeaterCell, phase: str) -> Run:
    """Begin a run; return when it is in a phase."""
    if phase == "approaching":
        with cell.connect() as arms:
            arms.move_joints({name: list(AWAY) for name in arms.arms}, 1.0)
    run = cell.begin()
    run.await_line(BEGINS[phase])
    if phase == "approaching":
        with cell.connect() as arms:
            names = tuple(arms.arms)
            until(lambda: any(arms.status()[name].state is State.MOVING for name in names), "motion")
    elif phase == "heating":
        cell.until(lambda truth: truth["middle_temperature"] > 100.0, "heat")
    elif phase == "holding":
        with cell.heater() as robot:
            until(lambda: robot.processes["heater"].state == "holding", "the temperature")
    return run


def assert_arms_rest(cell: HeaterCell) -> None:
    with cell.connect() as arms:
        rest(arms, State.MOVING, State.STOPPING)


def test_a_rod_gets_its_shape_and_the_report_says_what_was_measured(cell: HeaterCell) -> None:
    cell.platform.rtcp("cell", "enable")
    hottest, run = 0.0, cell.begin()
    with ThreadPoolExecutor(1) as pool:
        errors = pool.submit(run.finish)
        while not errors.done():
            hottest = max(hottest, cell.truth()["middle_temperature"])
            time.sleep(0.05)
    assert run.code == 0, errors.result()
    assert {file.name for file in run.folder.iterdir()} == {
        "report.html", "report.json", "shape.png", "heat.png", "along.png", "set.png",
    }  # fmt: skip
    page = (run.folder / "report.html").read_text()
    assert all(f'src="{name}.png"' in page for name in ("shape", "heat", "along", "set"))
    report, facts = json.loads((run.folder / "report.json").read_text()), run.facts()
    assert facts["result"] == "the profile is complete"
    assert report["initial_resistance"] == pytest.approx(0.34, rel=0.01)
    assert max(report["samples"]["middle_temperature"]) == pytest.approx(510.0, abs=10.0)
    grid = np.array(report["along"]["celsius"])
    assert grid.shape == (len(report["along"]["s"]), len(report["along"]["times"]))
    assert grid.max() == pytest.approx(510.0, abs=10.0)
    assert grid[len(grid) // 2].max() == grid.max()
    assert grid[0].max() < 50.0
    # After the fast ramp the fin is not in the steady state that the estimate assumes.
    assert hottest == pytest.approx(510.0, abs=30.0)
    assert float(facts["hottest place of the rod"].split()[0]) == pytest.approx(hottest, abs=10.0)
    assert set(report["interlocks"].values()) == {"good"}
    truth = cell.truth()
    assert (truth["gate"], truth["relay"], truth["relay_closed"]) == (False, False, False)


@pytest.mark.parametrize(
    ("number", "phase"),
    [
        pytest.param(
            number,
            phase,
            id=f"{number.name}-{phase}",
            marks=[] if (number, phase) == (signal.SIGKILL, "heating") else [ENDED_OTHERWISE],
        )
        for number in (signal.SIGINT, signal.SIGKILL)
        for phase in BEGINS
    ],
)
def test_a_command_that_is_ended_anywhere_leaves_no_heat_and_arms_at_rest(
    cell: HeaterCell, number: signal.Signals, phase: str
) -> None:
    run = begin(cell, phase)
    os.kill(run.pid, number)
    cell.assert_cold()
    errors = run.finish()
    assert_arms_rest(cell)
    if number is signal.SIGINT:
        assert run.code == 130
        assert "interrupted: all arms come to a controlled stop" in errors
        assert run.facts()["result"] == "interrupted"
    else:
        assert run.code == -signal.SIGKILL


def halt_left(cell: HeaterCell) -> None:
    with Robot("the tests", control_socket(cell.directory / "left")) as left:
        left.halt()


def halt_all(cell: HeaterCell) -> None:
    # Not by the command line: on a busy host it starts too slowly for the heat.
    with cell.connect() as arms:
        arms.halt()


def press_emergency_stop(cell: HeaterCell) -> None:
    with RequestClient(irc5_control(cell.directory / "left"), server="virtual IRC5") as operator:
        operator.ask({"do": "stop", "circuit": "emergency"})


def kill_loop(name: str) -> Callable[[HeaterCell], None]:
    return lambda cell: kill(read_processes(cell.directory / name).loop)


def kill_gateway(cell: HeaterCell) -> None:
    kill(read_processes(cell.directory / "heater").gateway)


CAUSES: dict[str, tuple[Callable[[HeaterCell], None], str]] = {
    "cell halt": (halt_all, "stop"),
    "emergency stop of an arm": (press_emergency_stop, "arms engaged"),
    "an arm's loop is killed": (kill_loop("right"), "arm lost"),
    "the heater's gateway is killed": (kill_gateway, "closed the connection"),
    "the heater's loop is killed": (kill_loop("heater"), "loop"),
}


@OTHER_CAUSE
@pytest.mark.parametrize("cause", CAUSES)
def test_heat_ends_by_itself_and_the_message_says_why(cell: HeaterCell, cause: str) -> None:
    act, words = CAUSES[cause]
    run = begin(cell, "heating")
    act(cell)
    cell.assert_cold()
    errors = run.finish()
    assert run.code == 5, errors
    assert words in errors.lower().replace("_", " ")
    assert run.facts()["result"] in errors


@OTHER_CAUSE
def test_a_halt_of_one_arm_that_bends_the_rod_ends_all(cell: HeaterCell) -> None:
    run = begin(cell, "bending")
    with cell.connect() as arms:
        until(lambda: arms.arms["left"].state is State.MOVING, "motion")
    halt_left(cell)
    errors = run.finish()
    cell.assert_cold()
    assert_arms_rest(cell)
    assert run.code == 5, errors
    assert "stop" in errors


def test_after_all_that_the_example_sets_the_shape_of_a_rod_through_ros(ros: Ros, cell: HeaterCell) -> None:  # noqa: F811
    with cell.heater() as robot:
        robot.disable()  # `robot_enable` reaches arms and heater
        VirtualRod(robot).renew()
    node = begin_node(ros, cell.platform, "--cell")
    try:
        files = (cell.config / "cell_shape_setting.yaml", cell.job)
        said = ros.run(sys.executable, EXAMPLE, *files, "--yes").stdout
        states = re.findall(r"the heater is (\w+), the rod has (\d+) C", said)
        names = [name for name, _ in states]
        assert names[-4:] == ["heating", "holding", "cooling", "done"]
        assert names.index("measuring") < names.index("heating")
        assert max(int(celsius) for _, celsius in states) > 450
        assert "heater/start_heating: heater is done" in said
        truth = cell.truth()
        assert (truth["gate"], truth["relay"]) == (False, False)
        fields = "straight_and_unloaded=true phase=austenite"
        called = ros.run("/usr/bin/rosservice", "call", "/heater/measure_resistance", fields).stdout
        assert "success: False" in called
        assert "the heater is" in called  # the reason
        shown = ros.run("/usr/bin/rostopic", "echo", "-n", "1", "/processes").stdout
        assert 'name: "heater"' in shown
        assert 'message: "done"' in shown
        assert "success: True" in ros.run("/usr/bin/rosservice", "call", "/robot_disable").stdout
        with cell.heater() as robot:
            assert robot.state is State.READY
    finally:
        ros.stop(node)


def put_in_order_once_it_stands(panel: RequestClient, first: dict[str, str]) -> None:
    """Perform the operator's steps at the controller, which refuses them until the robot rests."""

    def is_done() -> bool:
        try:
            panel.ask(first)
            put_in_order(panel)
            return True
        except RequestRefused:
            panel.ask({"do": "enabling", "position": "released"})
            return False

    until(is_done, f"{first} at the controller", interval_s=0.2)


def test_by_hand_in_auto_with_each_arm_in_its_hand_mode_a_released_enabling_device_ends_the_heat(
    cell: HeaterCell,
) -> None:
    names = ("left", "right")
    with contextlib.ExitStack() as open_sockets:
        panels = {
            name: open_sockets.enter_context(RequestClient(irc5_control(cell.directory / name), server="virtual IRC5"))
            for name in names
        }
        try:
            for panel in panels.values():
                panel.ask({"do": "mode", "mode": "hand"})
                put_in_order_once_it_stands(panel, {"do": "enabling", "position": "middle"})
            with cell.connect() as arms, cell.heater() as robot:
                rest(arms, State.STOPPING, State.DISABLING)
                arms.reset()
                for name in names:
                    if arms.arms[name].state is State.READY:
                        arms.arms[name].enable()
                if robot.state is State.READY:
                    robot.enable()
                heater = robot.processes["heater"]
                profile = read_job(cell.job)[1]
                heater.command("arm_heater")
                cell.until(lambda truth: truth["relay_closed"], "relay closed")
                time.sleep(0.1)
                heater.command("set_heat_profile", **asdict(heat_command(profile)))
                heater.command("measure_resistance", straight_and_unloaded=True, phase="austenite")
                with ThreadPoolExecutor(1) as pool:
                    heating = pool.submit(heater.command, "start_heating")
                    before = cell.truth()["middle_temperature"]
                    cell.until(lambda truth: truth["middle_temperature"] > before + 20.0, "heat")
                    panels["left"].ask({"do": "enabling", "position": "released"})
                    cell.assert_cold()
                    with pytest.raises(RtcpError) as ended:
                        heating.result()
                assert ended.value.fields["row"] in ("arms_permitted", "arms_engaged")
        finally:
            for panel in panels.values():
                panel.ask({"do": "enabling", "position": "released"})
                put_in_order_once_it_stands(panel, {"do": "mode", "mode": "auto"})
