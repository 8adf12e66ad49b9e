"""Can a small encoder read the board at all?

For every Easy game an encoder is taught, from single frames of the MDP, what the scripted player
would do and the facts of the state (cells, cards, positions). What cannot be learned with labels
cannot be learned from rewards.

    python examples/probe_encoders.py --games NavigatorEasy CountRecallEasy --out probe.csv

Writes one line a game, encoder and fact: accuracy on frames of other episodes, that of the most
common answer, the share of what guessing misses that was learned, and the frames an encoder trains
on in a second (batches of 132).
"""

import argparse
import csv
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from arcade_torch.envs_jax import make
from arcade_torch.envs_jax.batch import BatchedGame, env_keys
from arcade_torch.envs_jax.oracles import make_oracle

GAMES = (
    "AutoEncode",
    "BattleShip",
    "Breakout",
    "CartPole",
    "CountRecall",
    "MineSweeper",
    "Navigator",
)
GAMES = tuple(f"{name}Easy" for name in (*GAMES, "NoisyCartPole", "Skittles", "Tetris"))
BATCH = 132


class Gated(nn.Module):
    """Two halves of a convolution multiplied, then the maximum of windows (Hadamax, arXiv
    2505.15345).
    """

    def __init__(
        self, channels: int, out: int, kernel: int, stride: int = 1, pool: int = 1
    ) -> None:
        super().__init__()
        self.conv = nn.Conv2d(channels, 2 * out, kernel, stride)
        self.pool = pool

    def forward(self, x: Tensor) -> Tensor:
        """[N, C, h, w] -> [N, out, h', w']."""
        a, b = self.conv(x).chunk(2, dim=1)
        x = F.gelu(a) * F.gelu(b)
        return F.max_pool2d(x, self.pool + 1, self.pool) if self.pool > 1 else x


def stack(*layers: nn.Module) -> nn.Sequential:
    """Convolutions with LeakyReLU behind them, then 128 features of everything."""
    parts: list[nn.Module] = []
    for layer in layers:
        parts += [layer, nn.LeakyReLU(inplace=True)] if isinstance(layer, nn.Conv2d) else [layer]
    return nn.Sequential(
        *parts, nn.Flatten(), nn.LazyLinear(128), nn.LayerNorm(128), nn.LeakyReLU()
    )


def encoders() -> dict[str, tuple[int, nn.Sequential]]:
    """Name -> side of the pooled frame, network."""
    conv = nn.Conv2d
    return {
        "32": (32, stack(conv(3, 32, 4, 4), conv(32, 32, 3))),
        "64": (64, stack(conv(3, 32, 4, 4), conv(32, 32, 3, 2), conv(32, 32, 3))),
        "64 narrow": (64, stack(conv(3, 16, 4, 4), conv(16, 32, 3, 2), conv(32, 32, 3))),
        "64 wide patches": (64, stack(conv(3, 64, 8, 8), conv(64, 32, 3))),
        "64 overlapping patches": (
            64,
            stack(conv(3, 32, 8, 4), conv(32, 32, 3, 2), conv(32, 32, 3)),
        ),
        "64 max pool": (
            64,
            stack(conv(3, 32, 4, 4), conv(32, 32, 3), nn.MaxPool2d(2), conv(32, 32, 3)),
        ),
        "64 gated": (64, stack(Gated(3, 32, 4, 4, pool=2), Gated(32, 32, 3))),
        "64 average": (
            64,
            stack(conv(3, 32, 4, 4), conv(32, 32, 3, 2), conv(32, 64, 3), nn.AdaptiveAvgPool2d(1)),
        ),
    }


def play(name: str, frames: int, seed: int) -> tuple[Tensor, dict[str, Tensor]]:
    """Frames uint8 [T, 64, 64, 3] of 64 games in which half of the moves are random, and numbers
    [T, cells] by name.
    """
    num_envs = 64
    rng = np.random.default_rng(seed)
    batched = BatchedGame(make(name))
    oracle = make_oracle(batched.game)
    batch = batched.init(env_keys(seed, num_envs), np.zeros(num_envs, bool))
    is_init = np.ones(num_envs, bool)
    pixels = batched.render(batch)
    seen = []
    answers: dict[str, list[np.ndarray]] = {}
    for t in range(4 * frames // num_envs):
        state = jax.tree.map(np.asarray, batch.state)
        action = np.asarray(oracle.act(state, is_init))
        if t % 4 == 0:  # neighbours in time look alike
            halves = torch.from_numpy(np.array(pixels)).view(num_envs, 64, 2, 64, 2, 3)
            seen.append(halves.float().mean((2, 4)).to(torch.uint8))
            answers.setdefault("action", []).append(action[:, None])
            for path, leaf in jax.tree_util.tree_leaves_with_path(state):
                fact = jax.tree_util.keystr(path).strip(".")
                cells = leaf.reshape(num_envs, -1)
                if cells.shape[1] <= 128 and not any(
                    word in fact for word in ("time", "key", "step")
                ):
                    answers.setdefault(fact, []).append(cells)
        explores = rng.random(num_envs) < 0.5
        action = np.where(explores, rng.integers(0, 5, num_envs), action).astype(np.int32)
        batch, _, outcome, pixels = batched.step_autoreset(batch, action)
        is_init = np.asarray(outcome.done)
    return torch.cat(seen), {
        fact: torch.from_numpy(np.concatenate(rows)) for fact, rows in answers.items()
    }


def classes(values: Tensor, like: Tensor) -> Tensor:
    """Numbers as classes 0, 1, ...: whole ones by themselves, others by the eighths of ``like``."""
    if values.is_floating_point():
        inner = torch.quantile(like.float(), torch.arange(1, 8) / 8, dim=0)
        return (values.float() > inner.unsqueeze(1)).sum(0)
    return values.long() - int(like.min())


class Heads(nn.Module):
    """A linear layer for each fact, from 128 features to the classes of its cells."""

    def __init__(self, answers: dict[str, Tensor]) -> None:
        super().__init__()
        self.sizes = {fact: int(values.max()) + 1 for fact, values in answers.items()}
        self.layers = nn.ModuleDict()
        for fact, size in self.sizes.items():
            self.layers[fact.replace(".", "_")] = nn.Linear(128, answers[fact].shape[1] * size)

    def forward(self, fact: str, features: Tensor) -> Tensor:
        """[N, 128] -> logits [N, cells, classes]."""
        out = self.layers[fact.replace(".", "_")](features)
        return out.view(len(features), -1, self.sizes[fact])


def halved(frames: Tensor) -> Tensor:
    """Frames of 64 pixels at half their size."""
    return frames.view(-1, 32, 2, 32, 2, 3).float().mean((2, 4)).to(torch.uint8)


def learnable(facts: dict[str, Tensor]) -> dict[str, Tensor]:
    """The facts as classes, without those that never change or have too many values."""
    answers = {}
    for fact, values in facts.items():
        as_classes = classes(values, values)
        if (as_classes != as_classes[:1]).any() and as_classes.max() < 512:
            answers[fact] = as_classes
    return answers


def teach(
    name: str,
    side: int,
    encoder: nn.Sequential,
    data: list[tuple[Tensor, dict[str, Tensor]]],
    passes: int,
) -> list[dict[str, Any]]:
    """Rows of the table, one a fact: train on the first of ``data``, measure on the second."""
    (pixels, facts), (others, other_facts) = data
    if side == 32:
        pixels = halved(pixels)
        others = halved(others)
    shift = pixels.float().mean(0)
    scale = (pixels[:2000].float() - shift).square().mean().sqrt().clamp_min(1)

    def scaled(frames: Tensor) -> Tensor:
        return ((frames - shift) / scale).permute(0, 3, 1, 2)

    encoder(scaled(pixels[:2]))  # the lazy layer
    answers = learnable(facts)
    heads = Heads(answers)
    speed = train(encoder, heads, pixels, scaled, answers, passes)
    rows = []
    with torch.no_grad():
        features = torch.cat([encoder(scaled(chunk)) for chunk in others.split(512)])
        for fact, values in answers.items():
            truth = classes(other_facts[fact], facts[fact])
            right = float((heads(fact, features).argmax(-1) == truth).float().mean())
            guess = float((values.mode(0).values == truth).float().mean())
            learned = (right - guess) / max(1 - guess, 1e-9)
            row = {"game": name, "fact": fact, "accuracy": right, "guess": guess}
            rows.append(row | {"learned": learned, "frames_per_second": speed})
    return rows


def train(
    encoder: nn.Sequential,
    heads: Heads,
    pixels: Tensor,
    scaled: Callable[[Tensor], Tensor],
    answers: dict[str, Tensor],
    passes: int,
) -> int:
    """Teach encoder and heads; returns the frames a second, without the time of the heads."""
    steps = passes * (len(pixels) // BATCH)
    optimizer = torch.optim.Adam([*encoder.parameters(), *heads.parameters()], fused=True)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 2e-3, total_steps=steps)
    spent = 0.0
    for _ in range(passes):
        for rows in torch.randperm(len(pixels)).split(BATCH):
            if len(rows) < BATCH:
                continue
            began = time.perf_counter()
            features = encoder(scaled(pixels[rows]))
            gradient = features.detach().requires_grad_()
            loss = torch.zeros(())
            for fact, values in answers.items():
                logits = heads(fact, gradient).flatten(0, 1)
                loss = loss + F.cross_entropy(logits, values[rows].flatten())
            optimizer.zero_grad()
            heads_began = time.perf_counter()
            loss.backward()
            heads_took = time.perf_counter() - heads_began
            features.backward(gradient.grad)
            optimizer.step()
            schedule.step()
            spent += time.perf_counter() - began - heads_took
    return round(steps * BATCH / spent)


def main() -> None:
    """Teach every encoder every game."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--games", nargs="+", default=GAMES)
    parser.add_argument("--encoders", nargs="+", default=list(encoders()))
    parser.add_argument("--frames", type=int, default=16_384)
    parser.add_argument("--passes", type=int, default=8)
    parser.add_argument("--out", type=Path, default=Path("probe.csv"))
    args = parser.parse_args()
    torch.set_num_threads(1)
    rows = []
    for game in args.games:
        data = [play(game, args.frames, seed=1), play(game, args.frames // 4, seed=2)]
        for name in args.encoders:
            torch.manual_seed(0)
            side, encoder = encoders()[name]
            found = [
                {"encoder": name} | row for row in teach(game, side, encoder, data, args.passes)
            ]
            print(
                game,
                name,
                ", ".join(f"{row['fact']} {row['learned']:.2f}" for row in found),
                flush=True,
            )
            rows += found
            with args.out.open("w", newline="") as file:
                table = csv.DictWriter(file, rows[0])
                table.writeheader()
                table.writerows(rows)


if __name__ == "__main__":
    main()
