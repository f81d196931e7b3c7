"""The picture that `rtcp status` draws: whole at 80 columns, readable without colour."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import datetime
from typing import Any

from rich import box
from rich.console import Group, RenderableType
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

STATE_STYLES = {
    "holding": "bold green",
    "moving": "bold green",
    "ready": "bold cyan",
    "stopping": "bold yellow",
    "homing": "bold green",
    "stopped by limit": "bold yellow",
    "fault": "bold red",
    "emergency stop": "bold red",
}

JOINT_COLUMNS = (
    ("position", "rad"),
    ("velocity", "rad/s"),
    ("torque", "Nm"),
    ("target", "rad"),
)

DIGITAL_BITS = 16
"""Inputs, and outputs, of the IO box."""

ABSENT = "-"

UNHEARD_S = 0.1
"""Where cycles have been without the right working counter for longer, what the joints say is old, and said to be."""

MESSAGES = 5
"""So many of the last sentences are shown."""


def picture(status: Mapping[str, Any]) -> RenderableType:
    """Return the whole picture of one answer to `status`; a field that is missing is drawn as a dash."""
    gap = Text()
    tables = (_slaves(status), gap, _times(status), gap, _facts(status), *_messages(status))
    return Group(_headline(status), _joints(status), gap, *tables)


def _headline(status: Mapping[str, Any]) -> Panel:
    state = str(status.get("state", ABSENT)).replace("_", " ")
    modes = ", ".join(str(status[key]) for key in ("motion", "mode") if key in status) or ABSENT
    line = Text.assemble(
        (state.upper(), STATE_STYLES.get(state.lower(), "bold")),
        f"   {modes} on {status.get('bus', ABSENT)}",
    )
    cycle_ns = status.get("cycle_ns")
    if isinstance(cycle_ns, int | float):
        line.append(f"   every {cycle_ns / 1000:g} us")
    line.append(f"   {_count(status.get('cycles'))} cycles, ")
    line.append(f"{_count(status.get('missed'))} missed", "yellow" if status.get("missed") else "")
    message = str(status.get("message") or "")
    if message:
        line.append("\n" + message, "red" if state.lower() in ("fault", "emergency stop") else "")
    return Panel(line, box=box.ROUNDED, title="rtcp", title_align="left")


def _messages(status: Mapping[str, Any]) -> list[RenderableType]:
    """What was said last, each sentence with its local time."""
    told = [_mapping(one) for one in _sequence(status.get("events"))][-MESSAGES:]
    if not told:
        return []
    table = Table.grid(padding=(0, 2))
    table.add_column(no_wrap=True)
    table.add_column()
    for one in told:
        table.add_row(Text(_clock(one.get("time")), "dim"), Text(str(one.get("sentence", ABSENT))))
    return [Text(), table]


def _clock(value: object) -> str:
    try:
        return datetime.fromisoformat(str(value)).astimezone().strftime("%H:%M:%S.%f")[:-3]
    except ValueError:
        return ABSENT


def _joints(status: Mapping[str, Any]) -> Table:
    joints = _mapping(status.get("joints"))
    columns = {name: _sequence(joints.get(name)) for name, _ in JOINT_COLUMNS}
    names = _sequence(status.get("joint_names"))
    count = max([len(values) for values in columns.values()] + [0])
    table = Table(box=box.SIMPLE_HEAD, show_edge=False, expand=True, padding=(0, 1))
    unheard_s = status.get("unheard_s")
    if isinstance(unheard_s, int | float) and unheard_s > UNHEARD_S:
        table.caption = f"as last heard, {unheard_s:.1f} s ago: not every slave takes part since then"
        table.caption_justify = "left"
    table.add_column("joint")
    for name, unit in JOINT_COLUMNS:
        table.add_column(f"{name} {unit}", justify="right")
    for joint in range(count):
        label = str(names[joint]) if joint < len(names) else str(joint + 1)
        table.add_row(label, *(_signed(_at(columns[name], joint)) for name, _ in JOINT_COLUMNS))
    return table


def _slaves(status: Mapping[str, Any]) -> Table:
    """Slaves in two columns, down the first and then the second, as the cable runs."""
    slaves = [_mapping(slave) for slave in _sequence(status.get("slaves"))]
    rows = (len(slaves) + 1) // 2
    troubled = any(_trouble(slave) for slave in slaves)
    table = Table(box=box.SIMPLE_HEAD, show_edge=False, expand=True, padding=(0, 1))
    for _ in range(2 if len(slaves) > 1 else 1):
        table.add_column("#", justify="right")
        table.add_column("slave", ratio=1)
        table.add_column("state")
        if troubled:
            table.add_column("lost/err/links")
    for row in range(rows):
        cells: list[RenderableType] = []
        for slave in slaves[row::rows]:
            found = str(slave.get("state", ABSENT))
            cells += [
                str(slave.get("position", ABSENT)),
                str(slave.get("name", ABSENT)),
                Text(found, "green" if found.upper() == "OP" else "red"),
            ]
            if troubled:
                cells.append(Text(_trouble(slave), "yellow"))
        table.add_row(*cells)
    return table


def _trouble(slave: Mapping[str, Any]) -> str:
    """How often a slave left OP, damaged frames that came in over its cables, lost links; empty where all are 0."""
    errors = _mapping(slave.get("errors"))
    counts = [slave.get("lost", 0), errors.get("rx", 0), errors.get("links", 0)]
    return "/".join(map(str, counts)) if any(counts) else ""


def _times(status: Mapping[str, Any]) -> Table:
    table = Table(box=box.SIMPLE_HEAD, show_edge=False, expand=True, padding=(0, 1))
    table.add_column("time of a cycle")
    for quantile in ("p50", "p99", "max"):
        table.add_column(f"{quantile} us", justify="right")
    for label, key in (("wake-up", "wakeup_us"), ("exchange", "exchange_us"), ("compute", "compute_us")):
        values = _mapping(status.get(key))
        table.add_row(label, *(_microseconds(values.get(quantile)) for quantile in ("p50", "p99", "max")))
    return table


def _facts(status: Mapping[str, Any]) -> Table:
    table = Table.grid(padding=(0, 2))
    table.add_column(style="bold", no_wrap=True)
    table.add_column()
    if robot := _mapping(status.get("robot")):
        table.add_row("robot", _robot(robot))
    if status.get("motion") == "joystick":
        stick = _mapping(status.get("stick"))
        whose = "the arm's" if stick.get("arm_has_it") else "the wheelchair's"
        table.add_row("stick", f"{stick.get('mode', ABSENT)}, it is {whose}")
    wkc = _mapping(status.get("wkc"))
    table.add_row("frames", _working_counter(wkc))
    table.add_row("clocks", _clocks(_mapping(status.get("dc")), _answered(wkc)))
    table.add_row("inputs", _bits(status.get("inputs")))
    table.add_row("outputs", _bits(status.get("outputs")))
    table.add_row("real time", realtime_line(_mapping(status.get("realtime"))))
    lease = _mapping(status.get("lease")).get("holder")
    if lease:
        table.add_row("lease", Text(str(lease)))
    pids = _mapping(status.get("pids"))
    table.add_row("processes", ", ".join(f"{name} {pid}" for name, pid in pids.items() if pid) or ABSENT)
    return table


def _robot(robot: Mapping[str, Any]) -> Text:
    """RobotStatus in words: what is on is said, what is wrong is red."""
    line = Text(f"{robot.get('mode', ABSENT)}, drives {'powered' if robot.get('drives_powered') else 'without power'}")
    line.append(", motion possible" if robot.get("motion_possible") else ", no motion possible")
    line.append(", in motion" if robot.get("in_motion") else ", not in motion")
    if robot.get("e_stopped"):
        line.append(", emergency stop", "bold red")
    if robot.get("in_error"):
        line.append(f", error {robot.get('error_code', ABSENT)}", "bold red")
    return line


def _answered(wkc: Mapping[str, Any]) -> bool:
    """Whether any slave took part in the last frame: its counter is above 0; -1: the frame did not come back."""
    actual = wkc.get("actual")
    return not isinstance(actual, int) or actual > 0


def _working_counter(wkc: Mapping[str, Any]) -> Text:
    expected, actual = wkc.get("expected", ABSENT), wkc.get("actual", ABSENT)
    if not _answered(wkc):
        return Text(f"no answer, {expected} expected", "bold red")
    return Text(f"working counter {actual} of {expected}", "" if actual == expected else "bold red")


def _clocks(clocks: Mapping[str, Any], answered: bool) -> Text:
    if not clocks:
        return Text(ABSENT)
    if not answered:
        return Text("not followed: no answer", "yellow")
    line = Text("locked" if clocks.get("locked") else "not locked", "" if clocks.get("locked") else "yellow")
    for key, label in (("offset_ns", "offset"), ("filtered_ns", "filtered")):
        value = clocks.get(key)
        if isinstance(value, int | float):
            line.append(f", {label} {value / 1000:+.1f} us")
    return line


def realtime_line(realtime: Mapping[str, Any]) -> str:
    """Return scheduling and memory of the loop in one line, with the notes on what the system refused below it."""
    if not realtime:
        return ABSENT
    cpu = realtime.get("cpu")
    line = ", ".join(
        (
            str(realtime.get("scheduler", ABSENT)),
            "memory locked" if realtime.get("memory_locked") else "memory not locked",
            "no CPU of its own" if cpu is None else f"CPU {cpu}",
        )
    )
    return "\n".join([line, *(str(note) for note in _sequence(realtime.get("notes")))])


def _bits(value: object) -> str:
    """Return the bits highest first in groups of four, with the number as a programmer writes it."""
    if not isinstance(value, int):
        return ABSENT
    digits = f"{value & (1 << DIGITAL_BITS) - 1:0{DIGITAL_BITS}b}"
    grouped = " ".join(digits[start : start + 4] for start in range(0, DIGITAL_BITS, 4))
    return f"{grouped}  (0x{value:04X}, bit 15 first)"


def _signed(value: object) -> str:
    return f"{value:+.4f}" if isinstance(value, int | float) else ABSENT


def _microseconds(value: object) -> str:
    return f"{value:.1f}" if isinstance(value, int | float) else ABSENT


def _count(value: object) -> str:
    return f"{value:,}".replace(",", " ") if isinstance(value, int) else ABSENT


def _at(values: Sequence[Any], index: int) -> object:
    return values[index] if index < len(values) else None


def _mapping(value: object) -> Mapping[str, Any]:
    return value if isinstance(value, dict) else {}


def _sequence(value: object) -> Sequence[Any]:
    return value if isinstance(value, list) else []
