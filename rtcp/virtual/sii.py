"""The slave information interface: the EEPROM of a device and its registers (ETG.1000.6, 5.4; ETG.1000.4, 6.4)."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from enum import IntEnum, IntFlag

from rtcp.esi.sii import crc
from rtcp.virtual.device import DeviceModel
from rtcp.virtual.objects import Access, ObjectDictionary
from rtcp.virtual.pdo import (
    RX_ASSIGN,
    RX_MAPPINGS,
    TX_ASSIGN,
    TX_MAPPINGS,
    PdoImage,
    SyncManager,
    SyncManagerLayout,
    SyncManagerType,
    listed,
    split_mapping,
)
from rtcp.virtual.protocol import MailboxType, Register

_CATEGORIES_AT = 2 * 0x40
"""Byte address of the first category (ETG.2010, table 2)."""
_END = 0xFFFF
_ERASED = b"\xff"
_CONFIG = struct.Struct("<5H4x")
_CONTROL = 0x0080
"""PDI control: on-chip bus, for lack of a processor interface (ETG.2010, table 2)."""
_SYNC_PULSE = 100
"""Length of a SYNC pulse in units of 10 ns."""
_IDENTITY = struct.Struct("<4L")
_MAILBOXES = struct.Struct("<8x9H")
_PROTOCOLS = {
    MailboxType.AOE: 0x01, MailboxType.EOE: 0x02, MailboxType.COE: 0x04, MailboxType.FOE: 0x08,
    MailboxType.SOE: 0x10, MailboxType.VOE: 0x20,
}  # fmt: skip
"""Supported mailbox protocols (ETG.1000.6, table 18)."""
_VERSION = 1
_SMALLEST_KBIT = 16
_GENERAL = struct.Struct("<4Bx5BxBhxx2H12x")
_PORTS = 0x0011
"""Ports 0 and 1 are MII, the others absent; one nibble per port."""
_SYNC_MANAGER = struct.Struct("<HHBBBB")
_PDO = struct.Struct("<HBBBBH")
_PDO_ENTRY = struct.Struct("<HBBBBH")
_DC_MODE = struct.Struct("<3LhHhBB4x")
_NOT_ASSIGNED = 0xFF
"""Sync manager of a PDO that is not assigned."""
_DC_SYNC0 = 0x0300
"""AssignActivate: cyclic operation and SYNC0."""


class Category(IntEnum):
    """Categories of the SII (ETG.1000.6, table 19)."""

    STRINGS = 10
    GENERAL = 30
    FMMU = 40
    SYNC_MANAGER = 41
    TXPDO = 50
    RXPDO = 51
    DC = 60


class CoeDetail(IntFlag):
    """CoE details (ETG.1000.6, table 21)."""

    SDO = 0x01
    SDO_INFORMATION = 0x02
    PDO_ASSIGN = 0x04
    PDO_CONFIGURATION = 0x08
    UPLOAD_AT_STARTUP = 0x10
    COMPLETE_ACCESS = 0x20


class FmmuUse(IntEnum):
    """Use of an FMMU (ETG.1000.6, table 23)."""

    OUTPUTS = 1
    INPUTS = 2
    MAILBOX_STATE = 3


_COE_DETAILS = CoeDetail.SDO | CoeDetail.SDO_INFORMATION | CoeDetail.UPLOAD_AT_STARTUP | CoeDetail.COMPLETE_ACCESS
_FMMUS = (FmmuUse.OUTPUTS, FmmuUse.INPUTS, FmmuUse.MAILBOX_STATE)


class _Strings:
    """The strings of an image, each once; number 0 is the empty string."""

    def __init__(self) -> None:
        self._numbers: dict[bytes, int] = {}

    def number(self, text: str) -> int:
        """Add `text` to the strings of the image and return its number; 0: no room for another."""
        encoded = text.encode("ascii", "replace")[:255]
        if not encoded or (encoded not in self._numbers and len(self._numbers) == 255):
            return 0
        return self._numbers.setdefault(encoded, len(self._numbers) + 1)

    def content(self) -> bytes:
        """Return the category: the number of strings, then each with a leading length."""
        parts = (bytes((len(text),)) + text for text in self._numbers)
        return bytes((len(self._numbers),)) + b"".join(parts)


def build_sii(device: DeviceModel, layout: SyncManagerLayout, alias: int) -> bytes:
    """Return the whole EEPROM image of `device`, a power of two of bytes; words are little endian.

    The PDO categories and the lengths of SM2 and SM3 follow the PDO assignment at the time of the call. `alias` is the
    configured station alias.

    Raises:
        SdoAbort: a PDO object refers to an unknown or unmappable object.
        ValueError: the process data exceed a sync manager's buffer.
    """
    categories = b"".join(_category(number, content) for number, content in _contents(device, layout))
    body = categories + struct.pack("<H", _END)
    kbit = _SMALLEST_KBIT
    while kbit * 128 < _CATEGORIES_AT + len(body):
        kbit *= 2
    image = _head(device, layout, alias, kbit) + body
    return image.ljust(kbit * 128, _ERASED)


def _head(device: DeviceModel, layout: SyncManagerLayout, alias: int, kbit: int) -> bytes:
    """Return words 0 to 0x3F: configuration, identity, mailboxes, size and version (ETG.1000.6, table 16)."""
    configuration = _CONFIG.pack(_CONTROL, 0, _SYNC_PULSE, 0, alias)
    identity = device.identity
    receive, send = layout.mailbox_receive, layout.mailbox_send
    protocols = sum(_PROTOCOLS[protocol] for protocol in {MailboxType.COE, *device.mailbox_protocols})
    # The bootstrap mailboxes are 0: no BOOT state.
    head = (
        configuration
        + struct.pack("<H", crc(configuration))
        + _IDENTITY.pack(identity.vendor_id, identity.product_code, identity.revision, identity.serial)
        + _MAILBOXES.pack(0, 0, 0, 0, receive.start, receive.length, send.start, send.length, protocols)
    )
    return head.ljust(_CATEGORIES_AT - 4, b"\0") + struct.pack("<HH", kbit - 1, _VERSION)


def _category(number: Category, content: bytes) -> bytes:
    """Return a category with its header, which has its length in words."""
    content += bytes(len(content) % 2)
    return struct.pack("<HH", number, len(content) // 2) + content


def _contents(device: DeviceModel, layout: SyncManagerLayout) -> Iterable[tuple[Category, bytes]]:
    """Return the categories in order, without those of absent PDOs or DC."""
    strings = _Strings()
    # SOEM and others take string 1 as the name.
    strings.number(device.identity.name)
    later: list[tuple[Category, bytes]] = [
        (Category.GENERAL, _general(device, strings)),
        (Category.FMMU, bytes((*_FMMUS, 0xFF))),
        (Category.SYNC_MANAGER, b"".join(_sync_manager(device.objects, sm) for sm in layout)),
    ]
    for category, mappings, assignment in (
        (Category.TXPDO, TX_MAPPINGS, TX_ASSIGN),
        (Category.RXPDO, RX_MAPPINGS, RX_ASSIGN),
    ):
        pdos = _pdos(device.objects, mappings, assignment, strings)
        if pdos:
            later.append((category, pdos))
    if device.supports_dc:
        later.append((Category.DC, _dc(strings)))
    return [(Category.STRINGS, strings.content()), *later]


def _general(device: DeviceModel, strings: _Strings) -> bytes:
    """Return the category General (ETG.1000.6, table 21)."""
    group = strings.number(device.identity.group)
    order = strings.number(device.identity.order_code)
    name = strings.number(device.identity.name)
    # Group, image, order, name; CoE, FoE, EoE, SoE and DS402 details; flags; Ebus current; ports; identity address.
    foe, eoe = (protocol in device.mailbox_protocols for protocol in (MailboxType.FOE, MailboxType.EOE))
    return _GENERAL.pack(group, 0, order, name, _coe_details(device.objects), foe, eoe, 0, 0, 0, 0, _PORTS, 0)


def _coe_details(objects: ObjectDictionary) -> CoeDetail:
    """Return the CoE details; writable PDO objects count as assignable and configurable."""
    details = _COE_DETAILS
    if any(objects[index, 0].access & Access.WO for index in (RX_ASSIGN, TX_ASSIGN)):
        details |= CoeDetail.PDO_ASSIGN
    for obj in objects:
        if (obj.index in RX_MAPPINGS or obj.index in TX_MAPPINGS) and obj.entries[0].access & Access.WO:
            details |= CoeDetail.PDO_CONFIGURATION
    return details


def _sync_manager(objects: ObjectDictionary, sm: SyncManager) -> bytes:
    """Return a sync manager (ETG.1000.6, table 24), with the length of the assigned process data."""
    assignment = {SyncManagerType.OUTPUTS: RX_ASSIGN, SyncManagerType.INPUTS: TX_ASSIGN}.get(sm.type)
    length = sm.length if assignment is None else PdoImage.from_assignment(objects, assignment).byte_length
    return _SYNC_MANAGER.pack(sm.start, length, sm.control, 0, sm.activate, sm.type)


def _pdos(objects: ObjectDictionary, mappings: range, assignment: int, strings: _Strings) -> bytes:
    """Return the PDOs of a direction from their mapping objects (ETG.1000.6, table 25)."""
    assigned = listed(objects, assignment)
    content = b""
    for obj in objects:
        if obj.index not in mappings:
            continue
        mapped = listed(objects, obj.index)
        # 0x1C10 + n is the PDO assignment of sync manager n.
        sync_manager = assignment - 0x1C10 if obj.index in assigned else _NOT_ASSIGNED
        content += _PDO.pack(obj.index, len(mapped), sync_manager, 0, strings.number(obj.name), 0)
        for mapping in mapped:
            index, subindex, bits = split_mapping(mapping)
            name, data_type = 0, 0
            if index:
                entry = objects[index, subindex]
                name, data_type = strings.number(entry.name), int(entry.data_type)
            content += _PDO_ENTRY.pack(index, subindex, name, data_type, bits, 0)
    return content


def _dc(strings: _Strings) -> bytes:
    """Return the operation modes with and without SYNC0 (ETG.2010, table 15); the master chooses the cycle."""
    synchron = _DC_MODE.pack(0, 0, 0, 0, _DC_SYNC0, 1, strings.number("DC Synchron"), 0)
    free = _DC_MODE.pack(0, 0, 0, 0, 0, 0, strings.number("SM Synchron"), 0)
    return synchron + free


READ_8_BYTES = 0x0040
TWO_ADDRESS_BYTES = 0x0080
LARGEST_OF_ONE_ADDRESS_BYTE = 2048
"""Size of a 16 kbit EEPROM, bytes; larger ones have two address bytes (ETG.1000.4, 0x0502 bit 7)."""
WRITE_ENABLE = 0x0001
COMMAND_MASK = 0x0700
READ = 0x0100
WRITE = 0x0200
RELOAD = 0x0400
CHECKSUM_ERROR = 0x0800
COMMAND_ERROR = 0x2000
WRITE_ENABLE_ERROR = 0x4000
BUSY = 0x8000
BUSY_NS = {READ: 20_000, RELOAD: 20_000, WRITE: 500_000}
"""Duration of each command, ns."""
CONFIGURATION_BYTES = 14
"""Bytes covered by the checksum in word 7 (ETG.1000.6, table 16)."""
ALIAS_WORD = 4


class EepromInterface:
    """Serves the EEPROM registers in `memory`; their ownership sets the master's rights in `writable`."""

    def __init__(self, memory: bytearray, writable: bytearray, image: bytes) -> None:
        self._memory = memory
        self._writable = writable
        self.image = bytearray(image)
        """Content of the EEPROM, word addressed, little endian; kept for the life of the process."""
        self._busy_until = 0
        self._command = 0
        self._errors = 0
        self._reload()
        self._store_status()

    def write_config(self) -> None:
        """Handle a write to 0x0500: owner is the master (0) or the device (1); bit 1 forces it back."""
        config = self._memory[Register.EEPROM_CONFIG]
        if config & 0x02:
            self._memory[Register.EEPROM_PDI_ACCESS] = 0
        open_to_master = not config & 0x01
        for address in range(Register.EEPROM_CONTROL, Register.EEPROM_DATA + 8):
            self._writable[address] = open_to_master

    def before_read(self, t: int) -> None:
        """Update the busy flag and the command before the master reads at instant `t`."""
        high = Register.EEPROM_CONTROL + 1
        running = (BUSY | self._command) >> 8 if t < self._busy_until else 0
        self._memory[high] = self._memory[high] & ~((BUSY | COMMAND_MASK) >> 8) | running

    def write_control(self, t: int) -> None:
        """Execute the command written to 0x0502 at instant `t`."""
        memory = self._memory
        control = int.from_bytes(memory[Register.EEPROM_CONTROL : Register.EEPROM_CONTROL + 2], "little")
        command = control & COMMAND_MASK
        word = int.from_bytes(memory[Register.EEPROM_ADDRESS : Register.EEPROM_ADDRESS + 4], "little")
        self._errors &= CHECKSUM_ERROR
        if t < self._busy_until:
            # A running command continues; a new one is lost.
            self._errors |= COMMAND_ERROR if command else 0
        else:
            self._command = command
            if command == READ:
                self._read(word)
            elif command == WRITE:
                self._write(word, bool(control & WRITE_ENABLE))
            elif command == RELOAD:
                self._reload()
            elif command:
                self._errors |= COMMAND_ERROR
            if command in BUSY_NS and not self._errors & (COMMAND_ERROR | WRITE_ENABLE_ERROR):
                self._busy_until = t + BUSY_NS[command]
        self._store_status()

    def _read(self, word: int) -> None:
        data = self.image[2 * word : 2 * word + 8]
        # An EEPROM answers to every address; erased cells read as ones.
        self._memory[Register.EEPROM_DATA : Register.EEPROM_DATA + 8] = bytes(data).ljust(8, b"\xff")

    def _write(self, word: int, enabled: bool) -> None:
        if not enabled:
            self._errors |= WRITE_ENABLE_ERROR
        elif 2 * word + 2 > len(self.image):
            self._errors |= COMMAND_ERROR
        else:
            self.image[2 * word : 2 * word + 2] = self._memory[Register.EEPROM_DATA : Register.EEPROM_DATA + 2]

    def _reload(self) -> None:
        """Load PDI control and station alias from the EEPROM if its checksum is correct."""
        self._errors = 0
        if len(self.image) < 16 or self.image[CONFIGURATION_BYTES] != crc(bytes(self.image[:CONFIGURATION_BYTES])):
            self._errors = CHECKSUM_ERROR
            return
        self._memory[Register.PDI_CONTROL : Register.PDI_CONTROL + 2] = self.image[0:2]
        self._memory[Register.ALIAS : Register.ALIAS + 2] = self.image[2 * ALIAS_WORD : 2 * ALIAS_WORD + 2]

    def _store_status(self) -> None:
        status = READ_8_BYTES | self._errors
        if len(self.image) > LARGEST_OF_ONE_ADDRESS_BYTE:
            status |= TWO_ADDRESS_BYTES
        self._memory[Register.EEPROM_CONTROL : Register.EEPROM_CONTROL + 2] = status.to_bytes(2, "little")
