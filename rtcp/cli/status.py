"""`rtcp status`: the state of the platform, for people and for programs, once or continuously.

The picture fits 80 columns and reads without colour.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Iterator, Mapping
from datetime import datetime
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rtcp.api import ConnectionLost, NotRunning, Robot
from rtcp.cli.arguments import option
from rtcp.cli.output import CommandError, ExitCode, console, emit, emit_json, facts, show, table
from rtcp.cli.platform import connect, loop_process

if TYPE_CHECKING:
    from rich.console import RenderableType
    from rich.panel import Panel
    from rich.table import Table
    from rich.text import Text

Json = Mapping[str, Any]
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
CYCLE_TIMES = (("wake-up", "wakeup_us"), ("exchange", "exchange_us"), ("compute", "compute_us"))
QUANTILES = ("p50", "p99", "max")
_STALE_S = 0.1
"""Age from which on joint values are marked as stale, s."""
_LOST_SHARE = 0.01
"""Share of unanswered or incomplete cycles from which on they are highlighted."""
_DIFFERENT_RAD = 1e-6
"""Least change of a commanded position by a limiter that is shown, rad."""
_MESSAGES = 5
"""Number of recent messages."""

commands = typer.Typer()


@commands.command("status")
def _status(
    as_json: Annotated[bool, option("--json", "One JSON object a line, SI units.")] = False,
    watch: Annotated[bool, option("--watch", "Refresh until Ctrl-C.")] = False,
) -> None:
    """Show state, joints, slaves, cycle times and clocks of the running platform."""
    if watch:
        try:
            _watch(as_json)
        except KeyboardInterrupt:
            raise typer.Exit(ExitCode.DONE) from None  # Ctrl-C is the normal end of a watch
    with connect("status") as robot:
        status = robot.status().raw
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


def _statuses(interval_s: float) -> Iterator[Json]:
    """Yield the status at regular instants; connect again where only the gateway has ended.

    Raises:
        CommandError: the platform has ended.
        NotRunning: the loop runs and no gateway can be reached.
    """
    due = time.monotonic()
    robot = connect("status")
    try:
        while True:
            try:
                status = robot.status().raw
            except ConnectionLost:
                robot = _reconnect(robot)
                continue
            yield status
            due = max(due + interval_s, time.monotonic())
            time.sleep(max(0.0, due - time.monotonic()))
    finally:
        robot.close()


def _reconnect(robot: Robot) -> Robot:
    robot.close()
    try:
        return connect("status")
    except NotRunning as error:
        if loop_process():
            raise
        raise CommandError("the platform has ended", ExitCode.NOT_RUNNING) from error


def picture(status: Json) -> RenderableType:
    """Return the whole picture of a status."""
    from rich.console import Group
    from rich.text import Text

    gap = Text()
    slaves = (_slaves(status), gap) if status["slaves"] else ()
    parts = (_headline(status), _joints(status), gap, *slaves, _times(status), gap, _facts(status))
    return Group(*parts, *_messages(status))


def _headline(status: Json) -> Panel:
    from rich import box
    from rich.panel import Panel
    from rich.text import Text

    state = status["state"].replace("_", " ")
    line = Text.assemble((state.upper(), STATE_STYLES.get(state, "bold")))
    kind = "" if status["bus_kind"] == "ethercat" else f" ({status['bus_kind']})"
    line.append(f"   {status['control_mode']}, {status['drive_mode']} on {status['bus']}{kind}")
    if (override := status["speed_override"]) < 1.0:
        line.append(f"   speed {100.0 * override:.3g} %", "yellow")
    line.append(f"   every {status['cycle_ns'] / 1000:g} us   {status['cycles']:,} cycles, ".replace(",", " ", 1))
    line.append(f"{status['missed']:,} missed".replace(",", " "), "yellow" if status["missed"] else "")
    if status["message"]:
        line.append(f"\n{status['message']}", "red" if state in ("fault", "emergency stop") else "")
    return Panel(line, box=box.ROUNDED, title="rtcp", title_align="left")


def _joints(status: Json) -> Table:
    joints = status["joints"]
    columns = {
        "position\nrad": joints["actual_position"],
        "velocity\nrad/s": joints["actual_velocity"],
        "torque\nNm": joints["actual_torque"],
        "target\nrad": joints["sent_position"],
    }
    differences = zip(joints["commanded_position"], joints["sent_position"], strict=True)
    if any(abs(commanded - sent) > _DIFFERENT_RAD for commanded, sent in differences):
        columns["commanded\nrad"] = joints["commanded_position"]
    rows = table(("joint", *columns), ("joint",), expand=True)
    if status["lost_s"] > _STALE_S:
        rows.caption = f"last received {status['lost_s']:.1f} s ago: not every slave has answered since"
        rows.caption_justify = "left"
    for name, *values in zip(status["joint_names"], *columns.values(), strict=True):
        rows.add_row(name, *(f"{value:+.4f}" for value in values))
    return rows


def _slaves(status: Json) -> Table:
    """Return the slaves in the order of the cable: down the first column, then the second; one column with errors."""
    from rich.text import Text

    slaves = status["slaves"]
    with_errors = any(_error_counts(slave) for slave in slaves)
    headings = ("#", "slave", "state", *(("lost/err/links",) if with_errors else ()))
    columns = 1 if with_errors or len(slaves) == 1 else 2
    rows = table(headings * columns, ("state", "lost/err/links"), expand=True, fill="slave")
    height = -(-len(slaves) // columns)
    for row in range(height):
        cells: list[RenderableType] = []
        for slave in slaves[row::height]:
            cells += [str(slave["position"]), slave["name"]]
            cells.append(Text(slave["state"], "green" if slave["state"] == "OP" else "red"))
            if with_errors:
                cells.append(Text(_error_counts(slave), "yellow"))
        rows.add_row(*cells)
    return rows


def _error_counts(slave: Json) -> str:
    """Return counts of a slave: exits from OP, damaged frames at its ports, lost links; empty where all are 0."""
    counts = [slave["lost"], sum(slave["errors"]["rx"]), sum(slave["errors"]["links"])]
    return "/".join(map(str, counts)) if any(counts) else ""


def _times(status: Json) -> Table:
    rows = table(("time of a cycle", *(f"{quantile} us" for quantile in QUANTILES)), ("time of a cycle",), expand=True)
    for label, key in CYCLE_TIMES:
        rows.add_row(label, *quantiles(status[key]))
    return rows


def quantiles(values: Json) -> list[str]:
    """Return p50, p99 and maximum of a time, us; a dash before the first cycle."""
    return ["-" if values.get(name) is None else f"{values[name]:.1f}" for name in QUANTILES]


def _facts(status: Json) -> Table:
    from rich.text import Text

    rows = facts()
    rows.columns[0].style = "bold"
    rows.add_row("robot", _robot(status["robot"]))
    if (joystick := status["joystick"]) is not None:
        rows.add_row("joystick", f"{joystick['mode']}, controls the {'arm' if joystick['controls_arm'] else 'chair'}")
    rows.add_row("drives", _drives(status))
    if status["tool"] is not None:
        rows.add_row("tool", Text(_tool(status)))
    rows.add_row("frames", _frames(status))
    if status["dc"] is not None:
        rows.add_row("clocks", _clocks(status))
    for name, axis in status["axes"].items():
        doing = "moves" if axis["moving"] else "at rest" if axis["homed"] else "at rest, not homed"
        unit = axis["unit"]
        rows.add_row(Text(name), Text(f"{axis['position']:+.4f} {unit}, {axis['velocity']:+.4f} {unit}/s, {doing}"))
    for name, process in status["processes"].items():
        rows.add_row(Text(name), Text(process["state"] or process["kind"]))
    for device, fields in status["devices"].items():
        for name, field in fields.items():
            rows.add_row(Text(f"{device} {name}"), Text(_value(name, **field)))
    rows.add_row("real time", realtime_line(status["realtime"]))
    if problems := _host_problems(status):
        rows.add_row("host", Text(f"{', '.join(problems)}: see `rtcp doctor`", "yellow"))
    if status["lease"]["holder"]:
        rows.add_row("lease", Text(status["lease"]["holder"]))
    rows.add_row("processes", ", ".join(f"{name} {pid}" for name, pid in status["pids"].items() if pid))
    return rows


def _drives(status: Json) -> str:
    """Return the states of the drives: one for all, or each by the name of its joint."""
    states = status["drive_states"]
    if len(set(states)) == 1:
        return str(states[0])
    return ", ".join(f"{name} {state}" for name, state in zip(status["joint_names"], states, strict=True))


def _tool(status: Json) -> str:
    """Return the name of the tool, its payload, its measured pose and its speeds."""
    tool, mass = status["tool"], status["payload"]["mass"]
    name = f"{status['tool_name']} with {mass:.3g} kg" if mass else status["tool_name"]
    position, angles = (" ".join(f"{value:+.4f}" for value in tool["pose"][at : at + 3]) for at in (0, 3))
    speed, turn_rate = (math.hypot(*tool["velocity"][at : at + 3]) for at in (0, 3))
    return f"{name}: {position} m, {angles} rad, {speed:.3f} m/s, {turn_rate:.3f} rad/s"


def _value(name: str, value: Any, unit: str) -> str:
    """Return the value of a device's field: levels of inputs and outputs as bits."""
    if name in ("inputs", "outputs"):
        return _bits(int(value))
    number = f"{value:.6g}" if isinstance(value, float) else str(value)
    return f"{number} {unit}".rstrip()


def _frames(status: Json) -> Text:
    """Return the working counter of the last answer, and the number of unanswered cycles of the last second."""
    from rich.text import Text

    expected, actual, second = status["wkc"]["expected"], status["wkc"]["actual"], status["last_second"]
    if actual <= 0:  # 0: no slave took part; -1: no frame came back
        return Text(f"no answer in the last second, {expected} expected", "bold red")
    counter = f"working counter {actual} of {expected}" if status["slaves"] else "answered"
    line = Text(counter, "" if actual == expected else "bold red")
    for kind in ("unanswered", "incomplete"):
        if second[kind]:
            style = "yellow" if second[kind] > _LOST_SHARE * second["cycles"] else ""
            line.append(f", {second[kind]} of {second['cycles']} cycles {kind}", style)
    return line


def _clocks(status: Json) -> Text:
    """Return whether the master is locked to the reference clock, and in how many cycles of the last second it was."""
    from rich.text import Text

    clocks, second = status["dc"], status["last_second"]
    if status["wkc"]["actual"] <= 0:
        return Text("not tracked: no answer", "yellow")
    text = clock_state(clocks)
    if second["tracked"] < second["cycles"]:
        text = f"locked in {second['tracked']} of {second['cycles']} cycles"
    line = Text(text, "" if clocks["locked"] else "yellow")
    line.append(f", offset {clocks['offset_ns'] / 1000:+.1f} us, filtered {clocks['filtered_ns'] / 1000:+.1f} us")
    return line


def _host_problems(status: Json) -> list[str]:
    """Return the obstacles to real time on the host, a few words each; `rtcp doctor` explains them."""
    refused, skipped = len(status["realtime"].get("notes", ())), status.get("skipped_ticks")
    problems = [f"{refused} setting{'s' * (refused > 1)} refused"] if refused else []
    return problems + ([f"{100 * skipped['share']:.2g} % of the ticks skipped"] if skipped else [])


def _robot(robot: Json) -> Text:
    """Return ROS-Industrial's RobotStatus in words."""
    from rich.text import Text

    powered = {True: "drives powered", False: "drives without power", None: "power of the drives unknown"}
    moving = {True: ", in motion", False: ", not in motion", None: ", motion unknown"}
    line = Text(f"{robot['mode']}, " if robot["mode"] else "")
    line.append(powered[robot["drives_powered"]])
    line.append(", motion possible" if robot["motion_possible"] else ", no motion possible")
    line.append(moving[robot["in_motion"]])
    if robot["e_stopped"]:
        line.append(", emergency stop", "bold red")
    if robot["in_error"]:
        line.append(f", error {robot['error_code']}", "bold red")
    return line


def clock_state(clocks: Json) -> str:
    """Return whether the master is locked to the reference clock."""
    return "locked" if clocks["locked"] else "not locked"


def realtime_line(realtime: Json) -> str:
    """Return scheduling, memory and CPU of the loop, and whether it runs compiled, in one line."""
    if not realtime:
        return "-"
    memory = "memory locked" if realtime["memory_locked"] else "memory not locked"
    cpu = "no CPU of its own" if realtime["cpu"] is None else f"CPU {realtime['cpu']}"
    return f"{realtime['scheduler']}, {memory}, {cpu}, {'compiled' if realtime.get('compiled') else 'not compiled'}"


def _messages(status: Json) -> list[RenderableType]:
    """Return the latest messages with their local time."""
    from rich.text import Text

    if not status["messages"]:
        return []
    rows = facts()
    for at, message in list(zip(status["message_times"], status["messages"], strict=True))[-_MESSAGES:]:
        local = datetime.fromisoformat(at).astimezone().strftime("%H:%M:%S.%f")[:-3]
        rows.add_row(Text(local, "dim"), Text(message))
    return [Text(), rows]


def _bits(value: int) -> str:
    """Return 16 bits, highest first, in groups of four, and the number in hex."""
    digits = f"{value & 0xFFFF:016b}"
    return f"{' '.join(digits[at : at + 4] for at in range(0, 16, 4))}  (0x{value:04X}, bit 15 first)"
