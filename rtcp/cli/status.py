"""`rtcp status`: what the platform does, for people and for programs, once or continuously.

The picture fits 80 columns and reads without colour; a field that the platform does not report is a dash.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rtcp.cli.connection import connect, loop_process
from rtcp.cli.errors import CommandError, ExitCode
from rtcp.cli.output import ABSENT, console, emit, emit_json, facts, show, table
from rtcp.ipc.client import ControlClient
from rtcp.ipc.errors import RtcpError

if TYPE_CHECKING:
    from rich.console import RenderableType
    from rich.panel import Panel
    from rich.table import Table
    from rich.text import Text

REFRESH_S, PIPED_REFRESH_S = 0.1, 1.0
"""Interval of `--watch` on a terminal and in JSON, and in a pipe, where each refresh is a whole table."""
STATE_STYLES = {
    "holding": "bold green",
    "moving": "bold green",
    "homing": "bold green",
    "ready": "bold cyan",
    "stopping": "bold yellow",
    "stopped by limit": "bold yellow",
    "fault": "bold red",
    "emergency stop": "bold red",
}
JOINT_COLUMNS = (("position", "rad"), ("velocity", "rad/s"), ("torque", "Nm"), ("target", "rad"))
CYCLE_TIMES = (("wake-up", "wakeup_us"), ("exchange", "exchange_us"), ("compute", "compute_us"))
QUANTILES = ("p50", "p99", "max")
_STALE_S = 0.1
"""Joint values older than this are marked."""
_MESSAGES = 5
"""Number of recent messages."""


def register(app: typer.Typer) -> None:
    """Add this group's commands."""
    app.command("status")(_status)


def _status(
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object a line, SI units.")] = False,
    watch: Annotated[bool, typer.Option("--watch", help="Refresh until Ctrl-C.")] = False,
) -> None:
    """Show state, joints, slaves, cycle times and clocks of the running platform."""
    if watch:
        try:
            _watch(as_json)
        except KeyboardInterrupt:
            raise typer.Exit(ExitCode.DONE) from None  # Ctrl-C is the normal end of a watch
    with connect("status") as client:
        status = client.call("status")
    emit_json(status) if as_json else show(picture(status))


def _watch(as_json: bool) -> None:
    if as_json:
        for status in _statuses(REFRESH_S):
            emit_json(status)
    elif not sys.stdout.isatty():
        for status in _statuses(PIPED_REFRESH_S):
            show(picture(status))
            emit("")
    else:
        from rich.live import Live

        with Live(console=console(), auto_refresh=False, vertical_overflow="crop") as live:
            for status in _statuses(REFRESH_S):
                live.update(picture(status), refresh=True)


def _statuses(interval_s: float) -> Iterator[dict[str, Any]]:
    """Yield the status at regular instants; connect again where only the gateway has ended.

    Raises:
        CommandError: the platform has ended.
        RtcpError: the loop runs and no gateway can be reached.
    """
    due = time.monotonic()
    client = connect("status")
    try:
        while True:
            try:
                status = client.call("status")
            except RtcpError as error:
                if error.kind != "lost":
                    raise
                client = _reconnect(client)
                continue
            yield status
            due = max(due + interval_s, time.monotonic())
            time.sleep(max(0.0, due - time.monotonic()))
    finally:
        client.close()


def _reconnect(client: ControlClient) -> ControlClient:
    client.close()
    try:
        return connect("status")
    except RtcpError as error:
        if loop_process():
            raise
        raise CommandError("the platform has ended", ExitCode.NOT_RUNNING) from error


def picture(status: Mapping[str, Any]) -> RenderableType:
    """Return the whole picture of a status."""
    from rich.console import Group
    from rich.text import Text

    gap = Text()
    parts = (_headline(status), _joints(status), gap, _slaves(status), gap, _times(status), gap, _facts(status))
    return Group(*parts, *_messages(status))


def _headline(status: Mapping[str, Any]) -> Panel:
    from rich import box
    from rich.panel import Panel
    from rich.text import Text

    state = str(status.get("state", ABSENT)).replace("_", " ")
    modes = ", ".join(str(status[key]) for key in ("motion", "mode") if key in status) or ABSENT
    line = Text.assemble(
        (state.upper(), STATE_STYLES.get(state.lower(), "bold")), f"   {modes} on {status.get('bus', ABSENT)}"
    )
    cycle_ns = status.get("cycle_ns")
    if isinstance(cycle_ns, int | float):
        line.append(f"   every {cycle_ns / 1000:g} us")
    line.append(f"   {_count(status.get('cycles'))} cycles, ")
    line.append(f"{_count(status.get('missed'))} missed", "yellow" if status.get("missed") else "")
    if message := str(status.get("message") or ""):
        line.append("\n" + message, "red" if state in ("fault", "emergency stop") else "")
    return Panel(line, box=box.ROUNDED, title="rtcp", title_align="left")


def _joints(status: Mapping[str, Any]) -> Table:
    joints = _mapping(status.get("joints"))
    headings = [f"{name} {unit}" for name, unit in JOINT_COLUMNS]
    rows = table(("joint", *headings), ("joint",), expand=True)
    stale_s = status.get("unheard_s")
    if isinstance(stale_s, int | float) and stale_s > _STALE_S:
        rows.caption = f"last received {stale_s:.1f} s ago: not every slave has answered since"
        rows.caption_justify = "left"
    columns = [_sequence(joints.get(name)) for name, _ in JOINT_COLUMNS]
    for name, *values in zip(_sequence(status.get("joint_names")), *columns, strict=False):
        shown = (f"{value:+.4f}" if isinstance(value, int | float) else ABSENT for value in values)
        rows.add_row(str(name), *shown)
    return rows


def _slaves(status: Mapping[str, Any]) -> Table:
    """Return the slaves in two columns, down the first and then the second, in the order of the cable."""
    from rich.text import Text

    slaves = [_mapping(slave) for slave in _sequence(status.get("slaves"))]
    with_errors = any(_error_counts(slave) for slave in slaves)
    headings = ("#", "slave", "state", *(("lost/err/links",) if with_errors else ()))
    rows = table(headings * (2 if len(slaves) > 1 else 1), ("state", "lost/err/links"), expand=True, fill="slave")
    half = (len(slaves) + 1) // 2
    for row in range(half):
        cells: list[RenderableType] = []
        for slave in slaves[row::half]:
            state = str(slave.get("state", ABSENT))
            cells += [str(slave.get("position", ABSENT)), str(slave.get("name", ABSENT))]
            cells.append(Text(state, "green" if state.upper() == "OP" else "red"))
            if with_errors:
                cells.append(Text(_error_counts(slave), "yellow"))
        rows.add_row(*cells)
    return rows


def _error_counts(slave: Mapping[str, Any]) -> str:
    """Return how often the slave left OP, damaged frames at its ports and lost links; empty where all are 0."""
    errors = _mapping(slave.get("errors"))
    counts = [slave.get("lost", 0), errors.get("rx", 0), errors.get("links", 0)]
    return "/".join(map(str, counts)) if any(counts) else ""


def _times(status: Mapping[str, Any]) -> Table:
    rows = table(("time of a cycle", *(f"{one} us" for one in QUANTILES)), ("time of a cycle",), expand=True)
    for label, key in CYCLE_TIMES:
        rows.add_row(label, *quantiles(status, key))
    return rows


def quantiles(status: Mapping[str, Any], key: str) -> list[str]:
    """Return p50, p99 and maximum of a time, us."""
    values = _mapping(status.get(key))
    found = (values.get(quantile) for quantile in QUANTILES)
    return [f"{value:.1f}" if isinstance(value, int | float) else ABSENT for value in found]


def _facts(status: Mapping[str, Any]) -> Table:
    from rich.text import Text

    rows = facts()
    rows.columns[0].style = "bold"
    if robot := _mapping(status.get("robot")):
        rows.add_row("robot", _robot(robot))
    if status.get("motion") == "joystick":
        joystick = _mapping(status.get("stick"))
        user = "arm" if joystick.get("arm_has_it") else "wheelchair"
        rows.add_row("joystick", f"{joystick.get('mode', ABSENT)}, controls the {user}")
    wkc = _mapping(status.get("wkc"))
    expected, actual = wkc.get("expected", ABSENT), wkc.get("actual", ABSENT)
    answered = not isinstance(actual, int) or actual > 0  # -1: the frame did not come back
    if answered:
        counted = Text(f"working counter {actual} of {expected}", "" if actual == expected else "bold red")
    else:
        counted = Text(f"no answer, {expected} expected", "bold red")
    rows.add_row("frames", counted)
    rows.add_row("clocks", _clocks(_mapping(status.get("dc")), answered))
    rows.add_row("inputs", _bits(status.get("inputs")))
    rows.add_row("outputs", _bits(status.get("outputs")))
    rows.add_row("real time", realtime_line(_mapping(status.get("realtime"))))
    if holder := _mapping(status.get("lease")).get("holder"):
        rows.add_row("lease", Text(str(holder)))
    pids = _mapping(status.get("pids"))
    rows.add_row("processes", ", ".join(f"{name} {pid}" for name, pid in pids.items() if pid) or ABSENT)
    return rows


def _robot(robot: Mapping[str, Any]) -> Text:
    """Return ROS-Industrial's RobotStatus in words."""
    from rich.text import Text

    line = Text(f"{robot.get('mode', ABSENT)}, drives {'powered' if robot.get('drives_powered') else 'without power'}")
    line.append(", motion possible" if robot.get("motion_possible") else ", no motion possible")
    line.append(", in motion" if robot.get("in_motion") else ", not in motion")
    if robot.get("e_stopped"):
        line.append(", emergency stop", "bold red")
    if robot.get("in_error"):
        line.append(f", error {robot.get('error_code', ABSENT)}", "bold red")
    return line


def _clocks(clocks: Mapping[str, Any], answered: bool) -> Text:
    from rich.text import Text

    if not clocks:
        return Text(ABSENT)
    if not answered:
        return Text("not tracked: no answer", "yellow")
    line = Text("locked" if clocks.get("locked") else "not locked", "" if clocks.get("locked") else "yellow")
    for key, label in (("offset_ns", "offset"), ("filtered_ns", "filtered")):
        value = clocks.get(key)
        if isinstance(value, int | float):
            line.append(f", {label} {value / 1000:+.1f} us")
    return line


def realtime_line(realtime: Mapping[str, Any]) -> str:
    """Return scheduling and memory of the loop in one line, and what the system refused in the lines below."""
    if not realtime:
        return ABSENT
    cpu = realtime.get("cpu")
    memory = "memory locked" if realtime.get("memory_locked") else "memory not locked"
    line = f"{realtime.get('scheduler', ABSENT)}, {memory}, {'no CPU of its own' if cpu is None else f'CPU {cpu}'}"
    return "\n".join([line, *map(str, _sequence(realtime.get("notes")))])


def _messages(status: Mapping[str, Any]) -> list[RenderableType]:
    """Return the latest messages with their local time."""
    from rich.text import Text

    events = [_mapping(event) for event in _sequence(status.get("events"))][-_MESSAGES:]
    if not events:
        return []
    rows = facts()
    for event in events:
        rows.add_row(Text(_local_time(event.get("time")), "dim"), Text(str(event.get("sentence", ABSENT))))
    return [Text(), rows]


def _local_time(value: object) -> str:
    try:
        return datetime.fromisoformat(str(value)).astimezone().strftime("%H:%M:%S.%f")[:-3]
    except ValueError:
        return ABSENT


def _bits(value: object) -> str:
    """Return 16 bits, highest first, in groups of four, and the number in hex."""
    if not isinstance(value, int):
        return ABSENT
    digits = f"{value & 0xFFFF:016b}"
    return f"{' '.join(digits[at : at + 4] for at in range(0, 16, 4))}  (0x{value:04X}, bit 15 first)"


def _count(value: object) -> str:
    return f"{value:,}".replace(",", " ") if isinstance(value, int) else ABSENT


def _mapping(value: object) -> Mapping[str, Any]:
    return value if isinstance(value, dict) else {}


def _sequence(value: object) -> Sequence[Any]:
    return value if isinstance(value, list) else []
