"""What the agents ask of others: a recurrent network of Q-values, or of logits and a value, and a player."""

from typing import Protocol

from tensordict import TensorDictBase
from torch import Tensor


class QNetwork(Protocol):
    """The part of ``MemoryNetwork`` that acting and learning use; a module of yours needs these four methods."""

    def __call__(
        self, pixels: Tensor, last_action: Tensor, is_init: Tensor, state: TensorDictBase
    ) -> tuple[Tensor, TensorDictBase]:
        """Encode and remember: pixels [B, T, ...] to Q-values float [B, T, A] and the state after the last step."""
        ...

    def encode(self, pixels: Tensor) -> Tensor:
        """Features float [..., E] of frames uint8 [..., S, S, C], each on its own."""
        ...

    def remember(
        self, features: Tensor, last_action: Tensor, is_init: Tensor, state: TensorDictBase
    ) -> tuple[Tensor, TensorDictBase]:
        """Q-values float [B, T, A] of features [B, T, E], and the state after the last step; causal in time.

        ``last_action`` is int64 [B, T], ``is_init`` bool [B, T] (forget everything before reading that step), ``state``
        TensorDict [B].
        """
        ...

    def initial_state(self, batch_size: int, /) -> TensorDictBase:
        """State before the first observation, TensorDict [B]."""
        ...


class ActorCritic(QNetwork, Protocol):
    """The part of ``ActorCriticNetwork`` that PPO uses: outputs are A logits and a value, the critic can run alone.

    The state has the entries "actor" and "critic"; ``critic`` reads the second and gives float [B, T, 1].
    """

    @property
    def critic(self) -> QNetwork:
        """The tower of the value."""
        ...

    def split(self, out: Tensor, /) -> tuple[Tensor, Tensor]:
        """Output float [..., A + 1] as (logits [..., A], value [...])."""
        ...


class Player(Protocol):
    """What can be evaluated: acts, and carries a recurrent state."""

    def initial_state(self, batch_size: int, /) -> TensorDictBase:
        """State before the first observation, TensorDict [N]."""
        ...

    def act(self, obs: TensorDictBase, state: TensorDictBase, /) -> tuple[Tensor, dict[str, Tensor], TensorDictBase]:
        """Action int64 [N], extras, new state."""
        ...
