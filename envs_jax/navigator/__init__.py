"""Navigator: find the treasure, avoid TNT, on a map that the POMDP shows only once."""

from typing import ClassVar

import jax.numpy as jnp

from arcade_torch.envs_jax.game import Array, LevelGame, Rules
from arcade_torch.envs_jax.navigator import rules
from arcade_torch.envs_jax.navigator.oracle import FramesOracle, StateOracle
from arcade_torch.envs_jax.navigator.renderer import Screen
from arcade_torch.envs_jax.navigator.rules import LEVELS, NavigatorState, Params


class Navigator(LevelGame[NavigatorState]):
    """Walk to the treasure and open it; seven blocks of TNT lie about.

    Actions 0 to 3 move the agent by one cell, 4 opens what it stands on. Opening the treasure pays
    1 and ends the game, a move that ends on TNT pays -0.5 and ends it too; all else costs ``0.5 /
    cells``, and ``cells`` steps truncate. Returns lie in [0.5 / cells - 1, 1 - 0.5 / cells]; after
    d moves the treasure is worth ``1 - 0.5 d / cells``.

    The MDP twin shows the map; the POMDP twin shows it in the first frame only, and the agent
    always. On a few maps (3, 0.5 and 0.3 in a thousand) TNT walls off treasure or agent.

    Args:
        rules: ``"reference"`` puts the treasure almost always on the same few cells, may put it or
            the agent onto TNT, and pays nothing for the step that reaches the time limit. Returns
            then lie in [1 / cells - 1, 1].

    Source: POPGym Arcade (ICML 2026). Differs from popgym-arcade 0.0.7 in: treasure and agent are
        on cells of their
    own, uniformly random in every episode; the last step is paid; the agent's square is smaller
    than its tile; no colours are blended.
    """

    levels = LEVELS
    memory_kind: ClassVar = "mapping"
    oracles: ClassVar = {"state": StateOracle, "frames": FramesOracle}

    def __init__(self, level: Params, *, id: str, obs_size: int, rules: Rules) -> None:
        super().__init__(level, id=id, obs_size=obs_size, rules=rules)
        self.max_steps = level.max_steps
        self.return_range = (-1 - level.step_reward, 1 + level.step_reward)
        if rules == "reference":
            self.return_range = (-1 - 2 * level.step_reward, 1.0)
        self.screen = Screen(obs_size, level)

    def reset(self, key: Array) -> NavigatorState:
        """See :meth:`Game.reset`."""
        return rules.reset(key, self.level, self.rules)

    def step(
        self, key: Array, state: NavigatorState, action: Array
    ) -> tuple[NavigatorState, Array, Array, Array]:
        """See :meth:`Game.step`."""
        return rules.step(state, action, self.level, self.rules)

    def facts(self, state: NavigatorState) -> dict[str, Array]:
        """Where treasure and agent are: column and row, float32."""
        is_treasure = state.board == rules.TREASURE
        return {
            "treasure_x": is_treasure.any(1).argmax().astype(jnp.float32),
            "treasure_y": is_treasure.any(0).argmax().astype(jnp.float32),
            "agent_x": state.x.astype(jnp.float32),
            "agent_y": state.y.astype(jnp.float32),
        }
