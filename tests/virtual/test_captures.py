"""The segment, made of the EEPROM images of real devices, answers a master's frames as those devices did."""

from __future__ import annotations

from pathlib import Path

import pytest

from rtcp.config.segment import load_segment
from rtcp.virtual.segment import make_segment
from tests.virtual.captures import Difference, replay

CAPTURES = Path(__file__).parent / "captures_of_devices"
FILES = Path(__file__).parents[1] / "esi" / "files"
RUNS = {
    "ek1100-el2828-el2889": ([CAPTURES / f"{name}.bin" for name in ("ek1100", "el2828", "el2889")], 500, 0.75),
    "akd": ([FILES / "akd.bin"], 180, 0.85),
}
"""For each capture: EEPROM images, least number of datagrams, least share of equal answers, the EEPROM's kind aside."""
_AL_CONTROL, _AL_STATUS, _EEPROM_CONTROL, _MAILBOX_STATUS = 0x0120, 0x0130, 0x0502, 0x080D
_EEPROM_KIND = "the kind of EEPROM"
_DIFFERENCES = (
    ("type, ports and features of the ESC", range(0x0000, 0x000A)),
    ("FMMUs and sync managers that its ESC does not have", range(0x0630, 0x0680)),
    ("FMMUs and sync managers that its ESC does not have", range(0x0820, 0x0840)),
    ("a clock, of which the EEPROM says nothing, and its time", range(0x0900, 0x0A00)),
    ("the DL status of an EK1100, whose PDI is no processor", range(0x0110, 0x0112)),
    ("the PDI of another AKD than the one whose EEPROM was published", range(0x0140, 0x0142)),
)
"""Properties of a device that its EEPROM does not contain."""
_MAILBOX_AND_SDO_HEADER = 12


def reason_of(difference: Difference) -> str:
    """Return why a device answered otherwise; empty: nothing explains it."""
    sent, device, ours = difference.sent, difference.device, difference.segment
    for reason, addresses in _DIFFERENCES:
        if sent.address in addresses and sent.command not in (10, 11, 12):
            return reason
    if sent.address == _EEPROM_CONTROL and ours is not None and device.wkc == ours.wkc:
        # Emulation, read size and busy time may differ; address width and errors may not.
        changed = int.from_bytes(device.data, "little") ^ int.from_bytes(ours.data, "little")
        return _EEPROM_KIND if not changed & ~0x8F70 else ""
    if ours is None:
        return ""
    if sent.address == _AL_CONTROL and device.wkc < ours.wkc:
        return "AL control is locked until its application has read it"
    if sent.address == _AL_STATUS and device.data[0] < ours.data[0] < 0x10:
        return "its application takes longer to change its state"
    if sent.address == _MAILBOX_STATUS and not device.data[0] & 8 and ours.data[0] & 8:
        return "its application takes longer to answer"
    if len(sent.data) > 64 and device.data[:_MAILBOX_AND_SDO_HEADER] == ours.data[:_MAILBOX_AND_SDO_HEADER]:
        return "the value of an object, of which the EEPROM says nothing, and what lies behind the message"
    return ""


@pytest.mark.interpreted
@pytest.mark.parametrize("name", RUNS)
def test_each_datagram_is_answered_as_by_the_devices_but_for_what_no_eeprom_contains(name: str, tmp_path: Path) -> None:
    eeproms, least, share = RUNS[name]
    file = tmp_path / "segment.yaml"
    file.write_text("slaves:\n" + "".join(f"  - {{sii: {eeprom}}}\n" for eeprom in eeproms))
    answers = list(replay(CAPTURES / f"{name}.pcapng", make_segment(load_segment(file), 0), 10**9))
    differences = [difference for difference in answers if difference is not None]
    assert len(answers) > least
    assert [difference for difference in differences if not reason_of(difference)] == []
    same = len(answers) - len(differences)
    of_eeprom = sum(reason_of(difference) == _EEPROM_KIND for difference in differences)
    assert same + of_eeprom > share * len(answers), (
        f"{same} of {len(answers)} the same, {of_eeprom} but for the kind of EEPROM"
    )
