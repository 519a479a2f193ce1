# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Stateless randomness: a generator is a function of a seed and a key, not of earlier draws.

A key names the use, for example ``(step, frame_token, "mask")``. A resumed run, another number of
loader workers or another order of calls therefore sees the same numbers.
"""

from __future__ import annotations

import hashlib
from numbers import Integral

import numpy as np


def seed_of(seed: int, *key: int | str) -> int:
    """63-bit seed of ``(seed, *key)``: blake2b over the typed parts, equal on every machine.

    Raises:
        TypeError: a part is neither an integer nor a string (floats would invite rounding).
    """
    digest = hashlib.blake2b(digest_size=8)
    for part in (seed, *key):
        if isinstance(part, str):
            kind, text = b"s", part.encode()
        elif isinstance(part, Integral):
            kind, text = b"i", str(int(part)).encode()
        else:
            raise TypeError(f"seed_of: key parts must be int or str, got {type(part).__name__}")
        # The length keeps ("ab", "c") apart from ("a", "bc"), the kind keeps 1 apart from "1".
        digest.update(kind + len(text).to_bytes(8, "little") + text)
    return int.from_bytes(digest.digest(), "little") >> 1


def numpy_generator(seed: int, *key: int | str) -> np.random.Generator:
    """NumPy generator (Philox) of ``(seed, *key)``."""
    return np.random.Generator(np.random.Philox(key=seed_of(seed, *key)))
