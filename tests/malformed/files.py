"""Files that are nearly right: cut, damaged, and with values in them that nobody meant."""

from __future__ import annotations

from random import Random

WORDS = (
    b"0", b"-1", b"1e308", b"-1e400", b".nan", b".inf", b"nan", b"1_0", b"0x7FFFFFFFFFFFFFFF", b"9" * 90, b"true",
    b"null", b"~", b"''", b'""', b"x", b"[]", b"{}", b"[[[]]]", b"{a: {b: c}}", b"*a", b"&a 1", b"!!float x", b"- 1",
    b"pi/0", b"pi**9", b"1;1", "\u00b2".encode(), "\u0663".encode(), b"\\ud800", b'"\\ud800"', b"../../etc/passwd",
    b"\x00", b"? x", b"%", b"@", b"'", b'"', b"{", b"[", b"a" * 3000,
)  # fmt: skip


def damaged(content: bytes, random: Random) -> bytes:
    """Return a file's content with one to three mutations."""
    found = bytearray(content)
    for _ in range(random.choice((1, 1, 2, 3))):
        _MUTATIONS[random.randrange(len(_MUTATIONS))](found, random)
    return bytes(found)


def _cut(found: bytearray, random: Random) -> None:
    del found[random.randrange(len(found) + 1) :]


def _flip(found: bytearray, random: Random) -> None:
    for _ in range(random.randrange(1, 5)):
        if found:
            found[random.randrange(len(found))] ^= 1 << random.randrange(8)


def _noise(found: bytearray, random: Random) -> None:
    at = random.randrange(len(found) + 1)
    found[at : at + random.randrange(30)] = random.randbytes(random.randrange(30))


def _line(found: bytearray, random: Random) -> None:
    """Take a line out, or put it in again elsewhere, once or often."""
    lines = found.splitlines(keepends=True)
    if lines:
        line = lines.pop(random.randrange(len(lines)))
        for _ in range(random.choice((0, 0, 1, 2, 50))):
            lines.insert(random.randrange(len(lines) + 1), line)
    found[:] = b"".join(lines)


def _indent(found: bytearray, random: Random) -> None:
    lines = found.splitlines(keepends=True)
    if lines:
        at = random.randrange(len(lines))
        lines[at] = random.choice((b"  ", b"\t", b" ", b"- ")) + lines[at]
    found[:] = b"".join(lines)


def _value(found: bytearray, random: Random) -> None:
    """Another value behind a colon or a comma, or in place of a number."""
    places = [at for at, byte in enumerate(found) if byte in b":,[{="]
    if places:
        at = random.choice(places) + 1
        end = at
        while end < len(found) and found[end] not in b",]}\n#":
            end += 1
        found[at:end] = b" " + random.choice(WORDS)


def _key(found: bytearray, random: Random) -> None:
    places = [at for at, byte in enumerate(found) if byte in b":"]
    if places:
        at = random.choice(places)
        found[at:at] = random.choice((b"x", b"_", b" ", b"0", b"\xff"))


_MUTATIONS = (_cut, _flip, _noise, _line, _indent, _value, _value, _value, _value, _key)
