"""Writes the ESI file of a drive from its device description, for a slave of the segment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from rtcp.config.model import DeviceDescription, Pdo

_TYPES = {"bool": "BOOL", "int8": "SINT", "uint8": "USINT", "int16": "INT", "uint16": "UINT", "int32": "DINT",
          "uint32": "UDINT"}  # fmt: skip
_BITS = {"SINT": 8, "USINT": 8, "INT": 16, "UINT": 16, "DINT": 32, "UDINT": 32}
_RATIO = """<DataType><Name>RATIO</Name><BitSize>80</BitSize>
<SubItem><SubIdx>0</SubIdx><Name>Count</Name><Type>USINT</Type><BitSize>8</BitSize><BitOffs>0</BitOffs></SubItem>
<SubItem><SubIdx>1</SubIdx><Name>Above</Name><Type>UDINT</Type><BitSize>32</BitSize><BitOffs>16</BitOffs>
<Flags><Access>rw</Access></Flags></SubItem>
<SubItem><SubIdx>2</SubIdx><Name>Below</Name><Type>UDINT</Type><BitSize>32</BitSize><BitOffs>48</BitOffs>
<Flags><Access>rw</Access></Flags></SubItem></DataType>"""
Objects = Mapping[int, tuple[str, int] | tuple[int, int]]
"""By index: type and value of a variable, or the two parts of a ratio."""
TWO_AXIS: Objects = {
    index + shift: entry
    for shift in (0, 0x800)
    for index, entry in (
        (0x603F, ("UINT", 0)), (0x6076, ("UDINT", 40_000)), (0x608F, (131072, 1)), (0x6091, (50, 1)),
        (0x6098, ("SINT", 37)),
    )
}  # fmt: skip
SYNAPTICON: Objects = {
    0x603F: ("UINT", 0), 0x6076: ("UDINT", 640), 0x6091: (100, 1), 0x6098: ("SINT", 37),
    0x60A9: ("UDINT", 0x00B44700),
}  # fmt: skip
ARMS: dict[str, tuple[str, Objects, dict[str, object]]] = {
    "two-axis": ("two-axis-drive", TWO_AXIS, {"rated_torque": 40.0, "torque_ratio": 1.0}),
    "myactuator": ("myactuator-x6-60", {}, {"rated_torque": 9.5 * 2.1, "counts_per_turn": 131072.0}),
    "synapticon": ("synapticon-somanet", SYNAPTICON, {"counts_per_turn": 524288.0 * 100}),
}
"""Other arms by name: file of their drives, what these hold, options of the behaviour `cia402`."""


def write_esi(path: Path, device: DeviceDescription, objects: Objects) -> None:
    """Write the file; mapped objects need not be among `objects`, start-up SDOs are added."""
    entries = {sdo.index: (_TYPES[sdo.type], 0) for sdo in device.sdo if not sdo.sub_index} | dict(objects)
    mapped = {entry.index for pdo in (*device.rpdo, *device.tpdo) for entry in pdo.channels}
    listed = "".join(_object(index, entries[index]) for index in sorted(entries) if index not in mapped)
    path.write_text(f"""<?xml version="1.0"?>
<EtherCATInfo><Vendor><Id>{device.vendor_id}</Id><Name>Vendor</Name></Vendor>
<Descriptions><Devices><Device Physics="YY">
<Type ProductCode="#x{device.product_id:X}" RevisionNo="#x1">{device.name}</Type><Name>{device.name}</Name>
<Profile><ProfileNo>402</ProfileNo><Dictionary><DataTypes>{_RATIO}</DataTypes><Objects>{listed}</Objects></Dictionary>
</Profile><Fmmu>Outputs</Fmmu><Fmmu>Inputs</Fmmu><Fmmu>MBoxState</Fmmu>
<Sm StartAddress="#x1000" DefaultSize="128" ControlByte="#x26" Enable="1">MBoxOut</Sm>
<Sm StartAddress="#x1080" DefaultSize="128" ControlByte="#x22" Enable="1">MBoxIn</Sm>
<Sm StartAddress="#x1100" DefaultSize="64" ControlByte="#x64" Enable="1">Outputs</Sm>
<Sm StartAddress="#x1400" DefaultSize="64" ControlByte="#x20" Enable="1">Inputs</Sm>
{_pdos("RxPdo", 2, device.rpdo)}{_pdos("TxPdo", 3, device.tpdo)}
<Mailbox><CoE SdoInfo="1" PdoAssign="1" PdoConfig="1" CompleteAccess="{int(device.complete_access)}"/></Mailbox>
<Dc><OpMode><Name>DC</Name><AssignActivate>#x{device.assign_activate:X}</AssignActivate></OpMode></Dc>
</Device></Devices></Descriptions></EtherCATInfo>
""")


def _object(index: int, entry: tuple[str, int] | tuple[int, int]) -> str:
    kind, value = entry
    if isinstance(kind, int):
        parts = "".join(
            f"<SubItem><Name>{name}</Name><Info><DefaultData>{data.hex()}</DefaultData></Info></SubItem>"
            for name, data in (
                ("Count", b"\2"), ("Above", kind.to_bytes(4, "little")), ("Below", value.to_bytes(4, "little"))
            )
        )  # fmt: skip
        return (
            f"<Object><Index>#x{index:X}</Index><Name>Ratio</Name><Type>RATIO</Type><BitSize>80</BitSize>"
            f"<Info>{parts}</Info><Flags><Access>rw</Access></Flags></Object>"
        )
    data = value.to_bytes(_BITS[kind] // 8, "little").hex()
    return (
        f"<Object><Index>#x{index:X}</Index><Name>Object</Name><Type>{kind}</Type><BitSize>{_BITS[kind]}</BitSize>"
        f"<Info><DefaultData>{data}</DefaultData></Info><Flags><Access>rw</Access></Flags></Object>"
    )


def _pdos(tag: str, manager: int, pdos: Sequence[Pdo]) -> str:
    return "".join(
        f'<{tag} Sm="{manager}"><Index>#x{pdo.index:X}</Index><Name>PDO</Name>'
        + "".join(
            f"<Entry><Index>#x{entry.index:X}</Index><SubIndex>{entry.sub_index}</SubIndex>"
            f"<BitLen>{entry.length}</BitLen><Name>{entry.name}</Name><DataType>{_TYPES[entry.type]}</DataType></Entry>"
            if entry.index
            else f"<Entry><Index>0</Index><BitLen>{entry.length}</BitLen></Entry>"
            for entry in pdo.channels
        )
        + f"</{tag}>"
        for pdo in pdos
    )
