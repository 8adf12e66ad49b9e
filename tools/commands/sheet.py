"""``arcade-torch sheet``."""

from dataclasses import dataclass
from pathlib import Path

import tyro


@dataclass
class Sheet:
    """Draw one picture of all games: both twins at 256 pixels, then both at 128, in the middle of an episode.

    With --steps, a strip of one game: the MDP above the POMDP after these steps of the scripted player.

    Example: arcade-torch sheet MineSweeperEasy --steps 0 8 16 --out minesweeper.png
    """

    games: tyro.conf.Positional[tuple[str, ...]] = ()
    """Ids; the ten games of one level by default."""
    level: str = "Easy"
    """Easy, Medium or Hard, when no games are named."""
    steps: tuple[int, ...] = ()
    """Draw a strip of one game after these steps."""
    out: Path = Path("games.png")
    """Picture to write."""

    def run(self) -> int:
        """Play, draw, write."""
        from arcade_torch.envs_jax import registered_ids, resolve_id
        from arcade_torch.tools.sheet import sheet, strip, write_png

        if self.level not in ("Easy", "Medium", "Hard"):
            raise ValueError(f"level is {self.level!r}, allowed: Easy, Medium, Hard")
        ids = [resolve_id(name) for name in self.games]
        if self.steps and len(ids) != 1:
            raise ValueError(f"--steps draws a strip of one game: name one, got {len(ids)}")
        ids = ids or [id for id in registered_ids() if f"{self.level}-v" in id]
        print(write_png(strip(ids[0], self.steps) if self.steps else sheet(ids), self.out).resolve())
        return 0


COMMAND = Sheet
