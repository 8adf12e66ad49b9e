"""The loss of the learners of Q-values: half the mean squared distance to a lambda-return."""

from typing import NamedTuple, cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.objectives import LossModule

from arcade_torch.agents.protocols import QNetwork
from arcade_torch.agents.targets import TimeLimit, q_lambda_return
from arcade_torch.agents.window import Bootstrap, Window, WindowKeys, outputs_along, read_window


class QOutput(NamedTuple):
    """What one forward pass of the loss gives; everything but ``loss`` is detached.

    ``q_value`` float [B, L, A] are the Q-values of the observations, ``chosen`` [B, S] those of the actions taken at
    the S steps that have a target, ``target`` [B, S] these targets, ``next_value`` [B, S] the value of each true next
    observation (zeros where targets were stored).
    """

    loss: Tensor
    q_value: Tensor
    chosen: Tensor
    target: Tensor
    next_value: Tensor


class QLoss(LossModule):
    """Half the mean squared distance of Q(s, a) to its Q(lambda) return.

    In keys: ``pixels``, ``action``, ``last_action``, ``is_init``, ``("next", "reward" | "terminated" | "truncated")``,
    and

    * for sequences [B] of ``ArcadeCollector.collect()`` (or rows of them): ``initial_state``, ``next_pool``,
      ``("next", "frame_slot")``;
    * for stock TorchRL batches [B, T]: dense ``("next", "pixels")``, and the recurrent state per step under ``memory``
      (only index 0 is read; not needed where every row begins with an episode).

    Out keys: ``loss`` (scalar with gradient), ``q_mean``, ``target_mean``, ``td_error`` (mean absolute), detached.

    Rows of a batch are whole sequences; never shuffle or flatten time.

    Args:
        network: a ``MemoryNetwork``, or any module with its ``encode``, ``remember`` and ``initial_state``.
        gamma: discount.
        lam: lambda of the return.
        time_limit: see :class:`LearnerConfig`.
        bootstrap: ``"next"``: every step has a target; ``"last"``: the last step only lends its value.
    """

    _AcceptedKeys = WindowKeys
    default_keys = WindowKeys
    out_keys = ("loss", "q_mean", "target_mean", "td_error")

    network: QNetwork

    def __init__(
        self,
        network: QNetwork,
        gamma: float = 0.99,
        lam: float = 0.95,
        time_limit: TimeLimit = "bootstrap",
        bootstrap: Bootstrap = "next",
    ) -> None:
        super().__init__()
        self.network = network
        self.gamma, self.lam = gamma, lam
        self.time_limit, self.bootstrap = time_limit, bootstrap

    @property
    def functional(self) -> bool:
        """False: the network's parameters are used where they are."""
        return False

    @property
    def in_keys(self) -> list[object]:
        """Entries that every batch must hold."""
        return cast(WindowKeys, self.tensor_keys).required()

    def _forward_value_estimator_keys(self, **kwargs: object) -> None:
        """There is no separate value estimator."""

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Loss and metrics of a batch, as a TensorDict of scalars.

        Args:
            tensordict: sequences [B] or a stock batch [B, T].

        Returns:
            The out keys.

        Raises:
            ValueError: a needed next observation or recurrent state is not in the batch.
        """
        out = self.compute(self.read(tensordict))
        metrics = {
            "loss": out.loss,
            "q_mean": out.chosen.mean(),
            "target_mean": out.target.mean(),
            "td_error": (out.chosen - out.target).abs().mean(),
        }
        return TensorDict(metrics, batch_size=[])

    def read(self, tensordict: TensorDictBase) -> Window:
        """Read a batch into plain tensors once; minibatches are then ``window.rows(...)``, free of TensorDict work."""
        keys = cast(WindowKeys, self.tensor_keys)
        return read_window(tensordict, keys, self.time_limit, self.bootstrap, self.network.initial_state)

    def compute(self, window: Window) -> QOutput:
        """The loss of a window (the fast path of the training loop).

        Args:
            window: from :meth:`read`, or rows of it.

        Returns:
            Loss and its parts.
        """
        q = outputs_along(self.network, window)
        steps = window.action.shape[1] - (1 if self.bootstrap == "last" else 0)
        position = window.position[:, :steps]
        chosen = q.flatten(1).gather(1, position * q.shape[-1] + window.action[:, :steps])
        target, next_value = self.targets(window, q.detach(), steps)
        first = self.first_trained
        loss = 0.5 * nn.functional.mse_loss(chosen[:, first:], target[:, first:])
        roots = window.position.unsqueeze(-1).expand(-1, -1, q.shape[-1])
        return QOutput(loss, q.detach().gather(1, roots), chosen.detach(), target, next_value)

    @property
    def first_trained(self) -> int:
        """Index of the first step that takes part in the loss."""
        return 0

    def bootstrap_values(self, window: Window, q: Tensor) -> Tensor:
        """Value of every observation of the extended sequence, float [B, L + K]; here the best of ``q``."""
        return q.amax(-1)

    @torch.no_grad()
    def targets(self, window: Window, q: Tensor, steps: int) -> tuple[Tensor, Tensor]:
        """Lambda-returns of the first ``steps`` steps.

        Args:
            window: the experience.
            q: float [B, L + K, A], Q-values along the extended sequence.
            steps: S.

        Returns:
            (targets [B, S], values of the true next observations [B, S]).
        """
        value = self.bootstrap_values(window, q)
        following = (window.position[:, :steps] + 1).clamp_max(value.shape[1] - 1)
        next_value = value.gather(1, following)
        target = q_lambda_return(
            window.reward[:, :steps],
            next_value,
            window.terminated[:, :steps],
            window.truncated[:, :steps],
            self.gamma,
            self.lam,
            self.time_limit,
        )
        return target, next_value
