"""Other programs report no fault: SOEM's slaveinfo, KickCAT and Wireshark's dissector.

`.ci/foreign_tools` installs them; where one is missing its tests are skipped.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from rtcp.config import default_config, load, segment_path
from rtcp.launch.capturing import Capture
from tests.fieldbus.conftest import MODELS, StartSegment
from tests.virtual.conftest import ROOT, described, segment

TOOLS = Path(os.environ.get("RTCP_FOREIGN_TOOLS", "none"), "bin")
KICKCAT = Path(__file__).with_name("kickcat_child.py")
JOINED = (
    "import os, sys; import tests.virtual.soem_child as s; s.join(sys.argv[1]); os.execv(sys.argv[2], sys.argv[2:])"
)
DESCRIBED = (
    described(0x13, "name: root"), described(0x20, "after: root, port: 3, behaviour: cia402"),
    described(0x30, "after: root, port: 1"), described(0x11), described(0x12), described(0x11),
)  # fmt: skip
"""A junction with a two-SM box, bits that share bytes, and a drive at its port 3."""
CHECKED = (
    "_ws.expert.message", "ecat_mailbox.invalid", "ecat_mailbox.coe.invalid", "ecat_mailbox.foe.invalid",
    "ecat_mailbox.foe_opmode", "ecat_mailbox.coe.type",
)  # fmt: skip
EXCHANGES: tuple[tuple[int | Sequence[str], dict[str, dict[str, Any]]], ...] = (
    (3, {"op": {"period_ns": 1_000_000}, "sdo": {}, "scan": {}, "emergency": {}}),
    (("files", "bits4"), {"files": {}}),
)
"""Segments, and for each the scenarios of `master_child` with their arguments."""
SOEM_SOURCE = "Source MAC must not be a group address"
"""SOEM sends from 01:01:01:01:01:01."""


def run(tool: str, pid: int, *arguments: str) -> str:
    """Run a tool in the network namespace of a segment; return its output."""
    if not (TOOLS / tool).exists():
        pytest.skip(f"RTCP_FOREIGN_TOOLS names no folder with bin/{tool}: `.ci/foreign_tools` makes one")
    command = [sys.executable, "-c", JOINED, str(pid), str(TOOLS / tool), *arguments]
    return subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True, cwd=ROOT).stdout


@pytest.mark.parametrize("what", ["-sdo", "-map"])
@pytest.mark.parametrize("slaves", ["shipped", "described"])
def test_slaveinfo_of_soem_brings_all_slaves_to_safe_op_and_reads_every_object(
    slaves: str, what: str, tmp_path: Path
) -> None:
    config = tmp_path / "segment.yaml"
    config.write_text("slaves:\n" + "".join(f"- {{{entry}}}\n" for entry in DESCRIBED))
    with segment(segment_path(load(default_config())) if slaves == "shipped" else config) as pid:
        output = run("slaveinfo", pid, "ecat0", what)
    assert f"{len(MODELS) if slaves == 'shipped' else len(DESCRIBED)} slaves found and configured." in output
    assert re.findall(r".*(?:error:|[Uu]nknown|Not all|workaround).*", output) == []
    assert set(re.findall(r"State: (.*)", output)) == {"4"}
    if what == "-sdo":
        objects = sum(map(int, re.findall(r"CoE Object Description found, (\d+) entries", output)))
        assert objects == len(re.findall(r"^0x\w{4} ", output, re.MULTILINE)) > 40


def test_kickcat_brings_the_shipped_segment_to_op_and_reads_objects() -> None:
    with segment(segment_path(load(default_config()))) as pid:
        slaves = json.loads(run("python", pid, str(KICKCAT), "ecat0").splitlines()[-1])
    assert [slave["name"] for slave in slaves] == ["DIEWU 16DI16DO", *(f"Cubemars {m[9:].upper()}" for m in MODELS[1:])]
    assert [slave["bytes"] for slave in slaves] == [[2, 6]] + [[15, 15]] * 6
    for number, slave in enumerate(slaves, 1):
        assert (slave["state"], slave["object"], slave["entry"]) == ("OPERATIONAL", "Identity", "Vendor ID")
        assert slave["whole"] == slave["one by one"]
        assert slave["whole"].endswith(number.to_bytes(4, "little").hex())


@pytest.mark.skipif(shutil.which("tshark") is None, reason="tshark is not installed")
def test_wiresharks_dissector_finds_no_fault_in_what_master_and_slaves_exchange(
    start_segment: StartSegment, tmp_path: Path
) -> None:
    services: tuple[set[str], set[str]] = (set(), set())
    out = tmp_path / "frames.pcapng"
    for slaves, scenarios in EXCHANGES:
        segment = start_segment(slaves)
        with out.open("wb") as file, Capture("ecat0", segment.pid, file) as capture:
            for scenario, arguments in scenarios.items():
                assert "result" in segment.master(scenario, receive_fraction=0.5, **arguments)
            assert capture.wait(0.5).lost == 0
        command = ["tshark", "-r", str(out), "-T", "fields", *(word for name in CHECKED for word in ("-e", name))]
        lines = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout.splitlines()
        assert len(lines) > 1000
        for line in lines:
            message, *invalid, file_service, coe_service = line.split("\t")
            assert (not message or message.startswith(SOEM_SOURCE), "".join(invalid)) == (True, ""), line
            services[0].update(filter(None, file_service.split(",")))
            services[1].update(filter(None, coe_service.split(",")))
    # Every service occurred: of FoE the six, of CoE emergency, SDO request and response, SDO information.
    assert [len(services[0]), services[1]] == [6, {"1", "2", "3", "8"}]
