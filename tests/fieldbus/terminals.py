"""Slaves of many kinds: SII images for the segment, device descriptions for the master, and behaviours."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from rtcp.config.model import DeviceDescription, Pdo, PdoEntry, SlaveConfig
from rtcp.esi import model
from rtcp.esi.sii import write_sii
from rtcp.virtual.behaviour import Behaviour, FileBusy, FileRefused, FoeError
from rtcp.virtual.protocol import AlState

ESI_FILES = Path(__file__).parents[1] / "esi" / "files"
VENDOR = 0x0E2A
OUT, IN = 0x7000, 0x6000
MAILBOX = (
    model.SyncManager(0x1000, 128, 0x26, model.SyncManagerType.MAILBOX_RECEIVE),
    model.SyncManager(0x1080, 128, 0x22, model.SyncManagerType.MAILBOX_SEND),
)
Areas = Sequence[tuple[int, int, int]]
"""Sync manager, start address and bits of each area of process data."""


class Echo(Behaviour):
    """Its inputs are its outputs."""

    def on_outputs(self, dt: float) -> None:
        for n in range(1, 9):
            if (OUT, n) in self and (IN, n) in self:
                self[IN, n] = self[OUT, n]


class Bootable(Echo):
    """Accepts its firmware in BOOT only, and is busy three times first."""

    def on_start(self) -> None:
        self.state, self.busy = AlState.INIT, 3

    def on_state(self, old: AlState, new: AlState) -> None:
        self.state = new

    def on_file(self, name: str, data: bytes) -> None:
        if name == "firmware" and self.state is not AlState.BOOTSTRAP:
            raise FileRefused(FoeError.BOOTSTRAP_ONLY, "go to BOOT first")
        if name == "firmware" and self.busy:
            self.busy -= 1
            raise FileBusy(3 - self.busy, 3)
        super().on_file(name, data)


def _type(bits: int) -> str:
    return f"BIT{bits}" if bits < 8 else {8: "USINT", 16: "UINT", 24: "UINT24", 32: "UDINT"}[bits]


def device(
    product: int, outputs: Areas, inputs: Areas, *, mailbox: bool = False, modes: Sequence[model.DcMode] = (),
    control: int = 0x64,
) -> model.Device:  # fmt: skip
    """Return a device with one PDO of one entry for each area; `control`: of the sync managers of outputs."""
    managers = dict(enumerate(MAILBOX if mailbox else ()))
    pdos: list[list[model.Pdo]] = [[], []]
    for direction, (areas, first, index) in enumerate(((outputs, 0x1600, OUT), (inputs, 0x1A00, IN))):
        for n, (number, start, bits) in enumerate(areas, 1):
            kind = (model.SyncManagerType.OUTPUTS, model.SyncManagerType.INPUTS)[direction]
            # Below the RAM and its digital outputs stand registers, for which there is no sync manager.
            virtual, byte = start < 0x0F00, (control, 0x20)[direction]
            managers[number] = model.SyncManager(start, (bits + 7) // 8, byte, kind, virtual=virtual)
            entry = model.PdoEntry(index, n, bits, f"value {n}", _type(bits))
            pdos[direction].append(model.Pdo(first + n, f"PDO {n}", (entry,), number, fixed=True, virtual=virtual))
    uses = [model.FmmuUse.OUTPUTS] * len(outputs) + [model.FmmuUse.INPUTS] * len(inputs)
    return model.Device(
        identity=model.Identity(VENDOR, product, 1, product + 100),
        name=f"Terminal {product}",
        source=model.Source.ESI,
        origin="a test",
        physics="YYYY",
        sync_managers=tuple(managers[number] for number in sorted(managers)),
        fmmus=tuple(uses),
        rx_pdos=tuple(pdos[0]),
        tx_pdos=tuple(pdos[1]),
        mailbox=model.Mailbox(model.Coe(sdo_information=True)) if mailbox else None,
        dc_modes=tuple(modes),
        eeprom_bytes=512,
    )


def bits(product: int, count: int, place: int = 0) -> model.Device:
    """Return a terminal without mailbox with `count` bits of outputs and of inputs."""
    return device(product, [(0, 0x0F00, count)], [(1, 0x1000, count)])


DEVICES = {
    "coupler": device(1, [], []),
    **{f"bits{count}": bits(10 + count, count) for count in range(1, 8)},
    # AL status is a copy of AL control (PDI configuration, byte 1 bit 0), as in most terminals.
    "emulated": replace(bits(19, 4), config_data=bytes((0x05, 0x01))),
    "input": device(20, [], [(0, 0x1000, 3)]),
    "output": device(21, [(0, 0x0F00, 16)], []),
    # Three areas of outputs with gaps between them: SOEM's own FMMUs are wrong. None triggers the watchdog.
    "areas": device(
        30, [(2, 0x1100, 8), (3, 0x1200, 32), (4, 0x1300, 8)], [(5, 0x1800, 16)], mailbox=True, control=0x24
    ),
    "files": replace(
        device(40, [(2, 0x1200, 16)], [(3, 0x1300, 16)], mailbox=True),
        mailbox=model.Mailbox(model.Coe(sdo_information=True), foe=True),
        bootstrap=struct.pack("<4H", 0x1000, 256, 0x1400, 256),
    ),
    "clock": device(22, [], [(0, 0x1000, 3), (1, 0x0910, 32)], modes=[model.DcMode("DC", 0)]),
    "pairs": device(
        31, [(2, 0x1100, 16), (4, 0x1300, 24)], [(3, 0x1200, 16), (5, 0x1800, 24)], mailbox=True,
        modes=[model.DcMode("DC", 0x0730)],
    ),
    # Words 0x18 to 0x1B of its EEPROM, start and size of the mailboxes, are 0.
    "sizeless": device(50, [(2, 0x1100, 16)], [(3, 0x1200, 16)], mailbox=True),
    # Its EEPROM has no mailbox at all.
    "unlisted": device(51, [(2, 0x1100, 16)], [(3, 0x1200, 16)], mailbox=True),
}  # fmt: skip


def _image(kind: str) -> bytes:
    image = write_sii(replace(DEVICES[kind], mailbox=None) if kind == "unlisted" else DEVICES[kind])
    return image[:48] + bytes(8) + image[56:] if kind == "sizeless" else image


def slave(name: str, kind: str, alias: int = 0) -> SlaveConfig:
    """Return the master's description of a device."""
    source = DEVICES[kind]

    def pdos(mapped: Sequence[model.Pdo], several: bool) -> Iterator[Pdo]:
        for pdo in mapped:
            (entry,) = pdo.entries
            kind, length = ("bits", entry.bits) if entry.bits < 8 else (f"uint{entry.bits}", None)
            channel = PdoEntry(entry.index, entry.sub_index, kind, entry.name, bits=length)  # type: ignore[arg-type]
            start = source.sync_managers[pdo.sync_manager or 0].start if pdo.virtual else 0
            yield Pdo(pdo.index, (channel,), pdo.sync_manager if several else None, start_address=start)

    several = max(len(source.rx_pdos), len(source.tx_pdos)) > 1
    return SlaveConfig(
        name,
        DeviceDescription(
            source.name, "generic", VENDOR, source.identity.product_code,
            tuple(pdos(source.rx_pdos, several)), tuple(pdos(source.tx_pdos, several)), configurable_pdos=False,
            coe=source.mailbox is not None,
            assign_activate=source.dc_modes[0].assign_activate if source.dc_modes else 0,
        ),
        alias=alias,
    )  # fmt: skip


def write_segment(file: Path, *entries: str) -> None:
    """Write a segment's file of these devices, each with keys behind its name (`bits4, alias: 7`), or of ESI files."""
    lines = []
    for entry in entries:
        if entry.endswith(".xml"):
            lines.append(f"- {{esi: {ESI_FILES / entry}}}\n")
            continue
        kind, _, more = entry.partition(",")
        (file.parent / f"{kind}.bin").write_bytes(_image(kind))
        echo = f"behaviour: 'tests.fieldbus.terminals:{'Bootable' if kind == 'files' else 'Echo'}'"
        lines.append(f"- {{sii: {kind}.bin, {echo}{',' if more else ''}{more}}}\n")
    file.write_text("slaves:\n" + "".join(lines))
