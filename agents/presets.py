"""Ready-made configs, by name."""

import dataclasses
from collections.abc import Mapping
from typing import Any

from arcade_torch.agents.config import GROUPS, TrainConfig
from arcade_torch.agents.dqn import DQNConfig
from arcade_torch.agents.learner import coerce, require
from arcade_torch.agents.ppo import PPOConfig
from arcade_torch.agents.pqn import PQNConfig


def preset_names() -> list[str]:
    """Names that :func:`preset` knows."""
    return sorted(_PRESETS)


def preset(name: str, **changes: Any) -> TrainConfig:
    """A ready-made config, with some fields changed. Every preset has numbers for each algorithm.

    * ``paper``: the paper's settings and network; 10 M frames for CartPole, NoisyCartPole and AutoEncode, 20 M else.
    * ``reference``: ``paper`` as its published code behaves: time limits end like terminations, the last step of a
      window is trained in the next (PQN), targets are stored (DQN), no last action (PPO), no skip connection around the
      memory, the games' law of the published numbers.
    * ``small``: a small network that learns CartPoleEasy, SkittlesEasy or MineSweeperEasy in one to three minutes on
      one core with PQN. Time limits end like terminations: what comes after them is no part of the score. Which of the
      two learns better in runs this short is not settled.
    * ``smoke``: ``small`` cut down until a run takes seconds; it learns nothing.

    Args:
        name: preset.
        **changes: fields of :class:`TrainConfig`; ``pqn``, ``ppo``, ``dqn`` may be a dictionary of their fields;
            only that of the chosen algorithm may be given.

    Returns:
        The config.

    Raises:
        ValueError: the preset or a field is unknown, or a value is not allowed.

    Example:
        >>> preset("small", env="CartPoleEasy", pqn={"lam": 0.9}).pqn.lam
        0.9
        >>> preset("paper", algorithm="ppo").learner.learning_rate
        0.0001
    """
    if name not in _PRESETS:
        raise ValueError(f"unknown preset {name!r}; presets: {', '.join(preset_names())}")
    base = _for_algorithm(name, _PRESETS[name], changes.get("algorithm", "pqn"))
    if name in ("paper", "reference"):
        base = _paper_budget(base, str(changes.get("env", base.env)))
    merged = base.to_dict() | changes
    for group, kind in GROUPS.items():
        if group not in changes:
            continue
        given = changes[group]
        require(isinstance(given, kind | Mapping), group, given, f"a {kind.__name__} or a table of its fields")
        given = dataclasses.asdict(given) if isinstance(given, kind) else dict(given)
        used = group == base.algorithm or not given
        require(
            used, group, given, f"left out: the algorithm is {base.algorithm!r}, its numbers are {base.algorithm}.*"
        )
        merged[group] = dataclasses.asdict(getattr(base, group)) | given
    merged["total_frames"] = coerce("total_frames", merged["total_frames"], int)
    if "total_frames" in changes:
        for field_name, parts in (("eval_every", 5), ("checkpoint_every", 10)):
            if field_name not in changes:
                merged[field_name] = min(merged[field_name], max(1, merged["total_frames"] // parts))
    return TrainConfig.from_dict(merged)


def _for_algorithm(name: str, base: TrainConfig, algorithm: Any) -> TrainConfig:
    """The preset as it is for an algorithm."""
    options = dict(base.network_options)
    if name == "reference" and algorithm == "ppo":
        options["use_last_action"] = False
    return dataclasses.replace(base, algorithm=algorithm, network_options=options)


def _paper_budget(base: TrainConfig, env: str) -> TrainConfig:
    """The published number of frames of a game; AutoEncode explores for twice the usual share of it."""
    if env.startswith("AutoEncode"):
        shares: dict[str, Any] = {"exploration_fraction": 0.8, "lr_decay_fraction": 0.2}
        pqn, dqn = dataclasses.replace(base.pqn, **shares), dataclasses.replace(base.dqn, **shares)
        return dataclasses.replace(base, total_frames=10_000_000, pqn=pqn, dqn=dqn)
    if env.startswith(("CartPole", "NoisyCartPole", "NoisyPole")):
        return dataclasses.replace(base, total_frames=10_000_000)
    return base


_SMALL_PQN = PQNConfig(
    num_envs=64,
    num_steps=32,
    overlap=0,
    epochs=2,
    minibatches=16,
    lam=0.8,
    learning_rate=5e-4,
    learning_rate_end=5e-6,
    lr_decay_fraction=1.0,
    max_grad_norm=1.0,
    exploration_fraction=0.4,
    warmup_steps=150,
    time_limit="terminal",
)
_SMALL_PPO = PPOConfig(
    num_envs=64,
    num_steps=32,
    epochs=4,
    minibatches=4,
    learning_rate=1e-3,
    learning_rate_end=5e-5,
    max_grad_norm=1.0,
    warmup_steps=150,
    time_limit="terminal",
)
_SMALL_DQN = DQNConfig(
    num_envs=64,
    num_steps=32,
    overlap=0,
    epochs=1,
    minibatches=16,
    lam=0.8,
    learning_rate=1e-3,
    learning_rate_end=5e-5,
    lr_decay_fraction=1.0,
    max_grad_norm=1.0,
    exploration_fraction=0.4,
    warmup_steps=150,
    time_limit="terminal",
    replay_frames=100_000,
    batch_sequences=128,
    learning_starts=256,
    burn_in=4,
)
_SMALL = TrainConfig(
    memory="mingru",
    network="small",
    total_frames=200_000,
    threads=1,
    eval_every=40_000,
    checkpoint_every=20_000,
    pqn=_SMALL_PQN,
    ppo=_SMALL_PPO,
    dqn=_SMALL_DQN,
)
_TINY: dict[str, Any] = {"num_envs": 8, "num_steps": 8, "minibatches": 4, "warmup_steps": 8}
_PRESETS: dict[str, TrainConfig] = {
    "paper": TrainConfig(),
    "reference": TrainConfig(
        rules="reference",
        network_options={"skip": "none"},
        pqn=PQNConfig(time_limit="terminal", bootstrap="last"),
        ppo=PPOConfig(time_limit="terminal"),
        dqn=DQNConfig(time_limit="terminal", targets="stored"),
    ),
    "small": _SMALL,
    "smoke": dataclasses.replace(
        _SMALL,
        total_frames=512,
        eval_every=0,
        eval_episodes=4,
        checkpoint_every=128,
        pqn=dataclasses.replace(_SMALL_PQN, **_TINY),
        ppo=dataclasses.replace(_SMALL_PPO, **_TINY),
        dqn=dataclasses.replace(
            _SMALL_DQN, **_TINY, replay_frames=192, batch_sequences=8, learning_starts=16, burn_in=2
        ),
    ),
}
