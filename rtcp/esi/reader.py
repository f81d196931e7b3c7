"""ESI files (ETG.2000): reader of devices and modules, and look-up.

Mistakes of real files are accepted with a warning if the meaning is clear; an unreadable device is skipped with its
reason.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from rtcp.esi import model
from rtcp.esi.object_reader import FileTooLarge, ObjectReader
from rtcp.esi.values import Values, name_of, number
from rtcp.esi.xml_tree import Node, read_trees

DEVICE_LIMIT = 10_000
"""Devices and modules in a file."""
SLOT_LIMIT = 1024
"""Places for modules of one slot element."""
_MAX_ENTRY_BITS = 8 * 1486
_MOST_SAMPLES = 255
"""Values of a PDO in a cycle; a PDO assignment has as many subindices (ETG.1000.6, 5.6.7.4)."""
_SYNC_MANAGERS = {
    "mboxout": model.SyncManagerType.MAILBOX_RECEIVE,
    "mboxin": model.SyncManagerType.MAILBOX_SEND,
    "outputs": model.SyncManagerType.OUTPUTS,
    "inputs": model.SyncManagerType.INPUTS,
}
_CONTROL = {1: 0x26, 2: 0x22, 3: 0x64, 4: 0x20}
"""Control byte of a sync manager's type, where none is given (ETG.1000.4, table 59)."""
_FMMUS = {
    "outputs": model.FmmuUse.OUTPUTS,
    "inputs": model.FmmuUse.INPUTS,
    "mboxstate": model.FmmuUse.MAILBOX_STATE,
    "": model.FmmuUse.UNUSED,
}
_FMMU_OF = {model.SyncManagerType.OUTPUTS: model.FmmuUse.OUTPUTS, model.SyncManagerType.INPUTS: model.FmmuUse.INPUTS}
_COE = (
    ("sdo_information", "@SdoInfo"),
    ("pdo_assignment", "@PdoAssign"),
    ("pdo_configuration", "@PdoConfig"),
    ("pdo_upload", "@PdoUpload"),
    ("complete_access", "@CompleteAccess"),
    ("segmented", "@SegmentedSdo"),
)


class _Reader:
    """Builds devices and modules from their trees."""

    def __init__(self, path: Path) -> None:
        self.path = str(path)
        self.values = Values(self.path)
        self.objects = ObjectReader(self.values)
        self.vendor_id = 0
        self.vendor_name = ""
        self.groups: dict[str, str] = {}
        self.devices: list[model.Device] = []
        self.modules: list[model.Module] = []
        self.failures: list[str] = []
        self.hiding: dict[tuple[int | str, int | None], set[tuple[int, int]]] = {}
        """Product code or type, and revision (None: all) -> devices that hide these."""

    def collect(self, node: Node) -> None:
        """Process a tree of the file."""
        if len(self.devices) + len(self.modules) + len(self.failures) >= DEVICE_LIMIT:
            raise self.values.error(node, f"more than {DEVICE_LIMIT} devices and modules")
        try:
            if node.tag == "Vendor":
                self.vendor_id = self.values.number(node, "Id", 0) & 0xFFFFFFFF
                self.vendor_name = name_of(node)
            elif node.tag == "Group":
                self.groups[node.value("Type") or ""] = name_of(node)
            elif node.tag == "Device":
                self.devices.append(self.device(node))
            else:
                self.modules.append(self.module(node))
        except FileTooLarge:
            raise
        except model.EsiError as error:
            self.failures.append(str(error))

    def file(self) -> model.DeviceFile:
        """Return the result."""
        devices = [replace(device, hidden=True) if self.is_hidden(device) else device for device in self.devices]
        return model.DeviceFile(
            path=self.path,
            vendor_id=self.vendor_id,
            vendor_name=self.vendor_name,
            devices=tuple(devices),
            modules=tuple(self.modules),
            warnings=self.values.warnings.all(),
            failures=tuple(self.failures),
        )

    def is_hidden(self, device: model.Device) -> bool:
        """Return whether another device of the file hides this one."""
        own = (device.identity.product_code, device.identity.revision)
        keys = ((kind, revision) for kind in (own[0], device.type) for revision in (own[1], None))
        return any(self.hiding.get(key, set()) - {own} for key in keys)

    # Devices

    def device(self, node: Node) -> model.Device:
        values = self.values
        identity = model.Identity(
            self.vendor_id,
            values.number(node, "Type/@ProductCode", 0) & 0xFFFFFFFF,
            values.number(node, "Type/@RevisionNo", 0) & 0xFFFFFFFF,
        )
        kind = name_of(node, "Type")
        if node.value("Type/@ProductCode") is None:
            values.warnings.add(node.line, f"{kind}: no product code; it is no slave, or cannot be told from others")
        for tag, count in (node.unread or {}).items():
            values.warnings.add(node.line, f"{count} elements {tag} of {kind} are not read")
        for item in node.below("HideType"):
            revision = item.value("@RevisionNo") or item.value("@ProductRevision")
            key = (number(item.value("@ProductCode")) or item.text or identity.product_code, number(revision))
            self.hiding.setdefault(key, set()).add((identity.product_code, identity.revision))
        rx_pdos = values.each(node.below("RxPdo"), self.pdo)
        tx_pdos = values.each(node.below("TxPdo"), self.pdo)
        sync_managers = self.sync_managers(node, rx_pdos, tx_pdos)
        profile, channels = self.profiles(node)
        group = node.value("GroupType") or ""
        symbols = [
            (number(item.value("NotationIndex")), item.value("Symbol"))
            for item in node.below("Profile/Dictionary/UnitTypes/UnitType")
        ]
        return model.Device(
            identity=identity,
            name=name_of(node) or kind,
            source=model.Source.ESI,
            origin=f"{self.path}:{node.line}",
            type=kind,
            vendor_name=self.vendor_name,
            group=group,
            group_name=self.groups.get(group, ""),
            physics=(node.value("@Physics") or "").rstrip()[:4],
            sync_managers=sync_managers,
            fmmus=self.fmmus(node, sync_managers),
            rx_pdos=rx_pdos,
            tx_pdos=tx_pdos,
            mailbox=self.mailbox(node),
            objects=self.objects.dictionary(node),
            init_commands=values.each(node.below("Mailbox/CoE/InitCmd"), self.init_command),
            dc_modes=values.each(node.below("Dc/OpMode"), self.dc_mode),
            slots=values.each(node.below("Slots/Slot"), lambda slot: self.slot(node, slot)),
            download_module_idents=values.flag(node, "Slots/@DownloadModuleIdentList"),
            eeprom_bytes=values.number(node, "Eeprom/ByteSize", 0, low=0, high=1 << 22),
            config_data=values.data(node, "Eeprom/ConfigData", limit=14),
            bootstrap=values.data(node, "Eeprom/BootStrap", limit=8),
            profile=profile,
            channel_profiles=channels,
            ebus_current=values.number(node, "Info/Electrical/EBusCurrent", 0, low=-32768, high=32767),
            no_lrw=values.flag(node, "Type/@UseLrdLwr"),
            unit_symbols={index: symbol[:40] for index, symbol in symbols if index is not None and symbol},
            unread=dict(node.unread or {}),
        )

    @staticmethod
    def profiles(node: Node) -> tuple[int | None, tuple[int, ...]]:
        """Return the profile of a device, that of drives first, and those of its channels."""
        own, channels = (
            tuple(
                value for item in node.below(path) if (value := number(item.text)) is not None and 0 <= value <= 0xFFFF
            )
            for path in ("Profile/ProfileNo", "Profile/ChannelInfo/ProfileNo")
        )
        known = (*own, *channels)
        return (402 if 402 in known else known[0] if known else None), channels[:256]

    def sync_managers(
        self, node: Node, rx_pdos: tuple[model.Pdo, ...], tx_pdos: tuple[model.Pdo, ...]
    ) -> tuple[model.SyncManager, ...]:
        nodes = node.below("Sm")
        if len(nodes) > 16:
            raise self.values.error(nodes[16], f"{len(nodes)} sync managers; no slave controller has more than 16")
        assigned = {pdo.sync_manager: model.SyncManagerType.OUTPUTS for pdo in rx_pdos} | {
            pdo.sync_manager: model.SyncManagerType.INPUTS for pdo in tx_pdos
        }
        has_mailbox = node.first("Mailbox") is not None
        return tuple(self.sync_manager(item, assigned.get(n), has_mailbox) for n, item in enumerate(nodes))

    def sync_manager(self, node: Node, assigned: model.SyncManagerType | None, has_mailbox: bool) -> model.SyncManager:
        values = self.values
        control = number(node.value("@ControlByte"))
        kind = _SYNC_MANAGERS.get(node.text.lower())
        if kind is None:
            outputs = control is not None and control >> 2 & 1
            if assigned is not None:
                kind = assigned
            elif control is None:
                kind = model.SyncManagerType.UNUSED
            elif control & 3 == 2 and has_mailbox:
                kind = model.SyncManagerType.MAILBOX_RECEIVE if outputs else model.SyncManagerType.MAILBOX_SEND
            else:
                kind = model.SyncManagerType.OUTPUTS if outputs else model.SyncManagerType.INPUTS
            values.warnings.add(node.line, f"Sm: the type {node.text[:40]!r} is not known; taken as {kind.name}")
        minimum, maximum = (values.number(node, f"@{name}Size", -1, low=-1, high=0xFFFF) for name in ("Min", "Max"))
        enable = values.number(node, "@Enable", 1)
        return model.SyncManager(
            start=values.number(node, "@StartAddress", 0, low=0, high=0xFFFF),
            length=values.number(node, "@DefaultSize", 0, low=0, high=0xFFFF),
            control=_CONTROL.get(kind, 0) if control is None else control & 0xFF,
            type=kind,
            enabled=bool(enable & 1),
            virtual=values.flag(node, "@Virtual"),
            minimum=minimum if minimum >= 0 else None,
            maximum=maximum if maximum >= 0 else None,
            op_only=values.flag(node, "@OpOnly") or bool(enable & 8),
        )

    def fmmus(self, node: Node, sync_managers: tuple[model.SyncManager, ...]) -> tuple[model.FmmuUse, ...]:
        """Return the uses of the FMMUs; one that is named as a sync manager has that one's direction."""
        nodes = node.below("Fmmu")
        if len(nodes) > 16:
            raise self.values.error(nodes[16], f"{len(nodes)} FMMUs; no slave controller has more than 16")
        named = {item.text: sync.type for item, sync in zip(node.below("Sm"), sync_managers, strict=True)}
        uses = []
        for item in nodes:
            use = _FMMUS.get(item.text.lower())
            if use is None:
                use = _FMMU_OF.get(named.get(item.text, model.SyncManagerType.UNUSED), model.FmmuUse.UNUSED)
                warning = f"Fmmu: the use {item.text[:40]!r} is not known; taken as {use.name}"
                self.values.warnings.add(item.line, warning)
            uses.append(use)
        return tuple(uses)

    def pdo(self, node: Node) -> model.Pdo | None:
        values = self.values
        if not node.value("Index"):
            values.warnings.add(node.line, f"{node.tag} without an index is left out")
            return None
        index = values.number(node, "Index", low=0, high=0xFFFF)
        excluded = (number(item.text) for item in node.below("Exclude"))
        return model.Pdo(
            index=index,
            name=name_of(node),
            entries=values.each(node.below("Entry"), self.pdo_entry),
            sync_manager=values.number(node, "@Sm", low=0, high=15) if node.value("@Sm") else None,
            fixed=values.flag(node, "@Fixed"),
            mandatory=values.flag(node, "@Mandatory"),
            sample_increment=values.number(node, "@OSIndexInc", 0, low=0, high=0xFFFF),
            fewest_samples=min(values.number(node, "@OSMin", 1, low=0), _MOST_SAMPLES),
            most_samples=min(values.number(node, "@OSMax", 1, low=0), _MOST_SAMPLES),
            virtual=values.flag(node, "@Virtual"),
            excludes=frozenset(value & 0xFFFF for value in excluded if value is not None) - {index},
            depends_on_slot=values.flag(node, "Index/@DependOnSlot"),
            overwritten_by_module=values.flag(node, "@OverwrittenByModule"),
        )

    def pdo_entry(self, node: Node) -> model.PdoEntry | None:
        values = self.values
        bits = values.number(node, "BitLen", low=0, high=_MAX_ENTRY_BITS)
        if bits == 0:
            values.warnings.add(node.line, "Entry of 0 bits is left out")
            return None
        return model.PdoEntry(
            index=values.number(node, "Index", 0, low=0, high=0xFFFF),
            sub_index=values.number(node, "SubIndex", 0, low=0, high=0xFF),
            bits=bits,
            name=name_of(node),
            type=node.value("DataType") or "",
            depends_on_slot=values.flag(node, "Index/@DependOnSlot"),
        )

    def mailbox(self, node: Node) -> model.Mailbox | None:
        mailbox = node.first("Mailbox")
        if mailbox is None:
            return None
        flag = self.values.flag
        coe = mailbox.first("CoE")
        described = None
        if coe is not None:
            channels = self.values.number(coe, "@DS402Channels", 0, low=0, high=255)
            described = model.Coe(**{name: flag(coe, path) for name, path in _COE}, ds402_channels=channels)
        protocols = {name.lower(): mailbox.first(name) is not None for name in ("FoE", "EoE", "AoE", "SoE", "VoE")}
        return model.Mailbox(coe=described, **protocols, data_link_layer=flag(mailbox, "@DataLinkLayer"))

    def init_command(self, node: Node) -> model.InitCommand:
        values = self.values
        return model.InitCommand(
            transitions=tuple(item.text.upper() for item in node.below("Transition") if item.text),
            index=values.number(node, "Index", low=0, high=0xFFFF),
            sub_index=values.number(node, "SubIndex", 0, low=0, high=0xFF),
            data=values.data(node, "Data"),
            complete_access=values.flag(node, "@CompleteAccess"),
            fixed=values.flag(node, "@Fixed"),
            comment=name_of(node, "Comment"),
            depends_on_slot=values.flag(node, "Index/@DependOnSlot"),
        )

    def dc_mode(self, node: Node) -> model.DcMode:
        def time(tag: str, low: int = -(1 << 31)) -> int:
            return self.values.number(node, tag, 0, low=low, high=(1 << 31) - 1)

        def factor(tag: str, default: int) -> int:
            return self.values.number(node, f"{tag}/@Factor", default if node.first(tag) is not None else 0)

        def assigned(manager: Node) -> tuple[int, ...]:
            return tuple(index for item in manager.below("Pdo") if (index := number(item.text)) is not None)

        managers = [(number(item.value("@No")), assigned(item)) for item in node.below("Sm")]
        return model.DcMode(
            name=node.value("Name") or "",
            assign_activate=self.values.number(node, "AssignActivate", 0) & 0xFFFF,
            description=node.value("Desc") or "",
            sync0_cycle=time("CycleTimeSync0", low=0),
            sync0_factor=factor("CycleTimeSync0", 1),
            sync0_shift=time("ShiftTimeSync0"),
            sync1_cycle=time("CycleTimeSync1", low=0),
            sync1_factor=factor("CycleTimeSync1", 0),
            sync1_shift=time("ShiftTimeSync1"),
            pdos=tuple((manager, indices) for manager, indices in managers if manager is not None and indices),
            samples=tuple(
                (index, count)
                for item in node.below("Sm/Pdo")
                if (index := number(item.text)) is not None
                and (count := min(number(item.value("@OSFac")) or 1, _MOST_SAMPLES)) > 1
            ),
        )

    # Slots and modules

    def slot(self, device: Node, node: Node) -> model.Slot:
        values = self.values

        def increment(name: str) -> int:
            common = values.number(device, f"Slots/@{name}", 0, low=0, high=0xFFFF)
            return values.number(node, f"@{name}", common, low=0, high=0xFFFF)

        idents = [(number(item.text), item) for item in node.below("ModuleIdent")]
        maximum = values.number(node, "@MaxInstances", 1, low=0, high=SLOT_LIMIT)
        return model.Slot(
            name=name_of(node),
            idents=tuple(ident for ident, _ in idents if ident is not None),
            minimum=min(values.number(node, "@MinInstances", 0, low=0), maximum),
            maximum=maximum,
            pdo_increment=increment("SlotPdoIncrement"),
            index_increment=increment("SlotIndexIncrement"),
            classes=tuple(item.text for item in node.below("ModuleClass/Class") if item.text),
            default=next((ident for ident, item in idents if values.flag(item, "@Default")), None),
        )

    def module(self, node: Node) -> model.Module:
        values = self.values
        return model.Module(
            ident=values.number(node, "Type/@ModuleIdent") & 0xFFFFFFFF,
            name=name_of(node) or name_of(node, "Type"),
            rx_pdos=values.each(node.below("RxPdo"), self.pdo),
            tx_pdos=values.each(node.below("TxPdo"), self.pdo),
            objects=self.objects.dictionary(node),
            init_commands=values.each(node.below("Mailbox/CoE/InitCmd"), self.init_command),
            module_class=node.value("Type/@ModuleClass") or "",
            profile=self.profiles(node)[0],
            origin=f"{self.path}:{node.line}",
        )


def read_esi(path: Path | str) -> model.DeviceFile:
    """Return the devices and modules of an ESI file.

    Raises EsiError where the file is no ESI file, or beyond the limits of this module and of `xml_tree`. A device or
    module that cannot be understood is in `failures` instead.
    """
    reader = _Reader(Path(path))
    root = read_trees(Path(path), reader.collect, reader.values.warnings)
    if not (reader.devices or reader.modules or reader.failures):
        raise model.EsiError(str(path), f"{root} holds no device and no module")
    return reader.file()


def describe(device: model.Device) -> str:
    """Return a device in a line: name, type, product code, revision."""
    identity = device.identity
    return f"{device.name} ({device.type}), product 0x{identity.product_code:08X}, revision 0x{identity.revision:08X}"


def find_devices(
    file: model.DeviceFile, *, product: int | None = None, revision: int | None = None, name: str | None = None
) -> tuple[model.Device, ...]:
    """Return the devices that match all criteria; `name` is a type or a name, case-insensitive."""
    wanted = name.lower() if name is not None else None
    return tuple(
        device
        for device in file.devices
        if product in (None, device.identity.product_code)
        and revision in (None, device.identity.revision)
        and wanted in (None, device.type.lower(), device.name.lower())
    )


def _shown(fitting: tuple[model.Device, ...]) -> tuple[model.Device, ...]:
    """Return the devices that no other one hides, or all where each is hidden."""
    return tuple(device for device in fitting if not device.hidden) or fitting


def choice_of(file: model.DeviceFile, device: model.Device) -> int | None:
    """Return the `choice` by which `find_device` finds a device by its identity; None: it needs none."""
    identity = device.identity
    fitting = _shown(find_devices(file, product=identity.product_code, revision=identity.revision))
    return fitting.index(device) + 1 if len(fitting) > 1 and device in fitting else None


def find_device(
    file: model.DeviceFile,
    *,
    product: int | None = None,
    revision: int | None = None,
    name: str | None = None,
    choice: int | None = None,
) -> model.Device:
    """Return the single matching device; of several revisions the one not hidden by another.

    With `choice`, which counts from 1, it is one of those that match. Raises LookupFailure with the candidates if none
    or several match.
    """
    fitting = _shown(find_devices(file, product=product, revision=revision, name=name))
    if choice is not None and 1 <= choice <= len(fitting):
        return fitting[choice - 1]
    if len(fitting) == 1 and choice is None:
        return fitting[0]
    candidates = tuple(describe(device) for device in fitting or file.devices)
    criteria = [
        f"{key} 0x{value:08X}" for key, value in (("product", product), ("revision", revision)) if value is not None
    ]
    criteria += [f"name {name}"] if name is not None else []
    criteria += [f"choice {choice}"] if choice is not None else []
    numbered = [f"{number}: {text}" for number, text in enumerate(candidates, 1)] if fitting else candidates
    listed = "; ".join(numbered[:20]) + (f"; and {len(candidates) - 20} more" if len(candidates) > 20 else "")
    failed = f"; not readable: {'; '.join(file.failures[:5])}" if file.failures else ""
    problem = f"{len(fitting) or 'no'} devices fit {', '.join(criteria) or 'without a choice'}"
    raise model.LookupFailure(
        file.path, f"{problem}; there are: {listed or 'none'}{failed}", candidates, several=len(fitting) > 1
    )
