"""Slaves without mailbox, with a few bits, with several sync managers a direction, and on branches, brought to OP."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import pytest

from rtcp.config.device_file import file_text
from rtcp.esi.reader import find_device, read_esi
from rtcp.esi.sii import write_sii
from rtcp.virtual.faults.control import SegmentClient
from tests.fieldbus.conftest import WATCHER, StartSegment
from tests.fieldbus.terminals import DEVICES, ESI_FILES, OUT
from tests.waiting import until

DIRECT = ("coupler", "bits2", "emulated", "output", "bits4", "bits7", "bits6", "input", "bits1", "bits6")


def test_neighbours_that_share_bytes_each_have_their_own_bits(start_segment: StartSegment) -> None:
    answer = start_segment(DIRECT).master("terminals", kinds=DIRECT)
    result = answer["result"]
    assert answer["left"] == []
    assert result["states"] == ["OP"] * len(DIRECT)
    # Two for outputs and one for inputs each; SOEM expects too few.
    assert result["expected_wkc"] == 7 * 3 + 2 + 1
    assert set(result["wkcs"][-50:]) <= {result["expected_wkc"], -1}
    assert result["soem_expected"] < result["expected_wkc"]
    for sent, received in result["patterns"]:
        assert [data for data, kind in zip(received, DIRECT, strict=True) if kind.startswith(("bits", "emu"))] == [
            data for data, kind in zip(sent, DIRECT, strict=True) if kind.startswith(("bits", "emu"))
        ]


def test_several_sync_managers_of_a_direction_each_get_their_fmmu(start_segment: StartSegment) -> None:
    kinds = ("areas", "pairs", "bits3")
    entries = ("areas", "pairs, options: {sync_error_limit: 0}", "bits3")
    result = start_segment(entries).master("terminals", kinds=kinds)["result"]
    assert result["states"] == ["OP"] * 3
    assert result["expected_wkc"] == 9
    for sent, received in result["patterns"]:
        # The first of its three areas of outputs comes back in an input of 16 bits.
        assert received[0] == sent[0][:2] + "00"
        assert received[1:] == sent[1:]
    assert "".join(result["objects"]) == result["patterns"][-1][0][0]
    assert result["sync"] == "3007"


def test_mailbox_sizes_of_0_in_the_eeprom_are_replaced_by_its_sync_managers(
    start_segment: StartSegment,
) -> None:
    kinds = ("sizeless", "bits3", "sizeless")
    answer = start_segment(kinds).master("terminals", kinds=kinds)
    result = answer["result"]
    assert result["states"] == ["OP"] * 3
    assert all(received == sent for sent, received in result["patterns"])
    used = "its EEPROM gives no mailbox sizes (words 0x18 to 0x1B); those of its sync managers are used: 128 bytes at "
    assert [note for note in answer["left"] if "mailbox" in note] == [
        f"slave {n} (t{n - 1}): {used}0x1000 to the slave, 128 bytes at 0x1080 from it" for n in (1, 3)
    ]


def test_a_device_file_with_coe_for_a_slave_whose_eeprom_has_no_mailbox_is_refused(start_segment: StartSegment) -> None:
    (error,) = start_segment(("unlisted",)).master("terminals", kinds=("unlisted",))["error"]
    assert error.startswith("slave 1 (t0): its EEPROM lists no CoE mailbox (words 0x18 to 0x1C, and category 41), but ")


def test_registers_that_a_virtual_sync_manager_stands_for_are_process_data(start_segment: StartSegment) -> None:
    result = start_segment(("clock", "bits3")).master("terminals", kinds=("clock", "bits3"))["result"]
    assert result["states"] == ["OP"] * 2
    times = [int.from_bytes(bytes.fromhex(received[0])[1:], "little") for _, received in result["patterns"]]
    assert all(0 < later - time & 0xFFFFFFFF < 2_000_000_000 for time, later in pairwise(times))
    assert [received[1] for _, received in result["patterns"]] == [sent[1] for sent, _ in result["patterns"]]


@pytest.mark.parametrize(
    ("root", "delays"), [("clock", [0, 840, 1680, 4200, 5040]), ("coupler", [None, 0, 840, 0, 840])]
)
def test_delays_count_from_the_first_clock_of_a_branch(
    start_segment: StartSegment, root: str, delays: list[int | None]
) -> None:
    segment = start_segment((root, "clock, after: 1, port: 3", "clock", "clock, after: 1, port: 1", "clock"))
    assert [slave["delay_ns"] for slave in segment.master("scan")["result"]] == pytest.approx(delays, abs=20)


def test_a_slave_on_one_branch_is_set_up_again_while_another_branch_is_lost(start_segment: StartSegment) -> None:
    kinds = ("coupler", "bits4", "bits2", "areas", "output")
    segment = start_segment((kinds[0], "bits4, after: 1, port: 3", "bits2", "areas, after: 1, port: 1", "output"))
    result = segment.master("branches", child=WATCHER, control=str(segment.control), kinds=kinds)["result"]
    assert result["acted"] == ["OP", "no answer", "no answer", "OP", "OP"]
    assert result["states"] == ["OP"] * 5
    assert result["after"] == result["before"]
    # The three sync managers of outputs that trigger the watchdog against the EEPROM.
    managers = bytes.fromhex(result["after"][3]["managers"])
    assert [managers[8 * n + 4] for n in (2, 3, 4)] == [0x64] * 3
    assert result["whole"]
    messages = "\n".join(result["reported"])
    assert "slave 2 (t2) to slave 3 (t3) left OP: none of them answers" in messages
    assert "between slave 1 (t1) and slave 2 (t2)" in messages
    assert "slave 4 (t4) to slave 5 (t5) left OP" in messages
    assert "between slave 1 (t1) and slave 4 (t4)" in messages


def test_outputs_become_safe_when_the_master_dies_also_where_the_eeprom_leaves_the_watchdog_off(
    start_segment: StartSegment,
) -> None:
    kinds = ("areas", "bits4", "output")
    segment = start_segment(kinds)
    assert segment.master("dies", kinds=kinds) == ["OP"] * 3
    with SegmentClient(segment.control) as client:
        until(lambda: [slave["al"] for slave in client.truth()["slaves"]] == ["SAFE-OP"] * 3, "SAFE-OP")
        outputs = [
            entry["value"] for slave in (1, 2, 3) for entry in client.get(slave) if entry["index"] == OUT
        ]  # fmt: skip
    assert outputs == [0] * 5


def test_files_are_written_and_read_over_foe_and_firmware_in_boot(start_segment: StartSegment) -> None:
    result = start_segment(("files", "bits4")).master("files")["result"]
    assert result["refused"] == [
        "slave 1 (Terminal 40) refused the read of file 'nothing': error 0x8001, there is no such file (file not "
        "found)",
        "slave 1 (Terminal 40) refused the write of 1 bytes to file 'firmware': error 0x8008, only in BOOT: add --boot "
        "(go to BOOT first)",
        "slave 2 (Terminal 14): read of file 'settings' is not possible, its EEPROM lists no FoE mailbox",
        "slave 2 (Terminal 14): its EEPROM lists no mailboxes for BOOT (words 0x14 to 0x17)",
        f"slave 1 (Terminal 40): read of file '{'n' * 300}' is not possible, the name has 300 bytes, its mailbox takes "
        "116: give a shorter name",
    ]
    assert (result["in_boot"], result["kept"]) == ("BOOT", True)
    # It answers busy three times before it accepts the last packet; each answer is reported.
    assert result["done"][-5:] == [1952] * 4 + [2000]


def test_an_eeprom_is_read_and_written_word_by_word_and_only_where_it_differs(start_segment: StartSegment) -> None:
    result = start_segment(("files",)).master("eeprom")["result"]
    assert bytes.fromhex(result["before"]) == write_sii(DEVICES["files"])
    assert result["written"] == [1, 0]
    assert result["same"]
    assert result["parts"] == [8 / 512, 1.0]
    # Half written, it has a wrong checksum whenever the write is broken off.
    assert (result["sound"], result["whole"]) == ([False, False, False, True], True)


def test_texts_and_complete_objects_of_the_makers_start_up_commands_are_written_at_the_start(
    start_segment: StartSegment, tmp_path: Path
) -> None:
    file = tmp_path / "analog.yaml"
    file.write_text(file_text(find_device(read_esi(ESI_FILES / "analog.xml"))))
    segment = start_segment(("analog.xml",))
    written = ["54414e4b2050524553535552", "64000000", "0000c03f", "feffffff"]
    assert segment.master("described", file=str(file))["result"] == written
    file.write_text(file.read_text().replace("54 41", "54 41 54 41"))
    assert segment.master("described", file=str(file))["error"] == [
        "slave 1 (aio) refused the write of 14 bytes to 0x8001:0: abort code 0x06070012, data type does not match: "
        "too long"
    ]


def test_a_terminal_whose_eeprom_maps_other_objects_than_its_file_is_refused(start_segment: StartSegment) -> None:
    assert start_segment(("input", "bits4")).master("contradicted")["error"] == [
        "slave 2 (t2): the PDOs in its EEPROM differ from the device's file (key `rpdo`): expected 4 bits (0x1601: "
        "0x7000:9/4), found 4 bits (0x1601: 0x7000:1/4); `rtcp device new --from-bus` describes it as it is"
    ]


@pytest.mark.interpreted
def test_an_answer_that_got_lost_is_repeated_by_the_slave_and_not_asked_for_again(start_segment: StartSegment) -> None:
    result = start_segment(("analog.xml",)).master("repeated")["result"]
    assert result == {"value": "Analog terminal", "requests": 1, "answers": 2, "same": True}
