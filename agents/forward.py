"""From frames to outputs in one call with gradients: what libraries of attribution ask for."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from arcade_torch.agents.checked import require
from arcade_torch.models.flat_state import unflatten_state


@contextmanager
def evaluating(module: nn.Module) -> Iterator[None]:
    """Evaluation mode for a while; the mode of every part comes back."""
    modes = {part: part.training for part in module.modules()}
    module.eval()
    try:
        yield
    finally:
        for part, training in modes.items():
            part.training = training


def state_of(
    state: TensorDictBase | Tensor | None, initial_state: Callable[[int], Any], rows: int
) -> Any:
    """The recurrent state that is given, or is made of floats [B, F]; else the initial one."""
    if state is None:
        return initial_state(rows)
    if isinstance(state, Tensor):
        example = initial_state(rows)
        if isinstance(example, TensorDictBase):
            return unflatten_state(state, example)
    return state


def state_of_rows(state: Any, rows: int) -> Any:
    """A recurrent state, if its first axis is the batch of so many rows.

    Raises:
        ValueError: another axis is, or it is no one tensor or TensorDict.
    """
    shape = getattr(state, "shape", None)
    is_known = state is None or shape is not None
    got = f"{list(shape)}" if shape is not None else f"a {type(state).__name__}"
    require(
        is_known and (shape is None or shape[:1] == (rows,)),
        "the recurrent state",
        got,
        f"a TensorDict [{rows}] or a tensor [{rows}, ...], {rows} entries of the batch first, or "
        "None: of torch's GRU, whose layers are first, take state.transpose(0, 1), and of several "
        "tensors torch.stack(..., 1)",
    )
    return state


def last_outputs(
    network: Any,
    frames: Tensor,
    last_action: Tensor | None,
    is_init: Tensor | None,
    state: TensorDictBase | Tensor | None,
) -> Tensor:
    """What a network's ``remember`` gives for the last of the frames [N, T, ...], [N, R]."""
    batch = frames.shape[:2]
    if last_action is None:
        last_action = torch.zeros(batch, dtype=torch.int64, device=frames.device)
    if is_init is None:
        is_init = torch.zeros(batch, dtype=torch.bool, device=frames.device)
    before = state_of(state, network.initial_state, batch[0])
    out, _ = network.remember(network.encode(frames), last_action, is_init.bool(), before)
    last: Tensor = out[:, -1]
    return last
