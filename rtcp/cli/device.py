"""`rtcp device`: what an ESI file holds, a device's file made of it, and that file compared with the bus."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rtcp.cli.arguments import AsJson, BusName, ConfigFile, option
from rtcp.cli.bus import open_bus, parse_integer
from rtcp.cli.output import CommandError, ExitCode, emit, emit_json, new_file, report, show, table, transfer
from rtcp.cli.slaves import own_bus

if TYPE_CHECKING:
    from rtcp.config.model import DeviceDescription, Pdo
    from rtcp.esi.model import Device, DeviceFile

EsiPath = Annotated[Path, typer.Argument(metavar="FILE", help="ESI file of the device's maker.")]
_SLOT = re.compile(r"(\d{1,3})=(\w+)")

commands = typer.Typer()
device = typer.Typer(name="device", help="Describe a device: from its ESI file, or from the bus.", no_args_is_help=True)
commands.add_typer(device)


@device.command("list")
def _list(
    file: EsiPath,
    older: Annotated[bool, option("--all", "Revisions that the file hides, too.")] = False,
    as_json: AsJson = False,
) -> None:
    """List the devices and modules of an ESI file."""
    content = _read(file)
    devices = [device for device in content.devices if older or not device.hidden]
    rows = [_facts(device) for device in devices]
    if as_json:
        modules = [{"ident": module.ident, "name": module.name} for module in content.modules]
        emit_json({"vendor_id": content.vendor_id, "vendor": content.vendor_name, "devices": rows, "modules": modules})
        return
    headings = ("product", "revision", "name", "kind", "out", "in", "mailbox", "clock", "slots")
    title = f"{content.vendor_name or file.name}, vendor 0x{content.vendor_id:08X}; process data in bits"
    overview = table(headings, ("kind", "mailbox", "clock"), title=title, fill="name", expand=True)
    for row in rows:
        numbers = [f"0x{row[key]:X}" for key in ("product", "revision")]
        texts = [str(row[key]) for key in ("name", "kind", "output_bits", "input_bits", "mailbox")]
        overview.add_row(*numbers, *texts, "yes" if row["dc"] else "no", str(row["slots"] or ""))
    parts = [overview]
    if content.modules:
        parts.append(table(("ident", "module"), ("module",)))
        for module in content.modules:
            parts[-1].add_row(f"0x{module.ident:08X}", module.name)
    show(*parts)
    if len(devices) < len(content.devices):
        report(f"{len(content.devices) - len(devices)} older revisions are not listed: --all")


def _facts(device: Device) -> dict[str, Any]:
    from rtcp.config.device_file import assigned, kind_of

    mailbox = device.mailbox
    protocols = () if mailbox is None else ("coe", "foe", "eoe", "aoe", "soe", "voe")
    return {
        "product": device.identity.product_code,
        "revision": device.identity.revision,
        "name": device.name,
        "kind": kind_of(device),
        "output_bits": sum(pdo.bits for pdo in assigned(device, outputs=True)),
        "input_bits": sum(pdo.bits for pdo in assigned(device, outputs=False)),
        "mailbox": " ".join(name for name in protocols if getattr(mailbox, name)),
        "dc": bool(device.dc_modes),
        "slots": len(device.slots),
    }


@device.command("new")
def _new(
    out: Annotated[Path, option("--out", "FILE", "The device's file to write, as config/devices/NAME.yaml.")],
    esi: Annotated[Path | None, option("--esi", "FILE", "ESI file of the device's maker.")] = None,
    sii: Annotated[Path | None, option("--sii", "FILE", "EEPROM image, as `rtcp eeprom read` writes it.")] = None,
    from_bus: Annotated[str | None, option("--from-bus", "BUS", "Ask a slave that is there; with --slave.")] = None,
    slave: Annotated[int | None, option("--slave", "N", "Its position on the cable, from 1.")] = None,
    product: Annotated[str | None, option("--product", "CODE", "Product code, where the file has several.")] = None,
    revision: Annotated[str | None, option("--revision", "NUMBER", "Revision. Default: the newest.")] = None,
    module: Annotated[list[str] | None, option("--module", "SLOT=IDENT", "Module in a slot; again for more.")] = None,
    kind: Annotated[str | None, option("--kind", "KIND", "Driver. Default: the one that fits.")] = None,
    config: ConfigFile = None,
) -> None:
    """Write a device's file that a person reads: process data with types and units, start-up SDOs, clocks, watchdog."""
    from rtcp.config.device_file import file_text
    from rtcp.config.loader import load_device
    from rtcp.esi.modules import assemble
    from rtcp.esi.reader import find_device

    sources = [name for name, value in (("--esi", esi), ("--sii", sii), ("--from-bus", from_bus)) if value is not None]
    if len(sources) != 1:
        raise CommandError(f"found {' and '.join(sources) or 'no source'}; give one of --esi, --sii, --from-bus")
    if (slave is None) is not (from_bus is None):
        raise CommandError("--from-bus and --slave belong together: which bus, and which position on its cable")
    if slave is not None and slave < 1:
        raise CommandError(f"--slave {slave} is not allowed: a position on the cable, from 1")
    chosen = _slots(module or ())
    with new_file(out) as file:
        if esi is not None:
            content = _read(esi)
            bare = find_device(content, product=_number("--product", product), revision=_number("--revision", revision))
            made = assemble(bare, content.modules, chosen) if bare.slots or chosen else bare
        elif chosen:
            raise CommandError("--module needs --esi: an EEPROM and a bus have no list of modules")
        else:
            made = _of_image(sii) if sii is not None else _of_bus(str(from_bus), slave or 0, config)
        text = file_text(made, kind)
        file.write(text.encode())
    load_device(out)
    marks = text.count("CHECK:")
    report(f"{out}: {made.name}" + (f"; lines marked CHECK, {marks} of them, need a person" if marks else ""))


@device.command("check")
def _check(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A device's file.")],
    bus: BusName = None,
    config: ConfigFile = None,
) -> None:
    """Check a device's file; with --bus compare it with the slaves of its identity that are there."""
    from rtcp.config.loader import load_device
    from rtcp.config.model import SlaveConfig
    from rtcp.devices.driver import DeviceError, make_driver

    described = load_device(file)
    try:
        make_driver(SlaveConfig(file.stem, described, str(file)), 1e-3)
    except DeviceError as error:
        raise CommandError(f"{file}: {error}") from error
    bits = ", ".join(f"{name} {sum(_bits(pdo) for pdo in pdos)} bits" for name, pdos in _images(described))
    report(f"{file}: {described.name}, kind {described.kind}, {bits}: no mistake in it")
    if bus is None:
        return
    with open_bus("device check", bus, config) as asked:
        slaves = asked.access.scan()
    same = [slave for slave in slaves if (slave["vendor_id"], slave["product_code"]) == _identity(described)]
    if not same:
        there = "; ".join(f"{slave['position']}: {slave['name']} {_identity_text(slave)}" for slave in slaves) or "none"
        raise CommandError(f"{asked.name}: no slave has {_identity_text(described)}; found are {there}", ExitCode.FAULT)
    differences = 0
    for slave in same:
        found = _differences(described, slave)
        differences += len(found)
        emit(
            f"slave {slave['position']} ({slave['name']}): "
            + ("as the file says" if not found else "\n  ".join(["", *found]).strip("\n"))
        )
    if differences:
        raise CommandError(f"{differences} differences", ExitCode.FAULT)


def _differences(described: DeviceDescription, slave: Mapping[str, Any]) -> list[str]:
    """Return a sentence for each thing in which a slave that answered a scan differs from a device's file."""
    differences = []
    if described.coe is not bool(slave["has_coe"]):
        differences.append(
            f"coe: the file says {str(described.coe).lower()}, the slave has {'CoE' if slave['has_coe'] else 'none'}"
        )
    if described.assign_activate and not slave["dc"]:
        differences.append(
            f"assign_activate: the file says 0x{described.assign_activate:04X}, the slave has no distributed clock"
        )
    for (key, pdos), direction in zip(_images(described), ("outputs", "inputs"), strict=True):
        file_entries = [(e.index, e.sub_index if e.index else 0, e.length) for pdo in pdos for e in pdo.channels]
        bus_entries = [(e["index"], e["sub_index"], e["bits"]) for pdo in slave[direction] for e in pdo["entries"]]
        if described.coe and file_entries != bus_entries:
            said = "will be written" if described.configurable_pdos else "cannot be written"
            found = f"the file has {_entries(file_entries)}; the slave has {_entries(bus_entries)}"
            differences.append(f"{key}: {found}; the mapping {said}")
    return differences


def _images(described: DeviceDescription) -> tuple[tuple[str, Sequence[Pdo]], ...]:
    return ("rpdo", described.rpdo), ("tpdo", described.tpdo)


def _bits(pdo: Pdo) -> int:
    return sum(entry.length for entry in pdo.channels)


def _entries(entries: Sequence[tuple[int, int, int]]) -> str:
    return ", ".join(f"0x{index:04X}:{sub}/{bits}" for index, sub, bits in entries) or "nothing"


def _identity(described: DeviceDescription) -> tuple[int, int]:
    return described.vendor_id, described.product_id


def _identity_text(of: DeviceDescription | Mapping[str, Any]) -> str:
    vendor, product = (of["vendor_id"], of["product_code"]) if isinstance(of, Mapping) else _identity(of)
    return f"vendor 0x{vendor:08X}, product 0x{product:08X}"


def _read(file: Path) -> DeviceFile:
    """Read an ESI file, say what was accepted of it with a warning; raises EsiError."""
    from rtcp.esi.reader import read_esi

    content = read_esi(file)
    for warning in content.warnings:
        report(f"warning: {warning}")
    return content


def _of_image(file: Path) -> Device:
    """Read an EEPROM image, say what is wrong in it; raises CommandError where it is none."""
    from rtcp.esi import sii

    image = file.read_bytes()
    if len(image) < sii.HEADER_BYTES or sii.crc(image[:14]) != image[14]:
        raise CommandError(f"{file}: it is no EEPROM image: too short, or the checksum of its first 14 bytes is wrong")
    for sentence in sii.check_sii(image):
        report(f"warning: {file}: {sentence}")
    return sii.read_sii(image, str(file))


def _of_bus(bus: str, slave: int, config: Path | None) -> Device:
    """Ask a slave what it is; raises as `own_bus`."""
    from pydantic import ConfigDict, TypeAdapter

    from rtcp.esi import model

    with own_bus("device new", bus, config) as (_, access), transfer("reading", 1.0) as progress:
        answer = access.describe(slave, progress)
    # Of a list: settings of an adapter do not reach a dataclass that is its own type.
    adapter = TypeAdapter(list[model.Device], config=ConfigDict(val_json_bytes="hex"))
    return adapter.validate_json(json.dumps([answer]))[0]


def _slots(given: Sequence[str]) -> dict[int, int]:
    chosen: dict[int, int] = {}
    for text in given:
        match = _SLOT.fullmatch(text)
        if match is None:
            raise CommandError(f"--module: found {text!r}, allowed is SLOT=IDENT, as 0=0x00009800")
        chosen[int(match[1])] = _number("--module", match[2]) or 0
    return chosen


def _number(name: str, text: str | None) -> int | None:
    return None if text is None else parse_integer(text, name)
