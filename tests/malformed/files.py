"""Damaged files: cut, with changed bytes, and with other values."""

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
    mutant = bytearray(content)
    for _ in range(random.choice((1, 1, 2, 3))):
        _MUTATIONS[random.randrange(len(_MUTATIONS))](mutant, random)
    return bytes(mutant)


def _cut(content: bytearray, random: Random) -> None:
    del content[random.randrange(len(content) + 1) :]


def _flip(content: bytearray, random: Random) -> None:
    for _ in range(random.randrange(1, 5)):
        if content:
            content[random.randrange(len(content))] ^= 1 << random.randrange(8)


def _noise(content: bytearray, random: Random) -> None:
    at = random.randrange(len(content) + 1)
    content[at : at + random.randrange(30)] = random.randbytes(random.randrange(30))


def _line(content: bytearray, random: Random) -> None:
    """Remove a line, or insert it elsewhere, once or often."""
    lines = content.splitlines(keepends=True)
    if lines:
        line = lines.pop(random.randrange(len(lines)))
        for _ in range(random.choice((0, 0, 1, 2, 50))):
            lines.insert(random.randrange(len(lines) + 1), line)
    content[:] = b"".join(lines)


def _indent(content: bytearray, random: Random) -> None:
    lines = content.splitlines(keepends=True)
    if lines:
        at = random.randrange(len(lines))
        lines[at][:0] = random.choice((b"  ", b"\t", b" ", b"- "))
    content[:] = b"".join(lines)


def _value(content: bytearray, random: Random) -> None:
    """Another value behind a colon or a comma, or in place of a number."""
    places = [at for at, byte in enumerate(content) if byte in b":,[{="]
    if places:
        at = random.choice(places) + 1
        end = at
        while end < len(content) and content[end] not in b",]}\n#":
            end += 1
        content[at:end] = b" " + random.choice(WORDS)


def _key(content: bytearray, random: Random) -> None:
    places = [at for at, byte in enumerate(content) if byte in b":"]
    if places:
        at = random.choice(places)
        content[at:at] = random.choice((b"x", b"_", b" ", b"0", b"\xff"))


_MUTATIONS = (_cut, _flip, _noise, _line, _indent, _value, _value, _value, _value, _key)
