"""The control socket of a real segment: what it does, what it refuses, and that no client stops the frames."""

from __future__ import annotations

import json
import signal
import socket
import stat
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from rtcp.virtual.protocol import DatagramCommand
from rtcp.virtual.request_socket import LONGEST_REQUEST, MOST_CLIENTS, RequestRefused, ServerAway
from tests.virtual.faults.conftest import BeginSegment, Exchange, Running
from tests.virtual.frames import Datagram, build, parse

BROADCASTS = [build(Datagram(DatagramCommand.BRD, number, 0, 0, bytes(2))) for number in range(20)]


def connect(path: Path) -> socket.socket:
    client = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    client.settimeout(10)
    client.connect(str(path))
    return client


@pytest.fixture(autouse=True)
def whole(segment: Running) -> Iterator[None]:
    """Clear all faults after each test."""
    yield
    with segment.client() as client:
        client.clear()


def indices(received: list[tuple[int, bytes]]) -> list[int]:
    """Datagram indices of the received frames, in order."""
    return [next(parse(frame)).index for _, frame in received]


# -- faults on real frames ------------------------------------------------------------------------------------------


def test_without_a_fault_every_frame_comes_back_from_all_slaves(exchange: Exchange) -> None:
    answers = [next(parse(frame)) for _, frame in exchange(BROADCASTS).received]
    assert [answer.index for answer in answers] == list(range(20))
    assert {answer.counter for answer in answers} == {3}


def test_a_burst_of_lost_frames_is_lost_and_the_next_one_comes(segment: Running, exchange: Exchange) -> None:
    with segment.client() as client:
        client.fault({"fault": "loss", "burst": 5})
        assert indices(exchange(BROADCASTS, answers=15).received) == list(range(5, 20))
        assert client.faults() == []


@pytest.mark.parametrize(("seed", "lost", "written"), [(0, "lost_before", 0), (4, "lost_behind", 1)])
def test_slaves_see_what_is_lost_behind_them_and_not_what_is_lost_before(
    segment: Running, exchange: Exchange, seed: int, lost: str, written: int
) -> None:
    address = (0x2000 + seed).to_bytes(2, "little")
    with segment.client() as client:
        client.fault({"fault": "loss", "rate": 1.0, "seed": seed})
        assert exchange([build(Datagram(DatagramCommand.APWR, 0, 0xFFFF, 0x0010, address))], answers=0).received == []
        while not (counts := client.faults()[0]["counts"])[lost]:
            time.sleep(0.01)
        assert counts[lost] == 1
        client.clear()
    (_, answer), *_ = exchange([build(Datagram(DatagramCommand.FPRD, 0, 0x2000 + seed, 0, bytes(1)))]).received
    assert next(parse(answer)).counter == written


def test_answers_that_are_late_come_as_late_as_asked_for(segment: Running, exchange: Exchange) -> None:
    with segment.client() as client:
        client.fault({"fault": "delay", "ms": 300, "rate": 1.0})
        sent, received = exchange(BROADCASTS)
    assert indices(received) == list(range(20))
    late = [at - begun for begun, (at, _) in zip(sent, received, strict=True)]
    assert min(late) >= 300_000_000
    assert received[0][0] > sent[1], "frames went on being sent and answered meanwhile"


def test_noise_comes_without_a_frame_of_the_masters_and_ends_with_its_time(
    segment: Running, exchange: Exchange
) -> None:
    with segment.client() as client:
        client.fault({"fault": "noise", "rate_hz": 500, "protocol": "arp", "lasts": 0.2})
        received = exchange([], answers=1, patience_s=0.4).received
        while client.faults():
            time.sleep(0.01)
    assert 0 < len(received) <= 100
    assert {frame[12:14] for _, frame in received} == {b"\x08\x06"}
    assert exchange([], patience_s=0.1).received == []


def test_a_cable_broken_by_command_is_seen_by_the_master_until_it_is_mended(
    segment: Running, exchange: Exchange
) -> None:
    def counter() -> int:
        return next(parse(exchange(BROADCASTS[:1]).received[0][1])).counter

    with segment.client() as client:
        number = client.fault({"fault": "cable", "after": 1})
        assert counter() == 1
        assert [slave["reachable"] for slave in client.truth()["slaves"]] == [True, False, False]
        assert client.clear(number) == [number]
        assert counter() == 3


# -- what is reported -----------------------------------------------------------------------------------------------


def test_the_truth_is_reported_slave_by_slave(segment: Running) -> None:
    with segment.client() as client:
        while client.truth()["slaves"][1]["state"] == "not ready to switch on":  # the drive has just got its supply
            time.sleep(0.01)
        before = time.monotonic_ns()
        truth = client.truth()
    assert before < truth["time_ns"] < time.monotonic_ns()
    assert [slave["position"] for slave in truth["slaves"]] == [1, 2, 3]
    assert [slave["model"] for slave in truth["slaves"]] == ["diewu-io", "cubemars-orh70", "cubemars-orh40"]
    assert truth["slaves"][0] == {"position": 1, "model": "diewu-io", "al": "INIT", "reachable": True}
    drive = truth["slaves"][1]
    assert (drive["state"], drive["torque_on"], drive["al"]) == ("switch on disabled", False, "INIT")
    assert (drive["velocity_rad_s"], drive["moved_ns"], drive["peak_rad_s"]) == (0.0, 0, 0.0)


@pytest.mark.parametrize(
    ("request_", "sentence"),
    [
        (b"", None),
        (b"nonsense", "a request is one JSON object in UTF-8, and this is none"),
        (b"\xff\xfe", "a request is one JSON object in UTF-8, and this is none"),
        (b"[" * 1000, "a request is one JSON object in UTF-8, and this is none"),
        (b"9" * 1000, f"found {'9' * 40}"),
        (b"x" * (LONGEST_REQUEST + 1), f"a request has at most {LONGEST_REQUEST} bytes"),
        (b"[1, 2]", "found a list, allowed is an object with the key do"),
        ({}, "do: found nothing, allowed is one of fault, clear, faults, truth, clear_peaks, edges"),
        ({"do": "dance"}, 'do: found the text "dance", allowed is one of fault'),
        ({"do": ["fault"]}, "do: found a list, allowed is one of fault"),
        ({"do": "truth", "slave": 1}, "slave: this key does not exist; allowed are do"),
        ({"do": "clear", "id": True}, "id: found true, allowed is the number of a fault, or none for all"),
        ({"do": "clear", "id": 99999}, "there was no fault 99999; active now: none"),
        ({"do": "fault"}, "found nothing, allowed is a mapping with the key `fault`"),
        ({"do": "fault", "fault": dict.fromkeys("abcdefghijk", 1)}, "a fault has at most 10 keys, found 11"),
        ({"do": "fault", "fault": {"fault": "cabel"}}, "fault: this fault does not exist; did you mean cable?"),
        ({"do": "fault", "fault": {"fault": "cable"}}, "the key after is missing"),
        ({"do": "fault", "fault": {"fault": "cable", "after": 3}}, "there is no cable behind slave 3"),
        ({"do": "fault", "fault": {"fault": "cable", "after": -1}}, "after: found -1, allowed is"),
        ({"do": "fault", "fault": {"fault": "drive", "slave": 1, "error": "encoder"}}, "is no drive"),
        ({"do": "fault", "fault": {"fault": "loss", "rate": float("nan")}}, "rate: "),
        ({"do": "fault", "fault": {"fault": "loss", "rate": 0.1, "lasts": float("inf")}}, "lasts: found inf"),
        ({"do": "fault", "fault": {"fault": "loss", "rate": 0.1, "at": 3}}, "at: a fault that is asked for begins"),
        ({"do": "fault", "fault": {"fault": "\ud800", "after": 1}}, "fault: this fault does not exist"),
        ({"do": "fault", "fault": {"fault": "noise", "protocol": "\ud800"}}, "allowed is"),
    ],
)  # fmt: skip
def test_a_malformed_request_is_answered_with_a_sentence(
    segment: Running, request_: bytes | dict[str, Any], sentence: str | None
) -> None:
    with connect(segment.control) as client:
        client.send(request_ if isinstance(request_, bytes) else json.dumps(request_).encode())
        if sentence is None:
            assert client.recv(100) == b"", "an empty packet is the end of a connection"
            return
        answer = json.loads(client.recv(1 << 20))
        assert answer["ok"] is False
        assert sentence in answer["error"]
        client.send(b'{"do": "faults"}')
        assert json.loads(client.recv(1 << 20)) == {"ok": True, "result": []}


def test_a_refusal_reaches_the_caller_as_its_sentence(segment: Running) -> None:
    with segment.client() as client, pytest.raises(RequestRefused, match="there is no cable behind slave 3"):
        client.fault({"fault": "cable", "after": 3})


# -- clients that misbehave -----------------------------------------------------------------------------------------


FLOOD = """
import socket, sys
clients = []
for _ in range(3):
    clients.append(socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET))
    clients[-1].connect(sys.argv[1])
    clients[-1].setblocking(False)
print("asking", flush=True)
while True:
    for client in clients:
        for do in (lambda: client.send(b'{"do": "truth"}'), lambda: client.recv(1 << 16)):
            try:
                do()
            except BlockingIOError:
                pass
"""


def test_clients_that_ask_without_end_stop_no_frame(segment: Running, exchange: Exchange) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", FLOOD, str(segment.control)], stdout=subprocess.PIPE, text=True
    ) as flood:
        try:
            assert flood.stdout.readline() == "asking\n"
            assert indices(exchange(BROADCASTS).received) == list(range(20))
            with segment.client() as client:
                assert client.faults() == [], "others are answered meanwhile"
            assert flood.poll() is None
        finally:
            flood.kill()


def ask_without_listening(client: socket.socket) -> None:
    while True:
        client.send(b'{"do": "truth"}')


def test_a_client_that_takes_no_answers_is_let_go(segment: Running) -> None:
    with connect(segment.control) as client, pytest.raises(ConnectionError):
        ask_without_listening(client)


def test_clients_that_hang_give_way_to_the_next_one_the_most_silent_first(segment: Running) -> None:
    clients = [connect(segment.control) for _ in range(MOST_CLIENTS)]
    try:
        for client in [*clients, clients[0]]:
            client.send(b'{"do": "faults"}')
            assert json.loads(client.recv(1 << 16))["ok"]
        with segment.client() as another:
            assert another.faults() == []
        assert clients[1].recv(1) == b""
        clients[0].send(b'{"do": "faults"}')
        assert json.loads(clients[0].recv(1 << 16))["ok"]
    finally:
        for client in clients:
            client.close()


# -- the socket itself ----------------------------------------------------------------------------------------------


def test_the_socket_is_its_owners_alone(segment: Running) -> None:
    mode = segment.control.stat().st_mode
    assert stat.S_ISSOCK(mode)
    assert stat.S_IMODE(mode) == 0o600


def test_a_socket_in_use_is_refused_in_a_sentence_and_left_alone(begin_segment: BeginSegment, segment: Running) -> None:
    second = begin_segment("--control", str(segment.control))
    _, stderr = second.communicate()
    assert second.returncode == 2
    assert stderr == (
        f"the control socket {segment.control} is in use by a process that runs: choose another path\n"
    )  # fmt: skip
    with segment.client() as client:
        assert client.faults() == []


def test_a_file_that_is_no_socket_is_refused_in_a_sentence_and_left_alone(
    begin_segment: BeginSegment, tmp_path: Path
) -> None:
    path = tmp_path / "precious"
    path.write_text("data")
    refused = begin_segment("--control", str(path))
    assert "there is a file that is no socket" in refused.communicate()[1]
    assert (refused.returncode, path.read_text()) == (2, "data")


def test_a_killed_segments_socket_is_replaced_and_a_stopped_ones_removed(
    begin_segment: BeginSegment, tmp_path: Path
) -> None:
    path = tmp_path / "segment.sock"
    for end in (signal.SIGKILL, signal.SIGTERM):
        running = begin_segment("--control", str(path))
        assert running.stdout.readline()
        with Running(running.pid, path).client() as client:
            assert client.faults() == []
            running.send_signal(end)
            running.wait()
            with pytest.raises(ServerAway, match="has gone"):
                client.faults()
        assert path.exists() == (end == signal.SIGKILL)


def test_where_there_is_no_segment_the_client_says_where_it_looked(tmp_path: Path) -> None:
    path = tmp_path / "segment.sock"
    with pytest.raises(ServerAway, match=f"no segment answers at {path}"):
        Running(0, path).client()


# -- scripts --------------------------------------------------------------------------------------------------------


def test_a_script_runs_by_itself_from_the_segments_start(begin_segment: BeginSegment, tmp_path: Path) -> None:
    script, path = tmp_path / "faults.yaml", tmp_path / "segment.sock"
    script.write_text(
        "faults:\n"
        "  - {at: 0.2, fault: cable, after: 1, lasts: 900}\n"
        "  - {at: 0.0, fault: cable, after: 2}\n"
        "  - {at: 3600, fault: power, slave: 1}\n"
    )
    running = begin_segment("--control", str(path), "--faults", str(script))
    assert running.stdout.readline()
    with Running(running.pid, path).client() as client:
        while len(active := client.faults()) < 2:
            time.sleep(0.01)
    assert [each["fault"].get("after") for each in active] == [2, 1]
    assert [each["left_s"] is None for each in active] == [True, False]


def test_a_script_that_is_wrong_is_refused_with_its_lines_before_the_segment_starts(
    begin_segment: BeginSegment, tmp_path: Path
) -> None:
    script = tmp_path / "faults.yaml"
    script.write_text("faults:\n  - {at: 1, fault: cabel, after: 2}\n  - {fault: power, slave: 9}\n")
    refused = begin_segment("--faults", str(script))
    stderr = refused.communicate()[1].splitlines()
    assert refused.returncode == 2
    assert stderr[0].startswith(f"{script}:2: faults[0].fault: this fault does not exist; did you mean cable?")
    assert stderr[1] == f"{script}:3: faults[1].slave: found 9, the segment has 3 slaves: allowed is at most 3"
