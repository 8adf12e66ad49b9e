"""Hostile and random inputs: values of any type, names, and mutations of bytes, text and JSON that
were fine.
"""

import json
import random
from typing import Any

import numpy as np
import torch
from hypothesis import strategies as st

NAMES = (
    "",
    " ",
    ".",
    "..",
    "../../../etc/passwd",
    "/etc/passwd",
    "a/b",
    "a\x00b",
    "a\nb",
    "a\r\nb",
    "a,b",
    'a"b',
    "a'b",
    "<script>alert(1)</script>",
    '"><img src=x onerror=alert(1)>',
    "</script><script>alert(1)</script>",
    "=1+1",
    '=HYPERLINK("x")',
    "@SUM(A1)",
    "{{ 7*7 }}",
    "{0}",
    "%s%n",
    "$(touch x)",
    "[red]x[/red]",
    "[/]",
    "$\\frac{1}$",
    "nan",
    "inf",
    "1e400",
    "-0",
    "9" * 400,
    "9" * 5000,
    "x" * 5000,
    "\u0663",
    "\u202etxt.exe",
    "\U0001f996",
    "\ud800",
    "CartPoleEasy-v99999999999999999999",
    "CartPoleEasy-v\u0660",
    "CartPoleEasy-v0\n",
    "cartpoleeasy",
    "None",
    "true",
)
NUMBERS = (0, 1, -1, 2, 3, 7, 255, 2**31, 2**32, 2**63, 2**64, -(2**63), 10**30, 10**400)
FLOATS = (0.0, -0.0, 0.5, 1.0, 1.5, -1.0, 1e-320, 1e308, float("inf"), float("-inf"), float("nan"))

names = st.sampled_from(NAMES) | st.text(max_size=12)
numbers = st.sampled_from(NUMBERS) | st.sampled_from(FLOATS) | st.integers() | st.floats()
scalars = st.none() | st.booleans() | numbers | names
plain = st.recursive(
    scalars, lambda x: st.lists(x, max_size=3) | st.dictionaries(names, x, max_size=3), max_leaves=6
)
"""What JSON and TOML can hold, and NaN."""


class Strange:
    """An object that helps nobody."""

    def __bool__(self) -> bool:
        raise RuntimeError("no truth here")

    def __eq__(self, other: object) -> bool:
        raise RuntimeError("no equality here")

    __hash__ = None  # type: ignore[assignment]


OBJECTS: tuple[Any, ...] = (
    object(),
    object,
    Strange(),
    b"bytes",
    b"\xff\x00",
    complex(1, 2),
    {1, 2},
    frozenset(),
    len,
    range(3),
    np.int64(2),
    np.float32(0.5),
    np.bool_(True),
    np.array([1, 2]),
    np.array([]),
    np.array("x"),
    torch.tensor(2),
    torch.tensor([True, False]),
    torch.tensor([0.5, float("nan")]),
    torch.zeros(0),
    torch.zeros(2, 2),
    torch.zeros(2, dtype=torch.complex64),
    torch.device("cpu"),
    torch.float32,
    Exception("x"),
)
anything = st.sampled_from(OBJECTS) | plain

seeds = st.integers(0, 2**32 - 1)
"""One draw an input: what a generator of random numbers starts from."""

JUNK = (
    b"\x00",
    b"\xff",
    b"\n",
    b"\r",
    b",",
    b'"',
    b"'",
    b"{",
    b"[",
    b"-",
    b"1e400",
    b"NaN",
    b"\xef\xbb\xbf",
    b"=",
    b"<",
)


def mutated(data: bytes, seed: int) -> bytes:
    """Bytes with one to four accidents: flipped bits, cuts, insertions, repeats, swaps, or nothing
    but junk.
    """
    rng = random.Random(seed)
    out = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        size = len(out)
        at = rng.randrange(size + 1)
        kind = rng.randrange(9)
        if kind == 0 and size:
            out[at % size] ^= 1 << rng.randrange(8)
        elif kind == 1:
            del out[at:]
        elif kind == 2:
            del out[:at]
        elif kind == 3:
            out[at:at] = rng.choice(JUNK) * rng.choice((1, 1, 3, 50))
        elif kind == 4:
            out[at:at] = out[at : at + rng.randrange(1, 60)]
        elif kind == 5:
            del out[at : at + rng.randrange(1, 40)]
        elif kind == 6 and size:
            out[at % size] = rng.randrange(256)
        elif kind == 7:
            out = bytearray(rng.randbytes(rng.randrange(0, 40)))
        else:
            other = rng.randrange(size + 1)
            lo, hi = sorted((at, other))
            out[lo : lo + min(20, size - hi)] = out[hi : hi + 20]
    return bytes(out)


def _leaf(rng: random.Random) -> Any:
    kind = rng.randrange(9)
    if kind == 0:
        return rng.choice(NAMES)
    if kind == 1:
        return rng.choice(NUMBERS)
    if kind == 2:
        return rng.choice(FLOATS)
    if kind == 3:
        return rng.choice((None, True, False))
    if kind == 4:
        return [_leaf(rng) for _ in range(rng.randrange(3))]
    if kind == 5:
        return {rng.choice(NAMES): _leaf(rng) for _ in range(rng.randrange(3))}
    if kind == 6:
        return nested(rng.choice((5, 60)), rng.random() < 0.5)
    if kind == 7:
        return rng.randrange(-(10**6), 10**6)
    return rng.random() * 10 ** rng.randrange(-5, 6)


def nested(depth: int, lists: bool = True) -> Any:
    """A list in a list in a list, or dictionaries."""
    value: Any = 1
    for _ in range(depth):
        value = [value] if lists else {"x": value}
    return value


def mutated_value(value: Any, seed: int) -> Any:
    """A nested plain value with one to three leaves, keys or branches replaced, dropped, renamed or
    added.
    """
    rng = random.Random(seed)
    out = json.loads(json.dumps(value))
    for _ in range(rng.choice((1, 1, 2, 3))):
        out = _mutate(out, rng)
    return out


def _mutate(value: Any, rng: random.Random) -> Any:
    if not isinstance(value, dict | list) or not value or rng.random() < 0.03:
        return _leaf(rng)
    keys = list(value) if isinstance(value, dict) else list(range(len(value)))
    key = rng.choice(keys)
    kind = rng.randrange(10)
    if kind < 6 and isinstance(value[key], dict | list) and value[key]:
        value[key] = _mutate(value[key], rng)
    elif kind < 7:
        value[key] = _leaf(rng)
    elif kind == 7:
        del value[key]
    elif kind == 8 and isinstance(value, dict):
        value[rng.choice(NAMES)] = value.pop(key)
    elif kind == 9 and isinstance(value, dict):
        value[rng.choice(NAMES)] = _leaf(rng)
    else:
        value[key] = _leaf(rng)
    return value


def json_bytes(value: Any) -> bytes:
    """JSON as Python writes it: NaN and Infinity, lone surrogates escaped."""
    return json.dumps(value).encode()
