"""``arcade-torch baselines``."""

from dataclasses import dataclass
from pathlib import Path

import tyro


@dataclass
class Baselines:
    """Returns of random play and of both scripted players in each game: mean, 95 % interval, length.

    Keeps a CSV file that it goes on with after an interruption, and can write the table into a Markdown page.

    Example: arcade-torch baselines CartPoleEasy MineSweeperEasy --episodes 200 --out baselines.csv
    """

    games: tyro.conf.Positional[tuple[str, ...]] = ()
    """Ids; all of them by default."""
    episodes: int = 1000
    """Of each player in each game, at most."""
    seconds: float = 60.0
    """For each player in each game; what is begun is finished."""
    out: Path = Path("baselines.csv")
    """Table; rows it holds are not measured again."""
    page: Path | None = None
    """Markdown page that gets the table between its marks."""

    def run(self) -> int:
        """Measure and write."""
        from arcade_torch.envs_jax import registered_ids, resolve_id
        from arcade_torch.tools import baselines
        from arcade_torch.tools.optional import need

        if self.episodes < 1:
            raise ValueError(f"episodes must be at least 1, got {self.episodes}")
        ids = [resolve_id(name) for name in self.games] or registered_ids()
        bar = need("tqdm").tqdm(total=len(ids) * len(baselines.PLAYERS), unit="row")
        rows = []
        with bar:
            for row in baselines.measure_all(ids, self.episodes, self.seconds, self.out):
                rows.append(row)
                bar.set_postfix_str(f"{row.id} {row.player} {row.mean:.3f}")
                bar.update()
        table = baselines.markdown(rows)
        print(table)
        if self.page is not None:
            print(f"\nwritten into {baselines.insert(self.page, table)}")
        return 0

    def how_to_go_on(self) -> str:
        """What to type after an interruption."""
        return f"finished rows are in {self.out}; the same command goes on with the others"


COMMAND = Baselines
