"""Frames per second of training: collecting, learning, both, and the share of every part.

The very trainer of ``arcade-torch train`` is timed, on whole windows and whole minibatches. Rates come from passes
without a stopwatch in them, shares from passes with one, the kinds of operation from one in which each operation is
timed (see ``kinds.py``); beside them stand the convolutions of the encoder alone, on the same shapes in the same run.
"""

import contextlib
import dataclasses
import itertools
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from math import isnan, nan
from statistics import median
from typing import Any

import torch
from tensordict import TensorDictBase

from arcade_torch.agents.config import TrainConfig
from arcade_torch.agents.presets import preset
from arcade_torch.agents.trainer import Trainer
from arcade_torch.models import MemoryNetwork
from arcade_torch.tools.bench.convolutions import convolutions_of, plain_pass
from arcade_torch.tools.bench.kinds import KINDS, REST, shares_of_kinds
from arcade_torch.tools.bench.laps import Laps

COLLECTING = (
    "environment",
    "acting: encoder",
    "acting: memory",
    "acting: heads",
    "compressing",
    "storing and the rest",
)
LEARNING = ("encoder", "memory", "heads", "targets and loss", "optimiser", "minibatches and the rest")
FORMS: dict[str, dict[str, bool]] = {
    "eager": {},
    "amp": {"amp": True},
    "compiled": {"compile": True},
    "graphs": {"cuda_graphs": True},
}
"""Ways to run a network, by the settings of a run that ask for them."""


@dataclass(frozen=True)
class TrainSpeed:
    """What one network costs. Shares and the encoder's rate are NaN where its parts run as one and cannot be timed.

    Attributes:
        network: preset of the network.
        memory: name of the memory model.
        form: how it is run, forms of `FORMS` joined by "+".
        parameters: of the network.
        num_envs: environments.
        num_steps: steps of each in a window.
        minibatch_frames: frames in a minibatch.
        grad_steps: of an update.
        collect_fps: frames per second of collecting alone.
        learn_fps: frames per second of learning alone, all gradient steps of an update counted.
        train_fps: frames per second of both, one after the other.
        collecting: part -> share of the time of collecting.
        learning: part -> share of the time of learning.
        kinds: kind of operation -> share of the time of learning, see `KINDS`.
        encoder_gflops: 10**9 floating-point operations a second that the encoder's convolutions amount to, over the
            whole time of the encoder, forwards and backwards.
        plain_gflops: the same of the convolutions alone.
    """

    network: str
    memory: str
    form: str
    parameters: int
    num_envs: int
    num_steps: int
    minibatch_frames: int
    grad_steps: int
    collect_fps: float
    learn_fps: float
    train_fps: float
    encoder_gflops: float
    plain_gflops: float
    collecting: dict[str, float] = field(default_factory=dict)
    learning: dict[str, float] = field(default_factory=dict)
    kinds: dict[str, float] = field(default_factory=dict)

    def flat(self) -> dict[str, Any]:
        """All numbers in one row, for a table file; None where there is none."""
        row = asdict(self)
        for group in ("collecting", "learning", "kinds"):
            row |= {f"{group}: {part}": share for part, share in row.pop(group).items()}
        return {key: None if isinstance(value, float) and isnan(value) else value for key, value in row.items()}


def bench_train(
    networks: Sequence[str] = ("paper", "small"),
    memories: Sequence[str] = ("lru", "gru"),
    env: str = "MineSweeperEasy",
    device: str = "cpu",
    forms: Sequence[str] = ("eager",),
    grad_steps: int = 4,
    repeats: int = 3,
    tell: Callable[[str], None] = lambda text: None,
) -> list[TrainSpeed]:
    """Measure PQN with networks and memories.

    Args:
        networks: presets, "paper" (16 envs x 128 steps) and "small" (64 x 32); their learners' numbers come along.
        memories: names of memory models.
        env: game; its POMDP twin is played.
        device: of the network.
        forms: names of `FORMS`, or several joined by "+", such as "compiled+amp".
        grad_steps: gradient steps in each timed pass; an update has more, all alike.
        repeats: passes; the median counts.
        tell: called with a line before each network.

    Returns:
        One result for every network, memory and form.

    Raises:
        ValueError: an unknown name, or a number below 1.
    """
    for name, number in (("grad_steps", grad_steps), ("repeats", repeats)):
        if number < 1:
            raise ValueError(f"{name} must be at least 1, got {number}")
    plans = list(itertools.product(networks, memories, forms))
    configs = [_config(network, memory, env, device, form) for network, memory, form in plans]
    found = []
    for config, (_, _, form) in zip(configs, plans, strict=True):
        tell(f"{config.network} network, {config.memory}, {form}")
        with _closing(Trainer(config)) as trainer:
            found.append(_measure(trainer, form, grad_steps, repeats))
    return found


def _config(network: str, memory: str, env: str, device: str, form: str) -> TrainConfig:
    """The preset of that name without its random play, run in that form."""
    settings: dict[str, Any] = {}
    for name in form.split("+"):
        if name not in FORMS:
            raise ValueError(f"a form is {', '.join(FORMS)}, or several of them joined by '+'; got {form!r}")
        settings |= FORMS[name]
    config = preset(network, env=env, memory=memory, observability="partial", device=device, **settings)
    return dataclasses.replace(config, pqn=dataclasses.replace(config.pqn, warmup_steps=0))


@contextlib.contextmanager
def _closing(trainer: Trainer) -> Iterator[Trainer]:
    try:
        yield trainer
    finally:
        trainer.close()


def _measure(trainer: Trainer, form: str, grad_steps: int, repeats: int) -> TrainSpeed:
    numbers, device = trainer.config.learner, torch.device(trainer.config.device)
    frames = numbers.frames_per_update
    kept: list[TensorDictBase] = []  # the newest window: collecting overwrites the one before

    def collect() -> None:
        kept[:] = [trainer.collector.collect()]

    def learn() -> None:
        _learn_some(trainer, kept[0], grad_steps)

    collect()  # compiles
    learn()
    window = next(iter(trainer.learner.minibatches(kept[0])))
    assert isinstance(trainer.network, MemoryNetwork)  # PQN's
    shapes = convolutions_of(trainer.network.encoder, window.pixels.flatten(0, 1))
    plain = plain_pass(shapes)
    plain()
    laps, in_parts = Laps(device), not (trainer.config.compile or trainer.config.cuda_graphs)
    collecting: dict[str, float] = {} if in_parts else dict.fromkeys(COLLECTING, nan)
    learning: dict[str, float] = {} if in_parts else dict.fromkeys(LEARNING, nan)
    collect_s, learn_s, plain_s = [], [], []
    for _ in range(repeats):
        collect_s.append(_seconds(collect, device))
        learn_s.append(_seconds(learn, device) / grad_steps)
        plain_s += [plain() for _ in range(grad_steps)]
        if not in_parts:
            continue
        with _watched_collecting(laps, trainer):
            collecting = _added(collecting, laps, collect, COLLECTING)
        with _watched_learning(laps, trainer):
            learning = _added(learning, laps, learn, LEARNING)
    update_s = median(learn_s) * numbers.grad_steps_per_update
    flops = sum(shape.flops for shape in shapes)
    return TrainSpeed(
        network=trainer.config.network,
        memory=trainer.config.memory,
        form=form,
        parameters=sum(p.numel() for p in trainer.network.parameters()),
        num_envs=numbers.num_envs,
        num_steps=numbers.num_steps,
        minibatch_frames=window.action.numel(),
        grad_steps=numbers.grad_steps_per_update,
        collect_fps=frames / median(collect_s),
        learn_fps=frames / update_s,
        train_fps=frames / (median(collect_s) + update_s),
        encoder_gflops=flops / (learning["encoder"] / repeats / grad_steps) / 1e9,
        plain_gflops=flops / median(plain_s) / 1e9,
        collecting=_shares(collecting),
        learning=_shares(learning),
        kinds=shares_of_kinds(learn, device) if in_parts else dict.fromkeys([*KINDS, REST], nan),
    )


def _learn_some(trainer: Trainer, batch: TensorDictBase, grad_steps: int) -> None:
    """Learn from a window, ending after some gradient steps."""
    learner = trainer.learner
    every = type(learner).minibatches
    learner.__dict__["minibatches"] = lambda batch: itertools.islice(every(learner, batch), grad_steps)
    try:
        learner.learn(batch, 0)
    finally:
        del learner.__dict__["minibatches"]


def _seconds(work: Callable[[], object], device: torch.device) -> float:
    began = time.perf_counter()
    work()
    if device.type == "cuda":
        torch.cuda.synchronize()
    return time.perf_counter() - began


@contextlib.contextmanager
def _watched_collecting(laps: Laps, trainer: Trainer) -> Iterator[None]:
    network, rest = trainer.network, COLLECTING[-1]
    with contextlib.ExitStack() as stack:
        for part in ("encoder", "block", "head"):
            name = {"encoder": "encoder", "block": "memory", "head": "heads"}[part]
            stack.enter_context(laps.through(getattr(network, part), f"acting: {name}", rest, rest))
        stack.enter_context(laps.around(network.encoder, "compress", "compressing", rest))
        stack.enter_context(laps.around(trainer.env, "step_raw", "environment", rest))
        yield


@contextlib.contextmanager
def _watched_learning(laps: Laps, trainer: Trainer) -> Iterator[None]:
    network, rest, loss = trainer.network, LEARNING[-1], "targets and loss"
    with contextlib.ExitStack() as stack:
        stack.enter_context(laps.through(network.encoder, "encoder", rest, "memory"))  # type: ignore[arg-type]
        stack.enter_context(laps.through(network.block, "memory", rest, "heads"))  # type: ignore[arg-type]
        stack.enter_context(laps.through(network.head, "heads", rest, loss))  # type: ignore[arg-type]
        stack.enter_context(laps.around(trainer.learner, "objective", loss, rest))
        stack.enter_context(laps.around(trainer.learner.optimizer, "step", "optimiser", "optimiser"))
        yield


def _added(before: dict[str, float], laps: Laps, work: Callable[[], object], parts: Sequence[str]) -> dict[str, float]:
    """Seconds of each part, those of one more pass added."""
    laps.start()
    work()
    laps.press(parts[-1])
    assert laps.seconds.keys() <= set(parts), laps.seconds.keys()
    return {part: before.get(part, 0.0) + laps.seconds[part] for part in parts}


def _shares(seconds: dict[str, float]) -> dict[str, float]:
    total = sum(seconds.values())
    return {part: value / total for part, value in seconds.items()}
