"""Skittles: dodge blocks that fall, and flicker in the POMDP."""

from typing import ClassVar

import jax.numpy as jnp

from arcade_torch.envs_jax.game import Array, LevelGame, Rules
from arcade_torch.envs_jax.skittles import rules
from arcade_torch.envs_jax.skittles.oracle import FramesOracle, StateOracle
from arcade_torch.envs_jax.skittles.renderer import Screen
from arcade_torch.envs_jax.skittles.rules import LEVELS, MAX_STEPS, Params, SkittlesState
from arcade_torch.envs_jax.validation import check_penalty


class Skittles(LevelGame[SkittlesState]):
    """Dodge the blocks that fall towards the bottom row of a 10 x 10 grid, one new block a step.

    Actions 2 and 3 move the agent to the left and right within its lane, the others wait. Every
    step pays 1/100, the fatal one too; being hit terminates, 100 steps truncate. The first block
    arrives at step 10, so returns lie in [0.1, 1]. Some way through all blocks always exists.

    The MDP twin shows every block; the POMDP twin hides each cell with probability 1/2, anew at
    every step.

    Args:
        rules: ``"reference"`` flickers alike in all episodes, and blocks may leave no way through.
        hit_reward: Added to the reward of the step in which the agent is hit. The published scale
            has 0; the paper's words ask for a negative number.

    Source: POPGym Arcade (ICML 2026). Differs from popgym-arcade 0.0.7 in: every episode flickers
        in its own way, a way through exists, ``terminated`` is a flag and not a count.

    Raises:
        TypeError: ``hit_reward`` is no number.
        ValueError: ``hit_reward`` is positive or beyond -1.
    """

    levels = LEVELS
    memory_kind: ClassVar = "tracking"
    oracles: ClassVar = {"state": StateOracle, "frames": FramesOracle}

    def __init__(
        self, level: Params, *, id: str, obs_size: int, rules: Rules, hit_reward: float = 0.0
    ) -> None:
        check_penalty("hit_reward", hit_reward)
        super().__init__(level, id=id, obs_size=obs_size, rules=rules)
        self.hit_reward = float(hit_reward)
        self.max_steps = MAX_STEPS
        self.return_range = (0.1 + self.hit_reward, 1.0)
        self.screen = Screen(obs_size)

    def reset(self, key: Array) -> SkittlesState:
        """See :meth:`Game.reset`."""
        return rules.reset(key, self.level, self.rules)

    def step(
        self, key: Array, state: SkittlesState, action: Array
    ) -> tuple[SkittlesState, Array, Array, Array]:
        """See :meth:`Game.step`."""
        return rules.step(key, state, action, self.level, self.rules, self.hit_reward)

    def facts(self, state: SkittlesState) -> dict[str, Array]:
        """The column of the block in each row from the top, int32 [10], -1 in an empty row; and the
        agent's column, float32.
        """
        return {"block": state.column, "agent_x": state.x.astype(jnp.float32)}
