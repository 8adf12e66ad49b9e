"""Our memories in Stable-Baselines3: policies for ``RecurrentPPO`` of sb3-contrib in which any
memory model stands where the LSTM was.

    from sb3_contrib import RecurrentPPO
    from arcade_torch.models.sb3 import MemoryPolicy

    model = RecurrentPPO(MemoryPolicy, env, policy_kwargs={"memory": "lru"})

``RecurrentPPO`` keeps two arrays of floats a step, an LSTM's. Here the first one holds the whole
state of the memory, whatever it is made of, and the second is empty. Episodes begin as everywhere
in this package: what came before a start flag is forgotten, inside a sequence too, and the sequence
is still read at once.
"""

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from arcade_torch.models.flat_state import flatten_state, unflatten_state
from arcade_torch.models.registry import make_memory

try:
    from sb3_contrib.common.recurrent.policies import (
        RecurrentActorCriticCnnPolicy,
        RecurrentActorCriticPolicy,
        RecurrentMultiInputActorCriticPolicy,
    )
except ImportError as error:  # the hint works in a checkout
    raise ImportError("the package sb3-contrib is missing: pip install '.[sb3]'") from error

__all__ = ["CnnMemoryPolicy", "FlatMemory", "MemoryPolicy", "MultiInputMemoryPolicy"]


class FlatMemory(nn.Module):
    """A memory whose state is one tensor of floats, with the attributes of an ``nn.LSTM`` that
    ``RecurrentPPO`` reads.

    A row of the state is a 1 and then all entries of the memory's state. A row of zeros, which is
    what Stable-Baselines3 begins with, stands for the initial state.

    Args:
        memory: any memory model (``MemoryContract``).
        input_size: D.

    Attributes:
        hidden_size: F, floats of a state.
        num_layers: always 1.
    """

    num_layers = 1

    def __init__(self, memory: nn.Module, input_size: int) -> None:
        super().__init__()
        self.memory = memory
        self.input_size = input_size
        self.hidden_size = self.flatten(memory.initial_state(1)).shape[-1]  # type: ignore[operator]

    def forward(self, x: Tensor, flat: Tensor, is_init: Tensor) -> tuple[Tensor, Tensor]:
        """Read sequences.

        Args:
            x: float [B, T, D].
            flat: float [B, F], the states before step 0.
            is_init: bool [B, T].

        Returns:
            (float [B, T, H], float [B, F] after the last step).
        """
        is_empty = flat[:, :1] == 0
        first = torch.cat([is_init[:, :1] | is_empty, is_init[:, 1:]], dim=1)
        y, state = self.memory(x, self.unflatten(flat), first)
        return y, self.flatten(state)

    def flatten(self, state: TensorDictBase) -> Tensor:
        """A state [B] as float [B, F]."""
        numbers = flatten_state(state)
        return torch.cat([numbers.new_ones(len(state), 1), numbers], dim=1)

    def unflatten(self, flat: Tensor) -> TensorDictBase:
        """The inverse of :meth:`flatten`."""
        example = self.memory.initial_state(len(flat))  # type: ignore[operator]
        return unflatten_state(flat[:, 1:], example)


class MemoryPolicy(RecurrentActorCriticPolicy):
    """``MlpLstmPolicy`` with a memory of this package, for observations that are vectors.

    Args:
        *args: those of the policy.
        memory: a name (:func:`memory_names`) or a factory ``(input_size, hidden_size, **options) ->
            nn.Module``.
        memory_options: options of the memory.
        lstm_hidden_size: H, features of the memory's output.
        **kwargs: those of the policy; ``n_lstm_layers`` is 1.

    Raises:
        ValueError: an unknown memory, or several layers.
        TypeError: an option that the memory does not have.
    """

    def __init__(
        self,
        observation_space: Any,
        action_space: Any,
        lr_schedule: Any,
        *args: Any,
        memory: str | Callable[..., nn.Module] = "lru",
        memory_options: dict[str, Any] | None = None,
        lstm_hidden_size: int = 128,
        **kwargs: Any,
    ) -> None:
        if kwargs.get("n_lstm_layers", 1) != 1:
            raise ValueError(
                f"n_lstm_layers is {kwargs['n_lstm_layers']}, expected 1: pass memory= a factory "
                "that stacks layers, such as arcade_torch.models.MemoryBlock"
            )
        kwargs["lstm_hidden_size"] = lstm_hidden_size
        super().__init__(observation_space, action_space, lr_schedule, *args, **kwargs)
        self.memory = memory
        self.memory_options = memory_options or {}
        self.lstm_actor: Any = self._make_memory()
        if self.lstm_critic is not None:
            self.lstm_critic: Any = self._make_memory()
        self.lstm_hidden_state_shape = (1, 1, self.lstm_actor.hidden_size)
        self.optimizer = self.optimizer_class(
            self.parameters(),
            lr=lr_schedule(1),  # type: ignore[call-arg]
            **self.optimizer_kwargs,
        )

    def _make_memory(self) -> FlatMemory:
        sizes = (self.features_dim, self.lstm_output_dim)
        if callable(self.memory):
            memory = self.memory(*sizes, **self.memory_options)
        else:
            memory = make_memory(self.memory, *sizes, **self.memory_options)
        return FlatMemory(memory, self.features_dim)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data: dict[str, Any] = super()._get_constructor_parameters()
        data["memory"] = self.memory
        data["memory_options"] = self.memory_options
        data["lstm_hidden_size"] = self.lstm_output_dim
        data["shared_lstm"] = self.shared_lstm
        data["enable_critic_lstm"] = self.enable_critic_lstm
        return data

    @staticmethod
    def _process_sequence(  # type: ignore[override]
        features: Tensor,
        lstm_states: tuple[Tensor, Tensor],
        episode_starts: Tensor,
        lstm: FlatMemory,
    ) -> tuple[Tensor, tuple[Tensor, Tensor]]:
        """Read sequences that stand one after the other, [B * T, D], from states [1, B, F]."""
        flat = lstm_states[0].squeeze(0)
        x = features.reshape(len(flat), -1, lstm.input_size)
        is_init = episode_starts.reshape(len(flat), -1) > 0.5
        y, after = lstm(x, flat, is_init)
        after = after.unsqueeze(0)
        return y.flatten(0, 1), (after, torch.zeros_like(after))


class CnnMemoryPolicy(MemoryPolicy, RecurrentActorCriticCnnPolicy):
    """``CnnLstmPolicy`` with a memory: for frames."""


class MultiInputMemoryPolicy(MemoryPolicy, RecurrentMultiInputActorCriticPolicy):
    """``MultiInputLstmPolicy`` with a memory: for dictionaries of observations."""
