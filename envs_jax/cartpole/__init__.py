"""CartPole and NoisyCartPole: keep the pole up, seen as a picture with velocity arrows."""

from typing import ClassVar

from arcade_torch.envs_jax.cartpole import rules
from arcade_torch.envs_jax.cartpole.oracle import FramesOracle, StateOracle
from arcade_torch.envs_jax.cartpole.renderer import ARROWS, Arrow, Screen
from arcade_torch.envs_jax.cartpole.rules import LEVELS, CartPoleState, Params
from arcade_torch.envs_jax.game import Array, LevelGame, Rules
from arcade_torch.envs_jax.validation import check_choice


class CartPole(LevelGame[CartPoleState]):
    """Push a cart left and right so that its pole stays up.

    Actions 2 and 3 push with 10 N to the left and right, the others not at all. Each step that
    begins within the limits (2.4 m, 12 degrees) pays ``1 / max_steps``; leaving them terminates,
    ``max_steps`` truncates. Returns lie in (0, 1].

    The MDP twin shows cart, pole and two velocity arrows; the POMDP twin shows cart and pole in the
    first frame only. ``NoisyCartPole`` adds normal noise to what is drawn, never to the dynamics;
    the same noise in both twins.

    Args:
        rules: ``"reference"`` judges reward and end one step late, on the state before the step.
        arrow: ``"log"`` draws arrows whose size grows with the logarithm of the speed, in eight
            classes for speeds up to 4 (as published); ``"linear"`` draws lengths proportional to
            the speed, from which the position can be integrated.

    Source: POPGym Arcade (ICML 2026). Differs from popgym-arcade 0.0.7 in: ends are not one step
        late, the pole has one
    colour, noise is part of the state.

    Raises:
        ValueError: Unknown ``arrow``.
    """

    levels = LEVELS
    memory_kind: ClassVar = "velocity"
    oracles: ClassVar = {"state": StateOracle, "frames": FramesOracle}

    def __init__(
        self, level: Params, *, id: str, obs_size: int, rules: Rules, arrow: Arrow = "log"
    ) -> None:
        check_choice("arrow", arrow, ARROWS)
        super().__init__(level, id=id, obs_size=obs_size, rules=rules)
        self.arrow = arrow
        self.max_steps = level.max_steps
        self.return_range = (1.0 / level.max_steps, 1.0)
        self.screen = Screen(obs_size, level.max_steps, arrow)

    def reset(self, key: Array) -> CartPoleState:
        """See :meth:`Game.reset`."""
        return rules.reset(key, self.level)

    def step(
        self, key: Array, state: CartPoleState, action: Array
    ) -> tuple[CartPoleState, Array, Array, Array]:
        """See :meth:`Game.step`."""
        return rules.step(key, state, action, self.level, self.rules)

    def facts(self, state: CartPoleState) -> dict[str, Array]:
        """Position (m) and velocity of the cart, angle (rad) and angular velocity of the pole,
        without the noise of the picture.
        """
        return {
            "position": state.x,
            "velocity": state.x_dot,
            "angle": state.theta,
            "angular_velocity": state.theta_dot,
        }
