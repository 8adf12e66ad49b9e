"""A film of the agent at every greedy evaluation of its training: what it can do so far."""

import warnings
from pathlib import Path
from typing import Any

from arcade_torch.compiled import compiled_game
from arcade_torch.tools.play.session import Session
from arcade_torch.tools.record.episodes import recorded_frames
from arcade_torch.tools.record.files import writer_for
from arcade_torch.tools.record.players import Trained

FPS = 10
SEED = 2**31
"""Of the filmed episode: far from the seeds of training, the same at every evaluation, so that films compare."""


class EvaluationVideos:
    """Films one greedy episode whenever it is called; give it to ``train`` as ``on_evaluation``.

    Playing draws no random number of the training, so a run is the same to the bit with and without it. A film that
    fails is reported in a warning, and it was the last.
    """

    def __init__(self, folder: Path, suffix: str = ".gif", max_steps: int = 500) -> None:
        self.folder, self.suffix, self.max_steps = folder, suffix, max_steps
        self._write = writer_for(folder / f"film{suffix}")
        self._failed = False

    def __call__(self, agent: Any) -> None:
        """Film an agent."""
        if self._failed:
            return
        path = self.folder / f"frames-{agent.frames:09d}{self.suffix}"
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            self._film(agent, path)
        except Exception as error:  # a training is worth more than its film
            self._failed = True
            warnings.warn(f"no more films, {path.name}: {type(error).__name__}: {error}", stacklevel=2)

    def _film(self, agent: Any, path: Path) -> None:
        config = agent.config
        partial = config.observability != "full"
        game = compiled_game(config.env, config.obs_size, config.rules, dict(config.env_options))
        session = Session(game, seed=SEED, partial=partial, both=config.observability == "mixed", episodes=1)
        frames = recorded_frames(session, Trained(agent, partial), max_steps=self.max_steps, hold=FPS, scale=2)
        self._write(path, frames, FPS)
