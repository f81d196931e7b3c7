"""What a described device does: the base class of behaviours, and how a segment calls them without trusting them.

A behaviour is named in the segment's file, as `behaviour: cia402` or `behaviour: mymodule:MyDrive`:

    class Heater(Behaviour):
        options = {"ambient": Option(20.0, -40.0, 80.0, "temperature at power-on, C")}

        def on_start(self) -> None:
            self.temperature = self.option("ambient")

        def on_outputs(self, dt: float) -> None:
            self.temperature += (50.0 * self[0x7000, 1] - self.temperature + 20.0) * dt
            self[0x6000, 1] = round(10.0 * self.temperature)
"""

from __future__ import annotations

import faulthandler
import inspect
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from enum import IntEnum
from importlib.metadata import EntryPoint
from types import FrameType, MappingProxyType
from typing import Any, ClassVar, NamedTuple, TypeVar

from rtcp.config.document import shown
from rtcp.config.find import load_class
from rtcp.config.model import PluginError
from rtcp.virtual.device import DeviceModel, Emergency, Option, OptionError
from rtcp.virtual.objects import LARGEST, Entry, SdoAbort, Value, bounds, check_whole
from rtcp.virtual.protocol import AlState

__all__ = ["Behaviour", "FileBusy", "FileRefused", "FoeError", "Option", "SdoAbort"]

T = TypeVar("T")

BUILT_IN = {
    "cia402": "rtcp.virtual.models.cia402_drive:Cia402Drive",
}
"""Behaviours by their short names."""
GENERAL_ERROR = 0x08000000
"""Abort code of an SDO whose hook failed (ETG.1000.6, table 41)."""
UNSPECIFIED_ERROR = 0x0001
"""AL status code of a slave whose behaviour failed (ETG.1000.6, table 11)."""


class FoeError(IntEnum):
    """Error codes (ETG.1000.6, table 92)."""

    NOT_DEFINED = 0x8000
    NOT_FOUND = 0x8001
    ACCESS_DENIED = 0x8002
    DISK_FULL = 0x8003
    ILLEGAL = 0x8004
    PACKET_NUMBER = 0x8005
    ALREADY_EXISTS = 0x8006
    NO_USER = 0x8007
    BOOTSTRAP_ONLY = 0x8008
    NOT_BOOTSTRAP = 0x8009
    NO_RIGHTS = 0x800A
    PROGRAM_ERROR = 0x800B


class FileRefused(Exception):
    """A file that a behaviour refuses, with an error code and a text for the master."""

    def __init__(self, code: int = FoeError.ACCESS_DENIED, text: str = "") -> None:
        check_whole("code of FileRefused", code, 0xFFFFFFFF)
        if not isinstance(text, str):
            raise ValueError(f"text of FileRefused: found {shown(text)}, allowed is a text")
        super().__init__(f"0x{code:04X} {text}")
        self.code = code
        self.text = text


class FileBusy(Exception):
    """A behaviour is not ready: the master asks again; `done` of `entire`, 0 to 65535, is shown to it."""

    def __init__(self, done: int = 0, entire: int = 0) -> None:
        check_whole("done of FileBusy", done, 0xFFFF)
        check_whole("entire of FileBusy", entire, 0xFFFF)
        super().__init__(f"{done} of {entire}")
        self.done = done
        self.entire = entire


class Behaviour:
    """What a device does with its objects. Each hook may be left out.

    `self[index, subindex]`, or `self[index]` for subindex 0, is the value of an object: int, float, or bytes. A hook
    that raises something else than it may, or takes too long, ends OP with AL status code 0x0001; it is tried again
    when the slave goes to OP again.
    """

    options: ClassVar[Mapping[str, Option]] = MappingProxyType({})
    """Numbers that the segment's file may set under `options`; read with `option`."""
    keeps_outputs: ClassVar[bool] = False
    """Whether outputs keep their values when they become invalid (below OP); else they are 0 then."""

    def __init__(self, device: DeviceModel) -> None:
        self.device = device
        self.files: dict[str, bytes] = {}
        """What a master has written over FoE, by name, and may read."""

    # -- hooks ------------------------------------------------------------------------------------------------------

    def on_start(self) -> None:
        """Power comes on; every object has its default."""

    def on_outputs(self, dt: float) -> None:
        """`dt` seconds pass, in every state: read outputs, write inputs. In OP the outputs are those of the master."""

    def on_sdo_read(self, index: int, subindex: int) -> Value | None:
        """The master reads an object: return its value, None for the present one. May raise SdoAbort(code)."""

    def on_sdo_write(self, index: int, subindex: int, value: Value) -> None:
        """The master writes `value`, which is in range, to an object. May raise SdoAbort(code) to refuse it."""

    def on_state(self, old: AlState, new: AlState) -> None:
        """The slave went to another AL state."""

    def on_file(self, name: str, data: bytes) -> None:
        """A master has written a file over FoE. May raise FileRefused, or FileBusy to be asked again."""
        self.files[name] = data

    def read_file(self, name: str) -> bytes | None:
        """Return a file that a master reads over FoE; None: there is none. May raise as `on_file`."""
        return self.files.get(name)

    # -- what it can use ----------------------------------------------------------------------------------------------

    @property
    def outputs_valid(self) -> bool:
        """Whether outputs count: the slave is in OP and the master sends."""
        return self.device.outputs_valid

    def option(self, name: str, otherwise: float = 0.0) -> float:
        """Return the value of an option, `otherwise` where it has none."""
        return self.device.option(name, otherwise)

    def __contains__(self, key: tuple[int, int] | int) -> bool:
        return (key if isinstance(key, tuple) else (key, 0)) in self.device.objects

    def __getitem__(self, key: tuple[int, int] | int) -> Any:
        return self._entry(key).value

    def __setitem__(self, key: tuple[int, int] | int, value: Value) -> None:
        set_value(self._entry(key), value)

    def _entry(self, key: tuple[int, int] | int) -> Entry:
        at = key if isinstance(key, tuple) else (key, 0)
        if at not in self.device.objects:
            raise KeyError(f"{self.device.identity.name} has no object 0x{at[0]:04X}:{at[1]}")
        return self.device.objects[at]

    def emergency(self, code: int, register: int = 0x01, data: bytes = bytes(5)) -> None:
        """Send an emergency message: error code, error register, five bytes of the manufacturer."""
        self.device.emergencies.append(Emergency(code & 0xFFFF, register & 0xFF, data[:5].ljust(5, b"\0")))

    def fail(self, code: int = UNSPECIFIED_ERROR) -> None:
        """Leave OP for SAFE-OP with an AL status code."""
        self.device.failure = code & 0xFFFF


def set_value(entry: Entry, value: Value) -> None:
    """Store a value in an object.

    Raises:
        ValueError: it is of another kind, or outside what its bits hold.
    """
    where = f"0x{entry.index:04X}:{entry.subindex} {entry.name}"
    if entry.is_bytes:
        if not isinstance(value, bytes) or len(value) > (entry.bit_length + 7) // 8:
            raise ValueError(f"{where} takes up to {(entry.bit_length + 7) // 8} bytes, not {value!r}")
    elif not isinstance(value, int | float) or (not entry.is_float and value % 1):  # inf % 1 is NaN: true
        raise ValueError(f"{where} takes {'a number' if entry.is_float else 'a whole number'}, not {value!r}")
    else:
        most = LARGEST.get(entry.data_type)
        low, high = bounds(entry) if most is None else (-most, most)
        if not low <= value <= high:
            raise ValueError(f"{where} takes {low} to {high}, not {value}")
        value = value if entry.is_float else int(value)
    entry.value = value


class HookHangs(BaseException):
    """Raised inside a hook that takes too long; no `except Exception` of the hook catches it."""

    def __init__(self, said: str, where: str) -> None:
        super().__init__(f"{said}, at {where}")
        self.said = said


class Patience(NamedTuple):
    """How long a behaviour's code may run."""

    cpu_ns: int
    """CPU time: a process that waits for the CPU is no fault of the code."""
    ns: int
    """Time, for code that waits for something else."""


HOOK = Patience(20_000_000, 200_000_000)
"""Of a hook: it stops all other slaves while it runs."""
MAKING = Patience(5_000_000_000, 9_000_000_000)
"""Of a behaviour's module, its `__init__` and its first `on_start`, before the segment runs."""
EXIT_HANGING = 5
"""Exit code of a process that a hook keeps, as that of a command that failed."""


class HookWatch:
    """Ends hooks that take too long, by a signal, and where they do not let themselves be ended, the process."""

    PERIOD_S = 0.01
    MOST_RAISED = 20
    """How many times `HookHangs` is raised in one call, once a period, before the process ends."""
    LONGEST_IN_C_S = 3.0
    """CPU time of one call into C; the process then ends, for Python sees no signal before the call returns."""

    def __init__(self) -> None:
        self.patience: Patience | None = None
        """That with what runs now; None: no code of a behaviour's."""
        self.call = 0
        self._seen = -1
        self._since = self._since_cpu = self._raised = 0

    @contextmanager
    def started(self) -> Iterator[None]:
        """Watch in this block; outside of the main thread, which alone gets signals, do nothing."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        handler = signal.signal(signal.SIGALRM, self._look)
        faulthandler.register(signal.SIGPROF, 2, all_threads=False, chain=True)
        timer = signal.setitimer(signal.ITIMER_REAL, self.PERIOD_S, self.PERIOD_S)
        try:
            yield
        finally:
            signal.setitimer(signal.ITIMER_REAL, *timer)
            signal.setitimer(signal.ITIMER_PROF, 0.0)
            signal.signal(signal.SIGALRM, handler)
            faulthandler.unregister(signal.SIGPROF)

    def run(self, patience: Patience, call: Callable[..., T], *arguments: object) -> T:
        """Call code of a behaviour's, for as long as `patience` allows; raises HookHangs, and what the code raises."""
        try:
            self.call += 1
            self.patience = patience
            result = call(*arguments)
            self.patience = None
        except BaseException:
            # First: between the code and this line nothing is called, so no signal is looked at.
            self.patience = None
            raise
        return result

    def _look(self, number: int, frame: FrameType | None) -> None:
        # What C does not return from in this time ends the process, with the lines that called it.
        signal.setitimer(signal.ITIMER_PROF, self.LONGEST_IN_C_S)
        patience = self.patience
        if patience is None:
            return
        now, cpu = time.monotonic_ns(), time.thread_time_ns()
        if self._seen != self.call:
            self._seen, self._since, self._since_cpu, self._raised = self.call, now, cpu, 0
        elif cpu - self._since_cpu >= patience.cpu_ns or now - self._since >= patience.ns:
            said = f"it has not returned for {(now - self._since) / 1e6:.0f} ms"
            where = "?" if frame is None else f"{frame.f_code.co_filename}:{frame.f_lineno}"
            self._raised += 1
            if self._raised > self.MOST_RAISED:
                caught = "it catches what is raised to end it, as a bare `except:` does"
                # Not by `print`, which the hook may be in, and past all handlers of exceptions: it has its own.
                os.write(2, f"a behaviour cannot be ended at {where}: {said}, {caught}; this process ends\n".encode())
                os._exit(EXIT_HANGING)
            raise HookHangs(said, where)


WATCH = HookWatch()
"""Of this process; it watches while it is started."""


class HookFailed(Exception):
    """A hook raised what it may not, or hung; it has been reported."""


def _complain(sentence: str) -> None:
    print(sentence, file=sys.stderr, flush=True)


class Runner:
    """Calls the hooks of a device's behaviour, and reports each failure in one sentence."""

    def __init__(self, device: DeviceModel, kind: type[Behaviour] | None) -> None:
        """Make the behaviour; None: the device answers by its dictionary and keeps files.

        Raises:
            OptionError: it cannot be made.
        """
        self._device = device
        self.report: Callable[[str], None] = _complain
        self.place = device.identity.name
        """What a sentence calls the device."""
        self._broken = False
        self._told: set[str] = set()
        self._steps: Callable[[float], None] | None = None
        if kind is None:
            kind = Behaviour
        try:
            self.behaviour = WATCH.run(MAKING, kind, device)
            self.keeps_outputs = WATCH.run(MAKING, lambda: bool(self.behaviour.keeps_outputs))
            """Whether outputs keep their values when they become invalid."""
        except KeyboardInterrupt:
            raise
        except BaseException as error:  # whatever a behaviour raises, and HookHangs
            raise OptionError((("behaviour",), f"{_place_of(error, kind, '__init__')}: {_said(error)}")) from error
        if _overrides(kind, "on_outputs"):
            self._steps = self.behaviour.on_outputs
        for found in device.objects:
            for entry in found.entries.values():
                if _overrides(kind, "on_sdo_read"):
                    entry.on_read = self._read
                if _overrides(kind, "on_sdo_write") and entry.on_write is None:
                    entry.on_write = self._write
        self.start(MAKING)

    def start(self, patience: Patience = HOOK) -> None:
        """Power has come on."""
        self._broken = False
        self._try("on_start", self.behaviour.on_start, patience=patience)

    def step(self, dt: float) -> None:
        """Let `dt` seconds pass."""
        steps = self._steps
        if steps is None or self._broken:
            return
        try:
            WATCH.call += 1
            WATCH.patience = HOOK
            steps(dt)
            WATCH.patience = None
        except BaseException as error:  # whatever a behaviour raises, and HookHangs
            WATCH.patience = None
            self.fail("on_outputs", error)

    def outputs_valid(self, valid: bool) -> None:
        """Outputs count from now on, or do not; a behaviour that failed is tried again."""
        if valid:
            self._broken = False

    def state_changed(self, before: int, after: int) -> None:
        """The slave went to another AL state."""
        if _overrides(type(self.behaviour), "on_state"):
            self._try("on_state", self.behaviour.on_state, AlState(before), AlState(after))

    def on_file(self, name: str, data: bytes) -> None:
        """Hand a file over; raises HookFailed, and what `Behaviour.on_file` may raise."""
        self._call("on_file", self.behaviour.on_file, name, data, allowed=(FileBusy, FileRefused))

    def read_file(self, name: str) -> bytes | None:
        """Return a file, None where there is none; raises as `on_file`."""
        return self._call("read_file", self._file, name, allowed=(FileBusy, FileRefused))

    def _file(self, name: str) -> bytes | None:
        data: object = self.behaviour.read_file(name)
        if data is not None and not isinstance(data, bytes | bytearray):
            raise TypeError(f"read_file returned {type(data).__name__}, allowed is bytes or None")
        return None if data is None else bytes(data)

    def _try(self, hook: str, call: Callable[..., object], *arguments: object, patience: Patience = HOOK) -> None:
        """Call a hook whose failure takes the slave out of OP."""
        try:
            self._call(hook, call, *arguments, patience=patience)
        except HookFailed:
            self._device.failure = UNSPECIFIED_ERROR
            self._broken = True

    def _read(self, entry: Entry) -> None:
        try:
            self._call("on_sdo_read", self._update, entry, allowed=(SdoAbort,))
        except HookFailed:
            raise SdoAbort(GENERAL_ERROR) from None

    def _update(self, entry: Entry) -> None:
        value = self.behaviour.on_sdo_read(entry.index, entry.subindex)
        if value is not None:
            set_value(entry, value)

    def _write(self, entry: Entry, value: Value) -> None:
        try:
            arguments = entry.index, entry.subindex, value
            self._call("on_sdo_write", self.behaviour.on_sdo_write, *arguments, allowed=(SdoAbort,))
        except HookFailed:
            raise SdoAbort(GENERAL_ERROR) from None

    def _call(self, hook: str, call: Callable[..., T], *arguments: object, allowed: tuple[type[Exception], ...] = (),
              patience: Patience = HOOK) -> T:  # fmt: skip
        """Call a hook, which may raise what is `allowed`; report anything else and raise HookFailed."""
        try:
            return WATCH.run(patience, call, *arguments)
        except BaseException as error:  # whatever a behaviour raises, and HookHangs
            if isinstance(error, allowed):
                raise
            self._tell(hook, error)
            raise HookFailed from None

    def fail(self, hook: str, error: BaseException) -> None:
        """Take the slave out of OP for a failure, and report that."""
        self._broken = True
        self._device.failure = UNSPECIFIED_ERROR
        self._tell(hook, error)

    def _tell(self, hook: str, error: BaseException) -> None:
        sentence = f"{self.place}: {hook} failed at {_place_of(error, type(self.behaviour), hook)}: {_said(error)}"
        if sentence not in self._told and len(self._told) < _MOST_SENTENCES:
            self._told.add(sentence)
            self.report(sentence)


_SUSPENDED = inspect.CO_GENERATOR | inspect.CO_COROUTINE | inspect.CO_ASYNC_GENERATOR
"""Of functions whose call runs nothing of them."""
HOOKS = ("on_start", "on_outputs", "on_sdo_read", "on_sdo_write", "on_state", "on_file", "read_file")
_MOST_SENTENCES = 20
"""Different failures of a behaviour that are reported."""


def _overrides(kind: type[Behaviour], hook: str) -> bool:
    return getattr(kind, hook) is not getattr(Behaviour, hook)


def _said(error: BaseException) -> str:
    if isinstance(error, HookHangs):
        return error.said
    try:
        text = str(error)
    except Exception:  # its class is the behaviour's own
        text = "its text cannot be made"
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def _place_of(error: BaseException, kind: type, hook: str) -> str:
    """Return file and line of an error: the innermost of the behaviour's own file, else where the hook begins."""
    try:
        own = inspect.getsourcefile(kind)
    except TypeError:
        own = None
    places = [f"{frame.filename}:{frame.lineno}" for frame in traceback.extract_tb(error.__traceback__)]
    inner = next((place for place in reversed(places) if own and place.startswith(f"{own}:")), None)
    return inner or _beginning(kind, hook) or own or (places or ["?"])[-1]


def _beginning(kind: type, hook: str) -> str | None:
    """Return file and line where a hook begins; None: it is no function of Python's."""
    code = getattr(getattr(kind, hook, None), "__code__", None)
    return None if code is None else f"{code.co_filename}:{code.co_firstlineno}"


def find_behaviour(name: str) -> type[Behaviour]:
    """Return the behaviour of a name of `BUILT_IN`, or of `module:Class`.

    Raises:
        OptionError: there is none, it cannot be loaded, its options are none, or a hook of it would never run.
    """
    target = BUILT_IN.get(name, name)
    if ":" not in target:
        text = f'found the text "{name}", allowed is one of {", ".join(BUILT_IN)}, or module:Class'
        raise OptionError((("behaviour",), text))
    try:
        found = WATCH.run(MAKING, load_class, EntryPoint(name, target, "behaviour"), Behaviour)
    except (PluginError, HookHangs) as error:
        raise OptionError((("behaviour",), str(error))) from error
    _check(found)
    return found


def _check(kind: type[Behaviour]) -> None:
    where, options = f"{kind.__module__}:{kind.__qualname__}", kind.options
    given = {"": options} if not isinstance(options, Mapping) else options
    for name, option in given.items():
        if not isinstance(option, Option):
            text = f"found {shown(option)}, allowed is Option(default, low, high, meaning)"
            raise OptionError((("behaviour",), f"options of {where}{name and f', {name}'}: {text} by its name"))
    for hook in HOOKS:
        code = getattr(getattr(kind, hook), "__code__", None)
        if code is not None and code.co_flags & _SUSPENDED:
            text = f"{hook} would never run, for it has a `yield` or is `async`"
            raise OptionError((("behaviour",), f"{_beginning(kind, hook) or where}: {text}"))
