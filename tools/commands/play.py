"""``arcade-torch play`` and ``arcade-torch record``."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import tyro

from arcade_torch.agents.checked import require
from arcade_torch.agents.runs.shipped import agent_folder
from arcade_torch.tools.imports import import_again, load_agent
from arcade_torch.tools.options import Command, at_least, at_most, name_and_value
from arcade_torch.tools.progress import Bars
from arcade_torch.tools.text import say

LARGEST_SCALE = 32


@dataclass(kw_only=True)
class GameCommand(Command):
    """What both commands are told about the game and its picture."""

    game: tyro.conf.PositionalRequiredArgs[tyro.conf.Positional[str]]
    """Environment id."""
    both: bool = False  # Show both twins, the MDP on the left.
    scale: int = 2  # Width of a frame's pixel in the picture.
    env_option: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """NAME=VALUE, an option of the game; may be given several times."""

    def check_scale(self) -> None:
        """Refuse pictures without a pixel, and those that no screen and no memory holds."""
        at_most(self, scale=LARGEST_SCALE)
        at_least(self, scale=1)

    def game_options(self) -> dict[str, Any]:
        """The options of the game, by name."""
        return dict(map(name_and_value, self.env_option))


@dataclass(kw_only=True)
class Play(GameCommand):
    """Play a game by hand, in a window or (without pygame or a display, or with --terminal) in the
    terminal.

    Arrows and space are the five actions; one key, one step. P changes between MDP and POMDP, also
    in mid-episode. R restarts the episode, Enter goes on after an end, Esc quits.

    With --agent a trained agent plays and you watch: P, R, Enter and Esc still work.

    Example: arcade-torch play MineSweeperEasy --partial --episodes 3 --scores human.csv
    """

    seed: int | None = None
    """Of the first episode, each further one has the next; 0 by default, with --scores the first
    the file lacks.
    """
    partial: bool = False  # Begin with the POMDP twin.
    episodes: int = 0  # Stop after so many finished episodes; 0 for never.
    obs_size: Literal[128, 256] = 256  # Side of the frame in pixels.
    key_repeat: int = 0  # A held key repeats every so many milliseconds; 0 for not at all.
    rules: Literal["default", "reference"] = "default"  # Rules of the game.
    terminal: bool = False  # Play in the terminal.
    scores: Path | None = None  # CSV file that every episode is added to: return, seed, actions.
    player: str = ""  # Your name in that file.
    agent: str = ""  # Watch it play: an agent of this package, or a run folder.
    fps: float = 5.0  # Actions a second of that agent.

    def run(self) -> int:
        """Play."""
        from arcade_torch.compiled import compiled_game
        from arcade_torch.tools.play import recording, scores, screens
        from arcade_torch.tools.play.session import Session

        at_least(self, key_repeat=0, fps=0.1)
        at_most(self, fps=screens.FPS)
        self.check_scale()
        fits = self.scores is None or self.scores.suffix == ".csv"
        require(fits, "--scores", str(self.scores), "a file that ends in .csv")
        scene = self.scene()
        options = scene.options
        compiled = compiled_game(self.game, scene.obs_size, scene.rules, options)
        game: Any = compiled.batched.game
        said: list[str] = []
        rows = scores.read_scores_file(self.scores) if self.scores is not None else []
        seed = scores.next_seed(rows, game.id, self.player) if self.seed is None else self.seed

        def keep(attempt: Any) -> None:
            """Write a score, and remember to say it when the screen is the terminal's again."""
            said.append(f"seed {attempt.seed} ({attempt.observability}): {attempt}")
            if self.scores is not None:
                row = scores.score_row(attempt, game, options, self.player)
                scores.append_score(self.scores, row)

        session = Session(
            compiled,
            seed=seed,
            episodes=self.episodes,
            partial=scene.partial,
            both=self.both,
            on_attempt=keep,
        )
        watched = None
        if scene.agent is not None:
            watched = screens.Watched(recording.trained(scene.agent, None), self.fps)
        self.show(session, watched, said)
        return 0

    def show(self, session: Any, watched: Any, said: list[str]) -> None:
        """Show a session in a window or the terminal until it is closed, then say what was played;
        a signal leaves the running episode as Esc does.
        """
        from arcade_torch.tools.play import screens
        from arcade_torch.tools.play.session import LEGEND, QUIT

        in_terminal = self.plays_in_terminal()
        try:
            if in_terminal:
                screens.play_in_terminal(session, watched)
            else:
                print(LEGEND)
                screens.play_in_window(session, self.scale, self.key_repeat, watched)
        finally:
            session.press(QUIT)
            for line in said:
                say(line)
        if not said:
            say("no episode was played")

    def scene(self) -> "Scene":
        """What is played: as the options say, or as the agent that plays was trained."""
        if not self.agent:
            return Scene(self.obs_size, self.rules, self.partial, self.game_options())
        if self.scores is not None:
            raise ValueError("--scores is for people: leave it out with --agent")
        scene = scene_of_agent(self.game, agent_folder(self.agent), self.game_options())
        scene.partial = self.partial or scene.partial
        return scene

    def plays_in_terminal(self) -> bool:
        """Whether to play in the terminal, because it was asked for or because there is no window;
        a ``ValueError`` if there is neither.
        """
        from arcade_torch.tools.play import screens

        if self.terminal:
            return True
        no_window = screens.why_no_window()
        if no_window is None:
            return False
        no_terminal = screens.why_no_terminal()
        if no_terminal is not None:
            raise ValueError(
                f"playing needs a window or a terminal: {no_window}, and {no_terminal}"
            )
        say(f"playing in the terminal: {no_window}")
        return True


@dataclass
class Scene:
    """What a recording shows: the game, the twin, and the agent that plays, if one does."""

    obs_size: int
    rules: str
    partial: bool
    options: dict[str, Any]
    agent: Any = None


@dataclass(kw_only=True)
class Record(GameCommand):
    """Record episodes of a player as a GIF or, with the extra video, as an MP4.

    Players: random, state-oracle (sees the state), frames-oracle (sees the frames of the POMDP
    twin), an agent of this package by its name, such as signpost-partial-lru, or the run folder of
    another.

    Example: arcade-torch record MineSweeperEasy --player frames-oracle --both --out sweep.gif
    """

    out: Path  # File, .gif or .mp4; replaced if it exists.
    player: str = "random"
    """random, state-oracle, frames-oracle, an agent of this package, or a run folder."""
    observability: Literal["full", "partial"] | None = None
    """Twin that is shown, and that an agent sees; by default its own, partial for the
    frames-oracle, otherwise full.
    """
    seed: int = 0  # Of the first episode, each further one has the next.
    episodes: int = 1  # How many.
    max_steps: int = 1000  # The recording stops when an episode gets longer.
    fps: float = 10.0  # Frames a second.
    obs_size: Literal[128, 256] | None = None  # Side of the frame; the agent's, else 128.
    # Rules of the game; the agent's, else default.
    rules: Literal["default", "reference"] | None = None

    def run(self) -> int:
        """Record."""
        from arcade_torch.compiled import compiled_game
        from arcade_torch.envs_jax import resolve_id
        from arcade_torch.tools.play import recording
        from arcade_torch.tools.play.session import Session

        write = recording.writer_for(self.out)
        at_least(self, episodes=1, max_steps=1)
        self.check_scale()
        fastest = recording.FASTEST_FPS[self.out.suffix]
        allowed = f"at least 0.01 and at most {fastest} for {self.out.suffix}"
        require(0.01 <= self.fps <= fastest, "--fps", self.fps, allowed)
        if self.player not in recording.SCRIPTED:
            import_again(agent_folder(self.player))  # which may register the game, too
        game_id = resolve_id(self.game)
        scene = self.scene()
        game = compiled_game(game_id, scene.obs_size, scene.rules, scene.options)
        session = Session(
            game,
            seed=self.seed,
            episodes=self.episodes,
            partial=scene.partial,
            both=self.both,
            on_attempt=_say_attempt,
        )
        if scene.agent is None:
            player = recording.scripted(self.player, session.game, self.seed)
        else:
            player = recording.trained(scene.agent, scene.partial)
        hold = max(1, round(self.fps))
        frames = recording.recorded_frames(
            session, player, max_steps=self.max_steps, hold=hold, scale=self.scale
        )
        with Bars() as bars:
            write(self.out, _counted(frames, bars, str(self.out)), self.fps)
        say(f"recording: {self.out}")
        return 0

    def scene(self) -> Scene:
        """What is recorded: as the options say, then as the agent was trained, then by default."""
        from arcade_torch.tools.play import recording

        if self.player in recording.SCRIPTED:
            scene = Scene(
                obs_size=self.obs_size or 128,
                rules=self.rules or "default",
                partial=self.player == "frames-oracle",
                options=self.game_options(),
            )
        else:
            scene = self._scene_of_player()
        if self.observability is not None:
            scene.partial = self.observability == "partial"
        return scene

    def _scene_of_player(self) -> Scene:
        """What is recorded of a trained agent."""
        from arcade_torch.agents.runs.shipped import pretrained_names
        from arcade_torch.tools.play import recording

        folder = agent_folder(self.player)
        names = ", ".join((*recording.SCRIPTED, *pretrained_names()))
        require(folder.is_dir(), "--player", self.player, f"{names}, or a run folder")
        scene = scene_of_agent(self.game, folder, self.game_options())
        if self.obs_size not in (None, scene.obs_size):
            raise ValueError(
                f"--obs-size is {self.obs_size}, but the agent sees frames of {scene.obs_size}"
            )
        scene.rules = self.rules or scene.rules
        return scene


def scene_of_agent(game: str, folder: Path, options: dict[str, Any]) -> Scene:
    """What the agent in a folder plays: as it was trained, with other options of the game.

    Raises:
        ValueError: there is no such game or folder.
    """
    from arcade_torch.agents.runs.shipped import pretrained_names
    from arcade_torch.envs_jax import games_of, resolve_id

    names = ", ".join(pretrained_names())
    require(folder.is_dir(), "the agent", str(folder), f"a run folder, or one of {names}")
    agent = load_agent(folder)
    config = agent.config
    if resolve_id(game) in games_of(config.env):
        options = dict(config.env_options) | options
    else:
        say(f"note: this agent was trained on {config.env}")
    return Scene(
        obs_size=config.obs_size,
        rules=config.rules,
        partial=config.observability != "full",
        options=options,
        agent=agent,
    )


def _say_attempt(attempt: Any) -> None:
    """Say what came of an episode."""
    say(f"seed {attempt.seed}: {attempt}".replace("abandoned", "cut at --max-steps"))


def _counted(frames: Iterable[Any], bars: Bars, name: str) -> Iterator[Any]:
    """The same frames; their number is shown."""
    for count, frame in enumerate(frames, start=1):
        bars.update(name, count, 0, f"frame {count}")
        yield frame
