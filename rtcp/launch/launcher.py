"""Starting and stopping the platform: segment, loop, gateway, in this order, and back."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

from rtcp.config.find import find_config
from rtcp.config.loader import load, segment_path, widen, with_control_mode, with_period
from rtcp.config.model import VIRTUAL, ArmConfig, ControlModeName, DriveModeName
from rtcp.config.segment import load_segment
from rtcp.config.zero import read_zeros, state_directory
from rtcp.fieldbus.errors import BusError
from rtcp.fieldbus.interface import check_name
from rtcp.gateway.blackbox import BlackBox
from rtcp.gateway.blackbox_file import faults_directory
from rtcp.ipc.client import LONGEST_SOCKET_PATH
from rtcp.ipc.errors import RtcpError
from rtcp.ipc.observer import BlackboardError, Observer
from rtcp.ipc.runtime_directory import (
    LockHeld,
    RuntimeDirectoryError,
    blackboard_file,
    control_socket,
    exclusive,
    make_runtime_directory,
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
)
from rtcp.launch.platform import Platform, Report, StartError, clear, end_platform, undisturbed

CheckSegment = Callable[[Path], object]
"""Raises ConfigError where no segment can be made of the file. Which models there are is known to `rtcp.virtual`."""


@dataclass(frozen=True)
class StartOptions:
    """What `rtcp start` was told; None: as configured."""

    config: Path | None = None
    bus: str | None = None
    mode: str | None = None
    cycle_us: float | None = None
    poll: bool = False


START_WAITS_S = 1.0
"""For whoever gives a loop its gateway back: that takes a moment."""
STOP_WAITS_S = 30.0
"""For another stop, which takes 20 s at most, or a start; nobody else has the lock for long."""


@contextlib.contextmanager
def _locked(directory: Path, patience_s: float = 0.0, waits: Callable[[], None] | None = None) -> Iterator[None]:
    """Hold the directory's lock: two starts at once would each find nothing running."""
    try:
        with exclusive(directory, patience_s, waits):
            yield
    except LockHeld:
        waited = f", for {patience_s:g} s and more" if patience_s else ""
        sentence = f"another process starts or stops the platform of {directory}{waited}: this one has done nothing"
        raise StartError(sentence, "refused") from None


def start(options: StartOptions, report: Report, check_segment: CheckSegment = load_segment) -> Platform:
    """Start the platform; return when all slaves are in OP and the control socket listens.

    Args:
        options: what was asked for.
        report: is told each step in a sentence.
        check_segment: is given the virtual segment's file before anything is started.

    Raises:
        StartError: where it cannot be started; nothing is left running.
        ConfigError: where the configuration has mistakes.
    """
    began_ns = time.monotonic_ns()
    directory = runtime_directory()
    length = len(os.fsencode(control_socket(directory)))
    if length > LONGEST_SOCKET_PATH:
        raise StartError(
            f"the control socket's path {control_socket(directory)} has {length} bytes, at most {LONGEST_SOCKET_PATH} "
            "are allowed: set RTCP_RUNTIME_DIR to a shorter one",
            "usage",
        )
    try:
        make_runtime_directory(directory)
    except RuntimeDirectoryError as error:
        raise StartError(str(error), "usage") from None
    with _locked(directory, START_WAITS_S):
        _record_unseen_end(directory, report)
        stop_marker(directory).unlink(missing_ok=True)
        adopted = _adopt(directory, options, report)
        if adopted is None:
            config = _configured(options)
            _check_bus(config, check_segment)
            return _start_all(directory, config, options, began_ns, report)
    # Without the lock: a stop must not wait for a gateway.
    running, reading = adopted
    running.await_gateway(reading)
    return running


def _adopt(directory: Path, options: StartOptions, report: Report) -> tuple[Platform, int] | None:
    """Deal with what an earlier start left: refuse, give a lone loop its gateway back, or clear remnants away."""
    found = read_processes(directory)
    if is_running(found.loop):
        if is_running(found.gateway):
            raise StartError(
                f"the platform is running already (loop process {found.loop}): `rtcp status`, `rtcp stop`", "refused"
            )
        if options != StartOptions():
            raise StartError(
                f"the loop (process {found.loop}) is running without a gateway: `rtcp start` without options starts "
                "one; for other options `rtcp stop` first",
                "refused",
            )
        report(f"the loop (process {found.loop}) is running without a gateway: starting one")
        return _with_gateway(directory, found)
    clear(directory, found)
    return None


def _record_unseen_end(directory: Path, report: Report) -> None:
    """Have the black box record a loop that died while there was no gateway, before what it left is cleared away."""
    found = read_processes(directory)
    if not found.loop or any(is_running(pid) for pid in (found.loop, found.gateway)) or stop_marker(directory).exists():
        return
    try:
        with contextlib.closing(Observer(blackboard_file(directory))) as observer:
            if observer.loop_pid == found.loop:
                session = read_session(directory)
                box = BlackBox(observer, session, faults_directory(session.state), report)
                box.loop_had_ended()
                box.finish()
    except BlackboardError:
        return  # nothing is left of it
    except Exception as error:
        # What is left of a platform is cleared away all the same, whatever is wrong with it.
        why = str(error) if isinstance(error, SessionError) else f"{type(error).__name__}: {error}"
        report(f"the end of the loop (process {found.loop}) was not recorded: {why}")


def _with_gateway(directory: Path, found: Processes) -> tuple[Platform, int]:
    """Begin a loop's new gateway; return the pipe on which it says that it is ready too."""
    try:
        session = read_session(directory)
    except SessionError as error:
        raise StartError(f"{error}: `rtcp stop`, then start anew", "fault") from error
    running = Platform(directory, session.config, found, session.state)
    return running, running.begin_gateway()


def replace_gateway(directory: Path) -> int:
    """Give a living loop that has lost its gateway a new one; return its process, 0 where there was nothing to do.

    Raises:
        StartError: while a start or stop is under way (`refused`), or where it does not become ready.
    """
    with _locked(directory):
        found = read_processes(directory)
        if not is_running(found.loop) or is_running(found.gateway) or stop_marker(directory).exists():
            return 0
        running, reading = _with_gateway(directory, found)
    try:
        running.await_gateway(reading)
    except StartError:
        if is_running(found.loop) and not stop_marker(directory).exists():
            raise
        return 0  # the platform was stopped meanwhile, and the gateway with it
    return running.processes.gateway


def _configured(options: StartOptions) -> ArmConfig:
    config = load(find_config(options.config))
    if options.mode is not None:
        config = _with_mode(config, options.mode)
    if options.bus is not None:
        config = dataclasses.replace(config, bus=dataclasses.replace(config.bus, interface=options.bus))
    if options.cycle_us is not None:
        config = with_period(config, options.cycle_us)
    return widen(dataclasses.replace(config, zero_offsets=read_zeros(config)))


def _with_mode(config: ArmConfig, mode: str) -> ArmConfig:
    drive_modes: dict[str, DriveModeName] = {name: name for name in get_args(DriveModeName)}
    motions: dict[str, ControlModeName] = {name: name for name in get_args(ControlModeName)}
    if mode in motions:
        return with_control_mode(config, motions[mode])
    if mode not in drive_modes:
        raise StartError(f"mode {mode!r} is unknown: {', '.join([*motions, *drive_modes])}", "usage")
    return dataclasses.replace(config, drive_mode=drive_modes[mode])


def _check_bus(config: ArmConfig, check_segment: CheckSegment) -> None:
    if config.bus.interface == VIRTUAL:
        check_segment(segment_path(config))
        return
    try:
        check_name(config.bus.interface)
    except BusError as error:
        raise StartError(str(error), "usage") from None


def _start_all(
    directory: Path, config: ArmConfig, options: StartOptions, began_ns: int, report: Report
) -> Platform:  # fmt: skip
    bus = config.bus.interface
    state = state_directory().absolute()
    running = Platform(directory, config, Processes(), state)
    remove_exit_report(directory)
    for log in directory.glob("*.log"):
        # Of an earlier start, kept until the next; a gateway that is replaced goes on with its own.
        log.replace(log.with_name(f"{log.name}.1"))
    try:
        interface, segment = bus, 0
        if bus == VIRTUAL:
            facts = running.start_segment(segment_path(config), options.poll)
            interface, segment = str(facts["interface"]), int(facts["pid"])
            report(f"segment of {facts['slaves']} virtual slaves (process {segment})")
        session = Session(config, bus, interface, segment, began_ns, state, running.segment_control)
        session.write(directory)
        running.start_loop(report)
        running.start_gateway()
    except BaseException:
        with undisturbed():
            running.stop()
        raise
    return running


def stop(report: Report) -> tuple[str, ...]:
    """Stop the platform of this runtime directory; `report` is told what is worth it.

    Return in sentences what is not left as it should be: drives disabled, slaves in INIT.

    Raises:
        RtcpError: `not running` where nothing runs.
        StartError: while another start or stop is under way, for longer than is waited for.
    """
    directory = runtime_directory()
    found = read_processes(directory)
    if not any(is_running(pid) for pid in (found.loop, found.gateway, found.segment)):
        raise RtcpError("not running", f"no platform is running (runtime directory {directory})")

    def waits() -> None:
        report(f"another process starts or stops the platform: waiting for it, at most {STOP_WAITS_S:g} s")

    with _locked(directory, STOP_WAITS_S, waits):
        _record_unseen_end(directory, report)
        now = read_processes(directory)  # a gateway may have been replaced meanwhile
        # Another stop may have ended it all: how the loop ended then is to be told all the same.
        return end_platform(directory, now if now.loop else found, report)
