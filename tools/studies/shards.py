"""Shares of a work that several processes or machines carry out."""

import re


def part_of(shard: str) -> tuple[int, int]:
    """Which part of how many ``3/10`` is; an empty text is all of one.

    Raises:
        ValueError: it is written otherwise, or there is no such part.

    Example:
        >>> part_of("3/10")
        (3, 10)
    """
    match = re.fullmatch(r"(\d{1,6})/(\d{1,6})", shard or "1/1")
    part, parts = map(int, match.groups()) if match else (0, 0)
    if not 1 <= part <= parts:
        raise ValueError(f"a shard is written 3/10, the third of ten; got {shard!r}")
    return part, parts
