"""The SOEM bus against a virtual segment: real processes, real sockets, real frames."""

from __future__ import annotations

import random
import signal
import threading
import time
from collections.abc import Sequence
from typing import Any

import pytest

from rtcp.virtual.faults.control import SegmentClient
from tests.fieldbus.conftest import Segment, StartSegment

OP_MAPPING = ["05", "10004060", "20007a60", "2000ff60", "20007160", "08006060"]
INIT, NO_SYNC = "01", "00"
DELAYS = [0, 820, 1660, 2500, 3320, 4160, 5020]
"""Propagation delays of the arm's slaves, ns."""
LOST = "test_frames_that_get_lost_or_come_late_keep_no_segment_from_being_configured"
STALLED = "test_a_segment_that_is_off_its_cpu_now_and_then_is_configured_all_the_same"
PROMISCUOUS = 0x100
"""IFF_PROMISC, netdevice(7)."""


def test_seven_slaves_go_from_init_to_op_with_clocks_and_a_mapping_that_reads_back(start_segment: StartSegment) -> None:
    answer = start_segment(7).master("op", receive_fraction=0.5, period_ns=4_000_000)
    result = answer["result"]
    assert result["safe_op"] == ["SAFE-OP"] * 7
    assert result["states"] == ["OP"] * 7
    assert result["expected_wkc"] == 21
    assert set(result["wkcs"]) <= {21, -1}
    assert 21 in result["wkcs"]
    assert result["mapping"] == OP_MAPPING
    assert result["assigned"] == ["01", "0016"]
    assert result["following_window"] == 2000
    assert result["watchdog"] == 50_000  # units of 0.1 ms
    assert result["sync0_cycle_ns"] == 4_000_000
    # The reference clock is the first slave's: it drifts by ppm, not by per cent.
    least, most = result["host_passed_ns"]
    assert 0.9 * least < result["dc_passed_ns"] < 1.1 * most


@pytest.mark.parametrize("clock_bits", [(32, 64, 32), (0, 32, 64)])
def test_slaves_with_clocks_of_32_bits_or_a_first_one_that_cannot_be_set_get_to_op_and_show_their_time(
    start_segment: StartSegment, clock_bits: Sequence[int]
) -> None:
    segment = start_segment(3, clock_bits=clock_bits)
    result = segment.master("op", receive_fraction=0.5, period_ns=4_000_000)["result"]
    assert result["states"] == ["OP"] * 3
    least, most = result["host_passed_ns"]
    # The cycle's frames bring the reference clock's time, as it is on the wire.
    assert 0.9 * least < result["dc_passed_ns"] % (1 << 32) < 1.1 * most


def test_close_leaves_the_slaves_in_init_without_sync(segment: Segment) -> None:
    answer = segment.master("op", receive_fraction=0.5, period_ns=4_000_000)
    assert answer["left"] == []
    assert answer["after"] == {"al_status": INIT, "sync": NO_SYNC}


@pytest.mark.parametrize(
    ("scenario", "arguments"),
    [("up", {}), ("op", {"period_ns": 4_000_000}), ("refused", {"how": "absent objects"})],
)
def test_no_start_and_no_end_makes_a_slave_report_an_al_error(
    segment: Segment, scenario: str, arguments: dict[str, Any]
) -> None:
    answer = segment.master(scenario, receive_fraction=0.5, **arguments)
    assert answer["al_errors"] == []
    assert answer["after"]["al_status"] == INIT


@pytest.mark.parametrize("promiscuous", [False, True])
def test_close_leaves_the_interfaces_flags_as_they_were_before_open(segment: Segment, promiscuous: bool) -> None:
    before, after = segment.master("scan", promiscuous=promiscuous)["flags"]
    assert bool(before & PROMISCUOUS) == promiscuous
    assert after == before


def test_a_scan_that_is_ended_by_a_signal_leaves_the_interfaces_flags_and_the_slaves_as_they_were(
    segment: Segment,
) -> None:
    answer = segment.master("interrupted", pid=segment.pid)
    assert answer["result"] in (143, 0)  # 0: it had its answer before the signal came
    assert answer["flags"][1] == answer["flags"][0]
    assert answer["after"]["al_status"] == INIT


def test_an_error_in_the_cycle_leaves_the_slaves_in_init_too(segment: Segment) -> None:
    answer = segment.master("failing")
    assert answer["error"] == ["something broke in the cycle"]
    assert answer["after"] == {"al_status": INIT, "sync": NO_SYNC}


def test_slaves_left_in_op_with_sync_by_a_killed_master_start_again(segment: Segment) -> None:
    assert segment.master("abandoned") == {}
    assert segment.master("op", receive_fraction=0.5, period_ns=4_000_000)["result"]["states"] == ["OP"] * 3


def test_a_scan_tells_identity_states_map_clocks_and_delays(start_segment: StartSegment) -> None:
    slaves = start_segment(7).master("scan")["result"]
    assert [slave["name"] for slave in slaves] == ["DIEWU 16DI16DO"] + ["Cubemars ORH70"] * 3 + [
        "Cubemars ORH60", "Cubemars ORH50", "Cubemars ORH40"]  # fmt: skip
    assert [slave["station"] for slave in slaves] == list(range(0x1001, 0x1008))
    assert [slave["delay_ns"] for slave in slaves] == pytest.approx(DELAYS, abs=20)
    assert [slave["parent"] for slave in slaves] == list(range(7))
    assert {slave["state"] for slave in slaves} == {"PRE-OP"}
    assert [(slave["output_bits"], slave["input_bits"]) for slave in slaves] == [(16, 48)] + [(120, 120)] * 6
    drive = slaves[1]
    assert (drive["vendor_id"], drive["product_code"], drive["has_coe"], drive["dc"]) == (0xB5C, 0x40201, True, True)
    first = drive["outputs"][0]["entries"][0]
    assert (drive["outputs"][0]["index"], first["index"], first["bits"]) == (0x1600, 0x6040, 16)
    assert first["name"].lower() == "controlword"
    assert slaves[-1]["ports"][:2] == ["open", "no link"]


@pytest.mark.parametrize(
    ("how", "parts"),
    [
        ("swapped", ["position 1 (drive1)", "expected Cubemars ORH", "found DIEWU", "position 2 (io)"]),
        ("missing", ["3 slaves answer", "lists 4", "position 4 (drive3)", "found nothing"]),
        ("surplus", ["3 slaves answer", "lists 2", "position 3", "expected nothing", "found Cubemars"]),
        ("longer", ["slave 1 (io)", "key `tpdo`", "expected 64 bits", "found 48 bits"]),
        ("unmappable", ["slave 2 (drive1)", "refused", "0x1600", "abort code 0x060400", "orh.yaml (key `rpdo`)"]),
        ("absent objects", ["slave 2 (drive1)", "slave 3 (drive2)", "0x5FFF:1", "0x06020000", "does not exist"]),
    ],
)
def test_what_differs_from_the_configuration_is_refused_in_sentences(
    segment: Segment, how: str, parts: list[str]
) -> None:
    answer = segment.master("refused", how=how)
    sentences = "\n".join(answer["error"])
    for part in parts:
        assert part in sentences
    assert answer["after"]["al_status"] == INIT


@pytest.mark.parametrize("seed", [2, *(pytest.param(seed, marks=pytest.mark.long(LOST)) for seed in (1, 3))])
@pytest.mark.parametrize("fault", [{"fault": "loss", "rate": 0.02}, {"fault": "delay", "rate": 0.02, "ms": 30}])
def test_frames_that_get_lost_or_come_late_keep_no_segment_from_being_configured(
    start_segment: StartSegment, fault: dict[str, Any], seed: int
) -> None:
    segment = start_segment(7)
    with SegmentClient(segment.control) as client:
        client.fault({**fault, "seed": seed})
    answer = segment.master("up")
    assert answer.get("error") is None
    result = answer["result"]
    assert (result["expected_wkc"], result["tries"]) == (21, 3)
    assert result["delays"] == pytest.approx(DELAYS, abs=100)
    # Crystals have drifted apart since; a clock that was not set shows the time since the segment's start.
    assert result["apart_ns"] < 1_000_000


@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.long(STALLED)) for seed in (2, 3, 4))])
def test_a_segment_that_is_off_its_cpu_now_and_then_is_configured_all_the_same(
    start_segment: StartSegment, seed: int
) -> None:
    segment, chance, done = start_segment(7), random.Random(seed), threading.Event()

    def stalls() -> None:
        while not done.wait(chance.uniform(0.05, 0.4)):
            segment.process.send_signal(signal.SIGSTOP)
            time.sleep(0.08)
            segment.process.send_signal(signal.SIGCONT)

    host = threading.Thread(target=stalls)
    host.start()
    try:
        answer = segment.master("up")
    finally:
        done.set()
        host.join()
    assert answer.get("error") is None
    assert (answer["result"]["expected_wkc"], answer["result"]["tries"]) == (21, 3)


@pytest.mark.parametrize("complete_access", [True, False])
def test_slaves_that_answer_complete_access_wrongly_are_mapped_by_single_subindices(
    start_segment: StartSegment, complete_access: bool
) -> None:
    segment = start_segment(3, program="tests.fieldbus.wrong_complete_access")
    result = segment.master("up", complete_access=complete_access)["result"]
    assert result["expected_wkc"] == 9
    assert result["attempts"] == (2 if complete_access else 1)


def test_a_map_that_soem_misread_is_made_anew_from_init(segment: Segment) -> None:
    result = segment.master("misread", receive_fraction=0.5, times=2)["result"]
    assert (result["tries"], result["states"]) == (3, ["OP"] * 3)
    assert set(result["wkcs"]) <= {9, -1}
    assert 9 in result["wkcs"]


def test_a_map_that_soem_misreads_each_time_is_told(segment: Segment) -> None:
    answer = segment.master("misread", times=9)
    assert answer["error"] == ["slave 1: SOEM could not read the PDO mapping"]
    assert answer["after"]["al_status"] == INIT


def test_a_slave_that_is_silent_while_it_is_configured_is_told(segment: Segment) -> None:
    with SegmentClient(segment.control) as client:
        client.fault({"fault": "sdo_late", "slave": 2, "ms": 60000})
    (sentence,) = segment.master("refused", how="as it is")["error"]
    assert sentence.startswith("slave 2 (drive1), ")
    assert sentence.endswith(": no answer in time")


def test_an_optional_start_up_object_that_is_absent_becomes_a_note(segment: Segment) -> None:
    notes = segment.master("optional")["result"]
    assert any("slave 2 (drive1) has no 0x5FFF:1 (a luxury)" in note for note in notes)


def test_a_refused_transition_is_told_with_its_code_in_words_and_can_be_acknowledged(segment: Segment) -> None:
    answer = segment.master("straight_to_op")
    result = answer["result"]
    (sentence,) = result["sentences"]
    for part in ("slave 2 (Cubemars ORH70)", "OP", "PRE-OP + ERROR", "0x0011", "invalid requested state change"):
        assert part in sentence
    assert result["after"] == ["PRE-OP"] * 3
    assert answer["al_errors"]


def test_sdo_access_reads_writes_and_tells_aborts_in_words(segment: Segment) -> None:
    result = segment.master("sdo")["result"]
    assert result["name"].startswith("Cubemars ORH70")
    assert result["kept"] == "d2040000"
    assert "slave 2" in result["aborted"]
    assert "object does not exist / 06020000" in result["aborted"]
    assert result["absent"] == "there is no slave 9; the bus has slaves 1 to 3"


def test_outputs_of_a_wrong_length_are_not_taken(segment: Segment) -> None:
    assert segment.master("outputs", receive_fraction=0.5)["result"] == {"box": "3412", "display": 9}


def test_registers_and_sdos_read_beside_the_cycle_disturb_neither(segment: Segment) -> None:
    result = segment.master("beside", receive_fraction=0.5)["result"]
    assert result["stations"] == [0x1001, 0x1002, 0x1003]
    assert result["names"] == ["Cubemars ORH70"]
    assert set(result["wkcs"]) <= {result["expected_wkc"], -1}
    assert result["expected_wkc"] in result["wkcs"]


def test_a_drive_that_loses_its_outputs_is_told_by_emergency_and_watchdog(segment: Segment) -> None:
    result = segment.master("emergency", receive_fraction=0.5)["result"]
    assert result["steps"][-1] == "operation enabled"
    assert result["steps"].index("ready to switch on") < result["steps"].index("switched on")
    assert 2 in result["slaves"]
    assert "SAFE-OP + ERROR (0x001B: sync manager watchdog)" in result["states"][1]


def test_no_answer_from_before_a_silence_is_taken_for_a_new_one(start_segment: StartSegment) -> None:
    segment = start_segment(7)
    period = 2_000_000
    result = segment.master("stopped", pid=segment.pid, period_ns=period)["result"]
    rows, stop, go = result["rows"], result["stop"], result["go"]
    taken = [(n, lag) for n, (wkc, lag, _, _) in enumerate(rows) if wkc >= 0]
    # SOEM alone takes answers that are a multiple of 16 cycles old, with a perfect working counter.
    assert min(lag for _, lag in taken) > min(lag for n, lag in taken if n < stop) - 8 * period
    assert all(wkc == -1 for wkc, *_ in rows[stop + 1 : go])
    assert any(n > go for n, _ in taken)
    # The counter depends on whether the drives' watchdogs expired; this test does not.
    assert any(wkc > 0 for wkc, *_ in rows[go:])


@pytest.mark.timing
def test_nothing_is_taken_in_while_the_segment_is_silent(start_segment: StartSegment) -> None:
    segment = start_segment(3)
    result = segment.master("stopped", pid=segment.pid, period_ns=500_000)["result"]
    during = result["rows"][result["stop"] + 1 : result["go"]]
    assert len({dc_time for *_, dc_time in during}) == 1
    # A receive that blocks takes one or two jiffies, 4 to 8 ms, each time.
    spent = sorted(took for _, _, took, _ in during)
    assert spent[len(spent) // 2] < 3_000_000


def test_a_segment_that_dies_ends_in_no_answer_and_a_note(segment: Segment) -> None:
    answer = segment.master("killed", pid=segment.pid)
    assert answer["result"] == {"wkc": -1, "states": ["no answer"] * 3}
    assert answer["left"] == ["the slaves on ecat0 could not be brought back to INIT: no frame comes back"]
