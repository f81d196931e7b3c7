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

import inspect
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from enum import IntEnum
from importlib.metadata import EntryPoint
from types import FrameType, MappingProxyType
from typing import Any, ClassVar

from rtcp.config.find import load_class
from rtcp.config.model import PluginError
from rtcp.virtual.device import DeviceModel, Emergency, Option, OptionError
from rtcp.virtual.objects import Entry, SdoAbort, Value, bounds
from rtcp.virtual.protocol import AlState

__all__ = ["Behaviour", "FileBusy", "FileRefused", "FoeError", "Option", "SdoAbort"]

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
        super().__init__(f"0x{code:04X} {text}")
        self.code = code
        self.text = text


class FileBusy(Exception):
    """A behaviour is not ready: the master asks again; `done` of `entire` is shown to it."""

    def __init__(self, done: int = 0, entire: int = 0) -> None:
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
        self.device.failure = code


def set_value(entry: Entry, value: Value) -> None:
    """Store a value in an object.

    Raises:
        ValueError: it is of another kind, or outside what its bits hold.
    """
    where = f"0x{entry.index:04X}:{entry.subindex} {entry.name}"
    if entry.is_bytes:
        if not isinstance(value, bytes) or len(value) > (entry.bit_length + 7) // 8:
            raise ValueError(f"{where} takes up to {(entry.bit_length + 7) // 8} bytes, not {value!r}")
    elif not isinstance(value, int | float) or (not entry.is_float and int(value) != value):
        raise ValueError(f"{where} takes {'a number' if entry.is_float else 'a whole number'}, not {value!r}")
    elif not entry.is_float:
        low, high = bounds(entry)
        if not low <= value <= high:
            raise ValueError(f"{where} takes {low} to {high}, not {value}")
        value = int(value)
    entry.value = value


class HookHangs(BaseException):
    """Raised inside a hook that takes too long; no `except Exception` of the hook catches it."""


class HookWatch:
    """Ends hooks that take too long, by a signal: a hook stops all other slaves while it runs."""

    PERIOD_S = 0.01
    LONGEST_CPU_NS = 20_000_000
    """CPU time of a hook; a process that waits for the CPU is no fault of the hook."""
    LONGEST_NS = 200_000_000
    """Time of a hook that waits for something else."""

    def __init__(self) -> None:
        self.active = False
        self.call = 0
        self._seen = -1
        self._since = self._since_cpu = 0

    def start(self) -> None:
        """Watch from now on, in the main thread of this process."""
        signal.signal(signal.SIGALRM, self._look)
        signal.setitimer(signal.ITIMER_REAL, self.PERIOD_S, self.PERIOD_S)

    def _look(self, number: int, frame: FrameType | None) -> None:
        if not self.active:
            return
        now, cpu = time.monotonic_ns(), time.thread_time_ns()
        if self._seen != self.call:
            self._seen, self._since, self._since_cpu = self.call, now, cpu
        elif cpu - self._since_cpu >= self.LONGEST_CPU_NS or now - self._since >= self.LONGEST_NS:
            self.active = False
            raise HookHangs(f"it has not returned for {(now - self._since) / 1e6:.0f} ms")


WATCH = HookWatch()
"""Of this process; it watches once it was started."""


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
            self.behaviour = kind(device)
        except Exception as error:  # whatever a behaviour raises
            raise OptionError((("behaviour",), f"{_place_of(error, kind)}: {_said(error)}")) from error
        if _overrides(kind, "on_outputs"):
            self._steps = self.behaviour.on_outputs
        for found in device.objects:
            for entry in found.entries.values():
                if _overrides(kind, "on_sdo_read"):
                    entry.on_read = self._read
                if _overrides(kind, "on_sdo_write") and entry.on_write is None:
                    entry.on_write = self._write
        self.start()

    @property
    def keeps_outputs(self) -> bool:
        """Whether outputs keep their values when they become invalid."""
        return self.behaviour.keeps_outputs

    def start(self) -> None:
        """Power has come on."""
        self._broken = False
        self._try("on_start", self.behaviour.on_start)

    def step(self, dt: float) -> None:
        """Let `dt` seconds pass."""
        steps = self._steps
        if steps is None or self._broken:
            return
        try:
            WATCH.call += 1
            WATCH.active = True
            steps(dt)
        except BaseException as error:  # whatever a behaviour raises, and HookHangs
            self.fail("on_outputs", error)
        finally:
            WATCH.active = False

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
        with self._guarded("on_file", (FileBusy, FileRefused)):
            self.behaviour.on_file(name, data)

    def read_file(self, name: str) -> bytes | None:
        """Return a file, None where there is none; raises as `on_file`."""
        with self._guarded("read_file", (FileBusy, FileRefused)):
            return self.behaviour.read_file(name)

    def _try(self, hook: str, call: Callable[..., object], *arguments: object) -> None:
        """Call a hook whose failure takes the slave out of OP."""
        try:
            with self._guarded(hook):
                call(*arguments)
        except HookFailed:
            self._device.failure = UNSPECIFIED_ERROR
            self._broken = True

    def _read(self, entry: Entry) -> None:
        try:
            with self._guarded("on_sdo_read", (SdoAbort,)):
                value = self.behaviour.on_sdo_read(entry.index, entry.subindex)
                if value is not None:
                    set_value(entry, value)
        except HookFailed:
            raise SdoAbort(GENERAL_ERROR) from None

    def _write(self, entry: Entry, value: Value) -> None:
        try:
            with self._guarded("on_sdo_write", (SdoAbort,)):
                self.behaviour.on_sdo_write(entry.index, entry.subindex, value)
        except HookFailed:
            raise SdoAbort(GENERAL_ERROR) from None

    @contextmanager
    def _guarded(self, hook: str, allowed: tuple[type[Exception], ...] = ()) -> Iterator[None]:
        """Let a hook raise what is `allowed`; report anything else and raise HookFailed."""
        try:
            WATCH.call += 1
            WATCH.active = True
            yield
        except allowed:
            raise
        except BaseException as error:  # whatever a behaviour raises, and HookHangs
            self._tell(hook, error)
            raise HookFailed from None
        finally:
            WATCH.active = False

    def fail(self, hook: str, error: BaseException) -> None:
        """Take the slave out of OP for a failure, and report that."""
        self._broken = True
        self._device.failure = UNSPECIFIED_ERROR
        self._tell(hook, error)

    def _tell(self, hook: str, error: BaseException) -> None:
        sentence = f"{self.place}: {hook} failed at {_place_of(error, type(self.behaviour))}: {_said(error)}"
        if sentence not in self._told and len(self._told) < _MOST_SENTENCES:
            self._told.add(sentence)
            self.report(sentence)


_MOST_SENTENCES = 20
"""Different failures of a behaviour that are reported."""


def _overrides(kind: type[Behaviour], hook: str) -> bool:
    return getattr(kind, hook) is not getattr(Behaviour, hook)


def _said(error: BaseException) -> str:
    if isinstance(error, HookHangs):
        return str(error)
    return f"{type(error).__name__}: {error}" if str(error) else type(error).__name__


def _place_of(error: BaseException, kind: type) -> str:
    """Return file and line of an error: the innermost line of the behaviour's own file, else of all."""
    try:
        own = inspect.getsourcefile(kind)
    except TypeError:
        own = None
    frames = traceback.extract_tb(error.__traceback__)
    places = [f"{frame.filename}:{frame.lineno}" for frame in frames]
    return next((place for place in reversed(places) if own and place.startswith(f"{own}:")), (places or ["?"])[-1])


def find_behaviour(name: str) -> type[Behaviour]:
    """Return the behaviour of a name of `BUILT_IN`, or of `module:Class`.

    Raises:
        OptionError: there is none, or it cannot be loaded.
    """
    target = BUILT_IN.get(name, name)
    if ":" not in target:
        text = f'found the text "{name}", allowed is one of {", ".join(BUILT_IN)}, or module:Class'
        raise OptionError((("behaviour",), text))
    try:
        return load_class(EntryPoint(name, target, "behaviour"), Behaviour)
    except PluginError as error:
        raise OptionError((("behaviour",), str(error))) from error
