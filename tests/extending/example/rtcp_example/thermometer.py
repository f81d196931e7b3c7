"""The driver of a terminal with two temperature channels."""

from rtcp.devices import Driver


class Thermometer(Driver):
    """Temperatures of both channels in `values`, K."""

    REQUIRED_INPUTS = ("first", "second")
