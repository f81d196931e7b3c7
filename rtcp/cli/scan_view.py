"""What `rtcp scan` draws: a table of the slaves, then for each what its EEPROM and its object dictionary tell."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rich import box
from rich.console import RenderableType
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

PDO_TITLES = (("outputs", "RxPDO"), ("inputs", "TxPDO"))


def picture(bus: str, slaves: Sequence[Mapping[str, Any]]) -> list[RenderableType]:
    """Return the overview and a part for each slave; `slaves` are `rtcp.fieldbus.bus.SlaveInfo` as dictionaries."""
    if not slaves:
        return [Text(f"{bus}: no slave answers")]
    return [_overview(bus, slaves), *(part for slave in slaves for part in _slave(slave))]


def _overview(bus: str, slaves: Sequence[Mapping[str, Any]]) -> Table:
    counted = "1 slave" if len(slaves) == 1 else f"{len(slaves)} slaves"
    table = Table(box=box.SIMPLE_HEAD, title=f"{bus}: {counted}", title_justify="left", show_edge=False)
    for heading in ("#", "station", "name", "state", "out bits", "in bits", "delay ns"):
        table.add_column(heading, justify="left" if heading in ("name", "state") else "right")
    for slave in slaves:
        table.add_row(
            str(slave.get("position", "-")),
            _hex(slave.get("station"), 4),
            Text(str(slave.get("name", "-"))),
            Text(str(slave.get("state", "-"))),
            str(slave.get("output_bits", "-")),
            str(slave.get("input_bits", "-")),
            str(slave.get("delay_ns", "-")) if slave.get("dc") else "no DC",
        )
    return table


def _slave(slave: Mapping[str, Any]) -> list[RenderableType]:
    """Return the part of one slave: its identity and hardware as lines, its PDO map as a table."""
    parts: list[RenderableType] = [
        Text(""),
        Text(f"{slave.get('position', '-')}  {slave.get('name', '-')}", "bold"),
        Padding(_facts(slave), (0, 0, 0, 3)),
    ]
    if slave.get("outputs") or slave.get("inputs"):
        parts.append(Padding(_pdo_map(slave), (0, 0, 0, 3)))
    return parts


def _facts(slave: Mapping[str, Any]) -> Table:
    table = Table.grid(padding=(0, 2))
    table.add_column(no_wrap=True)
    table.add_column()
    table.add_row(
        "identity",
        f"vendor {_hex(slave.get('vendor_id'))}, product {_hex(slave.get('product_code'))}, "
        f"revision {_hex(slave.get('revision'))}\nserial {slave.get('serial', '-')}, alias {slave.get('alias', '-')}",
    )
    code = slave.get("al_status_code")
    table.add_row(
        "state", f"{slave.get('state', '-')}" + (f", {_hex(code, 4)}: {slave.get('al_status')}" if code else "")
    )
    table.add_row("mailbox", _mailbox(slave.get("mailbox"), bool(slave.get("has_coe"))))
    managers = [
        f"SM{manager['number']} {_hex(manager['start'], 4)} {manager['length']} bytes, "
        f"control {_hex(manager['control'], 2)}{'' if manager['enabled'] else ', off'}"
        for manager in slave.get("sync_managers", [])
    ]
    if managers:
        table.add_row("sync", "\n".join(managers))
    table.add_row("FMMUs", str(slave.get("fmmus", "-")))
    clock = f"yes, {slave.get('delay_ns', '-')} ns from the reference" if slave.get("dc") else "none"
    table.add_row("clock", clock)
    ports = ", ".join(f"{port} {found}" for port, found in enumerate(slave.get("ports", [])))
    behind = "the master" if not slave.get("parent") else f"slave {slave['parent']}"
    table.add_row("ports", f"{ports or '-'}; behind {behind}")
    return table


def _mailbox(mailbox: object, has_coe: bool) -> str:
    if not isinstance(mailbox, dict):
        return "none"
    protocols = ", ".join(mailbox.get("protocols", [])) or ("CoE" if has_coe else "no protocol")
    return (
        f"{protocols}; to the slave {_hex(mailbox.get('receive_start'), 4)} {mailbox.get('receive_size')} bytes, "
        f"from it {_hex(mailbox.get('send_start'), 4)} {mailbox.get('send_size')} bytes"
    )


def _pdo_map(slave: Mapping[str, Any]) -> Table:
    table = Table(box=box.SIMPLE_HEAD, show_edge=False)
    for heading in ("PDO", "at", "object", "bits", "name"):
        table.add_column(heading, justify="right" if heading in ("at", "bits") else "left")
    for key, title in PDO_TITLES:
        offset = 0
        for pdo in slave.get(key, []):
            label = f"{title} {_hex(pdo['index'], 4)}"
            for entry in pdo["entries"]:
                name = entry["name"] if entry["index"] else "(padding)"
                table.add_row(
                    label,
                    f"{offset // 8}.{offset % 8}",
                    f"{_hex(entry['index'], 4)}:{entry['sub_index']}",
                    str(entry["bits"]),
                    Text(str(name)),
                )
                label = ""
                offset += int(entry["bits"])
    return table


def _hex(value: object, digits: int = 8) -> str:
    return f"0x{value:0{digits}X}" if isinstance(value, int) else "-"
