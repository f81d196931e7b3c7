from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import inf

import pytest

from rtcp.virtual.heated_rod import Alloy, HeatedRod
from rtcp.virtual.heater_circuit import FULL_SCALE, Circuit, CircuitData, CircuitFault, Sampling, SensePoint

CYCLE = 500e-6
ROD = 0.340
"""A rod of 1 mm and 0.3 m, ohm."""


def run(circuit: Circuit, seconds: float, gate: bool = True, relay: bool = True, rod: float = ROD) -> float:
    current = 0.0
    for _ in range(round(seconds / CYCLE)):
        current = circuit.step(CYCLE, gate, relay, rod)
    return current


def armed(data: CircuitData | None = None, sense_point: SensePoint = SensePoint.ROD) -> Circuit:
    """Return a circuit whose relay is closed and whose gate is off."""
    circuit = Circuit(data, sense_point=sense_point)
    run(circuit, 0.03, gate=False)
    return circuit


def measured(circuit: Circuit) -> float:
    """Return the resistance that the last pair of samples shows, ohm."""
    data = circuit.data
    return (circuit.voltage_count * data.voltage_range) / (circuit.current_count * data.current_range)


def test_current_needs_gate_and_relay() -> None:
    circuit = armed()
    assert run(circuit, CYCLE, gate=False) == 0.0
    assert run(circuit, CYCLE) == pytest.approx(12.0 / (ROD + 0.012), rel=1e-3)
    run(circuit, 0.03, relay=False)
    assert circuit.current == 0.0


def test_the_relay_takes_15_ms_to_close_and_12_ms_to_open() -> None:
    circuit = Circuit()
    assert run(circuit, 0.0145) == 0.0
    assert run(circuit, 0.0005) > 30.0
    assert run(circuit, 0.0115, relay=False) > 30.0
    assert run(circuit, 0.0005, relay=False) == 0.0


def test_a_command_shorter_than_the_closing_time_leaves_the_relay_open() -> None:
    circuit = Circuit()
    for _ in range(5):
        run(circuit, 0.01)
        run(circuit, CYCLE, relay=False)
    assert not circuit.relay_closed


def test_the_mirror_contact_is_never_closed_together_with_the_main_contact() -> None:
    circuit = Circuit()
    assert circuit.mirror_closed
    for relay in (True, False):
        for _ in range(60):
            run(circuit, CYCLE, relay=relay)
            assert not (circuit.mirror_closed and circuit.relay_closed)
    assert circuit.mirror_closed


def test_a_welded_relay_keeps_the_mirror_contact_open() -> None:
    circuit = armed()
    circuit.inject(CircuitFault.RELAY_WELDED)
    assert run(circuit, 0.05, relay=False) > 30.0
    assert not circuit.mirror_closed
    circuit.clear(CircuitFault.RELAY_WELDED)
    assert run(circuit, 0.05, relay=False) == 0.0
    assert circuit.mirror_closed


@pytest.mark.parametrize(
    ("fault", "gate", "flows"),
    [
        (CircuitFault.GATE_STUCK_ON, False, True),
        (CircuitFault.GATE_STUCK_OFF, True, False),
        (CircuitFault.POWER_WIRE_BROKEN, True, False),
        (CircuitFault.FUSE_BLOWN, True, False),
    ],
)
def test_a_fault_of_the_current_path_lasts_until_it_is_cleared(fault: CircuitFault, gate: bool, flows: bool) -> None:
    circuit = armed()
    circuit.inject(fault)
    assert (run(circuit, CYCLE, gate=gate) > 0.0) is flows
    circuit.clear(fault)
    assert (run(circuit, CYCLE, gate=gate) > 0.0) is gate


def test_a_gate_stuck_on_is_stopped_by_the_relay() -> None:
    circuit = armed()
    circuit.inject(CircuitFault.GATE_STUCK_ON)
    assert run(circuit, 0.02, gate=False, relay=False) == 0.0


def test_a_sense_point_on_the_rod_sees_the_rod_alone() -> None:
    circuit = armed()
    run(circuit, CYCLE)
    assert circuit.voltage / circuit.current == pytest.approx(ROD)
    assert measured(circuit) == pytest.approx(ROD, rel=3e-4)


def test_a_sense_point_on_the_lug_adds_contacts_and_chucks() -> None:
    circuit = armed(sense_point=SensePoint.LUG)
    run(circuit, CYCLE)
    assert circuit.voltage / circuit.current == pytest.approx(ROD + 2 * 0.5e-3 + 1e-3)


def spread(sense_point: SensePoint) -> float:
    circuit = armed(sense_point=sense_point)
    circuit.inject(CircuitFault.CONTACT_LOOSE)
    values = []
    for _ in range(50):
        run(circuit, CYCLE)
        values.append(circuit.voltage / circuit.current)
    return max(values) - min(values)


def test_a_loose_contact_shows_at_the_lug_and_not_on_the_rod() -> None:
    assert spread(SensePoint.LUG) > 20e-3
    assert spread(SensePoint.ROD) < 1e-9


def test_a_broken_sense_wire_reads_zero_volts_while_current_flows() -> None:
    circuit = armed()
    circuit.inject(CircuitFault.SENSE_WIRE_BROKEN)
    run(circuit, CYCLE)
    assert abs(circuit.voltage_count) < 200
    assert circuit.current_count > 200_000


@pytest.mark.parametrize(
    ("fault", "voltage", "current"),
    [(CircuitFault.VOLTAGE_OFFSET, 0.05, 0.0), (CircuitFault.CURRENT_OFFSET, 0.0, 1.0)],
)
def test_an_offset_shows_with_the_gate_off(fault: CircuitFault, voltage: float, current: float) -> None:
    circuit = armed(replace(CircuitData(), noise=0.0))
    circuit.inject(fault)
    run(circuit, CYCLE, gate=False)
    assert circuit.voltage_count == round(voltage / 15.0 * FULL_SCALE)
    assert circuit.current_count == round(current / 1000.0 * FULL_SCALE)


def test_counts_stop_at_24_bit() -> None:
    circuit = armed(replace(CircuitData(), voltage_range=5.0))
    run(circuit, CYCLE)
    assert circuit.voltage_count == FULL_SCALE


def test_noise_has_the_stated_deviation() -> None:
    circuit = armed()
    counts = []
    for _ in range(2000):
        run(circuit, CYCLE, gate=False)
        counts.append(circuit.current_count)
    assert (sum(count * count for count in counts) / len(counts)) ** 0.5 == pytest.approx(20.0, rel=0.1)


def test_alternating_channels_mix_two_states_of_the_gate_and_say_so() -> None:
    circuit = Circuit(replace(CircuitData(), noise=0.0), sampling=Sampling.ALTERNATING)
    run(circuit, 0.02, gate=False)
    run(circuit, CYCLE)
    assert (circuit.voltage_count > 0, circuit.current_count) == (True, 0)
    assert circuit.voltage_step == circuit.current_step + 1
    run(circuit, CYCLE, gate=False)
    assert (circuit.voltage_count > 0, circuit.current_count) == (True, 0)
    assert circuit.current_step == circuit.voltage_step + 1


def test_simultaneous_channels_always_belong_together() -> None:
    circuit = armed()
    for gate in (True, False, True):
        run(circuit, CYCLE, gate=gate)
        assert circuit.voltage_step == circuit.current_step
        assert (circuit.voltage_count > 1000) is (circuit.current_count > 1000) is gate


def test_a_weak_battery_sags_under_load() -> None:
    circuit = armed()
    run(circuit, CYCLE)
    healthy = circuit.battery_voltage
    circuit.inject(CircuitFault.BATTERY_WEAK)
    run(circuit, CYCLE)
    assert healthy > 11.7
    assert circuit.battery_voltage < 9.7


def test_the_battery_empties_under_load_and_the_charger_fills_it() -> None:
    circuit = armed()
    for _ in range(3600):
        circuit.step(1.0, True, True, ROD)
    # 34 A less 10 A of the charger for an hour, of 70 Ah.
    assert circuit.charge == pytest.approx(1.0 - 24.0 / 70.0, abs=0.01)
    assert circuit.battery_voltage < 11.5
    for _ in range(3600):
        circuit.step(1.0, False, True, ROD)
    assert circuit.charge == pytest.approx(1.0 - 14.0 / 70.0, abs=0.01)


def test_a_shorted_rod_reads_low_and_blows_the_fuse_within_a_second() -> None:
    circuit = armed()
    circuit.inject(CircuitFault.ROD_SHORTED)
    rod_current = run(circuit, CYCLE)
    assert circuit.current > 900.0
    assert rod_current < 5.0
    assert measured(circuit) < 2e-3
    run(circuit, 0.5)
    assert circuit.fuse_intact
    run(circuit, 1.0)
    assert not circuit.fuse_intact
    assert circuit.current == 0.0


def test_a_new_fuse_starts_cold() -> None:
    circuit = armed()
    circuit.inject(CircuitFault.ROD_SHORTED)
    run(circuit, 1.5)
    circuit.clear(CircuitFault.FUSE_BLOWN)
    run(circuit, 0.5)
    assert circuit.fuse_intact


def test_the_fuse_carries_a_rod_of_3_2_mm() -> None:
    circuit = armed()
    run(circuit, 2.0, rod=0.036)
    assert 240.0 < circuit.current < 300.0
    assert circuit.fuse_intact


def test_a_parted_rod_takes_no_current_and_shows_the_whole_voltage() -> None:
    circuit = armed()
    assert run(circuit, CYCLE, rod=inf) == 0.0
    assert circuit.voltage == pytest.approx(12.0, abs=0.01)


def test_broken_insulation_pulls_the_chuck_to_the_frame() -> None:
    circuit = Circuit()
    assert circuit.chuck_to_frame_voltage == pytest.approx(4.95, abs=0.01)
    circuit.inject(CircuitFault.INSULATION_BROKEN)
    assert circuit.chuck_to_frame_voltage < 0.01


def heated_by(heated: HeatedRod, circuit: Circuit, command: Callable[[], bool], seconds: float) -> None:
    for _ in range(round(seconds / CYCLE)):
        heated.step(CYCLE, circuit.step(CYCLE, command(), True, heated.resistance))


@pytest.mark.parametrize(("diameter", "duty"), [(0.5e-3, 0.20), (1e-3, 0.08)])
def test_an_on_off_gate_holds_500_degrees_with_the_duty_of_the_table(diameter: float, duty: float) -> None:
    heated, circuit = HeatedRod(Alloy(), diameter=diameter, length=0.3), armed()
    on = []

    def command() -> bool:
        on.append(heated.middle_temperature < 500.0)
        return on[-1]

    heated_by(heated, circuit, command, 10.0)
    on.clear()
    heated_by(heated, circuit, command, 5.0)
    assert heated.middle_temperature == pytest.approx(500.0, abs=1.0)
    assert sum(on) / len(on) == pytest.approx(duty, rel=0.1)


def test_a_gate_stuck_on_for_100_ms_adds_50_kelvin() -> None:
    heated, circuit = HeatedRod(Alloy(), diameter=1e-3, length=0.3), armed()
    circuit.inject(CircuitFault.GATE_STUCK_ON)
    heated_by(heated, circuit, lambda: False, 0.1)
    assert heated.middle_temperature - 20.0 == pytest.approx(50.0, abs=3.0)


def test_a_rod_left_on_parts_and_the_current_ends() -> None:
    heated, circuit = HeatedRod(Alloy(), diameter=1e-3, length=0.3), armed()
    heated_by(heated, circuit, lambda: True, 5.0)
    assert heated.resistance == inf
    assert circuit.current == 0.0
