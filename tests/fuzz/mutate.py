"""Corrupts inputs: bits, lengths, tokens, numbers, and members of archives.

A zip file is also changed inside with correct sizes and checksums, so that the corruption
reaches the reader of its members.
"""

import contextlib
import io
import random
import re
import struct
import warnings
import zipfile

TOKEN = re.compile(rb"[-+]?\d[\d.]*(?:[eE][-+]?\d+)?|\w+|[^\w\s]|\s+")
TOKENS = [
    *(b"nan", b"inf", b"-inf", b"1e999", b"1e308", b"1e39", b"1e-320", b"-1", b"0"),
    *(b"9" * 30, b"9" * 6000, b"0" * 9000, b"1e" + b"9" * 5000, b"1_0", b"0x1F"),
    *("٣".encode(), "é".encode(), b"\xff\xfe", b"\0", b"", b" ", b"\n", b"\r", b"\t"),
    *(b"null", b'""', b'"', b",", b",,,,", b"*", b":", b"#", b"../../x"),
    *(b"[" * 9000, b'{"a":' * 5000, b"(" * 3000, b"x" * 20_000, b"\n" * 5000),
]
SIZES = (0, 1, -1, 7, 2**15, 2**16 - 1, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**63 - 1)


def mutate(rng: random.Random, content: bytes) -> bytes:
    """One corrupted input; the same for the same generator."""
    for _ in range(rng.choice((1, 1, 1, 2, 5))):
        content = _mutate(rng, content)
    return content


def _mutate(rng: random.Random, content: bytes) -> bytes:
    if content[:2] == b"PK" and rng.random() < 0.7:
        # A file that is corrupted already may not be a zip file any more.
        with contextlib.suppress(Exception), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return _zip(rng, content)
    is_text = b"\0" not in content and len(content) < 1 << 20
    if is_text and rng.random() < 0.85:
        return _text(rng, content)
    return _binary(rng, content)


def _text(rng: random.Random, content: bytes) -> bytes:
    if rng.random() < 0.2:
        lines = content.splitlines(keepends=True) or [b""]
        i, j = rng.randrange(len(lines)), rng.randrange(len(lines))
        many = lines[j] * min(2000, 1 + (1 << 18) // max(len(lines[j]), 1))
        lines[i] = rng.choice((lines[j], lines[j] * 2, many, b"", b"\n"))
        return b"".join(lines)
    tokens = TOKEN.findall(content) or [b""]
    i = rng.randrange(len(tokens))
    other = rng.choice((rng.choice(TOKENS), rng.choice(tokens)))
    tokens[i] = rng.choice((other, other, other, tokens[i] + other, b""))
    return b"".join(tokens)


def _binary(rng: random.Random, content: bytes) -> bytes:
    data, size = bytearray(content), len(content)
    at = rng.randrange(max(rng.choice((size, min(size, 512))), 1))
    end = min(size, at + rng.choice((1, 2, 4, 8, 64, 1000)))
    kind = rng.randrange(7)
    if kind <= 1 and size:
        data[at] ^= 1 << rng.randrange(8)
    elif kind == 2:
        del data[at:]
    elif kind == 3:
        data[at:end] = rng.choice((b"", rng.randbytes(end - at), bytes(end - at)))
    elif kind == 4:
        form = rng.choice(("<I", ">I", "<Q", ">Q", "<H", ">H"))
        number = rng.choice(SIZES) % 256 ** struct.calcsize(form)
        data[at : at + struct.calcsize(form)] = struct.pack(form, number)
    elif kind == 5:
        other = rng.randrange(max(size, 1))
        data[at:end] = data[other : other + end - at]
    else:
        data[at:at] = rng.choice((rng.choice(TOKENS), rng.randbytes(8), data[at:end]))
    return bytes(data)


def _zip(rng: random.Random, content: bytes) -> bytes:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = [(name, archive.read(name)) for name in archive.namelist()]
    i = rng.randrange(len(members))
    name, inside = members[i]
    kind = rng.randrange(8)
    if kind == 0:
        other = rng.choice(members)[0]
        members[i] = rng.choice((other, "../x", "/x", "x/" * 300, name + "x")), inside
    elif kind == 1:
        members.append((name, inside))
    elif kind == 2:
        del members[i]
    elif kind == 3:
        members[i] = name, bytes(rng.choice((0, 1 << 20, 1 << 26)))
    else:
        members[i] = name, _mutate(rng, inside)
    method = rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))
    if kind == 3:
        method = zipfile.ZIP_DEFLATED
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", method, compresslevel=1) as archive:
        for name, inside in members:
            archive.writestr(name, inside)
    return file.getvalue()
