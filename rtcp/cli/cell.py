"""`rtcp cell`: several arms, started, commanded and stopped together; each arm by itself: `rtcp --name NAME ...`."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from operator import methodcaller
from pathlib import Path
from typing import Annotated, Any

import typer

from rtcp.api import Arrival, RtcpError, State
from rtcp.api.cell import Cell, find_cells
from rtcp.api.robot import Robot
from rtcp.cli.arguments import option
from rtcp.cli.output import CommandError, ExitCode, emit, emit_json, report, show, table
from rtcp.config.cell import CellConfig
from rtcp.config.model import Point
from rtcp.config.numbers import angle, plain_number
from rtcp.ipc.runtime_directory import control_socket, runtime_directory
from rtcp.ipc.session import SessionError, is_running, read_processes, read_session

_READY_S = 90.0
_POLL_S = 0.1
commands = typer.Typer()
_cell = typer.Typer(help="Several arms in step: start, command and stop them together.", no_args_is_help=True)
commands.add_typer(_cell, name="cell")


@dataclasses.dataclass
class _Chosen:
    name: str = ""


_chosen = _Chosen()


@_cell.callback()
def _choose(name: Annotated[str, option("--cell", "NAME", "The cell, where several run.")] = "") -> None:
    """Several arms in step: start, command and stop them together."""
    _chosen.name = name


# -- starting and stopping --------------------------------------------------------------------------------------------


@_cell.command("start")
def _start(
    config: Annotated[Path | None, option("--config", "FILE", "File of the cell. Default: the packaged one.")] = None,
    detach: Annotated[bool, option("--detach", "Return when all arms run; `rtcp cell stop` ends them.")] = False,
) -> None:
    """Start the platforms of all arms of a cell."""
    from rtcp.config.cell_file import load_cell
    from rtcp.config.find import default_config

    path = default_config().with_name("cell.yaml") if config is None else config
    cell = load_cell(path)
    names = _to_start(cell)
    raise typer.Exit(_detached(cell, path, names) if detach else _foreground(cell, path, names))


def _to_start(cell: CellConfig) -> list[str]:
    """Return the arms whose loop does not run; raises CommandError where one runs outside this cell, or all run."""
    names = []
    for arm in cell.members:
        directory = runtime_directory(arm.name)
        if not is_running(read_processes(directory).loop):
            # The gateway of a loop that was killed may still have its socket: the start removes both.
            names.append(arm.name)
            continue
        with contextlib.suppress(SessionError):
            live = read_session(directory).cell
            if live is None or live.digest != cell.digest:
                owner = "no cell" if live is None else f"{live.name} of {live.source}, in another state of its files"
                raise CommandError(f"{arm.name} runs already, as part of {owner}: `rtcp --name {arm.name} stop` first")
    if not names:
        raise CommandError(f"the cell {cell.name} runs already: `rtcp cell status`")
    return names


def _command(path: Path, name: str, *more: str) -> list[str]:
    return [sys.executable, "-m", "rtcp.cli", "--name", name, "start", "--cell", str(path), *more]


def _detached(cell: CellConfig, path: Path, names: Sequence[str]) -> int:
    """Start these arms and return; where one does not start, stop those that were started."""
    children = {name: _spawn(_command(path, name, "--detach")) for name in names}
    threads = [_forward(name, child) for name, child in children.items()]
    codes = {name: child.wait() for name, child in children.items()}
    for thread in threads:
        thread.join()
    if any(codes.values()):
        for name in codes:
            # Also an arm that runs, but was not ready in time.
            if control_socket(runtime_directory(name)).exists():
                subprocess.run([sys.executable, "-m", "rtcp.cli", "--name", name, "stop"], check=False)
        raise CommandError("the cell was not started: " + ", ".join(n for n, c in codes.items() if c), ExitCode.FAULT)
    report(f"the cell {cell.name} runs: `rtcp cell enable`, `rtcp cell status`; `rtcp cell stop` ends it")
    return ExitCode.DONE


def _foreground(cell: CellConfig, path: Path, names: Sequence[str]) -> int:
    """Start these arms, wait for the end of all, and stop all on a signal."""
    children = {name: _spawn(_command(path, name)) for name in names}
    for name, child in children.items():
        _forward(name, child)

    def stop_all(number: int = 0, frame: object = None) -> None:
        for child in children.values():
            with contextlib.suppress(ProcessLookupError):
                child.send_signal(signal.SIGTERM)

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, stop_all)
    try:
        if _all_ready(children):
            report(f"the cell {cell.name} runs: `rtcp cell enable` in another terminal; Ctrl-C or `rtcp cell stop`")
        else:
            stop_all()
        codes = [abs(child.wait()) for child in children.values()]
    except BaseException:
        stop_all()
        raise
    return max(codes)


def _all_ready(children: dict[str, subprocess.Popen[str]]) -> bool:
    until = time.monotonic() + _READY_S
    waiting = list(children)
    while waiting and time.monotonic() < until:
        if any(child.poll() is not None for child in children.values()):
            return False
        directory = runtime_directory(waiting[0])
        if is_running(read_processes(directory).loop):
            with contextlib.suppress(RtcpError), Robot("rtcp cell start", control_socket(directory)) as robot:
                if robot.state is not State.STARTING:
                    waiting.pop(0)
                    continue
        time.sleep(_POLL_S)
    return not waiting


def _spawn(command: list[str]) -> subprocess.Popen[str]:
    # A group of its own: Ctrl-C in a terminal reaches this process, which stops all arms.
    return subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        start_new_session=True, env={**os.environ, "RTCP_NAME": ""},
    )  # fmt: skip


def _forward(name: str, child: subprocess.Popen[str]) -> threading.Thread:
    """Print the output of a child, with the arm's name before each line."""

    def copy() -> None:
        assert child.stdout is not None
        for line in child.stdout:
            report(f"{name}: {line.rstrip()}")

    thread = threading.Thread(target=copy, daemon=True)
    thread.start()
    return thread


@_cell.command("stop")
def _stop() -> None:
    """Stop the platforms of all arms: drives disabled, processes ended."""
    cells = find_cells(_chosen.name)
    running = [member.name for cell in cells for member in cell.members if control_socket(member.directory).exists()]
    children = {name: _spawn([sys.executable, "-m", "rtcp.cli", "--name", name, "stop"]) for name in running}
    threads = [_forward(name, child) for name, child in children.items()]
    codes = [child.wait() for child in children.values()]
    for thread in threads:
        thread.join()
    raise typer.Exit(max(codes))


# -- commands to all arms ---------------------------------------------------------------------------------------------


@contextlib.contextmanager
def _connected(command: str) -> Iterator[Cell]:
    """Connect to all arms; on Ctrl-C all stop."""
    with Cell(f"rtcp cell {command} (pid {os.getpid()})", _chosen.name) as cell:
        try:
            yield cell
        except KeyboardInterrupt:
            cell.halt()
            raise CommandError("interrupted: all arms come to a controlled stop", 130) from None


@_cell.command("status")
def _status(as_json: Annotated[bool, option("--json", "One JSON object: the status of each arm.")] = False) -> None:
    """Show the state of every arm."""
    statuses: dict[str, Any] = {}
    for member in (member for cell in find_cells(_chosen.name) for member in cell.members):
        try:
            with Robot("rtcp cell status", control_socket(member.directory)) as robot:
                statuses[member.name] = robot.status().raw
        except RtcpError as error:
            statuses[member.name] = {"state": "not running", "message": error.message}
    if as_json:
        emit_json(statuses)
        return
    rows = table(("arm", "state", "bus", "joints, rad", "message"), ("arm", "state", "bus"), fill="message")
    for name, status in statuses.items():
        joints = " ".join(f"{position:.3f}" for position in status.get("joints", {}).get("actual_position", ()))
        rows.add_row(name, status["state"].replace("_", " "), status.get("bus", "-"), joints, status["message"])
    show(rows)


def _simple(name: str, words: str, call: Callable[[Cell], object]) -> None:
    def command() -> None:
        with _connected(name) as cell:
            call(cell)
        emit(words)

    command.__doc__ = f"{call.__doc__}"
    _cell.command(name)(command)


_simple("enable", "all arms are enabled and hold", Cell.enable)
_simple("reset", "reset", Cell.reset)


def _stop_all(method: str, words: str) -> None:
    """Call a method of every arm that answers, all at once; then say which did not.

    Raises:
        CommandError: with a sentence for each.
    """
    import asyncio  # here: it loads slowly, and no other command has use for it

    from rtcp.api.async_cell import AsyncCell

    call = methodcaller(method)
    outcomes: dict[str, Any] = {}
    for config in find_cells(_chosen.name):
        cell = AsyncCell(config, f"rtcp cell {method} (pid {os.getpid()})")
        outcomes |= asyncio.run(cell.attempt({member.name: call for member in config.members}))
    failed = [f"{name}: {error}" for name, error in outcomes.items() if isinstance(error, BaseException)]
    if failed:
        raise CommandError("\n".join(failed), ExitCode.FAULT)
    emit(words)


@_cell.command("halt")
def _halt() -> None:
    """Stop every motion of every arm, whoever began it; an arm that does not answer does not delay the others."""
    _stop_all("halt", "all arms hold")


@_cell.command("disable")
def _disable() -> None:
    """Stop all arms and remove their torque; an arm that does not answer does not delay the others."""
    _stop_all("disable", "no arm has torque")


@_cell.command("move")
def _move(
    targets: Annotated[list[str], typer.Argument(metavar="ARM=Q1,..,QN...", help="Joint positions of an arm, rad.")],
    speed: Annotated[float | None, option("--speed", "V", "Of the fastest joint, rad/s. Default: the limits.")] = None,
) -> None:
    """Move joints of several arms in step: all begin and end together."""
    goals = dict(map(_target, targets))
    with _connected("move") as cell:
        arrived = cell.move_joints(goals, speed)
    _show_arrivals(arrived)


@_cell.command("run")
def _run(
    files: Annotated[
        list[str],
        typer.Argument(metavar="ARM=FILE...", help="Motion file of an arm, with a trajectory (docs/motion.md)."),
    ],
    approach: Annotated[bool, option("--approach", "Move in step to where the trajectories begin.")] = False,
) -> None:
    """Run trajectories of several arms in step; a motion file each."""
    from rtcp.config.motion_file import read_motion

    points: dict[str, list[dict[str, Any]]] = {}
    for text in files:
        name, equals, file = text.partition("=")
        if not (name and equals and file):
            raise CommandError(f'found "{text}", allowed is ARM=FILE: an arm and its motion file')
        motion = read_motion(Path(file))
        if not motion.trajectory:
            raise CommandError(
                f"{file}: found straight lines, allowed is a trajectory: lines of several arms have no common time"
            )
        points[name] = [_without_none(point) for point in motion.trajectory]
    with _connected("run") as cell:
        if approach:
            cell.move_joints({name: waypoints[0]["q"] for name, waypoints in points.items()})
        arrived = cell.run_trajectory(points)
    _show_arrivals(arrived)


def _without_none(point: Point) -> dict[str, Any]:
    return {key: value for key, value in dataclasses.asdict(point).items() if value is not None}


def _show_arrivals(arrived: Mapping[str, Arrival]) -> None:
    for name, end in arrived.items():
        emit(f"{name}: arrived, {1000 * end.error:.2f} mrad from the target")


def _target(text: str) -> tuple[str, list[float]]:
    name, equals, numbers = text.partition("=")
    try:
        if not (name and equals):
            raise ValueError
        return name, [plain_number(angle(value.strip())) for value in numbers.split(",")]
    except ValueError:
        raise CommandError(f'found "{text}", allowed is ARM=Q1,..,QN: an arm and its joint positions, rad') from None
