"""What a person at the arm does: stick, toggle, enabling switch, emergency stop; and what the lamps tell them."""

from __future__ import annotations

from rtcp.config.model import ArmConfig
from rtcp.control.arm import Arm
from rtcp.devices.io_box import Inputs, IoBox, JoystickInput, Outputs
from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.codes import Code, MotionMode
from rtcp.motion.controllers.joystick import Joystick
from rtcp.motion.state import Phase


class Operator:
    """Reads the inputs that have a meaning, leads the arm by the stick, and writes the outputs that have a meaning.

    Args:
        config: which they are.
        box: the IO box, or None: then nothing is pressed, nothing is forbidden and no stick is there.
    """

    def __init__(self, config: ArmConfig, box: IoBox | None) -> None:
        cycle_s = config.cycle.period_us * 1e-6
        self._box = box
        self.box_position = 0 if box is None else 1 + [slave.name for slave in config.slaves].index(box.name)
        """The box's position on the cable; 0: there is none."""
        self._inputs = Inputs(config.inputs, cycle_s)
        self._outputs = Outputs(config.outputs, config.gripper)
        self._stick = JoystickInput(config.inputs, cycle_s)
        self._joystick = Joystick(config.jog)
        self._arm_had_it = True
        self._code_told = False
        self.emergency_stop = box is not None and self._inputs.emergency_stop.active
        """Whether it is pressed; before the box has been heard it is."""
        self.permitted = box is None or self._inputs.enabling_switch.active
        """Whether the enabling switch allows motion."""
        self.arm_has_stick = False
        self.meant = self._outputs.meant
        """Numbers of the outputs that nobody switches by hand."""
        self.has_button = box is not None and config.inputs.emergency_stop is not None
        """Whether there is an emergency stop at the box."""
        self.has_gripper = box is not None and config.gripper is not None and config.gripper.output is not None

    @property
    def stick_mode(self) -> int:
        """0 X-Y, 1 Z-yaw, 2 roll-pitch, 3 gripper."""
        return self._joystick.mode

    def read(self) -> None:
        """Take the inputs of the cycle."""
        box, inputs = self._box, self._inputs
        if box is None:
            return
        levels = box.inputs
        inputs.read(levels)
        self._stick.read(levels)
        self.emergency_stop = inputs.emergency_stop.active
        self.permitted = inputs.enabling_switch.active
        self.arm_has_stick = inputs.arm_toggle.active

    def hear_press(self) -> None:
        """Take from the box's inputs that the emergency stop is pressed; that it is released is not taken."""
        if self._box is not None:
            stop = self._inputs.emergency_stop
            stop.read_active(self._box.inputs)
            self.emergency_stop = stop.active

    @property
    def holds_grip(self) -> bool:
        """Whether the stick is held where it opens or closes the gripper."""
        return self.arm_has_stick and self._joystick.holds_grip

    @property
    def button_known(self) -> bool:
        """Whether the emergency stop's input has been heard for long enough since it was forgotten."""
        return self._box is None or self._inputs.emergency_stop.settled

    def forget_press(self) -> None:
        """Let the emergency stop count as released until the box is heard to say otherwise."""
        self._inputs.emergency_stop.forget()
        self.emergency_stop = False

    def show(self, powered: bool, moving: bool) -> None:
        """Switch the lamps and toggle the heartbeat."""
        if self._box is not None:
            self._box.outputs = self._outputs.write(self._box.outputs, powered, moving)

    def forget_outputs(self) -> None:
        """Let the gripper's output, and what was switched by hand, be off as they are at a box that has left OP."""
        if self._box is not None:
            self._box.outputs = self._outputs.lamps(self._box.outputs)

    def wait_for_neutral(self) -> None:
        """Let the stick count only after it has been neutral."""
        self._joystick.wait_for_neutral()

    def grip(self, close: bool) -> None:
        """Close or open the gripper on its output."""
        if self._box is not None:
            self._box.outputs = self._outputs.grip(self._box.outputs, close)

    def lead_by_stick(self, arm: Arm, blackboard: Blackboard) -> bool:
        """Let the stick lead the arm, in the motion mode joystick; return whether the arm has to move for it.

        Called every cycle in which the arm holds, or moves by the stick.
        """
        motions = arm.motions
        jog = motions.jog
        if motions.mode is not MotionMode.JOYSTICK or jog is None:
            return False
        if self.arm_has_stick is not self._arm_had_it:
            self._arm_had_it = self.arm_has_stick
            blackboard.event(Code.STICK_TAKEN, -1, float(self.arm_has_stick))
        stick, joystick = self._stick, self._joystick
        before = joystick.mode
        joystick.update(stick, self.arm_has_stick and self.permitted)
        if joystick.mode != before:
            blackboard.event(Code.STICK_MODE, joystick.mode)
        if not stick.valid and self.arm_has_stick:
            if not self._code_told:
                blackboard.event(Code.CAME_OUT, -1, float(stick.code))
            self._code_told = True
        elif stick.valid:
            self._code_told = False
        if joystick.grip is not None:
            taken = self.has_gripper
            if arm.gripper is not None:
                taken = arm.gripper.grip(not joystick.grip)
            elif taken:
                self.grip(not joystick.grip)
            if taken:
                blackboard.event(Code.GRIPPER, -1, float(joystick.grip))
        in_tool_frame = joystick.frame == "tool"
        jog.command(joystick.twist, in_tool_frame=in_tool_frame)
        if jog.phase is Phase.HOLD and joystick.moves:
            jog.start()
            jog.command(joystick.twist, in_tool_frame=in_tool_frame)
            motions.active = jog
            return True
        return False
