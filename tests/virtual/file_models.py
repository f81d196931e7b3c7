"""Models of another package: a file server over FoE, and a device with too long process data."""

from __future__ import annotations

import struct
from collections.abc import Iterator

from rtcp.virtual.device import DeviceModel
from rtcp.virtual.objects import Access, DataType, Entry, ObjectDictionary
from rtcp.virtual.pdo import define_pdo_objects
from rtcp.virtual.protocol import MailboxType

READ, WRITE, DATA, ACKNOWLEDGE, ERROR = 1, 2, 3, 4, 5
"""Operation codes of FoE (ETG.1000.6, 5.8)."""
NOT_FOUND = 0x8001
HEADER = struct.Struct("<BxI")


class FileServer(DeviceModel):
    """Keeps files, which are read and written over FoE."""

    vendor_id, product_code = 0x0E2A, 3
    name, group, order_code = "File server", "Tests", "F1"
    uses_sync0 = False
    channels = times = 1

    def __init__(self, **options: object) -> None:
        super().__init__(**options)
        self.mailbox_protocols[MailboxType.FOE] = self._foe
        self.files = {"firmware": bytes(range(256)) * 2}
        self._name, self._rest = "", b""

    def define(self, objects: ObjectDictionary) -> None:
        entries = [
            Entry(0x6000, n, f"Channel {n}", DataType.UNSIGNED64, 0, Access.RO | Access.TXPDO)
            for n in range(1, self.channels + 1)
        ]
        objects.record(0x6000, "Channels", entries)
        mapped = [(0x6000, entry.subindex, 64) for entry in entries] * self.times
        define_pdo_objects(objects, {}, {0x1A00: mapped}, [], [0x1A00], fixed=True)

    def step(self, dt: float) -> None:
        """Nothing changes."""

    def _foe(self, message: bytes, room: int) -> Iterator[bytes]:
        operation, number = HEADER.unpack_from(message)
        content, most = message[HEADER.size :], room - HEADER.size
        if operation == READ and content.decode() not in self.files:
            yield HEADER.pack(ERROR, NOT_FOUND)
        elif operation == READ:
            self._rest = self.files[content.decode()]
            yield HEADER.pack(DATA, 1) + self._rest[:most]
        elif operation == ACKNOWLEDGE and len(self._rest) >= most:
            self._rest = self._rest[most:]
            yield HEADER.pack(DATA, number + 1) + self._rest[:most]
        elif operation == WRITE:
            self._name = content.decode()
            self.files[self._name] = b""
            yield HEADER.pack(ACKNOWLEDGE, 0)
        elif operation == DATA:
            self.files[self._name] += content
            yield HEADER.pack(ACKNOWLEDGE, number)


class TooLong(FileServer):
    """3200 bytes of inputs, more than the memory has room for three times."""

    channels, times = 200, 2
