"""`rtcp scan`, `rtcp sdo` and `rtcp segment`: the slaves themselves, with a platform running or without."""

from __future__ import annotations

from typing import Annotated

import typer

from rtcp.cli import sdo_value, segment
from rtcp.cli.arguments import NUMBERS_AS_WRITTEN, refuse_options
from rtcp.cli.bus_access import bus_access, position_of
from rtcp.cli.errors import CommandError
from rtcp.cli.options import BusName, ConfigFile, ObjectIndex, SlaveName
from rtcp.cli.output import emit, emit_json, report, show

SDO_WRITE_OPTIONS = ("--type", "--bus", "--config", "--help", "-h")


def register(app: typer.Typer) -> None:
    """Add this group's commands."""
    app.command("scan")(_scan)
    segment.register(app)
    sdo = typer.Typer(help="Read and write objects of a slave.", no_args_is_help=True)
    sdo.command("read")(_sdo_read)
    sdo.command("write", context_settings=NUMBERS_AS_WRITTEN)(_sdo_write)
    app.add_typer(sdo, name="sdo")


def _scan(
    bus: BusName = None,
    config: ConfigFile = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON array.")] = False,
) -> None:
    """Show the slaves: identity, state, PDO map, clocks and delays."""
    with bus_access("scan", bus, config) as access:
        slaves = access.scan()
    if as_json:
        emit_json(slaves)
        return
    from rtcp.cli.scan_view import picture

    show(*picture(access.name, slaves))


def _sdo_read(
    slave: SlaveName,
    where: ObjectIndex,
    type_name: Annotated[
        str | None, typer.Option("--type", metavar="TYPE", help=f"{', '.join(sdo_value.TYPES)}.")
    ] = None,
    bus: BusName = None,
    config: ConfigFile = None,
) -> None:
    """Read an object; without --type its bytes in hex and what they may mean."""
    index, subindex = sdo_value.parse_object(where)
    known = None if type_name is None else sdo_value.check_type(type_name)
    with bus_access("sdo read", bus, config) as access:
        data = access.sdo_read(position_of(slave, access), index, subindex)
    emit(sdo_value.guesses(data) if known is None else sdo_value.decode(data, known))


def _sdo_write(
    slave: SlaveName,
    where: ObjectIndex,
    value: Annotated[list[str], typer.Argument(metavar="VALUE")],
    type_name: Annotated[str, typer.Option("--type", metavar="TYPE", help=f"{', '.join(sdo_value.TYPES)}.")],
    bus: BusName = None,
    config: ConfigFile = None,
) -> None:
    """Write an object."""
    refuse_options([slave, where, *value], SDO_WRITE_OPTIONS)
    if len(value) != 1:
        raise CommandError(f"one value is written at a time, found {len(value)}: {' '.join(value)} (quote a string)")
    index, subindex = sdo_value.parse_object(where)
    data = sdo_value.encode(value[0], sdo_value.check_type(type_name))
    with bus_access("sdo write", bus, config) as access:
        position = position_of(slave, access)
        access.sdo_write(position, index, subindex, data)
    report(f"slave {position}, 0x{index:04X}:{subindex}: {data.hex(' ') or '(empty)'} written")
