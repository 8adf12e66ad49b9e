"""``arcade-torch sheet``."""

from dataclasses import dataclass
from pathlib import Path

import tyro


@dataclass
class Sheet:
    """Draw one picture of all games: both twins at 256 pixels, then both at 128, in the middle of an episode.

    Example: arcade-torch sheet --level Hard --out games.png
    """

    games: tyro.conf.Positional[tuple[str, ...]] = ()
    """Ids; the ten games of one level by default."""
    level: str = "Easy"
    """Easy, Medium or Hard, when no games are named."""
    out: Path = Path("games.png")
    """Picture to write."""

    def run(self) -> int:
        """Play, draw, write."""
        from arcade_torch.envs_jax import registered_ids, resolve_id
        from arcade_torch.tools.sheet import sheet, write_png

        if self.level not in ("Easy", "Medium", "Hard"):
            raise ValueError(f"level is {self.level!r}, allowed: Easy, Medium, Hard")
        ids = [resolve_id(name) for name in self.games]
        ids = ids or [id for id in registered_ids() if f"{self.level}-v" in id]
        print(write_png(sheet(ids), self.out).resolve())
        return 0


COMMAND = Sheet
