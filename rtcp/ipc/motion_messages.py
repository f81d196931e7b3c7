"""Refusals and events of motion in words; `rtcp.ipc.messages` has those of the machine."""

from __future__ import annotations

from collections.abc import Callable

from rtcp.ipc.codes import Code, MotionMode, Reason, Refusal
from rtcp.ipc.naming import Matter, Naming, number
from rtcp.ipc.stops import Rung

Say = Callable[[Matter], str]
_SINGULARITIES = ("shoulder", "elbow", "wrist")
_SINGULAR_WORDS = (
    "the wrist over the shoulder's axis",
    "the elbow stretched or folded",
    "axes 4 and 6 of the wrist in one line",
)
_SINGULAR_UNITS = ("m", "rad", "rad")
STICK_MODES = ("X-Y", "Z-yaw", "roll-pitch", "gripper")


def motion_name(value: float) -> str:
    """Return the name of a motion mode."""
    return MotionMode(int(value)).name.lower() if value in tuple(MotionMode) else number(value)


def motion_refusals(names: Naming) -> dict[Refusal, Say]:
    """Return the sentences of refusals of motion."""
    file = names.file
    return {
        Refusal.MOTION: lambda m: (
            f"motion mode {number(m.value)} is unknown: "
            f"{', '.join(f'{mode.name.lower()} ({mode})' for mode in MotionMode)}"
        ),
        Refusal.OTHER_MOTION: lambda m: (
            f"the arm is in mode {motion_name(m.axis)}, and this command is one of mode {motion_name(m.value)}: "
            f"`rtcp mode {motion_name(m.value)}` first"
        ),
        Refusal.NO_GEOMETRY: lambda _: f"the arm's geometry is not known: the key kinematics is missing in {file}",
        Refusal.PRESSED: lambda _: (
            f"the emergency stop is pressed (inputs.emergency_stop in {file}): release it, then `rtcp reset`"
        ),
        Refusal.NOT_PERMITTED: lambda _: f"the enabling switch is not pressed (inputs.enabling_switch in {file})",
        Refusal.BAD_PLAN: lambda m: (
            f"the plan cannot be carried out: {number(m.value)} was found"
            + (f" in row {m.axis}" if m.axis >= 0 else f", at most {number(m.limit)} is allowed")
        ),
        Refusal.PLAN_START: lambda m: (
            (
                f"{names.joint(m.axis)}: the plan begins at {number(m.value)} rad, the arm is commanded to "
                f"{number(m.limit)} rad"
                if m.axis >= 0
                else f"the path begins {number(m.value)} (m or rad) away from where the tool is"
            )
            + ": move there first (`rtcp run --approach`)"
        ),
        Refusal.PLAN_SPEED: lambda m: (
            f"{names.joint(m.axis)}: the plan begins at time 0 with {number(m.value)} rad/s, the arm is commanded "
            f"{number(m.limit)} rad/s: give its first point a later time"
        ),
        Refusal.IMPEDANCE: lambda m: (
            f"{number(m.value)} of a joint's stiffness or damping is not allowed: a part from 0 to 1 of cst_stiffness "
            f"and cst_damping (joints[] in {file})"
        ),
        Refusal.GRIPPER_RESTS: lambda _: "the gripper's drive is not enabled: `rtcp enable` first",
        Refusal.JOG_FRAME: lambda m: f"frame {number(m.value)} is unknown: 0 base, 1 tool, 2 joints",
        Refusal.HOME_MODE: lambda _: "a drive is homed while the drives are in csp: `rtcp mode csp` first",
        Refusal.PLAN_LEAD: lambda _: "no way was found from where the arm is to the plan's first point",
        Refusal.PLAN_MOVING: lambda m: (
            f"a path begins at rest, and {names.joint(m.axis)} moves at {number(m.value)} rad/s: stop first"
        ),
        Refusal.TORQUE_LIMIT: lambda m: (
            f"{names.joint(m.axis)}: torque {number(m.value)} Nm is beyond its limit of {number(m.limit)} Nm "
            f"(joints[{m.axis}].torque in {file})"
        ),
        Refusal.HOLD_TIME: lambda m: (
            f"it is to count for {number(m.value)} s: allowed is more than 0 and at most {number(m.limit)} s"
        ),
        Refusal.LIMITS_OUTSIDE: lambda m: (
            f"{names.joint(m.axis)} stands or would come to rest at {m.value:.9g} rad, outside the new limit "
            f"{m.limit:.9g} rad: nothing was changed"
            if m.axis >= 0
            else f"the tool, the wrist or the elbow would pass the new bounds of {names.box(int(m.limit))}: "
            "nothing was changed"
        ),
        Refusal.LIMITS_WRONG: lambda m: (
            f"{names.joint(m.axis) if m.axis >= 0 else 'the Cartesian limits'}: {number(m.value)} is no limit that can "
            f"be set ({number(m.limit)} is its bound): nothing was changed"
        ),
        Refusal.LIMITS_NARROW: lambda m: (
            f"{names.joint(m.axis) if m.axis >= 0 else 'the Cartesian limits'}: {number(m.value)} is beyond what the "
            f"configuration allows, {number(m.limit)} (in {file}): limits are only narrowed while running"
        ),
        Refusal.LIMITS_WEAK: lambda m: (
            f"{names.joint(m.axis)} holds {number(m.value)} Nm, more than the new limit of {number(m.limit)} Nm: it "
            "would sag, nothing was changed"
        ),
        Refusal.NO_GRIPPER: lambda _: f"no gripper is configured (gripper in {file})",
        Refusal.MEANT: lambda m: (
            f"output {number(m.value)} has a meaning of its own (outputs and gripper in {file}): "
            "it is not switched by hand"
        ),
        Refusal.AXIS: lambda m: f"joint number {number(m.value)} does not exist: 0 to {number(m.limit - 1)}",
        Refusal.OFFSET: lambda m: (
            f"{names.joint(m.axis)}: offset {number(m.value)} rad is not allowed: {number(m.limit)} rad either way"
        ),
        Refusal.JOG_SPEED: lambda m: (
            f"{_DIRECTIONS[m.axis]}: {number(m.value)} {'m/s' if m.axis < 3 else 'rad/s'} is not allowed: at most "
            f"{number(m.limit)} either way (cartesian.{'speed' if m.axis < 3 else 'angular_speed'} in {file})"
        ),
        Refusal.JOINT_SPEED: lambda m: (
            f"{names.joint(m.axis)}: {number(m.value)} rad/s is not allowed: at most {number(m.limit)} either way "
            f"({names.key(m.axis)}.velocity in {file}, or `rtcp limits`)"
        ),
        Refusal.STREAM_DROPPED: lambda m: f"the target came {number(m.value)} s late or out of order: it was dropped",
        Refusal.ZONE: lambda m: f"at that target the arm would pass the bounds of {names.box(m.axis)}",
        Refusal.HAS_TORQUE: lambda _: "the drives have torque: `rtcp disable` first",
    }


def _singularity(m: Matter) -> str:
    which = m.axis if 0 <= m.axis < 3 else 0
    unit = _SINGULAR_UNITS[which]
    return (
        f"the motion came within {number(m.value)} {unit} of a singularity ({_SINGULAR_WORDS[which]}), at least "
        f"{number(m.limit)} {unit} is kept (cartesian.singularity.{_SINGULARITIES[which]})"
    )


_DIRECTIONS = ("x", "y", "z", "rx", "ry", "rz")
_RESET = "; the arm holds, `rtcp reset` goes on"


def motion_events(names: Naming) -> dict[int, Say]:
    """Return the sentences of events of motion, by `Code`."""
    file = names.file

    def ended(reason: Reason) -> int:
        return Code.ENDED + reason

    watch = f"supervision in {file}"

    def emergency(code: Code) -> str:
        return names.stop(code, " at once" if names.rungs[code] is Rung.TORQUE_OFF else ", then torque off")

    def watched(code: Code) -> str:
        return f"emergency stop, {emergency(code)}, `rtcp reset` goes on"

    return {
        Code.PRESSED: lambda _: (
            f"the emergency stop was pressed: {emergency(Code.PRESSED)}; release it, `rtcp reset` goes on"
        ),
        Code.OVER_SPEED: lambda m: (
            f"{names.joint(m.axis)}: measured speed {number(m.value)} rad/s was beyond {number(m.limit)} rad/s for "
            f"{names.config.supervision.cycles} cycles ({watch}): {watched(Code.OVER_SPEED)}"
        ),
        Code.OVER_TORQUE: lambda m: (
            f"{names.joint(m.axis)}: measured torque {number(m.value)} Nm was beyond {number(m.limit)} Nm for "
            f"{names.config.supervision.cycles} cycles ({watch}): {watched(Code.OVER_TORQUE)}"
        ),
        Code.FOLLOWING_ERROR: lambda m: (
            f"{names.joint(m.axis)}: it was {number(m.value)} rad away from where it was commanded, at most "
            f"{number(m.limit)} rad is allowed ({watch}): {watched(Code.FOLLOWING_ERROR)}"
        ),
        Code.PARKED: lambda _: "after the emergency stop: the torque is off, the slaves go to PRE-OP",
        Code.NOT_PERMITTED: lambda _: f"the enabling switch was let go: {names.end(Code.NOT_PERMITTED)}",
        Code.STICK_TAKEN: lambda m: (
            "the stick is the arm's again: it counts from its neutral position on"
            if m.value
            else "the stick was given to the wheelchair: the arm holds still"
        ),
        Code.MOTION: lambda m: f"the arm takes commands of mode {motion_name(m.axis)}",
        Code.LIMITS: lambda _: "the limits were changed",
        Code.RELEASED: lambda _: "reset: the arm holds and takes commands again",
        Code.HOMING_ZONE: lambda m: f"the homing was stopped: by its old zero the arm is in {names.box(m.axis)}",
        Code.STANDS_IN: lambda m: (
            f"the arm stands {number(-m.value)} m beyond the bounds of {names.box(m.axis)}: only what leads "
            "out is taken, jogging does"
        ),
        Code.GRIPPER: lambda m: f"the gripper is told to {'open' if m.value else 'close'}",
        Code.ZERO: lambda m: f"{names.joint(m.axis)}: its zero is now at {number(m.value)} rad of the drive",
        Code.GRIPPER_AT: lambda m: (
            f"{names.joint(m.axis)} rests at {number(m.value)} rad" + (", it holds something" if m.limit else "")
        ),
        Code.HOMED: lambda m: f"{names.joint(m.axis)} is homed: its drive reads {number(m.value)} rad",
        Code.HOMING_FAILED: lambda m: (
            f"{names.joint(m.axis)}: homing did not succeed (statusword 0x{int(m.value):04X}); the arm holds"
        ),
        Code.STICK_MODE: lambda m: f"the stick's mode is {STICK_MODES[m.axis] if 0 <= m.axis < 4 else m.axis}",
        Code.CAME_OUT: lambda m: (
            f"the stick shows {int(m.value)}, which is no code: the arm stops until the stick is neutral"
        ),
        ended(Reason.STREAM_ENDED): lambda _: "the stream of targets has ended: controlled stop",
        ended(Reason.COMMAND_ENDED): lambda _: "the command was not said again in time: controlled stop",
        ended(Reason.NO_SOLUTION): lambda m: f"the motion would have gone out of reach by {number(m.value)} m{_RESET}",
        ended(Reason.JOINT_LIMIT): lambda m: (
            f"{names.joint(m.axis)}: the motion wanted {number(m.value)}, the limit is {number(m.limit)} "
            f"(joints[{m.axis}] in {file}, or `rtcp limits`){_RESET}"
        ),
        ended(Reason.SINGULARITY): lambda m: _singularity(m) + _RESET,
        ended(Reason.CODE): lambda m: f"the stick shows {int(m.value)}, which is no code: the arm has stopped",
        ended(Reason.PLAN): lambda m: f"the plan is damaged in row {m.axis}: {number(m.value)}{_RESET}",
        ended(Reason.KEEP_OUT): lambda m: (
            f"the arm stopped before {names.box(m.axis)}, {number(m.value)} m from it{_RESET}"
            if m.value >= 0.0
            else f"the arm is {number(-m.value)} m beyond the bounds of {names.box(m.axis)}, and the motion did not "
            f"lead out{_RESET}; jogging leads out"
        ),
        ended(Reason.JUMP): lambda m: (
            f"{names.joint(m.axis)}: the motion would have jumped by {number(m.value)} rad in a cycle, at most "
            f"{number(m.limit)} rad is possible{_RESET}"
        ),
        ended(Reason.GENERATOR): lambda _: "the trajectory generator refused its input: controlled stop",
    }
