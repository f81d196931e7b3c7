"""Behaviours of described slaves: abilities of their hooks, and limits to the damage of a failing hook."""

from __future__ import annotations

import signal
import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rtcp.config.model import ConfigError
from rtcp.config.segment import load_segment
from rtcp.virtual import behaviour as watched
from rtcp.virtual.behaviour import EXIT_HANGING, FileBusy, FileRefused
from rtcp.virtual.coe import read, write
from rtcp.virtual.mailbox import Mailbox
from rtcp.virtual.objects import SdoAbort
from rtcp.virtual.protocol import ERROR_FLAG, MailboxType
from rtcp.virtual.segment import make_segment
from tests.forked import answer_of
from tests.virtual import behaviours
from tests.virtual.conftest import ROOT, Master, abort_of, described
from tests.virtual.line import INIT, MS, Line, TinyDevice
from tests.virtual.test_described import DRIVE, OP, OUTPUTS, TWO, device

PRE_OP, BOOT = 2, 3


@pytest.mark.parametrize(
    ("behaviour", "part", "message"),
    [
        ("Raises", "on_outputs", "RuntimeError: out of order"),
        ("Hangs", "on_outputs", "it has not returned for "),
        ("Breaks", "the slave", "None"),
    ],
)
def test_a_hook_that_raises_or_hangs_or_breaks_its_slave_takes_its_own_slave_out_of_op_with_one_sentence(
    master: Master, behaviour: str, part: str, message: str, capfd: pytest.CaptureFixture[str]
) -> None:
    failing = described(TWO, f"behaviour: 'tests.virtual.behaviours:{behaviour}'")
    result = master(described(OUTPUTS), failing, described(DRIVE))
    assert result["safe_op"] == 4
    assert result["codes"] == [[OP, 0], [4 | 0x10, 0x0001], [OP, 0]]
    sentences = [line for line in capfd.readouterr().err.splitlines() if " failed at " in line]
    assert len(sentences) == 1
    assert f":3: slave 2: {part} failed at {behaviours.__file__}:" in sentences[0]
    assert message in sentences[0]
    # All answer; the slave in SAFE-OP does not take its outputs.
    assert 2 + 1 + 3 in result["counters"][-10:]


def config_of(folder: Path, behaviour: str) -> Path:
    """Return the file of a segment of one drive."""
    config = folder / "segment.yaml"
    entry = described(DRIVE, f"behaviour: '{behaviour}'")
    config.write_text(f"slaves:\n- {{{entry}}}\n")
    return config


@pytest.mark.parametrize(
    ("behaviour", "code", "message"),
    [
        ("Swallows", EXIT_HANGING, "a behaviour cannot be ended at {}:"),
        ("HangsInC", -signal.SIGPROF, 'File "{}", line '),
    ],
)
def test_a_hook_that_no_exception_ends_ends_the_process_which_says_where(
    tmp_path: Path, behaviour: str, code: int, message: str
) -> None:
    config = config_of(tmp_path, f"tests.virtual.behaviours:{behaviour}")
    command = [sys.executable, "-m", "rtcp.virtual", "--config", str(config)]
    ended = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)
    assert ended.returncode == code
    assert message.format(behaviours.__file__) in ended.stderr


CLASS = "from rtcp.virtual.behaviour import Behaviour\nclass Any(Behaviour):\n"
UNUSABLE = {
    "a module that ends the process": ("import sys\nsys.exit(7)", "cannot be loaded: SystemExit: 7"),
    "a module that hangs": ("while True: pass", "HookHangs: it has not returned for "),
    "one that ends the process": (CLASS + " def __init__(self, device): exit(3)", "{}:3: SystemExit: 3"),
    "one that hangs": (CLASS + " def __init__(self, device):\n  while True: pass", "{}:4: it has not returned for "),
    "options that are a list": (CLASS + " options = [1]", ":Any: found a list, allowed is Option(default, low, "),
    "an option that is none": (CLASS + " options = {'gain': 5}", ":Any, gain: found 5, allowed is Option("),
    "a generator": (CLASS + " def on_outputs(self, dt): yield", "{}:3: on_outputs would never run"),
    "a first hook that hangs": (
        CLASS + " def on_start(self):\n  while True: pass",
        "on_start failed at {}:4: it has not returned",
    ),
}


@pytest.mark.parametrize("name", UNUSABLE)
def test_a_behaviour_that_cannot_be_made_is_a_sentence_of_the_segments_file(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(watched, "MAKING", watched.HOOK)
    monkeypatch.setattr(sys, "path", [*sys.path])
    text, expected = UNUSABLE[name]
    module = tmp_path / f"{tmp_path.name}.py"  # a name that no test has imported
    module.write_text(text)
    config = config_of(tmp_path, f"{module.stem}:Any")
    with watched.WATCH.started():
        try:
            make_segment(load_segment(config), 0)
        except ConfigError as error:
            message = str(error)
        else:
            message = capfd.readouterr().err
    assert expected.format(module) in message
    assert (f"{config}:2: slaves[0].behaviour: " in message) == (name != "a first hook that hangs")
    assert (signal.getitimer(signal.ITIMER_REAL)[1], *signal.getitimer(signal.ITIMER_PROF)) == (0.0, 0.0, 0.0)


def test_hooks_answer_and_refuse_sdos_and_send_emergencies() -> None:
    drive = device(DRIVE, behaviours.Talkative)
    assert read(drive.objects, 0x6064, 0, False, PRE_OP) == struct.pack("<i", 4711)
    assert abort_of(write, drive.objects, 0x607A, 0, False, PRE_OP, struct.pack("<i", 13)) == 0x06090030
    assert (drive.objects[0x607A, 0].value, len(drive.emergencies)) == (0, 0)
    write(drive.objects, 0x607A, 0, False, PRE_OP, struct.pack("<i", 14))
    assert drive.objects[0x607A, 0].value == 14
    assert (drive.emergencies[0].error_code, drive.emergencies[0].data) == (0x5000, b"late\0")


def test_a_hook_of_a_service_that_fails_aborts_it_and_is_reported_once() -> None:
    drive = device(DRIVE, behaviours.FailsEverywhere)
    reported: list[str] = []
    drive.runner.report = reported.append
    for _ in range(3):
        assert abort_of(read, drive.objects, 0x6064, 0, False, PRE_OP) == 0x08000000
        assert abort_of(write, drive.objects, 0x607A, 0, False, PRE_OP, bytes(4)) == 0x08000000
    assert [sentence.split(": ")[1].split(" ")[0] for sentence in reported] == ["on_sdo_read", "on_sdo_write"]
    assert "0x6041:0 Statusword takes 0 to 65535, not 1048576" in reported[1]


def raising(error: Callable[..., Exception], *arguments: object) -> Callable[[], None]:
    def act() -> None:
        raise error(*arguments)

    return act


class Mute(Exception):
    """Has no text."""

    def __str__(self) -> str:
        raise RuntimeError


RUBBISH: list[Callable[[], object]] = [
    raising(FileRefused, -1), raising(FileRefused, 1 << 40), raising(FileRefused, 0x8001, 5),
    raising(FileBusy, "half", 2), raising(FileBusy, 0.5, 1.0), raising(FileBusy, 1, 1 << 16),
    raising(SdoAbort, -1), raising(SdoAbort, 1 << 40), raising(SdoAbort, "no"), raising(Mute),
    lambda: "a text", lambda: 10**13, lambda: [1, 2], lambda: float("inf"), lambda: float("nan"),
]  # fmt: skip


@pytest.mark.parametrize("act", RUBBISH)
def test_rubbish_of_a_hook_is_answered_as_its_failure_and_reported_with_file_and_line(
    act: Callable[[], object],
) -> None:
    client = FoeClient(
        type("Any", (behaviours.Rubbish,), {"act": staticmethod(act), "__module__": behaviours.__name__})
    )
    reported: list[str] = []
    client.device.runner.report = reported.append
    assert client.read("any") == 0x800B
    assert abort_of(read, client.device.objects, 0x6064, 0, False, PRE_OP) == 0x08000000
    assert [f" failed at {behaviours.__file__}:" in sentence for sentence in reported] == [True, True]


@pytest.mark.parametrize("taken", ["roles", "step"])
def test_a_slave_whose_own_code_fails_outside_of_hooks_says_so_and_the_others_go_on(taken: str) -> None:
    broken = device(DRIVE, behaviours.Talkative)
    line = Line([broken, TinyDevice()])
    reported: list[str] = []
    broken.runner.report = reported.append
    setattr(broken, taken, None)
    line.address()
    line.request(0, PRE_OP)
    line.pass_time(5 * MS)
    assert [": the slave failed at " in sentence for sentence in reported] == [True]
    assert line.request(1, BOOT) == (INIT | ERROR_FLAG, 0x0013)


# -- files over EtherCAT --------------------------------------------------------------------------------------------

REQUEST, WRITE, DATA, ACKNOWLEDGE, ERROR, BUSY = 1, 2, 3, 4, 5, 6


class FoeClient:
    """Talks FoE with a device through its mailbox, as frames would."""

    def __init__(self, behaviour: type[Any], size: int = 64) -> None:
        self.device = device(DRIVE, behaviour)
        self.device.open_mailbox(size, size)
        self.most = size - 12
        self._mailbox = Mailbox(
            self.device.objects, self.device.emergencies, size, size, protocols=self.device.mailbox_protocols, coe=None
        )
        self._counter = 0

    def ask(self, operation: int, number: int, content: bytes = b"") -> tuple[int, int, bytes] | None:
        self._counter = self._counter % 7 + 1
        message = struct.pack("<BxI", operation, number) + content
        head = struct.pack("<HHBB", len(message), 0, 0, self._counter << 4 | MailboxType.FOE)
        self._mailbox.receive((head + message).ljust(self.most + 12, b"\0"), BOOT)
        answer = self._mailbox.next_message()
        if answer is None:
            return None
        length = struct.unpack_from("<H", answer)[0]
        operation, number = struct.unpack_from("<BxI", answer, 6)
        return operation, number, answer[12 : 6 + length]

    def write(self, name: str, data: bytes) -> tuple[int, int]:
        """Write a file, of which the last packet is shorter than the others; return the last answer."""
        answer = self.ask(WRITE, 0, name.encode())
        parts = [data[at : at + self.most] for at in range(0, len(data) + 1, self.most)]
        for packet, part in enumerate(parts, 1):
            if answer is not None and answer[0] == ACKNOWLEDGE:
                answer = self.ask(DATA, packet, part)
            while answer is not None and answer[0] == BUSY:
                answer = self.ask(DATA, packet, part)
        return answer[0], answer[1]

    def read(self, name: str) -> bytes | int:
        """Read a file; return it, or the error code."""
        answer = self.ask(REQUEST, 0, name.encode())
        data = b""
        while answer is not None and answer[0] == DATA:
            data += answer[2]
            answer = self.ask(ACKNOWLEDGE, answer[1])
        return data if answer is None else answer[1]


@pytest.mark.parametrize("length", [0, 1, 51, 52, 53, 104, 1000])
def test_a_file_of_any_length_is_written_and_read_back(length: int) -> None:
    client = FoeClient(behaviours.Talkative)
    data = bytes(n % 251 for n in range(length))
    assert client.write("firmware", data)[0] == ACKNOWLEDGE
    assert client.read("firmware") == data


def test_a_behaviour_refuses_a_file_and_is_busy_and_fails() -> None:
    client = FoeClient(behaviours.Talkative)
    assert client.write("secret", b"1234") == (ERROR, 0x800A)
    assert client.read("nothing") == 0x8001
    assert client.write("slow", b"late but whole") == (ACKNOWLEDGE, 1)
    assert client.read("slow") == b"late but whole"
    failing = FoeClient(behaviours.FailsEverywhere)
    reported: list[str] = []
    failing.device.runner.report = reported.append
    assert failing.write("any", b"1") == (ERROR, 0x800B)
    assert "on_file failed at" in reported[0]


def test_packets_out_of_order_and_messages_that_fit_nothing_are_errors() -> None:
    client = FoeClient(behaviours.Talkative)
    client.ask(WRITE, 0, b"a")
    assert client.ask(DATA, 2, b"x")[:2] == (ERROR, 0x8005)
    assert client.ask(DATA, 1, b"x")[:2] == (ERROR, 0x8004)
    assert client.ask(99, 0)[:2] == (ERROR, 0x8004)
    assert client.ask(ACKNOWLEDGE, 5) is None
    client.device.runner.behaviour.files["b"] = bytes(200)
    client.ask(REQUEST, 0, b"b")
    assert client.ask(ACKNOWLEDGE, 7)[:2] == (ERROR, 0x8005)


def test_a_real_master_writes_firmware_in_boot_and_reads_it(tmp_path: Path) -> None:
    from tests.virtual.conftest import segment

    config = tmp_path / "segment.yaml"
    config.write_text(f"slaves:\n- {{{described(DRIVE)}}}\n")
    with segment(config) as pid:
        result = answer_of("tests.virtual.boot_child", str(pid), "ecat0")
    assert result["boot"] == BOOT
    assert result["read"] == result["written"]
    assert result["no_coe_in_boot"]
    assert result["after"] == PRE_OP
