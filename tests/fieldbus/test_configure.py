from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from rtcp.config.model import DeviceDescription, Pdo, PdoEntry, SlaveConfig
from rtcp.fieldbus.errors import BusError
from rtcp.fieldbus.image import limit_faults
from rtcp.fieldbus.interpolation_time import expressions
from rtcp.fieldbus.pdo import layout, mapping_of, mapping_text
from rtcp.fieldbus.slave_setup import by_alias, identity_faults
from rtcp.fieldbus.topology import PortState, Topology


def slave(name: str, vendor: int = 1, product: int = 2) -> SlaveConfig:
    pdo = Pdo(0x1600, (PdoEntry(0x7000, 1, "uint16", "c1"),))
    return SlaveConfig(name, DeviceDescription(f"kind {product}", "io", vendor, product, (pdo,), ()))


def answers(vendor: int = 1, product: int = 2) -> SimpleNamespace:
    return SimpleNamespace(name="thing", man=vendor, id=product)


def test_slaves_as_configured_have_no_fault() -> None:
    assert identity_faults([answers(), answers(product=3)], [slave("a"), slave("b", product=3)]) == []


def test_every_wrong_slave_is_named_with_position_name_expected_and_found() -> None:
    faults = identity_faults([answers(vendor=9), answers(), answers(product=7)], [slave("a"), slave("b"), slave("c")])
    assert len(faults) == 2
    for part in ("position 1 (a)", "vendor 0x00000001", "found thing (vendor 0x00000009"):
        assert part in faults[0]
    assert "position 3 (c)" in faults[1]


def test_a_missing_slave_is_told_with_the_number_and_the_place() -> None:
    faults = identity_faults([answers()], [slave("a"), slave("b")])
    assert faults == [
        "1 slaves answer, the configuration (key `slaves`) lists 2",
        "position 2 (b): expected kind 2 (vendor 0x00000001, product 0x00000002), found nothing",
    ]


def test_a_surplus_slave_is_told_with_its_place() -> None:
    faults = identity_faults([answers(), answers(product=5)], [slave("a")])
    assert "position 2: expected nothing, found thing" in faults[1]


@pytest.mark.parametrize(
    ("period_ns", "bits", "first", "count"),
    [(500_000, 8, (5, -4), 2), (250_000, 8, (25, -5), 2), (1_000_000, 8, (1, -3), 3), (125_000, 8, (125, -6), 1),
     (100_000_000, 8, (1, -1), 3), (333_000, 8, None, 0), (333_000, 16, (333, -6), 3)],
)  # fmt: skip
def test_the_interpolation_time_is_a_number_and_a_power_of_ten(
    period_ns: int, bits: int, first: tuple[int, int] | None, count: int
) -> None:
    found = list(expressions(period_ns, bits))
    assert (found[0] if found else None, len(found)) == (first, count)
    assert all(value * 10.0**exponent == pytest.approx(period_ns * 1e-9) for value, exponent in found)


def test_a_mapping_lists_index_subindex_and_bits() -> None:
    padding = Pdo(0x1A00, (PdoEntry(0x6041, 0, "uint16", "statusword"), PdoEntry(0, 0, "bool", "gap")))
    assert mapping_of((padding,)) == ((0x1A00, ((0x6041, 0, 16), (0, 0, 1))),)
    assert mapping_text(mapping_of((padding,))) == "17 bits (0x1A00: 0x6041:0/16, 0x0000:0/1)"


def with_managers(*bits_of: tuple[int, int], sent: int = 1) -> SlaveConfig:
    """A slave with inputs in (sync manager, bits) each, and `sent` bytes of outputs in one sync manager."""
    tpdo = tuple(
        Pdo(0x1A00 + n, (PdoEntry(0x6000, n, "bits", f"c{n}", bits=bits),), manager)
        for n, (manager, bits) in enumerate(bits_of)
    )
    rpdo = (Pdo(0x1600, (PdoEntry(0x7000, 1, "bytes", "out", bits=8 * sent),)),)
    return SlaveConfig("a", DeviceDescription("kind", "io", 1, 2, rpdo, tpdo))


def test_each_sync_manager_begins_at_a_whole_byte_in_the_order_of_its_number() -> None:
    image = layout(with_managers((5, 3), (3, 12)).device.tpdo)
    assert [(channel.name, channel.bit_offset) for channel in image.channels] == [("c1", 0), ("c0", 16)]
    assert image.bits == 19


def test_values_of_a_cycle_are_counted_in_the_lengths_of_sync_managers() -> None:
    single = with_managers((3, 4), (4, 12))
    first, second = single.device.tpdo
    double = replace(single, device=replace(single.device, tpdo=(replace(first, samples=2), second)))
    assert len(limit_faults([single])) == 1
    assert limit_faults([double]) == []


@pytest.mark.parametrize(
    ("slaves", "sentence"),
    [
        ([with_managers((3, 8), (4, 4))], ""),
        ([with_managers((3, 4), (4, 4))], "slave 1 (a): the sync managers of key `tpdo` carry 4 and 4 bits, which need "
         "2 bytes; SOEM gives them 1"),
        ([with_managers(*((n, 8) for n in range(3, 7)))], "slave 1 (a): `rpdo` and `tpdo` use 5 sync managers, each of "
         "which needs an FMMU; SOEM has room for 4"),
        ([with_managers(sent=21)] * 199, "the process data of all slaves have 4179 bytes; SOEM has room for 4096"),
        ([with_managers()] * 200, "(key `slaves`) lists 200 slaves; SOEM has room for 199"),
    ],
)  # fmt: skip
def test_what_soem_has_no_room_for_is_told_before_it_maps(slaves: list[SlaveConfig], sentence: str) -> None:
    assert "\n".join(limit_faults(slaves)).count(sentence) == 1 if sentence else not limit_faults(slaves)


OPEN, NONE = PortState.OPEN, PortState.NO_LINK
END, MIDDLE = (OPEN, NONE, NONE, NONE), (OPEN, OPEN, NONE, NONE)


@pytest.mark.parametrize(
    ("ports", "expected"),
    [
        ([MIDDLE, MIDDLE, MIDDLE, END], [(0, 0), (1, 1), (2, 1), (3, 1)]),
        # A junction with two slaves at port 3, which the frame visits first, one at port 1, two at port 2.
        ([(OPEN,) * 4, MIDDLE, END, END, MIDDLE, END], [(0, 0), (1, 3), (2, 1), (1, 1), (1, 2), (5, 1)]),
        # A junction behind a branch of another one.
        ([(OPEN, OPEN, NONE, OPEN), (OPEN, OPEN, OPEN, NONE), END, END, END], [(0, 0), (1, 3), (2, 1), (2, 2), (1, 1)]),
    ],
)  # fmt: skip
def test_the_tree_of_the_slaves_follows_from_the_open_ports(
    ports: Sequence[Sequence[PortState]], expected: list[tuple[int, int]]
) -> None:
    tree = Topology.of(ports)
    assert [(tree.parent(position), tree.port(position)) for position in range(1, len(ports) + 1)] == expected
    assert all(tree.child_at(*at) == position for position, at in enumerate(expected, 1))


def test_the_first_of_the_slaves_that_are_lost_together_hangs_at_one_that_answers() -> None:
    tree = Topology.of([(OPEN,) * 4, MIDDLE, END, END, MIDDLE, END])
    lost = {2, 3, 5, 6}
    assert [tree.first_lost(position, lost) for position in (2, 3, 5, 6)] == [2, 2, 5, 5]
    assert [tree.depth(position) for position in range(1, 7)] == [0, 1, 2, 1, 1, 2]


def answering(*aliases: int) -> list[Any]:
    return [SimpleNamespace(position=n, name="thing", alias=alias) for n, alias in enumerate(aliases, 1)]


def test_slaves_with_an_alias_are_found_where_they_hang_and_the_others_in_their_order() -> None:
    slaves = [replace(slave(name), alias=alias) for name, alias in (("a", 7), ("b", 0), ("c", 9), ("d", 0))]
    assert [config.name for config in by_alias(slaves, answering(0, 9, 5, 7))] == ["b", "c", "d", "a"]


def test_an_alias_that_nobody_or_that_several_have_is_told_with_those_that_there_are() -> None:
    slaves = [replace(slave(name), alias=alias) for name, alias in (("a", 7), ("b", 8))]
    with pytest.raises(BusError) as error:
        by_alias(slaves, answering(8, 8, 5))
    assert error.value.sentences == (
        "a: no slave has the station alias 7 (key `slaves`): slave 1 (thing) has 8, slave 2 (thing) has 8, slave 3 "
        "(thing) has 5; `rtcp alias set` writes one",
        "b: slave 1 and slave 2 have the station alias 8; `rtcp alias set` changes one",
    )
