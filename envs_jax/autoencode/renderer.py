"""The screen of AutoEncode: the card on the table, the selector, and the stack of cards still to be
named.
"""

import jax.numpy as jnp

from arcade_torch.envs_jax.autoencode.rules import AutoEncodeState, Params
from arcade_torch.envs_jax.game import Array
from arcade_torch.envs_jax.render import Layers, number_slot, titled_background
from arcade_torch.envs_jax.render.palette import HOT_PINK, PALE_BLUE, SCARLET
from arcade_torch.envs_jax.render.suits import NO_CARD, corner_slot, history_codes, history_grid


class Screen:
    """Everything on the screen of one AutoEncode configuration.

    Args:
        size: Side of the picture, 128 or 256.
        level: Numbers of the difficulty.
        mdp_marker: Whether the MDP twin takes the cards away that have been answered.
    """

    def __init__(self, size: int, level: Params, mdp_marker: bool) -> None:
        self.level = level
        self.mdp_marker = mdp_marker
        background = titled_background(size, "AUTOENCODE", PALE_BLUE, HOT_PINK)
        # the reference can pay one card twice
        self.score = number_slot(size, level.cards + 1, PALE_BLUE, SCARLET)
        shorter = 3 * (size // 128)
        self.card = corner_slot(size, False, PALE_BLUE, shorter)
        self.selector = corner_slot(size, True, PALE_BLUE, shorter)
        self.history = history_grid(size, PALE_BLUE)
        self.layers = Layers(background, self.score, self.card, self.selector, self.history)

    def draw(self, state: AutoEncodeState, partial: Array | bool) -> Array:
        """The frame of a state: uint8 [S, S, 3]. The POMDP twin shows no stack."""
        index = jnp.arange(self.level.cards)
        height = jnp.minimum(state.timestep, self.level.cards)
        if self.mdp_marker:
            height -= state.given
        current = jnp.where(index == state.timestep, 1 + state.cards, NO_CARD).sum()
        history = history_codes(state.cards, (index < height) & ~jnp.asarray(partial))
        return self.layers.draw(state.score, current, 1 + state.selected, history)
