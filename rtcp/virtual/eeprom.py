"""The SII EEPROM interface of a slave controller (ETG.1000.4, 6.5): registers 0x0500 to 0x050F."""

from __future__ import annotations

from rtcp.virtual.registers import Register
from rtcp.virtual.sii import crc8

READ_8_BYTES = 0x0040
TWO_ADDRESS_BYTES = 0x0080
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
"""How long a command keeps the interface busy, in ns."""
CONFIGURATION_BYTES = 14
"""Bytes that the checksum in word 7 covers (ETG.1000.6, table 16)."""
ALIAS_WORD = 4


class EepromInterface:
    """Serves the EEPROM registers in `memory`; `writable` opens and closes them for the master with their ownership."""

    def __init__(self, memory: bytearray, writable: bytearray, image: bytes) -> None:
        self._memory = memory
        self._writable = writable
        self.image = bytearray(image)
        """The EEPROM's content, word addressed, little endian; kept through the life of the process."""
        self._busy_until = 0
        self._errors = 0
        self._reload()
        self._store_status()

    def write_config(self) -> None:
        """0x0500 was written: the interface is the master's (0) or the device's (1); bit 1 takes it back by force."""
        config = self._memory[Register.EEPROM_CONFIG]
        if config & 0x02:
            self._memory[Register.EEPROM_PDI_ACCESS] = 0
        open_to_master = not config & 0x01
        for address in range(Register.EEPROM_CONTROL, Register.EEPROM_DATA + 8):
            self._writable[address] = open_to_master

    def before_read(self, t: int) -> None:
        """Bring the busy flag up to date before the master looks at instant `t`."""
        busy = BUSY >> 8 if t < self._busy_until else 0
        high = Register.EEPROM_CONTROL + 1
        self._memory[high] = self._memory[high] & ~(BUSY >> 8) | busy

    def write_control(self, t: int) -> None:
        """0x0502 was written at instant `t`: carry the command out."""
        memory = self._memory
        control = int.from_bytes(memory[Register.EEPROM_CONTROL : Register.EEPROM_CONTROL + 2], "little")
        command = control & COMMAND_MASK
        word = int.from_bytes(memory[Register.EEPROM_ADDRESS : Register.EEPROM_ADDRESS + 4], "little")
        self._errors &= CHECKSUM_ERROR
        if command and t < self._busy_until:
            self._errors |= COMMAND_ERROR
        elif command == READ:
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
        # An EEPROM answers every address; erased cells read as ones.
        self._memory[Register.EEPROM_DATA : Register.EEPROM_DATA + 8] = bytes(data).ljust(8, b"\xff")

    def _write(self, word: int, enabled: bool) -> None:
        if not enabled:
            self._errors |= WRITE_ENABLE_ERROR
        elif 2 * word + 2 > len(self.image):
            self._errors |= COMMAND_ERROR
        else:
            self.image[2 * word : 2 * word + 2] = self._memory[Register.EEPROM_DATA : Register.EEPROM_DATA + 2]

    def _reload(self) -> None:
        """Take PDI control and station alias from the EEPROM, if its checksum is right."""
        self._errors = 0
        if len(self.image) < 16 or self.image[CONFIGURATION_BYTES] != crc8(bytes(self.image[:CONFIGURATION_BYTES])):
            self._errors = CHECKSUM_ERROR
            return
        self._memory[Register.PDI_CONTROL : Register.PDI_CONTROL + 2] = self.image[0:2]
        self._memory[Register.ALIAS : Register.ALIAS + 2] = self.image[2 * ALIAS_WORD : 2 * ALIAS_WORD + 2]

    def _store_status(self) -> None:
        status = READ_8_BYTES | TWO_ADDRESS_BYTES | self._errors
        self._memory[Register.EEPROM_CONTROL : Register.EEPROM_CONTROL + 2] = status.to_bytes(2, "little")
