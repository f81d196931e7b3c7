"""What drives hold beside their process data, for `rtcp scan --describe` and `rtcp doctor --drives`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rtcp.api import Robot
from rtcp.cli.bus import open_bus
from rtcp.cli.output import ExitCode, complain, emit, show, table
from rtcp.config.drive_limits import with_limits
from rtcp.config.model import SlaveConfig
from rtcp.config.scaling import OBJECTS_PER_AXIS
from rtcp.fieldbus.drive_settings import OBJECTS, Setting, Values, after_start, compare, settings_of
from rtcp.ipc.errors import Refused
from rtcp.launch.offline import OfflineBus, configuration

if TYPE_CHECKING:
    from rich.table import Table

_STATUSWORD = 0x6041


@dataclass(frozen=True)
class AxisSettings:
    """The settings of an axis of a drive, and their differences from what its joint needs, in sentences."""

    slave: str
    axis: int
    settings: Sequence[Setting]
    warnings: Sequence[str] = ()
    """Differences that are notes at the start."""
    refusals: Sequence[str] = ()
    """Differences with which `rtcp start` ends."""

    def as_json(self) -> dict[str, Any]:
        """Return its JSON form."""
        settings = [{**asdict(setting), "text": setting.text} for setting in self.settings]
        return {**asdict(self), "settings": settings}


def read_values(access: Robot | OfflineBus, axes: Mapping[Any, Sequence[int]]) -> Iterator[tuple[Any, int, Values]]:
    """Yield slave, axis and settings of the axes of slaves; raises RtcpError where the bus does not answer."""
    addresses = {
        slave: [(index + (n - 1) * OBJECTS_PER_AXIS, sub_index) for n in numbers for index, sub_index in OBJECTS]
        for slave, numbers in axes.items()
    }
    if isinstance(access, OfflineBus):
        found = access.read_objects(addresses)
    else:
        found = [[_read(access, slave, *at) for at in of_slave] for slave, of_slave in addresses.items()]
    for (slave, numbers), data in zip(axes.items(), found, strict=True):
        for at, number in enumerate(numbers):
            own = data[at * len(OBJECTS) : (at + 1) * len(OBJECTS)]
            yield slave, number, {place: value for place, value in zip(OBJECTS, own, strict=True) if value}


def _read(robot: Robot, slave: int, index: int, sub_index: int) -> bytes | None:
    try:
        return robot.sdo_read(slave, index, sub_index)
    except Refused as refused:
        if refused.reason != "sdo_aborted":
            raise
        return None


def settings_of_slave(
    access: OfflineBus, slave: Any, device: Mapping[str, Any], config: Path | None
) -> list[AxisSettings]:
    """Return the settings of each axis of a slave as they are; empty: it is no drive.

    Args:
        access: the bus, which has described the slave.
        slave: the slave, as `access` takes it.
        device: its description.
        config: the arm's file. Where it has this device at this place, the scale is that of its device file.
    """
    indices = {item["index"] for item in device["objects"]}
    axes = [n for n in range(1, 9) if _STATUSWORD + (n - 1) * OBJECTS_PER_AXIS in indices]
    if not axes:
        return []
    identity, slaves, position = device["identity"], with_limits(configuration(config)), access.position
    entry = slaves[position - 1] if position <= len(slaves) else None
    ids = identity["vendor_id"], identity["product_code"]
    if entry is not None and (entry.device.vendor_id, entry.device.product_id) != ids:
        entry = None
    known, name = None if entry is None else entry.device, str(device["name"])
    return [
        AxisSettings(name, n, settings_of(held, n, known, "rad" if entry is None else entry.unit_of(n)))
        for _, n, held in read_values(access, {slave: axes})
    ]


def settings_of_drives(bus: str | None, config: Path | None) -> list[AxisSettings]:
    """Return the settings of all drives of an arm as they are after the start, compared with what the joints need.

    Raises:
        CommandError: a signal ended the command.
        RtcpError: the bus cannot be opened, or does not answer.
    """
    drives = [
        slave for slave in with_limits(configuration(config)) if slave.device.kind == "cia402" and slave.device.coe
    ]
    with open_bus("doctor --drives", bus, config) as opened:
        by_address = {opened.slave(slave.name): slave for slave in drives}
        axes = {address: slave.device.axes for address, slave in by_address.items()}
        return [_compared(values, by_address[address], n) for address, n, values in read_values(opened.access, axes)]


def _compared(held: Values, slave: SlaveConfig, axis: int) -> AxisSettings:
    values = after_start(held, slave, axis)
    where = slave.name if slave.device.axes == (1,) else f"{slave.name}, axis {axis}"
    warnings, refusals = compare(
        values, slave.device, slave.needs_of(axis), where, slave.file or "its device file", axis
    )
    return AxisSettings(
        slave.name, axis, settings_of(values, axis, slave.device, slave.unit_of(axis)), warnings, refusals
    )


def settings_table(drives: Sequence[AxisSettings]) -> Table:
    """Return the settings as a table."""
    headings = ("drive", "object", "value", "setting, in SI units or in words")
    rows = table(headings, headings[:2], fill=headings[3], expand=True)
    for drive in drives:
        label = drive.slave if drive.axis == 1 else f"{drive.slave}, axis {drive.axis}"
        for setting in drive.settings:
            words = f"{setting.name}: {setting.scaled}" if setting.scaled else setting.name
            rows.add_row(label, setting.where, str(setting.raw), words)
    return rows


def show_drives(drives: Sequence[AxisSettings]) -> None:
    """Show the settings of an arm's drives, and their differences from what the joints need."""
    show(settings_table(drives))
    refusals = [text for drive in drives for text in drive.refusals]
    warnings = [text for drive in drives for text in drive.warnings]
    for text in refusals:
        complain(f"refused at the start: {text}")
    for text in warnings:
        complain(f"warning: {text}")
    if not refusals and not warnings:
        emit("The drives hold what their joints need.")


def exit_code(drives: Sequence[AxisSettings]) -> ExitCode:
    """Return the exit code that the differences mean."""
    if any(drive.refusals for drive in drives):
        return ExitCode.FAULT
    return ExitCode.REFUSED if any(drive.warnings for drive in drives) else ExitCode.DONE
