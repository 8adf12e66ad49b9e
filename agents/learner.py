"""What PQN, PPO and DQN share: schedules, the order of minibatches, the gradient step, the check
for NaN.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.objectives import LossModule

from arcade_torch.agents.config import LearnerConfig, QConfig
from arcade_torch.agents.cuda_graph import GraphedFunction
from arcade_torch.agents.runs.states import check_optimizer


class NonFiniteError(RuntimeError):
    """A quantity of the training became NaN or infinite."""


def linear(start: float, end: float, frames: float, duration: float) -> float:
    """Straight line from ``start`` at frame 0 to ``end`` at frame ``duration``, constant
    afterwards.
    """
    return end if frames >= duration else start + (end - start) * (frames / duration)


def learning_rate_at(config: LearnerConfig, frames: float, total_frames: int) -> float:
    """Step size after ``frames`` of ``total_frames`` frames."""
    return linear(
        config.learning_rate,
        config.learning_rate_end,
        frames,
        config.lr_decay_fraction * total_frames,
    )


def epsilon_at(config: LearnerConfig, frames: float, total_frames: int) -> float | None:
    """Probability of a uniformly random action; None for a learner that samples its own policy."""
    if not isinstance(config, QConfig):
        return None
    return linear(
        config.epsilon_start, config.epsilon_end, frames, config.exploration_fraction * total_frames
    )


@dataclass(frozen=True)
class Training:
    """What a learner needs to know of its run."""

    total_frames: int  # for the schedules
    generator: torch.Generator  # CPU generator of the minibatch order
    device: torch.device  # of the networks
    folder: Path | None = None  # where a replay may write; None for a temporary folder
    cuda_graphs: bool = False  # capture the gradient step as one CUDA graph


class Learner:
    """The plumbing below an algorithm's ``update``: one gradient step, minibatches, schedules, the
    check for NaN.

    Args:
        loss: gives a TensorDict; the sum of its ``loss*`` entries is minimised, all its scalars
            become metrics.
        config: numbers of the algorithm.
        training: of the run.
        optimizer: ``"radam"`` or ``"adam"``, see :func:`make_optimizer`.
    """

    def __init__(
        self,
        loss: LossModule,
        config: LearnerConfig,
        training: Training,
        optimizer: Literal["radam", "adam"],
    ) -> None:
        self.loss = loss
        self.config = config
        self.training = training
        self.parameters = [p for p in loss.parameters() if p.requires_grad]
        self.optimizer = make_optimizer(self.parameters, config.learning_rate, optimizer)
        # PPO's running mean of advantages, which a checkpoint holds too; the others' is empty
        self.norm: nn.Module = getattr(loss, "advantage_norm", None) or nn.Module()
        self.frames_per_step = config.frames_per_update / config.grad_steps_per_update
        self.grad_steps = 0
        self.learning_rate = config.learning_rate
        self._step = GraphedFunction(self._plain_step) if training.cuda_graphs else self._plain_step
        self._metrics: list[TensorDictBase] = []

    def minibatches(self, data: TensorDictBase) -> Iterator[TensorDictBase]:
        """The minibatches of all epochs, each epoch over the rows of ``data`` in a random order of
        its own.
        """
        for _ in range(self.config.epochs):
            order = torch.randperm(len(data), device="cpu", generator=self.training.generator)
            order = order.to(self.training.device, non_blocking=True)
            yield from _rows(data, order).split(-(-len(data) // self.config.minibatches))

    def gradient_step(self, minibatch: TensorDictBase, frames: float) -> None:
        """One step of the optimiser, with the step size after ``frames`` frames."""
        self.learning_rate = learning_rate_at(self.config, frames, self.training.total_frames)
        set_learning_rate(self.optimizer, self.learning_rate)
        self._metrics.append(self._step(minibatch))

    def _plain_step(self, minibatch: TensorDictBase) -> TensorDictBase:
        losses = self.loss(minibatch)
        loss = sum(value for key, value in losses.items() if key.startswith("loss"))
        self.optimizer.zero_grad()
        loss.backward()
        norm = nn.utils.clip_grad_norm_(self.parameters, self.config.max_grad_norm, foreach=True)
        self.optimizer.step()
        metrics = {key: value.detach().mean() for key, value in losses.items()}
        return TensorDict(metrics | {"loss": loss.detach(), "grad_norm": norm}, batch_size=[])

    def take_metrics(self) -> dict[str, float]:
        """Means over the gradient steps since the last call, read from the device once.

        Raises:
            NonFiniteError: a loss, a gradient or a weight is not finite; names the gradient step.
        """
        steps = self._metrics
        self._metrics = []
        if not steps:
            return {"lr": self.learning_rate}
        self.grad_steps += len(steps)
        names = list(steps[0].keys())
        table = torch.stack([torch.stack([step[name] for name in names]) for step in steps])
        columns = dict(zip(names, table.T.tolist(), strict=True))
        self._check_finite(columns)
        means = {name: sum(column) / len(column) for name, column in columns.items()}
        return means | {"lr": self.learning_rate}

    def _check_finite(self, columns: dict[str, list[float]]) -> None:
        """Raise NonFiniteError for the first step with a loss or a gradient that is not finite, or
        for weights that are not.
        """
        losses = columns["loss"]
        for number, (loss, norm) in enumerate(zip(losses, columns["grad_norm"], strict=True)):
            for text, value in (("loss", loss), ("gradient norm", norm)):
                if not math.isfinite(value):
                    raise NonFiniteError(
                        f"the {text} is {value} at gradient step {number + 1} of {len(losses)}"
                    )
        sums = torch.stack([p.detach().sum() for p in self.parameters])
        if bool(sums.isfinite().all()):
            return
        bad = [n for n, p in self.loss.named_parameters() if not bool(p.detach().isfinite().all())]
        raise NonFiniteError(f"the weights {', '.join(bad[:3])} are not finite")

    def state_dict(self) -> dict[str, Any]:
        """Everything but the trained weights and the generator that the coming updates depend
        on.
        """
        return {
            "optimizer": self.optimizer.state_dict(),
            "grad_steps": self.grad_steps,
            "norm": self.norm.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go back to a saved moment; the weights are loaded elsewhere."""
        check_optimizer(state["optimizer"], self.parameters)
        group = self.optimizer.param_groups[0]
        options = {name: value for name, value in group.items() if name != "params"}
        self.optimizer.load_state_dict(state["optimizer"])
        self.norm.load_state_dict(state.get("norm", {}))  # older checkpoints have none
        # The config decides these; the step size is set before every step, and on CUDA a tensor
        # there.
        self.optimizer.param_groups[0].update(options)
        self._lay_out_averages()
        self.grad_steps = state["grad_steps"]

    def _lay_out_averages(self) -> None:
        """Store averages in the order of their weights, which was another in older versions: fused
        Adam pairs numbers by their place in memory.
        """
        for parameter, averages in self.optimizer.state.items():
            for name in ("exp_avg", "exp_avg_sq"):
                averages[name] = torch.empty_like(parameter).copy_(averages[name])


def _rows(data: TensorDictBase, rows: Tensor) -> TensorDictBase:
    """``data[rows]``; whole rows are copied, where indexing a CPU's bytes goes one by one."""
    return data.apply(lambda entry: entry.index_select(0, rows))


def make_optimizer(
    parameters: list[nn.Parameter], learning_rate: float, kind: Literal["radam", "adam"] = "radam"
) -> torch.optim.Optimizer:
    """RAdam (PQN, DQN; eps 1e-8) or Adam (PPO; eps 1e-5) with the constants of the paper: betas
    0.9, 0.999, no decay.

    On CUDA the step size, which :func:`set_learning_rate` moves, is a tensor that a graph can read.
    Complex weights, which no fused kernel takes, are moved by torch's plain code.

    Source: Liu et al., "On the variance of the adaptive learning rate and beyond", arXiv
    1908.03265; Kingma & Ba, arXiv 1412.6980.
    """
    cuda = bool(parameters) and parameters[0].device.type == "cuda"
    lr = torch.tensor(learning_rate, device=parameters[0].device) if cuda else learning_rate
    fused = not any(parameter.is_complex() for parameter in parameters)
    if kind == "adam":
        return torch.optim.Adam(parameters, lr=lr, eps=1e-5, fused=fused, capturable=cuda)
    if fused and not cuda:
        return FusedRAdam(parameters, lr=lr, fused=True)
    return torch.optim.RAdam(parameters, lr=lr, foreach=True, capturable=cuda)


class FusedRAdam(torch.optim.Adam):
    """RAdam by the fused kernel of Adam, one pass over the weights on a CPU instead of fourteen.

    RAdam's step is Adam's with a step size that depends on the number of steps alone; in the first
    five steps, where the variance is not yet known, it is one along the mean of the gradients.

    Source: Liu et al., arXiv 1908.03265, algorithm 2; equal to ``torch.optim.RAdam``.
    """

    @torch.no_grad()
    def step(self, closure: Any = None) -> Any:
        """One step, as :meth:`torch.optim.Optimizer.step`."""
        loss = None if closure is None else torch.enable_grad()(closure)()
        group = self.param_groups[0]
        parameters = group["params"]
        # those that had a gradient equally often: all, but for parts that some steps do not use
        together: dict[int, list[nn.Parameter]] = {}
        for parameter in parameters:
            if parameter.grad is not None:
                steps = int(self.state.get(parameter, {}).get("step", 0))
                together.setdefault(steps + 1, []).append(parameter)
        try:
            for t, weights in together.items():
                group["params"] = weights
                self._step_number(t, group)
        finally:
            group["params"] = parameters
        return loss

    def _step_number(self, t: int, group: dict[str, Any]) -> None:
        """The step ``t`` of all weights of a group."""
        lr = group["lr"]
        eps = group["eps"]
        (beta1, beta2) = group["betas"]
        largest = 2 / (1 - beta2) - 1
        correction = 1 - beta2**t
        # of the average of squares: what the variance is known by
        length = largest - 2 * t * beta2**t / correction
        factor = (length - 4) * (length - 2) * largest / ((largest - 4) * (largest - 2) * length)
        try:
            group["lr"] = lr * math.sqrt(factor) if length > 5 else 0.0  # 0: only averages move
            group["eps"] = eps / math.sqrt(correction)
            super().step()
        finally:
            group["lr"] = lr
            group["eps"] = eps
        if length <= 5:
            for parameter in group["params"]:
                average = self.state[parameter]["exp_avg"]
                parameter.add_(average, alpha=-lr / (1 - beta1**t))


def set_learning_rate(optimizer: torch.optim.Optimizer, learning_rate: float) -> None:
    """Give every parameter group the same step size; in place where it is a tensor."""
    for group in optimizer.param_groups:
        group["lr"] = (
            group["lr"].fill_(learning_rate) if isinstance(group["lr"], Tensor) else learning_rate
        )


def share_reached(training_return: float | None, return_range: tuple[float, float]) -> float:
    """A return as a share of what a game can pay: 0 at the lowest return (and before any), 1 at the
    highest.
    """
    if training_return is None:
        return 0.0
    low, high = return_range
    return min(1.0, max(0.0, (training_return - low) / (high - low)))


def window_share(training_return: float | None, return_range: tuple[float, float]) -> float:
    """How much of the longest window the mean goes over: 0 at the lowest return, 1 at the highest.

    A game that pays from 0 on has the fourth power of the share that is reached. Where returns
    below 0 are possible the exponent is larger, four times the range over its part above 0: near
    the highest return, the window then depends on the return as in a game without them.
    """
    low, high = return_range
    exponent = 4 * (high - low) / high if low < 0 < high else 4
    return share_reached(training_return, return_range) ** exponent


def check_return_range(game: str, return_range: tuple[float, float]) -> None:
    """Raise ValueError if no share of the range can be told."""
    low, high = return_range
    if not (math.isfinite(low) and math.isfinite(high) and low < high):
        raise ValueError(
            f"average_share goes by how much of a game's return is reached, but {game} has "
            f"return_range ({low}, {high}): give the game two finite numbers, the lowest and the "
            "highest return, or set it to 0"
        )


def move_mean(mean: nn.Module, network: nn.Module, window: float) -> None:
    """Move a mean of weights towards those of the network that learns; buffers, such as statistics
    of a batch norm, are copied.

    Args:
        mean: a network whose weights are the mean.
        network: the same network, one update further.
        window: updates that the mean goes over, beside the newest; 0: no mean at all.
    """
    for old, new in zip(mean.parameters(), network.parameters(), strict=True):
        old.data.lerp_(new.data, 1 / (1 + window))
    for buffer, newest in zip(mean.buffers(), network.buffers(), strict=True):
        buffer.copy_(newest)
