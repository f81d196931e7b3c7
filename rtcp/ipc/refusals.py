"""Refusals of commands: one frozen dataclass a reason, whose docstring is its message (`rtcp.ipc.names.message`)."""

from __future__ import annotations

from typing import ClassVar

from rtcp.ipc.message import Kinds, Message
from rtcp.ipc.states import ControlMode, DriveMode, Missing, State


class Refusal(Message, abstract=True):
    """Base of all refusals."""

    kinds: ClassVar[Kinds[Refusal]] = Kinds()


REFUSALS = Refusal.kinds


class Malformed(Refusal):
    """the command (number {kind}) is unknown, or its fields cannot be read"""

    kind: int


class NoLease(Refusal):
    """the lease expired or belongs to another commander: nothing moved"""


class Superseded(Refusal):
    """{command_name} was requested before a stop: nothing moved"""

    command: int
    """Number of the command's kind."""


class WrongState(Refusal):
    """{command_name} is not accepted in state {state}, only in: {accepting_states}{way_out}"""

    command: int
    """Number of the command's kind."""
    state: State


class NotInOp(Refusal):
    """{not_in_op}: see `rtcp status`, then `rtcp reset`"""


class ClockNotLocked(Refusal):
    """the cycle is not locked to the reference clock yet (`rtcp status`, clocks)"""


class DriveModeChanging(Refusal):
    """the drives are changing their mode: retry when the change is done"""


class DriveNotReady(Refusal):
    """{joint} cannot be enabled: {missing_words}"""

    axis: int
    missing: Missing


class HomingUnsupported(Refusal):
    """{joint} has no homing here: {homing_reason}"""

    axis: int


class EmergencyStopPressed(Refusal):
    """the emergency stop is pressed (inputs.emergency_stop in {file}): release it, then `rtcp reset`"""


class NotPermitted(Refusal):
    """the enabling switch is not pressed (inputs.enabling_switch in {file})"""


class FaultFollows(Refusal):
    """a fault has stopped all motion and begins at standstill (`rtcp status` names it): then `rtcp reset`"""


class NotAtStandstill(Refusal):
    """{joint} turns at {velocity:.6g} rad/s: wait until the joint stands still"""

    axis: int
    velocity: float


class JointOutsideRange(Refusal):
    """{joint} stands at {position:.6g} rad, outside its range {low:g} to {high:g} rad ({key}.position in {file}): it is
    not enabled there"""

    axis: int
    position: float


class TorquePresent(Refusal):
    """drives have torque: `rtcp disable` first"""


class UnknownAxis(Refusal):
    """axis {axis} does not exist: 0 to {highest}"""

    axis: int
    highest: int


class OffsetOutOfRange(Refusal):
    """{joint}: offset {value:.6g} rad is not allowed: at most {limit:.6g} rad"""

    axis: int
    value: float
    limit: float


# -- outputs and gripper ----------------------------------------------------------------------------------------------


class NoOutputs(Refusal):
    """no IO box is configured (slaves in {file})"""


class UnknownBox(Refusal):
    """IO box {box} does not exist: 1 to {highest}, in the order of slaves in {file}"""

    box: int
    highest: int


class UnknownOutput(Refusal):
    """output {output} does not exist: 1 to {highest}"""

    output: int
    highest: int


class ReservedOutput(Refusal):
    """output {output} has a function (outputs and gripper in {file}): it cannot be set directly"""

    output: int


class ChannelNotSettable(Refusal):
    """{channel_name} cannot be set: only outputs of analog, encoder and generic slaves that no process writes can"""

    slave: int
    """Position on the cable, from 1."""
    channel: int


class ChannelOutOfRange(Refusal):
    """{channel_name}: {value:.6g} cannot be set: allowed is {lowest:.6g} to {highest:.6g} (min, max and type in the
    device file of slave {slave_name})"""

    slave: int
    """Position on the cable, from 1."""
    channel: int
    value: float
    lowest: float
    highest: float


class NoGripper(Refusal):
    """no gripper is configured (gripper in {file})"""


class GripperDisabled(Refusal):
    """the drive of the gripper is not enabled: `rtcp enable` first"""


# -- external axes ----------------------------------------------------------------------------------------------------


class UnknownExternalAxis(Refusal):
    """axis {axis} is no external axis (external_axes in {file})"""

    axis: int


class AxisDisabled(Refusal):
    """the drive of {joint} is not enabled: `rtcp enable` first"""

    axis: int


class AxisModeMissing(Refusal):
    """{joint} is not used in {mode_words} ({key}.modes in {file})"""

    axis: int
    mode: int


class AxisNotHomed(Refusal):
    """{joint} is not homed: `rtcp axis home {joint}` first"""

    axis: int


class AxisBusy(Refusal):
    """{joint} moves in another mode: `rtcp axis stop {joint}` first"""

    axis: int


class AxisOutOfRange(Refusal):
    """{joint}: {value:.6g} rad is outside its range: {axis_range}"""

    axis: int
    value: float


class AxisAtEnd(Refusal):
    """{joint} stands at {value:.6g} rad and would leave its range at this velocity: {axis_range}"""

    axis: int
    value: float


class IsExternalAxis(Refusal):
    """{joint} is an external axis, no joint: `rtcp axis home {joint}`"""

    axis: int


class AxisSpeedOutOfRange(Refusal):
    """{joint}: {value:.6g} rad/s is not allowed: {least:.3g} to {limit:.6g} rad/s ({key}.velocity in {file})"""

    axis: int
    value: float
    least: float
    limit: float


class AxisHoldOutOfRange(Refusal):
    """{joint}: a hold time of {value:.6g} s is not allowed: more than 0 and at most {limit:.6g} s"""

    axis: int
    value: float
    limit: float


# -- motion -----------------------------------------------------------------------------------------------------------


class WrongControlMode(Refusal):
    """the control mode is {active}, this command needs {needed}: `rtcp mode {needed}` first"""

    active: ControlMode
    needed: ControlMode


class DriveModeFixed(Refusal):
    """control mode {active} sets the mode of the drives: `rtcp mode joint` before {wanted}"""

    active: ControlMode
    wanted: DriveMode


class DriveModeUnsupported(Refusal):
    """the drive of {joint} cannot be used in {mode}: {mode_reason}"""

    axis: int
    mode: DriveMode


class NoArm(Refusal):
    """this platform has no arm: its processes alone can be commanded"""


class NoGeometry(Refusal):
    """the geometry of the arm is unknown: the key kinematics is missing in {file}"""


class NotInCsp(Refusal):
    """homing needs the drives in csp: `rtcp mode csp` first"""


class WrongCount(Refusal):
    """found {found} numbers, allowed are {allowed}"""

    found: int
    allowed: int


class NotFinite(Refusal):
    """{joint}: {value} is not a finite number"""

    axis: int
    value: float


class StampNotFinite(Refusal):
    """the time stamp {value} is not a finite number"""

    value: float


class PositionOutOfRange(Refusal):
    """{joint}: target {value:.6g} rad is outside its range, beyond {limit:.6g} rad ({key}.position in {file}, or `rtcp
    limits`)"""

    axis: int
    value: float
    limit: float


class SpeedOutOfRange(Refusal):
    """speed {value:.6g} rad/s is not allowed: more than 0 and at most {limit:.6g} rad/s (joints[].velocity in
    {file})"""

    value: float
    limit: float


class JointSpeedOutOfRange(Refusal):
    """{joint}: {value:.6g} rad/s is not allowed: at most {limit:.6g} in either direction ({key}.velocity in {file}, or
    `rtcp limits`)"""

    axis: int
    value: float
    limit: float


class JogSpeedOutOfRange(Refusal):
    """{direction_name}: {value:.6g} is not allowed: at most {limit:.6g} in either direction (cartesian.speed in m/s,
    cartesian.angular_speed in rad/s, in {file})"""

    direction: int
    """0 to 5: x y z rx ry rz."""
    value: float
    limit: float


class TorqueOutOfRange(Refusal):
    """{joint}: torque {value:.6g} Nm is beyond its limit of {limit:.6g} Nm ({key}.torque in {file})"""

    axis: int
    value: float
    limit: float


class FractionOutOfRange(Refusal):
    """stiffness or damping {value:.6g} is not allowed: a fraction from 0 to 1 of cst_stiffness and cst_damping
    (joints[] in {file})"""

    value: float


class HoldTimeOutOfRange(Refusal):
    """hold time {value:.6g} s is not allowed: more than 0 and at most {limit:.6g} s"""

    value: float
    limit: float


class SpeedOverrideOutOfRange(Refusal):
    """speed override {value:.6g} is not allowed: a fraction of the speed from {lowest:g} to 1"""

    value: float
    lowest: float


class MovedByAnother(Refusal):
    """the joystick or another client moves the arm: the speed override is only lowered meanwhile"""


class NotPausable(Refusal):
    """this motion cannot be paused: `rtcp halt` stops it. Moves, lines and trajectories can"""


class NotPaused(Refusal):
    """nothing is resumed: the motion under way is not paused"""


class MotionPaused(Refusal):
    """the motion under way is paused: who paused it or commands it resumes it, `rtcp halt` ends it"""


class SpeedOverridden(Refusal):
    """the speed override of this arm is {fraction:.0%}: a motion in step runs at 100 % only (`rtcp speed 100`)"""

    fraction: float


class UnknownTool(Refusal):
    """tool {tool} does not exist: 0 to {highest}, in the order of kinematics.tools in {file}"""

    tool: int
    highest: int


class ToolInBox(Refusal):
    """with the tool {tool_name} the arm would be beyond the bounds of {box_name}: move it away first"""

    tool: int
    box: int


class PlannedForAnotherTool(Refusal):
    """the motion was planned for the tool {planned_tool}, and {tool_name} is in use: plan it again"""

    planned: int
    tool: int


class MassesUnknown(Refusal):
    """the masses of the links are unknown (kinematics.links in {file}): the arm's weight cannot be carried"""


class PayloadTooHeavy(Refusal):
    """a payload of {mass:.6g} kg is not allowed: 0 to {limit:g} kg (payload.max_mass in {file})"""

    mass: float
    limit: float


class PayloadTooFar(Refusal):
    """the payload's centre is {distance:.6g} m from the tool point: at most {limit:g} m is allowed"""

    distance: float
    limit: float


class StreamPointDropped(Refusal):
    """the target came {late_s:.6g} s late or out of order: it was dropped"""

    late_s: float


class TargetInBox(Refusal):
    """at that target the arm would cross the bounds of {box_name}"""

    box: int


class NoTrajectory(Refusal):
    """no trajectory of at most {longest_s:.6g} s reaches the target at {speed:.6g} rad/s: choose a higher speed or a
    nearer target"""

    speed: float
    longest_s: float


class WrongRowCount(Refusal):
    """the plan cannot run: found {found} rows, allowed are 1 to {most}"""

    found: int
    most: int


class DamagedRow(Refusal):
    """the plan cannot run: found {value:.6g} in row {row}"""

    row: int
    value: float


class PlanStartsElsewhere(Refusal):
    """{joint}: the plan starts at {planned:.6g} rad, the arm is commanded to {commanded:.6g} rad: move there first
    (`rtcp run --approach`)"""

    axis: int
    planned: float
    commanded: float


class StartOutOfReach(Refusal):
    """the motion was to begin {ahead_s:.3g} s from now; allowed is more than 0 and at most {most_s:g} s"""

    ahead_s: float
    most_s: float


class UnknownPartner(Refusal):
    """the motion names partner {partner}, this arm has {count}"""

    partner: int
    count: int


class MotionNumberAhead(Refusal):
    """motion: found {motion}, allowed are numbers up to CLOCK_MONOTONIC in ns, {now_ns}, and a minute more"""

    motion: int
    now_ns: int


class MotionNumberUsed(Refusal):
    """number {motion} of the motion in step was used: the last one was {last}, allowed is a greater one"""

    motion: int
    last: int


class BrakesOutOfRange(Refusal):
    """the table of the brakes has {value_s:.3g} s, allowed is more than 0 and at most {most_s:g} s"""

    value_s: float
    most_s: float


class BrakeStepOutOfRange(Refusal):
    """the table of the brakes has an entry every {step_s:.3g} s of the path, allowed is {least_s:g} to {most_s:g} s"""

    step_s: float
    least_s: float
    most_s: float


class PartnerMissing(Refusal):
    """{partner_name} does not run, or publishes no records: a motion in step needs all its arms"""

    partner: int


class PartnerOfAnotherCell(Refusal):
    """{partner_name} runs as part of another cell, of another state of its files, or of none, so that nothing keeps the
    arms apart: `rtcp --name {partner_name} stop`, then `rtcp cell start`"""

    partner: int


class PartnerStopPressed(Refusal):
    """{partner_name}, whose emergency stop the cell shares, is in its emergency stop, or has its button pressed:
    release it and reset that arm first"""

    partner: int


class PartnerStopUnread(Refusal):
    """{partner_name} publishes no records, so that its emergency stop, which the cell shares, is not read and counts as
    pressed: start {partner_name} first (`rtcp cell start`)"""

    partner: int


class PathStartsElsewhere(Refusal):
    """the path starts {distance:.6g} (m or rad) away from the tool: move there first (`rtcp run --approach`)"""

    distance: float


class PlanStartsMoving(Refusal):
    """{joint}: the plan starts at time 0 with {planned:.6g} rad/s, the arm is commanded {commanded:.6g} rad/s: give its
    first point a later time"""

    axis: int
    planned: float
    commanded: float


class PathNeedsRest(Refusal):
    """a path starts at rest, and {joint} moves at {velocity:.6g} rad/s: `rtcp halt` first"""

    axis: int
    velocity: float


class ApproachImpossible(Refusal):
    """no motion leads from the present state to the first point of the plan"""


# -- limits -----------------------------------------------------------------------------------------------------------


class LimitsExcludeJoint(Refusal):
    """{joint} stands or would come to rest at {value:.9g} rad, outside the new limit {limit:.9g} rad: nothing was
    changed"""

    axis: int
    value: float
    limit: float


class LimitsExcludeArm(Refusal):
    """the arm would cross the new bounds of {box_name}: nothing was changed"""

    box: int


class LimitsTooNearPartner(Refusal):
    """under the new acceleration limits the arm would not stop in time: it would come to {distance:.3g} m from
    {partner_name}; nothing was changed, repeat the change when the arm is slower or stands"""

    partner: int
    distance: float


class LimitsInStep(Refusal):
    """the arm is in a motion in step, whose arms brake together under the limits that it was planned with: nothing was
    changed, repeat the change when the motion has ended"""


class ImpossibleLimit(Refusal):
    """{joint_or_box}: {value:.6g} cannot be set (its bound is {limit:.6g}): nothing was changed"""

    axis: int
    """-1: of a box or a cone; -2: of the supervision."""
    value: float
    limit: float


class LimitWidened(Refusal):
    """{joint_or_box}: {value:.6g} is beyond what the configuration allows, {limit:.6g} (in {file}): limits are only
    narrowed at run time, or with --widen brought up to the key absolute"""

    axis: int
    value: float
    limit: float


class TorqueLimitTooLow(Refusal):
    """{joint} holds {held:.6g} Nm, more than the limit of {limit:.6g} Nm: it would sag, nothing was changed"""

    axis: int
    held: float
    limit: float


class ThresholdTooLow(Refusal):
    """{joint} is at {found:.6g}, beyond the new threshold of {limit:.6g} (supervision.{threshold}): it would be an
    emergency stop, nothing was changed"""

    axis: int
    quantity: int
    """0: speed, rad/s; 1: torque, Nm; 2: following error, rad."""
    found: float
    limit: float


class DriverRaised(Refusal):
    """the driver of slave {slave} ({slave_name}) raised an error, which the log names"""

    slave: int
    """Position on the cable, from 1."""


class ControllerRaised(Refusal):
    """the controller {controller} raised an error, which the log names"""

    controller: str


class ProcessRaised(Refusal):
    """the process {process_name} raised an error, which the log names"""

    process: int
    """Its place in the configuration, from 0."""


class NotOpen(Refusal):
    """no open trajectory is under way"""


class NoRoomForPoints(Refusal):
    """{rows} points wait or are under way, at most {most} fit: append fewer, or later"""

    rows: int
    most: int


class NoEnablingSwitch(Refusal):
    """no enabling switch is configured (inputs.enabling_switch in {file}): a person guides the arm only while one is
    held; guiding.enabling_switch: false allows it without"""


class WeightUnknown(Refusal):
    """{joint} turns at {velocity:.6g} rad/s: while it turns, its torque does not show the weight that a torque motion
    has to carry; send the torque when the arm rests"""

    axis: int
    velocity: float


class WeightDiffers(Refusal):
    """{joint} holds {held:.6g} Nm, its weight by the masses is {expected:.6g} Nm: at most {limit:.6g} Nm apart are
    allowed (guiding.weight_error in {file}); set kinematics.links, or take off the load"""

    axis: int
    held: float
    expected: float
    limit: float


class DurationOutOfRange(Refusal):
    """duration {value:.6g} s is not allowed: at most {limit:.6g} s, or 0: until it is halted"""

    value: float
    limit: float
