"""The loop's process: reads a session file, runs the cycle, and leaves the bus in INIT.

It reports on a pipe, one JSON object a line: `phase` sentences, then `ready` with the facts of the start, or `error`.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import signal
import sys
import time
import traceback
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import FrameType
from typing import Any

from kinematics.compiled import BUILD
from rtcp.config.find import plugin_error
from rtcp.config.model import ArmConfig, ConfigError
from rtcp.control.bus_service import BusService
from rtcp.control.cycle import Cycle, address_of, make_discipline, record_schema
from rtcp.control.part import Device
from rtcp.control.partners import Partners
from rtcp.devices.cia402 import blind_outputs
from rtcp.devices.drive import Drive, TargetState
from rtcp.devices.driver import DeviceError
from rtcp.fieldbus.bus import ProcessData
from rtcp.fieldbus.errors import BusError
from rtcp.fieldbus.master import Master, master_of
from rtcp.ipc.blackboard import Blackboard, BlackboardTooLarge
from rtcp.ipc.runtime_directory import blackboard_file
from rtcp.ipc.schema import SchemaError
from rtcp.ipc.session import EXIT_INCOMPLETE, Session, SessionError, launch_arguments, read_session, write_exit_report
from rtcp.ipc.stop_reactions import quick_stop_s
from rtcp.realtime import scheduling

_DISABLE_STEPS = 3
"""State changes of a drive from Operation Enabled to Switch On Disabled (CiA 402-2, figure 7)."""


class Report:
    """Reports the progress of the start to the launcher; silent once the pipe is broken."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor

    def tell(self, event: str, **facts: Any) -> None:
        """Write one line; a launcher that has exited is not an error."""
        if self._descriptor < 0:
            return
        line = json.dumps({"event": event, **facts}).encode() + b"\n"
        try:
            os.write(self._descriptor, line)
        except OSError:
            self._descriptor = -1

    def close(self) -> None:
        """Close the pipe, which ends the reports."""
        if self._descriptor >= 0:
            with contextlib.suppress(OSError):
                os.close(self._descriptor)
            self._descriptor = -1


def main() -> int:
    """Run the loop's process.

    Return 0 after an orderly end, `EXIT_INCOMPLETE` where slaves did not reach INIT at the end, 2 where the start
    failed, 1 after a defect of this program.
    """
    directory, ready_fd = launch_arguments("rtcp.control.process")
    report = Report(ready_fd)
    try:
        session = read_session(directory)
    except SessionError as error:
        report.tell("error", sentences=[str(error)])
        sys.stderr.write(f"{error}\n")
        return 2
    # Before the cycle SIGTERM ends the start and closes the bus; then it requests a controlled stop.
    signal.signal(signal.SIGTERM, _leave)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    master: Master | None = None
    left: list[str] = []
    try:
        config = session.config
        master = master_of(config.bus)(config, session.interface, session.segment_pid)
        units = None if session.cell is None else session.cell.units_of(session.name)
        if units is not None:
            master.share(units)
        _work(master, session, directory, report)
    except (BusError, DeviceError, ConfigError, SchemaError, BlackboardTooLarge) as error:
        sentences = list(error.sentences) if isinstance(error, BusError) else str(error).splitlines()
        report.tell("error", sentences=sentences)
        sys.stderr.write("\n".join(sentences) + "\n")
        return 2
    finally:
        if master is not None:
            before = len(master.notes)
            master.close()
            left += master.notes[before:]
        write_exit_report(directory, os.getpid(), left)
        sys.stderr.write("".join(f"{sentence}\n" for sentence in left))
    return EXIT_INCOMPLETE if left else 0


def _leave(number: int, frame: FrameType | None) -> None:
    raise SystemExit(128 + number)


def _work(master: Master, session: Session, directory: Path, report: Report) -> None:
    period_ns = round(session.config.cycle.period_us * 1000)
    data = master.start(directory, lambda sentence: report.tell("phase", text=sentence))
    config = master.config
    if config.slaves != session.config.slaves:
        # The gateway counts the slaves as the bus does: it starts once the loop is ready.
        replace(session, config=config).write(directory)
    discipline = make_discipline(config, None if master.supervised is None else master.supervised.system_time)
    partners = None if session.cell is None else Partners(session.cell, session.name)
    blackboard = Blackboard(blackboard_file(directory), record_schema(config, partners), period_ns)
    cpu = scheduling.choose_cpu(config.cycle.cpu)
    scheduling.share_interpreter_quickly()
    service = BusService(
        master,
        blackboard,
        [address_of(config, joint) for joint in config.axes],
        config.bus.op_timeout_s,
        cpu,
        config.cycle.priority,
        config.ethercat.watch_ms * 1e-3,
    )
    cycle = Cycle(config, data, blackboard, service, discipline, partners=partners)
    if partners is not None:
        service.look_around = partners.open
    realtime = scheduling.Realtime()

    def started() -> None:
        facts = {
            "realtime": {
                "scheduler": realtime.scheduler,
                "memory_locked": realtime.memory_locked,
                "cpu": realtime.cpu,
                "compiled": BUILD.is_used,
                "interpreted_because": BUILD.reason,
                "notes": realtime.notes,
            },
            "start_to_op_s": round((time.monotonic_ns() - session.began_ns) * 1e-9, 3),
        }
        (directory / "started.json").write_text(json.dumps(facts))
        waits = master.waiting_for()
        ready = "all slaves in OP" if master.supervised is not None else "the robot is ready"
        text = f"waiting for the robot: {waits}" if waits else ready
        report.tell("ready", pid=os.getpid(), text=text, **facts)
        report.close()

    service.on_op = started
    service.temperature = lambda position: max(
        (drive.temperature for slot, drive in cycle.joints.pairs if slot + 1 == position),
        key=lambda degrees: -math.inf if math.isnan(degrees) else degrees,
        default=math.nan,
    )
    service.clock_followed = lambda: discipline is None or discipline.locked
    service.on_refused = cycle.shut_down
    service.start()
    signal.signal(signal.SIGTERM, lambda number, frame: cycle.shut_down())
    scheduling.prepare(realtime, config.cycle.priority, config.cycle.cpu)
    try:
        cycle.run()
    except BaseException:
        # A defect in the cycle: the drives come to rest before the bus goes away.
        stop_blindly(data, config, cycle.joints.pairs, cycle.devices)
        raise
    else:
        if service.refused:
            raise BusError(*service.refused)
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        service.finish()
        scheduling.release(realtime)


def stop_blindly(
    data: ProcessData, config: ArmConfig, drives: Sequence[tuple[int, Drive]], devices: Sequence[Device] = ()
) -> None:
    """Bring all drives to rest after a defect in the cycle: quick stop until standstill is certain, then torque off.

    It uses nothing else of the cycle; an exception of one drive or one frame does not affect the others.
    """
    for device in devices:
        with contextlib.suppress(Exception):
            device.safe()
            device.encode(data)
    period_s = config.cycle.period_us * 1e-6
    ramp_cycles = math.ceil(quick_stop_s(config) / period_s)
    off_cycles = _DISABLE_STEPS * config.drive_waits.answer_cycles(period_s)
    due = time.monotonic()
    for goal, cycles in ((TargetState.QUICK_STOPPED, ramp_cycles), (TargetState.DISABLED, off_cycles)):
        for _ in range(cycles):
            for slot, drive in drives:
                with contextlib.suppress(Exception):
                    data.set_output(slot, _outputs(drive, data, slot, goal))
            with contextlib.suppress(Exception):
                data.send()
                data.receive()
            # At the cycle's period: a drive that misses frames between its SYNC0 may leave OP.
            due = max(due + period_s, time.monotonic())
            time.sleep(max(due - time.monotonic(), 0.0))


def _outputs(drive: Drive, data: ProcessData, slot: int, goal: TargetState) -> bytes:
    """Return a drive's outputs one step towards `goal`; if its driver raises, a controlword and its safe outputs."""
    try:
        drive.decode(data.input(slot))
        drive.advance(goal)
        own = drive.encode()
        if len(own) != drive.output_bytes:
            raise ValueError(f"encode returned {len(own)} bytes, allowed are {drive.output_bytes}")
    except BaseException as error:
        plugin_error(error)
        own = blind_outputs(drive, goal, drive.safe_outputs)
    return own if drive.slave is None else drive.slave.outputs(drive, own)


if __name__ == "__main__":
    try:
        code = main()
    except SystemExit as ending:
        code = ending.code if isinstance(ending.code, int) else 1
    except BaseException:
        # A defect of this program: the whole traceback goes to the log.
        traceback.print_exc()
        code = 1
    sys.stderr.flush()
    # Skips the interpreter's shutdown, which with the collector off would report ruckig's objects as leaked.
    os._exit(code)
