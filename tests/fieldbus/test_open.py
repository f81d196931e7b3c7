from __future__ import annotations

import os

import pytest
from pysoem import pysoem

from rtcp.fieldbus import AlState, BusError
from rtcp.fieldbus.errors import MappingMisread
from rtcp.fieldbus.interface import enter
from rtcp.fieldbus.soem import SoemBus


def test_an_interface_that_does_not_exist_is_told_with_those_that_do():
    with pytest.raises(BusError, match=r"no network interface nonsense0 .*there are"):
        SoemBus("nonsense0").open()


def test_the_loopback_is_refused_as_no_interface_for_a_cable():
    bus = SoemBus("lo")
    try:
        with pytest.raises(BusError, match=r"interface lo \(`interface`\) is the loopback.*Ethernet"):
            bus.open()
    finally:
        bus.close()


def test_a_process_that_does_not_exist_has_no_namespace_to_join():
    with pytest.raises(BusError, match=r"namespace of process 4194999 cannot be opened: .*is the segment running"):
        enter(4194999)


def test_the_namespaces_that_one_is_in_need_no_joining():
    enter(os.getpid())


def test_closing_a_bus_that_was_never_opened_does_nothing():
    bus = SoemBus("nonsense0")
    bus.close()
    bus.close()
    assert bus.notes == []


def test_a_closed_bus_refuses_everything_in_a_sentence():
    bus = SoemBus("nonsense0")
    for use in (bus.scan, bus.read_states, bus.emergencies, lambda: bus.request_state(AlState.OP),
                lambda: bus.acknowledge(1), lambda: bus.sdo_read(1, 0x1000, 0)):  # fmt: skip
        with pytest.raises(BusError, match="the bus on nonsense0 is not open"):
            use()


UNEXPECTED = pysoem.PacketError(2, 1)
REFUSED = pysoem.SdoError(3, 0x1C12, 0, 0x08000020, "Data cannot be transferred")


@pytest.mark.parametrize(("met", "by_chance"), [([UNEXPECTED], True), ([UNEXPECTED, REFUSED], False)])
def test_a_map_is_misread_by_chance_only_where_no_slave_has_refused_an_object(met, by_chance):
    class Master:
        def config_map(self):
            raise pysoem.ConfigMapError(met)

    bus = SoemBus("nonsense0")
    bus._master = Master()
    with pytest.raises(BusError, match="slave 2: its PDO mapping could not be read: Unexpected frame") as told:
        bus._map([])
    assert isinstance(told.value, MappingMisread) is by_chance
