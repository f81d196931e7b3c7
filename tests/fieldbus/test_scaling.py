"""The units in a drive's objects compared with its device's file, on the in-process bus."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import cast

import pytest

from rtcp.config import default_config, load
from rtcp.config.model import Pdo, SlaveConfig
from rtcp.config.scaling import DriveScaling
from rtcp.fieldbus.errors import BusError, SdoAborted
from rtcp.fieldbus.mailbox import SdoClient
from rtcp.fieldbus.registers import finish
from rtcp.fieldbus.scaling import compare_scaling
from rtcp.testing.bus import InProcessBus
from rtcp.virtual.models import CubemarsDrive, create
from rtcp.virtual.objects import DataType, Entry

_WHOLE = load(default_config()).slaves[1].device
DEVICE = replace(_WHOLE, sdo=tuple(sdo for sdo in _WHOLE.sdo if sdo.index == 0x605A))
PERIOD_NS = 1_000_000
MODEL = create("cubemars-orh70")
assert isinstance(MODEL, CubemarsDrive)
INCREMENTS, GEAR_RATIO = int(MODEL.objects[0x608F, 1].value), int(MODEL.objects[0x6091, 1].value)
AGREES = DriveScaling(encoder_increments=INCREMENTS, gear_ratio=GEAR_RATIO)


def notes(scaling: tuple[DriveScaling, ...], *changes: tuple[int, tuple[int, ...]], pdos: int = 1) -> list[str]:
    """Start a drive with changed or added objects (index, values); return the notes."""
    model = create("cubemars-orh70")
    for index, values in changes:
        if len(values) == 1:
            model.objects.variable(index, "one", DataType.UNSIGNED32, values[0])
        else:
            entries = [Entry(index, i, "part", DataType.UNSIGNED32, value) for i, value in enumerate(values, 1)]
            model.objects.record(index, "ratio", entries)
    device = replace(DEVICE, scaling=scaling)
    if pdos == 2:
        # The model has one axis: only the objects of a second axis are compared.
        more = Pdo(0x1A00, DEVICE.tpdo[0].channels, axis=2)
        device = replace(device, tpdo=(more,), rpdo=DEVICE.rpdo)
    bus = InProcessBus([model])
    bus.configure([SlaveConfig("drive1", device, "devices/x.yaml")], PERIOD_NS)
    return bus.notes


def test_a_drive_that_counts_as_its_file_says_starts_and_what_it_lacks_is_noted() -> None:
    assert notes((AGREES,)) == [
        "slave 1 (drive1) has no 0x60A9 (velocity_unit): whether its file is right about it is not checked"
    ]
    everything = replace(AGREES, feed_constant=36000.0, rated_torque=1.2346, rated_current=4.5, velocity_unit="mrpm")
    objects = (0x6092, (72000, 2)), (0x6076, (1235,)), (0x6075, (4500,)), (0x60A9, (0xFDB44700,))
    assert notes((everything,), *objects) == []
    assert "0x6076 (rated_torque)" in notes((everything,), *objects[:1], (0x6076, (0,)), *objects[2:])[0]
    assert (
        notes((replace(everything, rated_torque_unit="uNm"),), *objects[:1], (0x6076, (1234600,)), *objects[2:]) == []
    )


@pytest.mark.parametrize(
    ("scaling", "objects", "named"),
    [
        (replace(AGREES, encoder_increments=1024.0), (0x608F, (131072, 1)),
         "0x608F holds 131072 increments a motor revolution, the file has 1024 (key `encoder_increments` of `scaling` "
         "in devices/x.yaml)"),
        (AGREES, (0x6091, (100, 3)), "0x6091 holds 33.33333333 motor revolutions"),
        (AGREES, (0x6092, (360000, 1)), "0x6092 holds 360000 counts"),
        (replace(AGREES, rated_torque=1.2), (0x6076, (1200000,)), "0x6076 holds 1200 Nm, the file has 1.2 "),
        (replace(AGREES, rated_current=4.5), (0x6075, (9000,)), "0x6075 holds 9 A, the file has 4.5 "),
        (AGREES, (0x60A9, (0x00B44700,)), "0x60A9 holds rpm, the file has counts/s "),
        (replace(AGREES, velocity_unit="rpm"), (0x60A9, (0x00410300,)), "0x60A9 holds the unit 0x00410300, "),
    ],
)  # fmt: skip
def test_a_drive_that_counts_otherwise_is_refused_with_both_values(
    scaling: DriveScaling, objects: tuple[int, tuple[int, ...]], named: str
) -> None:
    with pytest.raises(BusError) as refused:
        notes((scaling,), objects)
    (sentence,) = refused.value.sentences
    assert sentence.startswith("slave 1 (drive1): the drive counts otherwise than its file: ")
    assert named in sentence
    assert sentence.endswith("correct the one that is wrong before the arm moves")


def test_a_feed_constant_that_the_drive_does_not_count_in_is_not_compared() -> None:
    assert notes((replace(AGREES, feed_constant=0.0),), (0x6092, (1, 1)), (0x60A9, (0,)))
    assert notes((AGREES,), (0x6092, (0, 0)), (0x60A9, (0x00B50300,))) == []  # 0 is no ratio


def test_each_axis_is_compared_with_its_own_objects() -> None:
    second = replace(AGREES, gear_ratio=50.0)
    objects = (0x688F, (INCREMENTS, 1)), (0x60A9, (0x00B50300,)), (0x68A9, (0x00B50300,))
    assert notes((AGREES, second), *objects, (0x6891, (50, 1)), pdos=2) == [
        "slave 1 (drive1) has no interpolation time (0x68C2)"
    ]
    with pytest.raises(BusError, match=r"slave 1 \(drive1\), axis 2: .*0x6891 holds 51 .* has 50 "):
        notes((AGREES, second), *objects, (0x6891, (51, 1)), pdos=2)


def test_a_drive_that_answers_with_another_error_is_no_drive_that_lacks_the_object() -> None:
    class Client:
        position, name = 1, "drive1"

        def reading_int(self, index: int, subindex: int) -> Iterator[None]:
            raise SdoAborted("hardware error", 0x06060000)
            yield

    with pytest.raises(SdoAborted):
        finish(compare_scaling(cast(SdoClient, Client()), SlaveConfig("drive1", replace(DEVICE, scaling=(AGREES,)))))
