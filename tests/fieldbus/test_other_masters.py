"""The start, and the watcher beside the cycle, name the address of a second master on the cable."""

from __future__ import annotations

import json
from typing import Any

from rtcp.virtual.faults.control import SegmentClient
from tests.fieldbus.conftest import WATCHER, Segment
from tests.forked import answer_of

ADDRESS = "00:15:5d:2a:4b:01"


def ask(segment: Segment, do: str) -> dict[str, Any]:
    """Ask the bus as `rtcp scan` does."""
    question = {"interface": "ecat0", "namespace_pid": segment.pid, "do": do, "config": None, "slave": 1}
    return answer_of("rtcp.launch.offline", given=json.dumps(question))


def test_a_bus_error_names_the_second_master_as_its_cause_and_noise_is_none(segment: Segment) -> None:
    with SegmentClient(segment.control) as client:
        client.fault({"fault": "power", "slave": 1})
        client.fault({"fault": "noise", "rate_hz": 2000})
        alone = ask(segment, "scan")["error"]
        client.fault({"fault": "noise", "protocol": "other_master", "rate_hz": 1000})
        joined = ask(segment, "scan")["error"]
    assert alone == "no slave answers on ecat0: check the cable and the slaves' supply"
    first, cause = joined.splitlines()
    assert first == alone
    assert cause.startswith(f"frames that this platform did not send come from the address {ADDRESS}: a second ")


def test_a_second_master_beside_the_cycle_is_reported_once_with_its_address(segment: Segment) -> None:
    result = segment.master("other master", child=WATCHER, control=str(segment.control))["result"]
    assert result["alone"] == []
    assert result["joined"] == [
        f"frames that this platform did not send come from {ADDRESS}: disconnect or stop the second EtherCAT master"
    ]


def test_a_second_master_that_is_soem_too_is_heard_before_the_first_frame(segment: Segment) -> None:
    with SegmentClient(segment.control) as client:
        client.fault({"fault": "power", "slave": 1})
        client.fault({"fault": "noise", "protocol": "other_soem", "rate_hz": 1000})
        assert "from the address 01:01:01:01:01:01: a second" in ask(segment, "scan")["error"]
