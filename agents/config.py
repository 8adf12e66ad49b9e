"""What a run is: frozen dataclasses of plain numbers, and their JSON form. Imports no torch."""

import dataclasses
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, Literal

from arcade_torch.agents.checked import (
    Checked,
    Count,
    CountOrZero,
    Fraction,
    Options,
    Positive,
    PositiveOrZero,
    Range,
    Text,
    require,
)
from arcade_torch.envs_jax.validation import kind_of

SEED_LIMIT = 2**30  # training seeds lie below, evaluation seeds above; see evaluation.held_out_seed
MOST_EPISODES = 2**16
"""Of an evaluation. They are played side by side, one an environment: the frames of one step of so
many take 3 GB at 128 pixels.
"""
# more than a system has room for would end the process
Threads = Annotated[int, Range("a whole number from 0 to 1024", lambda x: 0 <= x <= 1024)]
# Names that are no options, because other fields decide them and learners rely on them.
OF_ENV = (
    "id",
    "num_envs",
    "observability",
    "obs_size",
    "seed",
    "device",
    "rules",
    "categorical_actions",
)
OF_NETWORK = (
    "preset",
    "memory",
    "obs_size",
    "num_outputs",
    "num_actions",
    "out_key",
    "value_key",
    "state_key",
    "store",
    "encoder",
)
DEVICE = re.compile(r"cpu(:0)?|cuda(:(0|[1-9][0-9]{0,2}))?")
Device = Annotated[str, Range("'cpu', 'cuda' or one of several such as 'cuda:0'", DEVICE.fullmatch)]
Seed = Annotated[int, Range(f"in [0, {SEED_LIMIT})", lambda x: 0 <= x < SEED_LIMIT)]
Episodes = Annotated[int, Range(f"from 1 to {MOST_EPISODES}", lambda x: 1 <= x <= MOST_EPISODES)]
TimeLimit = Literal["bootstrap", "terminal"]
Bootstrap = Literal["next", "last"]


@dataclass(frozen=True)
class LearnerConfig(Checked):
    """What PQN, PPO and DQN share; the defaults are the paper's, schedules in fractions of the
    run's frames.

    A schedule over a fraction of the run keeps its shape when the run is shortened.
    """

    # the field with the number of sequences that an update goes over
    SPLIT: ClassVar[str] = "num_envs"

    num_envs: Count = 16
    """Environments stepped together."""
    num_steps: Count = 128
    """New steps of each environment per update."""
    epochs: Count = 4
    """Passes over the data of an update."""
    minibatches: Count = 16
    """Parts a pass is split in, over sequences, never over time."""
    gamma: Fraction = 0.99
    """Discount per step."""
    lam: Fraction = 0.95
    """Lambda of the return (of PPO: of the generalised advantage estimate), in [0, 1]."""
    learning_rate: Positive = 5e-5
    """Step size at the start."""
    learning_rate_end: PositiveOrZero = 5e-7
    """Step size after the decay."""
    lr_decay_fraction: Fraction = 0.1
    """Fraction of the run's frames over which the step size falls linearly; 0 starts at the end
    value.
    """
    max_grad_norm: Positive = 0.5
    """Limit on the joint norm of the gradients."""
    average_share: Fraction = 0.0
    """The weights that act and are saved are a mean of those that learn, over about this share of
    the updates so far (polynomial decay: Shamir & Zhang, arXiv 1212.1824). The share grows with the
    training return: none at the lowest that the game can pay, all of it at the highest, between
    them by the fourth power, or a higher one in games that pay less than 0 (``window_share`` in
    ``agents/learner.py``). 0: no mean.
    """
    warmup_steps: CountOrZero = 0
    """Random steps of each environment before training, not counted as frames; they calibrate the
    input scaling.
    """
    time_limit: TimeLimit = "bootstrap"
    """``"bootstrap"``: a truncation keeps the value of its final frame; ``"terminal"``: it ends as
    a termination.
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        rows = getattr(self, self.SPLIT)
        allowed = f"a divisor of {self.SPLIT}={rows}: whole sequences go into a minibatch"
        self._require(rows % self.minibatches == 0, "minibatches", allowed)
        allowed = f"at most num_steps={self.num_steps}"
        self._require(self.steps_before <= self.num_steps, "overlap", allowed)

    @property
    def steps_before(self) -> int:
        """Steps of the previous window that stand in front of the new ones."""
        return int(getattr(self, "overlap", 0))

    @property
    def frames_per_update(self) -> int:
        """New frames one update consumes."""
        return self.num_envs * self.num_steps

    @property
    def grad_steps_per_update(self) -> int:
        """Optimiser steps one update takes."""
        return self.epochs * self.minibatches


@dataclass(frozen=True)
class QConfig(LearnerConfig):
    """What the learners of Q-values share; at the paper's 20 M frames, the fractions 0.1 and 0.4
    are its 2 M frames of learning-rate decay and 8 M frames of exploration decay.
    """

    warmup_steps: CountOrZero = 132
    """Random steps of each environment before training, not counted as frames; they calibrate the
    input scaling.
    """
    overlap: CountOrZero = 4
    """Steps of the previous window repeated in front of the new ones; they take part in the loss
    again.
    """
    epsilon_start: Fraction = 1.0
    """Probability of a uniformly random action at the start."""
    epsilon_end: Fraction = 0.05
    """The same after the decay."""
    exploration_fraction: Fraction = 0.4
    """Fraction of the run's frames over which it falls linearly."""


@dataclass(frozen=True)
class PQNConfig(QConfig):
    """Numbers of PQN; the defaults are the paper's, schedules in fractions of the run's frames.

    Source: POPGym Arcade (ICML 2026), hyperparameter table of PQN; Gallici et al., arXiv
    2407.04811.
    """

    GROUP: ClassVar[str] = "pqn."

    bootstrap: Bootstrap = "next"
    """``"next"``: every step is trained, the last with the observation after it; ``"last"`` (the
    published form): the last step of a window only lends its value, and is trained in the next
    window's overlap (needs overlap >= 1)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        allowed = (
            ">= 1 with bootstrap='last': the last step of a window is only trained in the overlap "
            "of the next"
        )
        self._require(self.bootstrap == "next" or self.overlap >= 1, "overlap", allowed)


@dataclass(frozen=True)
class PPOConfig(LearnerConfig):
    """Numbers of PPO; the defaults are the paper's, the step size falls over the whole run.

    Source: POPGym Arcade (ICML 2026), hyperparameter table of PPO; Schulman et al., arXiv
    1707.06347.
    """

    GROUP: ClassVar[str] = "ppo."

    learning_rate: Positive = 1e-4
    """Step size at the start."""
    learning_rate_end: PositiveOrZero = 1e-10
    """Step size after the decay."""
    lr_decay_fraction: Fraction = 1.0
    """Fraction of the run's frames over which the step size falls linearly; 0 starts at the end
    value.
    """
    clip: Positive = 0.2
    """How far the probability ratio, and the value, may move in an update before the gradient
    stops.
    """
    entropy_coeff: PositiveOrZero = 0.01
    """Weight of the entropy bonus at the start."""
    entropy_end: Annotated[float, Range("a number in (0, 1]", lambda x: 0.0 < x <= 1.0)] = 1.0
    """Share of that weight which is left at the end of the run, reached by equal factors; 1 keeps
    it, and no factor leads to 0 (for no bonus: ``entropy_coeff`` 0)."""
    advantage_decay: Annotated[float, Range("a number in [0, 1)", lambda x: 0.0 <= x < 1.0)] = 0.0
    """Share kept, at each update, of the running deviation that divides advantages; 0: each
    minibatch has its own.
    """
    critic_coeff: PositiveOrZero = 0.5
    """Weight of the value loss (half the mean squared error)."""
    prediction_coeff: PositiveOrZero = 0.0
    """Weight of an auxiliary loss: the memory learns to expect the next frame's features (arXiv
    2401.08898).
    """


@dataclass(frozen=True)
class DQNConfig(QConfig):
    """Numbers of DQN, schedules in fractions of the run's frames.

    The paper gives none; these are those of its published code, except for ``targets`` and
    ``time_limit``. An item of the replay is one environment's window: ``overlap + num_steps``
    frames with their actions, rewards and flags, the recurrent state before the first of them, and
    the final frames that targets need.

    Source: reference implementation of POPGym Arcade; Mnih et al., Nature 518 (2015); Kapturowski
    et al., "Recurrent experience replay in distributed reinforcement learning" (ICLR 2019), for
    stored states and burn-in.
    """

    GROUP: ClassVar[str] = "dqn."
    SPLIT: ClassVar[str] = "batch_sequences"

    lam: Fraction = 0.0
    """Lambda of the return, in [0, 1]; 0 is the one-step target."""
    replay_frames: int = 132_000
    """Capacity in frames (43,200 bytes at 128 pixels, 3,072 with the small encoder), rounded down
    to whole windows.
    """
    batch_sequences: Count = 32
    """Sequences drawn in an update, without repetition; all epochs go over the same."""
    learning_starts: Count = 32
    """Sequences that must be stored before learning starts."""
    burn_in: CountOrZero = 0
    """First steps of a sequence that only bring the memory up to date: read without gradient, no
    part of the loss.
    """
    targets: Literal["recompute", "stored"] = "recompute"
    """``"recompute"``: from present Q-values, at every use; ``"stored"`` (the published form):
    once, when collected.
    """
    target_every: CountOrZero = 0
    """Updates between copies of the network to a target network, which then gives the next values;
    0 for none.
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        length = self.overlap + self.num_steps
        self._require(self.burn_in < length, "burn_in", f"less than overlap + num_steps = {length}")
        is_one_network = self.targets != "stored" or not self.target_every
        self._require(is_one_network, "target_every", "0 with targets='stored'")
        needed = max(self.batch_sequences, self.learning_starts, self.num_envs)
        windows = -(-needed // self.num_envs)
        frames = windows * self.num_envs * length
        allowed = f">= {frames}, room for {needed} sequences of {length} frames"
        self._require(self.replay_sequences >= needed, "replay_frames", allowed)

    @property
    def replay_sequences(self) -> int:
        """Capacity in sequences: whole windows of all environments."""
        window = self.num_envs * (self.overlap + self.num_steps)
        return self.replay_frames // window * self.num_envs


GROUPS: dict[str, type[LearnerConfig]] = {"pqn": PQNConfig, "ppo": PPOConfig, "dqn": DQNConfig}
"""The algorithms, and the class of the field with their numbers."""


@dataclass(frozen=True)
class TrainConfig(Checked):
    """Everything that decides a training run.

    Counts of frames are environment steps summed over the environments: one environment, one
    action, one frame.
    """

    env: Text = "CartPoleEasy"
    """Game id, see ``arcade_torch.registered_ids()``, or several that one agent is to learn,
    ``CartPoleEasy+2*TetrisEasy``; a run pins the version that a bare name means.
    """
    observability: Literal["full", "partial", "mixed"] = "full"
    """Which twin: ``"full"`` is the MDP, ``"partial"`` the POMDP, ``"mixed"`` half the environments
    each.
    """
    obs_size: Count = 128
    """Height and width of the frames, pixels."""
    rules: Literal["default", "reference"] = "default"
    """Rules of the games; ``"reference"``: those that the published numbers were made with."""
    env_options: Options = field(default_factory=dict)
    """Further options of the game."""
    memory: Text = "lru"
    """Memory model, see ``arcade_torch.models.memory_names()``; ``"feedforward"``: the paper's
    network without any.
    """
    network: Text = "paper"
    """Network preset around the memory model: ``"paper"``, ``"small"`` or ``"small64"``, which sees
    64 instead of 32 pixels.
    """
    network_options: Options = field(default_factory=dict)
    """Further options of ``make_network``."""
    algorithm: Literal["pqn", "ppo", "dqn"] = "pqn"
    """Learner; its numbers are in the field of that name, those of the others are not looked at."""
    total_frames: Annotated[int, Range("at most 10**15", lambda x: x <= 10**15)] = 20_000_000
    """Frames of training; rounded down to whole updates."""
    seed: Seed = 0
    """Seed of everything random in the run, in [0, 2**30)."""
    device: Device = "cpu"
    """Torch device of the network and the learner."""
    amp: bool = False
    """Take the encoder in bfloat16, and the rest in float32: other numbers, faster on a GPU and on
    x86 with AMX, slower on some without. Agents act as they were trained."""
    compile: bool = False
    """Run encoder and memory through ``torch.compile``: half a minute or more at the start, and
    rounding of its own. Meant for GPUs: two cores are no faster with it. What is saved is the same;
    a loaded agent is not compiled."""
    cuda_graphs: bool = False
    """Replay acting, and every whole gradient step (loss, backward pass, clipping, optimiser), as
    one CUDA graph each, which saves launches; needs a CUDA device."""
    threads: Threads = 0
    """Torch threads; 0 leaves the setting alone. With 1, several runs side by side are fastest in
    total.
    """
    eval_every: CountOrZero = 1_000_000
    """Frames between greedy evaluations; 0 evaluates only at the end."""
    eval_episodes: Episodes = 128
    """Episodes of each evaluation, one in each of as many fresh environments."""
    checkpoint_every: CountOrZero = 500_000
    """Frames between checkpoints; 0 saves only at the end and when interrupted."""
    logger: Literal["none", "tensorboard", "wandb"] = "none"
    """Where the rows of ``metrics.csv`` and ``eval.csv`` go beside the files; needs the extra
    ``loggers``. ``"wandb"`` works offline (``wandb sync`` uploads) unless the environment says
    ``WANDB_MODE=online``."""
    pqn: PQNConfig = field(default_factory=PQNConfig)
    """Numbers of the PQN learner."""
    ppo: PPOConfig = field(default_factory=PPOConfig)
    """Numbers of the PPO learner."""
    dqn: DQNConfig = field(default_factory=DQNConfig)
    """Numbers of the DQN learner."""

    def __post_init__(self) -> None:
        super().__post_init__()  # names of games and models are checked when they are made
        self._refuse_decided("env_options", OF_ENV)
        self._refuse_decided("network_options", OF_NETWORK)
        cell_options = self.network_options.get("memory_options") or {}
        name = "network_options.memory_options"
        is_table = isinstance(cell_options, Mapping)
        require(is_table, name, cell_options, "a table of options of the memory")

        on_cuda = self.device.startswith("cuda")
        allowed = f"false on device {self.device!r}; it needs a CUDA device"
        self._require(on_cuda or not self.cuda_graphs, "cuda_graphs", allowed)

        envs = self.learner.num_envs
        steps = self.learner.num_steps
        frames = self.learner.frames_per_update
        allowed = f"at least one update of {envs} envs x {steps} steps = {frames} frames"
        self._require(self.total_frames >= frames, "total_frames", allowed)

        even = envs % 2 == 0 or self.observability != "mixed"
        require(even, f"{self.algorithm}.num_envs", envs, "even with observability='mixed'")

    def _refuse_decided(self, name: str, decided: tuple[str, ...]) -> None:
        """Refuse options that other fields decide."""
        options = getattr(self, name)
        given = ", ".join(option for option in options if option in decided)
        self._require(not given, name, f"without {given}, which other fields decide")

    @property
    def learner(self) -> LearnerConfig:
        """Numbers of the learner that ``algorithm`` names."""
        return getattr(self, self.algorithm)  # type: ignore[no-any-return]

    @property
    def num_updates(self) -> int:
        """Whole updates in the run."""
        return self.total_frames // self.learner.frames_per_update

    def to_dict(self) -> dict[str, Any]:
        """Plain nested dictionary, ready for JSON."""
        return dataclasses.asdict(self)

    @classmethod
    def from_dict(cls, plain: Mapping[str, Any]) -> "TrainConfig":
        """The inverse of :meth:`to_dict`.

        Raises:
            ValueError: a field is unknown, has the wrong type, or holds a value that is not
                allowed.
        """
        values = _fields_of(cls, plain, "")
        for name, kind in GROUPS.items():
            values[name] = kind(**_fields_of(kind, values.get(name, {}), kind.GROUP))
        return cls(**values)


def check_config(config: Any) -> None:
    """Refuse what is no `TrainConfig` (TypeError)."""
    if not isinstance(config, TrainConfig):
        raise TypeError(
            f"config must be a TrainConfig, as preset(...) gives; got {kind_of(config)}"
        )


def _fields_of(cls: type, values: Any, prefix: str) -> dict[str, Any]:
    """Values for the fields of a dataclass; unknown names are refused."""
    require(isinstance(values, Mapping), prefix[:-1] or "a config", values, "a table of fields")
    names = sorted(item.name for item in dataclasses.fields(cls))
    for name in values:
        if name not in names:
            raise ValueError(f"unknown field {prefix + str(name)!r}; fields: {', '.join(names)}")
    return dict(values)
