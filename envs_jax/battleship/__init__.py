"""BattleShip: hunt hidden ships with a cursor."""

from typing import ClassVar

from arcade_torch.envs_jax.battleship import rules
from arcade_torch.envs_jax.battleship.oracle import FramesOracle, StateOracle
from arcade_torch.envs_jax.battleship.renderer import Screen
from arcade_torch.envs_jax.battleship.rules import LEVELS, BattleShipState, Params
from arcade_torch.envs_jax.game import Array, LevelGame, Rules


class BattleShip(LevelGame[BattleShipState]):
    """Hit every cell of four hidden ships, of lengths 2, 3, 3 and 4, in a square sea.

    Actions 0 to 3 move the cursor by one cell, 4 fires at the cell under it: a ship cell pays ``1 /
    12``, water pays nothing, and a cell that was shot at before costs ``2 / cells``. The game ends
    with the last ship cell, or with ``cells / 2`` such repeats; ``2 * cells`` steps truncate it.
    Ships lie straight along either axis, may touch, and are placed one after the other, each
    uniform over the places left. Returns lie in [-1, 1].

    The MDP twin marks every shot, a cross for a hit and a ring for a miss; the POMDP twin shows the
    mark under the cursor alone. The number of hits is shown in both.

    Args:
        rules: ``"reference"`` judges the repeats one shot late (the lowest return is then one
            repeat lower) and never starts the cursor in the last row or column.

    Source: POPGym Arcade (ICML 2026). Differs from popgym-arcade 0.0.7 in: the end by repeats is
        not one shot late, the
    cursor starts on any cell, a mark has one colour in both twins and at all times.
    """

    levels = LEVELS
    memory_kind: ClassVar = "none"
    oracles: ClassVar = {"state": StateOracle, "frames": FramesOracle}

    def __init__(self, level: Params, *, id: str, obs_size: int, rules: Rules) -> None:
        super().__init__(level, id=id, obs_size=obs_size, rules=rules)
        self.max_steps = level.max_steps
        self.return_range = (-2 / level.cells * (level.max_repeats + (rules == "reference")), 1.0)
        self.screen = Screen(obs_size, level)

    def reset(self, key: Array) -> BattleShipState:
        """See :meth:`Game.reset`."""
        return rules.reset(key, self.level, self.rules)

    def step(
        self, key: Array, state: BattleShipState, action: Array
    ) -> tuple[BattleShipState, Array, Array, Array]:
        """See :meth:`Game.step`."""
        return rules.step(state, action, self.level, self.rules)

    def facts(self, state: BattleShipState) -> dict[str, Array]:
        """Which cells hold a ship and which are shot at, bool [side, side] each, indexed [x, y]."""
        return {"ship": state.board == 1, "shot": state.guesses == 1}
