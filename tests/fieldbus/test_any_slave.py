"""Slaves without mailbox, with a few bits, with several sync managers a direction, and on branches, brought to OP."""

from __future__ import annotations

from itertools import pairwise

import pytest

from rtcp.esi.sii import write_sii
from tests.fieldbus.conftest import WATCHER
from tests.fieldbus.terminals import DEVICES

pytestmark = pytest.mark.alone

DIRECT = ("coupler", "bits2", "emulated", "output", "bits4", "bits7", "bits6", "input", "bits1", "bits6")


def test_neighbours_that_share_bytes_each_have_their_own_bits(start_segment):
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


def test_several_sync_managers_of_a_direction_each_get_their_fmmu(start_segment):
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


def test_registers_that_a_virtual_sync_manager_stands_for_are_process_data(start_segment):
    result = start_segment(("clock", "bits3")).master("terminals", kinds=("clock", "bits3"))["result"]
    assert result["states"] == ["OP"] * 2
    times = [int.from_bytes(bytes.fromhex(received[0])[1:], "little") for _, received in result["patterns"]]
    assert all(0 < later - time & 0xFFFFFFFF < 2_000_000_000 for time, later in pairwise(times))
    assert [received[1] for _, received in result["patterns"]] == [sent[1] for sent, _ in result["patterns"]]


def test_a_slave_on_one_branch_is_set_up_again_while_another_branch_is_lost(start_segment):
    kinds = ("coupler", "bits4", "bits2", "areas", "output")
    segment = start_segment((kinds[0], "bits4, after: 1, port: 3", "bits2", "areas, after: 1, port: 1", "output"))
    result = segment.master("branches", child=WATCHER, control=str(segment.control), kinds=kinds)["result"]
    assert result["acted"] == ["OP", "no answer", "no answer", "OP", "OP"]
    assert result["states"] == ["OP"] * 5
    assert result["after"] == result["before"]
    assert result["whole"]
    told = "\n".join(result["said"])
    assert "slave 2 (t2) to slave 3 (t3) left OP: none of them answers" in told
    assert "between slave 1 (t1) and slave 2 (t2)" in told
    assert "slave 4 (t4) to slave 5 (t5) left OP" in told
    assert "between slave 1 (t1) and slave 4 (t4)" in told


def test_files_are_written_and_read_over_foe_and_firmware_in_boot(start_segment):
    result = start_segment(("files", "bits4")).master("files")["result"]
    assert result["refused"] == [
        "slave 1 (Terminal 40) refused the read of file 'nothing': error 0x8001, there is no such file (file not "
        "found)",
        "slave 1 (Terminal 40) refused the write of 1 bytes to file 'firmware': error 0x8008, only in BOOT: add --boot "
        "(go to BOOT first)",
        "slave 2 (Terminal 14): read of file 'settings' is not possible, its EEPROM lists no FoE mailbox",
        "slave 2 (Terminal 14): its EEPROM lists no mailboxes for BOOT (words 0x14 to 0x17)",
    ]
    assert (result["in_boot"], result["kept"]) == ("BOOT", True)
    assert result["done"][-1] == 2000


def test_an_eeprom_is_read_and_written_word_by_word_and_only_where_it_differs(start_segment):
    result = start_segment(("files",)).master("eeprom")["result"]
    assert bytes.fromhex(result["before"]) == write_sii(DEVICES["files"])
    assert result["written"] == [1, 0]
    assert result["same"]
    assert result["parts"] == [8 / 2048, 1.0]
