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
from rtcp.cli.output import CommandError, ExitCode, emit, emit_json, facts, interruptible, report, show, table, transfer
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
    with open_bus("scan", bus, config) as asked:
        slaves = asked.access.scan()
    if as_json:
        emit_json(slaves)
    else:
        show(*scan_tables(asked.name, slaves))


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
    number = parse_integer(password, "--password")
    with own_bus("foe read", bus, config) as (asked, access), transfer(f"reading {name}") as progress:
        data = access.foe_read(asked.position(slave), name, number, boot, progress)
    out.write_bytes(data)
    report(f"{len(data)} bytes written to {out}")


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
    number, data, name = parse_integer(password, "--password"), file.read_bytes(), name or file.name
    with own_bus("foe write", bus, config) as (asked, access), transfer(f"writing {name}", len(data)) as progress:
        position = asked.position(slave)
        access.foe_write(position, name, data, number, boot, progress)
    report(f"slave {position}: {len(data)} bytes written to its file {name}")


@eeprom.command("read")
def _eeprom_read(
    slave: SlaveName,
    out: Annotated[Path, option("--out", "FILE", "Where to put the image.")],
    bus: BusName = None,
    config: ConfigFile = None,
) -> None:
    """Read the whole EEPROM into a file."""
    with own_bus("eeprom read", bus, config) as (asked, access), transfer("reading", 1.0) as progress:
        image = access.eeprom_read(asked.position(slave), progress=progress)
    out.write_bytes(image)
    report(f"{len(image)} bytes written to {out}")


@eeprom.command("dump")
def _eeprom_dump(slave: SlaveName, bus: BusName = None, config: ConfigFile = None) -> None:
    """Show what the EEPROM says, and what is wrong in it."""
    from rtcp.esi.sii import check_sii, read_sii

    with own_bus("eeprom dump", bus, config) as (asked, access), transfer("reading", 1.0) as progress:
        position = asked.position(slave)
        image = access.eeprom_read(position, progress=progress)
    show(*_description(read_sii(image, f"slave {position}"), len(image)))
    for sentence in check_sii(image):
        emit(sentence)


@eeprom.command("write")
def _eeprom_write(
    slave: SlaveName,
    file: LocalFile,
    yes: Annotated[bool, option("--yes", "Do not ask.")] = False,
    other_device: Annotated[bool, option("--other-device", "Also an image of another vendor or product.")] = False,
    bus: BusName = None,
    config: ConfigFile = None,
) -> None:
    """Write an image into the EEPROM, word by word, each read back. A wrong image makes a slave useless."""
    image = file.read_bytes()
    with own_bus("eeprom write", bus, config) as (asked, access):
        position = asked.position(slave)
        with transfer("reading", 1.0) as progress:
            before = access.eeprom_read(position, progress=progress)
        for finding in _check_image(image, before, other_device):
            report(finding)
        if not yes:
            typer.confirm(f"Write {len(image)} bytes into the EEPROM of slave {position}?", abort=True)
        with transfer("writing", 1.0) as progress:
            written = access.eeprom_write(position, 0, image, progress)
    report(f"slave {position}: {written} words written and read back; switch it off and on to have it load them")


@alias.command("set")
def _alias_set(
    slave: SlaveName,
    number: Annotated[str, as_written("ALIAS", "0 for none, to 65535.")],
    bus: BusName = None,
    config: ConfigFile = None,
) -> None:
    """Write the station alias of a slave into its EEPROM."""
    from rtcp.esi.sii import crc
    from rtcp.fieldbus.eeprom import ALIAS_WORD, CHECKSUM_WORD

    value = parse_integer(number, "ALIAS")
    if not 0 <= value <= 0xFFFF:
        raise CommandError(f"alias {value} is not allowed: 0 to 65535")
    with own_bus("alias set", bus, config) as (asked, access):
        position = asked.position(slave)
        image = bytearray(access.eeprom_read(position, 2 * (CHECKSUM_WORD + 1)))
        image[2 * ALIAS_WORD : 2 * ALIAS_WORD + 2] = value.to_bytes(2, "little")
        image[2 * CHECKSUM_WORD] = crc(bytes(image[: 2 * CHECKSUM_WORD]))
        access.eeprom_write(position, 0, bytes(image))
    report(f"slave {position}: alias {value} written; switch it off and on to have it load it")


@commands.command("state")
def _state(
    slave: SlaveName,
    state: Annotated[str, typer.Argument(metavar="STATE", help=f"{', '.join(STATES)}.")],
    bus: BusName = None,
    config: ConfigFile = None,
) -> None:
    """Bring a slave to an AL state and leave it there; OP needs a cycle: `rtcp start`."""
    wanted = state.upper().replace("-", "")
    if wanted not in STATES:
        raise CommandError(f"state {state!r} is not known: {', '.join(STATES)}; OP needs a cycle: `rtcp start`")
    with own_bus("state", bus, config) as (asked, access):
        position = asked.position(slave)
        found = access.state(position, wanted)
    report(f"slave {position}: {found}")


@commands.command("capture")
def _capture(
    out: Annotated[Path, option("--out", "FILE.pcapng", "File for Wireshark or tshark.")],
    seconds: Annotated[float | None, option("--seconds", "Duration, s. Default: until Ctrl-C.")] = None,
    bus: BusName = None,
    config: ConfigFile = None,
) -> None:
    """Record the frames of the bus, beside the cycle of a running platform."""
    from rtcp.launch.capturing import Capture, place_of_bus

    positive("--seconds", seconds, "s")
    interface, pid = place_of_bus(bus, config)
    with Capture(interface, pid, out) as capture:
        report(f"capturing on {interface}; Ctrl-C ends it")
        counted = capture.wait(seconds)
    lost = f", {counted.lost} lost: the host was too slow" if counted.lost else ""
    report(f"{counted.frames} frames written to {out}{lost}")


def _describe(slave: str, bus: str | None, config: Path | None, as_json: bool) -> None:
    """Show what a slave tells of itself: identity, PDOs as they are assigned, object dictionary."""
    with (
        own_bus("scan --describe", bus, config) as (asked, access),
        transfer("reading", 1.0, quiet=as_json) as progress,
    ):
        device = access.describe(asked.position(slave), progress)
    if as_json:
        emit_json(device)
        return
    identity = device["identity"]
    emit(f"{device['name']}: vendor 0x{identity['vendor_id']:08X}, product 0x{identity['product_code']:08X}")
    headings = ("object", "bits", "type", "access", "name")
    objects = table(headings, headings[2:], fill="name", expand=True)
    for one in device["objects"]:
        for entry in one["entries"]:
            access_rights = "r" * entry["readable"] + "w" * entry["writable"]
            objects.add_row(
                f"0x{one['index']:04X}:{entry['sub_index']}",
                str(entry["bits"]),
                entry["type"],
                access_rights + (f" in {entry['write_states']}" if entry["write_states"] else ""),
                _plain(entry["name"] if entry["name"] in ("", one["name"]) else f"{one['name']}: {entry['name']}"),
            )
    show(*[one for one in (_pdo_table(device), objects) if one.row_count])


def _plain(text: str) -> str:
    """Return a slave's text, of which nothing is taken for markup."""
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
                held = robot.status().raw["bus"]
            if name in (None, held):
                raise CommandError(
                    f"the running platform (loop process {loop_process()}) holds the bus {held}, and `rtcp {command}` "
                    "would take its slaves from it: `rtcp stop` ends it",
                    ExitCode.REFUSED,
                )
        except NotRunning:
            refuse_second_platform()
        asked = offline_bus(name, config)
        assert isinstance(asked.access, OfflineBus)
        yield asked, asked.access


def _check_image(image: bytes, before: bytes, other_device: bool) -> tuple[str, ...]:
    """Return what is odd about an image; raises CommandError where it must not be written."""
    from rtcp.esi.sii import check_sii, crc, read_sii

    if len(image) > len(before) or len(image) % 2:
        raise CommandError(f"the image has {len(image)} bytes, the EEPROM has {len(before)}; an even number that fits")
    try:
        new, old = read_sii(image, "the image").identity, read_sii(before, "the EEPROM").identity
    except EsiError as error:
        raise CommandError(str(error)) from error
    if image[14] != (expected := crc(image[:14])):
        raise CommandError(
            f"the checksum in word 7 of the image is 0x{image[14]:02X}, of its content 0x{expected:02X}: it is damaged"
        )
    found, wanted = ((one.vendor_id, one.product_code) for one in (old, new))
    if found != wanted and not other_device:
        raise CommandError(
            f"the image is of vendor 0x{wanted[0]:08X}, product 0x{wanted[1]:08X}, the slave of vendor "
            f"0x{found[0]:08X}, product 0x{found[1]:08X}; --other-device writes it all the same",
            ExitCode.REFUSED,
        )
    return check_sii(image)


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
    made = _pdo_table(asdict(device))
    return [rows, made] if made.row_count else [rows]


def _pdo_table(device: Mapping[str, Any]) -> Table:
    made = table(("PDO", "SM", "object", "bits", "type", "name"), ("PDO", "object", "type", "name"))
    for title, pdos in (("RxPDO", device["rx_pdos"]), ("TxPDO", device["tx_pdos"])):
        for pdo in pdos:
            label = f"{title} 0x{pdo['index']:04X}"
            manager = "-" if pdo["sync_manager"] is None else str(pdo["sync_manager"])
            for entry in pdo["entries"]:
                kind, name = (entry["type"], _plain(entry["name"])) if entry["index"] else ("", "(padding)")
                at = f"0x{entry['index']:04X}:{entry['sub_index']}"
                made.add_row(label, manager, at, str(entry["bits"]), kind, name)
                label = manager = ""
    return made
