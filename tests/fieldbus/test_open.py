from __future__ import annotations

import os
from types import SimpleNamespace

import pytest
from pysoem import pysoem

from rtcp.fieldbus import AlState, BusError
from rtcp.fieldbus.interface import enter
from rtcp.fieldbus.soem import SoemBus
from tests.fieldbus.master_child import arm


def test_an_interface_that_does_not_exist_is_told_with_those_that_do() -> None:
    with pytest.raises(BusError, match=r"no network interface nonsense0 .*there are"):
        SoemBus("nonsense0").open()


def test_the_loopback_is_refused_as_no_interface_for_a_cable() -> None:
    bus = SoemBus("lo")
    try:
        with pytest.raises(BusError, match=r"interface lo \(`interface`\) is the loopback.*Ethernet"):
            bus.open()
    finally:
        bus.close()


def test_a_process_that_does_not_exist_has_no_namespace_to_join() -> None:
    with pytest.raises(BusError, match=r"namespace of process 4194999 cannot be opened: .*is the segment running"):
        enter(4194999)


def test_the_namespaces_that_one_is_in_need_no_joining() -> None:
    enter(os.getpid())


def test_closing_a_bus_that_was_never_opened_does_nothing() -> None:
    bus = SoemBus("nonsense0")
    bus.close()
    bus.close()
    assert bus.notes == []


def test_a_closed_bus_refuses_everything_in_a_sentence() -> None:
    bus = SoemBus("nonsense0")
    for use in (bus.scan, bus.read_states, bus.emergencies, lambda: bus.request_state(AlState.OP),
                lambda: bus.acknowledge(1), lambda: bus.sdo(1).read(0x1000, 0)):  # fmt: skip
        with pytest.raises(BusError, match="the bus on nonsense0 is not open"):
            use()


def test_a_map_is_judged_by_its_images_and_names_what_soem_reported_of_a_slave_whose_image_is_wrong() -> None:
    errors = [
        pysoem.PacketError(1, 1), pysoem.PacketError(2, 4),
        *[pysoem.SdoError(2, 0x1C12, 1, 0x06020000, "The object does not exist")] * 200,
    ]  # fmt: skip

    class Master:
        slaves = (SimpleNamespace(output=bytes(2), input=bytes(6)), SimpleNamespace(output=bytes(14), input=bytes(15)))

        def config_map(self) -> None:
            raise pysoem.ConfigMapError(errors)

    bus = SoemBus("nonsense0")
    bus._master, bus._infos = Master(), [None, None]
    assert bus._map(arm(2)) == {
        2: [
            "slave 2 (drive1): SOEM could not read the PDO mapping assigned through 0x1C12 (key `rpdo`): expected 15 "
            "bytes, found 14 (packet error 4; object 0x1C12:1: The object does not exist)"
        ]
    }
