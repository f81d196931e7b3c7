"""Questions to a bus while no platform runs: a child process opens the bus, asks one question and closes it.

The child lives in the virtual segment's namespaces, and a crash of the master's C library ends it alone. For the bus
`virtual` a segment runs for as long as the question takes. `python -m rtcp.launch.offline` is the child: a JSON object
on standard input, one on standard output.
"""

from __future__ import annotations

import dataclasses
import json
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from rtcp.ipc.errors import RtcpError
from rtcp.launch.platform import defer_signals, read_lines, spawn

if TYPE_CHECKING:
    from rtcp.config.model import ArmConfig

SEGMENT_TIMEOUT_S = 10.0
"""A segment creates its namespace and its pair of interfaces in far less."""
QUESTION_TIMEOUT_S = 30.0
"""A scan reads every slave's EEPROM; a slow one takes a second."""
END_TIMEOUT_S = 3.0


def configuration(config: Path | None) -> ArmConfig:
    """Load the configuration as the platform would find it.

    Raises:
        ConfigError: with every mistake in it.
    """
    from rtcp.config.find import find_config
    from rtcp.config.loader import load

    return load(find_config(config))


class OfflineBus:
    """A bus that is opened for each question and closed again; methods as those of `rtcp.api.Robot`.

    Each raises RtcpError where the segment or the bus cannot be opened or does not answer, with a slave's abort code in
    words, and ConfigError where the configuration of the virtual segment has mistakes.

    Args:
        bus: `virtual` or a network interface.
        config: the arm's file, which names the virtual segment's; None: found as usual.
    """

    def __init__(self, bus: str, config: Path | None) -> None:
        self._bus = bus
        self._config = config

    def scan(self) -> list[dict[str, Any]]:
        """Return what each slave reports of itself, as `rtcp.fieldbus.bus.SlaveInfo` has it, bytes as hex."""
        return list(self._ask("scan")["slaves"])

    def sdo_read(self, slave: int, index: int, subindex: int) -> bytes:
        """Return the object's bytes as they came over the wire; `slave` counts from 1."""
        return bytes.fromhex(self._ask("sdo_read", slave=slave, index=index, subindex=subindex)["hex"])

    def sdo_write(self, slave: int, index: int, subindex: int, data: bytes) -> None:
        """Write the object; `slave` counts from 1."""
        self._ask("sdo_write", slave=slave, index=index, subindex=subindex, hex=data.hex())

    def _ask(self, do: str, **arguments: int | str) -> dict[str, Any]:
        return _ask(self._bus, self._config, {"do": do, **arguments})


def _ask(bus: str, config: Path | None, question: Mapping[str, Any]) -> dict[str, Any]:
    from rtcp.config.loader import segment_path
    from rtcp.config.model import VIRTUAL
    from rtcp.fieldbus.errors import BusError
    from rtcp.fieldbus.interface import check_name

    if bus == VIRTUAL:
        with _segment(segment_path(configuration(config))) as ready:
            return _question({**question, "interface": ready["interface"], "namespace_pid": ready["pid"]})
    try:
        check_name(bus)
    except BusError as error:
        raise RtcpError("invalid", str(error)) from error
    return _question({**question, "interface": bus, "namespace_pid": None})


def _question(question: Mapping[str, Any]) -> dict[str, Any]:
    """Ask one question in a child process and return its answer."""
    bus = question["interface"]
    with ExitStack() as stack:
        # A signal between start and registration would leave a process that nobody ends.
        with defer_signals():
            child = subprocess.Popen(
                [sys.executable, "-m", "rtcp.launch.offline"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                start_new_session=True,  # Ctrl-C reaches the command, which then ends this process in order
            )
            stack.callback(_end, child)
        try:
            answered, complaint = child.communicate(json.dumps(question).encode(), QUESTION_TIMEOUT_S)
        except subprocess.TimeoutExpired as error:
            raise RtcpError("timeout", f"the bus {bus} gave no answer within {QUESTION_TIMEOUT_S:g} s") from error
    try:
        answer: dict[str, Any] = json.loads(answered.splitlines()[-1])
    except (IndexError, ValueError) as error:
        last = complaint.decode(errors="replace").strip().splitlines()[-1:] or [f"exit code {child.returncode}"]
        raise RtcpError("internal", f"asking the bus {bus} failed: {last[0]}") from error
    if "error" in answer:
        raise RtcpError(answer["kind"], str(answer["error"]))
    return answer


@contextmanager
def _segment(file: Path) -> Iterator[dict[str, Any]]:
    """Run a virtual segment in namespaces of its own; give its ready line: `pid` and `interface`."""
    arguments = ("--config", str(file))
    with ExitStack() as stack:
        with defer_signals():
            segment, reading = spawn("rtcp.virtual", *arguments, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
            stack.callback(_end, segment)
        ready = next(read_lines(reading, SEGMENT_TIMEOUT_S), None)
        if ready is None:
            raise _not_ready(segment)
        if "error" in ready:
            raise RtcpError("fault", str(ready["error"]))
        yield ready


def _not_ready(segment: subprocess.Popen[bytes]) -> RtcpError:
    try:
        _, complaint = segment.communicate(timeout=END_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        return RtcpError("timeout", f"the virtual segment was not ready within {SEGMENT_TIMEOUT_S:g} s")
    why = complaint.decode(errors="replace").strip() or f"exit code {segment.returncode}"
    return RtcpError("fault", f"the virtual segment did not start: {why}")


def _end(process: subprocess.Popen[bytes]) -> None:
    """End a child by SIGTERM, after `END_TIMEOUT_S` by SIGKILL; close its pipes."""
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


# -- the child --------------------------------------------------------------------------------------------------


def answer(question: dict[str, Any]) -> dict[str, Any]:
    """Open the bus, ask, close it.

    Args:
        question: `interface`, `namespace_pid` (None: the caller's namespaces), `do` and its arguments.

    Returns:
        `slaves`, `hex` or nothing, as asked; or `error`, a sentence, and its `kind`.

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
            missing = f"no slave at position {position}: the bus {question['interface']} has {len(slaves)}"
            return {"error": missing, "kind": "invalid"}
        if question["do"] == "sdo_read":
            return {"hex": bus.sdo_read(position, index, subindex).hex()}
        bus.sdo_write(position, index, subindex, bytes.fromhex(question["hex"]))
        return {}
    finally:
        bus.close()


def _plain(value: object) -> object:
    """Return the JSON form of what `json` does not know: bytes as hex, sets as lists, enums as text."""
    if isinstance(value, bytes):
        return value.hex()
    if isinstance(value, set | frozenset):
        return sorted(value)
    return str(value)


def main() -> int:
    """Answer the question on standard input; errors of the bus are answers too."""
    from rtcp.fieldbus.errors import BusError, SdoAborted

    # An interrupted command ends this process: the bus is closed on the way out.
    signal.signal(signal.SIGTERM, _leave)
    question = json.loads(sys.stdin.buffer.read())
    try:
        found = answer(question)
    except BusError as error:
        found = {"error": str(error), "kind": "refused" if isinstance(error, SdoAborted) else "fault"}
    print(json.dumps(found, default=_plain), flush=True)
    return 0


def _leave(number: int, frame: FrameType | None) -> None:
    raise SystemExit(128 + number)


if __name__ == "__main__":
    raise SystemExit(main())
