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
    "CheckpointError": "checkpoint",
    "EpsilonGreedyActor": "actor",
    "EvalResult": "evaluation",
    "NonFiniteError": "learner",
    "PQNConfig": "pqn",
    "PQNLoss": "pqn",
    "RunFolderError": "run_folder",
    "TrainConfig": "config",
    "TrainResult": "loop",
    "evaluate": "evaluation",
    "held_out_seed": "evaluation",
    "load": "loading",
    "paper_score": "metrics",
    "preset": "config",
    "preset_names": "config",
    "q_lambda_return": "targets",
    "train": "loop",
}

if TYPE_CHECKING:
    from arcade_torch.agents.actor import EpsilonGreedyActor
    from arcade_torch.agents.agent import Agent
    from arcade_torch.agents.checkpoint import CheckpointError
    from arcade_torch.agents.config import TrainConfig, preset, preset_names
    from arcade_torch.agents.evaluation import EvalResult, evaluate, held_out_seed
    from arcade_torch.agents.learner import NonFiniteError
    from arcade_torch.agents.loading import load
    from arcade_torch.agents.loop import TrainResult, train
    from arcade_torch.agents.metrics import paper_score
    from arcade_torch.agents.pqn import PQNConfig, PQNLoss
    from arcade_torch.agents.run_folder import RunFolderError
    from arcade_torch.agents.targets import q_lambda_return

__all__ = [
    "Agent",
    "CheckpointError",
    "EpsilonGreedyActor",
    "EvalResult",
    "NonFiniteError",
    "PQNConfig",
    "PQNLoss",
    "RunFolderError",
    "TrainConfig",
    "TrainResult",
    "evaluate",
    "held_out_seed",
    "load",
    "paper_score",
    "preset",
    "preset_names",
    "q_lambda_return",
    "train",
]


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
