"""Behaviours of described devices: their base class, and how a segment runs their untrusted code.

The segment's file names a behaviour, as `behaviour: cia402` or `behaviour: mymodule:MyDrive`:

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

from rtcp.config.find import load_class
from rtcp.config.findings import Finding, shown
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
"""SDO abort code after a failed hook (ETG.1000.6, table 41)."""
UNSPECIFIED_ERROR = 0x0001
"""AL status code after a failed hook (ETG.1000.6, table 11)."""


class FoeError(IntEnum):
    """FoE error codes (ETG.1000.6, table 92)."""

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
    """The behaviour refuses a file, with an error code and a text for the master."""

    def __init__(self, code: int = FoeError.ACCESS_DENIED, text: str = "") -> None:
        check_whole("code of FileRefused", code, 0xFFFFFFFF)
        if not isinstance(text, str):
            raise ValueError(f"text of FileRefused: found {shown(text)}, allowed is a text")
        super().__init__(f"0x{code:04X} {text}")
        self.code = code
        self.text = text


class FileBusy(Exception):
    """The behaviour is busy: the master asks again; `done` of `entire`, 0 to 65535, is its progress."""

    def __init__(self, done: int = 0, entire: int = 0) -> None:
        check_whole("done of FileBusy", done, 0xFFFF)
        check_whole("entire of FileBusy", entire, 0xFFFF)
        super().__init__(f"{done} of {entire}")
        self.done = done
        self.entire = entire


class Behaviour:
    """Function of a device: hooks that read and write its objects, all optional.

    `self[index, subindex]`, or `self[index]` for subindex 0, is the value of an object: int, float, or bytes. A hook
    that takes too long or raises any other error than documented ends OP with AL status code 0x0001; it runs again at
    the next change to OP.
    """

    options: ClassVar[Mapping[str, Option]] = MappingProxyType({})
    """Numbers that the segment's file can set under `options`; read them with `option`."""
    keeps_outputs: ClassVar[bool] = False
    """True: outputs keep their values below OP; False: they become 0."""

    def __init__(self, device: DeviceModel) -> None:
        self.device = device
        self.files: dict[str, bytes] = {}
        """Files that a master has written over FoE and can read, by name."""

    # -- hooks ------------------------------------------------------------------------------------------------------

    def on_start(self) -> None:
        """Called at power-on; every object has its default."""

    def on_outputs(self, dt: float) -> None:
        """Called every `dt` seconds, in all states: read outputs, write inputs. In OP the outputs are the master's."""

    def on_sdo_read(self, index: int, subindex: int) -> Value | None:
        """Called when the master reads an object: return its value; None: the stored one. May raise SdoAbort(code)."""

    def on_sdo_write(self, index: int, subindex: int, value: Value) -> None:
        """Called when the master writes `value`, already in range, to an object. May raise SdoAbort(code)."""

    def on_state(self, old: AlState, new: AlState) -> None:
        """Called after a change of the AL state."""

    def on_file(self, name: str, data: bytes) -> None:
        """Called when a master has written a file over FoE. May raise FileRefused, or FileBusy to be called again."""
        self.files[name] = data

    def read_file(self, name: str) -> bytes | None:
        """Return a file that a master reads over FoE; None: no such file. May raise as `on_file`."""
        return self.files.get(name)

    # -- services ----------------------------------------------------------------------------------------------

    @property
    def outputs_valid(self) -> bool:
        """Whether the outputs are valid: the slave is in OP and receives process data."""
        return self.device.outputs_valid

    def option(self, name: str, otherwise: float = 0.0) -> float:
        """Return the value of an option, or `otherwise` if it has none."""
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
        """Send an emergency message: error code, error register, five manufacturer-specific bytes."""
        self.device.emergencies.append(Emergency(code & 0xFFFF, register & 0xFF, data[:5].ljust(5, b"\0")))

    def fail(self, code: int = UNSPECIFIED_ERROR) -> None:
        """Leave OP for SAFE-OP with an AL status code."""
        self.device.failure = code & 0xFFFF


def set_value(entry: Entry, value: Value) -> None:
    """Store a value in an object.

    Raises:
        ValueError: the value has the wrong type or exceeds the object's bits.
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
    """Raised inside a hook that takes too long; an `except Exception` does not catch it."""

    def __init__(self, reason: str, where: str) -> None:
        super().__init__(f"{reason}, at {where}")
        self.reason = reason


class Patience(NamedTuple):
    """Time limits for a behaviour's code."""

    cpu_ns: int
    """CPU time, ns: waiting for the CPU does not count."""
    ns: int
    """Elapsed time, ns, for code that waits."""


HOOK = Patience(20_000_000, 200_000_000)
"""Of a hook, which blocks all other slaves."""
MAKING = Patience(5_000_000_000, 9_000_000_000)
"""Of importing a behaviour, its `__init__` and its first `on_start`, before the segment runs."""
EXIT_HANGING = 5
"""Exit code of a process that a hook blocks, as that of a failed command."""


class HookWatch:
    """Ends a hook that takes too long by a signal; ends the process if the hook does not end."""

    PERIOD_S = 0.01
    MOST_RAISED = 20
    """Upper bound on `HookHangs` raised in one call, once a period, before the process ends."""
    LONGEST_IN_C_S = 3.0
    """Upper bound on the CPU time of a call into C, s; then the process ends, as Python handles no signal during it."""

    def __init__(self) -> None:
        self.patience: Patience | None = None
        """Limits of the running code; None: no behaviour runs."""
        self.call = 0
        self._timed_call = -1
        self._since = self._since_cpu = self._raised = 0

    @contextmanager
    def started(self) -> Iterator[None]:
        """Watch in this block; no effect outside the main thread, which alone receives signals."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        handler = signal.signal(signal.SIGALRM, self._on_timer)
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
        """Call a behaviour's code within the limits `patience`; raises HookHangs, and what the code raises."""
        try:
            self.call += 1
            self.patience = patience
            result = call(*arguments)
            self.patience = None
        except BaseException:
            # First statement: no call before it could handle a signal.
            self.patience = None
            raise
        return result

    def _on_timer(self, number: int, frame: FrameType | None) -> None:
        # A call into C that lasts longer ends the process with a traceback.
        signal.setitimer(signal.ITIMER_PROF, self.LONGEST_IN_C_S)
        patience = self.patience
        if patience is None:
            return
        now, cpu = time.monotonic_ns(), time.thread_time_ns()
        if self._timed_call != self.call:
            self._timed_call, self._since, self._since_cpu, self._raised = self.call, now, cpu, 0
        elif cpu - self._since_cpu >= patience.cpu_ns or now - self._since >= patience.ns:
            reason = f"it has not returned for {(now - self._since) / 1e6:.0f} ms"
            where = "?" if frame is None else f"{frame.f_code.co_filename}:{frame.f_lineno}"
            self._raised += 1
            if self._raised > self.MOST_RAISED:
                caught = "it catches what is raised to end it, as a bare `except:` does"
                # Neither `print`, which the hook may be inside of, nor an exception, which it catches.
                os.write(2, f"a behaviour cannot be ended at {where}: {reason}, {caught}; this process ends\n".encode())
                os._exit(EXIT_HANGING)
            raise HookHangs(reason, where)


WATCH = HookWatch()
"""The watch of this process, active while started."""


class HookFailed(Exception):
    """A hook raised an undocumented error or hung; already reported."""


def _complain(sentence: str) -> None:
    print(sentence, file=sys.stderr, flush=True)


class Runner:
    """Calls the hooks of a device's behaviour and reports each failure in one sentence."""

    def __init__(self, device: DeviceModel, kind: type[Behaviour] | None) -> None:
        """Create the behaviour; None: the device only serves its dictionary and keeps files.

        Raises:
            OptionError: the behaviour cannot be created.
        """
        self._device = device
        self.report: Callable[[str], None] = _complain
        self.place = device.identity.name
        """Name of the device in messages."""
        self._broken = False
        self._reported: set[str] = set()
        self._steps: Callable[[float], None] | None = None
        if kind is None:
            kind = Behaviour
        try:
            self.behaviour = WATCH.run(MAKING, kind, device)
            self.keeps_outputs = WATCH.run(MAKING, lambda: bool(self.behaviour.keeps_outputs))
            """True: outputs keep their values when they become invalid."""
        except KeyboardInterrupt:
            raise
        except BaseException as error:  # whatever a behaviour raises, and HookHangs
            raise _error(f"{_place_of(error, kind, '__init__')}: {_text_of(error)}") from error
        if _overrides(kind, "on_outputs"):
            self._steps = self.behaviour.on_outputs
        for obj in device.objects:
            for entry in obj.entries.values():
                if _overrides(kind, "on_sdo_read"):
                    entry.on_read = self._read
                if _overrides(kind, "on_sdo_write") and entry.on_write is None:
                    entry.on_write = self._write
        self.start(MAKING)

    def start(self, patience: Patience = HOOK) -> None:
        """Power on."""
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
        """Set whether the outputs are valid; a failed behaviour is tried again."""
        if valid:
            self._broken = False

    def state_changed(self, before: int, after: int) -> None:
        """Report a change of the AL state to the behaviour."""
        if _overrides(type(self.behaviour), "on_state"):
            self._try("on_state", self.behaviour.on_state, AlState(before), AlState(after))

    def on_file(self, name: str, data: bytes) -> None:
        """Pass a file to the behaviour; raises HookFailed, and the errors of `Behaviour.on_file`."""
        self._call("on_file", self.behaviour.on_file, name, data, allowed=(FileBusy, FileRefused))

    def read_file(self, name: str) -> bytes | None:
        """Return a file, or None; raises as `on_file`."""
        return self._call("read_file", self._file, name, allowed=(FileBusy, FileRefused))

    def _file(self, name: str) -> bytes | None:
        data: object = self.behaviour.read_file(name)
        if data is not None and not isinstance(data, bytes | bytearray):
            raise TypeError(f"read_file returned {type(data).__name__}, allowed is bytes or None")
        return None if data is None else bytes(data)

    def _try(self, hook: str, call: Callable[..., object], *arguments: object, patience: Patience = HOOK) -> None:
        """Call a hook; a failure ends OP."""
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
        """Call a hook; pass on errors of the types `allowed`, report any other and raise HookFailed."""
        try:
            return WATCH.run(patience, call, *arguments)
        except BaseException as error:  # whatever a behaviour raises, and HookHangs
            if isinstance(error, allowed):
                raise
            self._tell(hook, error)
            raise HookFailed from None

    def fail(self, hook: str, error: BaseException) -> None:
        """Leave OP because of a failure, and report it."""
        self._broken = True
        self._device.failure = UNSPECIFIED_ERROR
        self._tell(hook, error)

    def _tell(self, hook: str, error: BaseException) -> None:
        sentence = f"{self.place}: {hook} failed at {_place_of(error, type(self.behaviour), hook)}: {_text_of(error)}"
        if sentence not in self._reported and len(self._reported) < _MOST_SENTENCES:
            self._reported.add(sentence)
            self.report(sentence)


_SUSPENDED = inspect.CO_GENERATOR | inspect.CO_COROUTINE | inspect.CO_ASYNC_GENERATOR
"""Flags of functions whose call does not run their code."""
HOOKS = ("on_start", "on_outputs", "on_sdo_read", "on_sdo_write", "on_state", "on_file", "read_file")
_MOST_SENTENCES = 20
"""Upper bound on the different failures reported per behaviour."""


def _overrides(kind: type[Behaviour], hook: str) -> bool:
    return getattr(kind, hook) is not getattr(Behaviour, hook)


def _text_of(error: BaseException) -> str:
    if isinstance(error, HookHangs):
        return error.reason
    try:
        text = str(error)
    except Exception:  # the error's class is foreign code
        text = "its text cannot be made"
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def _place_of(error: BaseException, kind: type, hook: str) -> str:
    """Return file and line of an error: the innermost line in the behaviour's file, else the start of the hook."""
    try:
        own = inspect.getsourcefile(kind)
    except TypeError:
        own = None
    places = [f"{frame.filename}:{frame.lineno}" for frame in traceback.extract_tb(error.__traceback__)]
    inner = next((place for place in reversed(places) if own and place.startswith(f"{own}:")), None)
    return inner or _beginning(kind, hook) or own or (places or ["?"])[-1]


def _beginning(kind: type, hook: str) -> str | None:
    """Return file and line of a hook's start; None: not a Python function."""
    code = getattr(getattr(kind, hook, None), "__code__", None)
    return None if code is None else f"{code.co_filename}:{code.co_firstlineno}"


def find_behaviour(name: str) -> type[Behaviour]:
    """Return the behaviour of a name in `BUILT_IN` or of `module:Class`.

    Raises:
        OptionError: unknown name, import error, invalid options, or a hook that would never run.
    """
    target = BUILT_IN.get(name, name)
    if ":" not in target:
        allowed = f"one of {', '.join(BUILT_IN)}, or module:Class"
        raise OptionError(Finding(("behaviour",), "choice", found=name, allowed=allowed))
    try:
        loaded = WATCH.run(MAKING, load_class, EntryPoint(name, target, "behaviour"), Behaviour)
    except (PluginError, HookHangs) as error:
        raise _error(str(error)) from error
    _check(loaded)
    return loaded


def _error(text: str) -> OptionError:
    return OptionError(Finding(("behaviour",), "behaviour", text=text))


def _check(kind: type[Behaviour]) -> None:
    where, options = f"{kind.__module__}:{kind.__qualname__}", kind.options
    mapping = {"": options} if not isinstance(options, Mapping) else options
    for name, option in mapping.items():
        if not isinstance(option, Option):
            text = f"found {shown(option)}, allowed is Option(default, low, high, meaning)"
            raise _error(f"options of {where}{name and f', {name}'}: {text} by its name")
    for hook in HOOKS:
        code = getattr(getattr(kind, hook), "__code__", None)
        if code is not None and code.co_flags & _SUSPENDED:
            text = f"{hook} would never run, for it has a `yield` or is `async`"
            raise _error(f"{_beginning(kind, hook) or where}: {text}")
