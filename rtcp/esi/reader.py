"""ESI files (ETG.2000): their devices and modules, and what is looked up among them.

What real files get wrong is accepted with a warning wherever the meaning is clear; a device that cannot be understood
is left out with its reason, and the others are read.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

from rtcp.esi import types
from rtcp.esi.model import (
    Coe,
    DcMode,
    Device,
    DeviceFile,
    DictionaryObject,
    EsiError,
    FmmuUse,
    Identity,
    InitCommand,
    LookupFailure,
    Mailbox,
    Module,
    ObjectCode,
    ObjectEntry,
    Pdo,
    PdoEntry,
    Slot,
    Source,
    SyncManager,
    SyncManagerType,
)
from rtcp.esi.xml_tree import Node, Warnings, read_trees

ENGLISH = "1033"
"""LcId of English."""
SLOT_LIMIT = 1024
"""Places for modules of one slot element."""
_MAX_ENTRY_BITS = 8 * 1486
_HEXADECIMAL = re.compile(r"#?x+(?:0x)?([0-9a-f]{1,16})|#([0-9a-f]{1,16})|0x([0-9a-f]{1,16})", re.IGNORECASE)
_DECIMAL = re.compile(r"[+-]?\d{1,20}")
_TRUE = {"1": True, "true": True, "0": False, "false": False, "": False}
_SYNC_MANAGERS = {
    "mboxout": SyncManagerType.MAILBOX_RECEIVE,
    "mboxin": SyncManagerType.MAILBOX_SEND,
    "outputs": SyncManagerType.OUTPUTS,
    "inputs": SyncManagerType.INPUTS,
}
_CONTROL = {1: 0x26, 2: 0x22, 3: 0x64, 4: 0x20}
"""Control byte of a sync manager's type, where none is given (ETG.1000.4, table 59)."""
_FMMUS = {
    "outputs": FmmuUse.OUTPUTS,
    "inputs": FmmuUse.INPUTS,
    "mboxstate": FmmuUse.MAILBOX_STATE,
    "": FmmuUse.UNUSED,
}
_FMMU_OF = {SyncManagerType.OUTPUTS: FmmuUse.OUTPUTS, SyncManagerType.INPUTS: FmmuUse.INPUTS}
_STATES = (("PREOP", "P"), ("SAFEOP", "S"), ("OP", "O"))
_T = TypeVar("_T")


def number(text: str) -> int | None:
    """Return an integer of an ESI file: `#x1A`, `0x1A`, `26`, `#x0x1A`; None: it is none."""
    text = text.strip()
    if _DECIMAL.fullmatch(text):
        return int(text)
    if match := _HEXADECIMAL.fullmatch(text):
        return int(match[1] or match[2] or match[3], 16)
    return None


def name_of(node: Node, tag: str = "Name") -> str:
    """Return a name in English; in the language without a number, or the first, where there is none in English."""
    names = node.all(tag)
    for language in (ENGLISH, None, "0"):
        for name in names:
            if name.attributes.get("LcId") == language and name.text:
                return name.text
    return next((name.text for name in names if name.text), "")


@dataclass(frozen=True)
class _Hiding:
    """A revision that a device hides."""

    by: tuple[int, int]
    type: str
    product: int | None
    revision: int | None


class _Reader:
    """Builds devices and modules from their trees."""

    def __init__(self, path: Path) -> None:
        self.path = str(path)
        self.warnings = Warnings(self.path)
        self.vendor_id = 0
        self.vendor_name = ""
        self.groups: dict[str, str] = {}
        self.devices: list[Device] = []
        self.modules: list[Module] = []
        self.failures: list[str] = []
        self.hidings: list[_Hiding] = []

    def collect(self, node: Node) -> None:
        """Take a tree of the file."""
        try:
            if node.tag == "Vendor":
                self.vendor_id = self.number(node, "Id", default=0) & 0xFFFFFFFF
                self.vendor_name = name_of(node)
            elif node.tag == "Group":
                self.groups[node.value("Type")] = name_of(node)
            elif node.tag == "Device":
                self.devices.append(self.device(node))
            else:
                self.modules.append(self.module(node))
        except EsiError as error:
            self.failures.append(str(error))

    def file(self) -> DeviceFile:
        """Return what has been read."""
        devices = [
            replace(device, hidden=True) if any(_hides(hiding, device) for hiding in self.hidings) else device
            for device in self.devices
        ]
        return DeviceFile(
            path=self.path,
            vendor_id=self.vendor_id,
            vendor_name=self.vendor_name,
            devices=tuple(devices),
            modules=tuple(self.modules),
            warnings=self.warnings.all(),
            failures=tuple(self.failures),
        )

    # Values

    def error(self, node: Node, problem: str) -> EsiError:
        return EsiError(f"{self.path}:{node.line}", problem)

    def _number(self, node: Node, what: str, text: str | None, default: int | None) -> int:
        if text is not None and (value := number(text)) is not None:
            return value
        if default is None:
            problem = f"{what} is missing" if not text else f"{what} is {text[:40]!r}, not a number"
            raise self.error(node, f"{node.tag}: {problem}")
        if text:
            self.warnings.add(node.line, f"{node.tag}: {what} is {text[:40]!r}, not a number; {default} is used")
        return default

    def number(self, node: Node, tag: str, default: int | None = None) -> int:
        """Return the number of a child; without a default it must be there."""
        return self._number(node, tag, node.value(tag), default)

    def attribute(self, node: Node, name: str, default: int | None = None) -> int:
        """Return the number of an attribute; without a default it must be there."""
        return self._number(node, name, node.attributes.get(name), default)

    def flag(self, node: Node | None, name: str, default: bool = False) -> bool:
        """Return whether an attribute is set."""
        if node is None or name not in node.attributes:
            return default
        text = node.attributes[name].strip().lower()
        if text not in _TRUE:
            value = number(text)
            self.warnings.add(node.line, f"{node.tag}: {name} is {text[:40]!r}, neither true nor false")
            return bool(value and value & 1)
        return _TRUE[text]

    def data(self, node: Node | None, tag: str, limit: int = 1 << 16) -> bytes:
        """Return the bytes of a child in hexadecimal; as far as they are some."""
        child = node.first(tag) if node is not None else None
        if child is None or not child.text:
            return b""
        text = re.sub(r"[\s,]|#x|0x", "", child.text, flags=re.IGNORECASE)
        if match := re.match(r"(?:[0-9a-fA-F]{2})*", text):
            if len(match[0]) != len(text):
                self.warnings.add(
                    child.line, f"{tag} is {child.text[:40]!r}, not bytes in hexadecimal; read up to there"
                )
            return bytes.fromhex(match[0])[:limit]
        return b""

    def each(self, nodes: Iterable[Node], build: Callable[[Node], _T | None]) -> tuple[_T, ...]:
        """Return what is built of each node; those of which nothing can be are left out."""
        return tuple(item for item in map(build, nodes) if item is not None)

    def within(self, node: Node, what: str, value: int, limit: int) -> int:
        """Return a value that must be 0 to a limit."""
        if not 0 <= value <= limit:
            raise self.error(node, f"{node.tag}: {what} is {value}; it can be 0 to {limit}")
        return value

    # Devices

    def device(self, node: Node) -> Device:
        kind = node.first("Type")
        if kind is None:
            raise self.error(node, "a device without a Type")
        identity = Identity(
            self.vendor_id,
            self.attribute(kind, "ProductCode", default=0) & 0xFFFFFFFF,
            self.attribute(kind, "RevisionNo", default=0) & 0xFFFFFFFF,
        )
        if "ProductCode" not in kind.attributes:
            self.warnings.add(kind.line, f"{kind.text}: no product code; it is no slave, or cannot be told from others")
        for hidden in node.all("HideType"):
            product, revision = (hidden.attributes.get(name) for name in ("ProductCode", "RevisionNo"))
            revision = revision or hidden.attributes.get("ProductRevision")
            self.hidings.append(
                _Hiding(
                    (identity.product_code, identity.revision),
                    hidden.text,
                    number(product) if product else None,
                    number(revision) if revision else None,
                )
            )
        rx_pdos = self.each(node.all("RxPdo"), self.pdo)
        tx_pdos = self.each(node.all("TxPdo"), self.pdo)
        mailbox = node.first("Mailbox")
        assigned = {pdo.sync_manager: SyncManagerType.OUTPUTS for pdo in rx_pdos} | {
            pdo.sync_manager: SyncManagerType.INPUTS for pdo in tx_pdos
        }
        sync_managers = tuple(
            self.sync_manager(item, assigned.get(number_), mailbox is not None)
            for number_, item in enumerate(node.all("Sm"))
        )
        profiles, channels = self.profiles(node)
        slots = node.first("Slots")
        eeprom = node.first("Eeprom")
        group = node.value("GroupType")
        return Device(
            identity=identity,
            name=name_of(node) or kind.text,
            source=Source.ESI,
            origin=f"{self.path}:{node.line}",
            type=kind.text,
            vendor_name=self.vendor_name,
            group=group,
            group_name=self.groups.get(group, ""),
            physics=node.attributes.get("Physics", "").rstrip()[:4],
            sync_managers=sync_managers,
            fmmus=self.fmmus(node, sync_managers),
            rx_pdos=rx_pdos,
            tx_pdos=tx_pdos,
            mailbox=self.mailbox(mailbox) if mailbox is not None else None,
            objects=self.dictionaries(node),
            init_commands=self.init_commands(mailbox),
            dc_modes=self.each(self.below(node, "Dc", "OpMode"), self.dc_mode),
            slots=self.each(slots.all("Slot"), lambda slot: self.slot(slots, slot)) if slots is not None else (),
            download_module_idents=self.flag(slots, "DownloadModuleIdentList"),
            eeprom_bytes=self.within(eeprom, "ByteSize", self.number(eeprom, "ByteSize", default=0), 1 << 22)
            if eeprom is not None
            else 0,
            config_data=self.data(eeprom, "ConfigData", limit=14),
            bootstrap=self.data(eeprom, "BootStrap", limit=8),
            profile=profiles,
            channel_profiles=channels,
            ebus_current=self.ebus_current(node),
            no_lrw=self.flag(kind, "UseLrdLwr"),
            unread=dict(node.unread or {}),
        )

    @staticmethod
    def below(node: Node, *path: str) -> list[Node]:
        """Return the last elements of a path under all of those before."""
        nodes = [node]
        for tag in path:
            nodes = [child for parent in nodes for child in parent.all(tag)]
        return nodes

    def ebus_current(self, node: Node) -> int:
        electrical = node.first("Info", "Electrical")
        value = self.number(electrical, "EBusCurrent", default=0) if electrical is not None else 0
        return max(min(value, 32767), -32768)

    def profiles(self, node: Node) -> tuple[int | None, tuple[int, ...]]:
        """Return the profile of a device, drives first, and of its channels."""
        numbers = [number(item.text) for item in self.below(node, "Profile", "ProfileNo")]
        channels = [number(item.text) for item in self.below(node, "Profile", "ChannelInfo", "ProfileNo")]
        known = [value for value in (*numbers, *channels) if value is not None]
        return (402 if 402 in known else known[0] if known else None), tuple(v for v in channels if v is not None)

    def sync_manager(self, node: Node, assigned: SyncManagerType | None, has_mailbox: bool) -> SyncManager:
        control = number(node.attributes.get("ControlByte", ""))
        kind = _SYNC_MANAGERS.get(node.text.lower())
        if kind is None:
            outputs = control is not None and control >> 2 & 1
            if assigned is not None:
                kind = assigned
            elif control is not None and control & 3 == 2 and has_mailbox:
                kind = SyncManagerType.MAILBOX_RECEIVE if outputs else SyncManagerType.MAILBOX_SEND
            elif control is not None:
                kind = SyncManagerType.OUTPUTS if outputs else SyncManagerType.INPUTS
            else:
                kind = SyncManagerType.UNUSED
            self.warnings.add(
                node.line, f"Sm: the type {node.text[:40]!r} is not known; {kind.name} by its control byte"
            )
        sizes = {
            name: self.attribute(node, name, default=-1) if name in node.attributes else -1
            for name in ("DefaultSize", "MinSize", "MaxSize")
        }
        for name, size in sizes.items():
            if size > 0xFFFF:
                raise self.error(node, f"Sm: {name} is {size}; it can be 0 to 65535")
        enable = self.attribute(node, "Enable", default=1)
        return SyncManager(
            start=self.within(node, "StartAddress", self.attribute(node, "StartAddress", default=0), 0xFFFF),
            length=max(sizes["DefaultSize"], 0),
            control=_CONTROL.get(kind, 0) if control is None else control & 0xFF,
            type=kind,
            enabled=bool(enable & 1) if "Enable" in node.attributes else True,
            virtual=self.flag(node, "Virtual"),
            minimum=sizes["MinSize"] if sizes["MinSize"] >= 0 else None,
            maximum=sizes["MaxSize"] if sizes["MaxSize"] >= 0 else None,
            op_only=self.flag(node, "OpOnly") or bool(enable & 8),
        )

    def fmmus(self, node: Node, sync_managers: tuple[SyncManager, ...]) -> tuple[FmmuUse, ...]:
        """Return the uses of the FMMUs; one that is named as a sync manager has that one's direction."""
        named = {item.text: sync.type for item, sync in zip(node.all("Sm"), sync_managers, strict=True)}
        uses = []
        for item in node.all("Fmmu"):
            use = _FMMUS.get(item.text.lower())
            if use is None:
                use = _FMMU_OF.get(named.get(item.text, SyncManagerType.UNUSED), FmmuUse.UNUSED)
                self.warnings.add(item.line, f"Fmmu: the use {item.text[:40]!r} is not known; taken as {use.name}")
            uses.append(use)
        return tuple(uses)

    def pdo(self, node: Node) -> Pdo | None:
        index = number(node.value("Index"))
        if index is None:
            self.warnings.add(node.line, f"{node.tag} without an index is left out")
            return None
        sync_manager = node.attributes.get("Sm", "").strip()
        excludes = frozenset(v & 0xFFFF for v in (number(item.text) for item in node.all("Exclude")) if v is not None)
        return Pdo(
            index=self.within(node, "Index", index, 0xFFFF),
            name=name_of(node),
            entries=self.each(node.all("Entry"), self.pdo_entry),
            sync_manager=self.within(node, "Sm", self.attribute(node, "Sm"), 15) if sync_manager else None,
            fixed=self.flag(node, "Fixed"),
            mandatory=self.flag(node, "Mandatory"),
            virtual=self.flag(node, "Virtual"),
            excludes=excludes - {index},
            depends_on_slot=self.flag(node.first("Index"), "DependOnSlot"),
            overwritten_by_module=self.flag(node, "OverwrittenByModule"),
        )

    def pdo_entry(self, node: Node) -> PdoEntry | None:
        bits = self.number(node, "BitLen")
        if bits == 0:
            self.warnings.add(node.line, "Entry of 0 bits is left out")
            return None
        return PdoEntry(
            index=self.within(node, "Index", self.number(node, "Index", default=0), 0xFFFF),
            sub_index=self.within(node, "SubIndex", self.number(node, "SubIndex", default=0), 0xFF),
            bits=self.within(node, "BitLen", bits, _MAX_ENTRY_BITS),
            name=name_of(node),
            type=node.value("DataType"),
            depends_on_slot=self.flag(node.first("Index"), "DependOnSlot"),
        )

    def mailbox(self, node: Node) -> Mailbox:
        coe = node.first("CoE")
        return Mailbox(
            coe=None
            if coe is None
            else Coe(
                sdo_information=self.flag(coe, "SdoInfo"),
                pdo_assignment=self.flag(coe, "PdoAssign"),
                pdo_configuration=self.flag(coe, "PdoConfig"),
                pdo_upload=self.flag(coe, "PdoUpload"),
                complete_access=self.flag(coe, "CompleteAccess"),
                segmented=self.flag(coe, "SegmentedSdo"),
                ds402_channels=min(max(self.attribute(coe, "DS402Channels", default=0), 0), 255),
            ),
            data_link_layer=self.flag(node, "DataLinkLayer"),
            **{key: node.first(tag) is not None for tag, key in _PROTOCOLS},
        )

    def init_commands(self, mailbox: Node | None) -> tuple[InitCommand, ...]:
        nodes = self.below(mailbox, "CoE", "InitCmd") if mailbox is not None else []
        return self.each(nodes, self.init_command)

    def init_command(self, node: Node) -> InitCommand:
        return InitCommand(
            transitions=tuple(item.text.upper() for item in node.all("Transition") if item.text),
            index=self.within(node, "Index", self.number(node, "Index"), 0xFFFF),
            sub_index=self.within(node, "SubIndex", self.number(node, "SubIndex", default=0), 0xFF),
            data=self.data(node, "Data"),
            complete_access=self.flag(node, "CompleteAccess"),
            fixed=self.flag(node, "Fixed"),
            comment=name_of(node, "Comment"),
            depends_on_slot=self.flag(node.first("Index"), "DependOnSlot"),
        )

    def dc_mode(self, node: Node) -> DcMode:
        def factor(tag: str, default: int) -> int:
            child = node.first(tag)
            return self.attribute(child, "Factor", default) if child is not None else 0

        times = {
            tag: max(min(self.number(node, tag, default=0), (1 << 31) - 1), -(1 << 31))
            for tag in ("CycleTimeSync0", "ShiftTimeSync0", "CycleTimeSync1", "ShiftTimeSync1")
        }
        return DcMode(
            name=node.value("Name"),
            assign_activate=self.number(node, "AssignActivate", default=0) & 0xFFFF,
            description=node.value("Desc"),
            sync0_cycle=max(times["CycleTimeSync0"], 0),
            sync0_factor=factor("CycleTimeSync0", 1),
            sync0_shift=times["ShiftTimeSync0"],
            sync1_cycle=max(times["CycleTimeSync1"], 0),
            sync1_factor=factor("CycleTimeSync1", 0),
            sync1_shift=times["ShiftTimeSync1"],
        )

    # Slots and modules

    def slot(self, slots: Node, node: Node) -> Slot:
        def increment(name: str) -> int:
            item = node if name in node.attributes else slots
            return self.within(item, name, self.attribute(item, name, default=0), 0xFFFF)

        idents = [(self.number_of(item), self.flag(item, "Default")) for item in node.all("ModuleIdent")]
        maximum = self.within(node, "MaxInstances", self.attribute(node, "MaxInstances", default=1), SLOT_LIMIT)
        return Slot(
            name=name_of(node),
            idents=tuple(ident for ident, _ in idents),
            minimum=min(max(self.attribute(node, "MinInstances", default=0), 0), maximum),
            maximum=maximum,
            pdo_increment=increment("SlotPdoIncrement"),
            index_increment=increment("SlotIndexIncrement"),
            classes=tuple(item.text for item in self.below(node, "ModuleClass", "Class") if item.text),
            default=next((ident for ident, default in idents if default), None),
        )

    def number_of(self, node: Node) -> int:
        """Return the number that an element holds."""
        return self._number(node, "its text", node.text, None)

    def module(self, node: Node) -> Module:
        kind = node.first("Type")
        if kind is None:
            raise self.error(node, "a module without a Type")
        mailbox = node.first("Mailbox")
        return Module(
            ident=self.attribute(kind, "ModuleIdent") & 0xFFFFFFFF,
            name=name_of(node) or kind.text,
            rx_pdos=self.each(node.all("RxPdo"), self.pdo),
            tx_pdos=self.each(node.all("TxPdo"), self.pdo),
            objects=self.dictionaries(node),
            init_commands=self.init_commands(mailbox),
            module_class=kind.attributes.get("ModuleClass", ""),
            profile=self.profiles(node)[0],
            origin=f"{self.path}:{node.line}",
        )

    # Dictionaries

    def dictionaries(self, node: Node) -> tuple[DictionaryObject, ...]:
        objects: dict[int, DictionaryObject] = {}
        for dictionary in self.below(node, "Profile", "Dictionary"):
            data_types: dict[str, Node] = {}
            for item in self.below(dictionary, "DataTypes", "DataType"):
                data_types.setdefault(item.value("Name"), item)
            for item in self.below(dictionary, "Objects", "Object"):
                try:
                    built = self.object(item, data_types)
                except EsiError as error:
                    self.warnings.add(item.line, f"Object is left out: {error.problem}")
                    continue
                if built.index in objects:
                    self.warnings.add(item.line, f"Object 0x{built.index:04X} occurs twice; the first is used")
                    continue
                objects[built.index] = built
        return tuple(objects[index] for index in sorted(objects))

    def object(self, node: Node, data_types: dict[str, Node]) -> DictionaryObject:
        index = self.within(node, "Index", self.number(node, "Index"), 0xFFFF)
        type_name = node.value("Type")
        data_type = data_types.get(type_name)
        parts = data_type.all("SubItem") if data_type is not None else []
        info = node.first("Info")
        code = ObjectCode.VARIABLE
        if not parts:
            bits = self.number(node, "BitSize", default=0)
            entries = [
                self.object_entry(node, 0, name_of(node), type_name, bits, node.first("Flags"), info, data_types)
            ]
        else:
            slots = self.sub_items(parts, data_types)
            code = ObjectCode.ARRAY if any(element for *_, element in slots) else ObjectCode.RECORD
            infos = _matched(info.all("SubItem") if info is not None else [], slots)
            entries = []
            for (sub_index, part, entry_type, bits, element), given in zip(slots, infos, strict=True):
                flags = part.first("Flags") or node.first("Flags")
                name = (name_of(given) if element and given is not None else "") or name_of(part)
                values = given.first("Info") if given is not None else part
                entries.append(self.object_entry(part, sub_index, name, entry_type, bits, flags, values, data_types))
            entries = [item for number_, item in sorted({item.sub_index: item for item in reversed(entries)}.items())]
            if entries[0].sub_index == 0 and not entries[0].default:
                entries[0] = replace(entries[0], default=bytes([entries[-1].sub_index]))
        return DictionaryObject(
            index=index,
            name=name_of(node),
            code=code,
            entries=tuple(entries),
            depends_on_slot=self.flag(node.first("Index"), "DependOnSlot"),
            overwritten_by_module=self.flag(node.first("Index"), "OverwrittenByModule"),
        )

    def sub_items(self, parts: list[Node], data_types: dict[str, Node]) -> list[_Part]:
        """Return the subindexes of a type; an array's elements one by one."""
        slots: list[_Part] = []
        for part in parts:
            type_name = part.value("Type")
            bits = self.number(part, "BitSize", default=0)
            given = number(part.value("SubIdx"))
            array = data_types[type_name].first("ArrayInfo") if type_name in data_types else None
            following = slots[-1][0] + 1 if slots else 0
            if given is None and array is not None:
                count = self.number(array, "Elements", default=0)
                first = max(self.number(array, "LBound", default=1), following, 1)
                element = data_types[type_name].value("BaseType")
                if not 0 <= count <= 255:
                    raise self.error(part, f"an array of {count} elements")
                slots += [(first + i, part, element, bits // count, True) for i in range(min(count, 256 - first))]
            else:
                sub_index = self.within(part, "SubIdx", following if given is None else given, 255)
                slots.append((sub_index, part, type_name, bits, False))
        return slots

    def object_entry(
        self,
        node: Node,
        sub_index: int,
        name: str,
        type_name: str,
        bits: int,
        flags: Node | None,
        info: Node | None,
        data_types: dict[str, Node],
    ) -> ObjectEntry:
        base, bits = self.base_type(node, type_name, bits, data_types)
        access = flags.first("Access") if flags is not None else None
        rights = access.text.lower() if access is not None else "ro"
        restrictions = access.attributes.get("WriteRestrictions", "") if access is not None else ""
        mapping = flags.value("PdoMapping").upper() if flags is not None else ""
        unit = number(info.value("Unit")) if info is not None else None
        return ObjectEntry(
            sub_index=sub_index,
            name=name,
            type=base.name,
            bits=bits,
            readable=rights != "wo",
            writable=rights in ("rw", "wo"),
            write_states="".join(letter for state, letter in _STATES if state in restrictions.upper().split("_")),
            rx_mappable="R" in mapping,
            tx_mappable="T" in mapping,
            default=self.given(info, base, "Default", f"0x{sub_index:02X} {name}"),
            minimum=self.given(info, base, "Min", name),
            maximum=self.given(info, base, "Max", name),
            unit=None if unit is None else unit & 0xFFFFFFFF,
        )

    def base_type(self, node: Node, name: str, bits: int, data_types: dict[str, Node]) -> tuple[types.BaseType, int]:
        """Return the base type under a name of the file, and its length."""
        for _ in range(8):
            found = types.named(name)
            data_type = data_types.get(name)
            if found is not None or data_type is None or not data_type.value("BaseType"):
                break
            bits = bits or self.number(data_type, "BitSize", default=0)
            name = data_type.value("BaseType")
        declared = data_types.get(name)
        bits = bits or (found.bits if found is not None else 0)
        if not bits and declared is not None:
            bits = self.number(declared, "BitSize", default=0)
        bits = self.within(node, "BitSize", bits, 1 << 22)
        base = types.resolve(name, bits)
        return base, bits or base.bits

    def given(self, info: Node | None, base: types.BaseType, which: str, name: str) -> bytes | None:
        """Return a value of `Info`: data, a number or a text, of the type's length."""
        if info is None:
            return None
        data: bytes | None = None
        if info.first(f"{which}Data") is not None:
            data = self.data(info, f"{which}Data")
        elif text := info.value(f"{which}String"):
            data = text.encode("utf-8")
        elif text := info.value(f"{which}Value"):
            value: types.Value | None = text if base.kind in (types.Kind.TEXT, types.Kind.REAL) else number(text)
            try:
                data = types.encode(base, value if value is not None else float(text))
            except (EsiError, ValueError):
                self.warnings.add(info.line, f"{name}: {which}Value {text[:40]!r} is no {base.name}; it is left out")
                return None
        if not data:
            return data
        if base.size and base.kind is not types.Kind.TEXT:
            if len(data) > base.size and any(data[base.size :]):
                self.warnings.add(
                    info.line, f"{name}: {which}Data has {len(data)} bytes, the type {base.size}; it is cut"
                )
            data = data[: base.size].ljust(base.size, b"\0")
        return data


_Part = tuple[int, Node, str, int, bool]
"""Subindex, element, type, bits, whether it is an array's element."""
_PROTOCOLS = (("FoE", "foe"), ("EoE", "eoe"), ("AoE", "aoe"), ("SoE", "soe"), ("VoE", "voe"))


def _matched(infos: list[Node], slots: list[_Part]) -> list[Node | None]:
    """Return the values of each subindex: by position, as their names often differ; by name where some are missing."""
    if len(infos) == len(slots):
        return list(infos)
    named = {name_of(info): info for info in reversed(infos)}
    by_name = [named.get(name_of(part)) for _, part, *_ in slots]
    if len(infos) < len(slots) and sum(found is not None for found in by_name) == len(infos):
        return list(by_name)
    return [infos[position] if position < len(infos) else None for position in range(len(slots))]


def _hides(hiding: _Hiding, device: Device) -> bool:
    identity = device.identity
    if (identity.product_code, identity.revision) == hiding.by:
        return False
    if hiding.product is not None:
        alike = identity.product_code == hiding.product
    elif hiding.type:
        alike = device.type == hiding.type
    else:
        alike = identity.product_code == hiding.by[0]
    return alike and hiding.revision in (None, identity.revision)


def read_esi(path: Path | str) -> DeviceFile:
    """Return the devices and modules of an ESI file.

    Raises EsiError where the file is no ESI file, or beyond the limits of `xml_tree`. A device or module that cannot be
    understood is in `failures` instead.
    """
    reader = _Reader(Path(path))
    root = read_trees(Path(path), reader.collect, reader.warnings)
    if not (reader.devices or reader.modules or reader.failures):
        raise EsiError(str(path), f"{root} holds no device and no module")
    return reader.file()


def describe(device: Device) -> str:
    """Return a device in a line: name, type, product code, revision."""
    identity = device.identity
    return f"{device.name} ({device.type}), product 0x{identity.product_code:08X}, revision 0x{identity.revision:08X}"


def find_devices(
    file: DeviceFile, *, product: int | None = None, revision: int | None = None, name: str | None = None
) -> tuple[Device, ...]:
    """Return the devices that fit all that is given; `name` is a type or a name, without regard to case."""
    wanted = name.lower() if name is not None else None
    return tuple(
        device
        for device in file.devices
        if (product is None or device.identity.product_code == product)
        and (revision is None or device.identity.revision == revision)
        and (wanted is None or wanted in (device.type.lower(), device.name.lower()))
    )


def find_device(
    file: DeviceFile, *, product: int | None = None, revision: int | None = None, name: str | None = None
) -> Device:
    """Return the one device that fits; of several revisions the one that no other hides.

    Raises LookupFailure with what there is where none fits, or several do.
    """
    fitting = find_devices(file, product=product, revision=revision, name=name)
    if len(fitting) > 1:
        fitting = tuple(device for device in fitting if not device.hidden) or fitting
    if len(fitting) == 1:
        return fitting[0]
    offered = fitting or file.devices
    candidates = tuple(describe(device) for device in offered)
    asked = ", ".join(
        f"{key} {value}"
        for key, value in (
            ("product", None if product is None else f"0x{product:08X}"),
            ("revision", None if revision is None else f"0x{revision:08X}"),
            ("name", name),
        )
        if value is not None
    )
    problem = f"{len(fitting) or 'no'} devices fit {asked or 'without a choice'}"
    shown = "; ".join(candidates[:20]) + (f"; and {len(candidates) - 20} more" if len(candidates) > 20 else "")
    failed = f"; not readable: {'; '.join(file.failures[:5])}" if file.failures else ""
    raise LookupFailure(file.path, f"{problem}; there are: {shown or 'none'}{failed}", candidates)
