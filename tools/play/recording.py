"""Players at a session, and pictures of what they play: films as GIF or MP4, single moments as
PNG.
"""

import io
import subprocess
import tempfile
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from itertools import chain, pairwise, repeat
from pathlib import Path
from typing import Any

import numpy as np

from arcade_torch.agents.checked import require
from arcade_torch.agents.runs.files import check_writable, write_atomic
from arcade_torch.compiled import compiled_game
from arcade_torch.envs_jax import ACTION_NAMES, games_of, make
from arcade_torch.envs_jax.oracles import RandomPlayer, make_oracle
from arcade_torch.gym.window import enlarge
from arcade_torch.tools.errors import need
from arcade_torch.tools.play.captions import HEIGHT, PAPER, TWINS, caption
from arcade_torch.tools.play.session import NEXT, QUIT, Frame, Session

SCRIPTED = ("random", "state-oracle", "frames-oracle")
FASTEST_FPS = {".gif": 50, ".mp4": 240}  # a GIF shows a frame for 2 hundredths of a second or more
# Quality of x264: 0 is lossless, 23 its default. Most players want this pixel format.
_ENCODING = ("-c:v", "libx264", "-crf", "14", "-pix_fmt", "yuv420p", "-movflags", "+faststart")
# of films of a training
FILM_FPS = 10
FILM_STEPS = 500
FILM_SEED = 2**31  # far from those of training, and always the same, so that films compare
GAP = 8
"""Between pictures on a sheet or a strip, in pixels."""

Chooser = Callable[[Session], int]
"""Somebody who plays: looks at a session and names an action, 0 to 4."""


def scripted(name: str, game: Any, seed: int) -> Chooser:
    """The random player or an oracle of the games, one of `SCRIPTED`."""
    player: Any = RandomPlayer(seed)
    if name != "random":
        player = make_oracle(game, "state" if name == "state-oracle" else "frames")

    def choose(session: Session) -> int:
        seen = session.view(partial=True) if name == "frames-oracle" else session.state
        return int(player.act(seen, np.array([session.steps == 0]))[0])

    return choose


def trained(agent: Any, partial: bool | None) -> Chooser:
    """A trained agent, greedy; it sees what it would see in an ``ArcadeEnv`` of one env, of the
    twin that the session shows where ``partial`` is None.
    """
    import torch
    from tensordict import TensorDict

    device = next(agent.network.parameters()).device
    state = agent.initial_state(1)
    last_action = 0

    def choose(session: Session) -> int:
        nonlocal state, last_action
        twin = session.partial if partial is None else partial
        obs = {
            "pixels": torch.from_numpy(session.view(twin)),
            "last_action": torch.tensor([last_action]),
            "is_init": torch.tensor([[session.steps == 0]]),
            "step_count": torch.tensor([[session.steps]]),
            "episode_reward": torch.tensor([[session.total]]),
        }
        with torch.no_grad():
            action, _, state = agent.act(TensorDict(obs, batch_size=[1]).to(device), state)
        last_action = int(action)
        return last_action

    return choose


def recorded_frames(
    session: Session, choose: Chooser, *, max_steps: int, hold: int, scale: int
) -> Iterator[Frame]:
    """Play a session to its end and give out its frames, the last of an episode ``hold`` times."""
    while not session.closed:
        frame = enlarge(session.picture, scale)
        yield frame
        if session.end is not None:
            yield from repeat(frame, hold - 1)
            session.press(NEXT)
        elif session.steps >= max_steps:
            session.press(QUIT)
        else:
            session.press(ACTION_NAMES[choose(session)])


def writer_for(path: Path) -> Callable[[Path, Iterable[Frame], float], Path]:
    """The writer that a file's name asks for."""
    require(path.suffix in FASTEST_FPS, "the film", str(path), "a file that ends in .gif or .mp4")
    check_writable(path)
    need("PIL" if path.suffix == ".gif" else "imageio_ffmpeg")
    return write_gif if path.suffix == ".gif" else write_mp4


def write_gif(path: Path, frames: Iterable[Frame], fps: float) -> Path:
    """Write an endless GIF. Frames of up to 256 colours, as the games' are, keep every pixel."""
    image = need("PIL.Image")
    buffer = io.BytesIO()
    pictures = (image.fromarray(frame).quantize(256) for frame in frames)  # one at a time
    first = next(pictures)
    duration_ms = 10 * max(1, round(100 / fps))
    first.save(buffer, "GIF", save_all=True, append_images=pictures, duration=duration_ms, loop=0)
    return write_atomic(path, buffer.getvalue())


def write_png(path: Path, picture: Frame) -> Path:
    """Write a picture without loss."""
    buffer = io.BytesIO()
    need("PIL.Image").fromarray(picture).save(buffer, format="PNG", optimize=True)
    return write_atomic(path, buffer.getvalue())


def write_mp4(path: Path, frames: Iterable[Frame], fps: float) -> Path:
    """Write an H.264 film that browsers show; colours are subsampled, pixels are not exact."""
    program = need("imageio_ffmpeg").get_ffmpeg_exe()
    rest = iter(frames)
    first = next(rest)
    size = f"{first.shape[1]}x{first.shape[0]}"
    source = f"-f rawvideo -pix_fmt rgb24 -s {size} -r {fps}".split()
    with tempfile.TemporaryDirectory() as folder:
        film = Path(folder) / "film.mp4"
        log = Path(folder) / "log"
        words = [program, "-v", "error", *source, "-i", "-", *_ENCODING, str(film)]
        process = subprocess.Popen(words, stdin=subprocess.PIPE, stderr=log.open("wb"))
        with suppress(BrokenPipeError), process:  # ffmpeg may give up early; it says why in its log
            assert process.stdin is not None
            for frame in chain([first], rest):
                process.stdin.write(np.ascontiguousarray(frame).data)
        if process.returncode:
            complaint = log.read_text(errors="replace").strip()
            raise ValueError(f"ffmpeg could not write {path}: {complaint or process.returncode}")
        return write_atomic(path, film.read_bytes())


def _moments(id: str, obs_size: int, steps: int) -> Iterator[list[Frame]]:
    """Both twins of each state of an episode of the scripted player, from the first to that after
    `steps`, or to the last before the end; of a random one where there is no player that sees the
    state.
    """
    session = Session(compiled_game(id, obs_size, "default", {}), seed=0)
    player = "state-oracle" if "state" in session.game.oracles else "random"
    choose = scripted(player, session.game, 0)
    while session.end is None and session.steps <= steps:
        yield [session.view(partial=False)[0], session.view(partial=True)[0]]
        session.press(ACTION_NAMES[choose(session)])


def scene(id: str, obs_size: int, steps: int = 60) -> list[Frame]:
    """Both twins of one moment in the middle of a game, played by the scripted player that sees the
    state.
    """
    middle = make(id, obs_size=obs_size).max_steps // 4
    *_, last = _moments(id, obs_size, min(steps, middle))
    return last


def strip(id: str, steps: Sequence[int], obs_size: int = 256) -> Frame:
    """Some moments of one episode side by side, the MDP twin above the POMDP twin, each row under
    its name.
    """
    rises = bool(steps) and steps[0] >= 0 and all(a < b for a, b in pairwise(steps))
    require(rises, "steps", list(steps), "whole numbers that rise from 0 or more")
    moments = list(_moments(id, obs_size, steps[-1]))
    if len(moments) <= steps[-1]:
        raise ValueError(
            f"the scripted episode of {id} with seed 0 ends after {len(moments)} steps: stay below"
        )
    rows = list[Frame]()
    for twin, name in enumerate(TWINS.values()):
        frames = [_padded(moments[step][twin], obs_size) for step in steps]
        row = np.hstack(frames)[:, :-GAP]
        rows += [caption([name], row.shape[1], max(1, obs_size // 128)), row]
    return np.vstack(rows)[:-GAP]


def sheet(
    ids: Sequence[str], columns: int = 2, progress: Callable[[str, int], None] | None = None
) -> Frame:
    """All games on one picture; a game is four frames: both twins at 256 pixels, both at 128.

    ``progress`` is called with the id of every game that is drawn, and how many are.
    """
    games = list[Frame]()
    for id in ids:
        frames = [*scene(id, 256), *scene(id, 128)]
        games.append(np.hstack([_padded(frame, 256) for frame in frames]))
        if progress is not None:
            progress(id, len(games))
    names = []
    for size in (256, 128):
        for name in TWINS.values():
            gap = np.full((HEIGHT * 2, GAP, 3), PAPER, np.uint8)
            names.append(np.hstack([caption([name], size, 2), gap]))
    games += [np.full_like(games[0], PAPER)] * (-len(games) % columns)
    lines = [np.hstack(names * columns)]
    for first in range(0, len(games), columns):
        lines.append(np.hstack(games[first : first + columns]))
    return np.vstack(lines)


def _padded(frame: Frame, height: int) -> Frame:
    """A frame with paper below it, to that height, and a gap behind."""
    return np.pad(frame, ((0, height + GAP - len(frame)), (0, GAP), (0, 0)), constant_values=PAPER)


class EvaluationVideos:
    """Films one greedy episode whenever it is called; give it to ``train`` as ``on_evaluation``.

    Playing draws no random number of the training, so a run is the same to the bit with and without
    it. A film that fails is reported in a warning, and it was the last.
    """

    def __init__(self, folder: Path, suffix: str = ".gif") -> None:
        self.folder = folder
        self.suffix = suffix
        self._write = writer_for(folder / f"film{suffix}")
        self._failed = False

    def __call__(self, agent: Any) -> None:
        """Film an agent."""
        if self._failed:
            return
        name = f"frames-{agent.frames:09d}"
        try:
            games = dict.fromkeys(games_of(agent.config.env))
            for game in games:
                which = f"-{game}" if len(games) > 1 else ""
                self._film(agent, game, self.folder / f"{name}{which}{self.suffix}")
        except Exception as error:  # a training is worth more than its film
            self._failed = True
            warnings.warn(
                f"no more films, {name}{self.suffix}: {type(error).__name__}: {error}", stacklevel=2
            )

    def _film(self, agent: Any, game_id: str, path: Path) -> None:
        """Film one game of an agent."""
        config = agent.config
        partial = config.observability != "full"
        game = compiled_game(game_id, config.obs_size, config.rules, dict(config.env_options))
        session = Session(
            game,
            seed=FILM_SEED,
            partial=partial,
            both=config.observability == "mixed",
            episodes=1,
        )
        player = trained(agent, partial)
        frames = recorded_frames(session, player, max_steps=FILM_STEPS, hold=FILM_FPS, scale=2)
        self._write(path, frames, FILM_FPS)
