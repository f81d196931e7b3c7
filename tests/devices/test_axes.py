"""A slave with two axes: each is a drive of its own, and both write into one image."""

from __future__ import annotations

import struct
from dataclasses import replace

import pytest

from rtcp.config import default_config, load
from rtcp.config.model import ArmConfig, DeviceDescription, Pdo, PdoEntry, SlaveConfig
from rtcp.control.cycle import make_drives
from rtcp.control.process import stop_blindly
from rtcp.devices import TargetState as T
from rtcp.devices.drive import Drive, share_slaves

SECOND = 0x800
OUT, IN = struct.Struct("<HihHih"), struct.Struct("<HihHih")
ENABLED, SWITCHED_ON = 0x0237, 0x0233


def entries(image: str, shift: int = 0) -> tuple[PdoEntry, ...]:
    word, position, torque = {
        "rpdo": ((0x6040, "controlword"), (0x607A, "target_position"), (0x6071, "target_torque")),
        "tpdo": ((0x6041, "statusword"), (0x6064, "position"), (0x6077, "torque")),
    }[image]
    return (
        PdoEntry(word[0] + shift, 0, "uint16", word[1]),
        PdoEntry(position[0] + shift, 0, "int32", position[1], 1e-4 if shift == 0 else 1e-3),
        PdoEntry(torque[0] + shift, 0, "int16", torque[1], 1e-2),
    )


def two_axes(*, one_pdo: bool) -> DeviceDescription:
    def image(name: str, index: int) -> tuple[Pdo, ...]:
        first, second = entries(name), entries(name, SECOND)
        if one_pdo:
            return (Pdo(index, (*first, *(replace(entry, axis=2) for entry in second))),)
        return Pdo(index, first), Pdo(index + 0x10, second, axis=2)

    return DeviceDescription("two axes", "cia402", 1, 2, image("rpdo", 0x1600), image("tpdo", 0x1A00))


SHIPPED = load(default_config())


class Data:
    """The process data of one slave."""

    expected_wkc = dc_time = missed = stale = 0

    def __init__(self, inputs: bytes) -> None:
        self.inputs, self.outputs = inputs, b""
        self.sent: list[tuple[int, ...]] = []

    def input(self, index: int) -> bytes:
        return self.inputs

    def set_output(self, index: int, data: bytes) -> None:
        self.outputs = data

    def send(self) -> None:
        self.sent.append(OUT.unpack(self.outputs))

    def receive(self) -> int:
        return -1


def drives(device: DeviceDescription) -> tuple[ArmConfig, list[tuple[int, Drive]]]:
    joints = tuple(
        replace(joint, slave="both", axis=axis) for axis, joint in zip((2, 1), SHIPPED.joints[:2], strict=True)
    )
    config = replace(SHIPPED, slaves=(SlaveConfig("both", device),), joints=joints, gripper=None)
    pairs = make_drives(config)
    share_slaves(pairs)
    return config, pairs


@pytest.mark.parametrize("one_pdo", [False, True])
def test_each_axis_reads_and_writes_its_own_part_of_one_image(one_pdo: bool) -> None:
    _, pairs = drives(two_axes(one_pdo=one_pdo))
    (_, second), (_, first) = pairs  # the first joint hangs on axis 2
    image = IN.pack(SWITCHED_ON, 10000, 100, SWITCHED_ON, -2000, -300)
    for _, drive in pairs:
        drive.decode(image)
        drive.advance(T.ENABLED)
    assert (first.position, second.position) == (pytest.approx(1.0), pytest.approx(-2.0))
    assert (first.torque, second.torque) == (pytest.approx(1.0), pytest.approx(-3.0))
    first.target_position, second.target_position = 0.5, -0.25
    sent = [drive.slave.outputs(drive, drive.encode()) for _, drive in pairs]
    assert OUT.unpack(sent[-1]) == (0x0F, 5000, 0, 0x0F, -250, 0)
    first.target_position = 0.25
    assert OUT.unpack(first.slave.outputs(first, first.encode())) == (0x0F, 2500, 0, 0x0F, -250, 0)


def test_an_axis_that_moves_no_joint_stays_disabled() -> None:
    config, _ = drives(two_axes(one_pdo=False))
    alone = make_drives(replace(config, joints=config.joints[1:]))
    ((_, first),) = alone
    first.decode(IN.pack(SWITCHED_ON, 10000, 0, 0x0250, 0, 0))
    first.advance(T.ENABLED)
    assert (first.slave, OUT.unpack(first.encode())) == (None, (0x0F, 10000, 0, 0, 0, 0))


@pytest.mark.interpreted
def test_a_blind_stop_tells_both_axes_also_where_the_driver_of_one_raises(monkeypatch: pytest.MonkeyPatch) -> None:
    config, pairs = drives(two_axes(one_pdo=False))
    data = Data(IN.pack(ENABLED, 10000, 0, ENABLED, -2000, 0))

    def broken(image: bytes) -> None:
        raise RuntimeError("a defect")

    monkeypatch.setattr(pairs[0][1], "decode", broken)
    stop_blindly(data, replace(config, cycle=replace(config.cycle, period_us=100_000)), pairs)
    words = {(first, second) for first, _, _, second, _, _ in data.sent}
    assert words == {(0x02, 0x02), (0x07, 0x00)}  # quick stop, then torque off: the axis whose driver raises at once
