"""Acting and learning on a device that is none: no numbers, but every operator, and where its
tensors are.

    python -m tests.agents.fake_device [MEMORY...]

prints a row for each algorithm and memory: operators of acting, of preparing a window and of a
gradient step; how many of them ran on the CPU, copied between devices, or made the host wait. The
last three are to be 0. The device is torch's private backend without a library behind it, in fake
tensors.
"""

import sys
from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils import backend_registration
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten

from arcade_torch.agents import preset
from arcade_torch.agents.learner import Learner, Training
from arcade_torch.agents.policy import build_network, make_policy
from arcade_torch.agents.trainer import LEARNERS, Trainer
from arcade_torch.models import memory_names

NAME = "npy"
WAITS = ("_local_scalar_dense", "is_nonzero", "nonzero", "equal.default", "item")
COLUMNS = ("algorithm", "memory", "part", "operators", "on the CPU", "copies", "waits")


class Watch(TorchDispatchMode):
    """Counts operators, and notes those that a GPU would have to wait for."""

    def __init__(self) -> None:
        super().__init__()
        self.operators = 0
        self.on_cpu: list[str] = []
        self.copies: list[str] = []
        self.waits: list[str] = []

    def __torch_dispatch__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Any = None
    ) -> Any:
        """Note an operator, and let it go on."""
        name = str(func)
        self.operators += 1
        if any(wait in name for wait in WAITS):
            self.waits.append(name)
        result = func(*args, **(kwargs or {}))
        tensors = [leaf for leaf in tree_flatten((args, kwargs, result))[0] if _counts(leaf)]
        devices = {tensor.device.type for tensor in tensors}
        if devices == {"cpu"}:
            self.on_cpu.append(name)
        elif len(devices) > 1:
            self.copies.append(name)
        return result


def _counts(leaf: Any) -> bool:
    """Whether a value is a tensor; a number on the CPU is an argument, as in ``x * 0.5``."""
    return isinstance(leaf, Tensor) and (leaf.ndim > 0 or leaf.device.type != "cpu")


def move(module: nn.Module, device: torch.device) -> None:
    """Put parameters and buffers on the device, as fake tensors; shared ones stay shared."""
    moved: dict[int, Tensor] = {}
    for part in module.modules():
        for tensors in (part._parameters, part._buffers):
            for name, tensor in tensors.items():
                if tensor is None:
                    continue
                if id(tensor) not in moved:
                    moved[id(tensor)] = _on(tensor, device)
                tensors[name] = moved[id(tensor)]  # type: ignore[assignment]


def _on(tensor: Tensor, device: torch.device) -> Tensor:
    """A tensor of the same shape and type on the device."""
    fake = torch.empty(tensor.shape, dtype=tensor.dtype, device=device)
    if isinstance(tensor, nn.Parameter):
        return nn.Parameter(fake, requires_grad=tensor.requires_grad)
    return fake


def prepare(learner: Learner, batch: TensorDictBase) -> TensorDictBase:
    """What an update does with a window before its first gradient step."""
    loss: Any = learner.loss
    make: Callable[[TensorDictBase], TensorDictBase] = getattr(loss, "prepare", None) or (
        loss.value_estimator
    )
    return make(batch)


def row(algorithm: str, memory: str) -> dict[str, Watch]:
    """Act, prepare and take a gradient step on the fake device; the watches by part."""
    numbers: dict[str, Any] = {"num_envs": 4, "num_steps": 8, "minibatches": 2}
    if algorithm == "dqn":
        numbers["target_every"] = 0  # the updater of a target network needs real tensors
    config = preset(
        "smoke", env="SkittlesEasy", algorithm=algorithm, memory=memory, **{algorithm: numbers}
    )
    trainer = Trainer(config)
    real = trainer.collector.collect()
    root = TensorDict(trainer.collector._obs, [4])
    root.update(trainer.collector._state)
    network = build_network(config)
    policy = make_policy(network)
    device = torch.device(NAME, 0)
    watches = {part: Watch() for part in ("act", "prepare", "step")}
    with FakeTensorMode(allow_non_fake_inputs=True):
        move(network, device)
        training = Training(1000, torch.Generator(), device)
        learner = LEARNERS[algorithm](network, config.learner, training)  # type: ignore[arg-type]
        if algorithm != "ppo":
            policy[-1]._apply(lambda tensor: _on(tensor, device))
        step = root.apply(lambda tensor: _on(tensor, device), device=device)
        batch = real.apply(lambda tensor: _on(tensor, device), device=device)
        with torch.no_grad(), watches["act"]:
            policy(step)
        with watches["prepare"]:
            data = prepare(learner, batch)
        minibatch = data[:2]
        with watches["step"]:
            learner._plain_step(minibatch)
    return watches


def table(memories: Sequence[str]) -> list[tuple[Any, ...]]:
    """Rows of :data:`COLUMNS`."""
    rows: list[tuple[Any, ...]] = []
    for algorithm in LEARNERS:
        for memory in memories:
            for part, watch in row(algorithm, memory).items():
                bad = (len(watch.on_cpu), len(watch.copies), len(watch.waits))
                rows.append((algorithm, memory, part, watch.operators, *bad))
                for kind in ("on_cpu", "copies", "waits"):
                    names = getattr(watch, kind)
                    if names:
                        print(f"# {algorithm} {memory} {part} {kind}: {sorted(set(names))}")
    return rows


def register() -> None:
    """Make the device known to this process."""
    backend_registration._setup_privateuseone_for_python_backend(NAME)
    module: Any = torch.get_device_module(NAME)
    module.get_amp_supported_dtype = lambda: [torch.bfloat16, torch.float16]


if __name__ == "__main__":
    register()
    print("| " + " | ".join(COLUMNS) + " |")
    print("|---" * len(COLUMNS) + "|")
    for line in table(sys.argv[1:] or memory_names()):
        print("| " + " | ".join(str(value) for value in line) + " |")
