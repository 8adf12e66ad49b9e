"""``arcade-torch evaluate``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import tyro

from arcade_torch.tools.files import write_json


@dataclass
class Evaluate:
    """Play greedy episodes with a trained agent on held-out seeds and print the mean return.

    Example: arcade-torch evaluate runs/one --episodes 256 --observability full
    """

    run_folder: tyro.conf.PositionalRequiredArgs[tyro.conf.Positional[Path]]
    """Run folder or checkpoint."""
    episodes: int = 128
    """Number of episodes, each in an environment of its own."""
    observability: Literal["full", "partial"] | None = None
    """Another twin than the agent was trained on."""
    json: Path | None = None
    """File for the numbers; not overwritten."""

    def run(self) -> int:
        """Evaluate and print."""
        from arcade_torch.agents import evaluate, load

        if self.json is not None and self.json.exists():
            raise FileExistsError(f"{self.json} exists: choose another file")
        agent = load(self.run_folder)
        more: dict[str, Any] = {} if self.observability is None else {"observability": self.observability}
        result = evaluate(agent, episodes=self.episodes, **more)
        returns = [float(value) for value in result.returns]
        mean, half = mean_and_half_width(returns)
        twin = self.observability or agent.config.observability
        config = agent.config
        print(
            f"{config.env} ({twin}), {config.algorithm} {config.memory}, {agent.frames:,} frames of training: "
            f"mean return {mean:.3f} +- {half:.3f} (95 %) over {len(returns)} episodes"
        )
        if self.json is not None:
            lengths = [int(value) for value in result.lengths]
            write_json(self.json, {"returns": returns, "lengths": lengths, "mean": mean, "half_width_95": half})
        return 0


def mean_and_half_width(values: list[float]) -> tuple[float, float]:
    """Mean and half the width of its normal 95 % interval (0 for a single value).

    Example:
        >>> mean_and_half_width([1.0, 1.0])
        (1.0, 0.0)
    """
    count = len(values)
    mean = sum(values) / count
    if count < 2:
        return mean, 0.0
    variance = sum((value - mean) ** 2 for value in values) / (count - 1)
    return mean, float(1.96 * (variance / count) ** 0.5)


COMMAND = Evaluate
