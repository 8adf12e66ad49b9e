"""Learners, training loop, evaluation and checkpoints.

Public names are resolved on first use, so that importing the package costs little.

Example:
    >>> from arcade_torch.agents import preset
    >>> preset("small", env="CartPoleEasy").pqn.num_envs
    64
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

_PUBLIC = {
    "Agent": "agent",
    "CategoricalActor": "actor",
    "CheckpointError": "checkpoint",
    "DQNConfig": "dqn",
    "DQNLoss": "dqn",
    "EpsilonGreedyActor": "actor",
    "EvalResult": "evaluation",
    "NonFiniteError": "learner",
    "PPOConfig": "ppo",
    "PPOLoss": "ppo",
    "PQNConfig": "pqn",
    "PQNLoss": "pqn",
    "RunFolderError": "run_folder",
    "SequenceReplay": "replay",
    "TrainConfig": "config",
    "TrainResult": "loop",
    "evaluate": "evaluation",
    "gae": "targets",
    "held_out_seed": "evaluation",
    "load": "loading",
    "paper_score": "metrics",
    "preset": "presets",
    "preset_names": "presets",
    "q_lambda_return": "targets",
    "train": "loop",
    "train_seeds": "seeds",
}

if TYPE_CHECKING:
    from arcade_torch.agents.actor import CategoricalActor, EpsilonGreedyActor
    from arcade_torch.agents.agent import Agent
    from arcade_torch.agents.checkpoint import CheckpointError
    from arcade_torch.agents.config import TrainConfig
    from arcade_torch.agents.dqn import DQNConfig, DQNLoss
    from arcade_torch.agents.evaluation import EvalResult, evaluate, held_out_seed
    from arcade_torch.agents.learner import NonFiniteError
    from arcade_torch.agents.loading import load
    from arcade_torch.agents.loop import TrainResult, train
    from arcade_torch.agents.metrics import paper_score
    from arcade_torch.agents.ppo import PPOConfig, PPOLoss
    from arcade_torch.agents.pqn import PQNConfig, PQNLoss
    from arcade_torch.agents.presets import preset, preset_names
    from arcade_torch.agents.replay import SequenceReplay
    from arcade_torch.agents.run_folder import RunFolderError
    from arcade_torch.agents.seeds import train_seeds
    from arcade_torch.agents.targets import gae, q_lambda_return

__all__ = [
    "Agent",
    "CategoricalActor",
    "CheckpointError",
    "DQNConfig",
    "DQNLoss",
    "EpsilonGreedyActor",
    "EvalResult",
    "NonFiniteError",
    "PPOConfig",
    "PPOLoss",
    "PQNConfig",
    "PQNLoss",
    "RunFolderError",
    "SequenceReplay",
    "TrainConfig",
    "TrainResult",
    "evaluate",
    "gae",
    "held_out_seed",
    "load",
    "paper_score",
    "preset",
    "preset_names",
    "q_lambda_return",
    "train",
    "train_seeds",
]


if not TYPE_CHECKING:  # a checker is to find misspelt names

    def __getattr__(name: str) -> Any:
        """Import a public name when it is first asked for (PEP 562)."""
        if name not in _PUBLIC:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}; public names: {', '.join(__all__)}")
        value = getattr(import_module(f"{__name__}.{_PUBLIC[name]}"), name)
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    """Public names, for completion."""
    return sorted(__all__)
