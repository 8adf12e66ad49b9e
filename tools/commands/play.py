"""``arcade-torch play``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import tyro


@dataclass
class Play:
    """Play a game by hand, in a window or (without pygame or a display, or with --terminal) in the terminal.

    Arrows and space are the five actions; one key, one step. P changes between MDP and POMDP, also in mid-episode. R
    restarts the episode, Enter goes on after an end, Esc quits.

    Example: arcade-torch play MineSweeperEasy --partial --episodes 3 --scores human.csv
    """

    game: tyro.conf.PositionalRequiredArgs[tyro.conf.Positional[str]]
    """Environment id."""
    seed: int | None = None
    """Of the first episode, each further one has the next; 0 by default, with --scores the first the file lacks."""
    partial: bool = False
    """Begin with the POMDP twin."""
    both: bool = False
    """Show both twins, the MDP on the left."""
    episodes: int = 0
    """Stop after so many finished episodes; 0 for never."""
    obs_size: Literal[128, 256] = 256
    """Side of the frame in pixels."""
    scale: int = 2
    """Width of a frame's pixel on the screen."""
    key_repeat: int = 0
    """A held key repeats every so many milliseconds; 0 for not at all."""
    rules: Literal["default", "reference"] = "default"
    """Law of the game."""
    env_option: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """NAME=VALUE, an option of the game; may be given several times."""
    terminal: bool = False
    """Play in the terminal."""
    scores: Path | None = None
    """CSV file that every episode is added to: return, seed, actions."""
    player: str = ""
    """Your name in that file."""

    def run(self) -> int:
        """Play."""
        from arcade_torch.compiled import compiled_game
        from arcade_torch.tools.name_value import name_and_value
        from arcade_torch.tools.play import scores, terminal, window
        from arcade_torch.tools.play.session import LEGEND, Session

        if self.scale < 1:
            raise ValueError(f"--scale must be at least 1, got {self.scale}")
        if self.key_repeat < 0:
            raise ValueError(f"--key-repeat must be 0 or more milliseconds, got {self.key_repeat}")
        if self.scores is not None and self.scores.suffix != ".csv":
            raise ValueError(f"--scores must end in .csv, got {self.scores}")
        options = dict(map(name_and_value, self.env_option))
        compiled = compiled_game(self.game, self.obs_size, self.rules, options)
        game: Any = compiled.batched.game
        said: list[str] = []
        rows = scores.read_scores_file(self.scores) if self.scores is not None else []
        seed = scores.next_seed(rows, game.id, self.player) if self.seed is None else self.seed

        def keep(attempt: Any) -> None:
            """Write a score, and remember to say it when the screen is the terminal's again."""
            how = f"return {attempt.total:+.3f} in {attempt.steps} steps, {attempt.end}"
            said.append(f"seed {attempt.seed} ({attempt.observability}): {how}")
            if self.scores is not None:
                scores.append_score(self.scores, scores.score_row(attempt, game, options, self.player))

        views = {"partial": self.partial, "both": self.both}
        session = Session(compiled, seed=seed, episodes=self.episodes, on_attempt=keep, **views)
        reason = None if self.terminal else window.why_no_window()
        if reason is not None:
            print(f"playing in the terminal: {reason}")
        if self.terminal or reason is not None:
            terminal.play_in_terminal(session)
        else:
            print(LEGEND)
            window.play_in_window(session, self.scale, self.key_repeat)
        print("\n".join(said) or "no episode was played")
        return 0


COMMAND = Play
