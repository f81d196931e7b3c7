"""Controls and lamps at the arm, each at an IO box: joystick, toggle, enabling switch, emergency stop."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from rtcp.config.buses import CONTROLLER_STATUS
from rtcp.config.model import ArmConfig
from rtcp.control.arm import Arm
from rtcp.control.gripper import DrivenGripper
from rtcp.control.part import Part, PartContext
from rtcp.devices.driver import DeviceError, Driver
from rtcp.devices.io_box import AnalogStick, Inputs, IoBox, JoystickInput, Outputs
from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.events import (
    GripperCloses,
    GripperOpens,
    JoystickGranted,
    JoystickModeChanged,
    JoystickOutOfRange,
    JoystickWithdrawn,
    UnknownJoystickCode,
)
from rtcp.ipc.schema import OPERATOR_FIELDS
from rtcp.ipc.states import ControlMode, State
from rtcp.motion.controllers.joystick import Joystick, Shown
from rtcp.motion.state import Phase

UNREAD_S: Final = 0.5
"""Time without a reading after which an emergency stop counts as pressed and an enabling switch as released, s. It is
the longest `silence_s` of a cell, so that arms in step brake along their paths first."""


class Operator(Part):
    """Reads the inputs with a function, jogs the arm by the joystick, and writes the outputs with a function.

    Args:
        config: configuration of the inputs and outputs.
        drivers: the slaves that are no drives, by name; without an IO box no button is pressed, motion is permitted and
            there is no joystick.
        driven: the gripper where it has a drive.

    Raises:
        DeviceError: an input or output with a function is not at an IO box, so it would be ignored; or no slave sends a
            channel of the joystick.
    """

    def __init__(self, config: ArmConfig, drivers: Mapping[str, Driver], driven: DrivenGripper | None) -> None:
        super().__init__("operator", OPERATOR_FIELDS)
        boxes = {name: driver for name, driver in drivers.items() if isinstance(driver, IoBox)}
        told = [[each for each in drivers.values() if name in each.values] for name, _, _ in CONTROLLER_STATUS]
        self._tell_power, self._tell_stop, self._tell_mode = told
        cycle_s = config.cycle.period_us * 1e-6
        inputs, outputs, gripper = config.inputs, config.outputs, config.gripper
        self._inputs = Inputs(inputs, cycle_s)
        self._outputs = Outputs(outputs, gripper)
        self._input = JoystickInput(inputs, cycle_s)
        stick = inputs.joystick
        self._analog = None if stick is None or stick.analog is None else AnalogStick(stick, drivers, cycle_s)
        self._shown: Shown = self._input if self._analog is None else self._analog
        self._joystick = Joystick(config.jog)
        self._driven = driven
        self._stop_box = boxes.get(config.box_of(inputs.emergency_stop))
        switch = inputs.enabling_switch
        self._switch_box = None if switch is None else boxes.get(config.box_of(switch))
        self._toggle_box = boxes.get(config.box_of(inputs.arm_toggle))
        self._stick_box = boxes.get(config.box_of(inputs.joystick))
        self._lamp_box = boxes.get(config.box_of(outputs))
        self._grip_box = boxes.get(config.box_of(gripper))
        output = None if gripper is None or gripper.output is None else gripper
        users = (inputs.emergency_stop, inputs.enabling_switch, inputs.arm_toggle, inputs.joystick, output)
        for user in users:
            if user is not None and config.box_of(user) not in boxes:
                box = config.box_of(user) or "none of the slaves"
                raise DeviceError(f"{type(user).__name__} needs an IO box: {box} is none, or has no driver of one")
        names = [slave.name for slave in config.slaves]
        self.stop_position = 0 if self._stop_box is None else 1 + names.index(self._stop_box.name)
        """Position on the cable of the box with the emergency stop; 0: no box."""
        self._was_granted = True
        self._code_reported = False
        self.emergency_stop = self._stop_box is not None and self._inputs.emergency_stop.active
        """Whether the emergency stop is pressed; true until the box was read."""
        self.permitted = self._switch_box is None or self._inputs.enabling_switch.active
        """Whether the enabling switch allows motion."""
        self._unread_limit = round(UNREAD_S / cycle_s)
        self.unread_cycles = self._missed = self._unread_limit
        """Consecutive cycles in which the emergency stop was not read, and in which not all inputs arrived: before the
        first cycle they never have."""
        self.joystick_granted = False
        lamps = [(config.box_of(outputs), led) for led in (outputs.state_lamp, outputs.motion_lamp, outputs.heartbeat)]
        grip = None if gripper is None else gripper.output
        self.reserved = frozenset((*lamps, (config.box_of(gripper), grip)))
        """Box and number of each output that commands may not switch."""
        self.has_button = self._stop_box is not None and inputs.emergency_stop is not None
        """Whether a box has an emergency stop."""
        self.has_gripper = self._grip_box is not None and grip is not None

    @property
    def joystick_mode(self) -> int:
        """Axes of the joystick: 0 X-Y, 1 Z-yaw, 2 roll-pitch, 3 gripper."""
        return self._joystick.mode

    def publish(self, values: list[Any]) -> None:
        """Write the joystick's mode."""
        values[self.at] = self._joystick.mode

    def read(self) -> None:
        """Read the inputs of the cycle."""
        inputs = self._inputs
        self.unread_cycles = self._missed = 0
        if self._stop_box is not None:
            inputs.emergency_stop.read(self._stop_box.inputs)
            self.emergency_stop = inputs.emergency_stop.active
        if self._switch_box is not None:
            inputs.enabling_switch.read(self._switch_box.inputs)
            self.permitted = inputs.enabling_switch.active
        if self._toggle_box is not None:
            inputs.arm_toggle.read(self._toggle_box.inputs)
            self.joystick_granted = inputs.arm_toggle.active
        if self._stick_box is not None:
            self._input.read(self._stick_box.inputs)
            if self._analog is not None:
                self._analog.read(self._input)

    def read_emergency_stop(self) -> None:
        """Update the emergency stop to pressed where it is; never to released."""
        if self._stop_box is not None:
            stop = self._inputs.emergency_stop
            stop.read_active(self._stop_box.inputs)
            self.emergency_stop = stop.active
            self.unread_cycles = 0

    def miss(self) -> None:
        """Count a cycle in which not all inputs arrived: after `UNREAD_S` the enabling switch counts as released."""
        self._missed += 1
        if self._missed > self._unread_limit and self._switch_box is not None:
            self.permitted = False

    @property
    def stop_unread(self) -> bool:
        """Whether the emergency stop was not read for `UNREAD_S`: for the partners it counts as pressed."""
        return self.has_button and self.unread_cycles > self._unread_limit

    @property
    def drives_powered(self) -> int:
        """Whether motors that a robot controller powers are on: 1 or 0; -1: it does not tell, or was not read."""
        return self._told(self._tell_power, "drives_powered")

    @property
    def e_stopped(self) -> int:
        """Whether the emergency stop is pressed, here or at a robot controller: 1 or 0; -1: it was not read, or no
        slave tells.
        """
        here = int(self.emergency_stop) if self.has_button and not self.stop_unread else -1
        return max(here, self._told(self._tell_stop, "e_stopped"))

    def _told(self, drivers: list[Driver], channel: str) -> int:
        """Return the largest value of a channel of `CONTROLLER_STATUS`; -1: there is none, or it was not read."""
        told = -1
        if self._missed <= self._unread_limit:
            for driver in drivers:
                told = max(told, int(driver.values[channel]))
        return told

    @property
    def operating_mode(self) -> int:
        """Position of a robot controller's key: 1 manual, 2 automatic; -1: unknown, not read, or two differ."""
        told = self._told(self._tell_mode, "operating_mode")
        for driver in self._tell_mode:
            if int(driver.values["operating_mode"]) != told:
                return -1
        return told

    @property
    def holds_grip(self) -> bool:
        """Whether the joystick is deflected to open or close the gripper."""
        return self.joystick_granted and self._joystick.holds_grip

    @property
    def button_known(self) -> bool:
        """Whether the emergency stop was read for its debounce time since `assume_released`."""
        return self._stop_box is None or self._inputs.emergency_stop.settled

    def assume_released(self) -> None:
        """Treat the emergency stop as released until its box reports it pressed."""
        self._inputs.emergency_stop.forget()
        self.emergency_stop = False
        self.unread_cycles = 0

    def update(self, context: PartContext) -> None:
        """Switch the lamps and toggle the heartbeat."""
        box = self._lamp_box
        if box is not None:
            box.outputs = self._outputs.write(box.outputs, context.all_enabled, context.state is State.MOVING)

    def clear_outputs(self, box: IoBox) -> None:
        """Clear all outputs of a box except the lamps, as a box itself does when it leaves OP."""
        box.outputs = self._outputs.lamps(box.outputs) if box is self._lamp_box else 0

    def require_neutral(self) -> None:
        """Ignore the joystick until it was neutral once."""
        self._joystick.wait_for_neutral()

    def begin_joystick(self, blackboard: Blackboard) -> None:
        """Begin with the joystick's first mode, as after the start; a forward push must not open the gripper."""
        changes = self._joystick.mode != 0
        self._joystick.begin()
        if changes:
            blackboard.event(JoystickModeChanged(0))

    def grip(self, close: bool) -> None:
        """Close or open the gripper on its output."""
        if self._grip_box is not None:
            self._grip_box.outputs = self._outputs.grip(self._grip_box.outputs, close)

    def jog_by_joystick(self, arm: Arm, blackboard: Blackboard) -> bool:
        """Command the jog in control mode joystick; return whether the arm has to start a motion.

        Called in every cycle in which the arm holds, or moves by the joystick.
        """
        jog = arm.jog
        if arm.control_mode is not ControlMode.JOYSTICK or jog is None:
            return False
        granted = self.joystick_granted
        if granted is not self._was_granted:
            self._was_granted = granted
            blackboard.event(JoystickGranted() if granted else JoystickWithdrawn())
        lines, analog, shown, joystick = self._input, self._analog, self._shown, self._joystick
        before = joystick.mode
        joystick.update(shown, granted and self.permitted)
        if joystick.mode != before:
            blackboard.event(JoystickModeChanged(joystick.mode))
        if shown.valid:
            self._code_reported = False
        elif granted:
            if not self._code_reported:
                out = analog is not None and not analog.in_range
                blackboard.event(JoystickOutOfRange() if out else UnknownJoystickCode(lines.code))
            self._code_reported = True
        if joystick.grip is not None:
            self._grip_by_joystick(blackboard, opens=joystick.grip)
        jog.command(joystick.twist, in_tool_frame=joystick.frame == "tool")
        if jog.phase is Phase.HOLD and joystick.moves:
            jog.start()
            jog.command(joystick.twist, in_tool_frame=joystick.frame == "tool")
            arm.active = jog
            return True
        return False

    def _grip_by_joystick(self, blackboard: Blackboard, opens: bool) -> None:
        accepted = self.has_gripper
        if self._driven is not None:
            accepted = self._driven.grip(not opens)
        elif accepted:
            self.grip(not opens)
        if accepted:
            blackboard.event(GripperOpens() if opens else GripperCloses())
