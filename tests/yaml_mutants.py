"""Damage that people and disks do to YAML files, drawn by a seeded generator."""

from __future__ import annotations

import numpy as np

INSERTED = (
    *(b"\t", b" ", b"  ", b"\n", b":", b": ", b"- ", b"#", b"'", b'"', b"[", b"]", b"{", b"}"),
    *(b"&a ", b"*a ", b"!!python/object:os.system ", b"!!binary ", b"!!int ", b"%", b"@", b"|"),
    *(b"\x00", b"\xff", b"\xc3", b"\xe2\x80\x8b", b"\xef\xbb\xbf", b"\r", b"---\n", b"...\n"),
    *(b"null", b"~", b"1e999", b"-1", b"2024-02-30", b"${seed}", b"${", b"???", b"\xc2\xb2"),
    *(b"[" * 3000, b"9" * 400, b"{a: " * 2000, b"<<: *a\n"),
)
"""What is written somewhere: signs of YAML and OmegaConf, bytes that are no UTF-8, depth."""


def mutants(text: bytes, count: int, seed: int):
    """Yield `count` damaged copies of a file, each damaged once or a few times."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        damaged = text
        for _ in range(rng.integers(1, 4)):
            damaged = _damage(damaged, rng)
        yield damaged


def _damage(text: bytes, rng: np.random.Generator) -> bytes:
    lines = text.split(b"\n")
    place, line = (int(rng.integers(n + 1)) for n in (len(text), len(lines) - 1))
    kind = rng.integers(8)
    if kind <= 2:
        piece = INSERTED[rng.integers(len(INSERTED))]
        return text[:place] + piece + text[place:]
    if kind == 3:
        return text[:place] + text[place + int(rng.integers(1, 20)) :]
    if kind == 4:
        return text[:place]
    if kind == 5:
        return b"\n".join([*lines[:line], lines[line], *lines[line:]])
    if kind == 6:
        indent = [b"\t", b" ", b"    "][rng.integers(3)]
        return b"\n".join([*lines[:line], indent + lines[line], *lines[line + 1 :]])
    flipped = bytearray(text or b"\n")
    flipped[place % len(flipped)] ^= 1 << int(rng.integers(8))
    return bytes(flipped)
