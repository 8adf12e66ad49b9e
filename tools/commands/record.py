"""``arcade-torch record``."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import tyro


@dataclass
class Record:
    """Record episodes of a player as a GIF or, with the extra video, as an MP4.

    Players: random, state-oracle (sees the state), frames-oracle (sees the frames of the POMDP twin), or the run folder
    of a trained agent.

    Example: arcade-torch record MineSweeperEasy --player frames-oracle --both --out sweep.gif
    """

    game: tyro.conf.PositionalRequiredArgs[tyro.conf.Positional[str]]
    """Environment id."""
    out: Path
    """File, .gif or .mp4; replaced if it exists."""
    player: str = "random"
    """random, state-oracle, frames-oracle, or a run folder."""
    observability: Literal["full", "partial"] | None = None
    """Twin that is shown, and that an agent sees; by default its own, partial for the frames-oracle, otherwise full."""
    both: bool = False
    """Show both twins, the MDP on the left."""
    seed: int = 0
    """Of the first episode, each further one has the next."""
    episodes: int = 1
    """How many."""
    max_steps: int = 1000
    """The recording stops when an episode gets longer."""
    fps: float = 10.0
    """Frames a second."""
    scale: int = 2
    """Width of a frame's pixel in the picture."""
    obs_size: Literal[128, 256] | None = None
    """Side of the frame; the agent's, else 128."""
    rules: Literal["default", "reference"] | None = None
    """Law of the game; the agent's, else default."""
    env_option: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """NAME=VALUE, an option of the game; may be given several times."""

    def run(self) -> int:
        """Record."""
        from arcade_torch.tools.record.episodes import recorded_frames
        from arcade_torch.tools.record.files import writer_for

        write = writer_for(self.out)
        self._check()
        session, chooser = self._players()
        frames = recorded_frames(
            session, chooser, max_steps=self.max_steps, hold=max(1, round(self.fps)), scale=self.scale
        )
        write(self.out, self._shown(frames), self.fps)
        print(f"recording: {self.out}")
        return 0

    def _check(self) -> None:
        from arcade_torch.tools.record.files import FASTEST_FPS

        for name in ("episodes", "max_steps", "scale"):
            if getattr(self, name) < 1:
                raise ValueError(f"--{name.replace('_', '-')} must be at least 1, got {getattr(self, name)}")
        fastest = FASTEST_FPS[self.out.suffix]
        if not 0 < self.fps <= fastest:
            raise ValueError(f"--fps must be above 0 and at most {fastest} for {self.out.suffix}, got {self.fps}")

    def _players(self) -> tuple[Any, Any]:
        """The session and who plays it."""
        from arcade_torch.compiled import compiled_game
        from arcade_torch.envs_jax import resolve_id
        from arcade_torch.tools.name_value import name_and_value
        from arcade_torch.tools.play.session import Session
        from arcade_torch.tools.record.players import SCRIPTED, Trained, load_agent, scripted

        game_id = resolve_id(self.game)
        options = dict(map(name_and_value, self.env_option))
        obs_size, rules, partial = self.obs_size, self.rules, self.player == "frames-oracle"
        agent = None if self.player in SCRIPTED else load_agent(self.player)
        if agent is not None:
            config = agent.config
            if obs_size not in (None, config.obs_size):
                raise ValueError(f"--obs-size is {obs_size}, but the agent sees frames of {config.obs_size}")
            obs_size, rules, partial = config.obs_size, rules or config.rules, config.observability != "full"
            if resolve_id(config.env) == game_id:
                options = {**dict(config.env_options), **options}
            else:
                print(f"note: this agent was trained on {config.env}")
        if self.observability is not None:
            partial = self.observability == "partial"
        game = compiled_game(game_id, obs_size or 128, rules or "default", options)
        session = Session(
            game, seed=self.seed, partial=partial, both=self.both, episodes=self.episodes, on_attempt=_say
        )
        if agent is not None:
            return session, Trained(agent, partial)
        return session, scripted(self.player, game.batched.game, self.seed)

    def _shown(self, frames: Iterable[Any]) -> Iterable[Any]:
        """The frames, counted on a terminal."""
        from arcade_torch.tools.optional import need

        bar: Iterable[Any] = need("tqdm").tqdm(frames, desc=str(self.out), unit=" frames", disable=None, leave=False)
        return bar


def _say(attempt: Any) -> None:
    """Report an episode."""
    end = "cut at --max-steps" if attempt.end == "abandoned" else attempt.end
    print(f"seed {attempt.seed}: return {attempt.total:+.3f} in {attempt.steps} steps, {end}")


COMMAND = Record
