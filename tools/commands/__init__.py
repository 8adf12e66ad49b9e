"""Commands of arcade-torch; every one is a dataclass whose fields are its options."""

from collections.abc import Sequence
from typing import Any, ClassVar

from arcade_torch.tools.options import parse


class Command:
    """What every command has; ``argv`` are the options that it was called with."""

    argv: ClassVar[tuple[str, ...]] = ()

    @classmethod
    def parse(cls, words: Sequence[str], prog: str) -> Any:
        """Read the options; a ``ValueError`` says in one line what cannot be read."""
        return parse(cls, words, prog)

    def resume_hint(self) -> str:
        """What an interruption left, and how to go on."""
        return "no file is half written; the same command starts again"
