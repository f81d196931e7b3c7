"""`rtcp sdo`, and what commands for slaves share: the running platform's bus or one opened for a request, tables."""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from rtcp.api import NotRunning, Robot
from rtcp.cli.arguments import NUMBERS_AS_WRITTEN, BusName, ConfigFile, as_written, option
from rtcp.cli.output import CommandError, emit, facts, interruptible, report, table
from rtcp.cli.platform import connect, refuse_second_platform
from rtcp.config.model import BITS, VIRTUAL, integer_range
from rtcp.config.numbers import plain_number
from rtcp.launch import offline

if TYPE_CHECKING:
    from rich.console import RenderableType
    from rich.table import Table

FLOATS = {"float32": struct.Struct("<f"), "float64": struct.Struct("<d")}
TYPES = (*BITS, "string", "bytes")
_OBJECT = re.compile(r"(?:0x(?P<prefixed>[0-9a-f]+)|(?P<suffixed>[0-9][0-9a-f]*)h)(?::(?P<sub>\w+))?", re.IGNORECASE)

SlaveName = Annotated[str, as_written("SLAVE", "Position on the cable, from 1, or the configured name.")]
ObjectIndex = Annotated[str, as_written("INDEX[:SUB]", "Index in hex, as 0x6041 or 6041h; 0x1018:1 for a subindex.")]

commands = typer.Typer()
sdo = typer.Typer(name="sdo", help="Read and write objects of a slave.", no_args_is_help=True)
commands.add_typer(sdo)


@sdo.command("read")
def _sdo_read(
    slave: SlaveName,
    where: ObjectIndex,
    type_name: Annotated[str | None, option("--type", "TYPE", f"{', '.join(TYPES)}.")] = None,
    bus: BusName = None,
    config: ConfigFile = None,
) -> None:
    """Read an object; without --type its bytes in hex and as each type of that size."""
    index, subindex = parse_object(where)
    known = None if type_name is None else _checked_type(type_name)
    with open_bus("sdo read", bus, config) as opened:
        data = opened.access.sdo_read(opened.slave(slave), index, subindex)
    emit(interpretations(data) if known is None else decode(data, known))


@sdo.command("write", context_settings=NUMBERS_AS_WRITTEN)
def _sdo_write(
    slave: SlaveName,
    where: ObjectIndex,
    value: Annotated[list[str], as_written("VALUE")],
    type_name: Annotated[str, option("--type", "TYPE", f"{', '.join(TYPES)}.")],
    bus: BusName = None,
    config: ConfigFile = None,
) -> None:
    """Write an object."""
    if len(value) != 1:
        raise CommandError(f"found {len(value)} values: {' '.join(value)}; give one (quote a string)")
    index, subindex = parse_object(where)
    data = encode(value[0], _checked_type(type_name))
    with open_bus("sdo write", bus, config) as opened:
        opened.access.sdo_write(opened.slave(slave), index, subindex, data)
    report(f"slave {slave}, 0x{index:04X}:{subindex}: {data.hex(' ') or '(empty)'} written")


# -- access ---------------------------------------------------------------------------------------------------------


class Bus(NamedTuple):
    """An open bus: its name, its slaves by configured name (as `access` takes them), and its access."""

    name: str
    slaves: Mapping[str, int | str]
    access: Robot | offline.OfflineBus

    def slave(self, slave: str) -> Any:
        """Return a slave, by position or configured name, as `access` takes it; raises CommandError.

        A running platform has matched slaves and names, and takes positions; an offline bus looks the names up.
        """
        if slave.isdecimal() and len(slave) < 6 and int(slave) > 0:
            return int(slave)
        if slave not in self.slaves:
            known = ", ".join(self.slaves) or "none"
            raise CommandError(f"no slave is called {slave!r}: a position from 1, or one of {known}")
        return self.slaves[slave]


@contextmanager
def open_bus(command: str, name: str | None, config: Path | None) -> Iterator[Bus]:
    """Yield the running platform's bus where it is the requested one, else open the requested or configured one.

    Raises:
        CommandError: a signal ended the command; a started segment has ended.
        RtcpError: as the platform or the offline bus answers.
        ConfigError: the configuration is wrong.
    """
    with interruptible("interrupted: nothing is left running"):
        try:
            robot = connect(command)
        except NotRunning:
            refuse_second_platform()
            yield offline_bus(name, config)
            return
        with robot:
            status = robot.status().raw
            if name in (None, status["bus"]):
                positions = {slave["name"]: slave["position"] for slave in status["slaves"]}
                yield Bus(status["bus"], positions, robot)
            else:
                yield offline_bus(name, config)


def offline_bus(name: str | None, config: Path | None) -> Bus:
    """Return a bus that is opened for each question; raises ConfigError, RtcpError."""
    from rtcp.config.loader import segment_path
    from rtcp.virtual.segment import check_segment

    arm = offline.configuration(config)
    name = arm.bus.interface if name is None else name
    if name == VIRTUAL:
        check_segment(segment_path(arm))
    return Bus(name, {slave.name: slave.name for slave in arm.slaves}, offline.OfflineBus(name, config))


# -- objects as text (little endian on the wire) --------------------------------------------------------------------


def parse_object(text: str) -> tuple[int, int]:
    """Return index and subindex of `0x6041`, `6041h`, `0x1018:1` or `0x1018:0x01`; raises CommandError."""
    match = _OBJECT.fullmatch(text)
    if not match:
        raise CommandError(
            f"{text!r} is not an object: write the index in hex, as 0x6041 or 6041h, and 0x1018:1 for a subindex"
        )
    index = int(match["prefixed"] or match["suffixed"], 16)
    if index > 0xFFFF:
        raise CommandError(f"index 0x{index:X} is too large: at most 0xFFFF")
    subindex = parse_integer(match["sub"] or "0", "subindex")
    if not 0 <= subindex <= 0xFF:
        raise CommandError(f"subindex {subindex} is not allowed: 0 to 255")
    return index, subindex


def _checked_type(name: str) -> str:
    if name.lower() not in TYPES:
        raise CommandError(f"type {name!r} is not known: {', '.join(TYPES)}")
    return name.lower()


def encode(text: str, type_name: str) -> bytes:
    """Return the bytes of a value; raises CommandError where it does not fit the type."""
    if type_name == "string":
        return text.encode()
    if type_name == "bytes":
        try:
            return bytes.fromhex(text.removeprefix("0x"))
        except ValueError as error:
            raise CommandError(f"{text!r} is not bytes in hex, as 01ff") from error
    if type_name == "bool":
        if text.lower() not in ("0", "1", "true", "false"):
            raise CommandError(f"{text!r} does not fit bool: 0, 1, true or false")
        return bytes([text.lower() in ("1", "true")])
    try:
        if type_name in FLOATS:
            return FLOATS[type_name].pack(_finite(text, type_name))
        number = parse_integer(text, type_name)
        return number.to_bytes(BITS[type_name] // 8, "little", signed=type_name.startswith("int"))
    except OverflowError as error:
        span = "" if type_name in FLOATS else ": {} to {}".format(*integer_range(type_name))
        raise CommandError(f"{text} does not fit {type_name}{span}") from error


def decode(data: bytes, type_name: str) -> str:
    """Return the value of the bytes as text; raises CommandError where the type has another size."""
    if type_name == "string":
        return data.rstrip(b"\0").decode(errors="replace")
    if type_name == "bytes":
        return data.hex()
    if len(data) != (size := -(-BITS[type_name] // 8)):
        raise CommandError(
            f"the object has {len(data)} bytes ({data.hex() or 'none'}), {type_name} has {size}: choose another --type"
        )
    if type_name in FLOATS:
        return repr(*FLOATS[type_name].unpack(data))
    number = int.from_bytes(data, "little", signed=type_name.startswith("int"))
    return str(bool(number)).lower() if type_name == "bool" else str(number)


def interpretations(data: bytes) -> str:
    """Return the bytes in hex, as integers of that size, and, if all of it is printable, as text."""
    parts = [data.hex(" ") or "(empty)"]
    if f"uint{8 * len(data)}" in BITS:
        unsigned, signed = (int.from_bytes(data, "little", signed=signed) for signed in (False, True))
        parts.append(f"uint{8 * len(data)} {unsigned} (0x{unsigned:0{2 * len(data)}X})")
        if signed < 0:
            parts.append(f"int{8 * len(data)} {signed}")
    text = data.rstrip(b"\0")
    if len(text) > 1 and all(0x20 <= byte < 0x7F for byte in text):
        parts.append(f"string {text.decode()!r}")
    return "   ".join(parts)


def _finite(text: str, type_name: str) -> float:
    try:
        number = plain_number(text)
    except ValueError as error:
        raise CommandError(f"{text!r} is not a number ({type_name})") from error
    if not math.isfinite(number):
        raise CommandError(f"{text} is not finite; a finite {type_name} is needed")
    return number


def parse_integer(text: str, name: str) -> int:
    """Return a whole number written in decimal or, after 0x, in hex; raises CommandError."""
    try:
        if "_" in text or not text.isascii():
            raise ValueError
        return int(text, 16) if text.lower().lstrip("+-").startswith("0x") else int(text)
    except ValueError as error:
        raise CommandError(f"{text!r} is not a whole number ({name})") from error


# -- tables of a scan -----------------------------------------------------------------------------------------------


def scan_tables(bus: str, slaves: Sequence[Mapping[str, Any]]) -> list[RenderableType]:
    """Return the overview, and for each slave its facts and its PDO map."""
    from rich.padding import Padding
    from rich.text import Text

    if not slaves:
        return [Text(f"{bus}: no slave answers")]
    counted = "1 slave" if len(slaves) == 1 else f"{len(slaves)} slaves"
    headings = ("#", "behind", "name", "state", "out", "in", "delay ns", "errors")
    overview = table(headings, ("behind", "name", "state"), title=f"{bus}: {counted}")
    parts: list[RenderableType] = [overview]
    for slave, branch in zip(slaves, _branches(slaves), strict=True):
        overview.add_row(
            str(slave["position"]),
            f"{slave['parent']} port {slave['parent_port']}" if slave["parent"] else "master",
            Text("  " * branch + str(slave["name"])),
            str(slave["state"]),
            str(slave["output_bits"]),
            str(slave["input_bits"]),
            _delay(slave) if slave["dc"] else "no DC",
            str(sum(slave["port_errors"]["rx"]) + sum(slave["port_errors"]["links"])),
        )
        parts += [Text(""), Text(f"{slave['position']}  {slave['name']}", "bold")]
        parts += [Padding(facts, (0, 0, 0, 3)) for facts in (_slave_facts(slave), _pdo_map(slave)) if facts.row_count]
    return parts


def _delay(slave: Mapping[str, Any]) -> str:
    return "unknown" if slave["delay_ns"] is None else str(slave["delay_ns"])


def _branches(slaves: Sequence[Mapping[str, Any]]) -> list[int]:
    """Return the number of branches that lead to each slave; a junction's last branch adds none."""
    last = {slave["parent"]: slave["position"] for slave in slaves}
    levels: dict[int, int] = {0: 0}
    for slave in slaves:
        parent, position = slave["parent"], slave["position"]
        levels[position] = levels.get(parent, 0) + (parent != 0 and last[parent] != position)
    return [levels[slave["position"]] for slave in slaves]


def _port(slave: Mapping[str, Any], port: int) -> str:
    errors = slave["port_errors"]
    counted = [
        f"{count} {singular if count == 1 else plural}"
        for count, singular, plural in (
            (errors["rx"][port], "damaged frame", "damaged frames"),
            (errors["forwarded"][port], "forwarded error", "forwarded errors"),
            (errors["links"][port], "lost link", "lost links"),
        )
        if count
    ]
    return f"{port} {slave['ports'][port]}" + (f" ({', '.join(counted)})" if counted else "")


def _slave_facts(slave: Mapping[str, Any]) -> Table:
    rows = facts()
    vendor, product, revision = (_hex(slave[key]) for key in ("vendor_id", "product_code", "revision"))
    identity = f"vendor {vendor}, product {product}, revision {revision}"
    station = _hex(slave["station"], 4)
    rows.add_row("identity", f"{identity}\nserial {slave['serial']}, alias {slave['alias']}, station {station}")
    code = slave["al_status_code"]
    rows.add_row("state", f"{slave['state']}" + (f", {_hex(code, 4)}: {slave['al_status']}" if code else ""))
    rows.add_row("mailbox", _mailbox(slave["mailbox"], bool(slave["has_coe"])))
    managers = [
        f"SM{manager['number']} {_hex(manager['start'], 4)} {manager['length']} bytes, "
        f"control {_hex(manager['control'], 2)}{'' if manager['enabled'] else ', off'}"
        for manager in slave["sync_managers"]
    ]
    if managers:
        rows.add_row("sync", "\n".join(managers))
    rows.add_row("FMMUs", str(slave["fmmus"]))
    rows.add_row("clock", f"yes, {_delay(slave)} ns from the reference" if slave["dc"] else "none")
    ports = ", ".join(_port(slave, port) for port in range(len(slave["ports"])))
    behind = f"slave {slave['parent']}, port {slave['parent_port']}" if slave["parent"] else "the master"
    rows.add_row("ports", f"{ports or '-'}; behind {behind}")
    return rows


def _mailbox(mailbox: Mapping[str, Any] | None, has_coe: bool) -> str:
    if mailbox is None:
        return "none"
    protocols = ", ".join(mailbox["protocols"]) or ("CoE" if has_coe else "no protocol")
    return (
        f"{protocols}; to the slave {_hex(mailbox['receive_start'], 4)} {mailbox['receive_size']} bytes, "
        f"from it {_hex(mailbox['send_start'], 4)} {mailbox['send_size']} bytes"
    )


def _pdo_map(slave: Mapping[str, Any]) -> Table:
    from rich.text import Text

    rows = table(("PDO", "at", "object", "bits", "name"), ("PDO", "object", "name"))
    for direction, title in (("outputs", "RxPDO"), ("inputs", "TxPDO")):
        offset = 0
        for pdo in slave[direction]:
            label = f"{title} {_hex(pdo['index'], 4)}"
            for entry in pdo["entries"]:
                rows.add_row(
                    label,
                    f"{offset // 8}.{offset % 8}",
                    f"{_hex(entry['index'], 4)}:{entry['sub_index']}",
                    str(entry["bits"]),
                    Text(str(entry["name"]) if entry["index"] else "(padding)"),
                )
                label = ""
                offset += int(entry["bits"])
    return rows


def _hex(value: int, digits: int = 8) -> str:
    return f"0x{value:0{digits}X}"
