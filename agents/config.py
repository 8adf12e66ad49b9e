"""What a run is: one frozen dataclass, and its JSON form."""

import dataclasses
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from arcade_torch.agents.dqn import DQNConfig
from arcade_torch.agents.learner import Checked, LearnerConfig, require
from arcade_torch.agents.ppo import PPOConfig
from arcade_torch.agents.pqn import PQNConfig

SEED_LIMIT = 2**30  # training seeds lie below, evaluation seeds above; see evaluation.held_out_seed
RESUME_MAY_CHANGE = ("checkpoint_every", "threads", "logger")  # fields that do not belong to a run's identity
GROUPS: dict[str, type[LearnerConfig]] = {"pqn": PQNConfig, "ppo": PPOConfig, "dqn": DQNConfig}
"""The algorithms, and the class of the field with their numbers."""
RENAMED = {
    "learning_rate_share": "lr_decay_fraction",
    "epsilon_share": "exploration_fraction",
    "entropy_weight": "entropy_coeff",
    "value_weight": "critic_coeff",
    "context": "overlap",
}
"""Fields of version 0.1 and their names since 0.2; the old ones go in 0.3."""


@dataclass(frozen=True)
class TrainConfig(Checked):
    """Everything that decides a training run.

    Counts of frames are environment steps summed over the environments: one environment, one action, one frame.
    """

    env: str = "CartPoleEasy"
    """Game id, see ``arcade_torch.registered_ids()``; a run pins the version that a bare name means."""
    observability: Literal["full", "partial", "mixed"] = "full"
    """Which twin: ``"full"`` is the MDP, ``"partial"`` the POMDP, ``"mixed"`` half the environments each."""
    obs_size: int = 128
    """Height and width of the frames, pixels."""
    rules: Literal["default", "reference"] = "default"
    """Law of the games; ``"reference"`` is the one the published numbers were made with."""
    env_options: Mapping[str, Any] = field(default_factory=dict)
    """Further options of the game."""
    memory: str = "lru"
    """Memory model, see ``arcade_torch.models.memory_names()``; ``"feedforward"``: the paper's network without any."""
    network: str = "paper"
    """Network preset around the memory model: ``"paper"`` or ``"small"``."""
    network_options: Mapping[str, Any] = field(default_factory=dict)
    """Further options of ``make_network``."""
    algorithm: Literal["pqn", "ppo", "dqn"] = "pqn"
    """Learner; its numbers are in the field of that name, those of the others are not looked at."""
    total_frames: int = 20_000_000
    """Frames of training; rounded down to whole updates."""
    seed: int = 0
    """Seed of everything random in the run, in [0, 2**30)."""
    device: str = "cpu"
    """Torch device of the network and the learner."""
    amp: bool = False
    """Take the convolutions in bfloat16, where processor or GPU can: faster, and other numbers; the rest stays float32.
    Agents act as they were trained."""
    compile: bool = False
    """Run encoder and memory through ``torch.compile``: half a minute or more at the start, and rounding of its own.
    Meant for GPUs: two cores are no faster with it. What is saved is the same; a loaded agent is not compiled."""
    cuda_graphs: bool = False
    """Replay acting, and every whole gradient step (loss, backward pass, clipping, optimiser), as one CUDA graph each,
    which saves launches; needs a CUDA device."""
    threads: int = 0
    """Torch threads; 0 leaves the setting alone. With 1, several runs side by side are fastest in total."""
    eval_every: int = 1_000_000
    """Frames between greedy evaluations; 0 evaluates only at the end."""
    eval_episodes: int = 128
    """Episodes of each evaluation, one in each of as many fresh environments."""
    checkpoint_every: int = 500_000
    """Frames between checkpoints; 0 saves only at the end and when interrupted."""
    logger: Literal["none", "tensorboard", "wandb"] = "none"
    """Where the rows of ``metrics.csv`` and ``eval.csv`` go beside the files; needs the extra ``loggers``.
    ``"wandb"`` works offline (``wandb sync`` uploads) unless the environment says ``WANDB_MODE=online``."""
    pqn: PQNConfig = field(default_factory=PQNConfig)
    """Numbers of the PQN learner."""
    ppo: PPOConfig = field(default_factory=PPOConfig)
    """Numbers of the PPO learner."""
    dqn: DQNConfig = field(default_factory=DQNConfig)
    """Numbers of the DQN learner."""

    def __post_init__(self) -> None:
        """Refuse values that cannot work, one line each; names of games and models are checked when they are made."""
        super().__post_init__()
        for name in ("env", "memory", "network", "device"):
            self._require(getattr(self, name) != "", name, "a non-empty string")
        kind = self.device.partition(":")[0]
        self._require(kind in ("cpu", "cuda", "mps", "xpu"), "device", "a torch device such as 'cpu' or 'cuda:0'")
        on_cuda = self.device.startswith("cuda") or not self.cuda_graphs
        self._require(on_cuda, "cuda_graphs", f"false on device {self.device!r}; it needs a CUDA device")
        self._require(self.obs_size >= 1, "obs_size", "a number of pixels >= 1")
        self._require(0 <= self.seed < SEED_LIMIT, "seed", f"in [0, {SEED_LIMIT})")
        self._each(("threads", "eval_every", "checkpoint_every"), lambda x: x >= 0, "a whole number >= 0")
        self._require(self.eval_episodes >= 1, "eval_episodes", "a whole number >= 1")
        self._check_sizes()

    def _check_sizes(self) -> None:
        """Refuse numbers that do not fit those of the learner."""
        envs, steps, per_update = self.learner.num_envs, self.learner.num_steps, self.learner.frames_per_update
        allowed = f"at least one update of {envs} envs x {steps} steps = {per_update} frames"
        self._require(self.total_frames >= per_update, "total_frames", allowed)
        if self.observability == "mixed":
            require(envs % 2 == 0, f"{self.algorithm}.num_envs", envs, "even with observability='mixed'")

    @property
    def learner(self) -> LearnerConfig:
        """Numbers of the learner that ``algorithm`` names."""
        found: LearnerConfig = getattr(self, self.algorithm)
        return found

    @property
    def num_updates(self) -> int:
        """Whole updates in the run."""
        return self.total_frames // self.learner.frames_per_update

    def to_dict(self) -> dict[str, Any]:
        """Plain nested dictionary, ready for JSON."""
        plain = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        plain.update({name: dataclasses.asdict(getattr(self, name)) for name in GROUPS})
        plain.update(env_options=dict(self.env_options), network_options=dict(self.network_options))
        return plain

    @classmethod
    def from_dict(cls, plain: Mapping[str, Any]) -> "TrainConfig":
        """The inverse of :meth:`to_dict`.

        Raises:
            ValueError: a field is unknown, has the wrong type, or holds a value that is not allowed.
        """
        require(isinstance(plain, Mapping), "a config", plain, "a table of fields")
        values, groups = dict(plain), {}
        for name, kind in GROUPS.items():
            numbers = values.pop(name, {})
            require(isinstance(numbers, Mapping), name, numbers, "a table of fields")
            groups[name] = kind(**_checked(kind, numbers, f"{name}."))
        return cls(**_checked(cls, values, ""), **groups)  # type: ignore[arg-type]


def differing_fields(one: TrainConfig, other: TrainConfig) -> list[str]:
    """Names of the fields that make two configs different runs, as ``name (this != that)``.

    Numbers of learners that neither of them uses make no difference.
    """
    mine, theirs = _flatten(one.to_dict()), _flatten(other.to_dict())
    unused = tuple(f"{name}." for name in GROUPS if name not in (one.algorithm, other.algorithm))
    names = [n for n in mine.keys() | theirs.keys() if n not in RESUME_MAY_CHANGE and not n.startswith(unused)]
    return [f"{n} ({mine.get(n)!r} != {theirs.get(n)!r})" for n in sorted(names) if mine.get(n) != theirs.get(n)]


def _checked(cls: type, values: Mapping[str, Any], prefix: str) -> dict[str, Any]:
    """Values for the fields of a dataclass, by today's names; unknown ones are refused."""
    known = {f.name for f in dataclasses.fields(cls)}
    for old in (set(values) - known) & set(RENAMED):
        warnings.warn(
            f"{prefix}{old} is called {RENAMED[old]} since 0.2; 0.3 drops the old name", FutureWarning, stacklevel=2
        )
    values = {name if name in known else RENAMED.get(name, name): value for name, value in values.items()}
    unknown = sorted(set(values) - known)
    if unknown:
        raise ValueError(f"unknown field {prefix + unknown[0]!r}; fields: {', '.join(sorted(known))}")
    return values


def _flatten(plain: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in plain.items():
        if isinstance(value, Mapping):
            flat |= _flatten(value, f"{prefix}{name}.")
        else:
            flat[prefix + name] = value
    return flat
