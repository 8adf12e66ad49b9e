"""``arcade-torch train`` and ``arcade-torch evaluate``."""

import os
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from arcade_torch.agents.config import TrainConfig
from arcade_torch.agents.presets import preset
from arcade_torch.agents.runs.files import check_writable, read_json, write_json
from arcade_torch.envs_jax import resolve_id
from arcade_torch.tools.imports import existing_agent, import_again, imports_of, load_agent
from arcade_torch.tools.memory_files import LateImports, check_memory_of
from arcade_torch.tools.options import Command, at_least, command_line, name_and_value
from arcade_torch.tools.options import parse as parse_options
from arcade_torch.tools.switches import Unless
from arcade_torch.tools.text import say

if TYPE_CHECKING:
    from arcade_torch.agents.evaluation import EvalResult

SLOWER = 1.05
"""Times as long as without: from there on ``train`` says that ``--amp`` costs time."""


@dataclass
class Train(Command):
    """Train one agent into a run folder: settings, logs, checkpoints, final evaluation.

    Options start from a preset (paper, reference, small, smoke) or from a JSON file; the resolved
    settings are kept in the folder's config.json. Numbers of the learner are --pqn.*, --ppo.* or
    --dqn.*, whichever --algorithm names.

    Example: arcade-torch train --preset small --env MineSweeperEasy --observability partial --out
    runs/one
    """

    settings: Annotated[TrainConfig, tyro.conf.arg(name="")]
    preset: str = "paper"  # Settings to start from.
    config: Path | None = None
    """JSON file to start from in the place of a preset: a run's config.json, or one that a study
    wrote.
    """
    env_option: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """NAME=VALUE, an option of the game; may be given several times."""
    network_option: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """NAME=VALUE, an option of the network; may be given several times."""
    # Run folder; runs/ENV__OBSERVABILITY__MEMORY__ALGORITHM__seedN by default, as in a study.
    out: Path | None = None
    resume: bool = False  # Go on with the run in that folder.
    # Seconds to wait until another process that trains in that folder has stopped.
    wait: float = 0.0
    check_memory: Unless = True
    """Whether the laws that a memory has to keep are checked before a model of yours is trained
    (about a second).
    """
    videos: Literal["none", "gif", "mp4"] = "none"
    """Film one greedy episode at every evaluation into the run folder's videos/; mp4 needs the
    extra video.
    """

    @classmethod
    def parse(cls, argv: Sequence[str], prog: str) -> Any:
        """Read the options; what is not given comes from the config file or the preset."""
        given = _flags(argv)
        if "preset" in given and "config" in given:
            raise ValueError("give --preset or --config to start from, not both")
        if "config" in given:
            start = _read_config(Path(given["config"]))
        else:
            # A preset's numbers depend on these two, and the help shows them.
            decisive: dict[str, Any] = {
                name: given[name] for name in ("env", "algorithm") if given.get(name)
            }
            start = preset(given.get("preset", "paper"), **decisive)
        parsed = parse_options(cls, argv, prog, cls(start))
        settings = parsed.settings
        if "config" not in given:
            names = {name.partition(".")[0].removeprefix("no_") for name in given}
            names &= {setting.name for setting in fields(TrainConfig)}
            chosen = {name: getattr(settings, name) for name in names}
            settings = preset(parsed.preset, **chosen)
        of_env = dict(map(name_and_value, parsed.env_option))
        of_network = dict(map(name_and_value, parsed.network_option))
        settings = replace(
            settings,
            env_options={**settings.env_options, **of_env},
            network_options={**settings.network_options, **of_network},
        )
        return replace(parsed, settings=settings)

    def run(self) -> int:
        """Train."""
        from arcade_torch.agents.runs.folder import wait_until_free
        from arcade_torch.agents.training import train
        from arcade_torch.tools.exploring import stopped_exploring
        from arcade_torch.tools.machine import (
            PARENT_VARIABLE,
            bfloat16_time,
            keep_freed_memory,
            watch_parent,
        )
        from arcade_torch.tools.progress import Bars, describe_row
        from arcade_torch.tools.runs import Run

        at_least(self, wait=0)
        watch_parent()
        keep_freed_memory()
        run = self.settings
        film = None
        folder = self.out or _run_folder(run)
        if self.videos != "none":
            from arcade_torch.tools.play.recording import EvaluationVideos

            film = EvaluationVideos(folder / "videos", f".{self.videos}")
        wait_until_free(folder, self.wait)
        if self.resume and not (folder / "config.json").exists():
            say(f"no run in {folder} to go on with: this one begins")
        if self.resume:
            import_again(folder)
        # a study has checked what its workers train, and a run that was begun what it goes on with
        is_first = PARENT_VARIABLE not in os.environ and not (folder / "config.json").exists()
        if self.check_memory and is_first:
            check_memory_of(run)
        if is_first and run.amp and run.device == "cpu":
            share = bfloat16_time(run)
            if share > SLOWER:
                say(f"--amp costs time here: the encoder takes {share:.2f} times as long with it")
        note_late = LateImports(folder, run)
        with Bars(unit="frames", first_line_s=0.0) as bars:

            def show(row: Any) -> None:
                note_late(row)
                bars.update(
                    str(folder), int(row["frames"]), int(row["total_frames"]), describe_row(row)
                )

            result = train(run, folder, self.resume, show, film, imports_of(run))
        if result.evaluation is None:
            raise KeyboardInterrupt
        say(
            f"greedy return {result.evaluation.mean:.3f} over {len(result.evaluation.returns)} "
            "episodes"
        )
        _say_each_game(result.evaluation)
        if reason := stopped_exploring(Run(result.run_dir)):
            say(f"this run {reason}")
        say(f"finished: {result.run_dir}")
        return 0

    def resume_hint(self) -> str:
        """The command that goes on."""
        argv = [word for word in self.argv if word != "--resume"]
        return f"go on with: {command_line(['train', *argv, '--resume'])}"


@dataclass
class Evaluate(Command):
    """Play greedy episodes with a trained agent on held-out seeds and print the mean return.

    Example: arcade-torch evaluate runs/one --episodes 256 --observability full
    """

    # Run folder, checkpoint, or an agent of this package by its name.
    run_folder: tyro.conf.PositionalRequiredArgs[tyro.conf.Positional[Path]]
    episodes: int = 128  # Number of episodes, each in an environment of its own.
    # Another twin than the agent was trained on.
    observability: Literal["full", "partial"] | None = None
    # Another game than the agent was trained on, or one of its several.
    game: str | None = None
    json: Path | None = None  # File for the numbers; not overwritten.

    def run(self) -> int:
        """Evaluate and print."""
        existing_agent(self.run_folder)
        from arcade_torch.agents.evaluation import evaluate

        if self.json is not None and self.json.exists():
            raise FileExistsError(f"{self.json} exists: choose another file")
        if self.json is not None:
            check_writable(self.json)
        agent = load_agent(self.run_folder)
        result = evaluate(agent, self.observability, self.episodes, game=self.game)
        config = agent.config
        twin = self.observability or agent.config.observability
        game = resolve_id(self.game or config.env)
        which = f"{config.algorithm}-{config.memory} on {game} ({twin}), seed {config.seed}"
        say(f"{which}, {agent.frames:,} frames of training: {result.text}")
        _say_each_game(result)
        if self.json is not None:
            episodes: dict[str, Any] = {
                "returns": result.returns.tolist(),
                "lengths": result.lengths.tolist(),
            }
            if result.games:
                episodes["games"] = list(result.games)
            write_json(
                self.json, episodes | {"mean": result.mean, "half_width_95": result.half_width}
            )
        return 0


def _say_each_game(result: "EvalResult") -> None:
    """Of a mixture, print the return in each game."""
    for game, episodes in result.by_game.items():
        say(f"  {game}: {episodes.text}")


def _run_folder(run: TrainConfig) -> Path:
    """Where a run goes by default: its name is that of a study."""
    from arcade_torch.tools.studies.grid import RunSpec

    spec = RunSpec(run.env, run.observability, run.memory, run.algorithm, run.seed)
    return Path("runs") / spec.name


def _read_config(file: Path) -> TrainConfig:
    if not file.is_file():
        raise FileNotFoundError(
            f"no config at {file}: give the config.json of a run, or one that a study wrote"
        )
    values = read_json(file)
    if isinstance(values, dict) and "config" in values:
        misplaced = {setting.name for setting in fields(TrainConfig)} & set(values)
        if misplaced:
            raise ValueError(
                f'{file} has settings outside of its table "config", where they would not be '
                f"looked at: {', '.join(sorted(misplaced))}; move them into it"
            )
        values = values["config"]
    try:
        return TrainConfig.from_dict(values)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{file} holds no config: {error}") from error


def _flags(argv: Sequence[str]) -> dict[str, str]:
    """Names and values of options before they are read: of ``--total-frames 5`` or
    ``--total-frames=5``.
    """
    values = {}
    for word, following in zip(argv, [*argv[1:], ""], strict=True):
        name, equals, value = word.partition("=")
        if name.startswith("--"):
            values[name[2:].replace("-", "_")] = value if equals else following
    return values
