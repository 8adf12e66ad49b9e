"""One update of several seeds of PQN: one pass and one optimiser for all, every number as in a run alone."""

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from arcade_torch.agents.learner import NonFiniteError, guard, minibatch_rows
from arcade_torch.agents.optim import make_optimizer, set_learning_rate
from arcade_torch.agents.pqn import PQNConfig, PQNLoss
from arcade_torch.models.networks import MemoryNetwork
from arcade_torch.models.stacked import StackedNetworks

_COMMON = ("step",)  # of an optimiser's state: what is no number of a weight, and the same for all networks


class SeedLearner:
    """PQN for G networks at once; rows of a batch are grouped by network.

    Each network has its own minibatches, targets, loss and limit on its gradient. RAdam works on every number by
    itself, so that one over stacked weights is G of them.

    Args:
        stack: the networks.
        networks: the same, one by one.
        seeds: of the networks, for messages.
        config: numbers of the learner.
        total_frames: of one run, for the schedules.
        generators: CPU generators of the minibatch orders.
    """

    def __init__(
        self,
        stack: StackedNetworks,
        networks: Sequence[MemoryNetwork],
        seeds: Sequence[int],
        config: PQNConfig,
        total_frames: int,
        generators: Sequence[torch.Generator],
    ) -> None:
        self.networks, self.seeds, self.numbers = networks, seeds, config
        self.total_frames, self.generators = total_frames, generators
        self.loss = PQNLoss(stack, config.gamma, config.lam, config.time_limit, config.bootstrap)
        self.parameters = [p for p in stack.parameters() if p.requires_grad]
        self.optimizer = make_optimizer(self.parameters, config.learning_rate)
        self.grad_steps = 0

    def learn(self, batch: TensorDictBase, frames: int) -> list[dict[str, float]]:
        """Learn from one window of sequences.

        Args:
            batch: sequences [G * num_envs].
            frames: frames of one run counted before this window.

        Returns:
            For each network what ``Learner.learn`` returns.

        Raises:
            NonFiniteError: a reward, a loss, a gradient or a weight is not finite; names seed and gradient step.
        """
        size, numbers = len(self.networks), self.numbers
        finite = batch.get(("next", "reward")).isfinite().reshape(size, -1).all(1).tolist()
        if not all(finite):
            raise NonFiniteError(f"seed {self.seeds[finite.index(False)]}: a reward is not finite")
        window = self.loss.read(batch)
        orders = [minibatch_rows(numbers, numbers.num_envs, generator) for generator in self.generators]
        records: list[Tensor] = []
        rate = numbers.learning_rate
        for step, parts in enumerate(zip(*orders, strict=True)):
            share = step / numbers.grad_steps_per_update
            rate = numbers.learning_rate_at(frames + numbers.frames_per_update * share, self.total_frames)
            set_learning_rate(self.optimizer, rate)
            rows = [group * numbers.num_envs + row for group, part in enumerate(parts) for row in part]
            out = self.loss.compute(window.rows(rows))
            self.optimizer.zero_grad()
            (out.loss * size).backward()  # the loss is a mean over all groups, which are equally large
            norm = clip_each(self.parameters, numbers.max_grad_norm)
            self.optimizer.step()
            chosen, error = out.chosen.reshape(size, -1), (out.chosen - out.target).reshape(size, -1)
            mean_loss = 0.5 * error.square().mean(1)
            records.append(torch.stack((mean_loss, norm, chosen.mean(1), error.abs().mean(1))))
        self.grad_steps += len(records)
        table = torch.stack(records).cpu()  # [gradient steps, numbers, G]
        return [self._metrics(group, table[..., group]) | {"lr": rate} for group in range(size)]

    def _metrics(self, group: int, table: Tensor) -> dict[str, float]:
        try:
            guard(table, self.networks[group])
        except NonFiniteError as error:
            raise NonFiniteError(f"seed {self.seeds[group]}: {error}") from error
        names = ("loss", "grad_norm", "q_mean", "td_error")
        return dict(zip(names, table.mean(0).tolist(), strict=True))

    def state_dict(self, group: int) -> dict[str, Any]:
        """What ``Learner.state_dict`` of one network alone would give."""
        whole = self.optimizer.state_dict()
        state = {
            index: {name: value if name in _COMMON else value[group] for name, value in numbers.items()}
            for index, numbers in whole["state"].items()
        }
        return {"optimizer": {**whole, "state": state}, "grad_steps": self.grad_steps}

    def load_state_dicts(self, states: Sequence[dict[str, Any]]) -> None:
        """Go back to a saved moment; the weights are loaded elsewhere.

        Args:
            states: for each network what its ``state_dict`` gave, here or alone.

        Raises:
            ValueError: they are not of one moment.
        """
        steps = sorted({state["grad_steps"] for state in states})
        if len(steps) != 1:
            raise ValueError(f"the seeds have made different numbers of gradient steps: {', '.join(map(str, steps))}")
        first = states[0]["optimizer"]
        parts = [state["optimizer"]["state"] for state in states]
        joined = {
            index: {
                name: value if name in _COMMON else torch.stack([part[index][name] for part in parts])
                for name, value in numbers.items()
            }
            for index, numbers in parts[0].items()
        }
        self.optimizer.load_state_dict({**first, "state": joined})
        self.grad_steps = steps[0]


def clip_each(parameters: Sequence[Tensor], max_norm: float) -> Tensor:
    """Scale the gradients of every network so that their joint norm is at most ``max_norm``.

    Args:
        parameters: stacked parameters, [G, ...] each; those without a gradient are skipped.
        max_norm: largest allowed Euclidean norm of one network's gradients, > 0.

    Returns:
        float32 [G], the norms before clipping.

    Example:
        >>> weight = torch.nn.Parameter(torch.zeros(2, 1))
        >>> weight.grad = torch.tensor([[3.0], [0.5]])
        >>> clip_each([weight], 1.0)
        tensor([3.0000, 0.5000])
        >>> weight.grad.flatten()
        tensor([1.0000, 0.5000])
    """
    gradients = [p.grad for p in parameters if p.grad is not None]
    norms = torch.stack([torch.linalg.vector_norm(g.reshape(len(g), -1), dim=1) for g in gradients])
    norm: Tensor = torch.linalg.vector_norm(norms, dim=0)
    scale = (max_norm / (norm + 1e-6)).clamp_max(1.0)  # as clip_grad_norm_ has it
    for gradient in gradients:
        gradient.mul_(scale.reshape(-1, *[1] * (gradient.ndim - 1)))
    return norm
