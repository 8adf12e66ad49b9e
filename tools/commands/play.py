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
        from arcade_torch.tools.play.session import LEGEND, Session
        from arcade_torch.tools.play.terminal import play_in_terminal
        from arcade_torch.tools.play.window import play_in_window, why_no_window

        self._check()
        self._said: list[str] = []
        options = dict(map(name_and_value, self.env_option))
        game = compiled_game(self.game, self.obs_size, self.rules, options)
        session = Session(
            game,
            seed=self._first_seed(game.batched.game.id),
            partial=self.partial,
            both=self.both,
            episodes=self.episodes,
            on_attempt=lambda attempt: self._keep(attempt, game.batched.game, options),
        )
        reason = None if self.terminal else why_no_window()
        if self.terminal or reason is not None:
            if reason is not None:
                print(f"playing in the terminal: {reason}")
            play_in_terminal(session)
        else:
            print(LEGEND)
            play_in_window(session, self.scale, self.key_repeat)
        print("\n".join(self._said) or "no episode was played")
        return 0

    def _check(self) -> None:
        if self.scale < 1:
            raise ValueError(f"--scale must be at least 1, got {self.scale}")
        if self.key_repeat < 0:
            raise ValueError(f"--key-repeat must be 0 or more milliseconds, got {self.key_repeat}")
        if self.scores is not None and self.scores.suffix != ".csv":
            raise ValueError(f"--scores must end in .csv, got {self.scores}")

    def _first_seed(self, game_id: str) -> int:
        """The seed that was asked for, or one that this player has not met in the file."""
        from arcade_torch.tools.play.scores import next_seed, read_scores_file

        rows = read_scores_file(self.scores) if self.scores is not None else []
        return next_seed(rows, game_id, self.player) if self.seed is None else self.seed

    def _keep(self, attempt: Any, game: Any, options: dict[str, Any]) -> None:
        """Write a score, and remember to say it when the screen is the terminal's again."""
        from arcade_torch.tools.play.scores import append_score, score_row

        words = f"seed {attempt.seed} ({attempt.observability}): return {attempt.total:+.3f} in {attempt.steps} steps"
        self._said.append(f"{words}, {attempt.end}")
        if self.scores is not None:
            append_score(self.scores, score_row(attempt, game, options, self.player))


COMMAND = Play
