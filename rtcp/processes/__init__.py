"""Processes beside motion; the interface for a package with one of its own (docs/processes.md)."""

from rtcp.config.model import InputChannel, OutputChannel, ProcessConfig
from rtcp.control.processes import Process, ProcessSetup, Signal

__all__ = ["InputChannel", "OutputChannel", "Process", "ProcessConfig", "ProcessSetup", "Signal"]
