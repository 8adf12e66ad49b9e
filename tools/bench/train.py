"""Frames per second of training with PQN: collecting, learning, both, and the share of every kind
of operation.
"""

import dataclasses
import itertools
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import torch
from torch.profiler import profile

from arcade_torch.agents.checked import require
from arcade_torch.agents.config import TrainConfig
from arcade_torch.agents.presets import preset
from arcade_torch.agents.trainer import Trainer
from arcade_torch.tools.bench.harness import Measure, interleaved
from arcade_torch.tools.bench.registry import BenchOptions
from arcade_torch.tools.machine import torch_threads
from arcade_torch.tools.options import at_least
from arcade_torch.tools.switches import Unless

FORMS = {
    "eager": {},
    "amp": {"amp": True},
    "compiled": {"compile": True},
    "graphs": {"cuda_graphs": True},
}
"""Ways to run a network, by the settings of a run that ask for them."""


@dataclass
class Options(BenchOptions):
    """Frames per second of training with PQN: collecting, learning, both, and where the time of
    learning goes.

    The trainer of arcade-torch train is timed with the numbers of the presets of that name: paper
    has 16 envs x 128 steps and 64 gradient steps an update, small 64 x 32 and 32. Freed memory is
    kept, as there.

    Example: arcade-torch bench train --networks small --memories lru gru --threads 1 --out
    runs/train.csv
    """

    networks: tuple[str, ...] = ("paper", "small")  # Presets of network and learner: paper, small.
    memories: tuple[str, ...] = ("lru", "gru")  # Memory models, see arcade-torch list.
    env: str = "MineSweeperEasy"  # The game; its POMDP twin is played.
    device: str = "cpu"  # Torch device of the network.
    forms: tuple[str, ...] = ("eager",)
    """How networks are run: eager, amp, compiled, graphs (CUDA graphs of acting and of gradient
    steps), or several joined by "+".
    """
    threads: int = 0  # Torch threads; 0 leaves the setting alone.
    grad_steps: int = 4  # Gradient steps in each timed pass; those of an update are all alike.
    repeats: int = 3  # Passes; the median counts.
    # Whether the C library keeps freed memory, as train does and a loop of your own does not.
    keep_memory: Unless = True


def run(options: Options, log: Callable[[str], None]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Rows of the table ``train``."""
    at_least(options, grad_steps=1, repeats=1, threads=0)
    plans = list(itertools.product(options.networks, options.memories, options.forms))
    configs = [_config(network, memory, form, options) for network, memory, form in plans]
    with torch_threads(options.threads or torch.get_num_threads()):
        for config, (_, _, form) in zip(configs, plans, strict=True):
            log(f"{config.network} network, {config.memory}, {form}")
            trainer = Trainer(config)
            try:
                yield "train", _measure(trainer, form, options)
            finally:
                trainer.close()


def _config(network: str, memory: str, form: str, options: Options) -> TrainConfig:
    """The preset of that name without its random play, run in that form."""
    settings: dict[str, Any] = {}
    for name in form.split("+"):
        allowed = f"{', '.join(FORMS)}, or several of them joined by '+'"
        require(name in FORMS, "a form", form, allowed)
        settings |= FORMS[name]
    config = preset(
        network,
        algorithm="pqn",
        env=options.env,
        memory=memory,
        observability="partial",
        device=options.device,
        **settings,
    )
    most = config.learner.grad_steps_per_update
    allowed = f"at most {most} with the {network} network"
    require(options.grad_steps <= most, "--grad-steps", options.grad_steps, allowed)
    return dataclasses.replace(config, pqn=dataclasses.replace(config.pqn, warmup_steps=0))


def _measure(trainer: Trainer, form: str, options: Options) -> dict[str, Any]:
    config = trainer.config.learner
    learner: Any = trainer.learner
    window = trainer.collector.collect()

    def collect() -> None:
        nonlocal window
        window = trainer.collector.collect()

    def learn() -> None:
        """PQN's update, of which only some gradient steps are made."""
        data = learner.loss.prepare(window)
        for minibatch in itertools.islice(learner.minibatches(data), options.grad_steps):
            learner.gradient_step(minibatch, frames=0)
        learner.take_metrics()

    frames = config.frames_per_update
    every_step = config.grad_steps_per_update
    learned = round(frames * options.grad_steps / every_step)  # of an update's frames in a pass
    measures = {"collect": Measure(collect, units=frames), "learn": Measure(learn, units=learned)}
    measured = interleaved(measures, seconds=1e-9, repeats=options.repeats, warm_ups=1)
    collect_fps = measured["collect"].rate
    learn_fps = measured["learn"].rate
    shares = {f"learning: {kind}": share for kind, share in op_breakdown(learn).items()}
    return {
        "network": trainer.config.network,
        "memory": trainer.config.memory,
        "form": form,
        "parameters": sum(p.numel() for p in trainer.network.parameters()),
        "num_envs": config.num_envs,
        "num_steps": config.num_steps,
        "grad_steps": every_step,
        "collect_fps": collect_fps,
        "learn_fps": learn_fps,
        "train_fps": 1 / (1 / collect_fps + 1 / learn_fps),
        **shares,
    }


KINDS = {
    "convolutions": ("convolution",),
    "pooling": ("max_pool",),
    "recurrence": ("linear_scan", "matrix_scan"),
    "matrix products": ("addmm", "::mm", "bmm", "matmul"),
    "activations": ("leaky_relu",),
    "copies and casts": (
        "copy",
        "aten::cat",
        "clone",
        "index_select",
        "aten::fill_",
        "aten::zero_",
    ),
}
"""Kinds of operation, by parts of their names; the rest is elementwise work."""
REST = "the rest"


def op_breakdown(work: Callable[[], object]) -> dict[str, float]:
    """Shares of the kinds of operation in the time of some work, by torch's profiler: CUDA kernels
    where there are any.

    On a CPU the profiler's own memory makes copies look a little dearer than they are.
    """
    work()
    # else the first profiler of a process writes lines of its own to stderr
    os.environ.setdefault("KINETO_LOG_LEVEL", "99")
    with profile() as run:
        work()
    events = list(run.key_averages())
    on_card = sum(event.self_device_time_total for event in events)
    seconds = dict.fromkeys([*KINDS, REST], 0.0)
    for event in events:
        seconds[_kind_of(event.key)] += (
            event.self_device_time_total if on_card else event.self_cpu_time_total
        )
    total = sum(seconds.values())
    return {kind: value / total for kind, value in seconds.items()}


def _kind_of(operation: str) -> str:
    """The first kind that an operation is of, by its name."""
    for kind, names in KINDS.items():
        if any(name in operation for name in names):
            return kind
    return REST
