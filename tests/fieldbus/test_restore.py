"""Setting up a slave where a write gets lost or is not kept: the attempt ends with the register's name."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from rtcp.config.segment import SegmentConfig, SegmentSlave
from rtcp.fieldbus.errors import BusError
from rtcp.fieldbus.registers import Answer, DatagramCommand, finish
from rtcp.fieldbus.slave_setup import SlaveRestorer, SlaveSetup, trigger_watchdog
from rtcp.fieldbus.system_time import SystemTime
from rtcp.virtual.segment import make_segment
from tests.fieldbus.direct import Direct
from tests.fieldbus.master_child import arm

PERIOD = 1_000_000


CONTROL_2, SYNC_MANAGER_2 = 0x0814, bytes.fromhex("0011100024000100")
"""Register and content of sync manager 2, whose control byte does not trigger the watchdog."""


class Forgetful(Direct):
    """Sync managers lose the bit that triggers the watchdog."""

    def exchange(self, command: DatagramCommand, station: int, address: int, data: bytes, **more: Any) -> Answer:
        if command is DatagramCommand.FPWR and address == CONTROL_2:
            data = bytes((data[0] & ~0x40,))
        elif command is DatagramCommand.FPWR and address == CONTROL_2 - 4:
            data = data[:4] + bytes((data[4] & ~0x40,)) + data[5:]
        return super().exchange(command, station, address, data, **more)


@pytest.fixture(params=[Direct])
def port(request: pytest.FixtureRequest) -> Direct:
    """An IO box and two drives, the second of which has lost its address."""
    models = ("diewu-io", "cubemars-orh70", "cubemars-orh70")
    segment = make_segment(SegmentConfig(tuple(SegmentSlave(model=model) for model in models), Path()), 0)
    for position, slave in enumerate(segment.slaves[:2], 1):
        slave.esc.write(0x0010, (0x1000 + position).to_bytes(2, "little"), 0)
    made: Direct = request.param(segment)
    return made


@pytest.mark.parametrize("register", [0x0500, 0x0502, 0x0981, 0x0928, 0x0920, 0x0930])
def test_a_write_that_got_lost_ends_the_attempt(port: Direct, register: int) -> None:
    port.lost = {(DatagramCommand.FPWR, register)}
    set_up = SlaveSetup(bytes(0x80), (bytes(8),) * 8, bytes(4), 0, 2)
    restorer = SlaveRestorer(port, arm(3), [set_up] * 3, lambda position: pytest.fail("too far"), PERIOD, SystemTime())
    with pytest.raises(BusError, match=rf"slave 3 \(drive2\) did not take .* register 0x{register:04X}"):
        finish(restorer.restore(3, place=3))


@pytest.mark.parametrize("port", [Direct, Forgetful], indirect=True)
def test_outputs_trigger_the_watchdog_or_a_drive_is_refused_and_any_other_slave_noted(port: Direct) -> None:
    box, drive, _ = arm(3)
    for station in (0x1001, 0x1002):
        port.write(station, CONTROL_2 - 4, SYNC_MANAGER_2)
    if not isinstance(port, Forgetful):
        assert trigger_watchdog(port, 1, box, 2) == trigger_watchdog(port, 2, drive, 2) == []
        assert port.read(0x1002, CONTROL_2 - 4, 7) == bytes.fromhex("00111000640001")
        return
    (note,) = trigger_watchdog(port, 1, box, 2)
    assert "slave 1 (io): the control byte of sync manager 2 was set to 0x64 and reads back as 0x24" in note
    with pytest.raises(BusError, match=r"slave 2 \(drive1\): .* a drive without it keeps moving when the master dies"):
        trigger_watchdog(port, 2, drive, 2)
    port.write(0x1002, CONTROL_2 + 2, b"\0")
    with pytest.raises(BusError, match="no sync manager carries its outputs"):
        trigger_watchdog(port, 2, drive, 2)


@pytest.mark.parametrize("port", [Forgetful], indirect=True)
def test_a_slave_that_forgets_the_trigger_of_the_watchdog_is_not_set_up_again(port: Direct) -> None:
    managers = (bytes(8), bytes(8), SYNC_MANAGER_2[:4] + b"\x64" + SYNC_MANAGER_2[5:], *(bytes(8),) * 5)
    set_up = SlaveSetup(bytes(0x80), managers, None, 0, 3)
    restorer = SlaveRestorer(port, arm(3), [set_up] * 3, lambda position: pytest.fail("too far"), PERIOD, SystemTime())
    with pytest.raises(BusError, match=r"slave 2 \(drive1\) does not keep sync manager 2 \(register 0x0810\)"):
        finish(restorer.restore(2, place=None))
