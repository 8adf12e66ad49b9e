"""Acting: epsilon-greedy with a recurrent Q-network, or by sampling a recurrent policy."""

from collections.abc import Callable, Sequence
from functools import partial

import torch
from tensordict import TensorDictBase
from torch import Tensor

from arcade_torch.agents.protocols import ActorCritic, QNetwork

Step = Callable[[Tensor, Tensor, Tensor, TensorDictBase], tuple[Tensor, TensorDictBase]]
"""``(pixels [N, ...], last_action int64 [N], is_init bool [N, 1], state [N]) -> (outputs [N, A], state [N])``."""


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

    ``actor.uniform = True`` makes every action random until it is taken back, as epsilon 1 does. ``actor.step`` is what
    runs the network, a :data:`Step`; assign another way of running the same one.

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
        self.greedy, self.record_q, self.uniform = greedy, record_q, False
        self.step: Step = partial(_one_step, network)

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
        q, state = self.step(*_seen(obs), state)
        action = q.argmax(-1)
        if not self.greedy:
            action = self._explore(action, q.shape[-1])
        return action, {"q_value": q} if self.record_q else {}, state

    def _explore(self, action: Tensor, num_actions: int) -> Tensor:
        return _perturbed(action, num_actions, 1.0 if self.uniform else self.epsilon, self.generator)


class GroupedEpsilonGreedyActor(EpsilonGreedyActor):
    """:class:`EpsilonGreedyActor` for groups of rows, each of which draws from a generator of its own.

    Args:
        network: reads the rows of all groups, such as ``StackedNetworks``.
        generators: one a group; the rows are split evenly among them.
    """

    def __init__(self, network: QNetwork, generators: Sequence[torch.Generator]) -> None:
        super().__init__(network, generator=generators[0])
        self.generators = tuple(generators)

    def _explore(self, action: Tensor, num_actions: int) -> Tensor:
        epsilon, groups = 1.0 if self.uniform else self.epsilon, action.chunk(len(self.generators))
        drawn = zip(groups, self.generators, strict=True)
        return torch.cat([_perturbed(group, num_actions, epsilon, generator) for group, generator in drawn])


class CategoricalActor:
    """The policy of an actor-critic network: a draw from its softmax, or its most likely action.

    Follows the ``Actor`` protocol of ``ArcadeCollector``. Draws come from a generator of its own.

    Args:
        network: an ``ActorCriticNetwork``, or any module with its ``forward``, ``split`` and ``initial_state``.
        generator: source of the draws, on the device of the observations; needed unless ``greedy``.
        greedy: take the most likely action; of equal ones the lowest number.

    ``actor.uniform = True`` makes every action uniformly random until it is taken back; the recorded log-probabilities
    are then still those of the policy. ``actor.step`` is what runs the network, as in :class:`EpsilonGreedyActor`.

    Raises:
        ValueError: sampling was asked for without a generator.
    """

    def __init__(self, network: ActorCritic, generator: torch.Generator | None = None, greedy: bool = False) -> None:
        if generator is None and not greedy:
            raise ValueError("a sampling actor needs a torch.Generator; pass generator=, or greedy=True")
        self.network, self.generator, self.greedy, self.uniform = network, generator, greedy, False
        self.step: Step = partial(_one_step, network)

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
            ``(action int64 [N], extras, new state)`` with the extras ``state_value`` float32 [N] and, if greedy,
            ``logits`` float32 [N, A], else ``action_log_prob`` float32 [N].
        """
        out, state = self.step(*_seen(obs), state)
        logits, value = self.network.split(out)
        if self.greedy:
            return logits.argmax(-1), {"logits": logits, "state_value": value}, state
        log_prob = logits.log_softmax(-1)
        # The largest of log p plus Gumbel noise is a draw from p; NaN gives some action, and is found while learning.
        noise = torch.empty_like(log_prob).exponential_(generator=self.generator).log()
        action = (torch.zeros_like(log_prob) if self.uniform else log_prob).sub(noise).argmax(-1)
        taken = log_prob.gather(-1, action.unsqueeze(-1)).squeeze(-1)
        return action, {"action_log_prob": taken, "state_value": value}, state


def _perturbed(action: Tensor, num_actions: int, epsilon: float, generator: torch.Generator | None) -> Tensor:
    """Replace each action by a uniform one with probability epsilon; always two draws, whatever epsilon is."""
    shape, device = action.shape, action.device
    coin = torch.rand(shape, generator=generator, device=device)
    other = torch.randint(num_actions, shape, generator=generator, device=device)
    return torch.where(coin < epsilon, other, action)


def _seen(obs: TensorDictBase) -> tuple[Tensor, Tensor, Tensor]:
    return obs.get("pixels"), obs.get("last_action"), obs.get("is_init")


def _one_step(
    network: QNetwork, pixels: Tensor, last_action: Tensor, is_init: Tensor, state: TensorDictBase
) -> tuple[Tensor, TensorDictBase]:
    """Outputs [N, A] of a network for one observation of every environment, and the state after it."""
    steps = pixels.shape[0], 1
    out, state = network(pixels.unsqueeze(1), last_action.reshape(steps), is_init.reshape(steps), state)
    return out.squeeze(1), state
