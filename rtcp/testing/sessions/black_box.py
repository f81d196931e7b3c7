"""The black box of a session: its cycle records and all that was done in it, as a recording of a fault."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np

from rtcp.config.cell import CellConfig
from rtcp.config.model import ArmConfig
from rtcp.ipc.recording import About, FaultRecording, Moment, RecordingError, versions, write_new
from rtcp.ipc.states import State
from rtcp.ipc.tool_motion import ToolMotion
from rtcp.testing.sessions.run import AnySession, Segment, run_session
from rtcp.testing.sessions.session import Result
from rtcp.testing.simulation import NAME

BEFORE_S, AFTER_S = 10.0, 1.0
"""Recorded time before and after the first violation, s; without one the last seconds of the session."""


def replay(
    seed: int, config: ArmConfig | CellConfig, seconds: float, file: Path, segment: Segment | None = None
) -> tuple[Result, list[str]]:
    """Run the session of a seed alone and write its black box; return its result and what was done in it, in order.

    The black box of a cell is that of the arm with the first violation, or of the first arm.

    `rtcp faults show FILE`, `rtcp plot`, `rtcp export` and `rtcp replay` open the file.

    Raises:
        RecordingError: the file exists or cannot be written, or there was no session to record.
    """
    done: list[str] = []

    def inspect(session: AnySession, error: Exception | None) -> None:
        done.extend(map(str, session.commander.log))
        write_new(file, _recording(session, error))

    if file.exists():
        raise RecordingError("exists", file, "there is such a file; it is not overwritten")
    result = run_session(seed, config, seconds, segment, inspect)
    if not file.exists():
        raise RecordingError("empty", file, f"the session of seed {seed} did not begin: {result.violation}")
    return result, done


def _recording(session: AnySession, error: Exception | None) -> FaultRecording:
    commander = session.commander
    simulation = commander.simulation
    config, checker = simulation.config, commander.checker
    first = checker.violations[0] if checker.violations else None
    what = f"{type(error).__name__}: {error}" if error is not None else str(first or "the end of a session that passed")
    fault_ns = first.time_ns if first is not None else simulation.now_ns
    records, _ = simulation.observer.since(0)
    from_fault = (records["time_ns"] - fault_ns) * 1e-9
    records = records[(from_fault >= -BEFORE_S) & (from_fault <= AFTER_S)]
    at = int(np.argmin(np.abs(records["time_ns"] - fault_ns))) if len(records) else -1
    # The clock of a simulation begins at 1 s: the file has the time at which it was written.
    wall_ns = time.time_ns() - fault_ns
    moments = [Moment(wall_ns + entry.time_ns, entry.text) for entry in commander.log]
    moments += [Moment(wall_ns + violation.time_ns, str(violation)) for violation in checker.violations]
    about = About(
        number=0,
        time_ns=wall_ns + fault_ns,
        what=what,
        before=State(int(records["state"][max(at - 1, 0)])).words if len(records) else "unknown",
        arm=config.name,
        bus=NAME,
        period_ns=simulation.period_ns,
        joints=tuple(joint.name for joint in config.joints),
        versions=versions(),
        began_ns=0,
        event=0,
        at=at,
        notes=(),
        timeline=tuple(sorted(moments, key=lambda moment: moment.time_ns)),
    )
    tool = ToolMotion(config.models, simulation.observer.schema)
    return FaultRecording(about, tool.add(records), tool.schema)
