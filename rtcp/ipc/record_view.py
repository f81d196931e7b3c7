"""The newest cycle record of another platform, for a loop: read without a lock, a copy or numpy."""

from __future__ import annotations

import mmap
import os
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rtcp.ipc.layout import (
    HEADER,
    MAGIC,
    RECORDS_AT,
    RECORDS_HEAD_AT,
    SCHEMA_AT,
    SCHEMA_SIZE,
    AtomicWords,
    file_size,
    records_for,
)
from rtcp.ipc.schema import RecordSchema, SchemaError


class RecordViewError(Exception):
    """The blackboard or a field of it is missing: a sentence."""


class RecordView:
    """Reads named fields of the newest record.

    Args:
        path: of the blackboard.
        names: of the fields.

    Raises:
        RecordViewError: there is no such blackboard, or a field is missing in it.
    """

    def __init__(self, path: Path, names: Sequence[str]) -> None:
        try:
            descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        except OSError as error:
            raise RecordViewError(f"{path} cannot be opened: {error.strerror}") from error
        try:
            status = os.fstat(descriptor)
            if status.st_size < RECORDS_AT:
                raise RecordViewError(f"{path} is cut short: {status.st_size} bytes")
            self._map = mmap.mmap(descriptor, status.st_size, prot=mmap.PROT_READ)
        finally:
            os.close(descriptor)
        magic, length, size, records, _, _, _, period, _, _ = HEADER.unpack_from(self._map, 0)
        try:
            if magic != MAGIC or not 0 < length <= SCHEMA_SIZE or period <= 0 or records != records_for(period):
                raise SchemaError("its head is of another version")
            schema = RecordSchema.from_definition(self._map[SCHEMA_AT : SCHEMA_AT + length])
            if size != schema.size or status.st_size != file_size(size, records):
                raise SchemaError("its size is not that of its schema")
            self._fields = [_place(schema, name) for name in names]
        except (SchemaError, KeyError) as error:
            raise RecordViewError(f"{path} is not a blackboard of this version, or not of a cell: {error}") from error
        self.count = sum(count for _, count, _ in self._fields)
        """How many numbers `read` writes."""
        self._size, self._mask = size, records - 1
        self._words = AtomicWords(self._map)
        # Every page is touched now, none in the cycle.
        for page in range(0, status.st_size, mmap.PAGESIZE):
            self._map[page]

    def read(self, values: list[Any]) -> bool:
        """Write the numbers of the fields into `values`, one after the other; return whether the record is whole."""
        del values[self.count :]
        words = self._words
        number = words.acquire(RECORDS_HEAD_AT)
        at = RECORDS_AT + (number & self._mask) * self._size
        if not number or words.acquire(at) != number:
            return False
        to = 0
        for offset, count, unpack in self._fields:
            values[to : to + count] = unpack(self._map, at + offset)
            to += count
        words.fence()
        return words[at] == number


def replace_view(views: list[RecordView | None], index: int, view: RecordView | None) -> None:
    """Store a view in a list that another thread reads.

    Compiled code releases what it replaces before it stores the new object. The release of a mapping lets other threads
    run, and they would read an object that is freed. The interpreter stores first: this module must not be compiled.
    """
    views[index] = view


def _place(schema: RecordSchema, name: str) -> tuple[int, int, Any]:
    """Return the offset of a field in the record, its count of numbers, and the function that unpacks it."""
    before = 0
    for field in schema.fields:
        if field.name == name:
            return before, field.count, struct.Struct("<" + field.code).unpack_from
        before += struct.calcsize("<" + field.code)
    raise KeyError(name)
