"""A slave of the in-process bus: what controller and firmware add to a device model, without registers and frames."""

from __future__ import annotations

import struct
from collections.abc import Sequence

from rtcp.config.model import DeviceDescription, Pdo, SlaveConfig, StartupSdo
from rtcp.virtual import coe as sdo_access
from rtcp.virtual.al_state import AlStatusCode
from rtcp.virtual.device import DeviceModel
from rtcp.virtual.objects import AbortCode, SdoAbort
from rtcp.virtual.pdo import RX_ASSIGN, TX_ASSIGN, PdoImage
from rtcp.virtual.protocol import State

TYPES = {
    "bool": (1, "B"), "int8": (8, "b"), "uint8": (8, "B"), "int16": (16, "h"), "uint16": (16, "H"), "int32": (32, "i"),
    "uint32": (32, "I"), "int64": (64, "q"), "uint64": (64, "Q"), "float32": (32, "f"), "float64": (64, "d"),
}  # fmt: skip
"""Bits and `struct` code of the types of a device's description (ETG.1000.6, table 64)."""
_ABSENT = (AbortCode.NO_OBJECT, AbortCode.NO_SUBINDEX)
_INTERPOLATION = 0x60C2
_SYNC_LIMIT = (0x10F1, 2)
_MISSED, _MET = 3, 1
"""What a SYNC0 without outputs adds to the sync error counter, and one with outputs takes away (ETG.1020, 21.2)."""


class InProcessError(Exception):
    """The bus or a slave on it refused: `sentences` say what and where; `code` is the SDO abort code, 0 without one."""

    def __init__(self, *sentences: str, code: int = 0) -> None:
        super().__init__("\n".join(sentences))
        self.sentences = sentences
        self.code = code


class InProcessSlave:
    """A device on the bus at `position` (from 1), in INIT at first."""

    def __init__(self, device: DeviceModel, position: int) -> None:
        self.device = device
        self.position = position
        self.name = device.identity.name
        self.state = State.INIT
        self.error = False
        self.code = AlStatusCode.NO_ERROR
        self.by_sync0 = False
        self.shift_ns = 0
        """SYNC0 of this slave, later than the clock's own whole cycles."""
        self.watchdog_ns = 100_000_000
        self.outputs = b""
        """The buffer that the master writes."""
        self.inputs = b""
        """The buffer that the master reads."""
        self._taken = b""
        self._sync_errors = 0
        self._sync_limit = 0
        self._map()

    def _map(self) -> None:
        self._rx = PdoImage.from_assignment(self.device.objects, RX_ASSIGN)
        self._tx = PdoImage.from_assignment(self.device.objects, TX_ASSIGN)
        self.outputs = bytes(self._rx.byte_length)
        self._refresh()

    @property
    def label(self) -> str:
        """How sentences name it."""
        return f"slave {self.position} ({self.name})"

    @property
    def output_bytes(self) -> int:
        """Length of its outputs."""
        return self._rx.byte_length

    @property
    def input_bytes(self) -> int:
        """Length of its inputs."""
        return self._tx.byte_length

    @property
    def hears(self) -> bool:
        """Whether it takes outputs: from SAFE-OP on, not after an error that is not acknowledged."""
        return self.state >= State.SAFE_OP and not self.error

    @property
    def counts(self) -> int:
        """What it adds to the working counter of an exchange: 1 for inputs, 2 for outputs that it took."""
        if self.state < State.SAFE_OP:
            return 0
        return (1 if self.input_bytes else 0) + (2 if self.output_bytes and self.hears else 0)

    # -- what the master asks ---------------------------------------------------------------------------------------

    def configure(self, config: SlaveConfig, period_ns: int) -> list[str]:
        """Set it up in PRE-OP as its description says; return sentences on what was tolerated.

        Raises:
            InProcessError: it refuses something, or maps other process data than the description.
        """
        device = config.device
        self.name = config.name
        for assignment, pdos, key in ((RX_ASSIGN, device.rpdo, "rpdo"), (TX_ASSIGN, device.tpdo, "tpdo")):
            if device.configurable_pdos:
                self._write_mapping(assignment, pdos)
            self._compare(assignment, pdos, key)
        notes = [note for startup in device.sdo for note in self._write_startup(startup)]
        if device.kind == "cia402":
            notes += self._write_interpolation(period_ns)
        self.by_sync0 = bool(device.assign_activate) and self.device.supports_dc
        self.shift_ns = round(device.sync0_shift_us * 1000)
        self.watchdog_ns = round(device.watchdog_ms * 1e6)
        self._map()
        return notes

    def request(self, wanted: State, fed: bool) -> None:
        """Go to `wanted`; `fed`: outputs have come lately, without which there is no OP."""
        if self.error and wanted > self.state:
            return
        if wanted == State.OP and not fed:
            self.fall(State.SAFE_OP, AlStatusCode.SYNC_MANAGER_WATCHDOG)
            return
        before, self.state = self.state, wanted
        self.error, self.code = False, AlStatusCode.NO_ERROR
        if before == State.OP and wanted < State.OP:
            self.device.set_outputs_valid(False)
        elif wanted == State.OP and before < State.OP:
            objects = self.device.objects
            self._sync_limit = int(objects[_SYNC_LIMIT].value) if _SYNC_LIMIT in objects else 0
            self._sync_errors = 0
            # What the master sent before is not for now: nothing until the next frame.
            self.outputs = bytes(self.output_bytes)
            self.device.set_outputs_valid(True)
        self._refresh()

    def acknowledge(self) -> None:
        """Take the error indication back; the state stays."""
        self.error, self.code = False, AlStatusCode.NO_ERROR

    def fall(self, state: State, code: AlStatusCode) -> None:
        """Leave the state on an error, the outputs ignored."""
        if self.state == State.OP and state < State.OP:
            self.device.set_outputs_valid(False)
        self.state, self.error, self.code = state, True, code

    def read(self, index: int, subindex: int) -> bytes:
        """Return an object's value; raises InProcessError with the abort code."""
        try:
            return sdo_access.read(self.device.objects, index, subindex, False, self._mailbox_state())
        except SdoAbort as abort:
            raise self._refused("read", index, subindex, abort) from abort

    def write(self, index: int, subindex: int, data: bytes) -> None:
        """Write an object's value; raises InProcessError with the abort code."""
        try:
            sdo_access.write(self.device.objects, index, subindex, False, self._mailbox_state(), data)
        except SdoAbort as abort:
            raise self._refused("write", index, subindex, abort) from abort
        self._taken = b""

    def _mailbox_state(self) -> int:
        if self.state < State.PRE_OP:
            raise InProcessError(f"{self.label} is in INIT, where it has no mailbox")
        return int(self.state)

    def _refused(self, what: str, index: int, subindex: int, abort: SdoAbort) -> InProcessError:
        return InProcessError(
            f"{self.label} refused to {what} 0x{index:04X}:{subindex} with abort code 0x{abort.code:08X}",
            code=abort.code,
        )

    # -- what time does ---------------------------------------------------------------------------------------------

    def advance(self, dt: float) -> None:
        """Let `dt` seconds pass in the device: outputs in (in OP), a step, inputs out (from SAFE-OP on)."""
        state = self.state
        if state is State.OP and self.outputs is not self._taken:
            self._rx.unpack(self.outputs)
            self._taken = self.outputs
        self.device.step(dt)
        if state >= State.SAFE_OP:
            self.inputs = self._tx.packed()

    def watch(self, since_fed_ns: int, came: bool) -> bool:
        """Look after watchdog and, at a SYNC0, sync error; return whether it has left OP."""
        if self.state is not State.OP:
            return False
        if since_fed_ns > self.watchdog_ns:
            self.fall(State.SAFE_OP, AlStatusCode.SYNC_MANAGER_WATCHDOG)
            return True
        if not self.by_sync0:
            return False
        self._sync_errors = max(0, self._sync_errors - _MET) if came else self._sync_errors + _MISSED
        if 0 < self._sync_limit < self._sync_errors:
            self.fall(State.SAFE_OP, AlStatusCode.SYNC_ERROR)
            return True
        return False

    @property
    def in_doubt(self) -> bool:
        """Whether its sync error counter is not zero."""
        return self._sync_errors > 0

    def _refresh(self) -> None:
        self._taken = b""
        self.inputs = self._tx.packed()

    # -- setting up -------------------------------------------------------------------------------------------------

    def _write_mapping(self, assignment: int, pdos: Sequence[Pdo]) -> None:
        self.write(assignment, 0, b"\0")
        for pdo in pdos:
            self.write(pdo.index, 0, b"\0")
            for place, entry in enumerate(pdo.channels, 1):
                mapping = entry.index << 16 | (entry.sub_index if entry.index else 0) << 8 | TYPES[entry.type][0]
                self.write(pdo.index, place, mapping.to_bytes(4, "little"))
            self.write(pdo.index, 0, bytes((len(pdo.channels),)))
        for place, pdo in enumerate(pdos, 1):
            self.write(assignment, place, pdo.index.to_bytes(2, "little"))
        self.write(assignment, 0, bytes((len(pdos),)))

    def _compare(self, assignment: int, pdos: Sequence[Pdo], key: str) -> None:
        image = PdoImage.from_assignment(self.device.objects, assignment)
        found = [(entry.index, entry.subindex, entry.bit_length) for entry in image.entries]
        channels = [entry for pdo in pdos for entry in pdo.channels]
        wanted = [(entry.index, entry.sub_index, TYPES[entry.type][0]) for entry in channels if entry.index]
        bits = sum(TYPES[entry.type][0] for entry in channels)
        if found != wanted or bits != image.bit_length:
            raise InProcessError(
                f"{self.label} maps {image.bit_length} bits through 0x{assignment:04X}, and the device's file "
                f"(key `{key}`) describes other entries, {bits} bits"
            )

    def _write_startup(self, startup: StartupSdo) -> list[str]:
        what = f"0x{startup.index:04X}:{startup.sub_index}"
        code = TYPES[startup.type][1]
        data = struct.pack("<" + code, startup.value if code in "fd" else int(startup.value))
        try:
            self.write(startup.index, startup.sub_index, data)
        except InProcessError as error:
            if startup.optional and error.code in _ABSENT:
                return [f"{self.label} has no {what}; it is marked optional and was left out"]
            raise
        return []

    def _write_interpolation(self, period_ns: int) -> list[str]:
        value, exponent = period_ns, -9
        while value % 10 == 0:
            value, exponent = value // 10, exponent + 1
        if value > 0xFF:
            return [f"{self.label}: 0x60C2 cannot say {period_ns / 1000:g} us and was left as it is"]
        self.write(_INTERPOLATION, 1, bytes((value,)))
        self.write(_INTERPOLATION, 2, exponent.to_bytes(1, "little", signed=True))
        return []


def identity_faults(slaves: Sequence[InProcessSlave], expected: Sequence[SlaveConfig]) -> list[str]:
    """Return a sentence for each position where the slaves differ from those of the configuration."""
    if len(slaves) != len(expected):
        return [f"{len(slaves)} slaves are on the bus, the configuration (key `slaves`) lists {len(expected)}"]

    def numbers(vendor: int, product: int) -> str:
        return f"vendor 0x{vendor:08X}, product 0x{product:08X}"

    faults = []
    for slave, config in zip(slaves, expected, strict=True):
        device: DeviceDescription = config.device
        found = slave.device.identity
        if (found.vendor_id, found.product_code) != (device.vendor_id, device.product_id):
            faults.append(
                f"position {slave.position} ({config.name}): expected {numbers(device.vendor_id, device.product_id)}, "
                f"found {found.name} ({numbers(found.vendor_id, found.product_code)})"
            )
    return faults
