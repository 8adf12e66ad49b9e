"""Transformer: softmax attention over a sliding window, with positions by rotation."""

import math

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torch.nn import functional as F

from arcade_torch.models.arguments import check_flags, check_sizes
from arcade_torch.models.memory import Memory, replay_by_steps
from arcade_torch.models.rotary import angles, rotate, rotate_pairs

__all__ = ["Attention", "window_attention", "window_attention_loop"]

BLOCK = 128  # queries looked at together; the fastest on a CPU at W = 128


class Attention(Memory):
    """y_t = sum_j softmax_j(q_t . k_j / sqrt(H)) v_j over the last W steps of the episode; one
    head, H wide.

    q and k are linear in x without bias and rotated by their positions (RoPE), v is linear with
    bias; no projection and no skip follow.

    The state is the window as a ring buffer: ``"key"`` (rotated) and ``"value"`` [W, H], and
    ``"step"`` int64 [], the number of steps of the episode so far. Step i of an episode, from 0,
    stands in slot i mod W; unused slots hold zeros. Acting writes one slot of a copy, because a
    rollout may keep the state of every step. At H = 512 and W = 128 the state has 131,073 numbers:
    keep it once a sequence, not once a step (``MemoryModule(store="sequence")``,
    ``ArcadeCollector``).

    Args:
        input_size: D.
        hidden_size: H; the last channel of an odd number is not rotated.
        window: W, number of steps that are looked at, the current one included; 128 is the paper's
            rollout.
        carry_cache: begin a call with the window that the last call returned, so that several calls
            with a carried state equal one. False is what the paper's text says ("does not maintain
            a recurrent state"), though not what its code does: a call with more than one step, a
            chunk of training, begins with an empty window. Acting (T = 1) carries it either way, so
            the two see different histories until a chunk is W steps old, and ``check_memory``
            refuses the model.

    Raises:
        ValueError: a size or the window is not positive.

    Source: Vaswani et al. (2017), arXiv 1706.03762, eq. 1; Su et al. (2021), arXiv 2104.09864;
        POPGym Arcade, appendix on memory models.
    """

    averages_values = True

    def __init__(
        self, input_size: int, hidden_size: int, *, window: int = 128, carry_cache: bool = True
    ) -> None:
        super().__init__(input_size, hidden_size)
        check_sizes(window=window)
        check_flags(carry_cache=carry_cache)
        if window < 1:
            raise ValueError(f"window must be at least 1 step (the current one), got {window}")
        self.window = window
        self.carry_cache = carry_cache
        self.query = nn.Linear(input_size, hidden_size, bias=False)
        self.key = nn.Linear(input_size, hidden_size, bias=False)
        self.value = nn.Linear(input_size, hidden_size)

    def state_leaves(self) -> dict[str, tuple[tuple[int, ...], torch.dtype | None]]:
        """See ``Memory.state_leaves``."""
        rows = (self.window, self.hidden_size)
        return {"key": (rows, None), "value": (rows, None), "step": ((), torch.int64)}

    def forward(self, x: Tensor, state: TensorDict, is_init: Tensor) -> tuple[Tensor, TensorDict]:
        """See ``MemoryContract``."""
        self._check(x, state, is_init)
        read = self._act if x.shape[1] == 1 else self._read_chunk
        y, key, value, step = read(x, state["key"], state["value"], state["step"], is_init)
        return y, TensorDict({"key": key, "value": value, "step": step}, batch_size=[x.shape[0]])

    def _act(
        self, x: Tensor, keys: Tensor, values: Tensor, step: Tensor, is_init: Tensor
    ) -> tuple[Tensor, ...]:
        """One step: write one slot of a copy of the ring, attend to all that are in use."""
        begins = _known_starts(is_init)
        if begins is None:
            keys = keys.masked_fill(is_init.unsqueeze(-1), 0)
            values = values.masked_fill(is_init.unsqueeze(-1), 0)
        step = torch.where(is_init[:, 0], 0, step)
        rotation = angles(step.unsqueeze(1), self.hidden_size, x.dtype)
        slot = (step % self.window)[:, None, None].expand(-1, 1, self.hidden_size)
        keys = keys.scatter(1, slot, rotate_pairs(self.key(x), *rotation).to(keys.dtype))
        values = values.scatter(1, slot, self.value(x).to(values.dtype))
        # in the copies that scatter made; cheaper than a copy with holes before
        if begins is not None and len(begins):
            for rows in (keys, values):
                rows[:, 1:].index_fill_(0, begins, 0)
        query = rotate_pairs(self.query(x), *rotation) / math.sqrt(self.hidden_size)
        unused = torch.arange(self.window, device=x.device) > step.unsqueeze(-1)
        score = (query @ keys.mT).masked_fill(unused.unsqueeze(1), -torch.inf)
        return score.softmax(-1) @ values, keys, values, step + 1

    def _read_chunk(
        self, x: Tensor, keys: Tensor, values: Tensor, step: Tensor, is_init: Tensor
    ) -> tuple[Tensor, ...]:
        """Several steps: put the ring in order of time, append the chunk, keep the last W steps as
        a ring again.
        """
        window = self.window
        lost = is_init[:, 0] if self.carry_cache else torch.ones_like(is_init[:, 0])
        step = torch.where(lost, 0, step)
        order = torch.arange(window, device=x.device)
        # positions of the W steps before the chunk; negative: there is none
        past = step.unsqueeze(-1) - window + order
        none = past < 0
        keys = rotate_pairs(_take(keys, past % window), *_angles_from(past[:, 0], window, -1, keys))
        keys = keys.masked_fill(none.unsqueeze(-1), 0)
        keys = torch.cat((keys, self.key(x)), dim=1)[:, 1:]
        values = _take(values, past % window).masked_fill(none.unsqueeze(-1), 0)
        values = torch.cat((values, self.value(x)), dim=1)[:, 1:]
        episode = torch.cat([torch.where(none, -1, 0)[:, 1:], is_init.cumsum(1)], dim=1)
        y = window_attention(self.query(x), keys, values, episode, window)
        index = torch.arange(1, x.shape[1] + 1, device=x.device)
        # where the last episode begins
        begun = torch.where(is_init, index - 1, -step.unsqueeze(-1)).amax(1)
        step = x.shape[1] - begun
        first = step - window  # position of the oldest of the last W steps
        keys = rotate_pairs(keys[:, -window:], *_angles_from(first, window, 1, keys))
        slots = (order - first.unsqueeze(-1)) % window  # which of them stands in each slot
        unused = (order >= step.unsqueeze(-1)).unsqueeze(-1)
        keys = _take(keys, slots).masked_fill(unused, 0)
        values = _take(values[:, -window:], slots).masked_fill(unused, 0)
        return y, keys, values, step

    def replay(self, x: Tensor, stored: TensorDict, is_init: Tensor) -> tuple[Tensor, TensorDict]:
        """See ``ReplayableMemory``; step by step (slow): windows are not meant to be stored for
        every step.
        """
        self._check(x, stored, is_init, batch_ndim=2)
        return replay_by_steps(self, x, stored, is_init)

    def extra_repr(self) -> str:
        """Sizes and options, for printing."""
        return f"{super().extra_repr()}, window={self.window}, carry_cache={self.carry_cache}"


def _take(rows: Tensor, index: Tensor) -> Tensor:
    """Rows [B, W, H] in the order of an index int64 [B, W]."""
    batch, width = rows.shape[:2]
    first_of_row = torch.arange(0, batch * width, width, device=rows.device).unsqueeze(-1)
    flat_index = (first_of_row + index).flatten()
    taken: Tensor = rows.flatten(0, 1).index_select(0, flat_index).unflatten(0, (batch, width))
    return taken


def _angles_from(first: Tensor, count: int, sign: int, template: Tensor) -> tuple[Tensor, Tensor]:
    """Cosine and sine [B, count, W // 2] of positions first, first + 1, ..., by the sum of angles
    (B + count of them).

    Args:
        first: int64 [B].
        count: how many positions.
        sign: -1 for the angles of the way back.
        template: gives width and dtype.
    """
    cos, sin = angles(first.unsqueeze(-1), template.shape[-1], template.dtype)
    cosine, sine = angles(
        torch.arange(count, device=first.device), template.shape[-1], template.dtype
    )
    return cos * cosine - sin * sine, sign * (sin * cosine + cos * sine)


def _known_starts(is_init: Tensor) -> Tensor | None:
    """Rows that begin an episode, int64 [n]; None where finding out costs (a card, a graph) or is
    refused (vmap).
    """
    if torch.compiler.is_compiling() or is_init.device.type != "cpu":
        return None
    try:
        return is_init[:, 0].nonzero().squeeze(-1)
    except RuntimeError:  # vmap: every row has flags of its own
        return None


def window_attention(
    query: Tensor, key: Tensor, value: Tensor, episode: Tensor, window: int, *, block: int = BLOCK
) -> Tensor:
    """Attend to the last ``window`` steps of the same episode.

    Queries are taken in blocks, each of which sees one stretch of window - 1 + block keys, so the
    mask and the weights need O(T (window + block)) numbers, and the angles O(window + block). A NaN
    or infinity among the values reaches the queries that see it and no others.

    Args:
        query: float [B, T, H].
        key: float [B, W - 1 + T, H], those of the W - 1 steps before index 0 first; unrotated, like
            the query.
        value: float [B, W - 1 + T, H].
        episode: int64 [B, W - 1 + T]; steps with different numbers do not see each other.
        window: W, at least 1.
        block: largest number of queries in a block.

    Returns:
        float [B, T, H].
    """
    length = query.shape[1]
    count = 1
    # a loop: a compiled graph then has one number of blocks and any length
    while count * block < length:
        count += 1
    size = (length + count - 1) // count
    spare = count * size - length
    past = window - 1
    stretch = past + size
    index = torch.arange(stretch, device=query.device)
    cosine, sine = angles(index, query.shape[-1], query.dtype)
    if spare:
        query = F.pad(query, (0, 0, 0, spare))
        key = F.pad(key, (0, 0, 0, spare))
        value = F.pad(value, (0, 0, 0, spare))
        episode = F.pad(episode, (0, spare), value=-2)
    # acting: what is not seen has been zeroed
    bad = ~value.sum(-1).isfinite() if length > 1 else None
    if bad is not None:
        value = value.masked_fill(bad.unsqueeze(-1), 0)  # a weight of zero would not stop it
    queries = rotate_pairs(query.unflatten(1, (count, size)), cosine[past:], sine[past:])
    # Not unfold: its backward is slower, and a graph that is compiled with it has one length.
    stretches = (torch.arange(count, device=query.device).unsqueeze(-1) * size + index).flatten()
    keys = key.index_select(1, stretches).unflatten(1, (count, stretch))
    values = value.index_select(1, stretches).unflatten(1, (count, stretch))
    episodes = episode.index_select(1, stretches).unflatten(1, (count, stretch))
    distance = index[past:, None] - index
    seen = (
        (distance >= 0)
        & (distance < window)
        & (episodes[..., past:, None] == episodes[..., None, :])
    )
    # Spelled out: on a CPU as fast as scaled_dot_product_attention with a mask, which vmap runs row
    # by row.
    score = queries / math.sqrt(query.shape[-1]) @ rotate_pairs(keys, cosine, sine).mT
    if bad is not None:
        lost = torch.where(bad, torch.nan, 0.0).to(score.dtype).index_select(1, stretches)
        score = score + lost.unflatten(1, (count, 1, stretch))
    y = torch.where(seen, score, -torch.inf).softmax(-1) @ values
    return y.flatten(1, 2)[:, :length]  # type: ignore[no-any-return]


def window_attention_loop(
    query: Tensor, key: Tensor, value: Tensor, episode: Tensor, window: int
) -> Tensor:
    """The same function as :func:`window_attention`, one query at a time (slow)."""
    outputs = []
    for t in range(query.shape[1]):
        near = slice(t, window + t)  # the window that ends at step t
        cosine, sine = angles(
            torch.arange(window, device=query.device), query.shape[-1], query.dtype
        )
        keys = rotate(key[:, near], cosine, sine)
        asked = rotate(query[:, t], cosine[-1], sine[-1])
        score = torch.einsum("bh,bwh->bw", asked, keys) / math.sqrt(query.shape[-1])
        score = score.masked_fill(episode[:, near] != episode[:, window - 1 + t, None], -torch.inf)
        outputs.append(torch.einsum("bw,bwh->bh", score.softmax(-1), value[:, near]))
    return torch.stack(outputs, dim=1)
