"""Processes beside motion; what a package needs that brings one (docs/processes.md)."""

from rtcp.config.model import InputChannel, OutputChannel, ProcessConfig
from rtcp.control.processes import Process, ProcessSetup, Signal

__all__ = ["InputChannel", "OutputChannel", "Process", "ProcessConfig", "ProcessSetup", "Signal"]
