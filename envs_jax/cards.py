"""Shuffled things: packs of suits, for the games that deal cards, and ranks."""

import jax
import jax.numpy as jnp

from arcade_torch.envs_jax.game import Array

SUIT_NAMES = ("heart", "spade", "club", "diamond")
HEART, SPADE, CLUB, DIAMOND = range(len(SUIT_NAMES))


def deal(key: Array, packs: int, cards: int, suits: int) -> Array:
    """Shuffle packs that hold the suits as evenly as can be: card i of an unshuffled pack has suit
    i modulo ``suits``.

    A card's sort key has 30 random bits above its suit, so one sort of plain integers shuffles and
    carries the suits along; it is faster than a sort of indices, and for these sizes than ranks by
    comparison.

    Args:
        key: uint32 [2].
        packs: How many packs to shuffle, each on its own.
        cards: Cards in each.
        suits: Number of suits, 1 to 4.

    Returns:
        int8 [packs, cards], each row a uniformly random order of its pack.

    Example:
        >>> jnp.bincount(deal(jax.random.PRNGKey(0), 2, 26, 4)[1]).tolist()
        [7, 7, 6, 6]
    """
    suit = jnp.arange(cards, dtype=jnp.uint32) % suits
    draw = jax.random.bits(key, (packs, cards)) & ~jnp.uint32(3)
    return (jnp.sort(draw | suit, axis=-1) & 3).astype(jnp.int8)


def random_ranks(key: Array, count: int) -> Array:
    """A uniformly random order of 0 to ``count - 1``: int32 [count], from a key uint32 [2].

    Ranks of random numbers by comparison, several times faster than a sort of so few.
    """
    draw = jax.random.bits(key, (count,))
    index = jnp.arange(count)
    lower = (draw[None, :] < draw[:, None]) | (
        (draw[None, :] == draw[:, None]) & (index[None, :] < index[:, None])
    )
    return lower.sum(1, dtype=jnp.int32)
