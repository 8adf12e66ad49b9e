"""MineSweeper: sweep all safe cells with a cursor."""

from typing import ClassVar

from arcade_torch.envs_jax.game import Array, LevelGame, Rules
from arcade_torch.envs_jax.minesweeper import rules
from arcade_torch.envs_jax.minesweeper.oracle import FramesOracle, StateOracle
from arcade_torch.envs_jax.minesweeper.renderer import Screen
from arcade_torch.envs_jax.minesweeper.rules import LEVELS, MineSweeperState, Params
from arcade_torch.envs_jax.validation import check_penalty


class MineSweeper(LevelGame[MineSweeperState]):
    """Sweep every safe cell of a square board, one cell at a time.

    Actions 0 to 3 move the cursor by one cell, 4 sweeps the cell under it: a covered safe cell pays
    ``1 / safe``, a swept cell costs ``2 / cells``, a mine ends the game. ``cells / 2`` sweeps of
    swept cells end it too; ``2 * cells`` steps truncate it. Nothing else is opened when a 0 is
    swept. Returns lie in [1 / safe - 1, 1]; on some boards a guess is unavoidable.

    The MDP twin shows the number of mines around every swept cell; the POMDP twin shows it for the
    cell under the cursor.

    Args:
        rules: ``"reference"`` judges repeats and time one sweep late, and never starts the cursor
            in the last row or column.
        mine_reward: Reward for hitting a mine. The published scale has 0; the paper's words ask for
            a negative number.

    Source: POPGym Arcade (ICML 2026). Differs from popgym-arcade 0.0.7 in: ends are not one sweep
        late, the cursor starts on any cell, numbers are legible and equal in both twins.

    Raises:
        TypeError: ``mine_reward`` is no number.
        ValueError: ``mine_reward`` is positive or beyond -1.
    """

    levels = LEVELS
    memory_kind: ClassVar = "mapping"
    oracles: ClassVar = {"state": StateOracle, "frames": FramesOracle}

    def __init__(
        self, level: Params, *, id: str, obs_size: int, rules: Rules, mine_reward: float = 0.0
    ) -> None:
        check_penalty("mine_reward", mine_reward)
        super().__init__(level, id=id, obs_size=obs_size, rules=rules)
        self.mine_reward = float(mine_reward)
        self.max_steps = level.max_steps
        repeats = level.max_repeats + (rules == "reference")
        lowest = 1 / level.safe - 2 / level.cells * repeats
        self.return_range = (
            min(lowest, lowest + 2 / level.cells + self.mine_reward, self.mine_reward),
            1.0,
        )
        self.screen = Screen(obs_size, level)

    def reset(self, key: Array) -> MineSweeperState:
        """See :meth:`Game.reset`."""
        return rules.reset(key, self.level, self.rules)

    def step(
        self, key: Array, state: MineSweeperState, action: Array
    ) -> tuple[MineSweeperState, Array, Array, Array]:
        """See :meth:`Game.step`."""
        return rules.step(state, action, self.level, self.rules, self.mine_reward)

    def facts(self, state: MineSweeperState) -> dict[str, Array]:
        """Which cells hold a mine and which are swept, bool [side, side] each, indexed [x, y]."""
        return {"mine": rules.mines(state, self.level), "swept": state.grid == rules.SWEPT}
