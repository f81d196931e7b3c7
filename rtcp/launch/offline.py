"""Requests to a bus while no platform runs: a child process opens the bus, carries out one request and closes it.

The child lives in the virtual segment's namespaces, and a crash of the master's C library ends it alone. For the bus
`virtual` a segment runs during the request. `python -m rtcp.launch.offline` is the child: a JSON object
on standard input, one on standard output.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from enum import Enum
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from rtcp.ipc.errors import RtcpError
from rtcp.launch.platform import defer_signals, read_lines, spawn

Progress = Callable[[float], None]
"""Receives how far a transfer is."""

if TYPE_CHECKING:
    from rtcp.config.model import ArmConfig
    from rtcp.fieldbus.soem import SoemBus

SEGMENT_TIMEOUT_S = 10.0
"""Longest wait for a segment, s; it creates its namespace and its interfaces in far less."""
QUESTION_TIMEOUT_S = 30.0
"""Longest wait for an answer, s: a scan reads every slave's EEPROM, which takes up to 1 s each."""
STATE_TIMEOUT_S = 5.0
END_TIMEOUT_S = 3.0


def configuration(config: Path | None) -> ArmConfig:
    """Load the configuration as the platform would find it.

    Raises:
        ConfigError: with every mistake in it.
    """
    from rtcp.config.find import find_config
    from rtcp.config.loader import load

    return load(find_config(config))


def ignore(done: float) -> None:
    """Show no progress."""


class OfflineBus:
    """A bus that is opened for each question and closed again; methods as those of `rtcp.api.Robot`.

    `slave` is a position from 1, or a name of the arm's file: that slave is looked up by its station alias, or by its
    place in the file, and must be the device that the file says.

    Each raises RtcpError where the segment or the bus cannot be opened or does not answer, with a slave's abort code in
    words, and ConfigError where the configuration of the virtual segment has mistakes.

    Args:
        bus: `virtual` or a network interface.
        config: the arm's file, which names the virtual segment's; None: found as usual.
    """

    def __init__(self, bus: str, config: Path | None) -> None:
        self._bus = bus
        self._config = config
        self.position = 0
        """Position of the slave that answered last."""
        self.label = ""
        """That slave as messages name it: position, device, serial number."""

    def scan(self) -> list[dict[str, Any]]:
        """Return the description of each slave, as `rtcp.fieldbus.bus.SlaveInfo` has it, bytes as hex."""
        return list(self._ask("scan")["slaves"])

    def sdo_read(self, slave: int | str, index: int, subindex: int) -> bytes:
        """Return the object's bytes, little endian as on the wire."""
        return bytes.fromhex(self._ask("sdo_read", slave=slave, index=index, subindex=subindex)["hex"])

    def sdo_write(self, slave: int | str, index: int, subindex: int, data: bytes) -> None:
        """Write the object."""
        self._ask("sdo_write", slave=slave, index=index, subindex=subindex, hex=data.hex())

    def object_lengths(self, slave: int, objects: Sequence[tuple[int, int]]) -> list[int | None]:
        """Return the lengths of objects, by index and subindex, bytes; -1: there is none; None: it cannot be read."""
        return list(self._ask("object_lengths", slave=slave, objects=[list(address) for address in objects])["lengths"])

    def read_objects(self, objects: Mapping[int | str, Sequence[tuple[int, int]]]) -> list[list[bytes | None]]:
        """Return objects of several slaves, by index and subindex, little endian; None: one that cannot be read."""
        asked = [[slave, [list(address) for address in addresses]] for slave, addresses in objects.items()]
        found = self._ask("read_objects", objects=asked)["found"]
        return [[None if text is None else bytes.fromhex(text) for text in of_slave] for of_slave in found]

    def describe(self, slave: int | str, progress: Progress = ignore) -> dict[str, Any]:
        """Return the description of a slave: the fields of `rtcp.esi.model.Device`, bytes as hex."""
        return dict(self._ask("describe", progress, slave=slave)["device"])

    def foe_read(self, slave: int | str, name: str, password: int, boot: bool, progress: Progress = ignore) -> bytes:
        """Return a file of a slave; `progress` receives bytes."""
        answer = self._ask("foe_read", progress, slave=slave, name=name, password=password, boot=boot)
        return bytes.fromhex(answer["hex"])

    def foe_write(
        self, slave: int | str, name: str, data: bytes, password: int, boot: bool, progress: Progress = ignore
    ) -> None:  # fmt: skip
        """Write a file of a slave; `progress` receives bytes."""
        self._ask("foe_write", progress, slave=slave, name=name, hex=data.hex(), password=password, boot=boot)

    def eeprom_read(self, slave: int | str, size: int = 0, progress: Progress = ignore) -> bytes:
        """Return the first `size` bytes of a slave's EEPROM; 0: the size that it states."""
        return bytes.fromhex(self._ask("eeprom_read", progress, slave=slave, size=size)["hex"])

    def eeprom_write(self, slave: int | str, before: bytes, image: bytes, progress: Progress = ignore) -> int:
        """Write into the EEPROM of a slave from word 0 on; return how many words differed.

        Args:
            slave: the slave.
            before: expected first bytes of its EEPROM, as they were read; where they differ nothing is written.
            image: the image.
            progress: receives how much is done, 0 to 1.
        """
        question = {"slave": slave, "before": before.hex(), "hex": image.hex()}
        return int(self._ask("eeprom_write", progress, **question)["written"])

    def eeprom_beginnings(self, slave: int | str) -> list[bytes]:
        """Return the first 16 bytes of the EEPROM of every slave, in the order of the cable, and look up `slave`."""
        return [bytes.fromhex(text) for text in self._ask("eeprom_beginnings", slave=slave)["beginnings"]]

    def state(self, slave: int | str, state: str) -> str:
        """Bring a slave to an AL state through those before it and leave it there; return its state in words."""
        return str(self._ask("state", slave=slave, state=state)["state"])

    def _ask(self, do: str, progress: Progress = ignore, **arguments: int | str | bool | list[Any]) -> dict[str, Any]:
        config = None if self._config is None else str(self._config)
        answered = _ask(self._bus, self._config, {"do": do, "config": config, **arguments}, progress)
        self.position, self.label = answered.get("position", 0), answered.get("label", "")
        return answered


def _ask(bus: str, config: Path | None, question: Mapping[str, Any], progress: Progress) -> dict[str, Any]:
    from rtcp.config.loader import segment_path
    from rtcp.config.model import VIRTUAL
    from rtcp.fieldbus.errors import BusError
    from rtcp.fieldbus.interface import check_name

    if bus == VIRTUAL:
        with _segment(segment_path(configuration(config))) as ready:
            return _question({**question, "interface": ready["interface"], "namespace_pid": ready["pid"]}, progress)
    try:
        check_name(bus)
    except BusError as error:
        raise RtcpError("invalid", str(error)) from error
    return _question({**question, "interface": bus, "namespace_pid": None}, progress)


def _question(question: Mapping[str, Any], progress: Progress) -> dict[str, Any]:
    """Carry out one request in a child process and return its answer; `progress` receives the progress."""
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
        assert child.stdin is not None
        assert child.stdout is not None
        with contextlib.suppress(BrokenPipeError):
            child.stdin.write(json.dumps(question).encode())
            child.stdin.close()
        answer: dict[str, Any] = {}
        try:
            for line in read_lines(os.dup(child.stdout.fileno()), QUESTION_TIMEOUT_S):
                if "progress" in line:
                    progress(line["progress"])
                else:
                    answer = line
                    break
            else:
                answer = _silence(child, bus)
        except ValueError as error:
            raise RtcpError("internal", f"asking the bus {bus} failed: {error}") from error
    if "error" in answer:
        raise RtcpError(answer["kind"], str(answer["error"]))
    return answer


def _silence(child: subprocess.Popen[bytes], bus: str) -> dict[str, Any]:
    """Return why a child has ended its output, or stopped, without an answer."""
    try:
        code = child.wait(END_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        return {"error": f"the bus {bus} gave no answer within {QUESTION_TIMEOUT_S:g} s", "kind": "timeout"}
    assert child.stderr is not None
    last = child.stderr.read().decode(errors="replace").strip().splitlines()[-1:] or [f"exit code {code}"]
    return {"error": f"asking the bus {bus} failed: {last[0]}", "kind": "internal"}


@contextmanager
def _segment(file: Path) -> Iterator[dict[str, Any]]:
    """Run a virtual segment in namespaces of its own; yield its ready line: `pid` and `interface`."""
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
        question: `interface`, `namespace_pid` (None: the caller's namespaces), `do` and its arguments; `config`, the
            arm's file, where `slave` is a name in it.

    Returns:
        `slaves`, `hex` or another result, with `position` and `label` of the slave; or `error`, a sentence, and
        its `kind`.

    Raises:
        BusError: as the bus raises it.
    """
    from rtcp.fieldbus.soem import SoemBus  # here: the command itself does without SOEM

    asked = [slave for slave, _ in question.get("objects", ())] if question["do"] == "read_objects" else []
    has_name = any(isinstance(slave, str) for slave in (question.get("slave"), *asked))
    # Before joining the namespace, in which this user has another id.
    named = configuration(Path(question["config"]) if question["config"] else None) if has_name else None
    bus = SoemBus(question["interface"], namespace_pid=question["namespace_pid"])
    bus.open()
    try:
        with bus.naming_other_master():
            return _ask_bus(bus, question, named)
    finally:
        bus.close()


def _ask_bus(bus: SoemBus, question: dict[str, Any], named: ArmConfig | None) -> dict[str, Any]:
    do = question["do"]
    # Requests for EEPROM or state need no slave in PRE-OP, which a wrong EEPROM may prevent.
    slaves = bus.discover() if do in ("eeprom_read", "eeprom_write", "eeprom_beginnings", "state") else bus.scan()
    if do == "scan":
        return {"slaves": [dataclasses.asdict(bus.with_eeprom_pdos(info)) for info in slaves]}
    asked = question.get("objects", ()) if do == "read_objects" else ()

    def position_of(slave: int | str) -> int:
        return int(slave) if named is None else bus.position_of(str(slave), named.slaves, slaves)

    positions = [position_of(slave) for slave, _ in asked] or [position_of(question["slave"])]
    for position in positions:
        if not 1 <= position <= len(slaves):
            missing = f"no slave at position {position}: the bus {question['interface']} has {len(slaves)}"
            return {"error": missing, "kind": "invalid"}
    if asked:
        pairs = zip(positions, asked, strict=True)
        return {"found": [_read_objects(bus, position, objects) for position, (_, objects) in pairs]}
    position = positions[0]
    device = slaves[position - 1]
    label = f"slave {position} ({device.name}, serial {device.serial})"
    return {"position": position, "label": label, **_ANSWERS[do](bus, position, question)}


def _report_progress(done: float) -> None:
    print(json.dumps({"progress": done}), flush=True)


def _report_percent(done: float) -> None:
    # A line for each percent: one for each word would be thousands.
    if int(1000 * done) % 10 == 0:
        _report_progress(done)


def _sdo_read(bus: SoemBus, position: int, question: dict[str, Any]) -> dict[str, Any]:
    return {"hex": bus.sdo(position).read(question["index"], question["subindex"]).hex()}


def _object_lengths(bus: SoemBus, position: int, question: dict[str, Any]) -> dict[str, Any]:
    from rtcp.fieldbus.errors import SdoAborted
    from rtcp.fieldbus.mailbox import ABSENT

    lengths: list[int | None] = []
    for index, subindex in question["objects"]:
        try:
            lengths.append(len(bus.sdo(position).read(index, subindex)))
        except SdoAborted as error:
            lengths.append(-1 if error.code in ABSENT else None)
    return {"lengths": lengths}


def _read_objects(bus: SoemBus, position: int, objects: Sequence[tuple[int, int]]) -> list[str | None]:
    from rtcp.fieldbus.drive_settings import reader
    from rtcp.fieldbus.registers import finish

    read = reader(bus.sdo(position))
    found = [finish(read(index, subindex)) for index, subindex in objects]
    return [None if data is None else data.hex() for data in found]


def _sdo_write(bus: SoemBus, position: int, question: dict[str, Any]) -> dict[str, Any]:
    bus.sdo(position).write(question["index"], question["subindex"], bytes.fromhex(question["hex"]))
    return {}


def _describe(bus: SoemBus, position: int, question: dict[str, Any]) -> dict[str, Any]:
    return {"device": dataclasses.asdict(bus.describe_device(position, _report_percent))}


def _foe_read(bus: SoemBus, position: int, question: dict[str, Any]) -> dict[str, Any]:
    if question["boot"]:
        bus.boot(position)
    return {"hex": bus.foe(position).read(question["name"], question["password"], _report_progress).hex()}


def _foe_write(bus: SoemBus, position: int, question: dict[str, Any]) -> dict[str, Any]:
    if question["boot"]:
        bus.boot(position)
    bus.foe(position).write(question["name"], bytes.fromhex(question["hex"]), question["password"], _report_progress)
    return {}


def _eeprom_read(bus: SoemBus, position: int, question: dict[str, Any]) -> dict[str, Any]:
    return {"hex": bus.read_eeprom(position, _report_percent, question["size"] or None).hex()}


def _eeprom_write(bus: SoemBus, position: int, question: dict[str, Any]) -> dict[str, Any]:
    image, before = bytes.fromhex(question["hex"]), bytes.fromhex(question["before"])
    if bus.read_eeprom(position, ignore, len(before)) != before:
        changed = f"the EEPROM of slave {position} is not the one that was read; nothing was written: begin again"
        return {"error": changed, "kind": "refused"}
    return {"written": bus.write_eeprom(position, image, _report_percent)}


def _eeprom_beginnings(bus: SoemBus, position: int, question: dict[str, Any]) -> dict[str, Any]:
    return {"beginnings": [bus.read_eeprom(info.position, ignore, 16).hex() for info in bus.read_states()]}


def _state(bus: SoemBus, position: int, question: dict[str, Any]) -> dict[str, Any]:
    from rtcp.fieldbus.al_state import AlState

    requested = AlState[question["state"]]
    between = [AlState.PREOP] if requested is AlState.SAFEOP else []
    for state in dict.fromkeys((AlState.INIT, *between, requested)):
        bus.request_state(state, [position])
        if refused := bus.wait_for_state(state, STATE_TIMEOUT_S, [position]):
            return {"error": "\n".join(refused), "kind": "refused"}
    words = bus.read_states()[position - 1].words()
    bus.release()
    return {"state": words}


_ANSWERS: dict[str, Callable[[SoemBus, int, dict[str, Any]], dict[str, Any]]] = {
    "sdo_read": _sdo_read,
    "sdo_write": _sdo_write,
    "object_lengths": _object_lengths,
    "describe": _describe,
    "foe_read": _foe_read,
    "foe_write": _foe_write,
    "eeprom_read": _eeprom_read,
    "eeprom_write": _eeprom_write,
    "eeprom_beginnings": _eeprom_beginnings,
    "state": _state,
}


def _plain(value: object) -> object:
    """Return the JSON form of what `json` does not know: bytes as hex, sets as lists, enums as their values."""
    if isinstance(value, bytes):
        return value.hex()
    if isinstance(value, set | frozenset):
        return sorted(value)
    return value.value if isinstance(value, Enum) else str(value)


def main() -> int:
    """Answer the question on standard input; errors of the bus are answers too."""
    from rtcp.fieldbus.errors import BusError, Refused

    # An interrupted command ends this process: the bus is closed on the way out.
    signal.signal(signal.SIGTERM, _leave)
    question = json.loads(sys.stdin.buffer.read())
    try:
        reply = answer(question)
    except BusError as error:
        reply = {"error": str(error), "kind": "refused" if isinstance(error, Refused) else "fault"}
    print(json.dumps(reply, default=_plain), flush=True)
    return 0


def _leave(number: int, frame: FrameType | None) -> None:
    raise SystemExit(128 + number)


if __name__ == "__main__":
    raise SystemExit(main())
