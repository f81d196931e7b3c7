"""`rtcp segment`: run software slaves for any EtherCAT master, and inject faults into a running segment."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import MISSING, asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

from rtcp.cli.arguments import (
    NUMBERS_AS_WRITTEN,
    AsJson,
    Poll,
    as_written,
    number,
    option,
    positive,
    refuse_old_name,
)
from rtcp.cli.control_socket import connected, free_path, settle
from rtcp.cli.output import CommandError, emit, emit_json, report
from rtcp.ipc.runtime_directory import runtime_directory, segment_control

if TYPE_CHECKING:
    from rtcp.virtual.faults.control import SegmentClient

ControlPath = Annotated[
    Path | None,
    option("--segment", "PATH", "Control socket of the segment. Default: in the runtime directory."),
]
_IN_HEX = ("code", "index")
_WRENCH = (("X", "N"), ("Y", "N"), ("Z", "N"), ("RX", "Nm"), ("RY", "Nm"), ("RZ", "Nm"))

commands = typer.Typer(name="segment", invoke_without_command=True)
refuse_old_name(commands, "mend", "rtcp segment clear")


# -- a segment in this process --------------------------------------------------------------------------------------


@commands.callback()
def _segment(
    context: typer.Context,
    config: Annotated[Path | None, option("--config", "FILE", "The slaves in the order of the cable.")] = None,
    interface: Annotated[
        str | None,
        option("--interface", "NAME", "Name of the master's interface, here. Default: in a network namespace."),
    ] = None,
    poll: Poll = False,
    cpu: Annotated[
        int | None,
        option("--cpu", "N", "CPU of the segment. Default: any but the last, on which a cycle runs by default."),
    ] = None,
    script: Annotated[Path | None, option("--faults", "SCRIPT", "Faults with their times, s after the start.")] = None,
) -> None:
    """Run a segment of software slaves until stopped, or inject faults into a running one."""
    options = {"--config": config, "--interface": interface, "--poll": poll or None, "--cpu": cpu, "--faults": script}
    if context.invoked_subcommand is not None:
        if wrong := [option for option, value in options.items() if value is not None]:
            raise CommandError(f"{wrong[0]} is an option of a segment that starts, not of {context.invoked_subcommand}")
        return
    if config is None:
        raise CommandError("--config FILE is missing: the slaves in the order of the cable (or: fault, clear, faults)")
    _run(config, interface, poll, cpu, script)


def _run(config: Path, interface: str | None, poll: bool, cpu: int | None, script: Path | None) -> None:
    from rtcp.virtual.network import NetworkError
    from rtcp.virtual.server import run

    users_before = _user_namespace()
    usual = segment_control(runtime_directory())
    control = free_path(usual)

    def ready(started: dict[str, int | str | bool]) -> None:
        settle(cpu)
        count, name, pid = started["slaves"], started["interface"], started["pid"]
        report(f"segment of {count} {'slave' if count == 1 else 'slaves'} (process {pid})")
        if not started["namespace"]:
            report(f"the master's interface is {name}: `rtcp start --bus {name}`, or any EtherCAT master on {name}")
        else:
            users = "" if _user_namespace() == users_before else " -U --preserve-credentials"
            report(f"the master's interface is {name} in the network namespace of process {pid}; start a master with")
            report(f"  nsenter -t {pid}{users} -n COMMAND {name}")
        where = "" if control == usual else f" --segment {control}"
        report(f"inject faults with `rtcp segment fault NAME{where}`; control socket {control}")
        report("Ctrl-C ends it")

    try:
        run(config, interface, poll, cpu, ready, control, script)
    except (NetworkError, ValueError) as error:
        raise CommandError(str(error)) from error
    report("ended")


def _user_namespace() -> str:
    return os.readlink("/proc/self/ns/user")


# -- faults of a running segment ------------------------------------------------------------------------------------


@commands.command("fault")
def _fault(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Kind of the fault: `rtcp segment kinds` lists them.")],
    pairs: Annotated[list[str] | None, typer.Argument(metavar="KEY=VALUE..", help="As after=3, code=0x1A.")] = None,
    lasts: Annotated[float | None, option("--lasts", "S", "Duration, s. Default: until it is cleared.")] = None,
    segment: ControlPath = None,
) -> None:
    """Inject a fault into the running segment."""
    from rtcp.virtual.faults.registry import parse

    planned, findings = parse(_mapping(name, pairs or [], lasts))
    if planned is None:
        raise CommandError("\n".join(map(str, findings)))
    if planned.at:
        raise CommandError("at: a fault of the command line begins at once; only a script has times")
    with _client(segment) as client:
        number = client.fault(planned.as_mapping())
        active = any(each["id"] == number for each in client.faults())
    fault = f"fault {number}: {_named(planned.as_mapping())}"
    if planned.fault.once or not active:
        report(f"{fault}: done")
        return
    until = "until it is cleared" if planned.lasts is None else f"for {planned.lasts:g} s"
    if getattr(planned.fault, "burst", None) is not None:
        until = "until its burst is over"
    where = "" if segment is None else f" --segment {segment}"
    report(f"{fault}, {until}; to clear it: rtcp segment clear {number}{where}")


@commands.command("push", context_settings=NUMBERS_AS_WRITTEN)
def _push(
    wrench: Annotated[
        list[str],
        as_written("X Y Z [RX RY RZ]", "Force, N, and torque, Nm, along and about the axes of the base."),
    ],
    seconds: Annotated[float, option("--seconds", "S", "How long, s.")] = 1.0,
    segment: ControlPath = None,
) -> None:
    """Push the arm at its tool, as a hand does; more pushes add up, and `rtcp segment clear` ends them."""
    positive("--seconds", seconds, "s")
    if len(wrench) not in (3, 6):
        raise CommandError(f"{len(wrench)} numbers are no push: 3 (X Y Z, N) or 6 (and RX RY RZ, Nm)")
    values = [number(text, name, unit) for text, (name, unit) in zip(wrench, _WRENCH, strict=False)]
    pairs = [f"{name.lower()}={value!r}" for value, (name, _) in zip(values, _WRENCH, strict=False)]
    _fault("push", pairs, seconds, segment)


@commands.command("clear")
def _clear(
    number: Annotated[int | None, typer.Argument(metavar="ID", help="Number of a fault. Default: all.")] = None,
    segment: ControlPath = None,
) -> None:
    """Clear a fault, or all of them."""
    with _client(segment) as client:
        cleared = client.clear(number)
    report(f"cleared: {', '.join(f'fault {each}' for each in cleared)}" if cleared else "no fault is active")


@commands.command("faults")
def _faults(as_json: AsJson = False, segment: ControlPath = None) -> None:
    """Show the active faults, since when, and how many frames they have changed."""
    with _client(segment) as client:
        active = client.faults()
    if as_json:
        emit_json(active)
        return
    for fault in active:
        remaining = "until it is cleared" if fault["left_s"] is None else f"{fault['left_s']:.1f} s left"
        counts = "".join(f", {count} {effect.replace('_', ' ')}" for effect, count in fault["counts"].items())
        emit(f"fault {fault['id']}: {_named(fault['fault'])}, for {fault['since_s']:.1f} s, {remaining}{counts}")
    if not active:
        emit("no fault is active")


@commands.command("get")
def _get(
    slave: Annotated[str, typer.Argument(metavar="SLAVE", help="Position from 1, or name.")],
    target: Annotated[
        str | None, typer.Argument(metavar="OBJECT", help="As 0x6000:1. Default: all process data.")
    ] = None,
    as_json: AsJson = False,
    segment: ControlPath = None,
) -> None:
    """Show what an object of a software slave holds, or its process data."""
    address = () if target is None else _object(target)
    with _client(segment) as client:
        entries = client.get(_slave(slave), *address)
    if as_json:
        emit_json(entries)
        return
    for entry in entries:
        emit(f"0x{entry['index']:04X}:{entry['subindex']} {entry['name']}: {entry['value']}")


@commands.command("set", context_settings=NUMBERS_AS_WRITTEN)
def _set(
    slave: Annotated[str, typer.Argument(metavar="SLAVE", help="Position from 1, or name.")],
    target: Annotated[str, typer.Argument(metavar="OBJECT", help="As 0x6000:1.")],
    value: Annotated[str, as_written("VALUE", "A number; of strings a text, or bytes as 0x1A2B.")],
    segment: ControlPath = None,
) -> None:
    """Set an object of a software slave, as its inputs: past all rights, and until something changes it."""
    index, subindex = _object(target)
    with _client(segment) as client:
        is_text = isinstance(client.get(_slave(slave), index, subindex)[0]["value"], str)
        entry = client.set(_slave(slave), index, subindex, value if is_text else _value(value))
    report(f"0x{index:04X}:{subindex} {entry['name']}: {entry['value']}")


def _slave(written: str) -> int | str:
    return int(written) if written.isdecimal() else written


def _object(written: str) -> tuple[int, int]:
    """Return index and subindex of an object, as 0x6000:1 or 0x6040; raises CommandError."""
    index, _, subindex = written.partition(":")
    try:
        parsed = int(index, 0), int(subindex or "0", 0)
    except ValueError:
        raise CommandError(f"{written!r} is no object: write index and subindex, as 0x6000:1") from None
    return parsed


@commands.command("kinds")
def _kinds(as_json: AsJson = False) -> None:
    """List the kinds of faults, their keys and the allowed values."""
    if as_json:
        emit_json([asdict(kind) for kind in kinds()])
        return
    for kind in kinds():
        emit(f"{kind.name}: {kind.says}")
        for key, allowed in kind.keys.items():
            emit(f"    {key:9} {allowed}")
    emit("Each that has a duration takes --lasts S. In a script: a list `faults:` with fault, at, lasts, keys.")


@dataclass(frozen=True)
class Kind:
    """A kind of fault: its description, and the allowed values of each key."""

    name: str
    says: str
    keys: dict[str, str]


def kinds() -> list[Kind]:
    """Return every kind of fault."""
    from rtcp.virtual.faults.registry import installed

    return [
        Kind(
            name,
            str(kind.__doc__).partition("\n")[0],
            {field.name: _allowed(kind, field) for field in kind.key_fields()},
        )
        for name, kind in installed().items()
    ]


def _allowed(kind: Any, field: Any) -> str:
    from rtcp.config.validation import allowed

    text = allowed(get_type_hints(kind, include_extras=True)[field.name])
    if field.default is MISSING:
        return text
    if field.default is None:
        return f"{text} (rate or burst)"
    return f"{text} ({_shown(field.name, field.default)} if left out)"


def _shown(key: str, value: Any) -> str:
    return f"0x{value:04X}" if key in _IN_HEX else f"{value:g}" if isinstance(value, float) else str(value)


def _named(fault: Mapping[str, Any]) -> str:
    """Return a fault as it is written on the command line."""
    own = [f"{key}={_shown(key, value)}" for key, value in fault.items() if key not in ("fault", "at", "lasts")]
    return " ".join([fault["fault"], *own])


def _mapping(name: str, pairs: Sequence[str], lasts: float | None) -> dict[str, Any]:
    """Return the fault of a command line as a script has it; raises CommandError."""
    mapping: dict[str, Any] = {"fault": name}
    for pair in pairs:
        key, _, value = pair.partition("=")
        if not key or not value:
            raise CommandError(f"{pair!r} is not KEY=VALUE, as after=3 or code=0x1A")
        if key in mapping:
            raise CommandError(f"{key} is given twice")
        mapping[key] = _value(value)
    if lasts is not None:
        if "lasts" in mapping:
            raise CommandError("lasts is given twice")
        mapping["lasts"] = lasts
    return mapping


def _value(written: str) -> int | float | str:
    """Return a number, decimal or as 0x1A, or the text itself."""
    if "_" in written or not written.isascii():
        return written
    for read in (int, lambda text: int(text, 16) if text[:2].lower() == "0x" else float(text)):
        try:
            return read(written)
        except ValueError:
            continue
    return written


def _client(path: Path | None) -> AbstractContextManager[SegmentClient]:
    from rtcp.virtual.faults.control import SegmentClient

    return connected(SegmentClient, path, segment_control(runtime_directory()), "virtual segment")
