"""A visit: a session brings the arm to a chosen place, and sends commands there one after another.

The places and the commands follow from the number of the session, so that consecutive sessions spread over all of them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import inf
from random import Random
from typing import Protocol

from rtcp.ipc import commands
from rtcp.ipc.commands import Command
from rtcp.ipc.states import ControlMode, State
from rtcp.testing.sessions.commander import Commander
from rtcp.testing.sessions.coverage import Place

COMMANDS_STRIDE = 7
"""Distance between the first commands of two visits of the same place, in the list of all commands."""
MOST_COMMANDS, MOST_APPROACHES = 12, 4
"""Commands of a visit, and times that the arm is brought to the place again after it left."""
_SAG_S = 0.3
_LASTING = frozenset({
    State.READY, State.HOLDING, State.MOVING, State.STOPPED_BY_LIMIT, State.FAULT, State.EMERGENCY_STOP, State.HOMING
})  # fmt: skip
"""States that the machine does not leave by itself, or not soon."""
_ALL_BUTTONS = (1, 2, 4, 8)
_MOTIONS: dict[ControlMode, tuple[type[Command], ...]] = {
    ControlMode.JOINT: (
        commands.MoveJoints, commands.Jog, commands.RunTrajectory, commands.StreamPosition, commands.OpenStream,
        commands.RunLines, commands.RunInStep,
    ),
    ControlMode.VELOCITY: (commands.MoveAtVelocity,),
    ControlMode.TORQUE: (commands.ApplyTorque, commands.Guide),
}  # fmt: skip
_MOTIONS[ControlMode.CARTESIAN] = _MOTIONS[ControlMode.JOINT]


def place_of(number: int, places: Sequence[Place]) -> tuple[Place, int]:
    """Return the place that the session of a number visits, and how many sessions visited it before."""
    # Neighbours in the list differ little: consecutive sessions are to differ much.
    mixed = list(places)
    Random(0).shuffle(mixed)
    round_, at = divmod(number, len(mixed))
    return mixed[at], round_


class Visitor(Protocol):
    """What a visit needs of its session."""

    commander: Commander
    random: Random
    joints: int

    def cycles(self, seconds: float) -> int:
        """Return the number of cycles in this time."""

    def send_likely(self, kind: type[Command]) -> None:
        """Send a command of a kind."""

    def hurry(self) -> None:
        """Run a trajectory that is far too quick for the limits of the joints."""


class Visit:
    """One visit of a session.

    Args:
        session: whose arm it is.
        place: the wanted place; the arm has been started in its modes.
        round_: how many sessions visited the place before.
    """

    def __init__(self, session: Visitor, place: Place, round_: int) -> None:
        self._session, self._place, self._round = session, place, round_
        self._commander = session.commander
        self._next, self._left = round_ * COMMANDS_STRIDE, MOST_COMMANDS
        """Number of the next command, and how many are left to send."""
        self._shuts_down = False
        """Whether it is the turn of a shutdown, which is sent at the end of the session."""
        self._end_s = inf
        self._approaches: dict[State, Callable[[], object]] = {
            State.READY: self._to_ready,
            State.ENABLING: self._to_enabling,
            State.HOLDING: self._to_holding,
            State.MOVING: self._to_moving,
            State.STOPPING: lambda: self._from_motion(commands.Halt()),
            State.DISABLING: lambda: self._from_motion(commands.Disable()),
            State.CLOSING: lambda: self._from_motion(commands.Shutdown()),
            State.STOPPED_BY_LIMIT: self._to_limit,
            State.FAULT: self._to_fault,
            State.RESETTING: self._to_resetting,
            State.EMERGENCY_STOP: self._to_emergency_stop,
            State.HOMING: self._to_homing,
        }

    def run(self, seconds: float) -> None:
        """Start the arm and send commands at the place, at most until it has run for `seconds` of simulated time."""
        commander, state = self._commander, self._place.state
        self._end_s = seconds
        if state is State.STARTING:
            commander.simulation.acquire()
            self._send_here()
            commander.start()
            return
        commander.start()
        if state is State.CLOSING:
            return
        for _ in range(MOST_APPROACHES):
            self._approaches[state]()
            self._send_here()
            if not self._left or self._over:
                break
        if state is State.EMERGENCY_STOP:
            commander.press(False)

    def end(self) -> None:
        """End the session if the visit has to: by a shutdown at the place, or by one that leads to it."""
        commander, state = self._commander, self._place.state
        self._end_s = inf
        if self._over or not (self._shuts_down or state is State.CLOSING):
            return
        # Random actions may have changed the modes.
        commander.send(commands.Halt())
        self._until(State.HOLDING, 0.5)
        self._to_holding()
        self._approaches[state]()
        if state is State.CLOSING:
            self._send_here()
        elif commander.place == self._place:
            commander.send(commands.Shutdown())

    def _send_here(self) -> None:
        """Send the next commands while the arm is at the place."""
        commander, kinds = self._commander, self._commander.kinds
        while self._left and commander.place == self._place and not self._over:
            kind = kinds[self._next % len(kinds)]
            if kind is commands.Shutdown and self._place.state not in (State.STARTING, State.CLOSING):
                self._shuts_down = True
            else:
                self._session.send_likely(kind)
            self._next += 1
            self._left -= 1

    @property
    def _over(self) -> bool:
        commander = self._commander
        return commander.simulation.done or bool(commander.checker.violations) or commander.seconds >= self._end_s

    def _until(self, state: State, seconds: float) -> None:
        self._commander.simulation.until(lambda: self._commander.state is state or self._over, seconds)

    # -- approaches -------------------------------------------------------------------------------------------------

    def _to_ready(self) -> None:
        commander = self._commander
        if commander.state is State.FAULT:
            commander.send(commands.Reset())
        elif commander.state is not State.READY:
            commander.send(commands.Disable())
        self._until(State.READY, 1.0)

    def _to_enabling(self) -> None:
        self._to_ready()
        self._commander.send(commands.Enable())

    def _to_holding(self) -> None:
        commander, place = self._commander, self._place
        commander.simulation.until(lambda: commander.state in _LASTING or self._over, 0.5)
        commander.enable()
        self._until(State.HOLDING, 1.0)
        if commander.place.control_mode is not place.control_mode:
            commander.send(commands.SetControlMode(place.control_mode))
        if commander.place.drive_mode is not place.drive_mode:
            commander.send(commands.SetDriveMode(place.drive_mode))
        machine = commander.simulation.loop.machine
        commander.simulation.until(lambda: not machine.changing_mode, 0.3)

    def _to_moving(self) -> None:
        session, mode = self._session, self._place.control_mode
        if self._commander.state is not State.MOVING:
            self._to_holding()
        if mode is ControlMode.TORQUE:
            # A torque motion begins only when the joints, which sag a little, stand still.
            self._commander.wait(session.cycles(_SAG_S))
        if mode is ControlMode.JOYSTICK:
            for button in _ALL_BUTTONS:
                self._commander.joystick(0)
                self._commander.wait(session.cycles(0.02))
                self._commander.joystick(button)
                self._until(State.MOVING, 0.05)
                if self._commander.state is State.MOVING:
                    return
            return
        motions = [kind for kind in _MOTIONS[mode] if kind in self._commander.simulation.loop.arm.controllers]
        motions += [kind for kind in self._commander.kinds if kind.__module__ != Command.__module__
                    and issubclass(kind, commands.MotionCommand)]  # fmt: skip
        for number in range(len(motions)):
            session.send_likely(motions[(self._round + number) % len(motions)])
            if self._commander.state is State.MOVING:
                return

    def _from_motion(self, command: Command) -> None:
        self._to_moving()
        self._commander.wait(self._session.cycles(0.15))
        self._commander.send(command)

    def _to_limit(self) -> None:
        self._to_holding()
        self._session.hurry()
        self._until(State.STOPPED_BY_LIMIT, 0.3)

    def _to_fault(self) -> None:
        session = self._session
        self._to_holding()
        self._commander.fault(session.random.randrange(session.joints), 0x3210)
        self._until(State.FAULT, 0.3)

    def _to_resetting(self) -> None:
        self._to_fault()
        self._commander.wait(self._session.cycles(0.2))
        self._commander.send(commands.Reset())

    def _to_emergency_stop(self) -> None:
        self._to_holding()
        self._commander.press(True)
        self._until(State.EMERGENCY_STOP, 0.1)

    def _to_homing(self) -> None:
        self._to_holding()
        self._commander.send(commands.Home(self._session.random.randrange(self._session.joints)))
