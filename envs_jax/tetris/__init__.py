"""Tetris: clear ten lines; the POMDP twin hides the pile."""

from typing import ClassVar

from arcade_torch.envs_jax.game import Array, LevelGame, Rules
from arcade_torch.envs_jax.tetris import rules
from arcade_torch.envs_jax.tetris.oracle import FramesOracle, StateOracle
from arcade_torch.envs_jax.tetris.renderer import Screen
from arcade_torch.envs_jax.tetris.rules import (
    GOAL,
    LEVELS,
    LINE_REWARD,
    MAX_STEPS,
    Params,
    TetrisState,
)


class Tetris(LevelGame[TetrisState]):
    """Clear ten lines of a board with 20 rows of 10 cells.

    Action 0 turns the falling piece clockwise, 2 and 3 shift it, 1 is a soft drop, 4 does nothing;
    gravity pulls at every step without a soft drop. A piece that cannot go further down locks at
    once. At the step after that, complete rows vanish and pay 0.1 each, and the next piece appears
    and already obeys that step's action. Ten lines terminate, and so does a new piece that finds no
    room, which pays -1; 3000 steps truncate. Returns lie in [-1, 1]. Pieces come from shuffled bags
    of all seven.

    The MDP twin shows the pile; the POMDP twin hides it. Both show the falling piece (also at the
    step at which it locks), the coming pieces, complete rows as white bands, and the lines cleared.

    Args:
        rules: ``"reference"`` deals the first bag with repeats and gaps when there is more than one
            preview, lets long falls pass through blocks, pays lines beyond the tenth, and does not
            punish topping out at the time limit.

    Source: POPGym Arcade (ICML 2026). Differs from popgym-arcade 0.0.7 in: every bag is complete,
        blocks are solid, the
    return never exceeds 1, topping out always costs 1, the time limit does not terminate.
    """

    levels = LEVELS
    memory_kind: ClassVar = "mapping"
    oracles: ClassVar = {"state": StateOracle, "frames": FramesOracle}

    def __init__(self, level: Params, *, id: str, obs_size: int, rules: Rules) -> None:
        super().__init__(level, id=id, obs_size=obs_size, rules=rules)
        self.max_steps = MAX_STEPS
        most_lines = GOAL if rules == "default" else GOAL + 3
        self.return_range = (-1.0, LINE_REWARD * most_lines)
        self.screen = Screen(obs_size, level)

    def reset(self, key: Array) -> TetrisState:
        """See :meth:`Game.reset`."""
        return rules.reset(key, self.level, self.rules)

    def step(
        self, key: Array, state: TetrisState, action: Array
    ) -> tuple[TetrisState, Array, Array, Array]:
        """See :meth:`Game.step`."""
        return rules.step(key, state, action, self.level, self.rules)

    def facts(self, state: TetrisState) -> dict[str, Array]:
        """The piece that falls, the next one (0 to 6: I O T S Z J L), and which cells of the board
        are filled, bool [20, 10].
        """
        return {"piece": state.piece, "next_piece": state.next[0], "filled": state.board > 0}
