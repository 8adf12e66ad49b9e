"""Transformer: softmax attention over a sliding window, with positions by rotation."""

import math

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torch.nn import functional as F

from arcade_torch.models.base import Memory, replay_by_steps
from arcade_torch.models.rotary import angles, rotate, rotate_pairs

__all__ = ["Attention", "window_attention", "window_attention_loop"]

BLOCK = 128  # queries looked at together; the fastest on a CPU at W = 128


class Attention(Memory):
    """y_t = sum_j softmax_j(q_t . k_j / sqrt(H)) v_j over the last W steps of the episode; one head, H wide.

    q and k are linear in x without bias and rotated by their positions (RoPE), v is linear with bias; no projection and
    no skip follow. Only the distance of two steps matters, so keys are kept unrotated.

    The state is the window: ``"key"`` and ``"value"`` [W, H], newest last, and ``"valid"`` bool [W], which of them
    belong to the running episode (the others hold zeros). At H = 512 and W = 128 that is 131,200 numbers: keep it once
    a sequence, not once a step (``MemoryModule(store="sequence")``, ``ArcadeCollector``).

    Args:
        input_size: D.
        hidden_size: H; the last channel of an odd number is not rotated.
        window: W, number of steps that are looked at, the current one included; 128 is the paper's rollout.
        carry_cache: begin a call with the window that the last call returned, so that several calls with a carried
            state equal one. False is what the paper's text says ("does not maintain a recurrent state"), though not
            what its code does: a call with more than one step, a chunk of training, begins with an empty window. Acting
            (T = 1) carries it either way, so the two see different histories until a chunk is W steps old, and
            ``check_memory`` refuses the model.

    Raises:
        ValueError: a size or the window is not positive.

    Source: Vaswani et al. (2017), arXiv 1706.03762, eq. 1; Su et al. (2021), arXiv 2104.09864; POPGym Arcade, appendix
        on memory models.
    """

    averages_values = True

    def __init__(self, input_size: int, hidden_size: int, *, window: int = 128, carry_cache: bool = True) -> None:
        super().__init__(input_size, hidden_size)
        if window < 1:
            raise ValueError(f"window must be at least 1 step (the current one), got {window}")
        self.window, self.carry_cache = window, carry_cache
        self.query = nn.Linear(input_size, hidden_size, bias=False)
        self.key = nn.Linear(input_size, hidden_size, bias=False)
        self.value = nn.Linear(input_size, hidden_size)

    def state_leaves(self) -> dict[str, tuple[tuple[int, ...], torch.dtype | None]]:
        """See ``Memory.state_leaves``."""
        rows = (self.window, self.hidden_size)
        return {"key": (rows, None), "value": (rows, None), "valid": ((self.window,), torch.bool)}

    def forward(self, x: Tensor, state: TensorDict, is_init: Tensor) -> tuple[Tensor, TensorDict]:
        """See ``MemoryContract``."""
        self._check(x, state, is_init)
        valid = state["valid"][:, 1:] & ~is_init[:, :1]
        if not self.carry_cache and x.shape[1] > 1:
            valid = torch.zeros_like(valid)
        episode = torch.cat([torch.where(valid, 0, -1), is_init.cumsum(1)], dim=1)
        keys = torch.cat([state["key"][:, 1:], self.key(x)], dim=1)
        values = torch.cat([state["value"][:, 1:], self.value(x)], dim=1)
        if x.shape[1] > 1 or not _known_to_be_none(is_init):  # else what is hidden holds zeros already
            hidden = (episode < 0).unsqueeze(-1)
            keys, values = keys.masked_fill_(hidden, 0), values.masked_fill_(hidden, 0)
        y = window_attention(self.query(x), keys, values, episode, self.window)
        valid = episode[:, -self.window :] == episode[:, -1:]
        if x.shape[1] > 1:  # else nothing else is hidden
            hidden = ~valid.unsqueeze(-1)
            keys, values = (rows[:, -self.window :].masked_fill(hidden, 0) for rows in (keys, values))
        after = {"key": keys, "value": values, "valid": valid}
        return y, TensorDict(after, batch_size=[x.shape[0]])

    def replay(self, x: Tensor, stored: TensorDict, is_init: Tensor) -> tuple[Tensor, TensorDict]:
        """See ``ReplayableMemory``; step by step (slow): windows are not meant to be stored for every step."""
        self._check(x, stored, is_init, batch_ndim=2)
        return replay_by_steps(self, x, stored, is_init)

    def extra_repr(self) -> str:
        """Sizes and options, for printing."""
        return f"{super().extra_repr()}, window={self.window}, carry_cache={self.carry_cache}"


def _known_to_be_none(flags: Tensor) -> bool:
    """Whether no flag is set; False where finding out costs something (a card, a graph) or cannot be done (vmap)."""
    if torch.compiler.is_compiling() or flags.device.type != "cpu":
        return False
    try:
        return not bool(flags.any())
    except RuntimeError:  # vmap: every row has flags of its own
        return False


def window_attention(
    query: Tensor, key: Tensor, value: Tensor, episode: Tensor, window: int, *, block: int = BLOCK
) -> Tensor:
    """Attend to the last ``window`` steps of the same episode.

    Queries are taken in blocks, each of which sees one stretch of window - 1 + block keys, so the mask and the weights
    need O(T (window + block)) numbers, and the angles O(window + block). A NaN or infinity among the values reaches the
    queries that see it and no others.

    Args:
        query: float [B, T, H].
        key: float [B, W - 1 + T, H], those of the W - 1 steps before index 0 first; unrotated, like the query.
        value: float [B, W - 1 + T, H].
        episode: int64 [B, W - 1 + T]; steps with different numbers do not see each other.
        window: W, at least 1.
        block: largest number of queries in a block.

    Returns:
        float [B, T, H].
    """
    length = query.shape[1]
    count = math.ceil(length / block)
    size = math.ceil(length / count)
    spare = count * size - length
    past = window - 1
    stretch = past + size
    index = torch.arange(stretch, device=query.device)
    cosine, sine = angles(index, query.shape[-1], query.dtype)
    if spare:
        query, key, value = (F.pad(x, (0, 0, 0, spare)) for x in (query, key, value))
        episode = F.pad(episode, (0, spare), value=-2)
    bad = ~value.sum(-1).isfinite() if length > 1 else None  # acting: what is not seen has been zeroed
    if bad is not None:
        value = value.masked_fill(bad.unsqueeze(-1), 0)  # a weight of zero would not stop it
    queries = rotate_pairs(query.unflatten(1, (count, size)), cosine[past:], sine[past:])
    keys, values = (x.unfold(1, stretch, size).mT for x in (key, value))
    episodes = episode.unfold(1, stretch, size)
    distance = index[past:, None] - index
    seen = (distance >= 0) & (distance < window) & (episodes[..., past:, None] == episodes[..., None, :])
    # Spelled out: on a CPU as fast as scaled_dot_product_attention with a mask, which vmap runs row by row.
    score = queries / math.sqrt(query.shape[-1]) @ rotate_pairs(keys, cosine, sine).mT
    if bad is not None:
        score = score + torch.where(bad, torch.nan, 0.0).to(score.dtype).unfold(1, stretch, size).unsqueeze(-2)
    y = torch.where(seen, score, -torch.inf).softmax(-1) @ values
    return y.flatten(1, 2)[:, :length]


def window_attention_loop(query: Tensor, key: Tensor, value: Tensor, episode: Tensor, window: int) -> Tensor:
    """The same function as :func:`window_attention`, one query at a time (slow)."""
    outputs = []
    for t in range(query.shape[1]):
        near = slice(t, window + t)  # the window that ends at step t
        cosine, sine = angles(torch.arange(window, device=query.device), query.shape[-1], query.dtype)
        keys = rotate(key[:, near], cosine, sine)
        asked = rotate(query[:, t], cosine[-1], sine[-1])
        score = torch.einsum("bh,bwh->bw", asked, keys) / math.sqrt(query.shape[-1])
        score = score.masked_fill(episode[:, near] != episode[:, window - 1 + t, None], -torch.inf)
        outputs.append(torch.einsum("bw,bwh->bh", score.softmax(-1), value[:, near]))
    return torch.stack(outputs, dim=1)
