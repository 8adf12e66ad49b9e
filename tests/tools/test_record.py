"""Recording: the pictures in the file are the frames of the episode, whoever plays."""

import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict

import arcade_torch
from arcade_torch.agents import evaluate, held_out_seed, load, preset
from arcade_torch.agents.policy import build_network
from arcade_torch.agents.runs.checkpoint import save_checkpoint
from arcade_torch.compiled import compiled_game
from arcade_torch.envs_jax.oracles import make_oracle
from arcade_torch.envs_jax.oracles import play as oracle_play
from arcade_torch.tools import cli
from arcade_torch.tools.play import recording
from arcade_torch.tools.play.recording import (
    SCRIPTED,
    recorded_frames,
    scripted,
    trained,
    write_gif,
    write_mp4,
)
from arcade_torch.tools.play.session import Attempt, Session

GAME = "MineSweeperEasy"


def session(**options: Any) -> tuple[Session, list[Attempt]]:
    found: list[Attempt] = []
    game = compiled_game(GAME, 128, "default", {})
    return Session(game, on_attempt=found.append, **{"episodes": 1, **options}), found


def pictures(path: Path) -> tuple[np.ndarray, list[int]]:
    """Frames of a GIF with equal neighbours put apart again, by their duration, and the hundredths
    of a second.
    """
    image = pytest.importorskip("PIL.Image")
    sequence = pytest.importorskip("PIL.ImageSequence")
    with image.open(path) as film:
        shown = [
            (np.array(frame.convert("RGB")), frame.info["duration"])
            for frame in sequence.Iterator(film)
        ]
    unit = min(duration for _, duration in shown)
    return np.stack([frame for frame, duration in shown for _ in range(duration // unit)]), [
        d for _, d in shown
    ]


@pytest.mark.parametrize("kind", ["state", "frames"])
def test_a_scripted_player_plays_as_it_does_for_the_references(kind: str) -> None:
    player, found = session(seed=4, episodes=3)
    list(
        recorded_frames(
            player, scripted(f"{kind}-oracle", player.game, 0), max_steps=99, hold=1, scale=1
        )
    )
    assert [a.seed for a in found] == [4, 5, 6]
    one = oracle_play(player.game, make_oracle(player.game, kind), 1, 4, frames=kind == "frames")
    assert (one.returns[0], one.lengths[0]) == (pytest.approx(found[0].total), found[0].steps)


class Suspicious:
    """An agent whose actions depend on everything it is shown and on what it has been shown
    before.
    """

    network = torch.nn.Linear(1, 1)

    def initial_state(self, batch_size: int) -> TensorDict:
        return TensorDict(
            {"sum": torch.zeros(batch_size, dtype=torch.int64)}, batch_size=[batch_size]
        )

    def act(self, obs: Any, state: Any) -> tuple[torch.Tensor, dict[str, torch.Tensor], Any]:
        seen = (
            obs["pixels"].long().sum((1, 2, 3)) // 7
            + 3 * obs["last_action"]
            + 2 * obs["is_init"][:, 0]
        )
        seen = (
            seen
            + obs["step_count"][:, 0]
            + (100 * obs["episode_reward"][:, 0]).long()
            + state["sum"]
        )
        return seen % 5, {}, TensorDict({"sum": seen % 1000}, batch_size=obs.batch_size)


@pytest.mark.parametrize("observability", ["full", "partial"])
def test_an_agent_is_shown_what_arcade_env_shows(observability: str) -> None:
    agent = Suspicious()
    env = arcade_torch.make(GAME, num_envs=1, observability=observability, seed=11)
    root, state, actions = env.reset(), agent.initial_state(1), ""
    for _ in range(32):
        action, _, state = agent.act(root, state)
        actions += str(int(action))
        step, root = env.step_and_maybe_reset(root.set("action", action))
        if step["next", "done"].item():
            break
    player, found = session(seed=11, both=True)
    list(
        recorded_frames(
            player, trained(agent, observability == "partial"), max_steps=99, hold=1, scale=1
        )
    )
    assert found[0].actions == actions and len(set(actions)) > 1


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder with the checkpoint of an untrained agent of the POMDP."""
    folder = tmp_path_factory.mktemp("run")
    config = preset("smoke", env=GAME, observability="partial", memory="gru")
    save_checkpoint(folder / "checkpoints", config, 0, build_network(config).state_dict(), {})
    return folder


def test_a_run_folder_plays_as_it_is_evaluated(
    run_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    seed = held_out_seed(0)
    words = [
        "record",
        GAME,
        "--player",
        str(run_folder),
        "--seed",
        str(seed),
        "--out",
        str(tmp_path / "a.gif"),
    ]
    assert cli.main([*words, "--scale", "1"]) == 0
    result = evaluate(load(run_folder), episodes=1)
    said = f"seed {seed}: return {result.returns[0]:+.3f} in {result.lengths[0]} steps"
    assert said in capsys.readouterr().out
    frames, _ = pictures(tmp_path / "a.gif")
    player, _ = session(seed=seed, partial=True)  # the twin it was trained on
    assert (frames[0] == player.picture).all()
    assert (
        cli.main([*words[:-1], str(tmp_path / "b.gif"), "--obs-size", "256"]) == cli.EXIT_BAD_INPUT
    )
    assert "--obs-size is 256, but the agent sees frames of 128" in capsys.readouterr().err
    words[1] = "MineSweeperMedium"
    assert cli.main([*words, "--scale", "1", "--max-steps", "2"]) == 0
    assert f"note: this agent was trained on {GAME}" in capsys.readouterr().out


@pytest.mark.parametrize("both", [False, True])
def test_a_gif_holds_the_true_frames(tmp_path: Path, both: bool) -> None:
    player, found = session(seed=2, episodes=2, both=both)
    frames = list(
        recorded_frames(player, scripted("random", player.game, 0), max_steps=99, hold=5, scale=2)
    )
    assert len(frames) == sum(a.steps + 1 + 4 for a in found)
    assert all((frame == frames[-1]).all() for frame in frames[-5:])
    twin, _ = session(seed=2, both=both)
    for action, frame in zip(found[0].actions, frames, strict=False):
        seen = twin.picture
        assert (frame[::2, ::2] == seen).all() and (frame[1::2, 1::2] == seen).all()
        twin.press(("up", "down", "left", "right", "fire")[int(action)])
    kept, durations = pictures(write_gif(tmp_path / "x.gif", frames, 20.0))
    assert (kept == np.stack(frames)).all()
    assert sum(durations) == 50 * len(frames)


def test_a_gif_keeps_a_frame_of_256_colours(tmp_path: Path) -> None:
    colours = (
        np.random.default_rng(0).choice(2**24, 256, replace=False)[:, None] >> np.array([16, 8, 0])
        & 255
    )
    frame = (
        colours[np.random.default_rng(1).permutation(4096) % 256]
        .reshape(64, 64, 3)
        .astype(np.uint8)
    )
    kept, _ = pictures(write_gif(tmp_path / "x.gif", [frame], 10.0))
    assert (kept[0] == frame).all()


def test_frames_of_many_colours_are_written_too(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (2, 32, 32, 3)).astype(np.uint8)
    kept, _ = pictures(write_gif(tmp_path / "x.gif", noise, 10.0))
    assert kept.shape == noise.shape and np.abs(kept.astype(int) - noise).mean() < 40


@pytest.mark.filterwarnings(
    "ignore:os.fork"
)  # reading through imageio_ffmpeg forks; writing does not
def test_an_mp4_holds_the_frames_nearly(tmp_path: Path) -> None:
    ffmpeg = pytest.importorskip(
        "imageio_ffmpeg", reason="needs the video extra: pip install '.[video]'"
    )
    player, _ = session(seed=2)
    frames = list(
        recorded_frames(player, scripted("random", player.game, 0), max_steps=99, hold=1, scale=2)
    )
    path = write_mp4(tmp_path / "x.mp4", frames, 10.0)
    film = ffmpeg.read_frames(str(path))
    assert next(film)["size"] == (256, 280)
    kept = np.stack([np.frombuffer(data, np.uint8).reshape(280, 256, 3) for data in film])
    assert len(kept) == len(frames)
    assert np.abs(kept.astype(int) - np.stack(frames)).mean() < 6
    with pytest.raises(ValueError, match=r"ffmpeg could not write .*y\.mp4: "):
        write_mp4(tmp_path / "y.mp4", [frame[:-1] for frame in frames], 10.0)  # an odd height
    assert [path.name for path in tmp_path.iterdir()] == ["x.mp4"]


@pytest.mark.parametrize("player", SCRIPTED)
def test_the_command_records_scripted_players(
    player: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "new" / "x.gif"
    words = [
        "record",
        GAME,
        "--player",
        player,
        "--both",
        "--scale",
        "1",
        "--out",
        str(out),
        "--seed",
        "3",
    ]
    assert cli.main(words) == 0
    said = capsys.readouterr().out
    assert re.search(
        r"seed 3: return [+-]\d\.\d+ in \d+ steps, (terminated|truncated)\nrecording: ", said
    )
    frames, _ = pictures(out)
    assert frames.shape[1:] == (12 + 128, 256, 3)
    assert [path.name for path in out.parent.iterdir()] == ["x.gif"]


def test_a_recording_is_repeated_to_the_byte_and_cut_when_it_gets_long(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "x.gif"
    words = [
        "record",
        GAME,
        "--out",
        str(out),
        "--max-steps",
        "3",
        "--observability",
        "partial",
        "--scale",
        "1",
    ]
    assert cli.main(words) == 0
    first = out.read_bytes()
    assert cli.main(words) == 0
    assert out.read_bytes() == first
    assert "in 3 steps, cut at --max-steps" in capsys.readouterr().out
    assert len(pictures(out)[0]) <= 4


def test_a_recording_that_fails_leaves_the_old_file(tmp_path: Path) -> None:
    out = tmp_path / "x.gif"
    out.write_bytes(b"old")

    def broken() -> Any:
        yield np.zeros((4, 4, 3), np.uint8)
        raise RuntimeError("in the middle")

    with pytest.raises(RuntimeError, match="in the middle"):
        write_gif(out, broken(), 10.0)
    assert out.read_bytes() == b"old" and [path.name for path in tmp_path.iterdir()] == ["x.gif"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["record", GAME], "Missing from arcade-torch record: --out"),
        (["record", "TetrisEsy", "--out", "x.gif"], "did you mean 'TetrisEasy'"),
        (["record", GAME, "--out", "x.png"], "a file that ends in .gif or .mp4; got 'x.png'"),
        (
            ["record", GAME, "--out", "x.gif", "--player", "nobody"],
            "--player must be random, state-",
        ),
        (["record", GAME, "--out", "x.gif", "--player", "."], "holds no checkpoint"),
        (
            ["record", GAME, "--out", "x.gif", "--episodes", "0"],
            "--episodes must be at least 1, got 0",
        ),
        (["record", GAME, "--out", "x.gif", "--max-steps", "0"], "--max-steps must be at least 1"),
        (["record", GAME, "--out", "x.gif", "--scale", "0"], "--scale must be at least 1"),
        (
            ["record", GAME, "--out", "x.gif", "--fps", "60"],
            "--fps must be at least 0.01 and at most 50 for .gif; got 60",
        ),
        (["record", GAME, "--out", "x.gif", "--fps", "nan"], "--fps must be at least 0.01"),
        (["record", GAME, "--out", "x.gif", "--fps", "0.001"], "--fps must be at least 0.01"),
        (["record", GAME, "--out", "x.gif", "--seed", "-1"], "seed is -1"),
        (["record", GAME, "--out", "x.gif", "--env-option", "wind=1"], "has no option 'wind'"),
    ],
)
def test_bad_input_is_one_line(
    words: list[str],
    message: str,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert cli.main(words) == cli.EXIT_BAD_INPUT
    out, err = capsys.readouterr()
    assert not out and err.count("\n") == 1 and message in err
    assert not list(tmp_path.iterdir())


def test_missing_writers_are_named_with_their_extras(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    monkeypatch.setitem(sys.modules, "PIL", None)
    for suffix, extra in ((".mp4", "video"), (".gif", "tools")):
        assert (
            cli.main(["record", GAME, "--out", str(tmp_path / f"x{suffix}")]) == cli.EXIT_BAD_INPUT
        )
        assert f"pip install '.[{extra}]'" in capsys.readouterr().err


def test_every_evaluation_of_a_training_is_filmed_and_changes_nothing(tmp_path: Path) -> None:
    words = [
        "train",
        "--preset",
        "smoke",
        "--env",
        GAME,
        "--total-frames",
        "256",
        "--eval-every",
        "128",
    ]
    assert cli.main([*words, "--out", str(tmp_path / "filmed"), "--videos", "gif"]) == 0
    assert cli.main([*words, "--out", str(tmp_path / "plain")]) == 0
    films = sorted(path.name for path in (tmp_path / "filmed" / "videos").iterdir())
    assert films == ["frames-000000128.gif", "frames-000000256.gif"]
    agent, found = load(tmp_path / "filmed"), []
    game = compiled_game(GAME, 128, "default", {})
    player = Session(
        game, seed=recording.FILM_SEED, partial=False, episodes=1, on_attempt=found.append
    )
    played = list(
        recorded_frames(
            player, trained(agent, False), max_steps=500, hold=recording.FILM_FPS, scale=2
        )
    )
    np.testing.assert_array_equal(
        pictures(tmp_path / "filmed" / "videos" / films[-1])[0], np.stack(played)
    )
    assert (tmp_path / "filmed/eval.csv").read_bytes() == (tmp_path / "plain/eval.csv").read_bytes()
    weights = [
        sorted((tmp_path / run).rglob("*.safetensors"))[-1].read_bytes()
        for run in ("filmed", "plain")
    ]
    assert weights[0] == weights[1]


def test_a_film_that_fails_is_the_last_and_stops_nothing(tmp_path: Path) -> None:
    film = recording.EvaluationVideos(tmp_path / "videos")
    with pytest.warns(UserWarning, match="no more films, frames-000000007.gif: AttributeError"):
        film(type("Broken", (), {"frames": 7})())
    film(None)
    with pytest.raises(ValueError, match=r"must be a file that ends in \.gif or \.mp4"):
        recording.EvaluationVideos(tmp_path, ".avi")
