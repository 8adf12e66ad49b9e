"""``arcade-torch evaluate``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import tyro

from arcade_torch.agents.runs.files import write_json


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
        twin, config = self.observability or agent.config.observability, agent.config
        print(
            f"{config.env} ({twin}), {config.algorithm} {config.memory}, {agent.frames:,} frames of training: "
            f"mean return {result.mean:.3f} +- {result.ci:.3f} (95 %) over {len(result.returns)} episodes"
        )
        if self.json is not None:
            found = {"returns": result.returns.tolist(), "lengths": result.lengths.tolist()}
            write_json(self.json, found | {"mean": result.mean, "half_width_95": result.ci})
        return 0


COMMANDS = {"evaluate": Evaluate}
