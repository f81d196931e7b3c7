"""The segment answers a master's frames as real devices did, which hang on it by the images of their EEPROMs."""

from __future__ import annotations

from pathlib import Path

import pytest

from rtcp.config.segment import load_segment
from rtcp.virtual.segment import make_segment
from tests.virtual.captures import Difference, replay

CAPTURES = Path(__file__).parent / "captures_of_devices"
DEVICES = ("ek1100", "el2828", "el2889")
_EEPROM_CONTROL = 0x0502
_DIFFERENCES = (
    ("type, ports and features of the ESC", range(0x0000, 0x000A)),
    ("FMMUs and sync managers that its ESC does not have", range(0x0630, 0x0680)),
    ("FMMUs and sync managers that its ESC does not have", range(0x0820, 0x0840)),
    ("a clock, of which the EEPROM says nothing", range(0x0900, 0x0A00)),
    ("the DL status of an EK1100, whose PDI is no processor", range(0x0110, 0x0112)),
)
"""What an EEPROM does not tell of a device."""


def reason_of(difference: Difference) -> str:
    """Return why a device answered otherwise; empty: nothing explains it."""
    sent, device, ours = difference.sent, difference.device, difference.segment
    for reason, addresses in _DIFFERENCES:
        if sent.address in addresses and sent.command not in (10, 11, 12):
            return reason
    if sent.address == _EEPROM_CONTROL and ours is not None and device.wkc == ours.wkc:
        # Read size, address width, checksum error; and for how long it is busy with its command. Its errors are not.
        changed = int.from_bytes(device.data, "little") ^ int.from_bytes(ours.data, "little")
        return "the kind of EEPROM" if not changed & ~0x8FF0 else ""
    return ""


@pytest.mark.interpreted
def test_each_datagram_is_answered_as_by_the_devices_but_for_what_no_eeprom_tells(tmp_path: Path) -> None:
    file = tmp_path / "segment.yaml"
    file.write_text("slaves:\n" + "".join(f"  - {{sii: {CAPTURES / name}.bin}}\n" for name in DEVICES))
    segment = make_segment(load_segment(file), 0)
    answers = list(replay(CAPTURES / "ek1100-el2828-el2889.pcapng", segment, 10**9))
    differences = [difference for difference in answers if difference is not None]
    assert len(answers) > 500
    assert [difference for difference in differences if not reason_of(difference)] == []
    same = len(answers) - len(differences)
    of_eeprom = sum(reason_of(difference) == "the kind of EEPROM" for difference in differences)
    assert same + of_eeprom > 0.75 * len(answers), (
        f"{same} of {len(answers)} the same, {of_eeprom} but for the kind of EEPROM"
    )
