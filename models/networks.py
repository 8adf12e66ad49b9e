"""Whole networks: encoder, last action, memory block, head."""

import difflib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from arcade_torch.models.encoders import Encoder, PaperEncoder, SmallEncoder
from arcade_torch.models.feedforward import FeedForward
from arcade_torch.models.heads import make_head
from arcade_torch.models.pullback import Pull, recorded_twice
from arcade_torch.models.stack import MemoryBlock

__all__ = ["FEED_FORWARD", "PRESETS", "MemoryNetwork", "NetworkPreset", "make_network", "preset_of"]

FEED_FORWARD = "feedforward"
"""In the place of a memory's name: no memory block at all, the paper's "MLP" agent (see :class:`FeedForward`)."""


@dataclass(frozen=True)
class NetworkPreset:
    """A network up to its memory model and its number of outputs; every field is an option of :func:`make_network`."""

    encoder: Callable[[int], Encoder]
    """called with ``obs_size``"""
    hidden_size: int
    """H, width of the memory block"""
    layers: int
    """cells in the memory block"""
    skip: str = "residual"
    """"residual" or "none", see :class:`MemoryBlock`"""
    head: str = "reference"
    """see :func:`make_head`"""
    actor_critic_head: str = "actor_critic"
    """head of the two towers of :func:`make_actor_critic`"""
    feedforward_size: int = 256
    """width of the layers that stand in for the memory block of a feed-forward network"""
    use_last_action: bool = True
    """append the one-hot last action to the features"""
    zero_action_on_reset: bool = False
    """no last action at the first step of an episode; False shows the last action of the episode before"""
    memory_options: dict[str, dict[str, Any]] = field(default_factory=dict)
    """options of the cells, by name of the memory"""


PRESETS = {
    "paper": NetworkPreset(encoder=PaperEncoder, hidden_size=512, layers=2),
    "small": NetworkPreset(
        encoder=SmallEncoder,
        hidden_size=128,
        layers=1,
        head="linear",
        actor_critic_head="linear",
        feedforward_size=128,
        zero_action_on_reset=True,
        memory_options={"mingru": {"slow_gates": True}},
    ),
}


def preset_of(name: str) -> NetworkPreset:
    """The preset of a name.

    Raises:
        ValueError: unknown name; the message has the nearest match and the list.
    """
    if name not in PRESETS:
        near = difflib.get_close_matches(str(name), PRESETS, n=1)
        hint = f"did you mean {near[0]!r}? " if near else ""
        raise ValueError(f"unknown network {name!r}: {hint}known are {', '.join(PRESETS)}")
    return PRESETS[name]


def make_network(
    preset: str = "paper",
    memory: str | Callable[..., nn.Module] = "lru",
    *,
    obs_size: int = 128,
    num_outputs: int = 5,
    num_actions: int = 5,
    memory_options: dict[str, Any] | None = None,
    **options: Any,
) -> "MemoryNetwork":
    """Make a network.

    Args:
        preset: "paper" (1,428,613 parameters plus two cells) or "small" (225,733 with MinGRU; learns the easiest games
            in minutes on one CPU core).
        memory: a name (:func:`memory_names`), a factory ``(input_size, hidden_size, **options) -> nn.Module``, or
            "feedforward": no memory block and no last action, the paper's memory-free agent (704,901 parameters).
        obs_size: side of the frames in pixels.
        num_outputs: A; one per action for Q-values or logits, 1 for a state value.
        num_actions: number of actions, for the one-hot last action.
        memory_options: options of the cells, over those of the preset.
        **options: any other field of :class:`NetworkPreset`: ``hidden_size``, ``layers``, ``skip``, ``head``,
            ``use_last_action``, ``zero_action_on_reset``, ``encoder``.

    Returns:
        a :class:`MemoryNetwork`.

    Raises:
        ValueError: unknown preset, memory, size, or value of an option.
        TypeError: unknown option.

    Example:
        >>> network = make_network("small", "mingru")
        >>> sum(p.numel() for p in network.parameters())
        225733
        >>> frames = torch.zeros(2, 7, 128, 128, 3, dtype=torch.uint8)
        >>> last_action, is_init = torch.zeros(2, 7, dtype=torch.int64), torch.zeros(2, 7, dtype=torch.bool)
        >>> out, state = network(frames, last_action, is_init, network.initial_state(2))
        >>> out.shape
        torch.Size([2, 7, 5])
    """
    chosen = preset_of(preset)
    if unknown := set(options) - set(NetworkPreset.__dataclass_fields__):
        allowed = ", ".join(NetworkPreset.__dataclass_fields__)
        raise TypeError(f"unknown network option {', '.join(sorted(unknown))}; allowed are {allowed}")
    chosen = replace(chosen, **options)
    if memory == FEED_FORWARD:
        return _feed_forward(chosen, obs_size, num_outputs)
    encoder = chosen.encoder(obs_size)
    actions = num_actions if chosen.use_last_action else 0
    block = _block(chosen, encoder.feature_size + actions, memory, memory_options or {})
    head = make_head(chosen.head, chosen.hidden_size, num_outputs)
    return MemoryNetwork(encoder, block, head, num_actions=actions, zero_action_on_reset=chosen.zero_action_on_reset)


def _block(
    chosen: NetworkPreset, input_size: int, memory: str | Callable[..., nn.Module], options: dict[str, Any]
) -> MemoryBlock:
    of_preset = chosen.memory_options.get(memory, {}) if isinstance(memory, str) else {}
    return MemoryBlock(
        input_size,
        chosen.hidden_size,
        memory,
        layers=chosen.layers,
        skip=chosen.skip,  # type: ignore[arg-type]
        memory_options=of_preset | options,
    )


def _feed_forward(chosen: NetworkPreset, obs_size: int, num_outputs: int) -> "MemoryNetwork":
    """The published memory-free network; its two layers take the place of a deep head's as well."""
    encoder = chosen.encoder(obs_size)
    block = FeedForward(encoder.feature_size, chosen.feedforward_size)
    head = make_head("linear" if chosen.head == "linear" else "plain", chosen.feedforward_size, num_outputs)
    return MemoryNetwork(encoder, block, head, num_actions=0)


class MemoryNetwork(nn.Module):
    """From frames, last actions and start flags to one number per action and step.

    Args:
        encoder: frames to features [..., E].
        block: a memory model, E + num_actions to H.
        head: [..., H] to [..., A].
        num_actions: length of the one-hot last action; 0 leaves it out.
        zero_action_on_reset: show a zero vector instead of the last action where ``is_init`` is set.

    Source: POPGym Arcade, network tables.
    """

    def __init__(
        self,
        encoder: Encoder,
        block: nn.Module,
        head: nn.Module,
        *,
        num_actions: int = 5,
        zero_action_on_reset: bool = False,
    ) -> None:
        super().__init__()
        self.encoder, self.block, self.head = encoder, block, head
        self.obs_size, self.num_actions, self.zero_action_on_reset = encoder.obs_size, num_actions, zero_action_on_reset
        self.register_buffer("actions", torch.arange(num_actions), persistent=False)
        self.actions: Tensor

    def compress(self, pixels: Tensor) -> Tensor:
        """What of the frames is worth storing.

        Args:
            pixels: uint8 [..., S, S, 3].

        Returns:
            uint8 [..., s, s, 3]: 32x32 block means for "small", the upper left 120x120 (of 256: 218x218) for "paper".
        """
        return self.encoder.compress(pixels)

    def calibrate(self, pixels: Tensor) -> None:
        """Set the input scaling from frames of random play, uint8 [..., S, S, 3] or compressed ("paper": no-op)."""
        self.encoder.calibrate(pixels)

    def encode(self, pixels: Tensor) -> Tensor:
        """Frames, uint8 or float 0..255, full or compressed [..., S or s, S or s, 3], to features float [..., E]."""
        return self.encoder(pixels)  # type: ignore[no-any-return]

    def record(self, frames: Tensor, dtype: torch.dtype = torch.float32) -> tuple[Tensor, Pull]:
        """:meth:`encode`, and how gradients reach the frames; see :meth:`Encoder.record`."""
        record = getattr(self.encoder, "record", None)  # an encoder of somebody's own has none
        return recorded_twice(self.encoder, frames, dtype) if record is None else record(frames, dtype)

    def remember(
        self, features: Tensor, last_action: Tensor, is_init: Tensor, state: TensorDict
    ) -> tuple[Tensor, TensorDict]:
        """Everything behind the encoder.

        Args:
            features: float [B, T, E].
            last_action: int64 [B, T], the action that led to each frame.
            is_init: bool [B, T], True where an episode begins.
            state: TensorDict [B], the recurrent state before step 0.

        Returns:
            (float [B, T, A], state TensorDict [B] after the last step).
        """
        if self.num_actions:
            one_hot = last_action.unsqueeze(-1) == self.actions
            if self.zero_action_on_reset:
                one_hot = one_hot & ~is_init.unsqueeze(-1)
            features = torch.cat([features, one_hot.to(features.dtype)], dim=-1)
        y, state = self.block(features, state, is_init)
        return self.head(y), state

    def forward(
        self, pixels: Tensor, last_action: Tensor, is_init: Tensor, state: TensorDict
    ) -> tuple[Tensor, TensorDict]:
        """:meth:`encode` and :meth:`remember` in one.

        Args:
            pixels: uint8 or float 0..255 [B, T, S, S, 3], full or compressed.
            last_action: int64 [B, T].
            is_init: bool [B, T].
            state: TensorDict [B].

        Returns:
            (float [B, T, A], state TensorDict [B] after the last step).
        """
        return self.remember(self.encode(pixels), last_action, is_init, state)

    def initial_state(self, batch_size: int | Sequence[int]) -> TensorDict:
        """Recurrent state at the start of an episode, TensorDict [batch_size]; dtype and device of the parameters."""
        return self.block.initial_state(batch_size)  # type: ignore[operator]
