"""Drivers, one per kind of slave: convert process data to SI units and states, and back."""

from rtcp.devices.cia402 import Cia402Drive
from rtcp.devices.drive import Drive, TargetState
from rtcp.devices.driver import DeviceError, Driver, make_driver
from rtcp.devices.io_box import IoBox
from rtcp.ipc.states import DriveState

__all__ = ["Cia402Drive", "DeviceError", "Drive", "DriveState", "Driver", "IoBox", "TargetState", "make_driver"]
