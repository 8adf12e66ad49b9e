"""A trained agent: a network, the config it was trained with, and how it acts."""

from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torch import Tensor

from arcade_torch.agents.algorithms import ALGORITHMS, Network
from arcade_torch.agents.config import TrainConfig
from arcade_torch.models.actor_critic import ActorCriticNetwork
from arcade_torch.models.encoders import Encoder


@dataclass(frozen=True)
class Agent:
    """A network that acts greedily; also an ``Actor`` that ``ArcadeCollector`` takes as its policy.

    Attributes:
        config: of the run that trained it.
        network: on its device; see :meth:`outputs` for what its outputs mean.
        frames: training frames behind it.
    """

    config: TrainConfig
    network: Network
    frames: int = 0

    @property
    def offers(self) -> tuple[str, ...]:
        """What :meth:`outputs` can be asked for: ("q", "value") or ("logits", "probs", "value")."""
        return ALGORITHMS[self.config.algorithm].offers

    def initial_state(self, batch_size: int) -> TensorDictBase:
        """Recurrent state before the first observation, TensorDict [N]."""
        state: TensorDictBase = self.network.initial_state(batch_size)
        return state

    def act(self, obs: TensorDictBase, state: TensorDictBase) -> tuple[Tensor, dict[str, Tensor], TensorDictBase]:
        """Greedy actions: the best Q-value, or the most likely action of a policy.

        Args:
            obs: root entries ``pixels`` [N, ...], ``last_action`` int64 [N], ``is_init`` bool [N, 1].
            state: recurrent state, TensorDict [N].

        Returns:
            ``(action int64 [N], extras, new state)``, with the extras ``q_value`` float32 [N, A], or ``logits`` [N, A]
            and ``state_value`` [N].
        """
        return ALGORITHMS[self.config.algorithm].make_actor(self.network, None).act(obs, state)

    def outputs(self, out: Tensor, what: str) -> Tensor:
        """Read what the network gave (by its call or its ``remember``) as one of :attr:`offers`.

        Args:
            out: float [..., R].
            what: ``"q"``: Q-values; ``"logits"``, ``"probs"``: of the actions; ``"value"``: of the state (for a network
                of Q-values, the best of them).

        Returns:
            float [..., A], for ``"value"`` [..., 1].

        Raises:
            ValueError: this agent does not offer it.

        Example:
            >>> from arcade_torch.agents import preset
            >>> config = preset("small", memory="gru")
            >>> Agent(config, build_network(config)).outputs(torch.tensor([1.0, 3.0, 2.0]), "value")
            tensor([3.])
        """
        if what not in self.offers:
            raise ValueError(f"this {self.config.algorithm} agent offers {', '.join(self.offers)}, not {what!r}")
        if isinstance(self.network, ActorCriticNetwork):
            return self.network.select(out, what)
        return out.amax(-1, keepdim=True) if what == "value" else out


def build_network(config: TrainConfig) -> Network:
    """The freshly initialised network of a config; the same seed gives the same weights, and no global draw moves.

    Args:
        config: of the run.

    Returns:
        The network, on ``config.device``.
    """
    make = ALGORITHMS[config.algorithm].make_network
    with torch.random.fork_rng(devices=[]):
        torch.default_generator.manual_seed(config.seed)
        network = make(config.network, memory=config.memory, obs_size=config.obs_size, **dict(config.network_options))
    for module in network.modules():
        if isinstance(module, Encoder):
            module.amp = config.amp
    return network.to(config.device)
