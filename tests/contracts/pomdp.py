"""A small POMDP with both kinds of end, and recurrent networks for it: what the tests of TorchRL's
losses share.
"""

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.modules import EGreedyModule, GRUModule, QValueModule

from arcade_torch.agents.policy import make_actor
from arcade_torch.collector import ArcadeCollector
from arcade_torch.compiled import CompiledGame
from arcade_torch.env import ArcadeEnv
from arcade_torch.models import make_network
from arcade_torch.models.encoders import Encoder
from tests.arcade_torch.stub import StubGame

GAME = CompiledGame(StubGame(risk=0.1, max_steps=5))
ENVS, STEPS, HIDDEN, ACTIONS = 4, 12, 16, 5
CONTROL = "GRUModule"


class Eye(Encoder):
    """Frames of 8 x 8 pixels to 8 features."""

    def __init__(self, obs_size: int = 8) -> None:
        super().__init__(obs_size, obs_size, 8)
        self.linear = nn.Linear(obs_size * obs_size * 3, 8)

    def features(self, frames: Tensor) -> Tensor:
        return torch.tanh(self.linear(frames.flatten(1).to(self.like.dtype) / 255))


def network(
    memory: str, out_key: str = "action_value", tower: str = "value", store: str = "step"
) -> nn.Module:
    """Encoder, memory ("block" in the names of its parameters) and head; with TorchRL's GRU if
    asked for.
    """
    outputs = 1 if out_key == "state_value" else ACTIONS
    if memory == CONTROL:
        keys = {
            "in_keys": ["features", ("memory", tower), "is_init"],
            "out_keys": ["remembered", ("next", "memory", tower)],
        }
        block = GRUModule(input_size=8, hidden_size=HIDDEN, **keys)
        return TensorDictSequential(
            TensorDictModule(Eye(), ["pixels"], ["features"]),
            block,
            TensorDictModule(nn.Linear(HIDDEN, outputs), ["remembered"], [out_key]),
        )
    return make_network(
        "small",
        memory,
        obs_size=8,
        encoder=Eye,
        hidden_size=HIDDEN,
        num_outputs=outputs,
        out_key=out_key,
        state_key=("memory", tower),
        store=store,  # type: ignore[arg-type]
        memory_options={"window": 4} if memory == "attention" else None,
    )


def q_actor(memory: str, store: str = "step") -> TensorDictSequential:
    return TensorDictSequential(
        network(memory, store=store), QValueModule(action_space="categorical")
    )


def make_env(seed: int = 2) -> ArcadeEnv:
    return ArcadeEnv(GAME, ENVS, observability="partial", seed=seed)


def collected(policy: nn.Module, seed: int = 2, windows: int = 2) -> TensorDictBase:
    """The last of some windows [ENVS, STEPS] in TorchRL's layout: next frames, and the state of
    every step.
    """
    collector = ArcadeCollector(make_env(seed), policy, ENVS * STEPS, windows * ENVS * STEPS)
    batch = list(collector)[-1]
    inside = batch["next"][:, 1:-1]
    assert (inside["truncated"] & ~inside["terminated"]).any() and inside["terminated"].any()
    assert not batch["is_init"][:, 0].all()  # some row goes on with what it remembers
    return batch


def explorer(memory: str) -> tuple[TensorDictSequential, TensorDictSequential]:
    """A network of Q-values with a greedy head, and the same with random actions in between."""
    greedy = q_actor(memory)
    return greedy, TensorDictSequential(
        *greedy, EGreedyModule(spec=make_env().action_spec_unbatched, eps_init=0.5)
    )


def actor_critic(memory: str) -> tuple[nn.Module, nn.Module, TensorDictSequential]:
    """A stochastic actor, a critic, and both in a row for the collector."""
    actor, critic = (
        make_actor(network(memory, "logits", "actor")),
        network(memory, "state_value", "critic"),
    )
    return actor, critic, TensorDictSequential(critic, actor)
