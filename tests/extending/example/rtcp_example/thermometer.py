"""The driver of a terminal with two temperature channels, a command that is no motion, and two events."""

from rtcp.devices import Driver
from rtcp.ipc.commands import CALM, Command
from rtcp.ipc.events import Event, FaultEvent
from rtcp.ipc.refusals import Refusal
from rtcp.ipc.states import State


class SetAlarm(Command):
    """Report when the second channel is warmer than `kelvin`; a fault 10 K above that."""

    states = CALM
    kelvin: float


class AlarmTooLow(Refusal):
    """an alarm at {kelvin:.6g} K would be active at once: the second channel has {second:.6g} K"""

    kelvin: float
    second: float


class Warm(Event, number=1001):
    """the second channel has {kelvin:.6g} K"""

    kelvin: float


class Overheated(FaultEvent, number=1002):
    """the second channel has {kelvin:.6g} K, more than 10 K above the alarm"""

    kelvin: float


class Thermometer(Driver):
    """Temperatures of both channels in `values`, K; they are in every record as SLAVE_first and SLAVE_second."""

    REQUIRED_INPUTS = ("first", "second")
    commands = (SetAlarm,)
    alarm, warm = float("inf"), False

    def accept(self, command: Command) -> Refusal | None:
        assert isinstance(command, SetAlarm)
        second = self.values["second"]
        if not command.kelvin > second:
            return AlarmTooLow(command.kelvin, second)
        self.alarm, self.warm = command.kelvin, False
        return None

    def update(self, state: State, now_ns: int) -> Event | None:
        kelvin = self.values["second"]
        if kelvin > self.alarm + 10.0:
            self.alarm = float("inf")
            return Overheated(kelvin)
        if kelvin > self.alarm and not self.warm:
            self.warm = True
            return Warm(kelvin)
        return None
