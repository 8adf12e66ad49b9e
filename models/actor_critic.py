"""Actor and critic with a memory each: two towers that share nothing but the frames."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from torch import Tensor, nn

from arcade_torch.models.memory import Store
from arcade_torch.models.networks import MemoryNetwork
from arcade_torch.models.presets import make_network, preset_of

__all__ = ["ActorCriticNetwork", "make_actor_critic"]


class ActorCriticNetwork(TensorDictModuleBase):
    """Two networks as one TensorDict module: the actor writes A logits, the critic the value of the state.

    Each tower is a :class:`MemoryNetwork` of its own and can be used alone. The plain-tensor methods are those of
    :class:`MemoryNetwork`; their output is [..., A + 1], the value last, and their state has an entry for each tower,
    ``("actor", ...)`` and ``("critic", ...)``.

    Args:
        actor: gives A logits.
        critic: gives one value; sees frames of the same size. Its output and state keys differ from the actor's.

    Source: POPGym Arcade (ICML 2026), PPO network table; the reference implementation's recurrent actor-critic.
    """

    offers = ("logits", "probs", "value")
    """What :meth:`select` can read an output as."""

    def __init__(self, actor: MemoryNetwork, critic: MemoryNetwork) -> None:
        super().__init__()
        self.actor, self.critic = actor, critic
        self.in_keys = list(dict.fromkeys([*actor.in_keys, *critic.in_keys]))
        self.out_keys = [*actor.out_keys, *critic.out_keys]

    @dispatch  # type: ignore[untyped-decorator]
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Run both towers, see :meth:`MemoryNetwork.forward`; the value is [*batch, 1]."""
        return self.critic(self.actor(tensordict))

    def compress(self, pixels: Tensor) -> Tensor:
        """What of the frames is worth storing, see :meth:`MemoryNetwork.compress`; the same for both towers."""
        return self.actor.compress(pixels)

    def calibrate(self, pixels: Tensor) -> None:
        """Set the input scaling of both towers from frames of random play."""
        self.actor.calibrate(pixels)
        self.critic.calibrate(pixels)

    def encode(self, pixels: Tensor) -> Tensor:
        """Frames to the features of both towers, float [..., 2 E], the actor's first."""
        return torch.cat((self.actor.encode(pixels), self.critic.encode(pixels)), dim=-1)

    def remember(
        self, features: Tensor, last_action: Tensor, is_init: Tensor, state: TensorDict
    ) -> tuple[Tensor, TensorDict]:
        """Everything behind the encoders, see :meth:`MemoryNetwork.remember`: features are [B, T, 2 E], the output is
        [B, T, A + 1], see :meth:`split`.
        """
        mine, theirs = features.split(features.shape[-1] // 2, dim=-1)
        logits, actor = self.actor.remember(mine, last_action, is_init, state["actor"])
        value, critic = self.critic.remember(theirs, last_action, is_init, state["critic"])
        after = TensorDict({"actor": actor, "critic": critic}, batch_size=state.batch_size)
        return torch.cat((logits, value), dim=-1), after

    def initial_state(self, batch_size: int | Sequence[int]) -> TensorDict:
        """Recurrent state at the start of an episode, TensorDict [batch_size]."""
        states = {"actor": self.actor.initial_state(batch_size), "critic": self.critic.initial_state(batch_size)}
        return TensorDict(states, batch_size=[batch_size] if isinstance(batch_size, int) else list(batch_size))

    @staticmethod
    def split(out: Tensor) -> tuple[Tensor, Tensor]:
        """An output [..., A + 1] as (logits [..., A], value [...])."""
        return out[..., :-1], out[..., -1]

    def select(self, out: Tensor, what: str) -> Tensor:
        """Read an output as one of :attr:`offers`.

        Args:
            out: float [..., A + 1].
            what: "logits", "probs" (of the actions) or "value".

        Returns:
            float [..., A], for "value" [..., 1].

        Raises:
            ValueError: another word.
        """
        if what not in self.offers:
            raise ValueError(f"an actor-critic offers {', '.join(self.offers)}, not {what!r}")
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
    """Make an actor and a critic, separate from the first convolution on, each with its own initial weights.

    Args:
        preset: see :func:`make_network`; the heads are the preset's ``actor_critic_head`` unless ``head`` is given.
        memory: see :func:`make_network`.
        obs_size: side of the frames in pixels.
        num_actions: A.
        memory_options: options of the cells, over those of the preset.
        store: see :func:`make_network`.
        **options: see :func:`make_network`. ``use_last_action=False`` is the published network, which differs from
            the published table in this.

    Returns:
        The two towers: the actor writes ``"logits"``, the critic ``"state_value"``; their states stand under
        ``("memory", "actor")`` and ``("memory", "critic")``.

    Raises:
        ValueError: unknown preset, memory, size, or value of an option.
        TypeError: unknown option.

    Example:
        >>> network = make_actor_critic("small", "gru")
        >>> frames = torch.zeros(2, 7, 128, 128, 3, dtype=torch.uint8)
        >>> last_action, is_init = torch.zeros(2, 7, dtype=torch.int64), torch.zeros(2, 7, dtype=torch.bool)
        >>> out, state = network.remember(network.encode(frames), last_action, is_init, network.initial_state(2))
        >>> [tuple(part.shape) for part in network.split(out)]
        [(2, 7, 5), (2, 7)]
    """
    options.setdefault("head", preset_of(preset).actor_critic_head)
    actor, critic = (
        make_network(
            preset,
            memory,
            obs_size=obs_size,
            num_outputs=outputs,
            num_actions=num_actions,
            memory_options=memory_options,
            out_key=key,
            state_key=("memory", tower),
            store=store,
            **options,
        )
        for tower, outputs, key in (("actor", num_actions, "logits"), ("critic", 1, "state_value"))
    )
    return ActorCriticNetwork(actor, critic)
