"""Policies: TensorDict modules for ``ArcadeCollector``; TorchRL's rollouts and collectors need a
memory's primer.
"""

from contextlib import suppress
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn
from torch.distributions import Categorical as CategoricalDistribution
from torchrl.data import Categorical, Composite
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import EGreedyModule, ProbabilisticActor, QValueModule

from arcade_torch.agents.batch_checks import check_module
from arcade_torch.agents.checked import Count, Fraction, coerce, require
from arcade_torch.agents.config import TrainConfig, check_config
from arcade_torch.agents.forward import evaluating, last_outputs
from arcade_torch.agents.runs.bundle import find_checkpoint
from arcade_torch.agents.runs.checkpoint import Checkpoint
from arcade_torch.agents.runs.files import CheckpointError
from arcade_torch.agents.torch_settings import device_of, plain_torch
from arcade_torch.envs_jax.validation import plain
from arcade_torch.models.actor_critic import (
    ActorCriticNetwork,
    current_names,
    make_actor_critic,
)
from arcade_torch.models.encoders import Encoder
from arcade_torch.models.flat_state import flatten_state
from arcade_torch.models.generators import kept_generators
from arcade_torch.models.networks import MemoryNetwork
from arcade_torch.models.presets import make_network

Network = MemoryNetwork | ActorCriticNetwork


def make_policy(
    network: Network, explore: bool = True, epsilon: float = 1.0, num_actions: int | None = None
) -> TensorDictSequential:
    """How a network acts.

    Args:
        network: of Q-values (``action_value``), or an actor-critic (``logits``).
        explore: for Q-values, append TorchRL's ``EGreedyModule``; for an actor-critic, sample.
        epsilon: probability of a random action; move it by ``policy[-1].eps.fill_(...)``.
        num_actions: A; None: the outputs of the last linear layer in the network's ``head``, 5 if
            it has none.

    Returns:
        A TensorDict module that writes ``action`` int64 [*], and ``action_log_prob`` where it
        samples. Random numbers come from torch's global generator.

    Raises:
        ValueError: the network writes neither, or an argument is out of its range.
        TypeError: the network is no TensorDict module.
    """
    _check_writes(network, "action_value", "logits")
    explore = coerce("explore", plain(explore), bool)
    epsilon = coerce("epsilon", plain(epsilon), Fraction)
    if num_actions is not None:
        num_actions = coerce("num_actions", plain(num_actions), Count)
    if "logits" in getattr(network, "out_keys", ()):
        return make_actor(network, deterministic=not explore)
    greedy = QValueModule(action_space="categorical")
    if not explore:
        return TensorDictSequential(network, greedy)
    device = next((p.device for p in network.parameters()), None)
    actions = Categorical(num_actions or _num_outputs(network))
    host = torch.device("cpu")  # made there whatever torch's default device is, and then moved
    exploring = EpsilonGreedy(actions, eps_init=epsilon, eps_end=0.0, device=host)
    return TensorDictSequential(network, greedy, exploring.to(device))


def make_actor(network: TensorDictModuleBase, deterministic: bool = False) -> ProbabilisticActor:
    """A policy that samples from the softmax of ``logits``.

    Args:
        network: any TensorDict module that writes ``logits`` [*, A].
        deterministic: take the most likely action unless told otherwise (``set_exploration_type``).

    Returns:
        TorchRL's ``ProbabilisticActor``; writes ``action`` int64 [*] and ``action_log_prob``.

    Raises:
        ValueError: the network does not write ``logits``.
        TypeError: it is no TensorDict module.
    """
    _check_writes(network, "logits")
    deterministic = coerce("deterministic", plain(deterministic), bool)
    kind = ExplorationType.DETERMINISTIC if deterministic else ExplorationType.RANDOM
    return ProbabilisticActor(
        network,
        in_keys=["logits"],
        distribution_class=Choice,
        distribution_kwargs={"validate_args": False},
        return_log_prob=True,
        default_interaction_type=kind,
    )


def _check_writes(network: Any, *names: str) -> None:
    """Refuse what is no TensorDict module (TypeError), or writes none of some entries
    (ValueError).
    """
    check_module(network)
    if not set(names) & set(network.out_keys):
        written = ", ".join(map(str, network.out_keys))
        raise ValueError(f"the network must write {' or '.join(names)}; it writes {written}")


class Choice(CategoricalDistribution):
    """A categorical distribution that samples something even where logits are NaN.

    ``torch.multinomial`` stops the process there (on CUDA for good), before the learner can name
    the update.
    """

    deterministic_sample = CategoricalDistribution.mode  # the name that TorchRL asks for

    def sample(self, sample_shape: Any = ()) -> Tensor:
        """Draw by the largest of ``logits + Gumbel noise``, int64 [*sample_shape, *batch]."""
        logits = self.logits.expand(*sample_shape, *self.logits.shape)
        return (logits - torch.empty_like(logits).exponential_().log()).argmax(-1)


class EpsilonGreedy(EGreedyModule):
    """TorchRL's module, whose random actions are drawn where its numbers are, also after a move.

    TorchRL moves ``eps`` alone and draws actions on the device of the spec.
    """

    def _apply(self, *args: Any, **kwargs: Any) -> "EpsilonGreedy":
        super()._apply(*args, **kwargs)
        self._spec: Composite = self.spec.to(self.eps.device)
        return self


def _num_outputs(network: nn.Module) -> int:
    """Outputs of the last linear layer in a network's head; 5 if it has none."""
    size = 5
    for layer in getattr(network, "head", nn.Identity()).modules():
        if isinstance(layer, nn.Linear):
            size = layer.out_features
    return size


class Agent(TensorDictModuleBase):
    """A trained network and the config it was trained with; as a TensorDict module it is the greedy
    policy.

    Attributes:
        config: of the run that trained it.
        network: on its device; see :meth:`outputs` for what its outputs mean.
        frames: training frames behind it.
        offers: what :meth:`outputs` can be asked for: ("q", "value") or ("logits", "probs",
            "value").

    Example:
        >>> from arcade_torch import ArcadeCollector, make
        >>> from arcade_torch.agents import preset
        >>> config = preset("small", memory="gru")
        >>> agent = Agent(config, build_network(config))
        >>> collector = ArcadeCollector(make("CartPoleEasy", num_envs=2), agent, frames_per_batch=6)
        >>> collector.collect()["action"].shape
        torch.Size([2, 3])
    """

    def __init__(self, config: TrainConfig, network: Network, frames: int = 0) -> None:
        super().__init__()
        check_config(config)
        self.config = config
        self.network = network
        self.frames = frames
        self.offers = network.offers if isinstance(network, ActorCriticNetwork) else ("q", "value")
        self.policy = make_policy(network, explore=False)
        self.in_keys = self.policy.in_keys
        self.out_keys = self.policy.out_keys

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the greedy action and what it rests on."""
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            return self.policy(tensordict)

    def initial_state(self, batch_size: int) -> TensorDictBase:
        """Recurrent state before the first observation, TensorDict [N]."""
        return self.network.initial_state(batch_size)

    @torch.no_grad()
    def act(
        self, obs: TensorDictBase, state: TensorDictBase
    ) -> tuple[Tensor, dict[str, Tensor], TensorDictBase]:
        """Greedy actions, with the recurrent state as an argument and a result.

        Args:
            obs: root entries ``pixels`` [N, ...], ``last_action`` int64 [N], ``is_init`` bool [N,
                1].
            state: recurrent state, TensorDict [N].

        Returns:
            ``(action int64 [N], extras, new state)``, with the extras ``q_value`` float32 [N, A],
            or ``logits`` [N, A] and ``state_value`` [N].
        """
        pixels = obs["pixels"].unsqueeze(1)
        steps = pixels.shape[0], 1
        last_action = obs["last_action"].reshape(steps)
        is_init = obs["is_init"].reshape(steps)
        out, state = self.network.remember(self.network.encode(pixels), last_action, is_init, state)
        heads = self.network.by_head(out.squeeze(1))
        if "logits" in heads:
            extras = {"logits": heads["logits"], "state_value": heads["state_value"].squeeze(-1)}
            return extras["logits"].argmax(-1), extras, state
        extras = {"q_value": heads["action_value"]}
        return extras["q_value"].argmax(-1), extras, state

    def outputs(self, out: Tensor, quantity: str) -> Tensor:
        """Read what ``network.remember`` gave, float [..., R], as one of :attr:`offers` (else
        ValueError).

        ``"q"``: Q-values [..., A]; ``"logits"``, ``"probs"``: of the actions [..., A]; ``"value"``:
        of the state, [..., 1], the best of its Q-values where it has these.
        """
        allowed = f"one that this agent offers: {', '.join(self.offers)}"
        require(quantity in self.offers, "quantity", quantity, allowed)
        if isinstance(self.network, ActorCriticNetwork):
            return self.network.select(out, quantity)
        return out.amax(-1, keepdim=True) if quantity == "value" else out

    def forward_frames(
        self,
        frames: Tensor,
        last_action: Tensor | None = None,
        is_init: Tensor | None = None,
        state: TensorDictBase | Tensor | None = None,
        *,
        target: str = "auto",
    ) -> Tensor:
        """Outputs of the last decision of sequences of frames, in evaluation mode, with gradients
        to the frames: a forward function for Captum.

        Args:
            frames: uint8 or float 0..255, [N, T, S, S, 3].
            last_action: int64 [N, T], the action that led to each frame; zeros by default.
            is_init: bool [N, T], whether a frame opens an episode; all false by default.
            state: recurrent state before the first frame, TensorDict [N], or float [N, F] of
                :meth:`flat_state`; the initial one by default.
            target: one of :attr:`offers`; "auto": Q-values or, for a policy, probabilities.

        Returns:
            float [N, A], of the target "value" [N, 1].
        """
        if target == "auto":
            target = "q" if "q" in self.offers else "probs"
        with evaluating(self):
            out = last_outputs(self.network, frames, last_action, is_init, state)
        return self.outputs(out, target)

    def forward_step(
        self,
        frame: Tensor,
        state: TensorDictBase | Tensor,
        last_action: Tensor | None = None,
        is_init: Tensor | None = None,
        *,
        target: str = "auto",
    ) -> Tensor:
        """Outputs of one decision from a frame [N, S, S, 3] and the recurrent state before it,
        [N, A].

        With the state as one tensor (:meth:`flat_state`) a library can attribute the decision to
        frame and state alike. All else is as for :meth:`forward_frames`, [N] in place of [N, T].
        """
        actions = None if last_action is None else last_action.reshape(-1, 1)
        flags = None if is_init is None else is_init.reshape(-1, 1)
        return self.forward_frames(frame.unsqueeze(1), actions, flags, state, target=target)

    @staticmethod
    def flat_state(state: TensorDictBase) -> Tensor:
        """A recurrent state [N] as one tensor, float32 [N, F]; a complex number is two of them."""
        return flatten_state(state)


def build_network(config: TrainConfig) -> Network:
    """The freshly initialised network of a config, on its device; the same seed gives the same
    weights, and no global draw moves; refuses what is no config (TypeError).
    """
    check_config(config)
    # on the CPU, whatever torch's default device is: there the seed says what is drawn
    with plain_torch(), kept_generators(config.seed), torch.device("cpu"):
        network = _new_network(config)
    for module in network.modules():
        if isinstance(module, Encoder):
            module.amp = config.amp
    return network.to(config.device)  # type: ignore[no-any-return]


def check_network(config: TrainConfig) -> None:
    """Refuse options that :func:`build_network` would refuse; no weight is allocated or drawn.

    Raises:
        ValueError, TypeError: an option of the network or of the memory is unknown, or its value
            is not allowed.
    """
    # a memory of somebody's own may need real numbers: its run finds out
    with suppress(RuntimeError), torch.device("meta"):
        _new_network(config)


def _new_network(config: TrainConfig) -> Network:
    """A network on torch's default device."""
    make: Any = make_actor_critic if config.algorithm == "ppo" else make_network
    options = {
        "predicts": getattr(config.learner, "prediction_coeff", 0.0) > 0,
        **config.network_options,
    }
    network: Network = make(
        config.network, memory=config.memory, obs_size=config.obs_size, **options
    )
    return network


def compile_network(network: nn.Module, backend: str) -> None:
    """Compile encoders, memories and heads in place, also for losses that hold them; weights keep
    their names.
    """
    for module in network.modules():
        if isinstance(module, MemoryNetwork):
            for part in (module.encoder, module.block, module.head):
                part.compile(backend=backend)


def _check_weights(path: Path, saved: dict[str, Tensor], wanted: dict[str, Tensor]) -> None:
    """Raise CheckpointError for weights that would load without a word and mean nothing."""
    for name, value in saved.items():
        if name in wanted and value.dtype != wanted[name].dtype:
            raise CheckpointError(
                f"the weight {name} in {path} is {value.dtype}, the network has "
                f"{wanted[name].dtype}"
            )
        if value.is_floating_point() and not bool(value.isfinite().all()):
            raise CheckpointError(
                f"the weight {name} in {path} is not finite: take the checkpoint before"
            )


def _check_size(checkpoint: Checkpoint) -> None:
    """Raise CheckpointError, before memory is taken for it, for a network far larger than the
    weights: settings may be a stranger's.
    """
    sizes: Network | None = None
    # what these options are refused for, `build_network` says; a memory may need real numbers
    with suppress(Exception), torch.device("meta"):
        sizes = _new_network(checkpoint.config)
    if sizes is None:
        return
    wanted = sum(value.numel() for value in sizes.state_dict().values())
    held = sum(value.numel() for value in checkpoint.weights.values())
    if wanted > 2 * held:  # weights of an older version may lack some
        raise CheckpointError(
            f"the settings in {checkpoint.path} are of a network of {wanted:,} numbers, its "
            f"weights hold {held:,}: they were changed, or are of another agent"
        )


def load(path: str | PathLike[str], device: str | torch.device | None = None) -> Agent:
    """Load an agent.

    Args:
        path: a run folder (its newest whole checkpoint), its ``checkpoints`` folder, one
            checkpoint folder, or a folder with an agent that was shared.
        device: where to put the network; default the device of the run if it is there, else the
            CPU.

    Returns:
        The agent, in evaluation mode: a policy for ``ArcadeCollector``, and for ``env.rollout`` if
        a memory is primed.

    Raises:
        CheckpointError: there is nothing to load at ``path``, or it is damaged; says what was
            found.
        ValueError: there is no such device.
    """
    return agent_of(find_checkpoint(Path(path)), device)


def agent_of(checkpoint: Checkpoint, device: str | torch.device | None = None) -> Agent:
    """The agent of a checkpoint, in evaluation mode; see `load`."""
    if device is not None:
        device = device_of(device)
    config = checkpoint.config
    _check_size(checkpoint)
    network = build_network(replace(config, device="cpu", cuda_graphs=False))
    weights = checkpoint.weights
    if isinstance(network, ActorCriticNetwork):
        weights = current_names(weights)
    _check_weights(checkpoint.path, weights, network.state_dict())
    try:
        network.load_state_dict(weights)
    except RuntimeError as error:
        reason = " ".join(str(error).split())[:200]  # torch names every weight
        raise CheckpointError(
            f"the weights in {checkpoint.path} do not fit the network ({reason} ...): they are of "
            "another version, or config.json was changed; train again, or use what made them"
        ) from error
    if device is None:
        wanted = torch.device(config.device)
        device = wanted if (wanted.index or 0) < torch.cuda.device_count() else "cpu"
    agent = Agent(config, network.to(device), checkpoint.frames)
    agent.eval()
    return agent
