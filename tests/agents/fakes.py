"""What tests of losses share: toy recurrent networks, fabricated experience whose true next frames
are known, and slow oracles that know nothing of windows.
"""

from dataclasses import dataclass, replace

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from arcade_torch.agents.layout import unroll
from arcade_torch.models import ActorCriticNetwork, MemoryNetwork

ACTIONS, WIDTH = 5, 6
GAMMA, LAM = 0.9, 0.7


class ToyEncoder(nn.Module):
    """One linear layer."""

    obs_size, feature_size, amp = 2, WIDTH, False

    def __init__(self) -> None:
        super().__init__()
        self.eye = nn.Linear(12, WIDTH)

    def forward(self, pixels: Tensor) -> Tensor:
        return torch.tanh(self.eye(pixels.flatten(-3).to(self.eye.weight.dtype) / 255))

    def compress(self, pixels: Tensor) -> Tensor:
        return pixels

    def calibrate(self, pixels: Tensor) -> None:
        pass


class ToyMemory(nn.Module):
    """A tiny gated recurrence, stepped by a plain loop."""

    def __init__(self) -> None:
        super().__init__()
        self.inner = nn.Linear(WIDTH + ACTIONS + WIDTH, WIDTH)

    def forward(self, x: Tensor, state: TensorDict, is_init: Tensor) -> tuple[Tensor, TensorDict]:
        h, out = state["h"], []
        for t in range(x.shape[1]):
            h = torch.where(is_init[:, t, None], 0.0, h)
            h = h + 0.5 * torch.tanh(self.inner(torch.cat((x[:, t], h), -1)))
            out.append(h)
        return torch.stack(out, 1), TensorDict({"h": h}, [h.shape[0]])

    def initial_state(self, batch_size: int) -> TensorDict:
        return TensorDict({"h": self.inner.weight.new_zeros(batch_size, WIDTH)}, [batch_size])


def toy_network(seed: int = 0, outputs: int = ACTIONS, **keys) -> MemoryNetwork:
    """The package's network around toy parts."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        return MemoryNetwork(ToyEncoder(), ToyMemory(), nn.Linear(WIDTH, outputs), **keys)  # type: ignore[arg-type]


def toy_actor_critic(seed: int = 0) -> ActorCriticNetwork:
    """Two toys behind the interface of an actor-critic."""
    actor = toy_network(seed, out_key="logits", state_key=("memory", "actor"))
    return ActorCriticNetwork(
        actor, toy_network(seed + 1, 1, out_key="state_value", state_key=("memory", "critic"))
    )


@dataclass
class Stream:
    """Random experience; ``final`` is the true next frame of every step. A seam is a start without
    an end before it.
    """

    pixels: Tensor
    final: Tensor
    action: Tensor
    last_action: Tensor
    is_init: Tensor
    reward: Tensor
    terminated: Tensor
    truncated: Tensor
    state: TensorDict

    @property
    def cut(self) -> Tensor:
        """bool [B, T]: the record ends behind this step though nothing terminated."""
        seam = torch.cat((self.is_init[:, 1:], torch.zeros_like(self.is_init[:, :1])), 1)
        return (self.truncated | seam) & ~self.terminated

    def sequences(self, final_frames: str = "truncated") -> TensorDict:
        """As ``ArcadeCollector.collect()`` gives it, one place more than needed: unused ones hold
        white frames.
        """
        rows, steps = self.action.shape
        batch = TensorDict(self._entries(), [rows])
        batch["initial_state"] = self.state
        if final_frames == "all":
            return batch.set(("next", "pixels"), self.final)
        wanted = self.cut.clone() if final_frames == "truncated" else torch.zeros_like(self.cut)
        wanted[:, -1] = ~self.terminated[:, -1] & (
            (final_frames == "truncated") | ~self.truncated[:, -1]
        )
        places = int(wanted.sum(1).max()) + 1
        frames = torch.full((rows, places, *self.final.shape[2:]), 255, dtype=torch.uint8)
        index, mask = (
            torch.full((rows, places), steps - 1),
            torch.zeros(rows, places, dtype=torch.bool),
        )
        for row in range(rows):
            at = wanted[row].nonzero().flatten()
            frames[row, : len(at)], index[row, : len(at)], mask[row, : len(at)] = (
                self.final[row, at],
                at,
                True,
            )
        return batch.update({"final_pixels": frames, "final_index": index, "final_mask": mask})

    def stock(self) -> TensorDict:
        """As a TorchRL collector gives it: dense next frames; the state of a step, of which only
        the first counts.
        """
        batch = TensorDict(self._entries(), self.action.shape)
        batch["next"].update({"pixels": self.final, "last_action": self.action})
        for key, first in self.state.items(True, True):
            unknown = torch.nan if first.is_floating_point() else -1
            value = torch.full((*self.action.shape, *first.shape[1:]), unknown, dtype=first.dtype)
            value[:, 0] = first
            batch[key] = value
        return batch

    def _entries(self) -> dict:
        flags = {
            "terminated": self.terminated,
            "truncated": self.truncated,
            "done": self.terminated | self.truncated,
        }
        after = {
            key: value.unsqueeze(-1) for key, value in (flags | {"reward": self.reward}).items()
        }
        roots = {"pixels": self.pixels, "action": self.action, "last_action": self.last_action}
        return roots | {"is_init": self.is_init.unsqueeze(-1), "next": after}


def stream(rows: int, steps: int, seed: int, ends: float = 0.3, seams: float = 0.0) -> Stream:
    """A random stream that starts in mid-episode in some rows."""
    g = torch.Generator().manual_seed(seed)
    frames, final = (
        torch.randint(256, (rows, steps, 2, 2, 3), generator=g, dtype=torch.uint8) for _ in range(2)
    )
    action = torch.randint(ACTIONS, (rows, steps), generator=g)
    terminated, truncated = (torch.rand(rows, steps, generator=g) < ends / 2 for _ in range(2))
    over = terminated | truncated | (torch.rand(rows, steps, generator=g) < seams)
    final[:, :-1] = torch.where(over[:, :-1, None, None, None], final[:, :-1], frames[:, 1:])
    first = torch.rand(rows, 1, generator=g) < 0.3
    return Stream(
        pixels=frames,
        final=final,
        action=action,
        last_action=torch.cat((torch.randint(ACTIONS, (rows, 1), generator=g), action[:, :-1]), 1),
        is_init=torch.cat((first, over[:, :-1]), 1),
        reward=torch.randn(rows, steps, generator=g),
        terminated=terminated,
        truncated=truncated,
        state=TensorDict({"memory": {"h": torch.randn(rows, WIDTH, generator=g)}}, [rows]),
    )


def with_two_states(s: Stream) -> Stream:
    """The stream as an actor-critic would have acted it: a state for each tower."""
    h = s.state["memory", "h"]
    other = torch.randn(h.shape, generator=torch.Generator().manual_seed(0))
    towers = {"memory": {"actor": {"h": h}, "critic": {"h": other}}}
    return replace(s, state=TensorDict(towers, s.state.batch_size))


@torch.no_grad()
def play(network: MemoryNetwork, s: Stream) -> tuple[Tensor, Tensor]:
    """One step of one row at a time: outputs for every observation and for every true next one,
    both [B, T, A].
    """
    here, after = [], []
    for b in range(s.action.shape[0]):
        row = s.state[b : b + 1]
        state = row[network.state_keys[0][:-1]] if network.state_keys else network.initial_state(1)
        for t in range(s.action.shape[1]):

            def step(frames, last, start, state, b=b, t=t):
                at = (slice(b, b + 1), slice(t, t + 1))
                return network.remember(network.encode(frames[at]), last[at], start[at], state)

            out, state = step(s.pixels, s.last_action, s.is_init, state)
            following, _ = step(s.final, s.action, torch.zeros_like(s.is_init), state)
            here.append(out[0, 0])
            after.append(following[0, 0])
    shape = (*s.action.shape, -1)
    return torch.stack(here).view(shape), torch.stack(after).view(shape)


def chosen(out: Tensor, action: Tensor) -> Tensor:
    """Entries [B, T] of [B, T, A]."""
    return out.gather(-1, action.unsqueeze(-1)).squeeze(-1)


def lambda_return(
    reward: Tensor, after: Tensor, terminated: Tensor, cut: Tensor, gamma: float, lam: float
) -> Tensor:
    """G[t] as a mixture of n-step returns, (1 - lam) lam^(n - 1), the last with what is left: no
    recursion.
    """
    out = torch.zeros_like(reward)
    for b in range(reward.shape[0]):
        r, v, ends, cuts = (x[b].tolist() for x in (reward, after, terminated, cut))
        for t in range(len(r)):
            total, weight, discounted = 0.0, 1.0, 0.0
            for n, k in enumerate(range(t, len(r))):
                discounted += gamma**n * r[k]
                tail = 0.0 if ends[k] else gamma ** (n + 1) * v[k]
                if ends[k] or cuts[k] or k == len(r) - 1:
                    total += weight * (discounted + tail)
                    break
                total += weight * (1 - lam) * (discounted + tail)
                weight *= lam
            out[b, t] = total
    return out


def summed_errors(
    reward: Tensor,
    value: Tensor,
    after: Tensor,
    terminated: Tensor,
    cut: Tensor,
    gamma: float,
    lam: float,
) -> Tensor:
    """The generalised advantage estimate as the sum over future errors, written out for every
    step.
    """
    out = torch.zeros_like(reward)
    for b in range(reward.shape[0]):
        r, v, w, ends, cuts = (x[b].tolist() for x in (reward, value, after, terminated, cut))
        for t in range(len(r)):
            weight, total = 1.0, 0.0
            for k in range(t, len(r)):
                total += weight * (r[k] + (0.0 if ends[k] else gamma * w[k]) - v[k])
                if ends[k] or cuts[k]:
                    break
                weight *= gamma * lam
            out[b, t] = total
    return out


@torch.no_grad()
def look_into(loss, batch: TensorDict) -> tuple[Tensor, Tensor, Tensor]:
    """Q-values [B, L, A], targets [B, S] and next values [B, S] of a loss of Q-values."""
    data = loss.prepare(batch)
    steps = data["reward"].shape[1] - (loss.bootstrap == "last")
    q = unroll(loss.value_network, loss.inputs, data, "action_value")
    here = q.gather(1, data["position"].unsqueeze(-1).expand(-1, -1, q.shape[-1]))
    return here, loss.targets(data, q, steps), loss.next_values(data, q, steps)
