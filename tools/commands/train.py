"""``arcade-torch train``."""

import dataclasses
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from arcade_torch.agents.config import TrainConfig
from arcade_torch.agents.presets import preset
from arcade_torch.tools import cli
from arcade_torch.tools.extensions import command_line
from arcade_torch.tools.name_value import name_and_value
from arcade_torch.tools.train_bar import TrainBar

_WHOLE = re.compile(r"\d+(\.\d*)?[eE]\+?\d+")


@dataclass
class Train:
    """Train one agent into a run folder: settings, logs, checkpoints, final evaluation.

    Options start from a preset (paper, reference, small, smoke); the resolved settings are kept in the folder's
    config.json. Numbers of the learner are --pqn.*, --ppo.* or --dqn.*, whichever --algorithm names.

    Example: arcade-torch train --preset small --env MineSweeperEasy --observability partial --out runs/one
    """

    config: Annotated[TrainConfig, tyro.conf.arg(name="")]
    preset: str = "paper"
    """Settings to start from."""
    env_option: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """NAME=VALUE, an option of the game; may be given several times."""
    network_option: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """NAME=VALUE, an option of the network; may be given several times."""
    out: Path | None = None
    """Run folder; runs/ENV-OBSERVABILITY-MEMORY-ALGORITHM-SEED by default."""
    resume: bool = False
    """Go on with the run in that folder."""
    seeds: tuple[int, ...] = ()
    """Train these seeds of PQN together in one process, each in a run folder of its own: OUT/seed0 and so on, or the
    default folders. With --resume those that are not finished go on from the last checkpoint that all of them have."""
    videos: Literal["none", "gif", "mp4"] = "none"
    """Film one greedy episode at every evaluation into the run folder's videos/; mp4 needs the extra video."""
    words: tyro.conf.Suppress[tuple[str, ...]] = ()

    def folder(self, seed: int | None = None) -> Path:
        """The run folder; with ``seed``, that of one of several seeds."""
        config = self.config
        if self.out is not None:
            return self.out if seed is None else self.out / f"seed{seed}"
        name = f"{config.env}-{config.observability}-{config.memory}-{config.algorithm}"
        return Path("runs") / f"{name}-seed{config.seed if seed is None else seed}"

    def run(self) -> int:
        """Train."""
        from arcade_torch.agents import train, train_seeds
        from arcade_torch.tools.keep_memory import keep_freed_memory
        from arcade_torch.tools.studies.engines import watch_parent

        watch_parent()
        keep_freed_memory()
        if self.seeds:
            folders = [self.folder(seed) for seed in self.seeds]
            with TrainBar(f"{len(folders)} seeds") as bar:
                films = self._films(dict(zip(self.seeds, folders, strict=True)))
                results = train_seeds(self.config, self.seeds, folders, self.resume, bar.update, films)
        else:
            folder = self.folder()
            with TrainBar(str(folder)) as bar:
                films = self._films({self.config.seed: folder})
                results = [train(self.config, folder, self.resume, bar.update, films)]
        if any(result.status == "interrupted" for result in results):
            raise KeyboardInterrupt
        for result in results:
            assert result.evaluation is not None
            print(f"greedy return {result.evaluation.mean:.3f} over {len(result.evaluation.returns)} episodes")
            print(f"finished: {result.run_dir}")
        return 0

    def _films(self, folders: Mapping[int, Path]) -> Callable[[Any], None] | None:
        """What films the agents into the folders of their seeds."""
        if self.videos == "none":
            return None
        from arcade_torch.tools.record.evaluations import EvaluationVideos

        films = {seed: EvaluationVideos(folder / "videos", f".{self.videos}") for seed, folder in folders.items()}
        return lambda agent: films[agent.config.seed](agent)

    def how_to_go_on(self) -> str:
        """What to type after an interruption."""
        words = [word for word in self.words if word != "--resume"]
        return f"go on with: {command_line(['train', *words, '--resume'])}"


COMMAND = Train


def parse(words: Sequence[str], prog: str) -> Train:
    """Read the options; what is not given comes from the preset.

    Args:
        words: the options.
        prog: the command, for messages.

    Raises:
        ValueError: an option or the preset is unknown, or a value is not allowed.
    """
    words = [_plain_number(word) for word in words]
    if _peek(words, "--seed") is not None and _peek(words, "--seeds") is not None:
        raise ValueError("give --seed for one run or --seeds for several, not both")
    name = _peek(words, "--preset") or "paper"
    # The preset's numbers depend on these two, and the help shows them.
    decisive = {key: _peek(words, f"--{key}") for key in ("env", "algorithm")}
    base = preset(name, **{key: value for key, value in decisive.items() if value})
    parsed: Train = cli.parse(Train, words, prog, Train(base, name))
    given = {word[2:].partition("=")[0].replace("-", "_") for word in words if word.startswith("--")}
    changes = _changes(base, parsed.config, given, "")
    for key, pairs in (("env_options", parsed.env_option), ("network_options", parsed.network_option)):
        if pairs:
            changes[key] = {**getattr(base, key), **dict(map(name_and_value, pairs))}
    return dataclasses.replace(parsed, config=preset(name, **changes), words=tuple(words))


def _changes(base: Any, parsed: Any, given: set[str], prefix: str) -> dict[str, Any]:
    """Fields that were given or differ, nested dataclasses as dictionaries."""
    found: dict[str, Any] = {}
    for item in dataclasses.fields(base):
        old, new = getattr(base, item.name), getattr(parsed, item.name)
        if dataclasses.is_dataclass(old):
            inner = _changes(old, new, given, f"{prefix}{item.name}.")
            if inner:
                found[item.name] = inner
        elif old != new or prefix + item.name in given:
            found[item.name] = new
    return found


def _peek(words: Sequence[str], flag: str) -> str | None:
    for index, word in enumerate(words):
        if word == flag and index + 1 < len(words):
            return words[index + 1]
        if word.startswith(flag + "="):
            return word.partition("=")[2]
    return None


def _plain_number(word: str) -> str:
    """Write 2e7 as 20000000, which an option that counts can read."""
    if _WHOLE.fullmatch(word) and float(word).is_integer():
        return str(int(float(word)))
    return word
