"""CountRecall: say how often the queried suit has been dealt."""

from typing import ClassVar

import jax.numpy as jnp

from arcade_torch.envs_jax.countrecall import rules
from arcade_torch.envs_jax.countrecall.oracle import FramesOracle, StateOracle
from arcade_torch.envs_jax.countrecall.renderer import Screen
from arcade_torch.envs_jax.countrecall.rules import LEVELS, MOVE_BUDGET, CountRecallState, Params
from arcade_torch.envs_jax.game import Array, LevelGame, Rules

# the counter of the reference, which is not held, then stays within three digits
LARGEST_BUDGET = 800


class CountRecall(LevelGame[CountRecallState]):
    """In each of N turns a card is dealt and a suit asked for: how many cards of that suit were
    dealt before?

    Actions 0 and 1 move the counter up and down, 4 confirms what it shows: ``1 / N`` if that is
    right, else 0; then the next turn begins. The card on the table is not counted yet, and the
    counter stays where it is between turns. The N-th turn terminates, ``N + move_budget`` steps
    truncate. Returns lie in [0, 1]; with 100 counter moves only about six of seven deals on Medium
    and three of ten on Hard allow 1 (mean of the best: 1, 0.99 and 0.96).

    The MDP twin shows all cards dealt before, the POMDP twin does not. Both show the card, the suit
    asked for, the counter and the number of right answers.

    Args:
        rules: ``"reference"`` lets the counter leave the range of possible answers.
        move_budget: Counter moves that the step limit leaves, 0 to 800; 100 is the published
            number.

    Source: POPGym Arcade (ICML 2026). Differs from popgym-arcade 0.0.7 in: the counter stays
        between 0 and the number
    of cards of the largest suit, symbols do not overlap at 128 pixels.

    Raises:
        ValueError: ``move_budget`` is not an integer from 0 to 800.
    """

    levels = LEVELS
    memory_kind: ClassVar = "counting"
    oracles: ClassVar = {"state": StateOracle, "frames": FramesOracle}

    def __init__(
        self, level: Params, *, id: str, obs_size: int, rules: Rules, move_budget: int = MOVE_BUDGET
    ) -> None:
        if (
            isinstance(move_budget, bool)
            or not isinstance(move_budget, int)
            or not 0 <= move_budget <= LARGEST_BUDGET
        ):
            raise ValueError(
                f"move_budget is {move_budget!r}, allowed: an integer from 0 to {LARGEST_BUDGET}"
            )
        super().__init__(level, id=id, obs_size=obs_size, rules=rules)
        self.move_budget = move_budget
        self.max_steps = level.cards + move_budget
        self.return_range = (0.0, 1.0)
        # A counter that is not held shows what it reaches, except that it stops at two digits below
        # 0.
        counter = (0, level.most) if rules == "default" else (-99, self.max_steps)
        self.screen = Screen(obs_size, level, counter)

    def reset(self, key: Array) -> CountRecallState:
        """See :meth:`Game.reset`."""
        return rules.reset(key, self.level)

    def step(
        self, key: Array, state: CountRecallState, action: Array
    ) -> tuple[CountRecallState, Array, Array, Array]:
        """See :meth:`Game.step`."""
        del key  # nothing is random after the deal
        return rules.step(state, action, self.level, self.max_steps, self.rules)

    def facts(self, state: CountRecallState) -> dict[str, Array]:
        """The suit asked for, the right answer, and how many cards of each suit were dealt before,
        float32 [suits]; -1 and NaN after the last turn.
        """
        query, counts = rules.dealt(state, self.level)
        answer = jnp.where(query < 0, jnp.nan, counts[jnp.maximum(query, 0)])
        return {"query": query, "answer": answer, "dealt": counts}
