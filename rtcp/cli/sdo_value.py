"""Objects of a slave as people write them: indices, typed values, and guesses at untyped ones (little endian)."""

from __future__ import annotations

import math
import re
import struct

from rtcp.cli.errors import CommandError
from rtcp.config.plain_number import plain_number

INTEGER_TYPES = {
    f"{sign}int{bits}": (bits // 8, sign == "") for bits in (8, 16, 32, 64) for sign in ("u", "")
}  # name -> (bytes, signed)

FLOAT_TYPES = {"float32": struct.Struct("<f"), "float64": struct.Struct("<d")}

TYPES = ("bool", *INTEGER_TYPES, *FLOAT_TYPES, "string", "bytes")

_OBJECT = re.compile(r"(?:0x(?P<prefixed>[0-9a-f]+)|(?P<suffixed>[0-9][0-9a-f]*)h)(?::(?P<sub>\w+))?", re.IGNORECASE)


def parse_object(text: str) -> tuple[int, int]:
    """Return index and subindex of `0x6041`, `6041h`, `0x1018:1` or `0x1018:0x01`.

    Raises:
        CommandError: when it is none of these or out of range.
    """
    found = _OBJECT.fullmatch(text)
    if not found:
        raise CommandError(
            f"{text!r} is no object: write the index in hex, as 0x6041 or 6041h, and 0x1018:1 for a subindex"
        )
    index = int(found["prefixed"] or found["suffixed"], 16)
    if index > 0xFFFF:
        raise CommandError(f"index 0x{index:X} is too large: at most 0xFFFF")
    subindex = _integer(found["sub"] or "0", "subindex")
    if not 0 <= subindex <= 0xFF:
        raise CommandError(f"subindex {subindex} is not allowed: 0 to 255")
    return index, subindex


def check_type(name: str) -> str:
    """Return the type's name in lower case.

    Raises:
        CommandError: naming the known ones.
    """
    if name.lower() not in TYPES:
        raise CommandError(f"type {name!r} is not known: {', '.join(TYPES)}")
    return name.lower()


def encode(text: str, type_name: str) -> bytes:
    """Return the bytes that go over the wire for a value as it was written.

    Raises:
        CommandError: when it is no such value or does not fit, with the range.
    """
    if type_name == "string":
        return text.encode()
    if type_name == "bytes":
        try:
            return bytes.fromhex(text.removeprefix("0x"))
        except ValueError as error:
            raise CommandError(f"{text!r} is not bytes in hex, as 01ff") from error
    if type_name in FLOAT_TYPES:
        return _encode_float(text, type_name)
    if type_name == "bool":
        if text.lower() not in ("0", "1", "true", "false"):
            raise CommandError(f"{text!r} does not fit bool: 0, 1, true or false")
        return b"\x01" if text.lower() in ("1", "true") else b"\x00"
    size, signed = INTEGER_TYPES[type_name]
    number = _integer(text, type_name)
    lowest, highest = (-(1 << 8 * size - 1), (1 << 8 * size - 1) - 1) if signed else (0, (1 << 8 * size) - 1)
    if not lowest <= number <= highest:
        raise CommandError(f"{text} does not fit {type_name}: {lowest} to {highest}")
    return number.to_bytes(size, "little", signed=signed)


def decode(data: bytes, type_name: str) -> str:
    """Return the value that the bytes hold, as text.

    Raises:
        CommandError: when they are not as many as the type has.
    """
    if type_name == "string":
        return data.rstrip(b"\0").decode(errors="replace")
    if type_name == "bytes":
        return data.hex()
    size = FLOAT_TYPES[type_name].size if type_name in FLOAT_TYPES else INTEGER_TYPES.get(type_name, (1, False))[0]
    if len(data) != size:
        raise CommandError(
            f"the object has {len(data)} bytes ({data.hex() or 'none'}), {type_name} has {size}: choose another --type"
        )
    if type_name in FLOAT_TYPES:
        return repr(float(FLOAT_TYPES[type_name].unpack(data)[0]))
    if type_name == "bool":
        return "true" if data[0] else "false"
    return str(int.from_bytes(data, "little", signed=INTEGER_TYPES[type_name][1]))


def guesses(data: bytes) -> str:
    """Return the bytes in hex and what they may mean: integers of that size, text when all of it is printable."""
    parts = [data.hex(" ") or "(empty)"]
    for name, (size, signed) in INTEGER_TYPES.items():
        if size == len(data):
            number = int.from_bytes(data, "little", signed=signed)
            if not signed:
                parts.append(f"{name} {number} (0x{number:0{2 * size}X})")
            elif number < 0:
                parts.append(f"{name} {number}")
    text = data.rstrip(b"\0")
    if len(text) > 1 and all(0x20 <= byte < 0x7F for byte in text):
        parts.append(f"string {text.decode()!r}")
    return "   ".join(parts)


def _encode_float(text: str, type_name: str) -> bytes:
    try:
        number = plain_number(text)
        packed = FLOAT_TYPES[type_name].pack(number)
    except ValueError as error:
        raise CommandError(f"{text!r} is not a number ({type_name})") from error
    except OverflowError as error:
        raise CommandError(f"{text} does not fit {type_name}") from error
    if not math.isfinite(number):
        raise CommandError(f"{text} is not finite, {type_name} is to be")
    return packed


def _integer(text: str, what: str) -> int:
    """Return a whole number written in decimal or, after 0x, in hex."""
    try:
        if "_" in text or not text.isascii():
            raise ValueError
        return int(text, 16) if text.lower().lstrip("+-").startswith("0x") else int(text)
    except ValueError as error:
        raise CommandError(f"{text!r} is not a whole number ({what})") from error
