"""Ready-made configs, by name."""

import dataclasses
from collections.abc import Mapping
from typing import Any

from arcade_torch.agents.checked import coerce, require
from arcade_torch.agents.config import GROUPS, TrainConfig
from arcade_torch.envs_jax.registry import names_in

_SMALL = {
    "num_envs": 64,
    "num_steps": 32,
    "max_grad_norm": 1.0,
    "warmup_steps": 150,
    "time_limit": "terminal",
}
_SMALL_Q = {
    "overlap": 0,
    "minibatches": 16,
    "lam": 0.8,
    "lr_decay_fraction": 1.0,
    "exploration_fraction": 0.4,
}
_SMALL_PQN = _SMALL_Q | {"epochs": 2, "learning_rate": 5e-4, "learning_rate_end": 5e-6}
_SMALL_DQN = _SMALL_Q | {
    "epochs": 1,
    "learning_rate": 1e-3,
    "learning_rate_end": 5e-5,
    "replay_frames": 100_000,
    "batch_sequences": 128,
    "learning_starts": 256,
    "burn_in": 4,
}
_SMALL_PPO = {
    "epochs": 2,
    "minibatches": 8,
    "learning_rate": 1e-3,
    "learning_rate_end": 5e-5,
    "average_share": 0.1,
    "entropy_coeff": 0.1,
    "entropy_end": 0.001,
    "critic_coeff": 4.0,
    "advantage_decay": 0.99,
    "prediction_coeff": 1.0,
}
# an action is paid in the step it is taken
_AT_ONCE = ("AutoEncode", "BattleShip", "CountRecall", "MineSweeper")
# every step survived is paid, and nothing else
_SURVIVAL = ("CartPole", "NoisyCartPole", "NoisyPole", "Skittles")
# Every step costs, and only the way to the treasure pays. Where limits end, walking down the clock
# is a way out that agents found and did not leave; and what the next frame will be (the agent, one
# cell further) says too little to be worth a loss.
_SEARCH = ("Navigator",)
_SMALL_SEARCH = {
    "time_limit": "bootstrap",
    "entropy_coeff": 0.05,
    "prediction_coeff": 0.0,
}
# Every hit of the ball is needed, and whoever still draws actions at random misses some.
_RALLY = ("Breakout",)
_SMALL_RALLY = {"entropy_coeff": 0.02}
# 10 million frames in the paper, where the others have 20
_HALF_BUDGET = ("AutoEncode", "CartPole", "NoisyCartPole", "NoisyPole")
_TINY = {"num_envs": 8, "num_steps": 8, "minibatches": 4, "warmup_steps": 8}
_TINY_REPLAY = {"replay_frames": 192, "batch_sequences": 8, "learning_starts": 16, "burn_in": 2}
_PRESETS: dict[str, dict[str, Any]] = {
    "paper": {},
    "reference": {
        "rules": "reference",
        "network_options": {"skip": "none"},
        "pqn": {"time_limit": "terminal", "bootstrap": "last"},
        "ppo": {"time_limit": "terminal"},
        "dqn": {"time_limit": "terminal", "targets": "stored"},
    },
    "small": {
        "algorithm": "ppo",
        "network": "small",
        "total_frames": 2_500_000,
        "threads": 1,
        "eval_every": 250_000,
        "checkpoint_every": 50_000,
        "pqn": _SMALL | _SMALL_PQN,
        "ppo": _SMALL | _SMALL_PPO,
        "dqn": _SMALL | _SMALL_DQN,
    },
    "smoke": {
        "algorithm": "pqn",
        "network": "small",
        "memory": "mingru",
        "total_frames": 512,
        "threads": 1,
        "eval_every": 0,
        "eval_episodes": 4,
        "checkpoint_every": 128,
        "pqn": _SMALL | _SMALL_PQN | _TINY,
        "ppo": _SMALL | _SMALL_PPO | _TINY,
        "dqn": _SMALL | _SMALL_DQN | _TINY | _TINY_REPLAY,
    },
}


def preset_names() -> list[str]:
    """Names that :func:`preset` knows."""
    return sorted(_PRESETS)


def preset(name: str, **changes: Any) -> TrainConfig:
    """A ready-made config, with some fields changed. Every preset has numbers for each algorithm.

    What a preset means stands here alone: ``train``, ``study`` and Python begin with this config,
    the algorithm with it, PQN but for ``small``.

    * ``paper``: the paper's settings and network; 10 M frames for CartPole, NoisyCartPole and
      AutoEncode, 20 M else.
    * ``reference``: ``paper`` as its published code behaves: time limits end like terminations, the
      last step of a window is trained in the next (PQN), targets are stored (DQN), no last action
      (PPO), no skip connection around the memory, the rules of the published numbers.
    * ``small``: a small network and PPO, made for the ten Easy games in ten minutes of one core
      (results/small.md; results/recipe.md says how it was chosen). PQN and DQN learn CartPoleEasy,
      SkittlesEasy, MineSweeperEasy with it. Time limits end like terminations; PPO's memory also
      learns to expect the next frame's features. PPO's gamma is .98 in games that pay an action at
      once (AutoEncode, BattleShip, CountRecall, MineSweeper), .995 in those that pay every step
      survived (the CartPoles, Skittles), .99 in the others. In Navigator limits bootstrap, the
      bonus begins at half, and no frame is expected: with the numbers of the others both seeds that
      were tried walked down the clock (results/small.md). In Breakout the bonus begins at .02, a
      fifth of that of the others. A mixture of games with other numbers has those of none.
    * ``smoke``: ``small`` with PQN, cut down until a run takes seconds; it learns nothing.

    Args:
        name: preset.
        **changes: fields of :class:`TrainConfig`; ``pqn``, ``ppo``, ``dqn`` may be a dictionary of
            their fields; only that of the chosen algorithm may be given.

    Returns:
        The config.

    Raises:
        ValueError: the preset or a field is unknown, or a value is not allowed.

    Example:
        >>> preset("small", env="CartPoleEasy", ppo={"lam": 0.9}).ppo.lam
        0.9
        >>> preset("paper", algorithm="ppo").learner.learning_rate
        0.0001
    """
    if not isinstance(name, str) or name not in _PRESETS:
        raise ValueError(f"unknown preset {name!r}; presets: {', '.join(preset_names())}")
    values = {"algorithm": TrainConfig.algorithm, "env": TrainConfig.env} | _PRESETS[name]
    algorithm = str(changes.get("algorithm", values["algorithm"]))
    env = str(changes.get("env", values["env"]))
    values |= _adjusted_to_game(name, algorithm, env)
    for group in GROUPS:
        if group in changes:
            changes[group] = values.get(group, {}) | _group_changes(
                group, changes[group], algorithm
            )
    values |= changes
    if "total_frames" in changes:
        total_frames = coerce("total_frames", changes["total_frames"], int)
        for interval, parts in (("eval_every", 5), ("checkpoint_every", 10)):
            if interval not in changes:
                usual = values.get(interval, getattr(TrainConfig, interval))
                values[interval] = min(usual, max(1, total_frames // parts))
    return TrainConfig.from_dict(values)


def _adjusted_to_game(name: str, algorithm: str, env: str) -> dict[str, Any]:
    """The values of a preset that depend on the algorithm and the game."""
    values: dict[str, Any] = {}
    if name == "reference" and algorithm == "ppo":
        values["network_options"] = {"skip": "none", "use_last_action": False}
    if name in ("paper", "reference"):
        values |= _paper_budget(_PRESETS[name], env)
    if name == "small":
        numbers = [_small_ppo_of(game) for game in names_in(env)]
        # games that differ get the numbers of none
        of_game = numbers[0] if all(other == numbers[0] for other in numbers) else {}
        values["ppo"] = _PRESETS[name]["ppo"] | of_game
    return values


def _small_ppo_of(game: str) -> dict[str, Any]:
    """The numbers of PPO that are a game's own in the preset small."""
    if game.startswith(_AT_ONCE):
        return {"gamma": 0.98}
    if game.startswith(_SURVIVAL):
        return {"gamma": 0.995}
    if game.startswith(_SEARCH):
        return _SMALL_SEARCH
    if game.startswith(_RALLY):
        return _SMALL_RALLY
    return {}


def _group_changes(group: str, changes: Any, algorithm: str) -> dict[str, Any]:
    """The numbers of a learner that are to be changed; only those of the algorithm may be."""
    kind = GROUPS[group]
    allowed = f"a {kind.__name__} or a table of its fields"
    require(isinstance(changes, kind | Mapping), group, changes, allowed)
    plain = dataclasses.asdict(changes) if isinstance(changes, kind) else dict(changes)
    allowed = f"left out: the algorithm is {algorithm!r}, its numbers are {algorithm}.*"
    require(group == algorithm or not plain, group, plain, allowed)
    return plain


def _paper_budget(values: Mapping[str, Any], env: str) -> dict[str, Any]:
    """The published number of frames of a game; AutoEncode explores for twice the usual share of
    it. A mixture has that of its largest.
    """
    games = names_in(env)
    if not all(game.startswith(_HALF_BUDGET) for game in games):
        return {}
    budget: dict[str, Any] = {"total_frames": 10_000_000}
    if all(game.startswith("AutoEncode") for game in games):
        shares = {"exploration_fraction": 0.8, "lr_decay_fraction": 0.2}
        budget |= {group: values.get(group, {}) | shares for group in ("pqn", "dqn")}
    return budget
