"""Shape setting as one run: grip, measure, bend, heat, hold, cool, release. Heat is off before the run moves an arm."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import signal
import struct
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final, TextIO

import numpy as np
import numpy.typing as npt

from kinematics import Pose, forward
from rtcp.api import Robot, RtcpError, State
from rtcp.api.cell import Cell, begin_thread, rod_file
from rtcp.api.robot import Process
from rtcp.config.cell import Member
from rtcp.config.model import VIRTUAL
from rtcp.ipc.client import ControlClient
from rtcp.ipc.runtime_directory import control_socket
from rtcp.processes.rod import BendingPlan, Equilibrium, Release, plan_motion, release, set_fraction, shoot
from rtcp.processes.rod.bending import HALF_TURN, plan_approach
from rtcp.processes.shape_setting.config import ShapeSettingConfig
from rtcp.processes.shape_setting.heat_profile import HeatProfile, heat_command, target_ratio
from rtcp.processes.shape_setting.interlocks import TABLE, Mode
from rtcp.processes.shape_setting.job import Job, pose_of
from rtcp.processes.shape_setting.messages import HeatingStarted
from rtcp.processes.shape_setting.profile import temperatures_along

Array = npt.NDArray[np.float64]
SAMPLE_S: Final = 0.2
"""Interval at which the heater's fields are kept for the report, s."""
_RELAY_S: Final = 2.0
"""Time for the relay to close or open, s."""
_HEAT_FIRST_S, _STOP_S = 0.5, 4.0
"""At an early end: how long the stop of the arms waits for that of the heat, and the longest time for all of it, s."""
_TOUCH_C: Final = 60.0
"""Temperature above which the rod must not be touched, C."""
_RESISTANCE_SHARE: Final = 0.2
"""Largest relative deviation of the initial resistance from that by alloy and dimensions; another phase: 7 to 20 %."""
_GHOSTS, _GHOST_STRIDE = 4, 4
"""Number of curves of the rod that panels draw, and the step between their nodes."""
_FIELDS: Final = (
    "ratio", "target_ratio", "setpoint_middle", "mean_temperature", "middle_temperature", "average_current",
    "target_current", "energy",
)  # fmt: skip
_ENDING: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGTSTP)
_VIRTUAL_BOX: Final = (0x00000A55, 0x00000010)
_BEND, _ACT, _FRACTION, _CELLS_AT, _HIGHEST = 0x2010, 0x2013, 0x2021, 0x2025, 0x2026
"""Objects of the virtual control box: curvature (one object per axis), action; of each cell of the rod: set fraction of
the bend, position, m, highest temperature, C."""
_IMPOSE, _SPRING_BACK, _RENEW = 1, 2, 3
"""Actions."""
_CELLS: Final = 48


@dataclass
class Outcome:
    """Results of a run; the shapes are curves of points, (n, 3), m, in the frame of the rod's start.

    times, samples: of the heater's fields by name. wanted, held, released: curves; released is an estimate from the
    temperatures along the rod. straight: lengths at the two ends that are not set, m. error: of the released rod
    against the wanted one, largest and root mean square, m.
    """

    times: list[float] = field(default_factory=list)
    samples: dict[str, list[float]] = field(default_factory=lambda: {name: [] for name in _FIELDS})
    wanted: Array | None = None
    held: Array | None = None
    released: Array | None = None
    s: Array | None = None
    fraction: Array | None = None
    highest: Array | None = None
    straight: tuple[float, float] = (0.0, 0.0)
    error: tuple[float, float] = (0.0, 0.0)
    strain: float = 0.0
    initial_resistance: float = 0.0
    energy: float = 0.0
    interlocks: dict[str, str] = field(default_factory=dict)
    steps: list[tuple[float, str]] = field(default_factory=list)
    """Time since the beginning, s, and name of each step."""


class ShapeSettingRun:
    """One run on a cell that is running.

    Args:
        cell: two arms and the heater.
        job: the shape.
        profile: of the heat.
        say: called with the name of each step at its start.
        confirm: called with what people have to do at the rod; returns when they have done it.

    Raises:
        Refused: the cell has no heater, another run uses it, another client uses the heater, the rod may be hot, or the
            bend cannot be planned; nothing has moved.
    """

    def __init__(
        self, cell: Cell, job: Job, profile: HeatProfile, say: Callable[[str], None], confirm: Callable[[str], None]
    ) -> None:
        self._cell, self._job, self._profile = cell, job, profile
        self._say, self._confirm = say, confirm
        self._member, self._name = _heater_of(cell)
        self._robot = cell.processes[self._member.name]
        self._heater = self._robot.processes[self._name]
        config = next(process for process in self._member.config.processes if process.name == self._name)
        assert isinstance(config, ShapeSettingConfig)
        self._config = config
        self.outcome = Outcome()
        self.heat_is_off = False
        """Whether a run that ended early has measured that relay, gate and current are off."""
        self._lock = _lock(self._member.directory.parent / "shape-set.lock")
        self._check_heater()
        # Before anything moves: a profile that the loop refuses ends the run here.
        self._set_profile()
        self._began = time.monotonic()
        self.plan: BendingPlan = plan_motion(cell.config, job.holders, job.steps(), pose_of(job.held), job.near)
        """The motion that bends the rod."""
        self._check_arms()

    def run(self) -> Outcome:
        """Do the whole run; an early end turns the heat off first, then stops the arms.

        Raises:
            RtcpError: the cause of an early end.
        """
        curves_file = rod_file(self._member.directory.parent)
        try:
            self._draw(curves_file)
            self._steps()
        except BaseException:
            self._stop()
            raise
        finally:
            with contextlib.suppress(OSError):
                curves_file.unlink(missing_ok=True)
            self._lock.close()
        return self.outcome

    @property
    def middle_c(self) -> float | None:
        """Newest temperature in the middle of the rod, C; None: none was measured."""
        return next((value for value in reversed(self.outcome.samples["middle_temperature"]) if value), None)

    def _check_heater(self) -> None:
        """Raise where the heater has tripped, is not measured as off, is in use, or the rod may be hot."""
        fields = self._heater.fields
        if fields["latched"]:
            raise RtcpError(
                "refused",
                f"the heater has tripped: clear the cause, then `rtcp --name {self._member.name} process {self._name} "
                "reset_trips`",
                "heater_tripped",
            )
        if not self._is_off(fields):
            raise RtcpError(
                "refused",
                "relay, gate and current of the heater are not measured as off, or its inputs do not change: see "
                f"`rtcp --name {self._member.name} process {self._name}`",
                "heater_not_off",
            )
        if fields["busy"] or fields["relay"]:
            raise RtcpError(
                "refused",
                f"the heater is {self._heater.state}: another client uses it; `rtcp --name {self._member.name} process "
                f"{self._name} stop_heating` ends that",
                "heater_in_use",
            )
        if fields["rod_hot_s"]:
            raise RtcpError(
                "refused",
                f"the rod of the heating before may be hot: no arm moves for {fields['rod_hot_s']:.0f} s "
                "(rod_cooling_s)",
                "rod_hot",
                {"wait_s": fields["rod_hot_s"]},
            )

    def _check_arms(self) -> None:
        """Raise where the heater does not supervise the arms that hold the rod."""
        supervised = self._config.arms
        if missing := [name for name in self._job.holders if name not in supervised]:
            raise RtcpError(
                "refused",
                f"the arm {missing[0]} is to hold the rod, the heater supervises {', '.join(supervised) or 'none'}: "
                f"name it in `arms` of the process {self._name}, {self._member.config.source}",
                "arm_not_supervised",
            )

    def _draw(self, path: Path) -> None:
        """Write curves of the rod along its bend, points in the world, m, which the panels of the arms draw."""
        curves = self.plan.curves
        chosen = np.linspace(0, len(curves) - 1, min(_GHOSTS, len(curves))).round().astype(int)
        draft = path.with_suffix(".new")
        # The panels are not needed: the run continues if the file cannot be written.
        with contextlib.suppress(OSError):
            points = curves[chosen][:, ::_GHOST_STRIDE].round(4).tolist()
            draft.write_text(json.dumps({"pid": os.getpid(), "curves": points}))
            draft.replace(path)

    def _begin(self, step: str) -> None:
        self.outcome.steps.append((time.monotonic() - self._began, step))
        self._say(step)

    def _steps(self) -> None:
        cell, heater = self._cell, self._heater
        last = self.plan.steps[-1]
        self.outcome.wanted, self.outcome.s, self.outcome.strain = last.p, last.s, last.largest_strain
        self._confirm("the chucks hold nothing, nothing stands between the arms")
        # The confirmation may have taken hours.
        self._check_heater()
        self._begin("arms are enabled and go to where the straight rod is gripped")
        for name in self._job.holders:
            if cell.arms[name].state is State.READY:
                cell.arms[name].enable()
        now = {name: cell.arms[name].status().commanded_positions for name in self.plan.begin}
        approach = plan_approach(cell.config, self._job.holders, now, self.plan.begin, self._job.approach_speed)
        if approach is not None:
            cell.run_trajectory(approach)
        room = f"{self._profile.initial_c:g} C"
        self._confirm(f"grip the rod, straight and unloaded, at {room}, which is above its Af; the key is at Auto")
        virtual = VirtualRod(self._robot) if _is_virtual(self._member) else None
        if virtual is not None:
            virtual.renew()
        self._begin("the initial resistance is measured")
        self._arm()
        self._set_profile()
        heater.command("measure_resistance", straight_and_unloaded=True, phase="austenite")
        self.outcome.initial_resistance = float(heater.fields["initial_resistance"])
        heater.command("stop_heating")
        self._check_resistance()
        self._await_relay(closed=False)
        self._check_heater()
        self._begin("the rod is bent")
        cell.run_trajectory(self.plan.trajectory)
        held = self._held()
        self.outcome.held = held.p
        if virtual is not None:
            virtual.bend(held)
        self._begin(f"heating to {self._profile.target_c:g} C in the middle, hold {self._profile.hold_s:g} s, cooling")
        self._arm()
        since = max((event.number for event in self._robot.events()), default=0)
        self._set_profile()
        with self._sampling():
            heater.command("start_heating")
        self._check_target(since)
        self.outcome.energy = float(heater.fields["energy"])
        self._note_interlocks(heater)
        warmth = _warmth(self.middle_c)
        self._begin(f"release: {warmth}")
        self._finish(held, virtual)
        self._confirm(f"open the chucks and take the rod out, {warmth}; the arms stay where they are")

    def _check_resistance(self) -> None:
        """Compare the initial resistance with that of the rod by its alloy and dimensions."""
        rod, value = self._job.rod, self.outcome.initial_resistance
        area = 0.25 * np.pi * rod.diameter**2
        expected = float(self._profile.alloy.resistivity(self._profile.initial_c) * rod.length / area)
        if not abs(value / expected - 1.0) <= _RESISTANCE_SHARE:
            raise RtcpError(
                "refused",
                f"the initial resistance is {value:.4g} ohm, by alloy and dimensions {expected:.4g} ohm are expected, "
                f"{100 * _RESISTANCE_SHARE:g} % off at most: check rod, phase, contacts and the profile's alloy",
                "implausible_resistance",
                {"resistance": value, "expected": expected},
            )

    def _set_profile(self) -> None:
        self._heater.command("set_heat_profile", **asdict(heat_command(self._profile)))

    def _check_target(self, since: int) -> None:
        """Raise where the heating since event `since` had another profile: any client may set one at any time."""
        expected = self._profile.target_c, target_ratio(self._profile)
        heated = [
            (event.fields["target_c"], event.fields["ratio"])
            for event in self._robot.events(since)
            if event.name == HeatingStarted.name
        ]
        if not heated or not np.allclose(heated, expected, rtol=1e-6, atol=0.0):
            targets = ", ".join(f"{target:g} C at the ratio {ratio:.5g}" for target, ratio in heated) or "nothing"
            raise RtcpError(
                "fault",
                f"the heater was to heat to {expected[0]:g} C at the ratio {expected[1]:.5g}, it reports {targets}: "
                "another client has changed the profile; this rod is not set as the report says",
                "profile_changed",
            )

    def _arm(self) -> None:
        mode = self._heater.fields["mode"]
        if mode != Mode.AUTO:
            raise RtcpError(
                "refused",
                f"the key is at {Mode(mode).name.capitalize()}, where the heater does not supervise the arms: turn it "
                "to Auto",
                "key_not_at_auto",
            )
        if self._robot.state is State.READY:
            self._robot.enable()
        self._heater.command("arm_heater")
        self._await_relay(closed=True)

    def _await_relay(self, closed: bool) -> None:
        until = time.monotonic() + _RELAY_S
        while bool(self._heater.fields["relay_closed"]) is not closed:
            if time.monotonic() > until:
                verb = "close" if closed else "open"
                raise RtcpError("fault", f"the heater's relay did not {verb} within {_RELAY_S:g} s: see its feedback")
            time.sleep(0.02)

    def _socket(self) -> Path:
        return control_socket(self._member.directory)

    @contextlib.contextmanager
    def _sampling(self) -> Iterator[None]:
        """Record the heater's fields during the block, over a separate connection."""
        ended = threading.Event()
        outcome, began = self.outcome, time.monotonic()

        def sample() -> None:
            with contextlib.suppress(RtcpError), Robot("shape-set: report", self._socket()) as robot:
                process = robot.processes[self._name]
                while not ended.wait(SAMPLE_S):
                    fields = process.fields
                    outcome.times.append(time.monotonic() - began)
                    for name, values in outcome.samples.items():
                        values.append(float(fields[name] or 0.0))

        thread = begin_thread(sample)
        try:
            yield
        finally:
            ended.set()
        # Only after a whole heating: an early end has to turn the heat off first.
        thread.join(_RELAY_S)

    def _held(self) -> Equilibrium:
        """Return the rod as the arms hold it by their measured positions."""
        mouths = []
        for name, chuck in self._job.holders.items():
            member, status = self._cell.config.member(name), self._cell.arms[name].status()
            assert member.config.arm is not None
            base = Pose.from_xyzrpy(*member.base.position, *member.base.rpy)
            bare = member.config.arm
            flange = forward(bare, status.positions) @ bare.tool.inverse()
            mouths.append(base @ flange @ chuck.pose)
        end = mouths[0].inverse() @ mouths[1] @ HALF_TURN.inverse()
        return shoot(self.plan.steps[-1].rod, end, self.plan.steps[-1])

    def _finish(self, held: Equilibrium, virtual: VirtualRod | None) -> None:
        """Estimate the released shape: of a virtual rod from its own temperatures, else from the fin's."""
        outcome = self.outcome
        if virtual is not None:
            at, fraction, highest = virtual.read()
            outcome.fraction, outcome.highest = np.interp(held.s, at, fraction), np.interp(held.s, at, highest)
            virtual.release()
        elif len(outcome.times) < 2:
            # The connection for the samples was lost: nothing is known of the heat.
            return
        else:
            grid = temperatures_along(self._profile, held.s, outcome.samples["middle_temperature"])
            outcome.fraction, outcome.highest = set_fraction(outcome.times, grid), grid.max(axis=1)
        freed: Release = release(held, np.clip(outcome.fraction, 0.0, 1.0), outcome.wanted)
        outcome.released = freed.shape.p
        outcome.straight = freed.straight_start, freed.straight_end
        outcome.error = float(freed.error.max()), float(np.sqrt(np.mean(freed.error**2)))

    def _note_interlocks(self, heater: Process) -> None:
        fields = heater.fields
        for rule in TABLE:
            bit = 1 << rule.row
            state = "latched" if int(fields["latched"]) & bit else "forbids" if int(fields["forbids"]) & bit else "good"
            self.outcome.interlocks[rule.row.name.lower()] = state

    def _stop(self) -> None:
        """Stop heat first, then motion; a platform that does not answer does not delay the others."""
        with undisturbed():
            self._stop_all()

    def _stop_all(self) -> None:
        # Over separate connections: the interrupt may have left those of the cell in the middle of an answer. In daemon
        # threads: a frozen gateway answers after its timeout, or never.
        until = time.monotonic() + _STOP_S
        commanded = threading.Event()
        threads = [begin_thread(self._stop_heat, commanded)]
        commanded.wait(_HEAT_FIRST_S)
        threads += [begin_thread(_halt, member) for member in self._cell.config.members]
        for thread in threads:
            thread.join(max(0.0, until - time.monotonic()))

    def _await_off(self, heater: Process) -> bool:
        """Wait for the relay to open; return whether relay, gate and current are measured as off."""
        until = time.monotonic() + _RELAY_S
        while not (is_off := self._is_off(heater.fields)) and time.monotonic() < until:
            time.sleep(0.02)
        return is_off

    def _is_off(self, fields: Mapping[str, Any]) -> bool:
        no_current = abs(fields["current"]) <= self._config.leakage_current
        return no_current and not fields["relay_closed"] and not fields["gate_sense"] and bool(fields["inputs_alive"])

    def _stop_heat(self, commanded: threading.Event) -> None:
        try:
            with contextlib.suppress(Exception), Robot("shape-set: stop", self._socket()) as robot:
                robot.command("stop_heating")
                commanded.set()
                heater = robot.processes[self._name]
                self.heat_is_off = self._await_off(heater)
                self._note_interlocks(heater)
        finally:
            commanded.set()


def _halt(member: Member) -> None:
    path = control_socket(member.directory)
    with contextlib.suppress(Exception), ControlClient("shape-set: stop", path) as client:
        client.call("halt")


@contextlib.contextmanager
def undisturbed() -> Iterator[None]:
    """Ignore a second Ctrl-C and other signals that end a command, during the block."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, signal.SIG_IGN) for number in _ENDING}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class VirtualRod:
    """The rod in the virtual control box. The box does not see the virtual arms: SDOs tell it what they do to the rod.

    Args:
        robot: the heater's platform; it is disabled for each change, since objects are written in state ready only.
    """

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._slave = next(
            slave["position"] for slave in robot.scan() if (slave["vendor_id"], slave["product_code"]) == _VIRTUAL_BOX
        )

    def renew(self) -> None:
        """Grip another rod, cold and straight."""
        self._act(_RENEW)

    def bend(self, held: Equilibrium) -> None:
        """Impose the shape in which the arms hold it."""
        at = self._column(_CELLS_AT)
        self._disable()
        for axis in range(3):
            for number, value in enumerate(np.interp(at, held.s, held.u[:, axis]).tolist(), 1):
                self._robot.sdo_write(self._slave, _BEND + axis, number, struct.pack("<f", value))
        self._act(_IMPOSE)

    def release(self) -> None:
        """Let it spring back."""
        self._act(_SPRING_BACK)

    def read(self) -> tuple[Array, Array, Array]:
        """Return for each of its cells: position, m, set part of the bend, and highest temperature, C."""
        return self._column(_CELLS_AT), self._column(_FRACTION), self._column(_HIGHEST)

    def _column(self, index: int) -> Array:
        cells = (self._robot.sdo_read(self._slave, index, number) for number in range(1, _CELLS + 1))
        return np.array([struct.unpack("<f", cell)[0] for cell in cells], dtype=np.float64)

    def _disable(self) -> None:
        if self._robot.state is State.HOLDING:
            self._robot.disable()

    def _act(self, action: int) -> None:
        self._disable()
        self._robot.sdo_write(self._slave, _ACT, 1, bytes((action,)))


def _warmth(middle_c: float | None) -> str:
    """Return the temperature in the middle of the rod, in words."""
    if middle_c is None:
        return "the temperature of the rod is not known: do not touch it"
    return f"its middle has {middle_c:.0f} C" + (": HOT, do not touch it" if middle_c > _TOUCH_C else "")


def _lock(path: Path) -> TextIO:
    """Return a file that is locked until it is closed; raises Refused where another run has it."""
    try:
        file = path.open("a")
    except OSError as error:
        raise RtcpError("refused", f"{path} cannot be written: {error.strerror}", "no_lock") from None
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        file.close()
        message = f"another `rtcp shape-set` works with this cell (it holds {path}): wait for its end"
        raise RtcpError("refused", message, "shape_set_runs") from None
    return file


def _heater_of(cell: Cell) -> tuple[Member, str]:
    for member in cell.config.processes:
        for process in member.config.processes:
            if isinstance(process, ShapeSettingConfig):
                return member, process.name
    raise RtcpError(
        "refused",
        f"the cell {cell.config.name} has no process of kind shape_setting: `rtcp cell start --config "
        "config/cell_shape_setting.yaml` has one",
        "no_heater",
    )


def _is_virtual(member: Member) -> bool:
    return member.config.bus.interface == VIRTUAL
