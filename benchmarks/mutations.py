"""Damage files as disks, transfers, programs and people do: bytes, tokens of text, values of JSON, chunks of PNG."""

from __future__ import annotations

import json
import re
import struct
import zlib
from collections.abc import Callable
from random import Random
from typing import Any

MOST_DAMAGES = 3
"""In one file."""
EXTREME_NUMBERS = tuple(
    b"0 -0.0 -1 1 3.5 255 65536 2147483648 4294967295 9223372036854775808 -9223372036854775809 1e-320 1e15 1e16 1e38 "
    b"1e308 -1e308 1e400 NaN Infinity -Infinity nan inf 1e 0x10 1,5 1_000".split()
)
TOKENS = (
    *EXTREME_NUMBERS,
    *(b"", b'""', b"null", b"true", b"[]", b"{}", b"-", b"\0", b"\n", b"\xff\xfe", b"../../x", b"/etc/passwd", b"#"),
    *(b"9" * 5000, b"a" * 5000, "Größe\u202e\U0001f30a".encode(), b"%s%n"),
)
NESTED = b"[" * 100_000
"""Deeper than any parser goes by recursion."""
JSON_VALUES: tuple[Any, ...] = (
    *(0, -1, 1, 3.5, 2**31, 2**63, 10**400, 1e15, 1e16, 1e308, -1e308, float("nan"), float("inf"), 1e-320),
    *(None, True, False, "", "x", "../../x", "\0", "\ud800", "1", [], {}, [[]], [0], [1.0, 2.0, 3.0], {"": None}),
    *("a" * 5000, [0.0] * 5000, ["x", "x"]),
)
BYTES = (
    *(b"\0", b"\xff", b"\x7f", b"\x80", b"\0" * 8, b"\xff" * 4, b"\xff" * 8, b"\0\0\0\0\0\0\0\x80"),
    *(struct.pack("<d", value) for value in (float("nan"), float("inf"), 1e308, -1.0, 1e-320)),
    *(struct.pack(order + "I", value) for order in "<>" for value in (1, 2**16, 2**31, 2**32 - 1)),
)
_NUMBER = re.compile(rb"[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
_WORD = re.compile(rb"[^\s,;:\[\]{}\"']+")
_PNG = b"\x89PNG\r\n\x1a\n"
Mutation = Callable[[bytes, Random], bytes]


def mutate(content: bytes, random: Random) -> bytes:
    """Damage a file in one to three places, each in a way that its format allows."""
    damaged = content
    while damaged == content:
        for _ in range(random.randint(1, MOST_DAMAGES)):
            damaged = random.choice(_mutations(damaged))(damaged, random)
    return damaged


def _mutations(content: bytes) -> list[Mutation]:
    found: list[Mutation] = [_bytes, _bytes, _tokens]
    if content[:1] in (b"{", b"["):
        found += [mutate_json] * 6
    elif content.startswith(_PNG):
        found += [_png_chunk] * 2
    elif b"\0" not in content:
        found += [_tokens, _lines, _lines]
    return found


def _span(content: bytes, random: Random) -> tuple[int, int]:
    """A part of the content, short ones more often than long ones."""
    start = random.randint(0, len(content))
    return start, min(len(content), start + int(2 ** random.uniform(0, 12)))


def _bytes(content: bytes, random: Random) -> bytes:
    """Flip bits, cut, insert, overwrite, repeat or swap parts."""
    start, end = _span(content, random)
    part = content[start:end]
    kind = random.randrange(8)
    if kind == 0:
        flipped = bytearray(content)
        for _ in range(random.randint(1, 8) if content else 0):
            flipped[random.randrange(len(content))] ^= 1 << random.randrange(8)
        return bytes(flipped)
    if kind == 1:
        return content[:start]
    if kind == 2:
        return content[:start] + random.randbytes(random.randint(1, 64)) + content[start:]
    if kind == 3:
        value = random.choice(BYTES)
        return content[:start] + value + content[start + len(value) :]
    if kind == 4:
        return content[:start] + content[end:]
    if kind == 5:
        return content[:end] + part * random.randint(1, 4) + content[end:]
    if kind == 6:
        return content[:start] + bytes(len(part)) + content[end:]
    other, other_end = _span(content, random)
    if other < end:
        start, end, other, other_end = other, min(other_end, start), start, end
    return content[:start] + content[other:other_end] + content[end:other] + content[start:end] + content[other_end:]


def _tokens(content: bytes, random: Random) -> bytes:
    """Replace a number or a word, also one in the header of a binary file."""
    found = list((_NUMBER if random.random() < 0.6 else _WORD).finditer(content[:1_000_000]))
    if not found:
        return content + random.choice(TOKENS)
    match = random.choice(found[:20] if random.random() < 0.3 else found)
    new = NESTED if random.random() < 0.01 else random.choice(TOKENS)
    return content[: match.start()] + new + content[match.end() :]


def _lines(content: bytes, random: Random) -> bytes:
    """Delete, repeat, swap or cut lines, or change how they end."""
    lines = content.split(b"\n")
    i, j, kind = random.randrange(len(lines)), random.randrange(len(lines)), random.randrange(6)
    if kind == 0:
        del lines[i]
    elif kind == 1:
        lines.insert(j, lines[i])
    elif kind == 2:
        lines[i], lines[j] = lines[j], lines[i]
    elif kind == 3:
        lines[i] = lines[i][: random.randint(0, len(lines[i]))]
    elif kind == 4:
        return random.choice((b"\r\n", b"\r", b"", b"\x0b", "\u2028".encode())).join(lines)
    else:
        return content.decode("latin-1").encode(random.choice(("utf-16", "utf-8-sig")))
    return b"\n".join(lines)


def mutate_json(content: bytes, random: Random) -> bytes:
    """Replace, remove, rename or repeat values of valid JSON, which stays valid."""
    try:
        top = json.loads(content)
    except (ValueError, RecursionError):
        return content
    if random.random() < 0.01:
        return content[: len(content) // 2] + NESTED + content[len(content) // 2 :]
    top = mutate_value(top, random)
    return json.dumps(top).encode()


def mutate_value(top: Any, random: Random) -> Any:
    """Change one value of a tree of lists and tables."""
    if not isinstance(top, dict | list) or not top or random.random() < 0.01:
        return random.choice(JSON_VALUES)
    parent: Any = top
    while True:  # values near the top as often as the many below
        keys = list(parent) if isinstance(parent, dict) else range(len(parent))
        key = random.choice(keys)
        if not isinstance(parent[key], dict | list) or not parent[key] or random.random() < 0.3:
            break
        parent = parent[key]
    kind = random.randrange(8)
    if kind == 0:
        del parent[key]
    elif kind == 1 and isinstance(parent, list):
        parent.insert(random.randrange(len(parent)), parent[key])
    elif kind == 1:
        parent[random.choice((*parent, "", "x", "\ud800", "a" * 5000, "../../x"))] = parent.pop(key)
    elif kind == 2:  # as another value of the same table has it
        parent[key] = parent[random.choice(keys)]
    else:
        parent[key] = random.choice(JSON_VALUES)
    return top


def _png_chunk(content: bytes, random: Random) -> bytes:
    """Damage what a chunk of a PNG holds, and give it the right checksum."""
    chunks, at = [], len(_PNG)
    while at + 12 <= len(content):
        (length,) = struct.unpack_from(">I", content, at)
        chunks.append((at, min(length, len(content) - at - 12)))
        at += 12 + length
    if not chunks:
        return content
    at, length = random.choice(chunks)
    kind, data = content[at + 4 : at + 8], content[at + 8 : at + 8 + length]
    data = _bytes(data, random)
    whole = struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
    return content[:at] + whole + content[at + 12 + length :]
