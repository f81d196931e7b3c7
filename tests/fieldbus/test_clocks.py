"""The clock of a slave that is set up again: a write that is lost or not kept ends the attempt."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import pytest

from rtcp.config.segment import SegmentConfig, SegmentSlave
from rtcp.fieldbus import clocks
from rtcp.fieldbus.clocks import (
    clocks_of,
    measure_delays,
    settle_clock,
    start_clocks,
    start_sync,
    take_over_time,
)
from rtcp.fieldbus.errors import BusError
from rtcp.fieldbus.registers import Answer, DatagramCommand, finish
from rtcp.fieldbus.system_time import SystemTime
from rtcp.virtual.segment import Connection, make_segment
from tests.fieldbus.direct import Direct
from tests.fieldbus.master_child import arm, with_device
from tests.virtual.line import Line, TinyDevice

MS = 1_000_000
LABEL, STATION = "slave 3 (drive2)", 0x1003
PERIOD = 1_000_000
LABELS = {1: "slave 1 (io)", 2: "slave 2 (drive1)", 3: LABEL}


@pytest.fixture
def port() -> Direct:
    """An IO box and two drives that have their addresses."""
    models = ("diewu-io", "cubemars-orh70", "cubemars-orh70")
    segment = make_segment(SegmentConfig(tuple(SegmentSlave(model=model) for model in models), Path()), 0)
    for position, slave in enumerate(segment.slaves, 1):
        slave.esc.write(0x0010, (0x1000 + position).to_bytes(2, "little"), 0)
    return Direct(segment)


def test_a_clock_that_does_not_get_to_the_references_ends_the_set_up(
    port: Direct, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(clocks, "_SETTLE_S", 0.02)
    monkeypatch.setattr(port, "read", lambda station, address, length: (0x8000_0000 + 1_250_000).to_bytes(4, "little"))
    with pytest.raises(BusError, match=r"slave 3 \(drive2\): its clock is not within 2 us .* 0x092C shows 1250 us"):
        finish(settle_clock(port, STATION, LABEL))


def test_a_clock_that_has_settled_at_last_is_believed(port: Direct, monkeypatch: pytest.MonkeyPatch) -> None:
    shown = iter((90_000, 5_000, 1_999))
    monkeypatch.setattr(port, "read", lambda station, address, length: next(shown).to_bytes(4, "little"))
    finish(settle_clock(port, STATION, LABEL))
    assert list(shown) == []


def test_a_broadcast_that_got_lost_latches_no_times_and_sets_no_clock(port: Direct) -> None:
    port.lost = {(DatagramCommand.BWR, 0x0900)}
    before = port.read(STATION, 0x0920, 8)
    with pytest.raises(BusError, match=r"slave 3 \(drive2\): the local times could not be latched"):
        take_over_time(port, STATION, LABEL, bytes(4), (1, 2), SystemTime(), always=True)
    assert port.read(STATION, 0x0920, 8) == before


class Soem:
    """In place of SOEM, whose socket this port has not."""

    def __init__(self) -> None:
        self.asked = False

    def config_dc(self) -> bool:
        self.asked = True
        return True


def test_delays_are_those_of_the_cable_whatever_the_registers_held(port: Direct) -> None:
    # Of another place on the cable, and another master.
    port.put(0x1001, 0x0928, (5000).to_bytes(4, "little"), LABEL)
    assert measure_delays(port, LABELS, clocks_of(port, LABELS)) == {1: 0, 2: 820, 3: 1660}
    written = [int.from_bytes(port.read(0x1000 + position, 0x0928, 4) or b"", "little") for position in (1, 2, 3)]
    assert written == [0, 820, 1660]


def test_times_that_wrap_between_two_ports_give_the_same_delays(port: Direct, monkeypatch: pytest.MonkeyPatch) -> None:
    write_all = port.write_all

    def just_before_the_wrap(address: int, data: bytes) -> int:
        for slave in port.segment.slaves:
            slave.clock.jump(-500 - slave.clock.local(port.now + MS + slave.delay))
        return write_all(address, data)

    monkeypatch.setattr(port, "write_all", just_before_the_wrap)
    assert measure_delays(port, LABELS, clocks_of(port, LABELS)) == {1: 0, 2: 820, 3: 1660}


@pytest.mark.parametrize("lost", [(DatagramCommand.BWR, 0x0900), (DatagramCommand.FPRD, 0x0900),
                                  (DatagramCommand.FPRD, 0x0110), (DatagramCommand.FPWR, 0x0928)])  # fmt: skip
def test_a_frame_that_is_missing_ends_the_measurement_of_delays(
    port: Direct, lost: tuple[DatagramCommand, int]
) -> None:
    clocks = clocks_of(port, LABELS)
    port.lost = {lost}
    with pytest.raises(BusError):
        measure_delays(port, LABELS, clocks)


def test_times_that_no_cable_gives_are_refused(port: Direct, monkeypatch: pytest.MonkeyPatch) -> None:
    read = port.read

    def latched_by_another(station: int, address: int, length: int) -> bytes | None:
        times = read(station, address, length)
        # Port 1 kept the time of a frame before.
        return b"\0\0\0\0" + bytes.fromhex("0000 0001") + bytes(8) if (station, address) == (0x1001, 0x0900) else times

    monkeypatch.setattr(port, "read", latched_by_another)
    with pytest.raises(BusError, match=r"slave 2 \(drive1\): its propagation delay .* would be \d+ ns .* 1000000 ns"):
        measure_delays(port, LABELS, clocks_of(port, LABELS))


def test_clocks_behind_a_junction_without_a_clock_share_the_length_of_its_cables() -> None:
    devices = [TinyDevice(), TinyDevice(supports_dc=False), TinyDevice(), TinyDevice(), TinyDevice()]
    devices[1].physics = "YYYY"
    connections = [Connection(None), Connection(0), Connection(1, 3), Connection(2), Connection(1, 1)]
    line = Line(devices, delays=[0, 840, 1680, 2520, 5040], connections=connections)
    line.address()
    port, labels = Direct(line.segment), {position: f"slave {position}" for position in range(1, 6)}
    delays = measure_delays(port, labels, clocks_of(port, labels))
    assert delays == {
        1: 0,
        3: pytest.approx(1680, abs=600),
        4: pytest.approx(2520, abs=600),
        5: pytest.approx(5040, abs=600),
    }


def test_a_slave_that_only_measures_delays_gets_no_clock(port: Direct, monkeypatch: pytest.MonkeyPatch) -> None:
    # As the EL2828 of tests/virtual/captures_of_devices: 0x0008 is 0x01FC, 0x0918, 0x0920 and 0x0928 do not answer.
    exchange = port.exchange

    def without_offset(command: DatagramCommand, station: int, address: int, data: bytes, **keys: Any) -> Answer:
        absent = station == 0x1002 and 0x0910 <= address < 0x0980
        return Answer(data, 0) if absent else exchange(command, station, address, data, **keys)

    monkeypatch.setattr(port, "exchange", without_offset)
    clocks = clocks_of(port, LABELS)
    assert measure_delays(port, LABELS, clocks) == {1: 0, 3: 1660}
    config = arm(3)
    with pytest.raises(
        BusError, match=r"slave 2 \(drive1\): `assign_activate` is 0x0300 but it has no distributed clock"
    ):
        start_clocks(Soem(), port, config, PERIOD)
    without_sync = [config[0], with_device(config[1], assign_activate=0), config[2]]
    start_clocks(Soem(), port, without_sync, PERIOD)
    assert port.read(0x1003, 0x0981, 1) == b"\x03"


def test_the_reference_is_the_first_clock_that_can_be_set_although_soem_takes_another(port: Direct) -> None:
    soem = Soem()
    assert start_clocks(soem, port, arm(3), PERIOD)[1] is None
    assert soem.asked
    slaves = (
        SegmentSlave(model="diewu-io", clock_bits=0),
        SegmentSlave(model="cubemars-orh70", clock_bits=32),
        SegmentSlave(model="cubemars-orh70"),
    )
    port.segment = make_segment(SegmentConfig(slaves, Path()), port.now)
    for position, slave in enumerate(port.segment.slaves, 1):
        slave.esc.write(0x0010, (0x1000 + position).to_bytes(2, "little"), port.now)
    soem = Soem()
    config = arm(3)
    without_sync = [with_device(config[0], assign_activate=0), *config[1:]]
    assert start_clocks(soem, port, without_sync, PERIOD)[1] == 2
    assert not soem.asked
    assert [int.from_bytes(port.read(station, 0x0928, 4) or b"", "little") for station in (0x1002, 0x1003)] == [0, 840]


def test_clocks_are_set_together(port: Direct) -> None:
    start_clocks(Soem(), port, arm(3), PERIOD)
    port.write_all(0x0900, bytes(4))
    times = [sum(int.from_bytes(port.read(station, at, 8) or b"", "little") for at in (0x0918, 0x0920))
             for station in (0x1001, 0x1002, 0x1003)]  # fmt: skip
    apart = [(time - times[0] + (1 << 63)) % (1 << 64) - (1 << 63) for time in times]
    assert apart == pytest.approx([0, 820, 1660], abs=200)


@pytest.mark.parametrize("lost", ["latch", "receive time", "offset"])
def test_clocks_that_cannot_be_set_end_the_start(port: Direct, lost: str) -> None:
    port.lost = {{
        "latch": (DatagramCommand.BWR, 0x0900),
        "receive time": (DatagramCommand.FPRD, 0x0918),
        "offset": (DatagramCommand.FPWR, 0x0920),
    }[lost]}  # fmt: skip
    with pytest.raises(BusError):
        start_clocks(Soem(), port, arm(3), PERIOD)


@pytest.mark.parametrize("register", [0x0980, 0x0990, 0x09A0])
def test_sync0_is_not_started_with_half_of_its_settings(port: Direct, register: int) -> None:
    port.lost = {(DatagramCommand.FPWR, register)}
    with pytest.raises(BusError, match=rf"slave 3 \(drive2\) did not take .* 0x{register:04X}"):
        start_sync(port, STATION, LABEL, arm(3)[2].device, PERIOD, SystemTime())
    assert port.read(STATION, 0x0981, 1) == b"\0"


def test_a_cycle_of_sync0_that_is_not_kept_is_told(port: Direct, monkeypatch: pytest.MonkeyPatch) -> None:
    # The write changes nothing: the slave answers and keeps its old value, a single SYNC0.
    put = port.put
    monkeypatch.setattr(port, "put", lambda station, address, *rest: address == 0x09A0 or put(station, address, *rest))
    with pytest.raises(BusError, match=r"does not keep the cycle of SYNC0, 1000 us, .* \(registers 0x09A0 and"):
        start_sync(port, STATION, LABEL, arm(3)[2].device, PERIOD, SystemTime())
    assert port.read(STATION, 0x0981, 1) == b"\0"


def test_an_activation_that_is_not_kept_is_told(port: Direct, monkeypatch: pytest.MonkeyPatch) -> None:
    put = port.put

    def keeps_sync1_off(station: int, address: int, data: bytes, label: str) -> None:
        put(station, address, b"\x30\x03" if (address, data) == (0x0980, b"\x30\x07") else data, label)

    monkeypatch.setattr(port, "put", keeps_sync1_off)
    device = with_device(arm(3)[2], assign_activate=0x0730).device
    with pytest.raises(BusError, match="`assign_activate` 0x0730 reads back from register 0x0980 as 0x0330"):
        start_sync(port, STATION, LABEL, device, PERIOD, SystemTime())


def test_sync0_that_would_have_begun_in_the_past_is_started_again(
    port: Direct, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(clocks, "_SYNC_DELAY_NS", -5_000_000)
    with pytest.raises(BusError, match="its first SYNC0 lies in the past"):
        start_sync(port, STATION, LABEL, arm(3)[2].device, PERIOD, SystemTime())
    delays = iter((-5_000_000, 100_000_000))
    put = port.put

    def stalls_once(station: int, address: int, data: bytes, label: str) -> None:
        if (address, data) == (0x0980, bytes(2)):
            monkeypatch.setattr(clocks, "_SYNC_DELAY_NS", next(delays))
        put(station, address, data, label)

    monkeypatch.setattr(port, "put", stalls_once)
    start_sync(port, STATION, LABEL, arm(3)[2].device, PERIOD, SystemTime())
    assert port.read(STATION, 0x0981, 1) == b"\x03"


@pytest.mark.parametrize(
    ("keys", "sync0", "after"),
    [
        ({}, 1_000_000, 0),
        ({"sync0_factor": 2, "sync0_shift_us": 100.0}, 2_000_000, 0),
        # Ten samples a cycle: SYNC1 with every tenth SYNC0.
        ({"sync0_factor": -10, "sync1_factor": -1}, 100_000, 900_000),
        ({"sync1_factor": 1, "sync1_shift_us": 25.5}, 1_000_000, 25_500),
        ({"sync1_factor": 2}, 1_000_000, 1_000_000),
        ({"sync0_factor": 0, "sync0_cycle_us": 250.0, "sync1_cycle_us": 500.0}, 250_000, 250_000),
    ],
)
def test_sync0_and_sync1_follow_the_factors_of_the_dc_mode_and_the_word_is_written_whole(
    port: Direct, keys: dict[str, float], sync0: int, after: int
) -> None:
    device = with_device(arm(3)[2], assign_activate=0x0730, **keys).device
    start_sync(port, STATION, LABEL, device, PERIOD, SystemTime())
    assert port.read(STATION, 0x0980, 2) == b"\x30\x07"
    assert port.read(STATION, 0x09A0, 8) == struct.pack("<II", sync0, after)
    start = int.from_bytes(port.read(STATION, 0x0990, 8) or b"", "little")
    assert (start - round(device.sync0_shift_us * 1000)) % max(sync0, PERIOD) % sync0 == 0
