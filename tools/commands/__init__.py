"""Commands of arcade-torch; every one is a dataclass whose fields are its options."""

from typing import ClassVar


class Command:
    """What every command has: ``argv``, the options it was called with, and a hint for after an interruption."""

    argv: ClassVar[tuple[str, ...]] = ()

    def resume_hint(self) -> str:
        """What an interruption left, and how to go on."""
        return "nothing was left half written"
