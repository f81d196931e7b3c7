"""`rtcp device`: what an ESI file holds, a device's file made of it, and that file compared with the bus."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rtcp.cli.arguments import AsJson, BusName, ConfigFile, option
from rtcp.cli.bus import bus_access
from rtcp.cli.output import CommandError, ExitCode, emit_json, report, show, table
from rtcp.config.numbers import plain_number

if TYPE_CHECKING:
    from rich.table import Table

    from rtcp.esi.model import Device, DeviceFile

EsiFile = Annotated[Path, typer.Argument(metavar="FILE", help="ESI file (XML) of the device's maker.")]
_SLOT = re.compile(r"(\d{1,3})=(\w+)")

commands = typer.Typer()
device = typer.Typer(name="device", help="Describe a device: from its ESI file or the bus to a file of ours.", no_args_is_help=True)
commands.add_typer(device)


@device.command("list")
def _list(file: EsiFile, hidden: Annotated[bool, option("--all", "Older revisions too.")] = False, as_json: AsJson = False) -> None:
    """List the devices and modules of an ESI file."""
    found = _read(file)
    shown = [one for one in found.devices if hidden or not one.hidden]
    if as_json:
        emit_json({"devices": [_facts(one) for one in shown], "modules": [{"ident": m.ident, "name": m.name} for m in found.modules]})
        return
    rows = table(("product", "revision", "name", "kind", "out bits", "in bits", "mailbox", "DC", "slots"), ("name", "kind", "mailbox", "DC"),
                 title=f"{found.vendor_name or file.name} (vendor 0x{found.vendor_id:08X})")  # fmt: skip
    for one in shown:
        facts = _facts(one)
        rows.add_row(
            f"0x{facts['product']:08X}", f"0x{facts['revision']:08X}", facts["name"], facts["kind"],
            str(facts["output_bits"]), str(facts["input_bits"]), facts["mailbox"], "yes" if one.dc_modes else "no",
            str(len(one.slots)) if one.slots else "",
        )  # fmt: skip
    parts = [rows] if shown else []
    if found.modules:
        modules = table(("ident", "module"), ("module",))
        for module in found.modules:
            modules.add_row(f"0x{module.ident:08X}", module.name)
        parts.append(modules)
    show(*parts)
    older = len(found.devices) - len(shown)
    if older:
        report(f"{older} older revisions are not listed: --all")
