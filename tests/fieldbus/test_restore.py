"""Setting up a slave again where a write gets lost: the attempt ends with the register's name, nothing is half done."""

from __future__ import annotations

from pathlib import Path

import pytest

from rtcp.config.segment import SegmentConfig, SegmentSlave
from rtcp.fieldbus.errors import BusError
from rtcp.fieldbus.registers import DatagramCommand, finish
from rtcp.fieldbus.slave_setup import SlaveRestorer, SlaveSetup
from rtcp.virtual.segment import make_segment
from tests.fieldbus.direct import Direct
from tests.fieldbus.master_child import arm

PERIOD = 1_000_000


@pytest.fixture
def port() -> Direct:
    """An IO box and two drives, the second of which has lost its address."""
    models = ("diewu-io", "cubemars-orh70", "cubemars-orh70")
    segment = make_segment(SegmentConfig(tuple(SegmentSlave(model=model) for model in models), Path()), 0)
    for position, slave in enumerate(segment.slaves[:2], 1):
        slave.esc.write(0x0010, (0x1000 + position).to_bytes(2, "little"), 0)
    return Direct(segment)


@pytest.mark.parametrize("register", [0x0500, 0x0502, 0x0981, 0x0928, 0x0920, 0x0930])
def test_a_write_that_got_lost_ends_the_attempt(port: Direct, register: int) -> None:
    port.lost = {(DatagramCommand.FPWR, register)}
    set_up = SlaveSetup(bytes(0x80), (bytes(8),) * 8, bytes(4), 0, 2)
    restorer = SlaveRestorer(port, arm(3), [set_up] * 3, lambda position: pytest.fail("too far"), PERIOD)
    with pytest.raises(BusError, match=rf"slave 3 \(drive2\) did not take .* register 0x{register:04X}"):
        finish(restorer.restore(3, place=3))
