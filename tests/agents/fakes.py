"""Toy recurrent networks and a random stream of experience with known final frames."""

from dataclasses import dataclass

import torch
from tensordict import NonTensorData, TensorDict
from torch import Tensor, nn

from arcade_torch.models.actor_critic import ActorCriticNetwork

ACTIONS = 5


class ToyNetwork(nn.Module):
    """The interface of MemoryNetwork over a tiny gated recurrence, stepped by a plain loop."""

    def __init__(self, seed: int = 0, width: int = 6, pixels: int = 12, outputs: int = ACTIONS) -> None:
        super().__init__()
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            self.eye = nn.Linear(pixels, width)
            self.inner = nn.Linear(width + ACTIONS + width, width)
            self.head = nn.Linear(width, outputs)
        self.width = width

    def compress(self, pixels: Tensor) -> Tensor:
        return pixels

    def calibrate(self, pixels: Tensor) -> None:
        pass

    def encode(self, pixels: Tensor) -> Tensor:
        return torch.tanh(self.eye(pixels.flatten(-3).to(self.eye.weight.dtype) / 255))

    def remember(self, features, last_action, is_init, state):
        h, out = state["h"], []
        action = nn.functional.one_hot(last_action, ACTIONS).to(features.dtype)
        for t in range(features.shape[1]):
            h = torch.where(is_init[:, t, None], 0.0, h)
            h = h + 0.5 * torch.tanh(self.inner(torch.cat((features[:, t], action[:, t], h), -1)))
            out.append(self.head(h))
        return torch.stack(out, 1), TensorDict({"h": h}, [h.shape[0]])

    def forward(self, pixels, last_action, is_init, state):
        return self.remember(self.encode(pixels), last_action, is_init, state)

    def initial_state(self, batch_size: int) -> TensorDict:
        return TensorDict({"h": self.head.weight.new_zeros(batch_size, self.width)}, [batch_size])


def toy_actor_critic(seed: int = 0) -> ActorCriticNetwork:
    """Two toys behind the interface of an actor-critic."""
    return ActorCriticNetwork(ToyNetwork(seed), ToyNetwork(seed + 1, outputs=1))  # type: ignore[arg-type]


class Pool:
    """What a batch's ``next_pool`` must offer."""

    def __init__(self, pixels: Tensor) -> None:
        self.pixels = pixels


@dataclass
class Stream:
    """Random experience; ``final`` is the true next frame of every step."""

    pixels: Tensor
    final: Tensor
    action: Tensor
    last_action: Tensor
    is_init: Tensor
    reward: Tensor
    terminated: Tensor
    truncated: Tensor
    state: TensorDict

    def sequences(self, final_frames: str = "all") -> TensorDict:
        """As ArcadeCollector.collect() gives it: each frame stored once, a pool for the others, in shuffled places."""
        done = self.terminated | self.truncated
        wanted = {"all": done, "truncated": self.truncated, "none": torch.zeros_like(done)}[final_frames].clone()
        wanted[:, -1] = True
        row, step = wanted.nonzero(as_tuple=True)
        place = torch.randperm(len(row), generator=torch.Generator().manual_seed(1))
        pool = torch.empty((len(row), *self.pixels.shape[2:]), dtype=torch.uint8)
        pool[place] = self.final[row, step]
        slot = torch.full(done.shape, -1)
        slot[row, step] = place
        return TensorDict(
            {
                **self._roots(),
                "next": {**self._ends(), "frame_slot": slot.unsqueeze(-1)},
                "next_pool": NonTensorData(Pool(pool), batch_size=[done.shape[0]]),
                "initial_state": self.state,
            },
            batch_size=[done.shape[0]],
        )

    def stock(self) -> TensorDict:
        """As a TorchRL collector gives it: dense next frames; the state of a step where its policy wrote it."""
        rows, steps = self.action.shape
        state = torch.full((rows, steps, self.state["h"].shape[-1]), torch.nan, dtype=self.state["h"].dtype)
        state[:, 0] = self.state["h"]
        return TensorDict(
            {**self._roots(), "memory": {"h": state}, "next": {**self._ends(), "pixels": self.final}},
            batch_size=[rows, steps],
        )

    def _roots(self):
        return {
            "pixels": self.pixels,
            "action": self.action,
            "last_action": self.last_action,
            "is_init": self.is_init.unsqueeze(-1),
        }

    def _ends(self):
        done = self.terminated | self.truncated
        flags = {"terminated": self.terminated, "truncated": self.truncated, "done": done}
        return {"reward": self.reward.unsqueeze(-1), **{k: v.unsqueeze(-1) for k, v in flags.items()}}


def stream(rows: int, steps: int, seed: int, end_share: float = 0.3, width: int = 6, size: int = 2) -> Stream:
    """A random stream that starts in mid-episode in some rows."""
    g = torch.Generator().manual_seed(seed)
    frames = torch.randint(256, (rows, steps, size, size, 3), generator=g, dtype=torch.uint8)
    final = torch.randint(256, (rows, steps, size, size, 3), generator=g, dtype=torch.uint8)
    action = torch.randint(ACTIONS, (rows, steps), generator=g)
    terminated, truncated = (torch.rand(rows, steps, generator=g) < end_share / 2 for _ in range(2))
    done = terminated | truncated
    final[:, :-1] = torch.where(done[:, :-1, None, None, None], final[:, :-1], frames[:, 1:])
    first = torch.rand(rows, 1, generator=g) < 0.3
    return Stream(
        pixels=frames,
        final=final,
        action=action,
        last_action=torch.cat((torch.randint(ACTIONS, (rows, 1), generator=g), action[:, :-1]), 1),
        is_init=torch.cat((first, done[:, :-1]), 1),
        reward=torch.randn(rows, steps, generator=g),
        terminated=terminated,
        truncated=truncated,
        state=TensorDict({"h": torch.randn(rows, width, generator=g)}, [rows]),
    )


@torch.no_grad()
def replay(network: nn.Module, s: Stream) -> tuple[Tensor, Tensor]:
    """One step of one row at a time: Q of every observation [B, T, A], best Q of every true next observation [B, T]."""
    q_all, next_all = [], []
    for b in range(s.action.shape[0]):
        state = s.state[b : b + 1]
        q_row, next_row = [], []
        for t in range(s.action.shape[1]):
            root = s.pixels[b, None, t, None], s.last_action[b, None, t, None], s.is_init[b, None, t, None]
            q, state = network(*root, state)
            no = torch.zeros(1, 1, dtype=torch.bool)
            after, _ = network(s.final[b, None, t, None], s.action[b, None, t, None], no, state)
            q_row.append(q[0, 0])
            next_row.append(after.max())
        q_all.append(torch.stack(q_row))
        next_all.append(torch.stack(next_row))
    return torch.stack(q_all), torch.stack(next_all)
