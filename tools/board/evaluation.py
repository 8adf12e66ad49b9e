"""One agent evaluated by the protocol."""

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from arcade_torch.agents.metrics import student_half_width
from arcade_torch.agents.runs.files import checksum
from arcade_torch.tools.board.protocol import Protocol
from arcade_torch.tools.machine import torch_threads, versions

MOST_WEIGHTS = 2 * 2**30
"""Bytes of the largest weights that are hashed."""
WEIGHTS = "weights.safetensors"


@dataclass(frozen=True)
class Played:
    """What an agent scored."""

    score: float  # mean return, float64
    std: float  # sample standard deviation of the returns
    half_width: float  # half of Student's 95 % interval of the mean
    returns_sha256: str  # of returns and lengths, see `digest`
    parameters: int  # of the whole network
    state_bytes: int  # of the recurrent state of one environment
    observations: tuple[str, ...]  # what the network reads, without its recurrent state


class Evaluator:
    """Evaluates agents one after another; games that were compiled are used again.

    Agents play on the CPU with one thread, so that the same machine and versions give the same
    bits.
    """

    def __init__(self, protocol: Protocol) -> None:
        self.protocol = protocol
        self._envs: dict[str, Any] = {}

    def play(self, checkpoint: Path, twin: str) -> Played:
        """Let the agent of a checkpoint folder play greedily on one twin; raises as
        `arcade_torch.agents.load`.
        """
        from arcade_torch.agents.evaluation import evaluate
        from arcade_torch.tools.imports import import_again

        import_again(checkpoint)
        with torch_threads(1):
            agent = self._load(checkpoint)
            env = self._env(agent.config)
            observability: Any = twin
            result = evaluate(agent, observability, seed=self.protocol.seed, env=env)
        returns = result.returns.astype(np.float64)
        parameters = sum(weight.numel() for weight in agent.network.parameters())
        state = agent.initial_state(1)
        tensors = list(state.values(include_nested=True, leaves_only=True))
        return Played(
            score=float(returns.mean()),
            std=result.std,
            half_width=student_half_width(returns) if len(returns) > 1 else 0.0,
            returns_sha256=digest(result.returns, result.lengths),
            parameters=int(parameters),
            state_bytes=int(sum(part.numel() * part.element_size() for part in tensors)),
            observations=tuple(key for key in agent.in_keys if isinstance(key, str)),
        )

    def _load(self, checkpoint: Path) -> Any:
        from arcade_torch.agents.policy import load

        return load(checkpoint, "cpu")

    def _env(self, config: Any) -> Any:
        """The environments of a game, compiled once."""
        from arcade_torch.agents.evaluation import make_eval_env

        settings = replace(config, device="cpu", cuda_graphs=False, compile=False)
        key = repr((config.env, config.rules, config.obs_size, config.env_options))
        if key not in self._envs:
            self._envs.clear()  # frames of a thousand environments are not kept of every game
            self._envs[key] = make_eval_env(settings, self.protocol.episodes, "full")
        return self._envs[key]


def digest(returns: Any, lengths: Any) -> str:
    """SHA-256 of the returns, little-endian float32, followed by the lengths, little-endian int64.

    Example:
        >>> digest([0.5], [3])[:8]
        '8c298b54'
    """
    packed = np.asarray(returns, "<f4").tobytes() + np.asarray(lengths, "<i8").tobytes()
    return hashlib.sha256(packed).hexdigest()


def weights_hash(checkpoint: Path) -> str:
    """SHA-256 of the weights in a checkpoint folder, which are not loaded for it."""
    return checksum(checkpoint / WEIGHTS, MOST_WEIGHTS)


def made_with() -> dict[str, str]:
    """Versions, commit, platform and processor: where these are equal, scores are to the bit."""
    return versions() | {"processor": _processor()}


def _processor() -> str:
    """Name, family and model of the processor; empty where the system does not say."""
    about = dict[str, str]()
    try:
        with open("/proc/cpuinfo", encoding="utf-8", errors="replace") as stream:
            lines = stream.read(2**16).splitlines()
    except OSError:
        return ""
    for line in lines:
        name, _, value = line.partition(":")
        about.setdefault(name.strip(), value.strip()[:100])
    parts = [about.get(name, "") for name in ("model name", "cpu family", "model")]
    return " ".join(part for part in parts if part)
