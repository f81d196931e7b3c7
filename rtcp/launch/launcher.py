"""Start and stop the platform of the runtime directory: segment, loop, gateway, in this order, and back.

Their modules, most of the time of a start, are loaded side by side.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast, get_args

from rtcp.config.buses import ControllerBus, is_address
from rtcp.config.cell import CellConfig, Member
from rtcp.config.find import find_config
from rtcp.config.loader import load, segment_path, widen, with_control_mode, with_period
from rtcp.config.model import VIRTUAL, ArmConfig, ControlModeName, DriveModeName, EthercatBus
from rtcp.config.segment import load_segment
from rtcp.config.zero import read_zeros, state_directory
from rtcp.fieldbus.errors import BusError
from rtcp.fieldbus.master import master_of
from rtcp.gateway.black_box import BlackBox
from rtcp.ipc.client import LONGEST_SOCKET_PATH
from rtcp.ipc.errors import RtcpError
from rtcp.ipc.observer import BlackboardError, Observer
from rtcp.ipc.recording import faults_directory
from rtcp.ipc.runtime_directory import (
    LockHeld,
    RuntimeDirectoryError,
    blackboard_file,
    control_socket,
    exclusive,
    make_runtime_directory,
    platform_name,
    runtime_directory,
    stop_marker,
)
from rtcp.ipc.session import (
    Processes,
    Session,
    SessionError,
    is_running,
    read_processes,
    read_session,
    remove_exit_report,
    session_file,
)
from rtcp.launch.platform import Platform, Report, clear, defer_signals, end_platform

CheckSegment = Callable[[Path], object]
"""Raises ConfigError where no segment can be made of the file; `rtcp.virtual` knows which device models exist."""

START_TIMEOUT_S = 1.0
"""Longest wait for the lock in a start, s: restarting a gateway holds it for a moment."""
SEGMENT_TIMEOUT_S = 30.0
"""Longest wait for the virtual controller that the platform of another arm starts, s."""
_POLL_S = 0.05
STOP_TIMEOUT_S = 30.0
"""Longest wait for the lock in a stop, s: another stop holds it for 20 s at most, or a start."""


@dataclass(frozen=True)
class StartOptions:
    """Options of `rtcp start`; None: as configured."""

    config: Path | None = None
    bus: str | None = None
    controller: str | None = None
    """IPv4 address of the robot controller."""
    mode: str | None = None
    """A drive mode or a control mode."""
    cycle_us: float | None = None
    poll: bool = False
    """The virtual segment polls for frames instead of sleeping."""
    cell: CellConfig | None = None
    """The cell to which the arm belongs; the name of the platform says which of its arms it is."""


def start(options: StartOptions, report: Report, check_segment: CheckSegment = load_segment) -> Platform:
    """Start the platform; return when all slaves are in OP and the control socket listens.

    Args:
        options: what to start.
        report: receives each step in a sentence.
        check_segment: called with the virtual segment's file before any process is started.

    Raises:
        RtcpError: it cannot be started (invalid, refused, fault); nothing is left running.
        ConfigError: the configuration has mistakes.
    """
    began_ns = time.monotonic_ns()
    directory = runtime_directory()
    length = len(os.fsencode(control_socket(directory)))
    if length > LONGEST_SOCKET_PATH:
        raise RtcpError(
            "invalid",
            f"the control socket's path {control_socket(directory)} has {length} bytes, at most {LONGEST_SOCKET_PATH} "
            "are allowed: set RTCP_RUNTIME_DIR to a shorter one",
        )
    try:
        if platform_name():
            make_runtime_directory(directory.parent)
        make_runtime_directory(directory)
    except RuntimeDirectoryError as error:
        raise RtcpError("invalid", str(error)) from None
    with _locked(directory, START_TIMEOUT_S):
        _record_unseen_end(directory, report)
        stop_marker(directory).unlink(missing_ok=True)
        pids = read_processes(directory)
        if not is_running(pids.loop):
            clear(directory, pids)
            config = _configure(options)
            _check_bus(config, check_segment)
            return _start_all(directory, config, options, began_ns, report)
        if is_running(pids.gateway):
            raise RtcpError(
                "refused", f"the platform is running already (loop process {pids.loop}): `rtcp status`, `rtcp stop`"
            )
        lone = f"the loop (process {pids.loop}) is running without a gateway"
        if options != StartOptions():
            raise RtcpError(
                "refused",
                f"{lone}: `rtcp start` without options starts one; for other options `rtcp stop` first",
            )
        report(f"{lone}: starting one")
        platform, ready = _begin_gateway(directory, pids)
    # Without the lock: a stop must not wait for a gateway.
    platform.await_gateway(ready)
    return platform


def replace_gateway(directory: Path) -> int:
    """Start a new gateway for a loop that has lost its own; return its process id, 0 where nothing was to be done.

    Raises:
        RtcpError: a start or stop is under way (refused), or the gateway does not become ready (fault).
    """
    with _locked(directory):
        pids = read_processes(directory)
        if not is_running(pids.loop) or is_running(pids.gateway) or stop_marker(directory).exists():
            return 0
        platform, ready = _begin_gateway(directory, pids)
    try:
        platform.await_gateway(ready)
    except RtcpError:
        if is_running(pids.loop) and not stop_marker(directory).exists():
            raise
        return 0  # the platform was stopped meanwhile, and the gateway with it
    return platform.processes.gateway


def stop(report: Report) -> tuple[str, ...]:
    """Stop the platform; `report` receives problems on the way.

    Return the steps that failed, in sentences: drives disabled, slaves in INIT.

    Raises:
        RtcpError: nothing runs (not running), or another start or stop takes longer than `STOP_TIMEOUT_S` (refused).
    """
    directory = runtime_directory()
    pids = read_processes(directory)
    if not any(is_running(pid) for pid in (pids.loop, pids.gateway, pids.segment)):
        raise RtcpError("not running", f"no platform is running (runtime directory {directory})")

    def on_wait() -> None:
        report(f"another process starts or stops the platform: waiting for it, at most {STOP_TIMEOUT_S:g} s")

    with _locked(directory, STOP_TIMEOUT_S, on_wait):
        _record_unseen_end(directory, report)
        now = read_processes(directory)  # a gateway may have been replaced meanwhile
        # Another stop may have ended everything: report how the loop ended all the same.
        return end_platform(directory, now if now.loop else pids, report)


@contextlib.contextmanager
def _locked(directory: Path, timeout_s: float = 0.0, on_wait: Callable[[], None] | None = None) -> Iterator[None]:
    """Hold the directory's lock: two starts at once would each find nothing running."""
    try:
        with exclusive(directory, timeout_s, on_wait):
            yield
    except LockHeld:
        waited = f", for {timeout_s:g} s and more" if timeout_s else ""
        message = f"another process starts or stops the platform of {directory}{waited}: this one has done nothing"
        raise RtcpError("refused", message) from None


def _record_unseen_end(directory: Path, report: Report) -> None:
    """Have the black box record a loop that died while there was no gateway, before its files are removed."""
    pids = read_processes(directory)
    if not pids.loop or any(is_running(pid) for pid in (pids.loop, pids.gateway)) or stop_marker(directory).exists():
        return
    try:
        with contextlib.closing(Observer(blackboard_file(directory))) as observer:
            if observer.loop_pid == pids.loop:
                session = read_session(directory)
                box = BlackBox(observer, session, faults_directory(session.state), report)
                box.loop_had_ended()
                box.finish()
    except BlackboardError:
        return  # nothing is left of it
    except Exception as error:
        # The files are removed all the same, whatever is wrong with them.
        why = str(error) if isinstance(error, SessionError) else f"{type(error).__name__}: {error}"
        report(f"the end of the loop (process {pids.loop}) was not recorded: {why}")


def _begin_gateway(directory: Path, pids: Processes) -> tuple[Platform, int]:
    """Start a gateway for a running loop; return also the pipe on which it reports that it is ready."""
    try:
        session = read_session(directory)
    except SessionError as error:
        raise RtcpError("fault", f"{error}: `rtcp stop`, then start anew") from error
    platform = Platform(directory, session.config, pids, session.state)
    return platform, platform.begin_gateway()


def _configure(options: StartOptions) -> ArmConfig:
    cell = options.cell
    config = load(find_config(options.config)) if cell is None else cell.member(platform_name()).config
    if (mode := options.mode) is not None:
        control_modes: dict[str, ControlModeName] = {name: name for name in get_args(ControlModeName)}
        drive_modes: dict[str, DriveModeName] = {name: name for name in get_args(DriveModeName)}
        if mode in control_modes:
            config = with_control_mode(config, control_modes[mode])
        elif mode in drive_modes:
            config = dataclasses.replace(config, drive_mode=drive_modes[mode])
        else:
            raise RtcpError("invalid", f"mode {mode!r} is unknown: {', '.join([*control_modes, *drive_modes])}")
    if options.bus is not None:
        config = dataclasses.replace(config, bus=dataclasses.replace(config.bus, interface=options.bus))
    if (address := options.controller) is not None:
        if not isinstance(config.bus, ControllerBus):
            raise RtcpError(
                "invalid",
                f"--controller {address}: bus.kind is {config.bus.kind}, without a robot controller: use --bus",
            )
        if not is_address(address):
            raise RtcpError("invalid", f"--controller {address}: allowed is an IPv4 address")
        config = dataclasses.replace(config, bus=config.bus.at_controller(address))
    if options.cycle_us is not None:
        config = with_period(config, options.cycle_us)
    return widen(dataclasses.replace(config, zero_offsets=read_zeros(config)))


def _check_bus(config: ArmConfig, check_segment: CheckSegment) -> None:
    if config.bus.interface == VIRTUAL and isinstance(config.bus, EthercatBus):
        check_segment(segment_path(config))
        return
    master = master_of(config.bus)
    if config.bus.interface == VIRTUAL:
        return
    try:
        master.check_interface(config.bus.interface)
    except BusError as error:
        raise RtcpError("invalid", str(error)) from None


def _segment_words(facts: dict[str, Any]) -> str:
    if "slaves" in facts:
        return f"segment of {facts['slaves']} virtual slaves (process {facts['pid']})"
    return f"virtual controller of {', '.join(facts['units'])} (process {facts['pid']})"


def _check_controller(config: ArmConfig, facts: dict[str, Any], arms: int) -> None:
    """Compare a virtual controller's ready line with the bus; raises RtcpError: no arm would ever hear from it."""
    if not isinstance(config.bus, ControllerBus):
        return
    path, streams, wanted = segment_path(config), "motion_port" in facts, config.bus.HAS_ONE_CONNECTION
    if streams != wanted:
        has, need = (f"{'has' if each else 'has no'} `rapid`" for each in (streams, wanted))
        raise RtcpError("invalid", f"{path} {has}: bus.kind {config.bus.kind} needs a file that {need} (`segment`)")
    if (count := len(facts["units"])) < arms:
        raise RtcpError("invalid", f"{path} has {count} units, the controller has {arms} arms (`segment`)")


def _placed(cell: CellConfig) -> CellConfig:
    """Return the cell with the runtime directories of its arms."""
    arms, processes = (
        tuple(dataclasses.replace(member, directory=runtime_directory(member.name).absolute()) for member in group)
        for group in (cell.arms, cell.processes)
    )
    return dataclasses.replace(cell, arms=arms, processes=processes)


def _segment_of(holder: Member) -> tuple[str, int, Path | None]:
    """Wait for the virtual controller that another platform of the cell starts; return what its session says of it.

    Raises:
        RtcpError: it does not start (fault).
    """
    until = time.monotonic() + SEGMENT_TIMEOUT_S
    while time.monotonic() < until:
        running = read_processes(holder.directory).segment
        if is_running(running):
            with contextlib.suppress(SessionError):
                session = read_session(holder.directory)
                if session.segment_pid == running:
                    return session.interface, session.segment_pid, session.segment_control
        time.sleep(_POLL_S)
    raise RtcpError(
        "fault", f"{holder.name}, which starts the virtual controller of both, does not run: start it first"
    )


def _start_all(directory: Path, config: ArmConfig, options: StartOptions, began_ns: int, report: Report) -> Platform:
    interface, segment = config.bus.interface, 0
    state = state_directory().absolute()
    platform = Platform(directory, config, Processes(), state)
    remove_exit_report(directory)
    session_file(directory).unlink(missing_ok=True)  # of the run before; the new loop counts as running from here on
    for log in directory.glob("*.log"):
        log.replace(log.with_name(f"{log.name}.1"))  # kept until the next start
    try:
        # Each process loads its modules while the one before it starts.
        loop = platform.load_loop()
        name, cell = platform_name(), options.cell
        placed = cell and _placed(cell)
        units = placed and placed.units_of(name)
        control: Path | None = None
        if units and units.index:
            holder = units.members[0]
            if interface == VIRTUAL and not cast(ControllerBus, config.bus).HAS_ONE_CONNECTION:
                report(f"the virtual controller is that of {holder.name}")
                interface, segment, control = _segment_of(holder)
        elif interface == VIRTUAL and config.bus.VIRTUAL_PROCESS:
            facts = platform.start_segment(segment_path(config), options.poll)
            interface, segment = str(facts["interface"]), int(facts["pid"])
            control = platform.segment_control
            report(_segment_words(facts))
            _check_controller(config, facts, len(units.members) if units else 1)
        bus = config.bus.interface
        Session(config, bus, interface, segment, began_ns, state, control, placed, name).write(directory)
        ready = platform.load_gateway()
        platform.start_loop(loop, report)
        platform.await_gateway(ready)
    except BaseException:
        with defer_signals():
            platform.stop()
        raise
    return platform
