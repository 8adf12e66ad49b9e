"""``make``: from the id of a game, or the ids of several, to a batch of envs."""

from collections.abc import Sequence
from typing import Any

import torch

from arcade_torch import default_seeds
from arcade_torch.compiled import compiled_game
from arcade_torch.default_seeds import DEFAULT_SEED
from arcade_torch.env import ArcadeEnv
from arcade_torch.envs_jax.validation import Observability, check_num_envs, partial_flags


def make(
    id: str | Sequence[str],
    num_envs: int = 16,
    observability: Observability | None = None,
    obs_size: int = 128,
    seed: int | None = DEFAULT_SEED,
    device: torch.device | str | None = None,
    rules: str = "default",
    *,
    partial_obs: bool | None = None,
    categorical_actions: bool = True,
    state_in_td: bool = False,
    task_in_td: bool | None = None,
    debug: bool = False,
    **options: Any,
) -> ArcadeEnv:
    """Make a batch of envs, not yet reset, of one game or of several that one policy is to play.

    Several games share the envs nearly equally, in their order; an id that stands in the list k
    times gets k shares. The key ``task`` is an index into ``env.games``. ``env.game`` has the
    longest time limit of all and the widest range of returns: report each game's own.

    Args:
        id: ``"CartPoleEasy-v0"``, or ``"CartPoleEasy"`` for its newest version; or several, as a
            list or as the command line has them, ``"CartPoleEasy+2*TetrisEasy"``.
        num_envs: Number of envs in the batch.
        observability: ``"full"`` (the default), ``"partial"``, or bool [num_envs], true = partial.
        obs_size: Side of the frames, 128 or 256 pixels.
        seed: Seed of the batch; None draws one. Envs with one seed play the same episodes.
        device: Device of all tensors; None for the device that JAX computes on.
        rules: ``"default"`` or ``"reference"`` (those of the published numbers).
        partial_obs: Alias: True means ``observability="partial"``.
        categorical_actions: False for one-hot actions.
        state_in_td: Whether the game state is in the tensordict, for planners; see ``ArcadeEnv``.
        task_in_td: Whether there is a key ``task``; None: if ``id`` names several games.
        debug: Whether actions are checked on CUDA too, where that makes the host wait.
        **options: Options of the game; several games all have to have them.

    Raises:
        ValueError: An unknown choice, no id, or fewer envs than games.
        TypeError: An argument of a wrong type, or an option the game does not have.

    Example:
        >>> make(["CartPoleEasy", "MineSweeperEasy"], num_envs=5).reset()["task"]
        tensor([0, 0, 0, 1, 1])
    """
    num_envs = check_num_envs(num_envs)
    flags = partial_flags(observability, num_envs, partial_obs)
    env = ArcadeEnv(
        compiled_game(id, obs_size, rules, options),
        num_envs,
        flags,
        seed=seed,
        device=device,
        categorical_actions=categorical_actions,
        state_in_td=state_in_td,
        task_in_td=task_in_td,
        debug=debug,
    )
    default_seeds.note(env, seed, plays=(repr(env.game), num_envs, flags.tobytes()))
    return env
