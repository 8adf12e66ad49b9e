"""Learners, training loop, evaluation and checkpoints.

Public names are resolved on first use, so that importing the package costs little.

Example:
    >>> from arcade_torch.agents import preset
    >>> preset("small", env="CartPoleEasy").ppo.num_envs
    64
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

_MODULES = {
    "config": ("DQNConfig", "PPOConfig", "PQNConfig", "TrainConfig"),
    "dqn": ("DQN", "DQNLoss"),
    "evaluation": ("EvalResult", "evaluate", "held_out_seed"),
    "learner": ("NonFiniteError",),
    "metrics": ("paper_score",),
    "policy": ("Agent", "build_network", "load", "make_actor", "make_policy"),
    "ppo": ("PPO", "PPOLoss"),
    "pqn": ("PQN", "PQNLoss"),
    "pretrained": ("from_pretrained",),
    "presets": ("preset", "preset_names"),
    "replay": ("SequenceReplay",),
    "replay_check": ("check_replay",),
    "returns": ("QLambdaEstimator", "SequenceGAE", "gae", "q_lambda_return"),
    "runs.files": ("CheckpointError",),
    "runs.folder": ("RunFolderError",),
    "runs.shipped": ("pretrained_names",),
    "trainer": ("Trainer",),
    "training": ("TrainResult", "train"),
}
_PUBLIC = {name: module for module, names in _MODULES.items() for name in names}

if TYPE_CHECKING:
    from arcade_torch.agents.config import DQNConfig, PPOConfig, PQNConfig, TrainConfig
    from arcade_torch.agents.dqn import DQN, DQNLoss
    from arcade_torch.agents.evaluation import EvalResult, evaluate, held_out_seed
    from arcade_torch.agents.learner import NonFiniteError
    from arcade_torch.agents.metrics import paper_score
    from arcade_torch.agents.policy import Agent, build_network, load, make_actor, make_policy
    from arcade_torch.agents.ppo import PPO, PPOLoss
    from arcade_torch.agents.pqn import PQN, PQNLoss
    from arcade_torch.agents.presets import preset, preset_names
    from arcade_torch.agents.pretrained import from_pretrained
    from arcade_torch.agents.replay import SequenceReplay
    from arcade_torch.agents.replay_check import check_replay
    from arcade_torch.agents.returns import QLambdaEstimator, SequenceGAE, gae, q_lambda_return
    from arcade_torch.agents.runs.files import CheckpointError
    from arcade_torch.agents.runs.folder import RunFolderError
    from arcade_torch.agents.runs.shipped import pretrained_names
    from arcade_torch.agents.trainer import Trainer
    from arcade_torch.agents.training import TrainResult, train

__all__ = [
    "DQN", "PPO", "PQN", "Agent", "CheckpointError", "DQNConfig", "DQNLoss", "EvalResult",
    "NonFiniteError", "PPOConfig", "PPOLoss", "PQNConfig", "PQNLoss", "QLambdaEstimator",
    "RunFolderError", "SequenceGAE", "SequenceReplay", "TrainConfig", "TrainResult", "Trainer",
    "build_network", "check_replay", "evaluate", "from_pretrained", "gae", "held_out_seed", "load",
    "make_actor", "make_policy", "paper_score", "preset", "preset_names", "pretrained_names",
    "q_lambda_return", "train",
]  # fmt: skip


if not TYPE_CHECKING:  # a checker is to find misspelt names

    def __getattr__(name: str) -> Any:
        """Import a public name when it is first asked for (PEP 562)."""
        if name not in _PUBLIC:
            raise AttributeError(
                f"module {__name__!r} has no attribute {name!r}; public names: {', '.join(__all__)}"
            )
        return getattr(import_module(f"{__name__}.{_PUBLIC[name]}"), name)


def __dir__() -> list[str]:
    """Public names, for completion."""
    return sorted(__all__)
