from __future__ import annotations

from types import SimpleNamespace

import pytest

from rtcp.config.model import DeviceDescription, Pdo, PdoEntry, SlaveConfig
from rtcp.fieldbus.pdo import layout_faults, mapping_of, mapping_text
from rtcp.fieldbus.scan import parents
from rtcp.fieldbus.slave_setup import identity_faults, interpolation_time


def slave(name: str, vendor: int = 1, product: int = 2, entries=("uint16",)) -> SlaveConfig:
    pdo = Pdo(0x1600, tuple(PdoEntry(0x7000, i, kind, f"c{i}") for i, kind in enumerate(entries, 1)))
    return SlaveConfig(name, DeviceDescription(f"kind {product}", "io", vendor, product, (pdo,), ()))


def found(vendor: int = 1, product: int = 2) -> SimpleNamespace:
    return SimpleNamespace(name="thing", man=vendor, id=product)


def test_slaves_as_configured_have_no_fault():
    assert identity_faults([found(), found(product=3)], [slave("a"), slave("b", product=3)]) == []


def test_every_wrong_slave_is_named_with_position_name_expected_and_found():
    faults = identity_faults([found(vendor=9), found(), found(product=7)], [slave("a"), slave("b"), slave("c")])
    assert len(faults) == 2
    for part in ("position 1 (a)", "vendor 0x00000001", "found thing (vendor 0x00000009"):
        assert part in faults[0]
    assert "position 3 (c)" in faults[1]


def test_a_missing_slave_is_told_with_the_number_and_the_place():
    faults = identity_faults([found()], [slave("a"), slave("b")])
    assert faults == [
        "1 slaves answer, the configuration (key `slaves`) lists 2",
        "position 2 (b): expected kind 2 (vendor 0x00000001, product 0x00000002), found nothing",
    ]


def test_a_surplus_slave_is_told_with_its_place():
    faults = identity_faults([found(), found(product=5)], [slave("a")])
    assert "position 2: expected nothing, found thing" in faults[1]


@pytest.mark.parametrize(
    ("period_ns", "said"),
    [(500_000, (5, -4)), (250_000, (25, -5)), (1_000_000, (1, -3)), (125_000, (125, -6)), (2_000_000, (2, -3)),
     (100_000_000, (1, -1)), (333_000, None)],
)  # fmt: skip
def test_the_interpolation_time_is_a_byte_and_a_power_of_ten(period_ns, said):
    assert interpolation_time(period_ns) == said


def test_a_mapping_lists_index_subindex_and_bits():
    padding = Pdo(0x1A00, (PdoEntry(0x6041, 0, "uint16", "statusword"), PdoEntry(0, 0, "bool", "gap")))
    assert mapping_of((padding,)) == ((0x1A00, ((0x6041, 0, 16), (0, 0, 1))),)
    assert mapping_text(mapping_of((padding,))) == "17 bits (0x1A00: 0x6041:0/16, 0x0000:0/1)"


@pytest.mark.parametrize(("entries", "faults"), [(("bool",) * 3, 1), (("bool",) * 8, 0), (("uint8",), 0)])
def test_an_image_below_a_byte_is_refused(entries, faults):
    assert len(layout_faults(slave("a", entries=entries).device)) == faults


OPEN, NONE = "open", "no link"


@pytest.mark.parametrize(
    ("ports", "expected"),
    [
        ([(OPEN, OPEN, NONE, NONE)] * 3 + [(OPEN, NONE, NONE, NONE)], [0, 1, 2, 3]),
        # A junction at 1 with a branch of two, then one more at its other port.
        (
            [(OPEN, OPEN, NONE, OPEN), (OPEN, OPEN, NONE, NONE), (OPEN, NONE, NONE, NONE), (OPEN, NONE, NONE, NONE)],
            [0, 1, 2, 1],
        ),
    ],
)  # fmt: skip
def test_the_parent_of_a_slave_follows_from_the_open_ports(ports, expected):
    assert parents(ports) == expected
