"""``arcade-torch train``."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from arcade_torch.agents.config import TrainConfig
from arcade_torch.agents.presets import preset
from arcade_torch.agents.runs.files import read_json
from arcade_torch.tools.extensions import command_line
from arcade_torch.tools.options import name_and_value
from arcade_torch.tools.options import parse as parse_options
from arcade_torch.tools.progress import TrainBar


@dataclass
class Train:
    """Train one agent into a run folder: settings, logs, checkpoints, final evaluation.

    Options start from a preset (paper, reference, small, smoke) or from a JSON file; the resolved settings are kept in
    the folder's config.json. Numbers of the learner are --pqn.*, --ppo.* or --dqn.*, whichever --algorithm names.

    Example: arcade-torch train --preset small --env MineSweeperEasy --observability partial --out runs/one
    """

    settings: Annotated[TrainConfig, tyro.conf.arg(name="")]
    preset: str = "paper"
    """Settings to start from."""
    config: Path | None = None
    """JSON file to start from in the place of a preset: a run's config.json, or one that a study wrote."""
    env_option: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """NAME=VALUE, an option of the game; may be given several times."""
    network_option: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """NAME=VALUE, an option of the network; may be given several times."""
    out: Path | None = None
    """Run folder; runs/ENV-OBSERVABILITY-MEMORY-ALGORITHM-SEED by default."""
    resume: bool = False
    """Go on with the run in that folder."""
    wait: float = 0.0
    """Seconds to wait until another process that trains in that folder has stopped."""
    videos: Literal["none", "gif", "mp4"] = "none"
    """Film one greedy episode at every evaluation into the run folder's videos/; mp4 needs the extra video."""
    argv: tyro.conf.Suppress[tuple[str, ...]] = ()

    def run(self) -> int:
        """Train."""
        from arcade_torch.agents import train
        from arcade_torch.agents.runs.folder import wait_until_free
        from arcade_torch.tools.keep_memory import keep_freed_memory
        from arcade_torch.tools.studies.engines import watch_parent

        watch_parent()
        keep_freed_memory()
        run, film = self.settings, None
        name = f"{run.env}-{run.observability}-{run.memory}-{run.algorithm}-seed{run.seed}"
        folder = self.out or Path("runs") / name
        if self.videos != "none":
            from arcade_torch.tools.play.recording import EvaluationVideos

            film = EvaluationVideos(folder / "videos", f".{self.videos}")
        wait_until_free(folder, self.wait)
        with TrainBar(str(folder)) as bar:
            result = train(run, folder, self.resume, bar.show, film)
        if result.evaluation is None:
            raise KeyboardInterrupt
        print(f"greedy return {result.evaluation.mean:.3f} over {len(result.evaluation.returns)} episodes")
        print(f"finished: {result.run_dir}")
        return 0

    def resume_hint(self) -> str:
        """What to type after an interruption."""
        argv = [word for word in self.argv if word != "--resume"]
        return f"go on with: {command_line(['train', *argv, '--resume'])}"


COMMANDS = {"train": Train}


def parse(argv: Sequence[str], prog: str) -> Train:
    """Read the options; what is not given comes from the config file or the preset."""
    name, file = _peek(argv, "--preset"), _peek(argv, "--config")
    if name is not None and file is not None:
        raise ValueError("give --preset or --config to start from, not both")
    # A preset's numbers depend on these two, and the help shows them.
    decisive = {key: value for key in ("env", "algorithm") if (value := _peek(argv, f"--{key}"))}
    base = preset(name or "paper", **decisive) if file is None else _read_config(Path(file))
    parsed: Train = parse_options(Train, argv, prog, Train(base))
    settings = parsed.settings if file else preset(parsed.preset, **_given(parsed.settings, argv))
    options = {"env_options": parsed.env_option, "network_options": parsed.network_option}
    more: dict[str, Any] = {
        key: {**getattr(settings, key), **dict(map(name_and_value, pairs))} for key, pairs in options.items()
    }
    return dataclasses.replace(parsed, settings=dataclasses.replace(settings, **more))


def _read_config(file: Path) -> TrainConfig:
    if not file.is_file():
        raise FileNotFoundError(f"no config at {file}: give the config.json of a run, or one that a study wrote")
    values = read_json(file)
    try:
        return TrainConfig.from_dict(values["config"] if isinstance(values, dict) and "config" in values else values)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{file} holds no config: {error}") from error


def _given(settings: TrainConfig, argv: Sequence[str]) -> dict[str, Any]:
    """The fields that were given, be it with the value of the preset; those of a learner as a dictionary."""
    found: dict[str, Any] = {}
    for word in argv:
        group, _, name = word.partition("=")[0].removeprefix("--").replace("-", "_").rpartition(".")
        name = name.removeprefix("no_")
        owner: Any = getattr(settings, group, None) if group else settings
        if word.startswith("--") and name in {item.name for item in dataclasses.fields(owner)}:
            (found.setdefault(group, {}) if group else found)[name] = getattr(owner, name)
    return found


def _peek(argv: Sequence[str], flag: str) -> str | None:
    """The value of an option, before options are read."""
    for word, following in zip(argv, [*argv[1:], None], strict=True):
        if word == flag or word.startswith(flag + "="):
            return following if word == flag else word.partition("=")[2]
    return None
