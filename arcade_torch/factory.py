"""``make``: from the id of a game to a batch of envs."""

from typing import Any

import torch

from arcade_torch.compiled import compiled_game
from arcade_torch.env import ArcadeEnv, check_num_envs
from arcade_torch.observability import Observability, resolve_observability


def make(
    id: str,
    num_envs: int = 16,
    observability: Observability | None = None,
    obs_size: int = 128,
    seed: int | None = 0,
    device: torch.device | str | None = None,
    rules: str = "default",
    *,
    partial_obs: bool | None = None,
    categorical_actions: bool = True,
    state_in_td: bool = False,
    debug: bool = False,
    **options: Any,
) -> ArcadeEnv:
    """Make a batch of envs of one game.

    Args:
        id: Id of the game, such as ``"CartPoleEasy"`` (newest version) or ``"CartPoleEasy-v0"``.
        num_envs: Number of envs in the batch.
        observability: ``"full"`` (MDP, the default), ``"partial"`` (POMDP twin), or bool [num_envs], true = partial.
        obs_size: Side of the frames, 128 or 256 pixels.
        seed: Seed of the batch; None draws one.
        device: Device of all tensors; None for the device that JAX computes on.
        rules: ``"default"`` or ``"reference"`` (the law of the published numbers).
        partial_obs: Alias: True means ``observability="partial"``.
        categorical_actions: False for one-hot actions.
        state_in_td: Whether the whole game state travels in the tensordict, for planners; see ``ArcadeEnv``.
        debug: Whether actions are checked on CUDA too, where that makes the host wait.
        **options: Options of the game.

    Returns:
        The env, not yet reset.

    Raises:
        ValueError: Unknown id, size, rules, device, observability, or a number of envs that is not positive.
        TypeError: An argument of a wrong type, or an option the game does not have.

    Example:
        >>> env = make("CartPoleEasy", num_envs=2, observability="partial")
        >>> env.rollout(3)["pixels"].shape
        torch.Size([2, 3, 128, 128, 3])
    """
    check_num_envs(num_envs)
    flags = resolve_observability(observability, partial_obs, num_envs)
    return ArcadeEnv(
        compiled_game(id, obs_size, rules, options),
        num_envs,
        flags,
        seed=seed,
        device=device,
        categorical_actions=categorical_actions,
        state_in_td=state_in_td,
        debug=debug,
    )
