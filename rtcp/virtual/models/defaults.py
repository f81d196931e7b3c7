"""The values that a device's objects have at power-on."""

from __future__ import annotations

from rtcp.virtual.objects import ObjectDictionary


class Defaults:
    """Remembers the values that `objects` have now; what an SDO changes in a device is not stored."""

    def __init__(self, objects: ObjectDictionary) -> None:
        self._values = [(entry, entry.value) for found in objects for entry in found.entries.values()]

    def restore(self) -> None:
        """Give each entry its value back, past its access rights and checks."""
        for entry, value in self._values:
            entry.value = value
