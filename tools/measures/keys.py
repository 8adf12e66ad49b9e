"""The keywords that all measures share, and which entries a policy and its env have where."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypedDict

from tensordict import TensorDictBase
from torch import Tensor

from arcade_torch.models.recurrence import Key

Channels = Literal["first", "last"]
Kind = Literal["q", "logits", "probs"]


class Names(TypedDict, total=False):
    """The keywords of ``as_policy``, which every measure passes on to it."""

    pixels_key: Key | None
    action_key: Key
    last_action_key: Key
    is_init_key: Key
    output_key: Key | None
    output_kind: Kind | None
    value_key: Key
    state_keys: Sequence[Key] | Mapping[Key, Key] | None
    initial_state: TensorDictBase | Mapping[str, Any] | None
    channels: Channels | None
    white: float | None


def refuse_unknown(names: Iterable[str]) -> None:
    """Refuse keywords that are none of `Names`: those of a measure that are misspelt end here.

    Raises:
        TypeError: there is one.
    """
    for name in names:
        if name not in Names.__annotations__:
            raise TypeError(
                f"unknown keyword {name!r}: beside those that the measure lists there are "
                f"{', '.join(Names.__annotations__)}"
            )


@dataclass(frozen=True)
class Keys:
    """Where the entries stand that a policy reads and writes, in its own tensordicts and in those
    of its env.
    """

    pixels: Key = "pixels"
    action: Key = "action"
    last_action: Key = "last_action"
    is_init: Key = "is_init"


def action_index(action: Tensor, name: Key) -> Tensor:
    """Actions, categorical [N] or [N, 1] or one-hot [N, A], as int64 [N].

    Raises:
        ValueError: they are neither.
    """
    if action.ndim == 1 and not action.is_floating_point():
        return action.long()
    if action.ndim == 2 and action.shape[-1] == 1 and not action.is_floating_point():
        return action.squeeze(-1).long()
    ones = action.long()
    if action.ndim == 2 and bool((ones == action).all() & (ones.sum(-1) == 1).all()):
        return ones.argmax(-1)
    raise ValueError(
        f"{name!r} must be discrete, categorical int64 [N] or one-hot [N, A], got {action.dtype} "
        f"{list(action.shape)}: the measures compare actions"
    )
