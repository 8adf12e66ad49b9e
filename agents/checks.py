"""One way to refuse a value."""


def require(condition: bool, name: str, value: object, allowed: str) -> None:
    """Raise one clear line unless ``condition`` holds.

    Args:
        condition: what must be true.
        name: field or argument, as the user writes it.
        value: what arrived.
        allowed: what is allowed.

    Raises:
        ValueError: the condition does not hold.

    Example:
        >>> require(0 >= 1, "epochs", 0, "a whole number >= 1")
        Traceback (most recent call last):
        ...
        ValueError: epochs must be a whole number >= 1; got 0
    """
    if not condition:
        found = " ".join(line.strip() for line in repr(value).splitlines())
        raise ValueError(f"{name} must be {allowed}; got {found}")
