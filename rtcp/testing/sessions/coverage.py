"""The coverage of simulated sessions: which commands were sent where, which events and refusals occurred.

A row is a command in a machine state, a control mode and a drive mode, a command during the motion of a controller, an
event, or a refusal. `rows_of` returns the rows that sessions of an arm have to fill. `NOT_REACHED` lists what they
cannot reach, with the reasons.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

from rtcp.config.model import MODE_CHANNELS, ArmConfig
from rtcp.ipc import events, refusals
from rtcp.ipc.commands import COMMANDS, Command
from rtcp.ipc.events import EVENTS, Event
from rtcp.ipc.refusals import REFUSALS, Refusal
from rtcp.ipc.states import ControlMode, DriveMode, State
from rtcp.testing.simulation import Simulation

PLATFORM_COMMANDS = tuple(
    sorted((kind for kind in COMMANDS if kind.__module__ == Command.__module__), key=lambda kind: kind.name)
)
"""All commands of the platform; other packages may register their own."""


def commands_of(simulation: Simulation) -> list[type[Command]]:
    """Return the commands of an arm by name: those of the platform, and those of its processes and controllers."""
    loop = simulation.loop
    kinds = {*PLATFORM_COMMANDS, *loop.arm.controllers}
    for part in loop.parts:
        kinds.update(part.commands)
    return sorted(kinds, key=lambda kind: kind.name)


class NotReached(NamedTuple):
    """Events and refusals that simulated sessions do not reach."""

    reason: str
    kinds: tuple[type[Event] | type[Refusal], ...]
    when: Callable[[ArmConfig], bool] = lambda config: True
    """Configurations of which that is so."""


def _has_arm(config: ArmConfig) -> bool:
    return bool(config.joints)


def _has_geometry(config: ArmConfig) -> bool:
    return config.arm is not None


def _no_geometry(config: ArmConfig) -> bool:
    return config.arm is None


def _no_joystick(config: ArmConfig) -> bool:
    return config.arm is None or config.inputs.joystick is None


def _no_emergency_stop(config: ArmConfig) -> bool:
    return config.inputs.emergency_stop is None


def _boxes(config: ArmConfig) -> int:
    return sum(slave.device.kind == "io" for slave in config.slaves)


NOT_REACHED: tuple[NotReached, ...] = (
    NotReached("simulated time stands still during a cycle", (events.PluginSlow,)),
    NotReached(
        "the loop of a session follows no reference clock, so that its start takes less time",
        (
            events.ClockLocked,
            events.ClockUnlocked,
            events.ClockLost,
            refusals.ClockNotLocked,
            refusals.FaultFollows,
        ),
    ),
    NotReached(
        "only the thread that supervises a real bus reports this",
        (
            events.SlavesBackInOp,
            events.NoSlaveAnswers,
            events.SlavesAnswerAgain,
            events.OtherMaster,
            events.StateNotReached,
            events.OtherSlaveAnswers,
            events.SlaveSetUpAgain,
            events.DamagedFrames,
            events.LinkLost,
            events.ErrorReported,
            events.MessagesLeftOut,
        ),
    ),
    NotReached(
        "only a robot behind a controller of its own reports this",
        (events.WaitingForRobot, events.RobotReady, events.ResetWithoutController, refusals.DriveNotReady),
    ),
    NotReached(
        "the arm of a session has no partner in a cell",
        (
            events.PartnerEmergencyStop,
            events.PushedNearPartner,
            events.PartnerStopUnread,
            events.PartnerNotReady,
            events.PartnerStopped,
            events.PartnerLeft,
            events.PartnerSilent,
            events.PartnerNear,
            events.PartnerForeign,
            refusals.PartnerMissing,
            refusals.PartnerOfAnotherCell,
            refusals.PartnerStopPressed,
            refusals.PartnerStopUnread,
            refusals.LimitsTooNearPartner,
        ),
    ),
    NotReached("no cycle of a session is late", (events.OutOfStep,)),
    NotReached(
        "only a plug-in that raises an error causes this",
        (
            events.DriverFailed,
            events.ProcessFailed,
            events.ControllerRaised,
            refusals.DriverRaised,
            refusals.ProcessRaised,
            refusals.ControllerRaised,
        ),
    ),
    NotReached(
        "the trajectory generator refuses no input that has passed the checks",
        (events.GeneratorFailed, events.ControllerFailed, refusals.ApproachImpossible),
    ),
    NotReached(
        "the virtual drives and brakes stop a joint in time", (events.ResetWhileMoving, events.HomingStillMoving)
    ),
    NotReached(
        "takes 2 s or 3 s, as long as a session, or longer",
        (
            events.EnableTimeout,
            events.DisableTimeout,
            events.ResetTimeout,
            events.ResetWithoutSlaves,
            events.ResetWithoutFrames,
            events.EstopUnobservable,
            events.NotSettled,
        ),
    ),
    NotReached(
        "the virtual drives home where they stand, and do not fail", (events.HomingFailed, events.HomedElsewhere)
    ),
    NotReached("the hands of a session are too weak to guide the tool so fast", (events.GuidedTooFast,)),
    NotReached("a spherical wrist has joint positions for each pose in reach", (events.NoSolution,)),
    NotReached(
        "the machine leaves the state ready in the cycle in which a slave is known to be lost", (refusals.NotInOp,)
    ),
    NotReached("the bus of a session is not a real one", (refusals.NoEnablingSwitch,)),
    NotReached("this arm has joints", (refusals.NoArm,), _has_arm),
    NotReached("the geometry of this arm is known", (refusals.NoGeometry,), _has_geometry),
    NotReached(
        "the masses of this arm are known",
        (refusals.MassesUnknown,),
        lambda config: config.arm is not None and bool(config.arm.links),
    ),
    NotReached(
        "the drives of this arm have all modes",
        (refusals.DriveModeUnsupported,),
        lambda config: len(drive_modes(config)) == len(DriveMode),
    ),
    NotReached(
        "the drives of this arm have homing", (refusals.HomingUnsupported,), lambda config: len(drive_modes(config)) > 1
    ),
    NotReached("this arm has a gripper", (refusals.NoGripper,), lambda config: config.gripper is not None),
    NotReached(
        "this arm has no gripper", (events.GripperOpens, events.GripperCloses), lambda config: config.gripper is None
    ),
    NotReached(
        "no drive moves the gripper of this arm",
        (events.GripperAtRest, refusals.GripperDisabled),
        lambda config: config.gripper is None or config.gripper.joint is None,
    ),
    NotReached(
        "this arm has one tool", (events.ToolChanged, refusals.ToolInBox), lambda config: len(config.models) < 2
    ),
    NotReached("this arm has an IO box", (refusals.NoOutputs,), lambda config: _boxes(config) > 0),
    NotReached(
        "this arm has no IO box",
        (refusals.UnknownBox, refusals.UnknownOutput, refusals.ReservedOutput),
        lambda config: _boxes(config) == 0,
    ),
    NotReached(
        "no slave of this arm has channels that can be set",
        (refusals.ChannelOutOfRange,),
        lambda config: all(slave.device.kind in ("cia402", "io") for slave in config.slaves),
    ),
    NotReached(
        "this arm has no emergency stop",
        (events.EmergencyStopActivated, refusals.EmergencyStopPressed),
        _no_emergency_stop,
    ),
    NotReached(
        "this arm has no IO box for an enabling switch",
        (events.PermissionWithdrawn, refusals.NotPermitted),
        _no_emergency_stop,
    ),
    NotReached(
        "this arm has no joystick",
        (events.JoystickGranted, events.JoystickWithdrawn, events.JoystickModeChanged, events.UnknownJoystickCode),
        _no_joystick,
    ),
    NotReached(
        "the stick of this arm is not analog",
        (events.JoystickOutOfRange,),
        lambda config: config.inputs.joystick is None or config.inputs.joystick.analog is None,
    ),
    NotReached(
        "the geometry of this arm is unknown",
        (
            events.EnabledInBox,
            events.HomingInBox,
            events.PushedNear,
            events.OutOfReach,
            events.SingularityReached,
            events.BoxReached,
            events.NotLeavingBox,
            events.CollisionAhead,
            refusals.TargetInBox,
            refusals.PathStartsElsewhere,
            refusals.LimitsExcludeArm,
            refusals.WeightDiffers,
            refusals.DurationOutOfRange,
            refusals.JogSpeedOutOfRange,
        ),
        _no_geometry,
    ),
)
"""All that is left out of the rows."""

# -- where a command can be sent --------------------------------------------------------------------------------------


class Place(NamedTuple):
    """Where a command arrives: the machine's state and the modes."""

    state: State
    control_mode: ControlMode
    drive_mode: DriveMode
    """Mode in which the drives hold; they are enabled and homed in CSP."""

    def __str__(self) -> str:
        return " ".join(part.name.lower() for part in self)


_FIXED = {ControlMode.VELOCITY: DriveMode.CSV, ControlMode.TORQUE: DriveMode.CST}
"""Drive modes that control modes set."""


def drive_modes(config: ArmConfig) -> list[DriveMode]:
    """Return the drive modes that the process data of all joints have."""
    devices = {slave.name: slave.device for slave in config.slaves}
    images = [devices[joint.slave].of_axis(joint.axis) for joint in config.joints]
    mapped = [({c.name for c in image.outputs}, {c.name for c in image.inputs}) for image in images]
    return [
        DriveMode[mode.upper()]
        for mode, needed in MODE_CHANNELS.items()
        if all(outputs.issuperset(needed[0]) and inputs.issuperset(needed[1]) for outputs, inputs in mapped)
    ]


def places_of(config: ArmConfig) -> list[Place]:
    """Return all places of an arm.

    Without an IO box there is no emergency stop, and without geometry there are no Cartesian modes. Only planned
    motions stop by a limit; jogs, speeds and torques that end at a limit leave the arm holding.
    """
    cartesian = (ControlMode.CARTESIAN, ControlMode.JOYSTICK)
    found = []
    for control in ControlMode:
        if control in cartesian and config.arm is None:
            continue
        for drive in drive_modes(config):
            if _FIXED.get(control, drive) is not drive:
                continue
            for state in State:
                planned = control in (ControlMode.JOINT, ControlMode.CARTESIAN)
                if state is State.OFF or (state is State.STOPPED_BY_LIMIT and not planned):
                    continue
                if state is State.HOMING and not (planned and drive is DriveMode.CSP):
                    continue
                if state is State.EMERGENCY_STOP and config.inputs.emergency_stop is None:
                    continue
                found.append(Place(state, control, drive))
    return found


# -- counts -----------------------------------------------------------------------------------------------------------


@dataclass
class Coverage:
    """Counts of one session, or of many."""

    sent: Counter[str] = field(default_factory=Counter)
    """Command and place, as "halt moving joint csp"."""
    accepted: Counter[str] = field(default_factory=Counter)
    under_way: Counter[str] = field(default_factory=Counter)
    """Command and the controller whose motion was under way, as "halt during jog"."""
    events: Counter[str] = field(default_factory=Counter)
    refusals: Counter[str] = field(default_factory=Counter)

    def command(self, name: str, place: Place, controller: str, refusal: Refusal | None) -> None:
        """Count a command; `controller`: whose motion is under way, or empty."""
        key = f"{name} {place}"
        self.sent[key] += 1
        if controller:
            self.under_way[f"{name} during {controller}"] += 1
        if refusal is None:
            self.accepted[key] += 1
        else:
            self.refusals[refusal.name] += 1

    def add(self, other: Coverage) -> None:
        """Add another's counts."""
        for name, counts in vars(other).items():
            getattr(self, name).update(counts)

    def as_dict(self) -> dict[str, dict[str, int]]:
        """Return the counts for JSON, in the order of the names."""
        return {name: dict(sorted(counts.items())) for name, counts in vars(self).items()}

    def as_json(self) -> str:
        """Return the counts as compact JSON."""
        return json.dumps(self.as_dict(), separators=(",", ":"))

    @classmethod
    def from_json(cls, text: str) -> Coverage:
        """Return the counts of `as_json`; those of a session without any are empty."""
        return cls(**{name: Counter(counts) for name, counts in json.loads(text or "{}").items()})

    def empty(self, rows: Coverage) -> list[str]:
        """Return the names of the rows that have no count, by the sections of the table."""
        return [
            f"{section}: {name}"
            for section, wanted in vars(rows).items()
            for name in wanted
            if not getattr(self, section)[name]
        ]


def by_state(coverage: Coverage) -> dict[str, dict[State, int]]:
    """Return how often each command was sent in each state: the modes are summed."""
    found: dict[str, dict[State, int]] = {}
    for key, count in coverage.sent.items():
        command, state, *_ = key.split()
        row = found.setdefault(command, {})
        row[State[state.upper()]] = row.get(State[state.upper()], 0) + count
    return dict(sorted(found.items()))


def rows_of(simulation: Simulation) -> Coverage:
    """Return the rows that sessions of an arm have to fill, each with the count 0."""
    commands = [kind.name for kind in commands_of(simulation)]
    config = simulation.config
    places = places_of(config)
    out_of_reach = {kind for entry in NOT_REACHED if entry.when(config) for kind in entry.kinds}
    controllers = {controller.name for controller in simulation.loop.arm.controllers.values()}
    return Coverage(
        sent=_zeros(f"{command} {place}" for command in commands for place in places),
        under_way=_zeros(f"{command} during {name}" for command in commands for name in sorted(controllers)),
        events=_zeros(kind.name for kind in EVENTS if kind not in out_of_reach and kind.__module__ == Event.__module__),
        refusals=_zeros(
            kind.name for kind in REFUSALS if kind not in out_of_reach and kind.__module__ == Refusal.__module__
        ),
    )


def _zeros(names: Iterator[str]) -> Counter[str]:
    return Counter(dict.fromkeys(names, 0))
