"""What a bus raises; apart from the modules that raise it, so that all of them may import it."""

from __future__ import annotations


class BusError(Exception):
    """The bus, or a slave on it, refused or failed; `sentences` say what, where, found and expected."""

    def __init__(self, *sentences: str) -> None:
        super().__init__("\n".join(sentences))
        self.sentences = sentences


class SdoAborted(BusError):
    """The slave refused an SDO service with an abort code (`code`, ETG.1000.6, table 41)."""

    def __init__(self, sentence: str, code: int) -> None:
        super().__init__(sentence)
        self.code = code


class ForeignSlave(BusError):
    """Another device answers at the place of a slave; nothing is written to it."""
