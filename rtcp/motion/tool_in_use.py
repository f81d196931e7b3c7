"""The tool and the payload in use, and the weight of the arm with both."""

from __future__ import annotations

from collections.abc import Sequence

from kinematics.gravity import STANDARD_GRAVITY, gravity_torques
from kinematics.model import LinkMass
from rtcp.config.model import ArmConfig


class ToolInUse:
    """`number`: of the tool, an index into `ArmConfig.models`. `payload`: in the tool's frame, or None.

    Shared by all controllers; only `rtcp.control.arm.Arm` writes it, at rest.
    """

    __slots__ = ("number", "payload")

    def __init__(self) -> None:
        self.number = 0
        self.payload: LinkMass | None = None


class Gravity:
    """Gravity compensation of an arm with the tool and the payload in use.

    Args:
        config: of the arm; without geometry or masses the torques are 0.
        tool: read at each call.
    """

    def __init__(self, config: ArmConfig, tool: ToolInUse) -> None:
        self._models = [model for model in config.models if model.links]
        self._tool = tool
        self._none = (0.0,) * len(config.joints)

    @property
    def is_known(self) -> bool:
        """Whether the masses are known."""
        return bool(self._models)

    def torques(self, q: Sequence[float]) -> Sequence[float]:
        """Return the torques that hold the arm still at `q`, rad: Nm, one per joint; 0 if masses are unknown."""
        if not self._models:
            return self._none
        tool = self._tool
        return gravity_torques(self._models[tool.number], q, STANDARD_GRAVITY, tool.payload)
