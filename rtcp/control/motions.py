"""The motion controllers of an arm and which of them is active."""

from __future__ import annotations

from rtcp.ipc.codes import MotionMode
from rtcp.ipc.commands import Jog, MoveJoints
from rtcp.ipc.states import DriveMode
from rtcp.motion.controllers import Controller, ControllerSetup, JogController, load_controllers
from rtcp.motion.state import ArmState, Phase

DRIVE_MODES = {"csp": DriveMode.CSP, "csv": DriveMode.CSV, "cst": DriveMode.CST}


class Motions:
    """All controllers of an arm; see `load_controllers`."""

    def __init__(self, setup: ControllerSetup) -> None:
        config = setup.config
        self.controllers = load_controllers(setup)
        self.generator = self.controllers[MoveJoints]
        jog = self.controllers.get(Jog)
        self.jog = jog if isinstance(jog, JogController) and jog.has_geometry else None
        self.active: Controller = self.generator
        self.mode = MotionMode[config.control_mode.upper()]
        """What the arm takes commands for."""
        self.drive_mode = DRIVE_MODES[config.drive_mode]
        """What moves, lines and jogs reach the drives in."""
        self.has_geometry = config.arm is not None

    def select(self, mode: MotionMode) -> None:
        """Take commands for `mode` from now on; at standstill."""
        self.mode = mode
        self.rest()

    def drive_mode_of(self, mode: MotionMode) -> DriveMode:
        """Return the drives' mode that a motion mode needs."""
        if mode is MotionMode.VELOCITY:
            return DriveMode.CSV
        return DriveMode.CST if mode is MotionMode.TORQUE else self.drive_mode

    def rest(self) -> None:
        """Hold where the set-points are; at standstill."""
        self.generator.hold()
        if self.jog is not None:
            # A jog that a fault ended in its midst would never be begun anew by the stick.
            self.jog.hold()
        self.active = self.generator

    def stop(self, state: ArmState) -> None:
        """Let what moves come to rest."""
        if self.active.phase is Phase.MOVE:
            self.active.stop(state)
