"""Networks by name: presets, and :func:`make_network`."""

import difflib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import nn

from arcade_torch.models.arguments import check_keys, is_whole
from arcade_torch.models.encoders import Encoder, PaperEncoder, SmallEncoder
from arcade_torch.models.networks import SKIPS, MemoryBlock, MemoryNetwork, check_memory_name
from arcade_torch.models.recurrence import Key, Store
from arcade_torch.models.stateless import FeedForward

__all__ = [
    "FEED_FORWARD",
    "HEADS",
    "PRESETS",
    "NetworkPreset",
    "make_head",
    "make_network",
    "preset_of",
]

FEED_FORWARD = "feedforward"
"""In the place of a memory's name: no memory block at all, the paper's "MLP" agent (see
:class:`FeedForward`).
"""


MOST = {"hidden_size": 2**15, "layers": 256, "towers": 256, "feedforward_size": 2**15}
"""Largest sizes of a network: a slip of the pen, or a file that somebody else wrote, asks for no
more memory.
"""
MOST_OPTION = 2**20
"""Largest number in the options of a memory."""


@dataclass(frozen=True)
class NetworkPreset:
    """A network up to its memory model and its number of outputs; every field is an option of
    :func:`make_network`.
    """

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
    """head of :func:`make_actor_critic`"""
    towers: int = 2
    """networks of :func:`make_actor_critic`: 2 for one each, 1 for both"""
    feedforward_size: int = 256
    """width of the layers that stand in for the memory block of a feed-forward network"""
    use_last_action: bool = True
    """append the one-hot last action to the features"""
    zero_action_on_reset: bool = False
    """no last action at the first step of an episode; False shows the last action of the episode
    before
    """
    predicts: bool = False
    """the memory (of two towers the actor) learns to expect the next frame, see
    ``MemoryNetwork.prediction_error``
    """
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
        towers=1,
        feedforward_size=128,
        zero_action_on_reset=True,
        memory_options={"mingru": {"slow_gates": True}},
    ),
}
PRESETS["small64"] = replace(PRESETS["small"], encoder=partial(SmallEncoder, side=64, channels=64))


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
    out_key: Key = "action_value",
    value_key: Key | None = None,
    state_key: Key = "memory",
    store: Store = "sequence",
    **options: Any,
) -> MemoryNetwork:
    """Make a network.

    Args:
        preset: "paper" (1,428,613 parameters plus two cells); "small" (225,733 with MinGRU; learns
            the easiest games in minutes on one CPU core); "small64", which sees 64 instead of 32
            pixels, so that it reads boards and cards better.
        memory: a name (:func:`memory_names`), a factory ``(input_size, hidden_size, **options) ->
            nn.Module``, or "feedforward": no memory and no last action (704,901 parameters).
        obs_size: side of the frames in pixels.
        num_outputs: A; one per action for Q-values or logits, 1 for a state value.
        num_actions: number of actions, for the one-hot last action; 0 for none.
        memory_options: options of the cells, over those of the preset.
        out_key, value_key, state_key, store: see :class:`MemoryNetwork`; a value head is one output
            more. ``store="step"`` goes without ``zero_action_on_reset``.
        **options: any other field of :class:`NetworkPreset`, such as ``hidden_size``, ``layers``.

    Raises:
        ValueError: unknown preset, memory, size, or value of an option.
        TypeError: unknown option, or ``memory_options`` of "feedforward".

    Example:
        >>> network = make_network("small", "mingru")
        >>> frames = torch.zeros(2, 7, 128, 128, 3, dtype=torch.uint8)
        >>> last_action = torch.zeros(2, 7, dtype=torch.int64)
        >>> is_init = torch.zeros(2, 7, dtype=torch.bool)
        >>> features = network.encode(frames)
        >>> out, state = network.remember(features, last_action, is_init, network.initial_state(2))
        >>> out.shape
        torch.Size([2, 7, 5])
    """
    settings = _settings(preset, options)
    _check_outputs(num_outputs, num_actions)
    _check_keys(out_key, value_key, state_key)
    _check_memory_options(memory, memory_options or {})
    if store == "step" and "zero_action_on_reset" not in options:
        settings = replace(settings, zero_action_on_reset=False)
    if value_key is not None:
        num_outputs += 1
    parts = _parts(settings, memory, memory_options or {}, obs_size, num_outputs, num_actions)
    names: dict[str, Any] = {"out_key": out_key, "value_key": value_key, "state_key": state_key}
    return MemoryNetwork(**parts, **names, store=store)


def _check_outputs(num_outputs: Any, num_actions: Any) -> None:
    """Refuse numbers of outputs and actions that no network has."""
    if not is_whole(num_outputs) or num_outputs < 1:
        raise ValueError(f"num_outputs must be a whole number from 1, got {num_outputs!r}")
    if not is_whole(num_actions) or num_actions < 0:
        raise ValueError(f"num_actions must be a whole number from 0, got {num_actions!r}")


def _check_keys(out_key: Any, value_key: Any, state_key: Any) -> None:
    """Refuse keys that TensorDict does not know, and one key for two heads."""
    keys = {"out_key": out_key, "state_key": state_key}
    if value_key is not None:
        keys["value_key"] = value_key
    check_keys(**keys)
    if out_key == value_key:
        raise ValueError(f"out_key and value_key are both {out_key!r}: give each head its own")


def _parts(
    settings: NetworkPreset,
    memory: str | Callable[..., nn.Module],
    memory_options: dict[str, Any],
    obs_size: int,
    num_outputs: int,
    num_actions: int,
) -> dict[str, Any]:
    """The parts of a :class:`MemoryNetwork`, by name of its arguments."""
    if isinstance(settings.encoder, nn.Module) or not callable(settings.encoder):
        raise ValueError(
            "encoder must be a function of obs_size that gives an Encoder, such as SmallEncoder, "
            f"got {settings.encoder!r}"
        )
    encoder = settings.encoder(obs_size)
    block: FeedForward | MemoryBlock
    if memory == FEED_FORWARD:
        num_actions = 0
        block = FeedForward(encoder.feature_size, settings.feedforward_size)
        # the two layers of the block take the place of a deep head's as well
        head_name = "linear" if settings.head == "linear" else "plain"
    else:
        num_actions = num_actions if settings.use_last_action else 0
        input_size = encoder.feature_size + num_actions
        block = _memory_block(settings, input_size, memory, memory_options)
        head_name = settings.head
    head = make_head(head_name, block.hidden_size, num_outputs)

    predictor = None
    if settings.predicts:
        predictor = _predictor(block.hidden_size + num_actions, encoder.feature_size)

    return {
        "encoder": encoder,
        "block": block,
        "head": head,
        "num_actions": num_actions,
        "zero_action_on_reset": settings.zero_action_on_reset,
        "predictor": predictor,
    }


def _settings(preset: str, options: dict[str, Any]) -> NetworkPreset:
    """A preset with some fields changed, all of them checked."""
    settings = preset_of(preset)
    fields = NetworkPreset.__dataclass_fields__
    unknown = sorted(set(options) - set(fields))
    if unknown:
        raise TypeError(
            f"unknown network option {', '.join(unknown)}; allowed are {', '.join(fields)}"
        )
    plain_options = {}
    for name, value in options.items():
        plain_options[name] = _plain(value)
    settings = replace(settings, **plain_options)

    for name, field_ in fields.items():
        value = getattr(settings, name)
        if field_.type is bool and type(value) is not bool:
            raise ValueError(f"{name} must be True or False, got {value!r}")
        if field_.type is int:
            _check_size(name, value)
    _check_choice("skip", settings.skip, SKIPS)
    _check_choice("head", settings.head, HEADS)
    _check_choice("actor_critic_head", settings.actor_critic_head, HEADS)
    _check_choice("towers", settings.towers, (1, 2))
    return settings


def _plain(value: Any) -> Any:
    """A number of numpy as one of Python."""
    return value.item() if isinstance(value, np.integer | np.bool_) else value


def _check_size(name: str, value: Any) -> None:
    """Refuse a size that no network has, before anything is allocated."""
    if type(value) is not int:
        raise ValueError(f"{name} must be a whole number, got {value!r}")
    if not 1 <= value <= MOST[name]:
        raise ValueError(f"{name} must be at least 1 and at most {MOST[name]}, got {value}")


def _check_choice(name: str, value: Any, allowed: tuple[Any, ...]) -> None:
    """Refuse a value that is none of the allowed ones."""
    if value not in allowed:
        raise ValueError(f"{name} must be one of {', '.join(map(str, allowed))}, got {value!r}")


def _check_memory_options(
    memory: str | Callable[..., nn.Module], memory_options: dict[str, Any]
) -> None:
    """Refuse options of a memory that is not there, and numbers that no machine could hold."""
    check_memory_name(memory)
    if not isinstance(memory_options, Mapping):
        raise ValueError(
            f"memory_options must be a mapping of names to values, got {memory_options!r}"
        )
    if memory == FEED_FORWARD and memory_options:
        raise TypeError(
            f"{FEED_FORWARD!r} has no memory, so memory_options must be left out, got "
            f"{memory_options}"
        )
    for name, value in memory_options.items():
        if isinstance(value, int) and abs(value) > MOST_OPTION:
            raise ValueError(f"memory_options.{name} must be at most {MOST_OPTION}, got {value}")


def _memory_block(
    settings: NetworkPreset,
    input_size: int,
    memory: str | Callable[..., nn.Module],
    memory_options: dict[str, Any],
) -> MemoryBlock:
    """The cells between encoder and head; options that are given go over those of the preset."""
    preset_options = settings.memory_options.get(memory, {}) if isinstance(memory, str) else {}
    return MemoryBlock(
        input_size,
        settings.hidden_size,
        memory,
        layers=settings.layers,
        skip=settings.skip,  # type: ignore[arg-type]
        memory_options=preset_options | memory_options,
    )


def _predictor(input_size: int, feature_size: int) -> nn.Module:
    """From what is remembered, and the next action, to the next frame's features."""
    return nn.Sequential(
        nn.Linear(input_size, feature_size),
        nn.LeakyReLU(inplace=True),
        nn.Linear(feature_size, feature_size),
    )


HEADS = ("reference", "paper", "actor_critic", "linear", "plain")


def make_head(name: str, input_size: int, num_outputs: int) -> nn.Module:
    """Make an output head.

    Args:
        name: "reference": Linear to 256, Linear (no activation between, as in the published
            Q-networks); "paper": Linear to 256, Linear 256, LeakyReLU, LayerNorm, Linear (the
            paper's table; the LayerNorm has parameters, which the table leaves open);
            "actor_critic": the same with LayerNorm before LeakyReLU, as in the published PPO
            networks; "linear": one Linear, initial weights a tenth of torch's, bias 0 (small
            initial values, so that action gaps are not drowned by the noise of the start); "plain":
            one Linear.
        input_size: H.
        num_outputs: A.

    Returns:
        module [..., H] -> [..., A].

    Raises:
        ValueError: unknown name.
    """
    if name == "reference":
        return nn.Sequential(nn.Linear(input_size, 256), nn.Linear(256, num_outputs))
    if name == "paper":
        return nn.Sequential(
            nn.Linear(input_size, 256),
            nn.Linear(256, 256),
            nn.LeakyReLU(inplace=True),
            nn.LayerNorm(256),
            nn.Linear(256, num_outputs),
        )
    if name == "actor_critic":
        return nn.Sequential(
            nn.Linear(input_size, 256),
            nn.Linear(256, 256),
            nn.LayerNorm(256),
            nn.LeakyReLU(inplace=True),
            nn.Linear(256, num_outputs),
        )
    if name == "plain":
        return nn.Linear(input_size, num_outputs)
    if name == "linear":
        head = nn.Linear(input_size, num_outputs)
        with torch.no_grad():
            head.weight.mul_(0.1)
            head.bias.zero_()
        return head
    raise ValueError(f"head must be one of {', '.join(HEADS)}, got {name!r}")
