"""What a run is: one frozen dataclass, its presets, its JSON form."""

import dataclasses
import typing
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from arcade_torch.agents.checks import require
from arcade_torch.agents.pqn import PQNConfig

SEED_LIMIT = 2**30  # training seeds lie below, evaluation seeds above; see evaluation.held_out_seed
RESUME_MAY_CHANGE = ("checkpoint_every", "threads")  # fields that do not belong to a run's identity


@dataclass(frozen=True)
class TrainConfig:
    """Everything that decides a training run.

    Counts of frames are environment steps summed over the environments: one environment, one action, one frame.
    """

    env: str = "CartPoleEasy"
    """Game id, see ``arcade_torch.registered_ids()``; a run pins the version that a bare name means."""
    observability: Literal["full", "partial"] = "full"
    """Which twin: ``"full"`` is the MDP, ``"partial"`` the POMDP."""
    obs_size: int = 128
    """Height and width of the frames, pixels."""
    rules: Literal["default", "reference"] = "default"
    """Law of the games; ``"reference"`` is the one the published numbers were made with."""
    env_options: Mapping[str, Any] = field(default_factory=dict)
    """Further options of the game."""
    memory: str = "lru"
    """Memory model, see ``arcade_torch.models.memory_names()``."""
    network: str = "paper"
    """Network preset around the memory model: ``"paper"`` or ``"small"``."""
    network_options: Mapping[str, Any] = field(default_factory=dict)
    """Further options of ``make_network``."""
    algorithm: Literal["pqn"] = "pqn"
    """Learner."""
    total_frames: int = 20_000_000
    """Frames of training; rounded down to whole updates."""
    seed: int = 0
    """Seed of everything random in the run, in [0, 2**30)."""
    device: str = "cpu"
    """Torch device of the network and the learner."""
    threads: int = 0
    """Torch threads; 0 leaves the setting alone. With 1, several runs side by side are fastest in total."""
    eval_every: int = 1_000_000
    """Frames between greedy evaluations; 0 evaluates only at the end."""
    eval_episodes: int = 128
    """Episodes of each evaluation, one in each of as many fresh environments."""
    checkpoint_every: int = 500_000
    """Frames between checkpoints; 0 saves only at the end and when interrupted."""
    pqn: PQNConfig = field(default_factory=PQNConfig)
    """Numbers of the PQN learner."""

    def __post_init__(self) -> None:
        """Refuse values that cannot work, one line each; names of games and models are checked when they are made."""
        for name in ("env", "memory", "network", "device"):
            value = getattr(self, name)
            require(isinstance(value, str) and value != "", name, value, "a non-empty string")
        for name in ("env_options", "network_options"):
            value = getattr(self, name)
            require(isinstance(value, Mapping), name, value, "a mapping of option names to values")
        require(self.observability in ("full", "partial"), "observability", self.observability, "'full' or 'partial'")
        require(self.rules in ("default", "reference"), "rules", self.rules, "'default' or 'reference'")
        require(self.algorithm == "pqn", "algorithm", self.algorithm, "'pqn'")
        require(self.obs_size >= 1, "obs_size", self.obs_size, "a number of pixels >= 1")
        require(0 <= self.seed < SEED_LIMIT, "seed", self.seed, f"in [0, {SEED_LIMIT})")
        for name in ("threads", "eval_every", "checkpoint_every"):
            require(getattr(self, name) >= 0, name, getattr(self, name), "a whole number >= 0")
        require(self.eval_episodes >= 1, "eval_episodes", self.eval_episodes, "a whole number >= 1")
        require(isinstance(self.pqn, PQNConfig), "pqn", self.pqn, "a PQNConfig")
        per_update = self.pqn.frames_per_update
        require(
            self.total_frames >= per_update,
            "total_frames",
            self.total_frames,
            f"at least one update of {self.pqn.num_envs} envs x {self.pqn.num_steps} steps = {per_update} frames",
        )

    @property
    def num_updates(self) -> int:
        """Whole updates in the run."""
        return self.total_frames // self.pqn.frames_per_update

    def to_dict(self) -> dict[str, Any]:
        """Plain nested dictionary, ready for JSON."""
        plain = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        plain.update(
            env_options=dict(self.env_options),
            network_options=dict(self.network_options),
            pqn=dataclasses.asdict(self.pqn),
        )
        return plain

    @classmethod
    def from_dict(cls, plain: Mapping[str, Any]) -> "TrainConfig":
        """The inverse of :meth:`to_dict`.

        Raises:
            ValueError: a field is unknown, has the wrong type, or holds a value that is not allowed.
        """
        values = dict(plain)
        pqn = values.pop("pqn", {})
        require(isinstance(pqn, Mapping), "pqn", pqn, "a table of fields")
        return cls(**_checked(cls, values, ""), pqn=PQNConfig(**_checked(PQNConfig, pqn, "pqn.")))


def differing_fields(one: TrainConfig, other: TrainConfig) -> list[str]:
    """Names of the fields that make two configs different runs, as ``name (this != that)``."""
    mine, theirs = _flatten(one.to_dict()), _flatten(other.to_dict())
    names = [name for name in mine.keys() | theirs.keys() if name not in RESUME_MAY_CHANGE]
    return [f"{n} ({mine.get(n)!r} != {theirs.get(n)!r})" for n in sorted(names) if mine.get(n) != theirs.get(n)]


def preset_names() -> list[str]:
    """Names that :func:`preset` knows."""
    return sorted(_PRESETS)


def preset(name: str, **changes: Any) -> TrainConfig:
    """A ready-made config, with some fields changed.

    * ``paper``: the paper's settings and network; 10 M frames for CartPole, NoisyCartPole and AutoEncode, 20 M else.
    * ``reference``: ``paper`` as its published code behaves: time limits end like terminations, the last step of a
      window is trained in the next, no skip connection around the memory, the games' law of the published numbers.
    * ``small``: a small network that learns CartPoleEasy or MineSweeperEasy in one to two minutes on one core. Time
      limits end like terminations: what comes after them is no part of the score. Which of the two learns better in
      runs this short is not settled.
    * ``demo``: ``small`` on MineSweeperEasy for 400 k frames.
    * ``smoke``: ``small`` cut down until a run takes seconds; it learns nothing.

    Args:
        name: preset.
        **changes: fields of :class:`TrainConfig`; ``pqn`` may be a dictionary of :class:`PQNConfig` fields.

    Returns:
        The config.

    Raises:
        ValueError: the preset or a field is unknown, or a value is not allowed.

    Example:
        >>> preset("small", env="CartPoleEasy", pqn={"lam": 0.9}).pqn.lam
        0.9
    """
    if name not in _PRESETS:
        raise ValueError(f"unknown preset {name!r}; presets: {', '.join(preset_names())}")
    base = _PRESETS[name]
    if name in ("paper", "reference"):
        base = _paper_budget(base, str(changes.get("env", base.env)))
    pqn = changes.pop("pqn", {})
    pqn = dataclasses.asdict(pqn) if isinstance(pqn, PQNConfig) else dict(pqn)
    merged = base.to_dict() | changes | {"pqn": dataclasses.asdict(base.pqn) | pqn}
    if "total_frames" in changes:
        merged.setdefault("eval_every", base.eval_every)
        for field_name, parts in (("eval_every", 5), ("checkpoint_every", 10)):
            if field_name not in changes:
                merged[field_name] = min(merged[field_name], max(1, int(changes["total_frames"]) // parts))
    return TrainConfig.from_dict(merged)


def _paper_budget(base: TrainConfig, env: str) -> TrainConfig:
    """The published number of frames of a game; AutoEncode explores for twice the usual share of it."""
    if env.startswith("AutoEncode"):
        pqn = dataclasses.replace(base.pqn, epsilon_share=0.8, learning_rate_share=0.2)
        return dataclasses.replace(base, total_frames=10_000_000, pqn=pqn)
    if env.startswith(("CartPole", "NoisyCartPole", "NoisyPole")):
        return dataclasses.replace(base, total_frames=10_000_000)
    return base


def _checked(cls: type, values: Mapping[str, Any], prefix: str) -> dict[str, Any]:
    """Values for the fields of a dataclass: unknown names and wrong types are refused, whole floats become ints."""
    hints = typing.get_type_hints(cls)
    known = {f.name for f in dataclasses.fields(cls)}
    unknown = sorted(set(values) - known)
    if unknown:
        raise ValueError(f"unknown field {prefix}{unknown[0]}; fields: {', '.join(sorted(known))}")
    return {name: _coerce(prefix + name, value, hints[name]) for name, value in values.items()}


def _coerce(name: str, value: Any, kind: Any) -> Any:
    if kind is int:
        whole = isinstance(value, (int, float)) and not isinstance(value, bool) and value == int(value)
        require(whole, name, value, "a whole number")
        return int(value)
    if kind is float:
        require(isinstance(value, (int, float)) and not isinstance(value, bool), name, value, "a number")
        return float(value)
    if kind is str:
        require(isinstance(value, str), name, value, "a string")
    return value


def _flatten(plain: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in plain.items():
        if isinstance(value, Mapping):
            flat |= _flatten(value, f"{prefix}{name}.")
        else:
            flat[prefix + name] = value
    return flat


_SMALL_PQN = PQNConfig(
    num_envs=64,
    num_steps=32,
    context=0,
    epochs=2,
    minibatches=8,
    lam=0.8,
    learning_rate=1e-3,
    learning_rate_end=5e-5,
    learning_rate_share=1.0,
    max_grad_norm=1.0,
    epsilon_share=0.4,
    warmup_steps=150,
    time_limit="terminal",
)
_SMALL = TrainConfig(
    memory="mingru",
    network="small",
    total_frames=200_000,
    threads=1,
    eval_every=40_000,
    checkpoint_every=20_000,
    pqn=_SMALL_PQN,
)
_PRESETS: dict[str, TrainConfig] = {
    "paper": TrainConfig(),
    "reference": TrainConfig(
        rules="reference",
        network_options={"skip": "none"},
        pqn=PQNConfig(time_limit="terminal", bootstrap="last"),
    ),
    "small": _SMALL,
    "demo": dataclasses.replace(
        _SMALL, env="MineSweeperEasy", total_frames=400_000, eval_every=80_000, checkpoint_every=40_000
    ),
    "smoke": dataclasses.replace(
        _SMALL,
        total_frames=512,
        eval_every=0,
        eval_episodes=4,
        checkpoint_every=128,
        pqn=dataclasses.replace(_SMALL_PQN, num_envs=8, num_steps=8, minibatches=4, warmup_steps=8),
    ),
}
