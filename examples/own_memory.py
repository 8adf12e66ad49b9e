"""A memory model of your own in one file: ``torch.nn.LSTM``, brought in by two methods and a name.

``forward`` reads a chunk of steps [B, T, D] from a given state and acting is the same call with T =
1; a step whose ``is_init`` is set opens an episode, so what came before it must be forgotten
*before* it is read. ``torch.nn.LSTM`` knows no such flag. Here the chunk is cut wherever some row
of the batch begins, and the rows that do get zeros.

Importing this file registers the model, and every tool knows it; run as a script it first checks
the laws that a memory has to keep and then is ``arcade-torch train`` itself:

    arcade-torch train --import examples/own_memory.py --memory torch_lstm --preset small
    python examples/own_memory.py --preset small --env SignpostEasy --observability partial
"""

import sys
from itertools import pairwise

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from arcade_torch.models import check_memory, register_memory


class LSTM(nn.Module):
    """``torch.nn.LSTM`` that forgets at starts."""

    def __init__(self, input_size: int, hidden_size: int) -> None:
        super().__init__()
        self.input_size = input_size
        self.hidden_size = hidden_size
        self.lstm = nn.LSTM(input_size, hidden_size, batch_first=True)

    def forward(self, x: Tensor, state: TensorDict, is_init: Tensor) -> tuple[Tensor, TensorDict]:
        """x [B, T, D], state [B], is_init bool [B, T] to (y [B, T, H], state [B])."""
        h = state["h"]
        c = state["c"]
        outputs = []
        begins = is_init[:, 1:].any(dim=0).nonzero().flatten() + 1
        for begin, end in pairwise([0, *begins.tolist(), x.shape[1]]):
            fresh = is_init[:, begin, None]
            kept = [torch.where(fresh, 0, old).unsqueeze(0) for old in (h, c)]
            y, (h, c) = self.lstm(x[:, begin:end], (kept[0], kept[1]))
            h = h[0]
            c = c[0]
            outputs.append(y)
        return torch.cat(outputs, dim=1), TensorDict({"h": h, "c": c}, batch_size=[len(x)])

    def initial_state(self, batch_size: int | list[int]) -> TensorDict:
        """Zeros, TensorDict [batch_size]."""
        batch = [batch_size] if isinstance(batch_size, int) else list(batch_size)
        zeros = self.lstm.weight_hh_l0.new_zeros(*batch, self.hidden_size)
        return TensorDict({"h": zeros, "c": zeros.clone()}, batch_size=batch)


register_memory("torch_lstm", LSTM)

if __name__ == "__main__":
    from arcade_torch.tools.cli import main

    for law, discrepancy in check_memory(LSTM(4, 8)).items():
        print(f"{law}: {discrepancy:.2g}", file=sys.stderr)
    sys.exit(main(["train", "--memory", "torch_lstm", *sys.argv[1:]]))
