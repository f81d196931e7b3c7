"""One driver a kind of slave: bytes on the wire on one side, SI units and states on the other."""

from rtcp.devices.cia402 import Cia402Drive
from rtcp.devices.drive import Drive, TargetState
from rtcp.devices.driver import DeviceError, Driver, make_driver
from rtcp.devices.io_box import IoBox
from rtcp.ipc.states import DriveState

__all__ = ["Cia402Drive", "DeviceError", "Drive", "DriveState", "Driver", "IoBox", "TargetState", "make_driver"]
