"""One driver a kind of slave: bytes on the wire on one side, SI units and states on the other."""

from rtcp.devices.cia402 import Cia402Drive, DriveGoal, DriveState
from rtcp.devices.codec import DeviceError
from rtcp.devices.io_box import IoBox

__all__ = ["Cia402Drive", "DeviceError", "DriveGoal", "DriveState", "IoBox"]
