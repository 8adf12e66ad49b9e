"""Ready-made configs, by name."""

import dataclasses
from collections.abc import Mapping
from typing import Any

from arcade_torch.agents.config import GROUPS, TrainConfig, coerce, require

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
_SMALL_REPLAY = {
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
}
_SMALL_PPO |= {
    "entropy_coeff": 0.1,
    "entropy_end": 0.001,
    "critic_coeff": 4.0,
    "advantage_decay": 0.99,
}
# an action is paid in the step it is taken
_AT_ONCE = ("AutoEncode", "BattleShip", "CountRecall", "MineSweeper")
# every step survived is paid, and nothing else
_SURVIVAL = ("CartPole", "NoisyCartPole", "NoisyPole", "Skittles")
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
        "pqn": _SMALL | _SMALL_Q | {"epochs": 2, "learning_rate": 5e-4, "learning_rate_end": 5e-6},
        "ppo": _SMALL | _SMALL_PPO | {"prediction_coeff": 1.0},
        "dqn": _SMALL
        | _SMALL_Q
        | {"epochs": 1, "learning_rate": 1e-3, "learning_rate_end": 5e-5}
        | _SMALL_REPLAY,
    },
}
_PRESETS["smoke"] = _PRESETS["small"] | {
    group: _PRESETS["small"][group] | _TINY for group in GROUPS
}
_PRESETS["smoke"]["dqn"] |= _TINY_REPLAY
_PRESETS["smoke"] |= {
    "algorithm": "pqn",
    "memory": "mingru",
    "total_frames": 512,
    "checkpoint_every": 128,
}
_PRESETS["smoke"] |= {"eval_every": 0, "eval_episodes": 4}


def preset_names() -> list[str]:
    """Names that :func:`preset` knows."""
    return sorted(_PRESETS)


def preset(name: str, **changes: Any) -> TrainConfig:
    """A ready-made config, with some fields changed. Every preset has numbers for each algorithm.

    * ``paper``: the paper's settings and network; 10 M frames for CartPole, NoisyCartPole and
      AutoEncode, 20 M else.
    * ``reference``: ``paper`` as its published code behaves: time limits end like terminations, the
      last step of a window is trained in the next (PQN), targets are stored (DQN), no last action
      (PPO), no skip connection around the memory, the games' law of the published numbers.
    * ``small``: a small network and PPO, made for the ten Easy games in ten minutes of one core
      (results/small.md; results/recipe.md says how it was chosen). PQN and DQN learn CartPoleEasy,
      SkittlesEasy, MineSweeperEasy with it. Time limits end like terminations; PPO's memory also
      learns to expect the next frame's features. PPO's gamma is .98 in games that pay an action at
      once (AutoEncode, BattleShip, CountRecall, MineSweeper), .995 in those that pay every step
      survived (the CartPoles, Skittles), .99 in the others.
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
    if name not in _PRESETS:
        raise ValueError(f"unknown preset {name!r}; presets: {', '.join(preset_names())}")
    values = dict(_PRESETS[name])
    algorithm, env = (
        str(changes.get(key, values.get(key, getattr(TrainConfig, key))))
        for key in ("algorithm", "env")
    )
    if name == "reference" and algorithm == "ppo":
        values["network_options"] = {"skip": "none", "use_last_action": False}
    if name in ("paper", "reference"):
        values |= _paper_budget(values, env)
    if name == "small" and env.startswith(_AT_ONCE + _SURVIVAL):
        values["ppo"] = values["ppo"] | {"gamma": 0.98 if env.startswith(_AT_ONCE) else 0.995}
    for group, kind in GROUPS.items():
        if group in changes:
            given = changes[group]
            require(
                isinstance(given, kind | Mapping),
                group,
                given,
                f"a {kind.__name__} or a table of its fields",
            )
            given = dataclasses.asdict(given) if isinstance(given, kind) else dict(given)
            allowed = f"left out: the algorithm is {algorithm!r}, its numbers are {algorithm}.*"
            require(group == algorithm or not given, group, given, allowed)
            changes[group] = values.get(group, {}) | given
    values |= changes
    if "total_frames" in changes:
        frames = coerce("total_frames", changes["total_frames"], int)
        for every, parts in (("eval_every", 5), ("checkpoint_every", 10)):
            if every not in changes:
                values[every] = min(
                    values.get(every, getattr(TrainConfig, every)), max(1, frames // parts)
                )
    return TrainConfig.from_dict(values)


def _paper_budget(values: Mapping[str, Any], env: str) -> dict[str, Any]:
    """The published number of frames of a game; AutoEncode explores for twice the usual share of
    it.
    """
    if not env.startswith(("AutoEncode", "CartPole", "NoisyCartPole", "NoisyPole")):
        return {}
    budget: dict[str, Any] = {"total_frames": 10_000_000}
    if env.startswith("AutoEncode"):
        shares = {"exploration_fraction": 0.8, "lr_decay_fraction": 0.2}
        budget |= {group: values.get(group, {}) | shares for group in ("pqn", "dqn")}
    return budget
