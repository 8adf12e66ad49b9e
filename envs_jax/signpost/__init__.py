"""Signpost: the smallest task that cannot be played without memory. A probe, not one of the ten
games.
"""

from typing import ClassVar

from arcade_torch.envs_jax.game import Array, LevelGame, Rules
from arcade_torch.envs_jax.signpost import rules
from arcade_torch.envs_jax.signpost.oracle import FramesOracle, StateOracle
from arcade_torch.envs_jax.signpost.renderer import Screen
from arcade_torch.envs_jax.signpost.rules import LEVELS, Params, SignpostState


class Signpost(LevelGame[SignpostState]):
    """Read the sign, walk to the gate, press the direction that the sign showed.

    Every action walks one cell along the corridor, and every one but 3 (right) stumbles and costs
    ``1 / corridor``. At the gate the action is the answer: the sign's direction opens the gate and
    pays 1, anything else pays 0, and the game ends. Returns lie in [-1, 1]. Without memory no
    player can expect more than 1/4; random play expects ``1/5 - 4/5``.

    The MDP twin shows the sign all the time; the POMDP twin shows it in the first frame alone.

    Args:
        rules: ``"default"`` and ``"reference"`` are the same here: no rules were published.

    Source: our own; a T-maze (Bakker 2001, "Reinforcement Learning with Long Short-Term Memory")
        with four ways on.
    """

    levels = LEVELS
    memory_kind: ClassVar = "recall"
    oracles: ClassVar = {"state": StateOracle, "frames": FramesOracle}

    def __init__(self, level: Params, *, id: str, obs_size: int, rules: Rules) -> None:
        super().__init__(level, id=id, obs_size=obs_size, rules=rules)
        self.max_steps = level.max_steps
        self.return_range = (-1.0, 1.0)
        self.screen = Screen(obs_size, level)

    def reset(self, key: Array) -> SignpostState:
        """See :meth:`Game.reset`."""
        return rules.reset(key)

    def step(
        self, key: Array, state: SignpostState, action: Array
    ) -> tuple[SignpostState, Array, Array, Array]:
        """See :meth:`Game.step`."""
        return rules.step(state, action, self.level)

    def facts(self, state: SignpostState) -> dict[str, Array]:
        """The sign, the action that opens the gate."""
        return {"sign": state.sign}
