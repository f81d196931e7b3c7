"""Controls and lamps at the arm: joystick, toggle, enabling switch, emergency stop."""

from __future__ import annotations

from rtcp.config.model import ArmConfig
from rtcp.control.arm import Arm
from rtcp.devices.io_box import Inputs, IoBox, JoystickInput, Outputs
from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.events import (
    GripperCloses,
    GripperOpens,
    JoystickGranted,
    JoystickModeChanged,
    JoystickWithdrawn,
    UnknownJoystickCode,
)
from rtcp.ipc.states import ControlMode
from rtcp.motion.controllers.joystick import Joystick
from rtcp.motion.state import Phase


class Operator:
    """Reads the inputs with a function, jogs the arm by the joystick, and writes the outputs with a function.

    Args:
        config: which they are.
        box: the IO box, or None: then nothing is pressed, nothing is forbidden and there is no joystick.
    """

    def __init__(self, config: ArmConfig, box: IoBox | None) -> None:
        cycle_s = config.cycle.period_us * 1e-6
        self._box = box
        self.box_position = 0 if box is None else 1 + [slave.name for slave in config.slaves].index(box.name)
        """The box's position on the cable; 0: there is none."""
        self._inputs = Inputs(config.inputs, cycle_s)
        self._outputs = Outputs(config.outputs, config.gripper)
        self._input = JoystickInput(config.inputs, cycle_s)
        self._joystick = Joystick(config.jog)
        self._was_granted = True
        self._code_reported = False
        self.emergency_stop = box is not None and self._inputs.emergency_stop.active
        """Whether it is pressed; until the box was read it is."""
        self.permitted = box is None or self._inputs.enabling_switch.active
        """Whether the enabling switch allows motion."""
        self.joystick_granted = False
        self.reserved = self._outputs.meant
        """Numbers of the outputs with a function."""
        self.has_button = box is not None and config.inputs.emergency_stop is not None
        """Whether there is an emergency stop at the box."""
        self.has_gripper = box is not None and config.gripper is not None and config.gripper.output is not None

    @property
    def joystick_mode(self) -> int:
        """0 X-Y, 1 Z-yaw, 2 roll-pitch, 3 gripper."""
        return self._joystick.mode

    def read(self) -> None:
        """Read the inputs of the cycle."""
        box, inputs = self._box, self._inputs
        if box is None:
            return
        levels = box.inputs
        inputs.read(levels)
        self._input.read(levels)
        self.emergency_stop = inputs.emergency_stop.active
        self.permitted = inputs.enabling_switch.active
        self.joystick_granted = inputs.arm_toggle.active

    def read_emergency_stop(self) -> None:
        """Read that the emergency stop is pressed; never that it was released."""
        if self._box is not None:
            stop = self._inputs.emergency_stop
            stop.read_active(self._box.inputs)
            self.emergency_stop = stop.active

    @property
    def holds_grip(self) -> bool:
        """Whether the joystick is held where it opens or closes the gripper."""
        return self.joystick_granted and self._joystick.holds_grip

    @property
    def button_known(self) -> bool:
        """Whether the emergency stop was read for long enough since `assume_released`."""
        return self._box is None or self._inputs.emergency_stop.settled

    def assume_released(self) -> None:
        """Let the emergency stop count as released until the box shows otherwise."""
        self._inputs.emergency_stop.forget()
        self.emergency_stop = False

    def write_outputs(self, powered: bool, moving: bool) -> None:
        """Switch the lamps and toggle the heartbeat."""
        if self._box is not None:
            self._box.outputs = self._outputs.write(self._box.outputs, powered, moving)

    def clear_outputs(self) -> None:
        """Clear all outputs but the lamps, as a box does that leaves OP."""
        if self._box is not None:
            self._box.outputs = self._outputs.lamps(self._box.outputs)

    def require_neutral(self) -> None:
        """Ignore the joystick until it has been neutral."""
        self._joystick.wait_for_neutral()

    def grip(self, close: bool) -> None:
        """Close or open the gripper on its output."""
        if self._box is not None:
            self._box.outputs = self._outputs.grip(self._box.outputs, close)

    def jog_by_joystick(self, arm: Arm, blackboard: Blackboard) -> bool:
        """Command the jog in control mode joystick; return whether the arm has to start moving.

        Called every cycle in which the arm holds, or moves by the joystick.
        """
        jog = arm.jog
        if arm.control_mode is not ControlMode.JOYSTICK or jog is None:
            return False
        granted = self.joystick_granted
        if granted is not self._was_granted:
            self._was_granted = granted
            blackboard.event(JoystickGranted() if granted else JoystickWithdrawn())
        shown, joystick = self._input, self._joystick
        before = joystick.mode
        joystick.update(shown, granted and self.permitted)
        if joystick.mode != before:
            blackboard.event(JoystickModeChanged(joystick.mode))
        if shown.valid:
            self._code_reported = False
        elif granted:
            if not self._code_reported:
                blackboard.event(UnknownJoystickCode(shown.code))
            self._code_reported = True
        if joystick.grip is not None:
            self._grip_by_joystick(arm, blackboard, opens=joystick.grip)
        jog.command(joystick.twist, in_tool_frame=joystick.frame == "tool")
        if jog.phase is Phase.HOLD and joystick.moves:
            jog.start()
            jog.command(joystick.twist, in_tool_frame=joystick.frame == "tool")
            arm.active = jog
            return True
        return False

    def _grip_by_joystick(self, arm: Arm, blackboard: Blackboard, opens: bool) -> None:
        accepted = self.has_gripper
        if arm.gripper is not None:
            accepted = arm.gripper.grip(not opens)
        elif accepted:
            self.grip(not opens)
        if accepted:
            blackboard.event(GripperOpens() if opens else GripperCloses())
