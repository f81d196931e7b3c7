"""Exceptions of a bus; in a module of their own, which all modules of the bus may import."""

from __future__ import annotations


class BusError(Exception):
    """The bus or a slave refused or failed; `sentences` name the failure, its place, the values found and expected."""

    def __init__(self, *sentences: str) -> None:
        super().__init__("\n".join(sentences))
        self.sentences = sentences


class Refused(BusError):
    """The slave refused a mailbox service, with an error code."""

    def __init__(self, sentence: str, code: int) -> None:
        super().__init__(sentence)
        self.code = code


class SdoAborted(Refused):
    """The slave aborted an SDO service; `code` is the abort code (ETG.1000.6, table 41)."""


class FoeRefused(Refused):
    """The slave refused a file; `code` is the error code (ETG.1000.6, table 92)."""


class ValueNotKept(BusError):
    """A slave does not keep a value that was written in its set-up: the object, the value wanted and the one found."""

    def __init__(self, sentence: str, index: int, sub_index: int, wanted: str, found: str) -> None:
        super().__init__(sentence)
        self.index, self.sub_index = index, sub_index
        self.wanted, self.found = wanted, found


class ForeignSlave(BusError):
    """Another device answers at the position of a slave; nothing is written to it."""
