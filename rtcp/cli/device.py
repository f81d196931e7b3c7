"""`rtcp device`: list an ESI file, write a device's file from it, and compare that file with the bus."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rtcp.cli.arguments import AsJson, BusName, ConfigFile, option
from rtcp.cli.bus import open_bus, parse_integer
from rtcp.cli.output import CommandError, ExitCode, asking, emit, emit_json, new_file, report, show, table, transfer
from rtcp.cli.slaves import own_bus
from rtcp.launch.offline import OfflineBus

if TYPE_CHECKING:
    from rtcp.config.findings import Finding
    from rtcp.config.model import DeviceDescription, Pdo, PdoEntry, StartupSdo
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
    from rich.markup import escape

    content = _read(file)
    devices = [device for device in content.devices if older or not device.hidden]
    rows = [_facts(device) for device in devices]
    if as_json:
        modules = [{"ident": module.ident, "name": module.name} for module in content.modules]
        emit_json({"vendor_id": content.vendor_id, "vendor": content.vendor_name, "devices": rows, "modules": modules})
        return
    headings = ("product", "revision", "name", "kind", "out", "in", "mailbox", "clock", "slots")
    title = f"{escape(content.vendor_name or file.name)}, vendor 0x{content.vendor_id:08X}; process data in bits"
    overview = table(headings, ("kind", "mailbox", "clock"), title=title, fill="name", expand=True)
    for row in rows:
        numbers = [f"0x{row[key]:X}" for key in ("product", "revision")]
        texts = [escape(str(row[key])) for key in ("name", "kind", "output_bits", "input_bits", "mailbox")]
        overview.add_row(*numbers, *texts, "yes" if row["dc"] else "no", str(row["slots"] or ""))
    parts = [overview]
    if content.modules:
        parts.append(table(("ident", "module"), ("module",)))
        for module in content.modules:
            parts[-1].add_row(f"0x{module.ident:08X}", escape(module.name))
    show(*parts)
    if len(devices) < len(content.devices):
        report(f"{len(content.devices) - len(devices)} older revisions are not listed: --all")


def _facts(device: Device) -> dict[str, Any]:
    from rtcp.config.device_file import kind_of

    mailbox = device.mailbox
    protocols = () if mailbox is None else ("coe", "foe", "eoe", "aoe", "soe", "voe")
    return {
        "product": device.identity.product_code,
        "revision": device.identity.revision,
        "name": device.name,
        "kind": kind_of(device),
        "output_bits": sum(pdo.bits for pdo in device.assigned(outputs=True)),
        "input_bits": sum(pdo.bits for pdo in device.assigned(outputs=False)),
        "mailbox": " ".join(name for name in protocols if getattr(mailbox, name)),
        "dc": bool(device.dc_modes),
        "slots": len(device.slots),
    }


@device.command("new")
def _new(
    out: Annotated[
        Path | None, option("--out", "FILE", "The device's file to write, config/devices/NAME.yaml.")
    ] = None,
    esi: Annotated[Path | None, option("--esi", "FILE", "ESI file of the device's maker.")] = None,
    sii: Annotated[Path | None, option("--sii", "FILE", "EEPROM image, as `rtcp eeprom read` writes it.")] = None,
    from_bus: Annotated[str | None, option("--from-bus", "BUS", "Ask a slave that is there; with --slave.")] = None,
    slave: Annotated[int | None, option("--slave", "N", "Its position on the cable, from 1.")] = None,
    product: Annotated[str | None, option("--product", "CODE", "Product code, where the file has several.")] = None,
    revision: Annotated[str | None, option("--revision", "NUMBER", "Revision. Default: the newest.")] = None,
    choice: Annotated[
        int | None, option("--choice", "N", "Which of several devices that fit, from 1. Default: asks.")
    ] = None,
    module: Annotated[list[str] | None, option("--module", "SLOT=IDENT", "Module in a slot; again for more.")] = None,
    kind: Annotated[str | None, option("--kind", "KIND", "Driver. Default: the one that fits.")] = None,
    mode: Annotated[str | None, option("--mode", "NAME", "Clock mode, and the PDOs that it assigns.")] = None,
    samples: Annotated[
        int | None, option("--samples", "N", "Values a cycle (oversampling). Default: the mode's.")
    ] = None,
    pdo: Annotated[
        list[str] | None,
        option("--pdo", "INDEX", "PDO in place of the default ones; again for more; `list` shows all."),
    ] = None,
    config: ConfigFile = None,
) -> None:
    """Write a device's file that a person reads: process data with types and units, start-up SDOs, clocks, watchdog.

    A figure that the description lacks is a key without a value: the file is refused until it is filled in.
    """
    from rtcp.config.device_file import file_text
    from rtcp.esi.modules import assemble

    sources = [name for name, value in (("--esi", esi), ("--sii", sii), ("--from-bus", from_bus)) if value is not None]
    if len(sources) != 1:
        raise CommandError(f"found {' and '.join(sources) or 'no source'}; give one of --esi, --sii, --from-bus")
    if (slave is None) is not (from_bus is None):
        raise CommandError("--from-bus and --slave belong together: which bus, and which position on its cable")
    if slave is not None and slave < 1:
        raise CommandError(f"--slave {slave} is not allowed: a position on the cable, from 1")
    if samples is not None and mode is None:
        raise CommandError("--samples needs --mode: the clock mode that takes several values a cycle")
    if choice is not None and esi is None:
        raise CommandError("--choice needs --esi: an EEPROM and a slave are one device")
    chosen = _slots(module or ())
    lists, indices = (
        pdo == ["list"],
        () if pdo in (None, ["list"]) else tuple(_number("--pdo", text) or 0 for text in pdo),
    )
    if (out is None) is not lists:
        raise CommandError(
            "--out names the file to write" if out is None else "--pdo list writes no file: without --out"
        )

    def described() -> Device:
        if esi is not None:
            content = _read(esi)
            bare = choose(content, _number("--product", product), _number("--revision", revision), choice)
            return assemble(bare, content.modules, chosen) if bare.slots or chosen else bare
        if chosen:
            raise CommandError("--module needs --esi: an EEPROM and a bus have no list of modules")
        return _of_image(sii) if sii is not None else _of_bus(str(from_bus), slave or 0, config)

    if out is None:
        _show_pdos(described())
        return
    with new_file(out) as file:
        result = described()
        text = file_text(result, kind, mode, samples, indices)
        file.write(text.encode())
        file.flush()
        try:
            missing = _mistakes(out)
        except BaseException:
            file.truncate(0)  # and with that no file is left
            raise
    marks = text.count("CHECK:")
    report(f"{out}: {result.name}" + (f"; lines marked CHECK, {marks} of them, need a person" if marks else ""))
    if missing:
        listed = "".join(f"\n  {finding}" for finding in missing)
        report(f"it is refused until these {len(missing)} values are filled in; then: rtcp device check {out}{listed}")


def choose(content: DeviceFile, product: int | None, revision: int | None, choice: int | None) -> Device:
    """Return the device of a file; ask which, if several fit and someone can answer.

    Raises:
        LookupFailure: none or several fit.
    """
    from rtcp.esi.model import LookupFailure
    from rtcp.esi.reader import find_device

    try:
        return find_device(content, product=product, revision=revision, choice=choice)
    except LookupFailure as failure:
        if not failure.several or choice is not None or sys.stdin is None or not sys.stdin.isatty():
            hint = "; give one by --product, --revision or --choice" if failure.several else ""
            raise CommandError(f"{failure}{hint}") from failure
        for number, text in enumerate(failure.candidates, 1):
            emit(f"{number}: {text}")
        with asking("pass --choice"):
            choice = typer.prompt("Which of these devices", type=int)
    return find_device(content, product=product, revision=revision, choice=choice)


def _show_pdos(device: Device) -> None:
    """Print the PDOs that can be assigned, with their entries."""
    for direction, pdos in (("rpdo", device.rx_pdos), ("tpdo", device.tx_pdos)):
        for pdo in pdos:
            marks = [] if pdo.sync_manager is None else ["default"]
            marks += [word for word, holds in (("fixed", pdo.fixed), ("mandatory", pdo.mandatory)) if holds]
            if pdo.excludes:
                marks.append("excludes " + " ".join(f"0x{index:04X}" for index in sorted(pdo.excludes)))
            emit(f"{direction} 0x{pdo.index:04X} {pdo.name}, {pdo.bits} bits" + "".join(f"; {mark}" for mark in marks))
            for entry in pdo.entries:
                of = f"0x{entry.index:04X}:{entry.sub_index} {entry.name}" if entry.index else "padding"
                emit(f"    {of}, {entry.bits} bits {entry.type}".rstrip())


def _mistakes(file: Path) -> list[Finding]:
    """Check a device's file as `rtcp device check` does; return the values that are missing.

    Raises:
        ConfigError: it has other mistakes.
        CommandError: its driver refuses it.
    """
    from rtcp.config.model import ConfigError

    try:
        _checked(file)
    except ConfigError as error:
        if any(finding.code != "no_value" for finding in error.findings):
            raise
        return list(error.findings)
    return []


def _checked(file: Path) -> DeviceDescription:
    """Read a device's file and make its driver; raises ConfigError, CommandError."""
    from rtcp.config.loader import load_device
    from rtcp.config.model import SlaveConfig
    from rtcp.devices.driver import DeviceError, make_driver

    described = load_device(file)
    try:
        make_driver(SlaveConfig(file.stem, described, str(file)), 1e-3)
    except DeviceError as error:
        raise CommandError(f"{file}: {error}") from error
    return described


@device.command("check")
def _check(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A device's file.")],
    bus: BusName = None,
    config: ConfigFile = None,
) -> None:
    """Check a device's file; with --bus compare it with the slaves of its identity that are there."""
    described = _checked(file)
    bits = ", ".join(f"{name} {sum(_bits(pdo) for pdo in pdos)} bits" for name, pdos in _images(described))
    report(f"{file}: {described.name}, kind {described.kind}, {bits}: no mistake in it")
    if bus is None:
        return
    objects = _objects(described)
    lengths: dict[int, list[int | None]] = {}
    with open_bus("device check", bus, config) as link:
        slaves = link.access.scan()
        same = [slave for slave in slaves if (slave["vendor_id"], slave["product_code"]) == _identity(described)]
        for slave in same:
            # A running platform has written and read all of them at its start.
            if isinstance(link.access, OfflineBus) and described.coe and slave["has_coe"]:
                addresses = [(item.index, item.sub_index) for item in objects]
                lengths[slave["position"]] = link.access.object_lengths(slave["position"], addresses)
    if not same:
        there = "; ".join(f"{slave['position']}: {slave['name']} {_identity_text(slave)}" for slave in slaves) or "none"
        raise CommandError(f"{link.name}: no slave has {_identity_text(described)}; found are {there}", ExitCode.FAULT)
    differences = 0
    for slave in same:
        findings = _differences(described, slave)
        findings += _lacking(objects, lengths.get(slave["position"], []))
        differences += len(findings)
        emit(
            f"slave {slave['position']} ({slave['name']}): "
            + ("as the file says" if not findings else "\n  ".join(["", *findings]).strip("\n"))
        )
        if described.rpdo and slave["watchdog_off"]:
            managers = " and ".join(str(number) for number in slave["watchdog_off"])
            emit(
                f"  watchdog: its EEPROM leaves the process-data watchdog of sync manager {managers} off; it is "
                "switched on at the start"
            )
    if differences:
        raise CommandError(f"{differences} differences", ExitCode.FAULT)


def _differences(described: DeviceDescription, slave: Mapping[str, Any]) -> list[str]:
    """Return a sentence for each difference between a scanned slave and a device's file."""
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
        file_entries = [
            (e.index, e.sub_index if e.index else 0, e.length)
            for each in pdos
            for pdo in each.assigned
            for e in pdo.channels
        ]
        bus_entries = [(e["index"], e["sub_index"], e["bits"]) for pdo in slave[direction] for e in pdo["entries"]]
        if (described.coe or bus_entries) and file_entries != bus_entries:
            remark = "will be written" if described.coe and described.configurable_pdos else "cannot be written"
            comparison = f"the file has {_entries(file_entries)}; the slave has {_entries(bus_entries)}"
            differences.append(f"{key}: {comparison}; the mapping {remark}")
    return differences


@dataclass(frozen=True)
class _Object:
    """An object that a device's file names."""

    where: str
    """Key and object, in words."""
    index: int
    sub_index: int
    length: int | None
    """Length in bytes; None: any."""


def _objects(described: DeviceDescription) -> list[_Object]:
    """Return the objects that the start writes or maps: start-up SDOs, PDOs, and their entries."""
    objects = [
        _Object(f"sdo: {_object_text(sdo)}", sdo.index, sdo.sub_index, None if sdo.type == "bytes" else sdo.length)
        for sdo in described.sdo
        if not sdo.optional
    ]
    for key, pdos in _images(described):
        for pdo in dict.fromkeys(pdo for each in pdos for pdo in each.assigned):
            objects.append(_Object(f"{key}: PDO 0x{pdo.index:04X}", pdo.index, 0, 1))
            for entry in pdo.channels:
                length = None if entry.length % 8 else entry.length // 8
                if entry.index:
                    objects.append(_Object(f"{key}: {_object_text(entry)}", entry.index, entry.sub_index, length))
    return objects


def _object_text(of: PdoEntry | StartupSdo) -> str:
    return f"0x{of.index:04X}:{of.sub_index}" + (f" ({of.name})" if of.name else "")


def _lacking(objects: Sequence[_Object], lengths: Sequence[int | None]) -> list[str]:
    """Return a sentence for each object that a slave lacks, or has in another length."""
    sentences = []
    for item, length in zip(objects, lengths, strict=False):
        if length == -1:
            sentences.append(f"{item.where}: the slave has no such object")
        elif None not in (length, item.length) and length != item.length:
            sentences.append(f"{item.where}: the file says {item.length} bytes, the slave has {length}")
    return sentences


def _images(described: DeviceDescription) -> tuple[tuple[str, Sequence[Pdo]], ...]:
    return ("rpdo", described.rpdo), ("tpdo", described.tpdo)


def _bits(pdo: Pdo) -> int:
    return pdo.samples * sum(entry.length for entry in pdo.channels)


def _entries(entries: Sequence[tuple[int, int, int]]) -> str:
    return ", ".join(f"0x{index:04X}:{sub}/{bits}" for index, sub, bits in entries) or "nothing"


def _identity(described: DeviceDescription) -> tuple[int, int]:
    return described.vendor_id, described.product_id


def _identity_text(of: DeviceDescription | Mapping[str, Any]) -> str:
    vendor, product = (of["vendor_id"], of["product_code"]) if isinstance(of, Mapping) else _identity(of)
    return f"vendor 0x{vendor:08X}, product 0x{product:08X}"


def _read(file: Path) -> DeviceFile:
    """Read an ESI file and report what was accepted of it with a warning; raises EsiError."""
    from rtcp.esi.reader import read_esi

    content = read_esi(file)
    for warning in content.warnings:
        report(f"warning: {warning}")
    return content


def _of_image(file: Path) -> Device:
    """Read an EEPROM image and print its mistakes; raises EsiError, CommandError if the file is not an image."""
    from rtcp.esi import sii
    from rtcp.esi.xml_tree import read_file

    image = read_file(file, sii.MAX_BYTES)
    if len(image) < sii.HEADER_BYTES or sii.crc(image[:14]) != image[14]:
        raise CommandError(f"{file}: it is no EEPROM image: too short, or the checksum of its first 14 bytes is wrong")
    for sentence in sii.check_sii(image):
        report(f"warning: {file}: {sentence}")
    return sii.read_sii(image, str(file))


def _of_bus(bus: str, slave: int, config: Path | None) -> Device:
    """Read a slave's description from the bus; raises as `own_bus`."""
    from pydantic import ConfigDict, TypeAdapter

    from rtcp.esi import model

    with own_bus("device new", bus, config) as (_, access), transfer("reading", 1.0) as progress:
        answer = access.describe(slave, progress)
    # In a list: the settings of an adapter do not apply to a dataclass that is its own type.
    adapter = TypeAdapter(list[model.Device], config=ConfigDict(val_json_bytes="hex"))
    return adapter.validate_json(json.dumps([answer]))[0]


def _slots(texts: Sequence[str]) -> dict[int, int]:
    chosen: dict[int, int] = {}
    for text in texts:
        match = _SLOT.fullmatch(text)
        if match is None:
            raise CommandError(f"--module: found {text!r}, allowed is SLOT=IDENT, as 0=0x00009800")
        chosen[int(match[1])] = _number("--module", match[2]) or 0
    return chosen


def _number(name: str, text: str | None) -> int | None:
    return None if text is None else parse_integer(text, name)
