"""Greedy evaluation on seeds that training never sees."""

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

import arcade_torch
from arcade_torch.agents.checked import coerce, require
from arcade_torch.agents.config import MOST_EPISODES, SEED_LIMIT, TrainConfig
from arcade_torch.agents.metrics import student_half_width
from arcade_torch.agents.torch_settings import plain_torch
from arcade_torch.envs_jax.game import check_ends
from arcade_torch.envs_jax.registry import is_mixture, resolve_id
from arcade_torch.envs_jax.validation import plain


@dataclass(frozen=True)
class EvalResult:
    """First finished episodes of fresh environments."""

    returns: NDArray[np.float32]  # [E], undiscounted return of each episode
    lengths: NDArray[np.int64]  # [E], steps of each episode
    games: tuple[str, ...] = ()
    """Of a mixture the game of each episode, by its versioned id; empty where all play one."""

    @property
    def by_game(self) -> dict[str, "EvalResult"]:
        """Of a mixture the episodes of each game, in the order of the games; empty of one game."""
        results = {}
        for game in dict.fromkeys(self.games):
            rows = np.array(self.games) == game
            results[game] = EvalResult(self.returns[rows], self.lengths[rows])
        return results

    @property
    def mean(self) -> float:
        """Mean return."""
        return float(self.returns.mean())

    @property
    def std(self) -> float:
        """Sample standard deviation of the returns; 0 for one episode."""
        return float(self.returns.std(ddof=1)) if len(self.returns) > 1 else 0.0

    @property
    def ci(self) -> float:
        """Half width of Student's 95 % interval of the mean return; NaN for one episode, which
        tells none.
        """
        return student_half_width(self.returns)

    @property
    def half_width(self) -> float | None:
        """The same for JSON, which has no NaN."""
        return None if len(self.returns) == 1 else self.ci

    @property
    def text(self) -> str:
        """The mean with its interval, and of how many episodes."""
        if len(self.returns) == 1:
            return f"return {self.mean:.3f} of one episode, which gives no interval"
        return (
            f"mean return {self.mean:.3f} +- {self.ci:.3f} (95 %) over {len(self.returns)} episodes"
        )


def held_out_seed(seed: int) -> int:
    """The environment seed of evaluation seed ``seed``, in [0, 2**30) else ValueError: training
    uses environment seeds below 2**30, evaluation those from 2**30 on, so no environment is ever in
    both.
    """
    seed = coerce("seed", plain(seed), int)
    require(0 <= seed < SEED_LIMIT, "seed", seed, f"in [0, {SEED_LIMIT})")
    return SEED_LIMIT + seed


def make_env(
    config: TrainConfig, num_envs: int, seed: int, observability: str | None = None
) -> arcade_torch.ArcadeEnv:
    """Environments of a run, of the twin it names (or another); of ``"mixed"`` the first half are
    MDPs, and where several games are played every other one, so that each game has both.
    """
    twin: Any = observability or config.observability
    if twin == "mixed":
        number = torch.arange(num_envs, device="cpu")
        twin = number % 2 == 1 if is_mixture(config.env) else number >= num_envs // 2
    return arcade_torch.make(
        config.env,
        num_envs=num_envs,
        observability=twin,
        obs_size=config.obs_size,
        seed=seed,
        device=config.device,
        rules=config.rules,
        **config.env_options,
    )


def make_eval_env(
    config: TrainConfig, episodes: int, observability: Literal["full", "partial"] | None = None
) -> Any:
    """The environments an evaluation of this config plays in, one an episode; of another twin on
    request.
    """
    return make_env(config, episodes, held_out_seed(0), observability)


@plain_torch()
@torch.no_grad()
def evaluate(
    agent: Any,
    observability: Literal["full", "partial"] | None = None,
    episodes: int = 128,
    seed: int = 0,
    env: Any = None,
    game: str | None = None,
) -> EvalResult:
    """Play greedily; gives returns and lengths of the first finished episode of each of
    ``episodes`` environments.

    Every environment contributes exactly one episode, so long episodes count as much as short ones.
    A warning says in how many of them the agent decided by outputs that are NaN.

    Args:
        agent: an ``Agent``, played where its network is; with ``env``, anything with
            ``initial_state`` and ``act``.
        observability: twin to play; default the one the agent was trained on (of a mixed training,
            half the episodes each). With ``env`` given, its own is put back afterwards.
        episodes: number of environments, and of episodes.
        seed: evaluation seed in [0, 2**30); the same seed plays the same episodes for every agent.
            Disjoint from all training seeds, see :func:`held_out_seed`.
        env: environments from :func:`make_eval_env` to use again (saves compiling); their number
            replaces ``episodes``.
        game: another game than the agent was trained on, or one of its mixture (without ``env``);
            it gets the same options.

    Raises:
        ValueError: ``episodes`` is not positive, ``seed`` is out of range, ``observability`` or
            ``game`` is unknown, or an episode does not end in time.
        TypeError: an option that the game does not have, or something that is no agent or no
            environment of ours.
    """
    _check_players(agent, env)
    episodes = _count(episodes)
    held_out_seed(seed)  # before anything is compiled
    is_twin = observability in (None, "full", "partial")
    require(is_twin, "observability", observability, "'full' or 'partial'")
    require(env is None or game is None, "game", game, "left out where env is given")
    if env is None:
        config = agent.config if game is None else replace(agent.config, env=resolve_id(game))
        device = str(next(agent.network.parameters()).device)
        env = make_eval_env(
            replace(config, device=device, cuda_graphs=False), episodes, observability
        )
    before = env.observability
    try:
        if observability is not None:
            env.set_observability(observability)
        env.set_seed(held_out_seed(seed))
        return _play(agent, env)
    finally:
        env.set_observability(before)


def _count(episodes: Any) -> int:
    """The number of episodes; refused (ValueError) where no batch is of so many."""
    count: int = coerce("episodes", plain(episodes), int)
    allowed = f"a whole number from 1 to {MOST_EPISODES}"
    require(1 <= count <= MOST_EPISODES, "episodes", episodes, allowed)
    return count


def _check_players(agent: Any, env: Any) -> None:
    """Refuse (TypeError) an agent that cannot act, or says no game where no ``env`` does, and an
    ``env`` that is none of ours.
    """
    names = ["act", "initial_state"] if env is not None else ["act", "initial_state", "config"]
    missing = [name for name in names if not hasattr(agent, name)]
    if missing == ["config"]:
        raise TypeError(
            f"{type(agent).__name__} does not say which game it plays: hand over env as well"
        )
    if missing:
        raise TypeError(
            "agent must be an agent, as load(...) and from_pretrained(...) give; got "
            f"{type(agent).__name__}: arcade_torch.tools.as_policy(policy) makes one of a "
            "TensorDict policy or a network, to evaluate with env="
        )
    if env is not None and not hasattr(env, "set_observability"):
        raise TypeError(
            "env must be environments of arcade_torch.make(...) or make_eval_env(...); got "
            f"{type(env).__name__}: greedy_window of arcade_torch.tools plays any env of TorchRL"
        )


def _play(agent: Any, env: Any) -> EvalResult:
    """One episode in each environment."""
    obs = env.reset()
    num_envs = env.batch_size[0]
    state = agent.initial_state(num_envs)
    returns = np.zeros(num_envs, np.float32)
    lengths = np.zeros(num_envs, np.int64)
    playing = np.ones(num_envs, bool)
    is_lost = np.zeros(num_envs, bool)
    steps = 0
    while playing.any():
        check_ends(env.game, steps)
        steps += 1
        action, extras, state = agent.act(obs, state)
        is_lost |= _are_nan(extras, num_envs) & playing
        step, obs = env.step_and_maybe_reset(obs.set("action", action))
        ended = step["next", "done"].view(-1).cpu().numpy() & playing
        if ended.any():
            returns[ended] = step["next", "episode_reward"].view(-1).cpu().numpy()[ended]
            lengths[ended] = step["next", "step_count"].view(-1).cpu().numpy()[ended]
            playing &= ~ended
    if is_lost.any():
        warnings.warn(
            f"the agent's outputs are NaN in {is_lost.sum()} of {num_envs} episodes, and its "
            "actions say nothing there: its state may grow beyond all bounds",
            stacklevel=4,
        )
    return EvalResult(returns, lengths, _games_played(env))


def _are_nan(extras: Any, num_envs: int) -> NDArray[np.bool_]:
    """Where an agent decides by outputs that are no numbers, bool [N]; nowhere if it shows none."""
    for name in ("q_value", "logits"):
        if isinstance(extras, Mapping) and name in extras:
            are_nan: NDArray[np.bool_] = extras[name].isnan().any(-1).cpu().numpy()
            return are_nan
    return np.zeros(num_envs, np.bool_)


def _games_played(env: Any) -> tuple[str, ...]:
    """The game of each environment of a mixture, by its id; empty where all play one."""
    if len(env.games) == 1:
        return ()
    return tuple(env.games[task].id for task in env.task.tolist())
