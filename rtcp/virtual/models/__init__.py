"""Device models of the virtual segment: Cubemars ORH drives and the DIEWU IO box."""

from __future__ import annotations

from rtcp.virtual.device import create
from rtcp.virtual.models.cubemars import CubemarsDrive
from rtcp.virtual.models.diewu import DiewuIoBox

__all__ = ["CubemarsDrive", "DiewuIoBox", "create"]
