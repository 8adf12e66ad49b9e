"""Epsilon-greedy acting with a recurrent Q-network."""

import torch
from tensordict import TensorDictBase
from torch import Tensor

from arcade_torch.agents.protocols import QNetwork


class EpsilonGreedyActor:
    """The policy of a Q-network: the best action, or with probability ``epsilon`` a uniform one.

    Follows the ``Actor`` protocol of ``ArcadeCollector``: the recurrent state is an argument and a result, never
    hidden. A random action may coincide with the best one; equal values go to the lowest action number. Draws come
    from a generator of its own, so nothing else shifts them.

    Args:
        network: a ``MemoryNetwork``, or any module with its ``forward`` and ``initial_state``.
        epsilon: probability of a random action, in [0, 1]; assign ``actor.epsilon`` to follow a schedule.
        generator: source of the draws, on the device of the observations; needed unless ``greedy``.
        greedy: never explore, whatever ``epsilon`` says.
        record_q: also return the Q-values, as the extra ``q_value`` float32 [N, A].

    Raises:
        ValueError: ``epsilon`` lies outside [0, 1], or exploring was asked for without a generator.
    """

    def __init__(
        self,
        network: QNetwork,
        epsilon: float = 0.0,
        generator: torch.Generator | None = None,
        greedy: bool = False,
        record_q: bool = False,
    ) -> None:
        if not 0.0 <= epsilon <= 1.0:
            raise ValueError(f"epsilon must lie in [0, 1]; got {epsilon}")
        if generator is None and not greedy:
            raise ValueError("an exploring actor needs a torch.Generator; pass generator=, or greedy=True")
        self.network, self.epsilon, self.generator = network, epsilon, generator
        self.greedy, self.record_q = greedy, record_q

    def initial_state(self, batch_size: int) -> TensorDictBase:
        """Recurrent state before the first observation, TensorDict [N]."""
        return self.network.initial_state(batch_size)

    @torch.no_grad()
    def act(self, obs: TensorDictBase, state: TensorDictBase) -> tuple[Tensor, dict[str, Tensor], TensorDictBase]:
        """Choose one action for every environment.

        Args:
            obs: root entries ``pixels`` [N, ...], ``last_action`` int64 [N], ``is_init`` bool [N, 1].
            state: recurrent state, TensorDict [N].

        Returns:
            ``(action int64 [N], extras, new state)``.
        """
        pixels, last_action, is_init = obs.get("pixels"), obs.get("last_action"), obs.get("is_init")
        steps = pixels.shape[0], 1
        q, state = self.network(pixels.unsqueeze(1), last_action.reshape(steps), is_init.reshape(steps), state)
        q = q.squeeze(1)
        action = q.argmax(-1)
        if not self.greedy:
            action = self._explore(action, q.shape[-1])
        return action, {"q_value": q} if self.record_q else {}, state

    def _explore(self, action: Tensor, num_actions: int) -> Tensor:
        """Replace each action by a uniform one with probability epsilon; always two draws, whatever epsilon is."""
        shape, device = action.shape, action.device
        coin = torch.rand(shape, generator=self.generator, device=device)
        other = torch.randint(num_actions, shape, generator=self.generator, device=device)
        return torch.where(coin < self.epsilon, other, action)
