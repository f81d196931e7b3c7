from __future__ import annotations

import struct
from dataclasses import replace
from importlib.metadata import EntryPoint, EntryPoints
from math import inf, nan

import pytest

from rtcp.config import find
from rtcp.config.model import LARGEST, DeviceDescription, Pdo, PdoEntry, SlaveConfig
from rtcp.devices import Cia402Drive, DeviceError, Driver, IoBox, make_driver
from tests.devices.conftest import slave
from tests.devices.test_io_box import INPUTS, OUTPUTS

SENSOR = SlaveConfig("force", DeviceDescription(
    "a force sensor", "force", 1, 2,
    (Pdo(0x1600, (PdoEntry(0x7000, 1, "uint8", "range"), PdoEntry(0, 0, "uint8", "padding"))),),
    (Pdo(0x1A00, (PdoEntry(0x6000, 1, "int16", "x", 0.1), PdoEntry(0x6000, 2, "float32", "y", 2.0))),),
))  # fmt: skip


class ForceSensor(Driver):
    REQUIRED_INPUTS = ("x", "y")


def test_our_own_drivers_are_found_by_the_kind_of_their_device() -> None:
    box = SlaveConfig("io", DeviceDescription("a box", "io", 1, 2, (Pdo(0x1600, OUTPUTS),), (Pdo(0x1A00, INPUTS),)))
    assert type(make_driver(slave(), 0.001)) is Cia402Drive
    assert type(make_driver(box, 0.001)) is IoBox


def test_a_driver_of_another_package_is_found_and_offers_its_channels_in_si_units(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    points = EntryPoints([EntryPoint("force", "tests.devices.test_driver:ForceSensor", "rtcp.devices")])
    monkeypatch.setattr(find, "installed", lambda group: points.select(group=group))
    sensor = make_driver(SENSOR, 0.001)
    sensor.decode(b"\xfb\xff\x00\x00\xc0\x3f")
    assert sensor.values == pytest.approx({"x": -0.5, "y": 3.0})
    sensor.targets["range"] = 7.0
    assert sensor.encode() == b"\x07\x00"


def test_what_is_set_is_bounded_by_the_channel_and_what_is_no_number_is_safe() -> None:
    outputs = (
        PdoEntry(0x7000, 1, "int16", "current", 0.5, max=10.0, safe=1.0),
        PdoEntry(0x7000, 2, "float32", "flow", 1e-3, min=-2.0),
    )
    driver = Driver(SlaveConfig("valves", DeviceDescription("valves", "analog", 1, 2, (Pdo(0x1600, outputs),))), 0.001)
    sent = struct.Struct("<hf")
    for current, flow, counts in (
        (1e9, -1e9, (20, -2000.0)),
        (inf, nan, (2, 0.0)),
        (-1e9, 1e39, (-(2**15), LARGEST["float32"])),
    ):
        driver.targets |= {"current": current, "flow": flow}
        assert sent.unpack(driver.encode()) == pytest.approx(counts)


def test_a_kind_without_a_driver_is_refused_with_the_kinds_that_are_installed() -> None:
    wanted = (
        r"a force sensor: no driver is installed for kind force .* analog, cia402, coupler, encoder, generic, io, joint"
    )
    with pytest.raises(DeviceError, match=wanted):
        make_driver(SENSOR, 0.001)


def test_a_driver_refuses_a_device_that_lacks_a_channel_it_needs() -> None:
    device = replace(SENSOR.device, tpdo=())
    with pytest.raises(DeviceError, match="`tpdo` maps no x, y; kind force needs x, y, found are none"):
        ForceSensor(replace(SENSOR, device=device), 0.001)
