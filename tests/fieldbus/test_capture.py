"""`rtcp capture`: the frames of a segment in a pcapng file, read here by the format's description."""

from __future__ import annotations

import os
import select
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from rtcp.ipc.errors import RtcpError
from rtcp.launch.capturing import Capture
from tests.fieldbus.conftest import Segment

SECTION, INTERFACE, PACKET = 0x0A0D0D0A, 1, 6
OUTBOUND = 2


def blocks(file: Path) -> Iterator[tuple[int, bytes]]:
    data = file.read_bytes()
    at = 0
    while at < len(data):
        kind, length = struct.unpack_from("<II", data, at)
        assert struct.unpack_from("<I", data, at + length - 4) == (length,)
        yield kind, data[at + 8 : at + length - 4]
        at += length
    assert at == len(data)


def test_every_frame_of_a_scan_is_in_the_file_with_its_time_and_direction(segment: Segment, tmp_path: Path) -> None:
    out = tmp_path / "scan.pcapng"
    began = time.time_ns()
    with out.open("xb") as file, Capture("ecat0", segment.pid, file) as capture:
        assert len(segment.master("scan")["result"]) == 3
        counted = capture.wait(0.5)
    (first, section), (second, interface), *packets = blocks(out)
    assert (first, section[:8]) == (SECTION, struct.pack("<IHH", 0x1A2B3C4D, 1, 0))
    assert (second, interface[:2]) == (INTERFACE, b"\x01\x00")
    assert b"ecat0" in interface
    assert (counted.frames, counted.lost) == (len(packets), 0)
    directions, last = [], began
    for kind, content in packets:
        _, high, low, captured, original = struct.unpack_from("<IIIII", content)
        frame, options = content[20 : 20 + captured], content[20 + (captured + 3 & ~3) :]
        assert (kind, captured) == (PACKET, original)
        assert frame[12:14] == b"\x88\xa4"
        assert last - 1_000_000_000 < (last := high << 32 | low) < time.time_ns()
        directions.append(struct.unpack_from("<HHI", options)[2])
    # Each frame goes out and comes back.
    assert directions.count(OUTBOUND) == pytest.approx(len(packets) / 2, rel=0.05)
    assert len(packets) > 500


def test_an_interface_that_does_not_exist_is_told(tmp_path: Path) -> None:
    with (
        (tmp_path / "x.pcapng").open("xb") as file,
        pytest.raises(RtcpError, match="there is no network interface rtcp-none0"),
    ):
        Capture("rtcp-none0", None, file)


def test_a_disk_that_is_full_ends_the_capture_in_a_sentence(segment: Segment) -> None:
    with Path("/dev/full").open("wb") as file, Capture("ecat0", segment.pid, file) as capture:
        segment.master("scan")
        with pytest.raises(RtcpError, match="capturing into /dev/full: No space left on device"):
            capture.wait(None)


def test_a_capture_ends_with_the_command_that_is_killed(segment: Segment, tmp_path: Path) -> None:
    program = (
        "import sys, time; from rtcp.launch.capturing import Capture\n"
        "capture = Capture('ecat0', int(sys.argv[1]), open(sys.argv[2], 'xb'))\n"
        "print(capture._child.pid, flush=True); time.sleep(600)"
    )
    out = tmp_path / "x.pcapng"
    with subprocess.Popen(
        [sys.executable, "-c", program, str(segment.pid), str(out)], stdout=subprocess.PIPE, text=True
    ) as command:
        child = os.pidfd_open(int(command.stdout.readline()))
        command.kill()
    select.select([child], [], [])
    os.close(child)
    assert [kind for kind, _ in blocks(out)] == [SECTION, INTERFACE]


def test_sigterm_to_all_its_processes_ends_a_capture_with_a_complete_file(segment: Segment, tmp_path: Path) -> None:
    program = (
        "import sys; from rtcp.launch import capturing\n"
        "capturing.place_of_bus = lambda bus, config: ('ecat0', int(sys.argv[1]))\n"
        "from rtcp.cli.__main__ import main; raise SystemExit(main(['capture', '--out', sys.argv[2]]))"
    )
    out = tmp_path / "x.pcapng"
    arguments = [sys.executable, "-c", program, str(segment.pid), str(out)]
    with subprocess.Popen(arguments, stdout=subprocess.PIPE, text=True) as command:
        assert "capturing on ecat0" in command.stdout.readline()
        assert len(segment.master("scan")["result"]) == 3
        # As a service manager does it: the command, and the child that captures for it.
        for pid in (*(child.pid for child in psutil.Process(command.pid).children()), command.pid):
            os.kill(pid, signal.SIGTERM)
        reported = command.stdout.read()
    frames = sum(kind == PACKET for kind, _ in blocks(out))
    assert (command.returncode, reported) == (0, f"{frames} frames written to {out}\n")
    assert frames > 500
