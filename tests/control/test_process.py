"""The stop of all drives after a defect in the cycle: on the device models, frame by frame."""

from __future__ import annotations

import struct
from dataclasses import replace
from typing import Any, cast

import pytest

from rtcp.config.model import ArmConfig, PdoEntry, SlaveConfig
from rtcp.control.cycle import make_drives
from rtcp.control.process import stop_blindly
from rtcp.devices.drive import Drive
from rtcp.fieldbus.bus import ProcessData
from rtcp.fieldbus.pdo import layout

from .rig import CONFIG, CSP, MOTIONS, PERIOD_S, QUICK_STOP, VOLTAGE_OFF, LoopRig

DISABLE_OPERATION_OPTION = 0x605C
STILL_RAD_S = 0.01
RAMP_S = CONFIG.joints[0].velocity / 10.0
"""Time from full speed to rest at the deceleration of 0x6085."""


class Defective:
    """A drive of which one step raises."""

    def __init__(self, drive: Drive, step: str) -> None:
        self._drive, self._step = drive, step

    def __getattr__(self, name: str) -> Any:
        if name == self._step:
            raise ZeroDivisionError("a defect for the test")
        return getattr(self._drive, name)


class Watched:
    """Records for each frame the true speed of every drive, and whether it has torque."""

    def __init__(self, rig: LoopRig) -> None:
        self.seen: list[list[tuple[float, bool]]] = []
        self._rig = rig
        self._receive = rig.data.receive
        rig.data.receive = self.receive  # type: ignore[method-assign]

    def receive(self) -> int:
        wkc = self._receive()
        self._rig.bus.advance_to(self._rig.bus.now_ns + self._rig.period_ns)
        self.seen.append([(abs(model.mechanics.velocity), model.powered) for model in self._rig.models])
        return wkc


def set_in_motion(rig: LoopRig, mode: int = CSP, direction: int = 1) -> Watched:
    """Both joints at full speed, with drives whose torque goes at once on `disable operation`."""
    for model in rig.models:
        model.objects[DISABLE_OPERATION_OPTION, 0].value = 0
        model.objects[0x6085, 0].value = 100_000
    rig.set_in_motion(mode, direction)
    return Watched(rig)


def ramps_down_under_torque(watched: Watched) -> bool:
    """Whether all joints come to rest under torque, and lose it then."""
    moving = [powered for cycle in watched.seen for speed, powered in cycle if speed > STILL_RAD_S]
    at_rest = all(speed < STILL_RAD_S and not powered for speed, powered in watched.seen[-1])
    return len(moving) > 10 and all(moving) and at_rest


@MOTIONS
def test_after_a_defect_joints_ramp_down_and_none_loses_its_torque_while_it_moves(
    rig: LoopRig, mode: int, direction: int
) -> None:
    watched = set_in_motion(rig, mode, direction)
    stop_blindly(rig.data, CONFIG, rig.joints.pairs)
    assert ramps_down_under_torque(watched)


@pytest.mark.parametrize("step", ["decode", "advance", "encode"])
@pytest.mark.parametrize("axis", [0, 1])
def test_a_defect_in_one_drive_keeps_neither_it_nor_the_others_from_ramping_down(
    rig: LoopRig, axis: int, step: str
) -> None:
    watched = set_in_motion(rig)
    slot, drive = rig.arm.pairs[axis]
    rig.arm.pairs[axis] = (slot, Defective(drive, step))  # type: ignore[assignment]
    stop_blindly(rig.data, CONFIG, rig.joints.pairs)
    assert ramps_down_under_torque(watched)


def test_a_frame_that_cannot_be_sent_is_followed_by_others(rig: LoopRig) -> None:
    watched = set_in_motion(rig)
    send, tries = rig.data.send, iter(range(1000))

    def sends() -> None:
        if next(tries) < 3:
            raise OSError("a defect for the test")
        send()

    rig.data.send = sends  # type: ignore[method-assign]
    stop_blindly(rig.data, CONFIG, rig.joints.pairs)
    assert ramps_down_under_torque(watched)


class Sent:
    """A process image that records sent frames."""

    def __init__(self, config: ArmConfig) -> None:
        self.outputs = dict.fromkeys(range(len(config.slaves)), b"")
        self.frames: list[dict[int, bytes]] = []

    def input(self, index: int) -> bytes:
        raise ZeroDivisionError("a defect for the test")

    def set_output(self, index: int, data: bytes) -> None:
        self.outputs[index] = data

    def send(self) -> None:
        self.frames.append(dict(self.outputs))

    def receive(self) -> int:
        return -1


def with_reversed_outputs(slave: SlaveConfig) -> SlaveConfig:
    """The same drive with its outputs mapped in reverse order: the controlword last."""
    pdos = [replace(pdo, channels=tuple(reversed(pdo.channels))) for pdo in slave.device.rpdo]
    return replace(slave, device=replace(slave.device, rpdo=tuple(reversed(pdos))))


def test_a_torque_limit_in_the_outputs_is_sent_too_where_the_driver_raises() -> None:
    slave = CONFIG.slaves[1]
    (pdo,) = slave.device.rpdo
    limit = PdoEntry(0x6072, 0, "uint16", "max_torque", safe=1500.0)
    device = replace(slave.device, rpdo=(replace(pdo, channels=(*pdo.channels, limit)),))
    config = replace(CONFIG, slaves=(CONFIG.slaves[0], replace(slave, device=device), *CONFIG.slaves[2:]))
    data = Sent(config)
    stop_blindly(cast(ProcessData, data), config, make_drives(config))
    assert {frame[1][-2:] for frame in data.frames} == {struct.pack("<H", 1500)}


def test_the_controlword_of_a_drive_whose_driver_raises_is_at_its_place_in_its_own_image() -> None:
    slaves = (*CONFIG.slaves[:2], with_reversed_outputs(CONFIG.slaves[2]))
    config = replace(CONFIG, slaves=slaves)
    data = Sent(config)
    stop_blindly(cast(ProcessData, data), config, make_drives(config))
    rest = layout(slaves[1].device.rpdo).bytes - 2
    ramp = [frame for frame in data.frames if struct.unpack_from("<H", frame[1])[0] == QUICK_STOP]
    assert len(ramp) * PERIOD_S >= RAMP_S
    assert data.frames[: len(ramp)] == ramp
    assert {frame[1] for frame in ramp} == {struct.pack("<H", QUICK_STOP) + bytes(rest)}
    assert {frame[2] for frame in ramp} == {bytes(rest) + struct.pack("<H", QUICK_STOP)}
    assert {word for frame in data.frames[len(ramp) :] for word in (*frame[1], *frame[2])} == {VOLTAGE_OFF}
