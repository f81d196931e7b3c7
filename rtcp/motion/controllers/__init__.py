"""Motion controllers: what turns commands into setpoints, a cycle at a time."""

from rtcp.motion.controllers.controller import Controller, ControllerSetup, load_controllers
from rtcp.motion.controllers.jog import JogController

__all__ = ["Controller", "ControllerSetup", "JogController", "load_controllers"]
