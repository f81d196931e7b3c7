"""Parts of a cycle, each with its inputs, its outputs and its fields of the cycle record.

send -> receive -> each part's `decode` -> command -> machine -> each part's `update` and `encode` -> each part's
`publish`. A new part is one class. A part never switches itself on: the machine decides, and calls `safe` of all parts
when their outputs have to be safe.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

from mypy_extensions import mypyc_attr

from rtcp.config.find import is_foreign, plugin_error
from rtcp.config.model import ArmConfig
from rtcp.devices.drive import Drive
from rtcp.devices.driver import Driver, make_driver
from rtcp.fieldbus.bus import ProcessData
from rtcp.ipc.commands import Command
from rtcp.ipc.events import DriverFailed, Event, MotionEnded, PluginSlow
from rtcp.ipc.message import PAYLOAD_SIZE
from rtcp.ipc.refusals import DriverRaised, Refusal
from rtcp.ipc.schema import Field, device_field
from rtcp.ipc.states import State

_SLOW_AGAIN_NS: Final = 10_000_000_000
_PAYLOAD: Final = bytearray(PAYLOAD_SIZE)
"""Where messages of plug-ins are packed before the cycle uses them."""


def checked_refusal(refusal: object) -> Refusal | None:
    """Return what `accept` of a plug-in has returned.

    Raises:
        TypeError: it is neither a refusal nor None; or another exception, where a field is not of its type.
    """
    if refusal is None:
        return None
    if not isinstance(refusal, Refusal):
        raise TypeError(f"accept returned {refusal!r:.80}, allowed is a Refusal or None")
    try:
        refusal.pack_into(_PAYLOAD, 0)
    except struct.error:
        pass  # it repeats a number of the command that is too large: the command is malformed
    return refusal


def checked_event(event: object) -> Event:
    """Return an event of a plug-in.

    Raises:
        TypeError: it is no event, or one that ends a motion; or another exception, where a field is not of its type.
    """
    if not isinstance(event, Event):
        raise TypeError(f"found {event!r:.80}, allowed is an event or None")
    if isinstance(event, MotionEnded):
        raise TypeError(f"a part ends no motion: {event.name}")
    event.pack_into(_PAYLOAD, 0)
    return event


class PublishedValues:
    """The values that a plug-in publishes, checked before they enter the record.

    Args:
        fields: of the plug-in.
    """

    def __init__(self, fields: Sequence[Field]) -> None:
        form = struct.Struct("<" + "".join(field.code for field in fields))
        self._pack, self._memory = form.pack_into, bytearray(form.size)
        self.count = sum(field.count for field in fields)
        self.values: list[Any] = [0] * self.count
        """Written by `publish` of the plug-in, from index 0 on."""

    def check(self) -> None:
        """Raise an exception unless the record can hold the values."""
        if len(self.values) != self.count:
            found = len(self.values)
            self.values[:] = [0] * self.count
            raise ValueError(f"publish wrote {found} values, its fields are {self.count}")
        self._pack(self._memory, 0, *self.values)


class PluginTimer:
    """Names each plug-in that takes more than half a period in one call, at most once in `_SLOW_AGAIN_NS`.

    Args:
        now: clock, ns.
        period_ns: period of the cycle, ns.
        report: publishes an event.
    """

    def __init__(self, now: Callable[[], int], period_ns: int, report: Callable[[Event], None]) -> None:
        self.now = now
        self._allowed_ns = period_ns // 2
        self._report = report
        self._again: dict[str, int] = {}
        """Plug-in that was named -> instant from which on it is named again, ns."""

    def check(self, plugin: str, began: int) -> None:
        """Name a plug-in whose call began at the instant `began`, ns, if it took too long."""
        now = self.now()
        took = now - began
        if took > self._allowed_ns and now >= self._again.get(plugin, now):
            self._again[plugin] = now + _SLOW_AGAIN_NS
            self._report(PluginSlow(plugin, took * 1e-3, self._allowed_ns * 1e-3))


class PartContext:
    """A part's view of its cycle; `rtcp.control.context.Context` implements it.

    Args:
        period_s: period of the cycle, s.
    """

    def __init__(self, period_s: float) -> None:
        self.period_s = period_s
        self.state = State.STARTING
        """State of the machine; only the machine writes it."""
        self.cycle = 0
        self.now_ns = 0
        """Instant of the cycle, ns of the clock of the loop."""
        self.good = False
        """Whether this cycle had the expected working counter."""
        self.all_enabled = False
        """Whether all drives are in Operation Enabled."""
        self.reported: Event | None = None
        """Fault that a part has reported; the machine handles it in the next cycle."""
        self._dropped = 0

    def publish(self, event: Event) -> None:
        """Report an event that changes no state."""
        raise NotImplementedError

    def lease_held(self, lease: int) -> bool:
        """Return whether `lease` is current and not expired."""
        raise NotImplementedError

    def explain(self, subject: str, error: BaseException) -> None:
        """Let the thread beside the cycle report an exception raised by `subject`."""
        raise NotImplementedError

    def report(self, event: Event) -> None:
        """Report an event of a part; a fault stops the arm in the next cycle, of several faults the hardest.

        Raises:
            TypeError: it is no event that a part may report (`checked_event`).
        """
        checked_event(event)
        if not event.is_fault:
            self.publish(event)
        elif self.reported is None:
            self.reported = event
        elif event.is_emergency and not self.reported.is_emergency:
            self.publish(self.reported)
            self.reported = event
        else:
            self.publish(event)

    def drop_reported(self, fault: int) -> None:
        """Forget a reported fault that ended no state; publish it once, unless it is of the present `fault`'s kind."""
        event, self.reported = self.reported, None
        number = 0 if event is None else event.number
        if event is not None and number not in (fault, self._dropped):
            self.publish(event)
        self._dropped = number


@mypyc_attr(allow_interpreted_subclasses=True)
class Part:
    """Base of all parts of the cycle.

    Args:
        name: unique in the platform; a device has the name of its slave.
        fields: fields of the record, in the order in which `publish` writes them.
        commands: classes of the commands, without motions, that `accept` handles.
    """

    def __init__(
        self, name: str, fields: Sequence[Field] = (), commands: Sequence[type[Command]] = ()
    ) -> None:  # fmt: skip
        self.name = name
        self.fields = tuple(fields)
        self.commands = tuple(commands)
        self.at = 0
        """Index of its first value in a record; set with the layout of the record."""
        self.is_timed = False
        """Whether the cycle measures its time: code of another package runs in it."""

    def decode(self, data: ProcessData) -> None:
        """Read the inputs of a cycle in which every slave took part."""

    def accept(self, command: Command, lease: int) -> Refusal | None:
        """Carry out one of `commands`, or return its refusal without any change."""
        raise NotImplementedError

    def update(self, context: PartContext) -> None:
        """Compute the outputs of the cycle; called after the machine."""

    def encode(self, data: ProcessData) -> None:
        """Write the outputs of the cycle."""

    def publish(self, values: list[Any]) -> None:
        """Write the values of `fields` into the record, from index `at` on."""

    def safe(self) -> None:
        """Set the outputs to their safe state; the machine calls it on a fault, on stale inputs and at the end."""


class Device(Part):
    """A slave that is no drive, with its driver, possibly of another package.

    An exception of the driver, or a wrong result, is a fault of that slave and does not end the cycle: the driver is
    not called any more, and its outputs are safe, until the machine is ready again.

    Args:
        slot: index of the slave.
        driver: driver of the slave.
    """

    def __init__(self, slot: int, driver: Driver) -> None:
        super().__init__(driver.name, [device_field(driver.name, field) for field in driver.fields()], driver.commands)
        self.slot = slot
        self.driver = driver
        self._stays_safe = False
        self._failed = False
        self._error: BaseException | None = None
        self._published = PublishedValues(self.fields)
        self._size = len(driver.safe_outputs)
        self._inputs = tuple(driver.values)
        self.is_timed = is_foreign(driver)

    def _fail(self, error: BaseException) -> None:
        self._failed, self._error = True, plugin_error(error)

    def decode(self, data: ProcessData) -> None:
        """Read the inputs of the slave."""
        try:
            if not self._failed:
                self.driver.decode(data.input(self.slot))
                if self.is_timed:
                    self._check_values()
        except BaseException as error:
            self._fail(error)

    def _check_values(self) -> None:
        """Raise an error where a driver of another package left a value that is no number: the joystick reads them."""
        values: Mapping[str, object] = self.driver.values
        for name in self._inputs:
            value = values[name]
            if not isinstance(value, int | float):
                raise TypeError(f"values[{name!r}] is {value!r:.80}, allowed is a number")

    def accept(self, command: Command, lease: int) -> Refusal | None:
        """Let the driver carry out the command."""
        try:
            return DriverRaised(self.slot + 1) if self._failed else checked_refusal(self.driver.accept(command))
        except BaseException as error:
            self._fail(error)
            return DriverRaised(self.slot + 1)

    def set_channel(self, name: str, value: float) -> Refusal | None:
        """Set an output channel of the driver, from this cycle's frame on."""
        if self._failed:
            return DriverRaised(self.slot + 1)
        self.driver.targets[name] = value
        return None

    def update(self, context: PartContext) -> None:
        """Update the driver; report its exception as a fault."""
        event = None
        try:
            if not self._failed:
                event = self.driver.update(context.state, context.now_ns)
                if event is not None:
                    checked_event(event)
            if self._stays_safe:
                # From the fault to the end of the reset, whatever the driver does meanwhile.
                self._stays_safe = context.state is not State.READY
                self._failed = self._failed and self._stays_safe
                if not self._failed:
                    self.driver.safe()
        except BaseException as error:
            self._fail(error)
        else:
            if event is not None:
                context.report(event)
        if self._error is not None:
            context.explain(f"driver of slave {self.name}", self._error)
            self._error = None
        if self._failed and not self._stays_safe:
            context.report(DriverFailed(self.slot + 1))

    def encode(self, data: ProcessData) -> None:
        """Write the outputs of the slave."""
        try:
            outputs = self.driver.safe_outputs if self._failed else self.driver.encode()
            if not isinstance(outputs, bytes) or len(outputs) != self._size:
                raise ValueError(f"encode returned {outputs!r:.80}, allowed are {self._size} bytes")
        except BaseException as error:
            self._fail(error)
            outputs = self.driver.safe_outputs
        data.set_output(self.slot, outputs)

    def publish(self, values: list[Any]) -> None:
        """Write the driver's values."""
        try:
            if not self._failed:
                published = self._published
                self.driver.publish(published.values, 0)
                published.check()
                values[self.at : self.at + published.count] = published.values
        except BaseException as error:
            self._fail(error)

    def safe(self) -> None:
        """Set the driver's outputs to their safe state until the machine is ready again."""
        self._stays_safe = True
        try:
            self.driver.safe()
        except BaseException as error:
            self._fail(error)


def make_devices(config: ArmConfig) -> list[Device]:
    """Return a part for each slave that is no drive; raises DeviceError."""
    period_s = config.cycle.period_us * 1e-6
    drivers = [(slot, make_driver(slave, period_s)) for slot, slave in enumerate(config.slaves)]
    return [Device(slot, driver) for slot, driver in drivers if not isinstance(driver, Drive)]
