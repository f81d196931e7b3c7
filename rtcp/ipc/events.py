"""Events of the loop: one frozen dataclass a kind, whose docstring is its message.

The number of a kind is also the error code in cycle records, in `rtcp status` and in ROS-Industrial's RobotStatus.
Code decides on kinds and fields; `rtcp.ipc.names` makes the text. An event of a package outside is
a subclass of `MotionEnded` with a number from 1000 on, which its controller returns by `give_up`.
"""

from __future__ import annotations

from typing import ClassVar

from rtcp.ipc.message import Kinds, Message
from rtcp.ipc.states import ControlMode, DriveMode, DriveState, Missing

JOYSTICK_MODES = ("X-Y", "Z-yaw", "roll-pitch", "gripper")


class Event(Message, abstract=True):
    """Base of all events."""

    kinds: ClassVar[Kinds[Event]] = Kinds()
    cuts_texts = True
    is_fault: ClassVar[bool] = False
    """Whether it begins a fault or an emergency stop."""
    is_emergency: ClassVar[bool] = False
    """Whether it begins the emergency stop, also from the fault state."""
    is_warning: ClassVar[bool] = False
    """Whether the operator must know of it, though it is no fault."""
    stop_key: ClassVar[str] = ""
    """Key under `stops` that sets its stop reaction (`rtcp.ipc.stop_reactions`); empty: a fault takes a quick stop."""


EVENTS = Event.kinds


class FaultEvent(Event, abstract=True):
    """Base of events that begin a fault."""

    is_fault = True


class EmergencyStop(FaultEvent, abstract=True):
    """Base of events that begin the emergency stop."""

    is_emergency = True


# -- states of the machine --------------------------------------------------------------------------------------------


class Ready(Event, number=10):
    """{all_in_op}"""


class Enabled(Event, number=11):
    """all drives are enabled, the arm holds"""


class Disabled(Event, number=12):
    """all drives are disabled"""


class ResetDone(Event, number=13):
    """reset: the fault is cleared, drives are disabled"""


class PluginSlow(Event, number=153):
    """{plugin} took {took_us:.0f} us in one cycle, allowed are {allowed_us:.0f} us: later cycles come late"""

    is_warning = True
    plugin: str
    """Slave, process or controller of another package."""
    took_us: float
    allowed_us: float


class Arrived(Event, number=14):
    """the motion is complete"""


class Stopped(Event, number=15):
    """the arm has stopped and holds"""


class StoppedByLimit(Event, number=51):
    """the arm has stopped at a limit and holds; then `rtcp reset`"""


class LimitStopReset(Event, number=32):
    """reset: the arm holds and accepts commands"""


class ClockLocked(Event, number=16):
    """the cycle is locked to the reference clock"""


class ClockUnlocked(Event, number=17):
    """the cycle has lost the phase of the reference clock"""

    is_warning = True


class TorqueRemoved(Event, number=21):
    """drives were commanded to remove their torque; the fault remains until `rtcp reset`"""


class SlavesParked(Event, number=27):
    """emergency stop complete: torque is off, slaves go to PRE-OP"""


class LimitsChanged(Event, number=31):
    """the limits were changed"""


class HaltedAtRest(Event, number=54):
    """halted: nothing moved"""


class SpeedOverrideChanged(Event, number=53):
    """the speed override is {fraction:.0%}"""

    fraction: float


class Paused(Event, number=56):
    """paused: the motion rests on its path"""


class Resumed(Event, number=57):
    """the motion goes on"""


class ToolChanged(Event, number=58):
    """the tool is {tool_name}"""

    tool: int


class PayloadChanged(Event, number=59):
    """the payload is {mass:.6g} kg"""

    mass: float


class ControlModeChanged(Event, number=30):
    """control mode {mode}"""

    mode: ControlMode


class ReturningToRange(Event, number=44):
    """{joint} stands {beyond:.2g} rad outside its range ({key}.position in {file}, or `rtcp limits`): it returns to the
    edge at {speed:.6g} rad/s"""

    axis: int
    beyond: float
    speed: float


class EnabledInBox(Event, number=41):
    """the arm stands {depth:.6g} {unit} beyond the bounds of {box_name}: only motion that leads out is accepted; jog
    out"""

    is_warning = True
    box: int
    depth: float
    """m; rad for a cone."""


class MovedSinceFault(Event, number=45):
    """{joint} stands at {position:.6g} rad, at the fault it stood at {before:.6g} rad: if nobody moved it and it did
    not sag, its drive lost its zero; check that before `rtcp enable`"""

    is_warning = True
    axis: int
    position: float
    before: float


# -- joystick, gripper, zero ------------------------------------------------------------------------------------------


class JoystickGranted(Event, number=29):
    """the joystick controls the arm once it has been neutral"""


class JoystickWithdrawn(Event, number=47):
    """the joystick controls the wheelchair: the arm holds"""


class JoystickModeChanged(Event, number=37):
    """joystick mode {joystick_mode}"""

    mode: int


class UnknownJoystickCode(Event, number=38):
    """the joystick reads {code}, which is no code: the arm stops until it is neutral"""

    is_warning = True
    code: int


class JoystickOutOfRange(Event, number=160):
    """a channel of the stick is no number, or beyond its full inclination (inputs.joystick.analog in {file}): the arm
    stops until the stick is neutral; check its wires"""

    is_warning = True


class GripperOpens(Event, number=33):
    """the gripper opens"""


class GripperCloses(Event, number=48):
    """the gripper closes"""


class GripperAtRest(Event, number=40):
    """{joint} rests at {position:.6g} rad"""

    axis: int
    position: float
    holds: bool
    """An object keeps it from its end position."""


class AxisAtRest(Event, number=190):
    """{joint} rests at {position:.6g} rad"""

    axis: int
    position: float
    reached: bool
    """It is at the target of its motion."""


class AxisFailed(Event, number=191):
    """{joint} is halted: its drive did not carry out the motion (mode {mode}, statusword 0x{statusword:04X})"""

    is_warning = True
    axis: int
    statusword: int
    mode: int
    """Mode of operation display."""


class AxisStillMoving(FaultEvent, number=192):
    """{joint} does not come to rest although it is halted: {velocity:.6g} rad/s; its drive stops it by a quick stop"""

    axis: int
    velocity: float


class AxisNotReplaced(FaultEvent, number=193):
    """{joint} is halted, and its drive does not acknowledge the set-point that replaces the former one (statusword
    0x{statusword:04X}); it is stopped by a quick stop"""

    axis: int
    statusword: int


class AxisModeLost(FaultEvent, number=194):
    """the drive of {joint} shows mode {shown}, commanded is {mode_words}: check 0x6060 and 0x6502 of the drive"""

    axis: int
    shown: int
    """Mode of operation display."""
    mode: int


class ZeroSet(Event, number=34):
    """{joint}: its zero is at {offset:.6g} rad of the drive, it stands at {position:.6g} rad"""

    axis: int
    offset: float
    position: float


class Homed(Event, number=35):
    """{joint} is homed: its drive reads {position:.6g} rad"""

    axis: int
    position: float


class HomingFailed(Event, number=36):
    """{joint}: homing failed (the drive shows mode {mode}, statusword 0x{statusword:04X}); the arm holds"""

    is_warning = True
    axis: int
    statusword: int
    mode: int
    """Mode of operation display; not 6: the drive does not home."""


class HomedElsewhere(Event, number=167):
    """{joint}: the drive reports that it is homed, but it shows {shown:.6g} rad and its home offset (0x607C) is
    {home_offset:.6g} rad, allowed are homing.tolerance = {homing_tolerance:g} rad between them: it has not homed, or it
    counts otherwise; the arm holds"""

    is_warning = True
    axis: int
    shown: float
    """What the drive itself shows, without the joint's zero offset."""
    home_offset: float


class HomingInBox(Event, number=42):
    """homing was stopped: by the old zero the arm is in {box_name}"""

    is_warning = True
    box: int


# -- beside the cycle -------------------------------------------------------------------------------------------------


class ServiceEvent(Event, abstract=True):
    """Base of events that are detected outside the cycle; where a stop is needed, the cycle detects its own fault."""

    is_problem: ClassVar[bool] = True
    """Whether it may be the message of the status; others are only listed."""


class SlavesLeftOp(ServiceEvent, number=60):
    """{slaves_named} left OP: {left_words}{falls_words}"""

    slave: int
    """Position of the first of several neighbours that left OP in the same way."""
    last: int
    al_status: int
    """0: no answer."""
    code: int
    parent: int
    """Position of the slave before the first; 0: the master."""
    falls: int
    """Times that each left OP since the last report."""


class SlavesBackInOp(ServiceEvent, number=61):
    """{slaves_named} {are} back in OP after {after_s:.1f} s; the arm does not move before `rtcp reset` and `rtcp
    enable`"""

    slave: int
    last: int
    after_s: float


class NoSlaveAnswers(ServiceEvent, number=62):
    """no slave answers: check the cable between the master and {first_slave}, and that slave's supply"""


class SlavesAnswerAgain(ServiceEvent, number=63):
    """slaves answer again, after {silent_s:.1f} s without any"""

    silent_s: float


class OtherMaster(ServiceEvent, number=90):
    """frames that this platform did not send come from {address}: disconnect or stop the second EtherCAT master"""

    address: str
    """Source address of the frames, as 01:23:45:67:89:ab."""


class StateNotReached(ServiceEvent, number=64):
    """{refusal_words}; it is asked again"""

    slave: int
    requested: int
    al_status: int
    code: int


class OtherSlaveAnswers(ServiceEvent, number=65):
    """{slave_label}: at its place answers {other_label}: put the cables back in their order"""

    slave: int
    other: int


class SlaveSetUpAgain(ServiceEvent, number=66):
    """{slave_label} is set up again: {set_up_reason}"""

    slave: int
    al_status: int
    """Before the set-up; 0: it was without supply."""
    code: int


class CableEvent(ServiceEvent, abstract=True):
    """Base of errors that enter at a cable."""

    near: int
    """Position of the slave at the end towards the master; 0: the master."""
    far: int
    """Position of the slave at its other end; 0: none that is configured."""
    count: int
    began_ns: int
    """Instant of the first, CLOCK_REALTIME."""


class DamagedFrames(CableEvent, number=67):
    """errors enter {cable}: {frames_counted} since {began}; check that cable and its plugs"""


class LinkLost(CableEvent, number=68):
    """the link {cable} was lost {times} since {began}; check that cable, its plugs and the supply"""


class EmergencyMessage(ServiceEvent, number=69):
    """{slave_label} sent emergency 0x{error_code:04X}: {error_meaning} (error register 0x{error_register:02X}, data
    {data_bytes}){error_advice}{repeated}"""

    slave: int
    error_code: int
    error_register: int
    data: int
    """Five bytes specific to the maker, the first one highest."""
    again: int = 0
    """Times that it came again in `seconds`."""
    seconds: float = 0.0


class ErrorReset(EmergencyMessage, number=70):
    """{slave_label} sent emergency 0x0000: error reset, or no error (error register 0x{error_register:02X}, data
    {data_bytes}){repeated}"""

    is_problem = False


class DriveErrorCode(ServiceEvent, number=71):
    """{joint} (slave {slave}{slave_axis_words}): the drive's error code is {error_words}"""

    axis: int
    slave: int
    slave_axis: int
    error_code: int


class WaitingForRobot(ServiceEvent, number=72):
    """waiting for the robot: {text}"""

    is_problem = False
    text: str
    """The reason for waiting (`Master.waiting_for`)."""


class RobotReady(ServiceEvent, number=73):
    """the robot is ready"""

    is_problem = False


class ErrorReported(ServiceEvent, number=74):
    """{text}{repeated}"""

    text: str
    """Message of an exception: of the bus, a driver or a process."""
    again: int = 0
    seconds: float = 0.0


class MessagesLeftOut(ServiceEvent, number=75):
    """further {messages_of} were left out: {count} in {seconds:.0f} s"""

    slave: int
    """0: failures of the bus."""
    count: int
    seconds: float


# -- faults -----------------------------------------------------------------------------------------------------------


class ProcessDataLost(FaultEvent, number=1):
    """process data lost: the count of cycles without the expected working counter reached {allowed}, the last
    {in_a_row} in a row; cycles with it count down ({lost_cycles} in {file}): {reaction}; `rtcp reset` when answers
    come again"""

    stop_key = "lost_frames"
    in_a_row: int
    allowed: int


class DriveLeftEnabled(FaultEvent, number=2):
    """{joint}: the drive left Operation Enabled by itself ({drive_words}): {reaction}; then `rtcp
    reset`"""

    stop_key = "drive_fault"
    axis: int
    state: DriveState
    statusword: int


class DriveFault(FaultEvent, number=18):
    """{joint}: the drive is in fault ({drive_words}): {reaction}; then `rtcp reset`"""

    stop_key = "drive_fault"
    axis: int
    state: DriveState
    statusword: int


class EnableTimeout(FaultEvent, number=3):
    """{joint}: the drive did not reach Operation Enabled within {enable_timeout:g} s ({drive_words};
    enable_timeout_s in {file}): {reaction}; then `rtcp reset`"""

    axis: int
    state: DriveState
    statusword: int


class TooHeavyForCst(FaultEvent, number=155):
    """{joint} holds {held:.6g} Nm, more than its torque limit of {limit:.6g} Nm: it would sag in CST: {reaction};
    lighten the arm, or change the drive mode or the limit, then `rtcp reset`"""

    axis: int
    held: float
    limit: float


class DisableTimeout(FaultEvent, number=4):
    """{joint}: the drive kept its torque for {enable_timeout:g} s ({drive_words}; enable_timeout_s in
    {file}): {reaction}; then `rtcp reset`"""

    axis: int
    state: DriveState
    statusword: int


class SlaveLost(FaultEvent, number=5):
    """slave {slave} ({slave_name}) left OP or does not answer: {reaction}; `rtcp reset` when it is back"""

    stop_key = "slave_lost"
    slave: int
    """Position on the cable, from 1."""


class ResetTimeout(FaultEvent, number=6):
    """{joint}: the drive remains in fault after the reset ({drive_words}): remove the cause, then `rtcp
    reset`"""

    axis: int
    state: DriveState
    statusword: int


class ResetWithoutSlaves(FaultEvent, number=49):
    """reset failed within 3 s: not all slaves are back in OP (`rtcp status` shows which): repair that, then `rtcp
    reset`"""


class ResetWithoutFrames(FaultEvent, number=50):
    """reset failed within 3 s: no frames return, or the reference clock is not locked (`rtcp status`)"""


class ResetWithoutController(FaultEvent, number=118):
    """reset failed within 3 s: {missing_words}; then `rtcp reset`"""

    missing: Missing


class ResetWhileMoving(FaultEvent, number=22):
    """{joint} still turns at {velocity:.6g} rad/s 3 s after the reset: its torque goes at standstill only; `rtcp
    disable` removes it at once"""

    axis: int
    velocity: float


class DriverFailed(FaultEvent, number=113):
    """the driver of slave {slave} ({slave_name}) raised an error, which the log names: its outputs are safe,
    {reaction}; then `rtcp reset`"""

    slave: int
    """Position on the cable, from 1."""


class ProcessFailed(FaultEvent, number=126):
    """the process {process_name} raised an error, which the log names: its outputs are safe, {reaction}; then
    `rtcp reset`"""

    process: int
    """Its place in the configuration, from 0."""


class ControllerRaised(FaultEvent, number=152):
    """the controller {controller} raised an error or returned wrong setpoints, which the log names: {reaction}; then
    `rtcp reset`"""

    controller: str


class GeneratorFailed(FaultEvent, number=7):
    """the trajectory generator refused its input: {reaction}; then `rtcp reset`"""


class DriveModeTimeout(FaultEvent, number=8):
    """{joint}: the drive shows mode {found} instead of {wanted}: {reaction}; then `rtcp reset`"""

    axis: int
    found: int
    wanted: DriveMode


class ClockLost(FaultEvent, number=19):
    """the cycle was not locked to the reference clock for {seconds:g} s: {reaction}; then `rtcp reset`"""

    stop_key = "clock_lost"
    seconds: float


class LeftRange(FaultEvent, number=20):
    """{joint} left its range of {low:g} to {high:g} rad while being enabled or homed: it stands at {position:.6g} rad
    ({key}.position in {file}): {reaction}; then `rtcp reset`"""

    axis: int
    position: float


class PositionJumped(FaultEvent, number=43):
    """{joint} jumped from {before:.6g} to {position:.6g} rad, possible are {bound:.3g} rad, for {supervision}: it was
    turned, or its drive shows a false position; {reaction}; compare it with `rtcp status`, then `rtcp reset`"""

    axis: int
    position: float
    before: float
    bound: float


class VelocityJumped(FaultEvent, number=76):
    """{joint}: the measured speed jumped from {before:.6g} to {velocity:.6g} rad/s, possible are {bound:.3g} rad/s, for
    {supervision}: it was hit, or its drive shows a false speed; {reaction}; then `rtcp reset`"""

    axis: int
    velocity: float
    before: float
    bound: float


class VelocityDisagrees(FaultEvent, number=156):
    """{joint}: its positions and its speed of {velocity:.6g} rad/s differ by {gap:.3g} rad within 0.1 s, allowed are
    {allowed:.3g} rad (supervision.velocity_gap in {file}): one of them is stuck or has a wrong factor; {reaction}; then
    `rtcp reset`"""

    axis: int
    velocity: float
    gap: float
    allowed: float


class HomingStillMoving(FaultEvent, number=39):
    """{joint} still turns at {velocity:.6g} rad/s {rest_s:g} s (homing.rest_s) after its homing: {reaction}; then
    `rtcp reset`"""

    axis: int
    velocity: float


class LeaseExpired(Event, number=9):
    """the commander fell silent or released its lease: {reaction}"""

    is_warning = True
    stop_key = "lease_ended"


class DisabledUnattended(Event, number=166):
    """the drives are disabled: nobody has commanded the arm for {seconds:g} s since its commander was lost in a motion
    (stops.power_off_after_s)"""

    is_warning = True
    seconds: float


class PermissionWithdrawn(Event, number=28):
    """the enabling switch was released: {reaction}"""

    is_warning = True
    stop_key = "enabling_switch"


class EstopUnobservable(Event, number=46):
    """the IO box has been out of OP for {after_s:g} s: the emergency stop (inputs.emergency_stop in {file}) cannot be
    read and counts as pressed"""

    is_warning = True
    after_s: float


class EmergencyStopActivated(EmergencyStop, number=23):
    """the emergency stop is pressed: {reaction}; release it, then `rtcp reset`"""

    stop_key = "emergency_stop"


class PartnerEmergencyStop(EmergencyStop, number=52):
    """the emergency stop of {partner_name}, which the cell shares, was pressed: {reaction}"""

    stop_key = "emergency_stop"
    partner: int


class PartnerStopUnread(EmergencyStop, number=151):
    """{partner_name} publishes no records any more, so that its emergency stop, which the cell shares, is not read and
    counts as pressed: {reaction}; start {partner_name} again (`rtcp cell start`), then `rtcp reset`"""

    stop_key = "emergency_stop"
    partner: int


class OverSpeed(EmergencyStop, number=24):
    """{joint}: measured speed {value:.6g} rad/s exceeded {limit:.6g} rad/s for {supervision}: {reaction}; then `rtcp
    reset`"""

    stop_key = "supervision"
    axis: int
    value: float
    limit: float


class OverTorque(EmergencyStop, number=25):
    """{joint}: measured torque {value:.6g} Nm exceeded {limit:.6g} Nm for {torque_time:g} s (supervision.torque_s in
    {file}): {reaction}; then `rtcp reset`"""

    stop_key = "supervision"
    axis: int
    value: float
    limit: float


class FollowingError(EmergencyStop, number=26):
    """{joint}: following error {value:.6g} rad exceeded {limit:.6g} rad for {supervision}: {reaction}; then `rtcp
    reset`"""

    stop_key = "supervision"
    axis: int
    value: float
    limit: float


class PushedNear(FaultEvent, number=77):
    """the arm was pushed towards {box_name}, to {distance:.3g} {unit} before its bounds: {reaction}; then `rtcp
    reset`"""

    box: int
    distance: float


class PushedNearPartner(FaultEvent, number=78):
    """the arm was pushed towards {partner_name}, to {distance:.3g} m before half the clearance: {reaction}; then
    `rtcp reset`"""

    partner: int
    distance: float


# -- why a motion ended before its goal -------------------------------------------------------------------------------


class MotionEnded(Event, abstract=True):
    """Base of the reasons for which a controller or a guard ends a motion."""

    by_limit: ClassVar[bool] = True
    """Whether the state becomes stopped by limit, which needs a reset; else the arm holds and accepts commands."""


class ProcessEnded(Event, abstract=True):
    """Base of the reasons for which a command of a process ends early, without a fault of the machine."""

    is_warning = True


def severity(kind: type[Event]) -> str:
    """Return the severity of a kind: emergency_stop, fault, limit (reset, and move away), warning or note."""
    if kind.is_fault:
        return "emergency_stop" if kind.is_emergency else "fault"
    if issubclass(kind, MotionEnded) and kind.by_limit:
        return "limit"
    return "warning" if kind.is_warning else "note"


class StreamEnded(MotionEnded, number=101):
    """the stream of targets ended: controlled stop"""

    by_limit = False


class NotSettled(MotionEnded, number=154):
    """{joint} is {distance:.4g} rad from its target {time_s:g} s after the end of the setpoints, allowed is {limit:g}
    rad (settle in {file}): the motion has failed and the arm holds; look for an obstacle, a load or friction"""

    by_limit = False
    is_warning = True
    axis: int
    distance: float
    limit: float
    time_s: float


class OutOfPoints(MotionEnded, number=117):
    """the open trajectory came to its last point and no more had been appended: controlled stop"""

    by_limit = False


class PartnerNotReady(MotionEnded, number=125):
    """{partner_name} did not accept the motion in step, or is silent: the motion did not begin"""

    by_limit = False
    partner: int


class PartnerStopped(MotionEnded, number=120):
    """{partner_name} brakes, and this arm in step with it, along the path"""

    by_limit = False
    partner: int


class PartnerLeft(MotionEnded, number=121):
    """{partner_name} has left the motion in step, or has fallen behind: this arm brakes along its path"""

    by_limit = False
    partner: int


class PartnerSilent(MotionEnded, number=122):
    """{partner_name} publishes no records any more: this arm brakes along its path"""

    by_limit = False
    partner: int


class PartnerNear(MotionEnded, number=124):
    """the arm stopped {distance:.3g} m from {partner_name}; it holds, then `rtcp reset`, and move one of them away"""

    partner: int
    distance: float


class PartnerForeign(MotionEnded, number=150):
    """{partner_name} runs as part of another cell, of another state of its files, or of none, so that nothing keeps the
    arms apart: controlled stop; `rtcp --name {partner_name} stop`, then `rtcp cell start`"""

    by_limit = False
    partner: int


class OutOfStep(MotionEnded, number=123):
    """this arm is {lag_s:.3g} s behind the others of the motion in step: its cycles were late; controlled stop"""

    by_limit = False
    lag_s: float


class SetpointOutOfRange(MotionEnded, number=114):
    """{joint}: the stream's setpoint of {value:.6g} rad is outside its range, beyond {limit:g} rad: controlled stop,
    the stream has ended"""

    by_limit = False
    axis: int
    value: float
    limit: float


class SetpointNotFinite(MotionEnded, number=115):
    """{joint}: a number of the stream's setpoint is not finite: controlled stop, and the stream has ended"""

    by_limit = False
    axis: int


class SetpointOutOfOrder(MotionEnded, number=116):
    """a setpoint of the stream came {late_s:.6g} s late or out of order: controlled stop, and the stream has ended"""

    by_limit = False
    late_s: float


class CommandExpired(MotionEnded, number=109):
    """the command was not renewed in time: controlled stop"""

    by_limit = False


class GuidedTooFast(MotionEnded):
    """the hand moved the tool at {speed:.6g} m/s, the bound is {limit:.6g} m/s (guiding.speed in {file}): controlled
    stop; push less hard"""

    by_limit = False
    speed: float
    limit: float


class OutOfReach(MotionEnded, number=102):
    """the motion would have left the reach of the arm by {distance:.6g} m; the arm holds, then `rtcp reset`"""

    distance: float


class NoSolution(MotionEnded, number=112):
    """no joint positions reach the motion's next tool pose: its orientation is out of reach, the arm is singular, or
    its wrist is not spherical; the arm holds, then `rtcp reset`, and move or jog the joints"""


class JointLimitReached(MotionEnded, number=103):
    """{joint}: the motion wanted {value:.6g}, the limit is {limit:.6g} ({key} in {file}, or `rtcp limits`); the arm
    holds, then `rtcp reset`"""

    axis: int
    value: float
    limit: float


class SingularityReached(MotionEnded, number=104):
    """the motion came within {value:.6g} {singularity_unit} of the {singularity} singularity, allowed is {limit:.6g}
    {singularity_unit} (cartesian.singularity.{singularity} in {file}); the arm holds, then `rtcp reset`"""

    which: int
    """0 shoulder, 1 elbow, 2 wrist."""
    value: float
    limit: float


class PlanDamaged(MotionEnded, number=106):
    """row {row} of the plan is damaged: found {value:.6g}; the arm holds, then `rtcp reset`"""

    row: int
    value: float


class BoxReached(MotionEnded, number=107):
    """the arm stopped {distance:.6g} {unit} from {box_name}; the arm holds, then `rtcp reset`"""

    box: int
    distance: float


class NotLeavingBox(MotionEnded, number=111):
    """the arm is {depth:.6g} {unit} beyond the bounds of {box_name}, and the motion did not lead out; `rtcp reset`,
    then jog out"""

    box: int
    depth: float


class CollisionAhead(MotionEnded, number=119):
    """the arm stopped {distance:.6g} m before {first_link} and {second_link} come as near to each other as
    {clearance:g} m (cartesian.clearance in {file}); the arm holds, then `rtcp reset`, and move them apart"""

    first: int
    """Link of the one body, 0: the base."""
    second: int
    distance: float


class SetpointJump(MotionEnded, number=108):
    """{joint}: the motion would have jumped by {value:.6g} rad in a cycle, at most {limit:.6g} rad is possible; the arm
    holds, then `rtcp reset`"""

    axis: int
    value: float
    limit: float


class ControllerFailed(MotionEnded, number=110):
    """the trajectory generator refused its input"""
