"""The limits on lost process data: wider on the virtual bus, as written on a network interface."""

from __future__ import annotations

import dataclasses

import pytest

from rtcp.config.find import default_config
from rtcp.config.loader import load, widen
from rtcp.config.model import ArmConfig


@pytest.fixture(scope="module")
def shipped() -> ArmConfig:
    return load(default_config())


def with_bus(config: ArmConfig, interface: str, patience: float) -> ArmConfig:
    return dataclasses.replace(config, bus=dataclasses.replace(config.bus, interface=interface, timeout_scale=patience))


def sync_error_limits(config: ArmConfig) -> list[float]:
    return [
        entry.value
        for slave in config.slaves
        for entry in slave.device.sdo
        if (entry.index, entry.sub_index) == (0x10F1, 2)
    ]


def test_on_a_network_interface_every_limit_is_the_one_that_is_written(shipped: ArmConfig) -> None:
    real = with_bus(shipped, "eth0", 25.0)
    assert widen(real) == real
    assert (real.bus.lost_cycles, real.slaves[1].device.watchdog_ms, sync_error_limits(real)) == (40, 20.0, [120.0] * 6)


def test_on_the_virtual_bus_the_limits_on_lost_process_data_are_so_many_times_wider(shipped: ArmConfig) -> None:
    widened = widen(with_bus(shipped, "virtual", 10.0))
    assert widened.bus.lost_cycles == 400
    assert [slave.device.watchdog_ms for slave in widened.slaves] == [1000.0] + [200.0] * 6
    assert sync_error_limits(widened) == [0.0] * 6


def test_a_patience_of_1_leaves_every_limit_as_it_is_written(shipped: ArmConfig) -> None:
    assert widen(with_bus(shipped, "virtual", 1.0)) == with_bus(shipped, "virtual", 1.0)


def test_nothing_but_these_limits_changes(shipped: ArmConfig) -> None:
    widened = widen(with_bus(shipped, "virtual", 10.0))
    assert (widened.joints, widened.cycle, widened.lease_s) == (shipped.joints, shipped.cycle, shipped.lease_s)
    for slave, before in zip(widened.slaves, shipped.slaves, strict=True):
        others = [entry for entry in slave.device.sdo if entry.index != 0x10F1]
        assert others == [entry for entry in before.device.sdo if entry.index != 0x10F1]


def test_the_widened_watchdog_stays_within_what_its_register_holds(shipped: ArmConfig) -> None:
    wide = widen(with_bus(shipped, "virtual", 100.0))
    assert max(slave.device.watchdog_ms for slave in wide.slaves) <= 6000.0
