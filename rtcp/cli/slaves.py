"""`rtcp scan` and `capture`; and what needs the bus for itself: `rtcp foe`, `eeprom`, `alias`, `state`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rtcp.api import NotRunning
from rtcp.cli.arguments import AsJson, BusName, ConfigFile, as_written, option, positive
from rtcp.cli.bus import Bus, SlaveName, offline_bus, open_bus, parse_integer, scan_tables
from rtcp.cli.drive_settings import settings_of_slave, settings_table
from rtcp.cli.output import (
    CommandError,
    ExitCode,
    confirm,
    emit,
    emit_json,
    facts,
    interruptible,
    new_file,
    report,
    show,
    signals_raise,
    table,
    transfer,
)
from rtcp.cli.platform import connect, loop_process, refuse_second_platform
from rtcp.esi.model import EsiError
from rtcp.launch.offline import OfflineBus

if TYPE_CHECKING:
    from rich.console import RenderableType
    from rich.table import Table

    from rtcp.esi.model import Device

commands = typer.Typer()
foe = typer.Typer(name="foe", help="Read and write files of a slave (FoE).", no_args_is_help=True)
eeprom = typer.Typer(name="eeprom", help="Read and write the EEPROM of a slave (SII).", no_args_is_help=True)
alias = typer.Typer(name="alias", help="Station aliases.", no_args_is_help=True)
for _group in (foe, eeprom, alias):
    commands.add_typer(_group)

FileName = Annotated[str, as_written("NAME", "Name of the file in the slave.")]
Password = Annotated[str, option("--password", "N", "Password of the file, a number.")]
Boot = Annotated[bool, option("--boot", "In BOOT, as most slaves want it for their firmware.")]
EepromSize = Annotated[
    str | None,
    option("--size", "BYTES", "Size of the EEPROM. Default: as it says, at most 4096 under a wrong checksum."),
]
LocalFile = Annotated[Path, typer.Argument(metavar="FILE", exists=True, dir_okay=False, help="File to write.")]
STATES = ("INIT", "PREOP", "BOOT", "SAFEOP")


@commands.command("scan")
def _scan(
    bus: BusName = None,
    config: ConfigFile = None,
    describe: Annotated[str | None, option("--describe", "SLAVE", "All that this slave tells of itself.")] = None,
    as_json: AsJson = False,
) -> None:
    """Show the slaves: identity, state, PDO map, clocks and delays."""
    if describe is not None:
        _describe(describe, bus, config, as_json)
        return
    with open_bus("scan", bus, config) as opened:
        slaves = opened.access.scan()
    if as_json:
        emit_json(slaves)
    else:
        show(*scan_tables(opened.name, slaves))


@foe.command("read")
def _foe_read(
    slave: SlaveName,
    name: FileName,
    out: Annotated[Path, option("--out", "FILE", "Where to put it.")],
    password: Password = "0",
    boot: Boot = False,
    bus: BusName = None,
    config: ConfigFile = None,
) -> None:
    """Read a file of a slave."""
    number = _password(password)
    _check_name(name)
    with new_file(out) as file, own_bus("foe read", bus, config) as (opened, access):
        with transfer(f"reading {name}") as progress:
            data = access.foe_read(opened.slave(slave), name, number, boot, progress)
        file.write(data)
    report(f"{access.label}: {len(data)} bytes written to {out}")


@foe.command("write")
def _foe_write(
    slave: SlaveName,
    file: LocalFile,
    name: Annotated[str | None, option("--as", "NAME", "Name in the slave. Default: that of the file.")] = None,
    password: Password = "0",
    boot: Boot = False,
    bus: BusName = None,
    config: ConfigFile = None,
) -> None:
    """Write a file to a slave."""
    number, data, name = _password(password), file.read_bytes(), name or file.name
    _check_name(name)
    with own_bus("foe write", bus, config) as (opened, access):
        target = opened.slave(slave)
        half = f"slave {slave} may have half of its file {name}: write it again before it is switched off"
        with interruptible(f"interrupted: {half}"), transfer(f"writing {name}", len(data)) as progress:
            access.foe_write(target, name, data, number, boot, progress)
    report(f"{access.label}: {len(data)} bytes written to its file {name}")


@eeprom.command("read")
def _eeprom_read(
    slave: SlaveName,
    out: Annotated[Path, option("--out", "FILE", "Where to put the image.")],
    size: EepromSize = None,
    bus: BusName = None,
    config: ConfigFile = None,
) -> None:
    """Read the whole EEPROM into a file."""
    with new_file(out) as file, own_bus("eeprom read", bus, config) as (opened, access):
        with transfer("reading", 1.0) as progress:
            image = access.eeprom_read(opened.slave(slave), _size(size), progress)
        file.write(image)
    report(f"{access.label}: {len(image)} bytes written to {out}")


@eeprom.command("dump")
def _eeprom_dump(slave: SlaveName, bus: BusName = None, config: ConfigFile = None) -> None:
    """Show what the EEPROM says, and what is wrong in it."""
    from rtcp.esi.sii import check_sii, read_sii

    with own_bus("eeprom dump", bus, config) as (opened, access), transfer("reading", 1.0) as progress:
        image = access.eeprom_read(opened.slave(slave), progress=progress)
    show(*_description(read_sii(image, access.label), len(image)))
    for sentence in check_sii(image):
        emit(sentence)


@eeprom.command("write")
def _eeprom_write(
    slave: SlaveName,
    file: LocalFile,
    yes: Annotated[bool, option("--yes", "Do not ask.")] = False,
    other_device: Annotated[bool, option("--other-device", "Also an image of another vendor or product.")] = False,
    verbatim: Annotated[
        bool, option("--verbatim", "Also the image's serial number and alias. Default: the slave keeps its own.")
    ] = False,
    size: EepromSize = None,
    bus: BusName = None,
    config: ConfigFile = None,
) -> None:
    """Write an image into the EEPROM, word by word, each read back. A wrong image makes a slave useless."""
    from rtcp.esi.sii import HEADER_BYTES

    image, room = file.read_bytes(), _size(size)
    with own_bus("eeprom write", bus, config) as (opened, access):
        target = opened.slave(slave)
        before = access.eeprom_read(target, HEADER_BYTES)
        findings = _check_image(image, before, other_device, room)
        if not verbatim:
            image, kept = _keep_identity(image, before)
            report(kept)
        for finding in findings:
            report(finding)
        if not yes:
            confirm(f"Write {len(image)} bytes into the EEPROM of {access.label}?")
        with _interruptible_write(access), transfer("writing", 1.0) as progress:
            written = access.eeprom_write(target, before, image, progress)
    report(f"{access.label}: {written} words written and read back; switch it off and on to have it load them")


@alias.command("set")
def _alias_set(
    slave: SlaveName,
    number: Annotated[str, as_written("ALIAS", "0 for none, to 65535.")],
    yes: Annotated[bool, option("--yes", "Do not ask.")] = False,
    bus: BusName = None,
    config: ConfigFile = None,
) -> None:
    """Write the station alias of a slave into its EEPROM; no two slaves may have the same."""
    from rtcp.fieldbus.eeprom import alias_of, is_sound, with_alias

    value = parse_integer(number, "ALIAS")
    if not 0 <= value <= 0xFFFF:
        raise CommandError(f"alias {value} is not allowed: 0 to 65535")
    with own_bus("alias set", bus, config) as (opened, access):
        target = opened.slave(slave)
        beginnings = access.eeprom_beginnings(target)
        before = beginnings[access.position - 1]
        if not is_sound(before):
            raise CommandError(
                f"{access.label}: the checksum in word 7 of its EEPROM is wrong, and an alias would make it right over "
                "damaged content: write its image first, `rtcp eeprom write`",
                ExitCode.REFUSED,
            )
        for position, beginning in enumerate(beginnings, 1):
            if value and position != access.position and is_sound(beginning) and alias_of(beginning) == value:
                raise CommandError(
                    f"slave {position} has the station alias {value} already, and two of one alias are refused at the "
                    f"start: give {access.label} another one, or slave {position} first",
                    ExitCode.REFUSED,
                )
        if not yes:
            confirm(f"Write alias {value} in place of {alias_of(before)} into {access.label}?")
        with _interruptible_write(access):
            access.eeprom_write(target, before, with_alias(before, value))
    report(f"{access.label}: alias {value} written; switch it off and on to have it load it")


@commands.command("state")
def _state(
    slave: SlaveName,
    state: Annotated[str, typer.Argument(metavar="STATE", help=f"{', '.join(STATES)}.")],
    bus: BusName = None,
    config: ConfigFile = None,
) -> None:
    """Bring a slave to an AL state and leave it there; OP needs a cycle: `rtcp start`."""
    name = state.upper().replace("-", "")
    if name not in STATES:
        raise CommandError(f"state {state!r} is not known: {', '.join(STATES)}; OP needs a cycle: `rtcp start`")
    with own_bus("state", bus, config) as (opened, access):
        reached = access.state(opened.slave(slave), name)
    report(f"{access.label}: {reached}")


@commands.command("capture")
def _capture(
    out: Annotated[Path, option("--out", "FILE.pcapng", "File for Wireshark or tshark.")],
    seconds: Annotated[float | None, option("--seconds", "Duration, s. Default: until Ctrl-C or SIGTERM.")] = None,
    bus: BusName = None,
    config: ConfigFile = None,
) -> None:
    """Record the frames of the bus, beside the cycle of a running platform."""
    from rtcp.launch.capturing import Capture, place_of_bus

    positive("--seconds", seconds, "s")
    interface, pid = place_of_bus(bus, config)
    # SIGTERM and SIGHUP end it as Ctrl-C does: the file is complete.
    with signals_raise(), new_file(out) as file, Capture(interface, pid, file) as capture:
        report(f"capturing on {interface}; Ctrl-C ends it")
        counted = capture.wait(seconds)
    lost = f", {counted.lost} lost: the host was too slow" if counted.lost else ""
    report(f"{counted.frames} frames written to {out}{lost}")


def _describe(slave: str, bus: str | None, config: Path | None, as_json: bool) -> None:
    """Show a slave's description of itself: identity, assigned PDOs, object dictionary; a drive also its settings."""
    with (
        own_bus("scan --describe", bus, config) as (opened, access),
        transfer("reading", 1.0, quiet=as_json) as progress,
    ):
        device = access.describe(opened.slave(slave), progress)
        drives = settings_of_slave(access, opened.slave(slave), device, config)
    if as_json:
        emit_json({**device, "drives": [drive.as_json() for drive in drives]})
        return
    identity = device["identity"]
    emit(f"{device['name']}: vendor 0x{identity['vendor_id']:08X}, product 0x{identity['product_code']:08X}")
    headings = ("object", "bits", "type", "access", "name")
    objects = table(headings, headings[2:], fill="name", expand=True)
    for item in device["objects"]:
        for entry in item["entries"]:
            access_rights = "r" * entry["readable"] + "w" * entry["writable"]
            objects.add_row(
                f"0x{item['index']:04X}:{entry['sub_index']}",
                str(entry["bits"]),
                entry["type"],
                access_rights + (f" in {entry['write_states']}" if entry["write_states"] else ""),
                _plain(entry["name"] if entry["name"] in ("", item["name"]) else f"{item['name']}: {entry['name']}"),
            )
    show(*[rows for rows in (_pdo_table(device), objects, settings_table(drives)) if rows.row_count])


def _plain(text: str) -> str:
    """Return a slave's text with nothing in it read as markup."""
    from rich.markup import escape

    return escape(text)


@contextmanager
def own_bus(command: str, name: str | None, config: Path | None) -> Iterator[tuple[Bus, OfflineBus]]:
    """Yield the bus where no platform holds it.

    Raises:
        CommandError: the running platform holds it, or a signal ended the command.
    """
    with interruptible("interrupted: nothing is left running"):
        try:
            with connect(command) as robot:
                label = robot.status().raw["bus"]
            if name in (None, label):
                raise CommandError(
                    f"the running platform (loop process {loop_process()}) holds the bus {label}, and `rtcp {command}` "
                    "would take its slaves from it: `rtcp stop` ends it",
                    ExitCode.REFUSED,
                )
        except NotRunning:
            refuse_second_platform()
        opened = offline_bus(name, config)
        assert isinstance(opened.access, OfflineBus)
        yield opened, opened.access


@contextmanager
def _interruptible_write(access: OfflineBus) -> Iterator[None]:
    """Turn a signal during a write of an EEPROM into a CommandError about the state of the EEPROM."""
    state = f"the EEPROM of {access.label} may be half written, under a wrong checksum; `rtcp eeprom write` repairs it"
    with interruptible(f"interrupted: {state}"):
        yield


def _password(text: str) -> int:
    number = parse_integer(text, "--password")
    if not 0 <= number <= 0xFFFFFFFF:
        raise CommandError(f"--password {number} is not allowed: 0 to {0xFFFFFFFF}")
    return number


def _check_name(name: str) -> None:
    """Refuse the name of a file that no message can carry; raises CommandError."""
    try:
        name.encode()
    except UnicodeEncodeError as error:
        raise CommandError(f"the name {name!r} is not UTF-8; `--as` gives it another one in the slave") from error


def _size(text: str | None) -> int:
    """Return the size of an EEPROM, 0 where none was given; raises CommandError."""
    from rtcp.esi.sii import HEADER_BYTES, MAX_BYTES

    size = 0 if text is None else parse_integer(text, "--size")
    if text is not None and (size % 2 or not HEADER_BYTES <= size <= MAX_BYTES):
        raise CommandError(f"--size {size} is not allowed: an even number of bytes, {HEADER_BYTES} to {MAX_BYTES}")
    return size


def _check_image(image: bytes, before: bytes, other_device: bool, size: int) -> tuple[str, ...]:
    """Return warnings about an image.

    Args:
        image: the image.
        before: the first 128 bytes of the EEPROM.
        other_device: whether the image may be of another device.
        size: bytes of the EEPROM; 0: as many as it says itself.

    Raises:
        CommandError: the image must not be written.
    """
    from rtcp.esi.sii import HEADER_BYTES, SOEM_BYTES, check_sii, crc, read_sii
    from rtcp.fieldbus.eeprom import is_sound, size_of

    sound = is_sound(before)
    # The size in an image that is not sound is not reliable.
    size = size or (size_of(before) if sound else SOEM_BYTES)
    if not HEADER_BYTES <= len(image) <= size or len(image) % 2:
        raise CommandError(
            f"the image has {len(image)} bytes; allowed is an even number from {HEADER_BYTES} to {size}, which "
            f"{'the EEPROM has' if sound else 'counts under a wrong checksum'}; --size gives its size"
        )
    try:
        read_sii(image, "the image")
    except EsiError as error:
        raise CommandError(str(error)) from error
    if image[14] != (expected := crc(image[:14])):
        raise CommandError(
            f"the checksum in word 7 of the image is 0x{image[14]:02X}, of its content 0x{expected:02X}: it is damaged"
        )
    old, new = before[_DEVICE], image[_DEVICE]
    if old != new and not other_device and not _is_blank(old):
        raise CommandError(
            f"the image is of {_device_text(new)}, the slave of {_device_text(old)}; --other-device writes it "
            "all the same",
            ExitCode.REFUSED,
        )
    return check_sii(image)


_DEVICE, _SERIAL = slice(0x10, 0x18), slice(0x1C, 0x20)
"""Bytes of vendor and product, and of the serial number (ETG.1000.6, table 16)."""


def _device_text(identity: bytes) -> str:
    return f"vendor 0x{identity[3::-1].hex().upper()}, product 0x{identity[7:3:-1].hex().upper()}"


def _is_blank(data: bytes) -> bool:
    return set(data) <= {0x00} or set(data) <= {0xFF}


def _keep_identity(image: bytes, before: bytes) -> tuple[bytes, str]:
    """Return the image with serial number and alias of the EEPROM, where it has them, and a report on that."""
    from rtcp.fieldbus.eeprom import alias_of, is_sound, with_alias

    kept = []
    if before[_DEVICE] == image[_DEVICE] and not set(before[_SERIAL]) <= {0xFF}:
        image = image[: _SERIAL.start] + before[_SERIAL] + image[_SERIAL.stop :]
        kept.append(f"serial number {int.from_bytes(before[_SERIAL], 'little')}")
    if is_sound(before):
        image = with_alias(image, alias_of(before))
        kept.append(f"alias {alias_of(before)}")
    if len(kept) < 2:
        return image, f"kept: {kept[0] if kept else 'nothing'}; the rest is the image's, the EEPROM has none to keep"
    return image, f"kept: {' and '.join(kept)}; --verbatim writes those of the image"


def _description(device: Device, size: int) -> list[RenderableType]:
    """Return the tables of `rtcp eeprom dump`."""
    rows = facts()
    identity = device.identity
    rows.add_row("device", _plain(f"{device.name or '-'} ({device.type or 'no order code'})"))
    rows.add_row(
        "identity",
        f"vendor 0x{identity.vendor_id:08X}, product 0x{identity.product_code:08X}, revision "
        f"0x{identity.revision:08X}, serial {identity.serial}",
    )
    rows.add_row("EEPROM", f"{size} bytes, alias {device.station_alias}")
    box = device.mailbox
    names = [] if box is None else [n for n in ("coe", "foe", "eoe", "aoe", "soe", "voe") if getattr(box, n)]
    rows.add_row("mailbox", ", ".join(name[0].upper() + "o" + name[2].upper() for name in names) or "none")
    for n, manager in enumerate(device.sync_managers):
        rows.add_row(
            f"SM{n}",
            f"0x{manager.start:04X} {manager.length} bytes, control 0x{manager.control:02X}, "
            f"{manager.type.name.lower().replace('_', ' ')}",
        )
    rows.add_row("FMMUs", ", ".join(use.name.lower().replace("_", " ") for use in device.fmmus) or "none")
    for mode in device.dc_modes:
        rows.add_row("DC mode", _plain(f"{mode.name}: AssignActivate 0x{mode.assign_activate:04X}"))
    pdos = _pdo_table(asdict(device))
    return [rows, pdos] if pdos.row_count else [rows]


def _pdo_table(device: Mapping[str, Any]) -> Table:
    rows = table(("PDO", "SM", "object", "bits", "type", "name"), ("PDO", "object", "type", "name"))
    for title, pdos in (("RxPDO", device["rx_pdos"]), ("TxPDO", device["tx_pdos"])):
        for pdo in pdos:
            label = f"{title} 0x{pdo['index']:04X}"
            manager = "-" if pdo["sync_manager"] is None else str(pdo["sync_manager"])
            for entry in pdo["entries"]:
                kind, name = (entry["type"], _plain(entry["name"])) if entry["index"] else ("", "(padding)")
                at = f"0x{entry['index']:04X}:{entry['sub_index']}"
                rows.add_row(label, manager, at, str(entry["bits"]), kind, name)
                label = manager = ""
    return rows
