"""Damages inputs: bits, lengths, tokens, numbers, JSON values, members of archives.

What a content is shows in it: JSON is changed as values, a zip, a safetensors file or a
PNG also inside, with sizes and checksums made right again, so that damage comes past them.
"""

import contextlib
import io
import json
import random
import re
import struct
import warnings
import zipfile
import zlib
from typing import Any

TOKEN = re.compile(rb"[-+]?\d[\d.]*(?:[eE][-+]?\d+)?|\w+|[^\w\s]|\s+")
TOKENS = [
    *(b"nan", b"inf", b"-inf", b"1e999", b"1e308", b"1e39", b"1e-320", b"-1", b"0"),
    *(b"9" * 30, b"9" * 6000, b"0" * 9000, b"1e" + b"9" * 5000, b"1_0", b"0x1F"),
    *("٣".encode(), "é".encode(), b"\xff\xfe", b"\0", b"", b" ", b"\n", b"\r", b"\t"),
    *(b"null", b"true", b'""', b'"', b"'", b",", b",,,,", b"*", b":", b"#", b"../../x"),
    *(b"[" * 9000, b'{"a":' * 5000, b"(" * 3000, b"x" * 20_000, b"\n" * 5000),
]
VALUES: list[Any] = [
    *(None, True, False, -1, 0, 1, 7, 2**31, 2**63, 10**400, 0.5, -0.0, 1e308, 1e300),
    *(float("nan"), float("inf"), "", "x", "nan", "٣", "a" * 5000, "../x", "\n", "\0"),
    *([], {}, [[]], [None], ["x"], [1, 2], [0] * 5000, {"a": 1}, [[1], [1, 2]]),
]
SIZES = (0, 1, -1, 7, 2**15, 2**16 - 1, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**63 - 1)
_PNG = b"\x89PNG\r\n\x1a\n"


def mutate(rng: random.Random, content: bytes, name: str = "") -> bytes:
    """One damaged input; the same for the same generator."""
    for _ in range(rng.choice((1, 1, 1, 2, 5))):
        content = _mutate(rng, content, name)
    return content


def _mutate(rng: random.Random, content: bytes, name: str) -> bytes:
    if rng.random() < 0.7:
        # Half-damaged already, as it may be, the plain ways are left.
        with contextlib.suppress(Exception), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            if content[:2] == b"PK":
                return _zip(rng, content)
            if content[:8] == _PNG:
                return _png(rng, content)
            if name.endswith(".safetensors"):
                return _safetensors(rng, content)
            value = json.loads(content)
            if isinstance(value, dict | list) and value:
                return json.dumps(_value(rng, value)).encode()
    try:
        content.decode()
    except UnicodeDecodeError:
        return _binary(rng, content)
    if len(content) > 1 << 20:  # tokens of a bomb take long
        return _binary(rng, content)
    return _text(rng, content) if rng.random() < 0.85 else _binary(rng, content)


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


def _value(rng: random.Random, value: Any) -> Any:
    """Another JSON value: something in it is exchanged, lost, doubled or renamed."""
    is_tree = isinstance(value, dict | list) and len(value) > 0
    if not is_tree or rng.random() < 0.1:
        return rng.choice(VALUES)
    keys = list(value) if isinstance(value, dict) else list(range(len(value)))
    key = rng.choice(keys)
    new = value.copy()
    kind = rng.randrange(10)
    if kind == 0:
        del new[key]
    elif kind == 1:
        new[key] = new[rng.choice(keys)]
    elif kind == 2 and isinstance(new, dict):
        new[rng.choice(("x", "", "../x", "9" * 400))] = new.pop(key)
    elif kind == 2:
        new.insert(0, new[key])
    else:
        new[key] = _value(rng, new[key])
    return new


def _zip(rng: random.Random, content: bytes) -> bytes:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = [(name, archive.read(name)) for name in archive.namelist()]
    i = rng.randrange(len(members))
    name, inside = members[i]
    kind = rng.randrange(8)
    if kind == 0:
        other = rng.choice(members)[0]
        name = rng.choice((other, "../x", "/x", "", "x/" * 300, name + "x"))
    elif kind == 1:
        members.append((name, inside))
    elif kind == 2:
        del members[i]
    elif kind == 3:
        inside = bytes(rng.choice((0, 1 << 20, 1 << 26)))
    else:
        inside = _mutate(rng, inside, name)
    if i < len(members):
        members[i] = name, inside
    methods = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) * 4 + (zipfile.ZIP_LZMA,)
    method = zipfile.ZIP_DEFLATED if len(inside) > 1 << 19 else rng.choice(methods)
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", method, compresslevel=1) as archive:
        for name, inside in members:
            archive.writestr(name, inside)
    return file.getvalue()


def _safetensors(rng: random.Random, content: bytes) -> bytes:
    end = 8 + int.from_bytes(content[:8], "little")
    header = json.dumps(_value(rng, json.loads(content[8:end]))).encode()
    return struct.pack("<Q", len(header)) + header + content[end:]


def _png(rng: random.Random, content: bytes) -> bytes:
    chunks, at = [], 8
    while at < len(content):
        (size,) = struct.unpack_from(">I", content, at)
        chunks.append((content[at + 4 : at + 8], content[at + 8 : at + 8 + size]))
        at += 12 + size
    i = rng.randrange(len(chunks))
    kind, data = chunks[i]
    if kind == b"IDAT" and rng.random() < 0.7:
        data = zlib.compress(_binary(rng, zlib.decompress(data)), 1)
    else:
        data = _binary(rng, data)
    chunks[i] = kind, data
    if rng.random() < 0.2:
        chunks.insert(i, rng.choice(chunks))
    return _PNG + b"".join(
        struct.pack(">I", len(data))
        + kind
        + data
        + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in chunks
    )
