"""Motion controllers: they turn commands into setpoints, once a cycle."""

from rtcp.motion.controllers.controller import Controller, ControllerSetup, load_controllers
from rtcp.motion.controllers.jog import JogController

__all__ = ["Controller", "ControllerSetup", "JogController", "load_controllers"]
