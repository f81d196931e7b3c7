"""SII images (ETG.1000.6, 5.4, and ETG.2010): reader and writer of the EEPROM content.

The writer writes one category of each kind, in ascending order, and an end mark: SOEM reads only the first category of
a kind, IgH requires a general category of 32 bytes and the sync managers before the PDOs, and both require the end
mark.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Iterator

from rtcp.esi import model, types

HEADER_BYTES = 128
MAX_BYTES = 1 << 17
"""Largest image: categories are addressed in words of 16 bits."""
SOEM_BYTES = 4096
"""Size of an image that SOEM and IgH read."""

_STRINGS, _GENERAL, _FMMU, SYNC_MANAGERS, _TX_PDO, _RX_PDO, _DC, END = 10, 30, 40, 41, 50, 51, 60, 0xFFFF
_ORDER = (_STRINGS, _GENERAL, _FMMU, SYNC_MANAGERS, _TX_PDO, _RX_PDO, _DC)
_SYNC_MANAGER_ENTRY = struct.Struct("<HHBBBB")
_PDO_HEADER = struct.Struct("<HBBBBH")
_PDO_ENTRY = struct.Struct("<HBBBBH")
_DC_ENTRY = struct.Struct("<IiihHhBB4x")
_FIXED, _MANDATORY, _VIRTUAL = 0x10, 0x01, 0x20
"""Flags of a PDO (ETG.2010, table 14)."""
_PROTOCOLS = ((0x01, "aoe"), (0x02, "eoe"), (0x04, "coe"), (0x08, "foe"), (0x10, "soe"), (0x20, "voe"))
"""Bits of word 0x1C (ETG.1000.6, table 18)."""
_COE = (
    (0x02, "sdo_information"),
    (0x04, "pdo_assignment"),
    (0x08, "pdo_configuration"),
    (0x10, "pdo_upload"),
    (0x20, "complete_access"),
)
_PORTS = {"Y": 1, "B": 1, "K": 3, "H": 4}
"""Port types of the general category: MII, E-bus, fast hot connect."""
_PORT_LETTERS = {1: "Y", 3: "K", 4: "H"}
_LONGEST_ENTRY = 248
"""Bits of each part of a longer entry: the length of an entry is one byte, and a part has whole bytes."""


def crc(data: bytes) -> int:
    """Return the CRC of the first seven words (polynomial 0x07, start 0xFF)."""
    value = 0xFF
    for byte in data:
        value ^= byte
        for _ in range(8):
            value = (value << 1 ^ 0x07) & 0xFF if value & 0x80 else value << 1
    return value


class _Texts:
    """The category of strings: each text once, by number from 1."""

    def __init__(self) -> None:
        self._numbers: dict[bytes, int] = {}

    def number(self, text: str) -> int:
        """Return the number of a text; 0 for an empty one, or if all numbers are used."""
        data = text.encode("utf-8", "replace")[:255]
        if not data or (data not in self._numbers and len(self._numbers) == 255):
            return 0
        return self._numbers.setdefault(data, len(self._numbers) + 1)

    def data(self) -> bytes:
        """Return the category."""
        return bytes([len(self._numbers)]) + b"".join(bytes([len(text)]) + text for text in self._numbers)


def _pdo_data(pdos: tuple[model.Pdo, ...], texts: _Texts, entry_names: bool) -> bytes:
    data = b""
    for pdo in pdos:
        entries = b""
        count = 0
        name = texts.number(pdo.name)
        for entry in pdo.entries:
            remaining = entry.bits
            number = types.resolve(entry.type, entry.bits).number & 0xFF
            text = texts.number(entry.name) if entry_names else 0
            while remaining > 0:
                bits = remaining if remaining <= 255 else _LONGEST_ENTRY
                entries += _PDO_ENTRY.pack(entry.index, entry.sub_index, text, number if entry.index else 0, bits, 0)
                count += 1
                remaining -= bits
        if count > 255:
            raise model.EsiError(f"PDO 0x{pdo.index:04X}", f"{count} entries; an SII image holds at most 255 of a PDO")
        flags = _FIXED * pdo.fixed | _MANDATORY * pdo.mandatory | _VIRTUAL * pdo.virtual
        sync_manager = 0xFF if pdo.sync_manager is None else pdo.sync_manager
        data += _PDO_HEADER.pack(pdo.index, count, sync_manager, 0, name, flags) + entries
    return data


def _general(device: model.Device, texts: _Texts) -> bytes:
    mailbox = device.mailbox or model.Mailbox()
    coe = 0
    if mailbox.coe is not None:
        coe = 1 | sum(bit for bit, name in _COE if getattr(mailbox.coe, name))
    ports = sum(_PORTS.get(letter, 0) << 4 * port for port, letter in enumerate(device.physics[:4]))
    order, group, group_name, name = (
        texts.number(text) for text in (device.type, device.group, device.group_name, device.name)
    )
    return struct.pack(
        "<12BhBxH14x",
        group,
        0,
        order,
        name,
        0,
        coe,
        mailbox.foe,
        mailbox.eoe,
        mailbox.soe,
        mailbox.coe.ds402_channels if mailbox.coe is not None else 0,
        0,
        device.no_lrw << 1 | mailbox.data_link_layer << 2,
        device.ebus_current,
        group_name,
        ports,
    )


def _header(device: model.Device, alias: int, size: int) -> bytes:
    config = bytearray(device.config_data.ljust(14, b"\0"))
    if alias:
        config[8:10] = alias.to_bytes(2, "little")
    boxes = {sync.type: sync for sync in reversed(device.sync_managers) if sync.length}
    receive, send = (
        boxes.get(kind) for kind in (model.SyncManagerType.MAILBOX_RECEIVE, model.SyncManagerType.MAILBOX_SEND)
    )
    mailbox = device.mailbox
    protocols = 0
    if mailbox is not None:
        protocols = sum(bit for bit, name in _PROTOCOLS if getattr(mailbox, name))
    identity = device.identity
    header = bytes(config) + struct.pack(
        "<H4I8x8s4HH",
        crc(bytes(config)),
        identity.vendor_id,
        identity.product_code,
        identity.revision,
        identity.serial,
        device.bootstrap[:8].ljust(8, b"\0"),
        receive.start if receive else 0,
        receive.length if receive else 0,
        send.start if send else 0,
        send.length if send else 0,
        protocols,
    )
    return header.ljust(124, b"\0") + struct.pack("<HH", max(size // 128 - 1, 0), 1)


def _categories(device: model.Device, pdos: bool, entry_names: bool) -> bytes:
    texts = _Texts()
    general = _general(device, texts)
    dc = b"".join(
        _DC_ENTRY.pack(
            mode.sync0_cycle & 0xFFFFFFFF,
            mode.sync0_shift,
            mode.sync1_shift,
            max(min(mode.sync1_factor, 32767), -32768),
            mode.assign_activate,
            max(min(mode.sync0_factor, 32767), -32768),
            texts.number(mode.name),
            texts.number(mode.description),
        )
        for mode in device.dc_modes
    )
    tx_pdos = _pdo_data(device.tx_pdos, texts, entry_names) if pdos else b""
    rx_pdos = _pdo_data(device.rx_pdos, texts, entry_names) if pdos else b""
    sync_managers = b"".join(
        _SYNC_MANAGER_ENTRY.pack(
            sync.start, sync.length, sync.control, 0, sync.enabled | sync.virtual << 2 | sync.op_only << 3, sync.type
        )
        for sync in device.sync_managers
    )
    data = {
        _STRINGS: texts.data(),
        _GENERAL: general,
        _FMMU: bytes(use or 0xFF for use in device.fmmus),
        SYNC_MANAGERS: sync_managers,
        _TX_PDO: tx_pdos,
        _RX_PDO: rx_pdos,
        _DC: dc,
    }
    image = b""
    for number in _ORDER:
        body = data[number] + (b"\xff" if number == _FMMU else b"\0") * (len(data[number]) % 2)
        if body:
            image += struct.pack("<HH", number, len(body) // 2) + body
    return image + struct.pack("<H", END)


def write_sii(device: model.Device, alias: int | None = None) -> bytes:
    """Return the SII image of a device, of its EEPROM's size or larger where that cannot hold it.

    Where the image does not fit, the PDOs are left out if the device has CoE (they are read by SDO), else the names of
    their entries. Raises EsiError where a PDO or the image is beyond what an SII image can hold.
    """
    alias = device.station_alias if alias is None else alias
    size = device.eeprom_bytes
    contents = [(True, True), (False, True) if device.coe is not None else (True, False)]
    data = b""
    for pdos, entry_names in contents if size else contents[:1]:
        data = _categories(device, pdos, entry_names)
        if HEADER_BYTES + len(data) <= size:
            break
    needed = HEADER_BYTES + len(data)
    if needed > size:
        size = 1 << (needed - 1).bit_length()
    if size > MAX_BYTES:
        raise model.EsiError(device.origin, f"an SII image of {needed} bytes; it can have {MAX_BYTES}")
    return (_header(device, alias, size) + data).ljust(size, b"\xff")


def _split(image: bytes) -> Iterator[tuple[int, bytes, bool]]:
    """Yield number, data and completeness of each category; the end mark, if there is one, last and without data."""
    position = HEADER_BYTES
    while position + 2 <= len(image):
        number = int.from_bytes(image[position : position + 2], "little")
        if number == END:
            yield END, b"", True
            return
        if position + 4 > len(image):
            yield number, b"", False
            return
        length = 2 * int.from_bytes(image[position + 2 : position + 4], "little")
        data = image[position + 4 : position + 4 + length]
        yield number, data, len(data) == length
        position += 4 + length


def _read_texts(data: bytes) -> list[str]:
    texts = [""]
    position = 1
    for _ in range(data[0] if data else 0):
        if position >= len(data):
            break
        text = data[position + 1 : position + 1 + data[position]]
        texts.append(_text(text))
        position += 1 + data[position]
    return texts


def _text(data: bytes) -> str:
    data = data.rstrip(b"\0")
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError:
        return data.decode("latin-1")


def _read_pdos(data: bytes, texts: dict[int, str]) -> tuple[model.Pdo, ...]:
    pdos = []
    position = 0
    while position + _PDO_HEADER.size <= len(data):
        index, count, sync_manager, _, name, flags = _PDO_HEADER.unpack_from(data, position)
        position += _PDO_HEADER.size
        entries = []
        for _ in range(count):
            if position + _PDO_ENTRY.size > len(data):
                break
            entry, sub_index, text, number, bits, _ = _PDO_ENTRY.unpack_from(data, position)
            position += _PDO_ENTRY.size
            kind = types.of_number(number, bits).name if entry or number else ""
            entries.append(model.PdoEntry(entry, sub_index, bits, texts.get(text, ""), kind))
        pdos.append(
            model.Pdo(
                index=index,
                name=texts.get(name, ""),
                entries=tuple(entries),
                sync_manager=None if sync_manager == 0xFF else sync_manager,
                fixed=bool(flags & _FIXED),
                mandatory=bool(flags & _MANDATORY),
                virtual=bool(flags & _VIRTUAL),
            )
        )
    return tuple(pdos)


def read_sync_managers(data: bytes) -> tuple[model.SyncManager, ...]:
    """Return the sync managers of a category."""
    return tuple(
        model.SyncManager(
            start=start,
            length=length,
            control=control,
            type=model.SyncManagerType(kind) if kind <= model.SyncManagerType.INPUTS else model.SyncManagerType.UNUSED,
            enabled=bool(enable & 1),
            virtual=bool(enable & 4),
            op_only=bool(enable & 8),
        )
        for start, length, control, _, enable, kind in _SYNC_MANAGER_ENTRY.iter_unpack(data[: len(data) // 8 * 8])
    )


def read_sii(image: bytes, origin: str = "SII image") -> model.Device:
    """Return the device described by an image, possibly incomplete; `check_sii` returns its mistakes.

    Raises EsiError where it is too short for its fixed part.
    """
    if len(image) < HEADER_BYTES:
        raise model.EsiError(origin, f"{len(image)} bytes; the fixed part of an SII image alone has {HEADER_BYTES}")
    categories: dict[int, bytes] = {}
    unread: Counter[str] = Counter()
    for number, data, _ in _split(image):
        if number in _ORDER:  # some tools write several categories of a number: they are joined
            categories[number] = categories.get(number, b"") + data
        elif number != END:
            unread[f"category {number}"] += 1
    texts = dict(enumerate(_read_texts(categories.get(_STRINGS, b""))))
    general = categories.get(_GENERAL, b"").ljust(32, b"\0")
    group, order, name, coe, channels, flags, current, group_name, ports = struct.unpack(
        "<BxBBxB3xBxBhBxH", general[:18]
    )
    vendor, product, revision, serial = struct.unpack_from("<4I", image, 16)
    protocols = int.from_bytes(image[56:58], "little")
    mailbox = None
    if protocols:
        mailbox = model.Mailbox(
            coe=model.Coe(**{key: bool(coe & bit) for bit, key in _COE}, ds402_channels=channels)
            if protocols & 0x04
            else None,
            **{key: bool(protocols & bit) for bit, key in _PROTOCOLS if key != "coe"},
            data_link_layer=bool(flags & 4),
        )
    fmmus = tuple(model.FmmuUse(use) if use <= 3 else model.FmmuUse.UNUSED for use in categories.get(_FMMU, b""))
    dc_data = categories.get(_DC, b"")
    return model.Device(
        identity=model.Identity(vendor, product, revision, serial),
        name=texts.get(name, "") or texts.get(1, ""),
        source=model.Source.SII,
        origin=origin,
        type=texts.get(order, ""),
        group=texts.get(group, ""),
        group_name=texts.get(group_name, ""),
        physics="".join(_PORT_LETTERS.get(ports >> 4 * port & 15, " ") for port in range(4)).rstrip(),
        sync_managers=read_sync_managers(categories.get(SYNC_MANAGERS, b"")),
        fmmus=fmmus,
        rx_pdos=_read_pdos(categories.get(_RX_PDO, b""), texts),
        tx_pdos=_read_pdos(categories.get(_TX_PDO, b""), texts),
        mailbox=mailbox,
        dc_modes=tuple(
            model.DcMode(
                name=texts.get(text, ""),
                assign_activate=activate,
                description=texts.get(description, ""),
                sync0_cycle=cycle0,
                sync0_factor=factor0,
                sync0_shift=shift0,
                sync1_factor=factor1,
                sync1_shift=shift1,
            )
            for cycle0, shift0, shift1, factor1, activate, factor0, text, description in _DC_ENTRY.iter_unpack(
                dc_data[: len(dc_data) // 24 * 24]
            )
        ),
        eeprom_bytes=(int.from_bytes(image[124:126], "little") + 1) * 128,
        config_data=image[:14],
        bootstrap=image[40:48] if any(image[40:48]) else b"",
        station_alias=int.from_bytes(image[8:10], "little"),
        ebus_current=current,
        no_lrw=bool(flags & 2),
        unread=dict(unread),
    )


def check_sii(image: bytes) -> tuple[str, ...]:
    """Return a sentence for each mistake in an image and each part that a master would not see."""
    if len(image) < HEADER_BYTES:
        return (f"{len(image)} bytes; the fixed part of an SII image alone has {HEADER_BYTES}.",)
    mistakes = []
    expected = crc(image[:14])
    if image[14] != expected:
        mistakes.append(f"The CRC of the first seven words is 0x{image[14]:02X}, not 0x{expected:02X}.")
    size = (int.from_bytes(image[124:126], "little") + 1) * 128
    if size < HEADER_BYTES or size > MAX_BYTES:
        mistakes.append(f"Its size is given as {size} bytes; allowed are {HEADER_BYTES} to {MAX_BYTES}.")
    if image[56:58] != b"\0\0" and image[50:52] == b"\0\0":
        mistakes.append("It lists mailbox protocols and no mailbox size (word 0x19): SOEM and IgH see no mailbox.")
    categories = list(_split(image))
    numbers = [number for number, *_ in categories]
    mistakes += [f"Category {number} is longer than the image." for number, _, whole in categories if not whole]
    if END not in numbers:
        mistakes.append("The end mark 0xFFFF is missing: IgH drops all categories.")
    mistakes += [
        f"Category {number} occurs {count} times: SOEM reads the first only."
        for number, count in Counter(numbers).items()
        if count > 1 and number in _ORDER
    ]
    data = dict(reversed([(number, body) for number, body, _ in categories]))
    if _GENERAL not in numbers:
        mistakes.append("Category 30 (general) is missing: SOEM uses no complete access, IgH no names.")
    elif len(data[_GENERAL]) != 32:
        mistakes.append(f"Category 30 (general) has {len(data[_GENERAL])} bytes, not 32: IgH refuses it.")
    if len(data.get(SYNC_MANAGERS, b"")) % 8:
        mistakes.append(f"Category 41 (sync managers) has {len(data[SYNC_MANAGERS])} bytes, no multiple of 8.")
    pdos = [numbers.index(number) for number in (_TX_PDO, _RX_PDO) if number in numbers]
    if pdos and SYNC_MANAGERS in numbers and numbers.index(SYNC_MANAGERS) > min(pdos):
        mistakes.append("Category 41 (sync managers) stands behind the PDOs: IgH cannot assign them.")
    used = HEADER_BYTES + sum(4 + len(body) for _, body, _ in categories)
    if used > SOEM_BYTES:
        mistakes.append(f"It has {used} bytes of categories: SOEM and IgH read {SOEM_BYTES}.")
    if used > size:
        mistakes.append(f"It needs {used} bytes, and gives its size as {size}.")
    return tuple(mistakes)
