"""Questions to a bus while no platform runs: the bus is opened for one question and closed again.

A child process asks, because it has to live in the virtual segment's namespaces and because a crash of the master's C
library must not take the command with it. `virtual` starts a segment for as long as the question takes.
"""

from __future__ import annotations

import dataclasses
import json
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from rtcp.config.model import VIRTUAL

if TYPE_CHECKING:
    from rtcp.config.model import ArmConfig

SEGMENT_TIMEOUT_S = 10.0
"""A segment makes its namespace and its pair of interfaces in far less."""

QUESTION_TIMEOUT_S = 30.0
"""Every slave's EEPROM is read in a scan; a slow one takes a second."""

END_TIMEOUT_S = 3.0


class OfflineError(Exception):
    """A question that got no answer: a sentence, and its kind as in the control protocol."""

    def __init__(self, kind: str, message: str) -> None:
        super().__init__(message)
        self.kind = kind


def configuration(config: Path | None) -> ArmConfig:
    """Load the configuration as the platform would find it.

    Raises:
        ConfigError: with every mistake in it.
    """
    from rtcp.config.find import find_config
    from rtcp.config.loader import load

    return load(find_config(config))


def scan(bus: str, config: Path | None) -> list[dict[str, Any]]:
    """Return what each slave tells of itself, as `rtcp.fieldbus.bus.SlaveInfo` has it, bytes as hex.

    Args:
        bus: `virtual` or a network interface.
        config: the arm's file, which names the virtual segment's; found as usual when None.

    Raises:
        OfflineError: when the segment or the bus cannot be opened or does not answer.
        ConfigError: when the configuration of the virtual segment is wrong.
    """
    slaves = _ask(bus, config, {"do": "scan"})["slaves"]
    return list(slaves)


def sdo_read(bus: str, config: Path | None, slave: int, index: int, subindex: int) -> bytes:
    """Return the object's bytes as they came over the wire; `slave` counts from 1.

    Raises:
        OfflineError: as `scan`, or with the slave's abort code in words.
    """
    answer = _ask(bus, config, {"do": "sdo_read", "slave": slave, "index": index, "subindex": subindex})
    return bytes.fromhex(answer["hex"])


def sdo_write(bus: str, config: Path | None, slave: int, index: int, subindex: int, data: bytes) -> None:
    """Write the object; `slave` counts from 1.

    Raises:
        OfflineError: as `scan`, or with the slave's abort code in words.
    """
    request = {"do": "sdo_write", "slave": slave, "index": index, "subindex": subindex, "hex": data.hex()}
    _ask(bus, config, request)


def _ask(bus: str, config: Path | None, question: Mapping[str, Any]) -> dict[str, Any]:
    if bus != VIRTUAL:
        from rtcp.fieldbus.errors import BusError
        from rtcp.fieldbus.interface import check_name

        try:
            check_name(bus)
        except BusError as error:
            raise OfflineError("usage", str(error)) from error
        return _question({**question, "interface": bus, "namespace_pid": None})
    from rtcp.config.loader import segment_path

    with _segment(segment_path(configuration(config))) as ready:
        return _question({**question, "interface": ready["interface"], "namespace_pid": ready["pid"]})


def _question(question: Mapping[str, Any]) -> dict[str, Any]:
    """Put one question to a child process and return its answer."""
    child = subprocess.Popen(
        [sys.executable, "-m", "rtcp.launch.offline"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,  # Ctrl-C is the command's, which then ends this process in order
    )
    try:
        answered, complaint = child.communicate(json.dumps(question).encode(), QUESTION_TIMEOUT_S)
    except subprocess.TimeoutExpired as error:
        raise OfflineError(
            "timeout", f"the bus {question['interface']} gave no answer within {QUESTION_TIMEOUT_S:g} s"
        ) from error
    finally:
        _end(child)
    lines = answered.splitlines()
    try:
        answer: dict[str, Any] = json.loads(lines[-1])
    except (IndexError, ValueError) as error:
        last = complaint.decode(errors="replace").strip().splitlines()[-1:] or [f"exit code {child.returncode}"]
        raise OfflineError("internal", f"asking the bus {question['interface']} failed: {last[0]}") from error
    if "error" in answer:
        raise OfflineError(str(answer["kind"]), str(answer["error"]))
    return answer


@contextmanager
def _segment(file: Path) -> Iterator[dict[str, Any]]:
    """Run a virtual segment in namespaces of its own; give its ready line: `pid` and `interface`."""
    mine, its = os.pipe()
    command = [sys.executable, "-m", "rtcp.virtual", "--config", str(file), "--ready-fd", str(its)]
    with open(mine, "rb", buffering=0) as words:
        try:
            segment = subprocess.Popen(
                command,
                pass_fds=(its,),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                start_new_session=True,
            )
        finally:
            os.close(its)
        try:
            yield _ready(segment, words.fileno())
        finally:
            _end(segment)


def _ready(segment: subprocess.Popen[bytes], words: int) -> dict[str, Any]:
    line = b""
    deadline = time.monotonic() + SEGMENT_TIMEOUT_S
    while not line.endswith(b"\n"):
        if not select.select([words], [], [], max(0.0, deadline - time.monotonic()))[0]:
            raise OfflineError("timeout", f"the virtual segment was not ready within {SEGMENT_TIMEOUT_S:g} s")
        chunk = os.read(words, 4096)
        if not chunk:
            raise OfflineError("fault", f"the virtual segment did not start: {_last_words(segment)}")
        line += chunk
    ready: dict[str, Any] = json.loads(line)
    if "error" in ready:
        raise OfflineError("fault", str(ready["error"]))
    return ready


def _last_words(segment: subprocess.Popen[bytes]) -> str:
    """Return what a segment that has closed its end said on standard error, or how it ended."""
    try:
        _, complaint = segment.communicate(timeout=END_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        return "it said nothing"
    return complaint.decode(errors="replace").strip() or f"exit code {segment.returncode}"


def _end(process: subprocess.Popen[bytes]) -> None:
    """End a process of ours, in order and else by force."""
    if process.poll() is None:
        process.terminate()
        try:
            process.wait(END_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
    for stream in (process.stdin, process.stdout, process.stderr):
        if stream is not None:
            stream.close()


# -- the process that opens the bus: a JSON object on standard input, one on standard output ------------------------


def answer(question: dict[str, Any]) -> dict[str, Any]:
    """Open the bus, ask, close it.

    Args:
        question: `interface`, `namespace_pid` (None: our own namespaces), `do` and the arguments of that.

    Returns:
        `slaves`, `hex` or nothing, as was asked; or `error`, a sentence, and its `kind`.

    Raises:
        BusError: as the bus raises it.
    """
    from rtcp.fieldbus.soem import SoemBus  # here: the command itself does without SOEM

    bus = SoemBus(question["interface"], namespace_pid=question["namespace_pid"])
    bus.open()
    try:
        slaves = bus.scan()
        if question["do"] == "scan":
            return {"slaves": [dataclasses.asdict(slave) for slave in slaves]}
        position, index, subindex = question["slave"], question["index"], question["subindex"]
        if not 1 <= position <= len(slaves):
            return {
                "error": f"no slave at position {position}: the bus {question['interface']} has {len(slaves)}",
                "kind": "invalid",
            }
        if question["do"] == "sdo_read":
            return {"hex": bus.sdo_read(position, index, subindex).hex()}
        bus.sdo_write(position, index, subindex, bytes.fromhex(question["hex"]))
        return {}
    finally:
        bus.close()


def _plain(value: object) -> object:
    """Turn what JSON does not know into what it does: bytes into hex, sets and enums into lists and names."""
    if isinstance(value, bytes):
        return value.hex()
    if isinstance(value, set | frozenset):
        return sorted(value)
    return str(value)


def main() -> int:
    """Answer the question on standard input; errors of the bus are answers too."""
    # An interrupted command ends this process: the bus is closed on the way out.
    signal.signal(signal.SIGTERM, _leave)
    from rtcp.fieldbus.errors import BusError, SdoAborted

    question = json.loads(sys.stdin.buffer.read())
    try:
        found = answer(question)
    except SdoAborted as error:
        found = {"error": str(error), "kind": "refused"}
    except BusError as error:
        found = {"error": str(error), "kind": "fault"}
    print(json.dumps(found, default=_plain), flush=True)
    return 0


def _leave(number: int, frame: FrameType | None) -> None:
    raise SystemExit(128 + number)


if __name__ == "__main__":
    raise SystemExit(main())
