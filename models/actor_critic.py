"""Actor and critic with memory: a network each, or one for both."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential, dispatch
from torch import Tensor, nn

from arcade_torch.models.memory import Store
from arcade_torch.models.networks import MemoryNetwork
from arcade_torch.models.presets import make_network, preset_of

__all__ = ["ActorCriticNetwork", "make_actor_critic"]


class ActorCriticNetwork(TensorDictModuleBase):
    """Actor and critic as one TensorDict module, which writes ``logits`` [*, A] and ``state_value``
    [*, 1].

    Either two networks that share nothing but the frames, as in the paper, or one for both at half
    the price, whose last output is the value. The plain-tensor methods are those of
    :class:`MemoryNetwork`; their output is [..., A + 1], the value last, and their state has an
    entry for each network.

    Args:
        actor: gives A logits; without a critic A + 1 outputs.
        critic: gives one value; sees frames of the same size. Its output and state keys differ from
            the actor's.

    Attributes:
        actor, critic: TensorDict modules for the terms of a loss; where one network serves both,
            the critic reads what the actor has written (TorchRL's ``A2CLoss`` has to be given
            :attr:`estimator`, or it trains no critic).

    Source: POPGym Arcade (ICML 2026), PPO network table; the reference implementation's recurrent
        actor-critic.
    """

    offers = ("logits", "probs", "value")
    """What :meth:`select` can read an output as."""

    def __init__(self, actor: MemoryNetwork, critic: MemoryNetwork | None = None) -> None:
        super().__init__()
        self.networks = {"both": actor} if critic is None else {"actor": actor, "critic": critic}
        if critic is None:
            logits = partial(self.select, what="logits")
            value = partial(self.select, what="value")
            self.actor = TensorDictSequential(
                actor, TensorDictModule(logits, [actor.out_key], ["logits"])
            )
            self.critic = TensorDictModule(value, [actor.out_key], ["state_value"])
        else:
            self.actor = actor
            self.critic = critic
        self.in_keys = list(
            dict.fromkeys(key for network in self.networks.values() for key in network.in_keys)
        )
        self.out_keys = [*self.actor.out_keys, *self.critic.out_keys]

    @property
    def estimator(self) -> TensorDictModuleBase:
        """What gives ``state_value`` from frames by itself."""
        return self if "both" in self.networks else self.critic

    @dispatch  # type: ignore[untyped-decorator]
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Run both, see :meth:`MemoryNetwork.forward`; the value is [*batch, 1]."""
        return self.critic(self.actor(tensordict))

    def compress(self, pixels: Tensor) -> Tensor:
        """What of the frames is worth storing, see :meth:`MemoryNetwork.compress`; the same for
        both networks.
        """
        return next(iter(self.networks.values())).compress(pixels)

    def calibrate(self, pixels: Tensor) -> None:
        """Set the input scaling from frames of random play."""
        for network in self.networks.values():
            network.calibrate(pixels)

    def encode(self, pixels: Tensor) -> Tensor:
        """Frames to features, float [..., E], of two networks [..., 2 E], the actor's first."""
        return torch.cat([network.encode(pixels) for network in self.networks.values()], dim=-1)

    def remember(
        self, features: Tensor, last_action: Tensor, is_init: Tensor, state: TensorDict
    ) -> tuple[Tensor, TensorDict]:
        """Everything behind :meth:`encode`, see :meth:`MemoryNetwork.remember`; the output is [B,
        T, A + 1].
        """
        parts = zip(self.networks.items(), features.chunk(len(self.networks), dim=-1), strict=True)
        read = {
            name: network.remember(part, last_action, is_init, state[name])
            for (name, network), part in parts
        }
        after = TensorDict(
            {name: state for name, (_, state) in read.items()}, batch_size=state.batch_size
        )
        return torch.cat([out for out, _ in read.values()], dim=-1), after

    def initial_state(self, batch_size: int | Sequence[int]) -> TensorDict:
        """Recurrent state at the start of an episode, TensorDict [batch_size]."""
        states = {
            name: network.initial_state(batch_size) for name, network in self.networks.items()
        }
        return TensorDict(
            states, batch_size=[batch_size] if isinstance(batch_size, int) else list(batch_size)
        )

    @staticmethod
    def split(out: Tensor) -> tuple[Tensor, Tensor]:
        """An output [..., A + 1] as (logits [..., A], value [...])."""
        return out[..., :-1], out[..., -1]

    @classmethod
    def select(cls, out: Tensor, what: str) -> Tensor:
        """Read an output as one of :attr:`offers`.

        Args:
            out: float [..., A + 1].
            what: "logits", "probs" (of the actions) or "value".

        Returns:
            float [..., A], for "value" [..., 1].

        Raises:
            ValueError: another word.
        """
        if what not in cls.offers:
            raise ValueError(f"an actor-critic offers {', '.join(cls.offers)}, not {what!r}")
        if what == "value":
            return out[..., -1:]
        return out[..., :-1].softmax(-1) if what == "probs" else out[..., :-1]


def make_actor_critic(
    preset: str = "paper",
    memory: str | Callable[..., nn.Module] = "lru",
    *,
    obs_size: int = 128,
    num_actions: int = 5,
    memory_options: dict[str, Any] | None = None,
    store: Store = "sequence",
    **options: Any,
) -> ActorCriticNetwork:
    """Make actor and critic: two networks, each with its own initial weights, or one (``towers=1``;
    "small").

    Args:
        preset: see :func:`make_network`; the heads are the preset's ``actor_critic_head`` unless
            ``head`` is given.
        memory: see :func:`make_network`.
        obs_size: side of the frames in pixels.
        num_actions: A.
        memory_options: options of the cells, over those of the preset.
        store: see :func:`make_network`.
        **options: see :func:`make_network`; ``use_last_action=False`` is the published code, unlike
            its table.

    Returns:
        The module; states stand under ``("memory", "actor")`` and ``("memory", "critic")``, or
        ``("memory", "both")``.

    Raises:
        ValueError: unknown preset, memory, size, or value of an option.
        TypeError: unknown option.

    Example:
        >>> network = make_actor_critic("small", "gru")
        >>> frames = torch.zeros(2, 7, 128, 128, 3, dtype=torch.uint8)
        >>> last_action = torch.zeros(2, 7, dtype=torch.int64)
        >>> is_init = torch.zeros(2, 7, dtype=torch.bool)
        >>> features = network.encode(frames)
        >>> out, state = network.remember(features, last_action, is_init, network.initial_state(2))
        >>> [tuple(part.shape) for part in network.split(out)]
        [(2, 7, 5), (2, 7)]
    """
    chosen = preset_of(preset)
    options.setdefault("head", options.pop("actor_critic_head", chosen.actor_critic_head))
    make: Any = partial(
        make_network, preset, memory, obs_size=obs_size, num_actions=num_actions, store=store
    )
    make = partial(make, memory_options=memory_options, **options)
    if options.get("towers", chosen.towers) == 1:
        both = make(
            num_outputs=num_actions + 1, out_key="logits_and_value", state_key=("memory", "both")
        )
        return ActorCriticNetwork(both)
    actor = make(num_outputs=num_actions, out_key="logits", state_key=("memory", "actor"))
    critic = make(
        num_outputs=1, out_key="state_value", state_key=("memory", "critic"), predicts=False
    )
    return ActorCriticNetwork(actor, critic)
