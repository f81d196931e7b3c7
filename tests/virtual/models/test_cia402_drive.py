"""The behaviour `cia402` on whatever objects a described drive has: units of the standard, one axis or more."""

from __future__ import annotations

from math import pi
from typing import Any

import pytest

from rtcp.esi import model
from rtcp.virtual.described import DescribedDevice
from rtcp.virtual.device import OptionError
from rtcp.virtual.models.cia402 import DriveState
from rtcp.virtual.models.cia402_drive import Cia402Drive

RX = ((0x6040, 16), (0x607A, 32), (0x60FF, 32), (0x6071, 16), (0x6060, 8))
TX = ((0x6041, 16), (0x6064, 32), (0x606C, 32), (0x6077, 16), (0x6061, 8))
TYPES = {8: "SINT", 16: "INT", 32: "DINT"}
ENABLED = DriveState.OPERATION_ENABLED
DT = 0.001


def ratio(index: int, above: int, below: int) -> model.DictionaryObject:
    entries = [model.ObjectEntry(0, "Count", "USINT", 8, default=b"\2")]
    entries += [
        model.ObjectEntry(n, "", "UDINT", 32, default=value.to_bytes(4, "little"))
        for n, value in ((1, above), (2, below))
    ]
    return model.DictionaryObject(index, "", model.ObjectCode.RECORD, tuple(entries))


def variable(index: int, value: int) -> model.DictionaryObject:
    entry = model.ObjectEntry(0, "", "UDINT", 32, default=value.to_bytes(4, "little"), writable=True)
    return model.DictionaryObject(index, "", model.ObjectCode.VARIABLE, (entry,))


def rated(millinewtonmetres: int) -> model.DictionaryObject:
    return variable(0x6076, millinewtonmetres)


def pdos(first: int, entries: tuple[tuple[int, int], ...], manager: int, axes: int) -> tuple[model.Pdo, ...]:
    return tuple(
        model.Pdo(
            first + 0x10 * n, "",
            tuple(model.PdoEntry(index + 0x800 * n, 0, bits, "", TYPES[bits]) for index, bits in entries), manager,
        )
        for n in range(axes)
    )  # fmt: skip


class Bench:
    """A drive in OP with its self-test behind it."""

    def __init__(self, *objects: model.DictionaryObject, axes: int = 1, **options: object) -> None:
        managers = (
            model.SyncManager(0x1000, 128, 0x26, model.SyncManagerType.MAILBOX_RECEIVE),
            model.SyncManager(0x1080, 128, 0x22, model.SyncManagerType.MAILBOX_SEND),
            model.SyncManager(0x1100, 0, 0x64, model.SyncManagerType.OUTPUTS),
            model.SyncManager(0x1600, 0, 0x20, model.SyncManagerType.INPUTS),
        )
        description = model.Device(
            model.Identity(1, 2, 3), "Drive", model.Source.ESI, "here", sync_managers=managers, objects=objects,
            rx_pdos=pdos(0x1600, RX, 2, axes), tx_pdos=pdos(0x1A00, TX, 3, axes), mailbox=model.Mailbox(model.Coe()),
        )  # fmt: skip
        self.device = DescribedDevice(description, lambda alias: b"", Cia402Drive, **options)
        self.sentences: list[str] = []
        self.device.runner.report = self.sentences.append
        self.device.set_outputs_valid(True)
        self.run(0.2)

    def __getitem__(self, index: int) -> int:
        return int(self.device.objects[index, 0].value)

    def __setitem__(self, index: int, value: int) -> None:
        self.device.objects[index, 0].value = value

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / DT)):
            self.device.step(DT)

    def enable(self, mode: int, axis: int = 0) -> None:
        shift = 0x800 * axis
        self[0x6060 + shift] = mode
        self[0x607A + shift] = self[0x6064 + shift]
        for controlword in (6, 7, 15):
            self[0x6040 + shift] = controlword
            self.run(0.003)
        assert self.device.servos[axis].state is ENABLED


@pytest.mark.parametrize(
    ("objects", "counts"),
    [
        ((), 65536),
        ((ratio(0x608F, 4096, 1),), 4096),
        ((ratio(0x608F, 4096, 1), ratio(0x6091, 100, 1)), 409_600),
        ((ratio(0x608F, 4096, 1), ratio(0x6091, 100, 1), ratio(0x6092, 36_000, 1)), 36_000),
    ],
    ids=["none", "encoder", "encoder and gear", "feed"],
)
def test_a_turn_of_the_joint_has_the_counts_that_the_drives_objects_say(
    objects: tuple[model.DictionaryObject, ...], counts: int
) -> None:
    bench = Bench(*objects, initial_position=pi)
    assert bench[0x6064] == counts // 2


@pytest.mark.parametrize(
    ("options", "reported", "turned"),
    [({}, 1.0, 1.0), ({"counts_per_turn": 655.36}, 1.0, 100.0), ({"encoder_ratio": -2.0}, -2.0, 1.0)],
    ids=["sound", "a gear that is not there", "an encoder that counts twice, and backwards"],
)
def test_options_play_a_wrong_gear_and_a_wrong_encoder(options: dict[str, Any], reported: float, turned: float) -> None:
    degree = 65536 / 360
    bench = Bench(**options)
    bench.enable(8)
    for step in range(1, 101):
        bench[0x607A] = round(step * degree / 100)
        bench.run(0.02)
    bench.run(0.5)
    assert bench[0x6064] == pytest.approx(reported * degree, abs=3)
    assert bench.device.servos[0].mechanics.position == pytest.approx(turned * 2 * pi / 360, rel=0.02)


def test_csp_follows_its_targets_at_any_speed_and_csv_keeps_counts_a_second() -> None:
    bench = Bench(ratio(0x608F, 10_000, 1))
    bench.enable(8)
    for n in range(1, 1001):
        bench[0x607A] = 5 * n
        bench.run(DT)
    bench.run(0.3)
    assert bench[0x6064] == pytest.approx(5000, abs=2)
    bench[0x60FF] = 2500
    bench[0x6060] = 9
    bench.run(1.0)
    assert bench[0x606C] == pytest.approx(2500, abs=10)
    assert bench.device.servos[0].mechanics.velocity == pytest.approx(pi / 2, abs=0.01)


@pytest.mark.parametrize(
    ("unit", "options", "counts"),
    [
        (0x00B44700, {}, 50 * 60 / (2 * pi)),
        (0xFDB44700, {}, 50 * 60_000 / (2 * pi)),
        (0xFDB44700, {"velocity_ratio": 1.0}, 60_000 / (2 * pi)),
        (0x00B50300, {}, 4096 * 50 / (2 * pi)),
        (0xFD410300, {"velocity_ratio": 1.0}, 180_000 / pi),
        (0x00B60000, {}, 4096 * 50 / (2 * pi)),
    ],
    ids=["rpm", "mrpm", "mrpm of the joint", "counts a second", "millidegrees a second", "no rate"],
)
def test_velocities_count_in_the_unit_of_the_si_notation_and_accelerations_the_same_a_second(
    unit: int, options: dict[str, Any], counts: float
) -> None:
    bench = Bench(ratio(0x608F, 4096, 1), ratio(0x6091, 50, 1), variable(0x60A9, unit), variable(0x6083, 0), **options)
    bench.enable(9)
    bench[0x60FF] = round(counts)
    bench.run(1.0)
    assert bench.device.servos[0].mechanics.velocity == pytest.approx(1.0, rel=5e-3)
    assert bench[0x606C] == pytest.approx(counts, rel=5e-3)
    assert bench[0x6083] == pytest.approx(20.0 * counts, rel=1e-3)


def test_accelerations_count_in_a_unit_of_their_own_where_the_drive_has_one() -> None:
    units = variable(0x60A9, 0x00B44700), variable(0x60AA, 0xFD105700)
    bench = Bench(ratio(0x6091, 50, 1), *units, variable(0x6083, 0))
    assert bench[0x6083] == 20_000 * 50


def test_rated_torque_and_current_are_the_motors_and_options_say_them_at_the_joint() -> None:
    gear, current = ratio(0x6091, 50, 1), variable(0x6075, 0)
    bench = Bench(gear, current, rated(400))
    assert bench.device.servos[0].size.rated_torque == pytest.approx(20.0)
    bench = Bench(gear, current, rated(0), rated_torque=20.0, rated_current=9.5)
    assert (bench[0x6076], bench[0x6075]) == (400, 9500)
    bench = Bench(gear, rated(20_000), torque_ratio=1.0)
    assert bench.device.servos[0].size.rated_torque == pytest.approx(20.0)


def test_torque_counts_per_mille_of_the_rated_torque() -> None:
    bench = Bench(rated(20_000), friction=0.0, viscous_friction=0.0, load_inertia=2.0)
    bench.enable(10)
    bench[0x6071] = 100
    bench.run(0.5)
    servo = bench.device.servos[0]
    assert (bench[0x6077], servo.axis.torque) == (100, pytest.approx(2.0))
    assert servo.mechanics.velocity == pytest.approx(0.5 * 2.0 / servo.mechanics.inertia, rel=0.02)


def test_two_axes_have_states_motions_and_options_of_their_own() -> None:
    bench = Bench(axes=2, initial_position=1.0, axis2_initial_position=-0.5)
    first, second = bench.device.servos
    assert (first.mechanics.position, second.mechanics.position) == (1.0, -0.5)
    bench.enable(8, axis=1)
    bench[0x607A + 0x800] += 1000
    bench.run(0.5)
    assert first.state is DriveState.SWITCH_ON_DISABLED
    assert second.mechanics.position == pytest.approx(-0.5 + 1000 * 2 * pi / 65536, abs=1e-3)
    assert first.mechanics.position == 1.0


def test_outputs_that_become_invalid_stop_a_drive_under_torque_with_an_emergency() -> None:
    bench = Bench()
    bench.enable(9)
    bench.device.set_outputs_valid(False)
    bench.run(0.1)
    assert bench.device.servos[0].state in (DriveState.FAULT_REACTION_ACTIVE, DriveState.FAULT)
    assert bench.device.emergencies[0].error_code == 0x8130


def test_what_a_description_leaves_open_gets_defaults_and_what_an_object_cannot_hold_is_bounded() -> None:
    bench = Bench(ratio(0x6092, 1 << 31, 1), rated(0), rated_torque=4000.0, initial_position=3.0)
    image = bench.device.lay_out(3)
    image.pack(bytearray(image.byte_length))
    assert bench[0x6064] == pytest.approx(3.0 / (2 * pi) * (1 << 31), abs=1)
    assert bench[0x6076] == 4_000_000
    bench.device.servos[0].mechanics.position = 7.0
    bench.run(0.01)
    image.pack(bytearray(image.byte_length))
    assert bench[0x6064] == (1 << 31) - 1
    assert not bench.sentences


def test_a_device_without_a_controlword_is_no_drive() -> None:
    description = model.Device(model.Identity(1, 2, 3), "Lamp", model.Source.ESI, "here")
    with pytest.raises(OptionError, match="cia402 moves a drive, and Lamp has no controlword"):
        DescribedDevice(description, lambda alias: b"", Cia402Drive)
