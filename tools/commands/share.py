"""``arcade-torch push`` and ``arcade-torch pull``: agents to and from others."""

import tempfile
from dataclasses import dataclass
from pathlib import Path

import tyro

from arcade_torch.agents.checked import require
from arcade_torch.agents.runs.files import check_writable_folder, read_bytes
from arcade_torch.agents.runs.shipped import agent_folder
from arcade_torch.tools.imports import existing_agent, import_again
from arcade_torch.tools.options import Command, at_least
from arcade_torch.tools.switches import Unless
from arcade_torch.tools.text import counted, say

MOST_EXTRA = 64 * 2**20
"""Bytes of the largest film, page or table of results that is fetched."""


@dataclass(kw_only=True)
class Push(Command):
    """Put a trained agent on the Hugging Face hub, or into a local folder in the same form.

    It writes config.json, model.safetensors, results.json, a model card with its metrics,
    .eval_results and a film of an episode, and evaluates what was written. The hub needs the extra
    hub and a login (hf auth login).

    Example: arcade-torch push runs/one someone/ppo-lru-signposteasy-partial
    """

    run_folder: tyro.conf.PositionalRequiredArgs[tyro.conf.Positional[Path]]
    """Run folder or checkpoint."""
    repo: tyro.conf.PositionalRequiredArgs[tyro.conf.Positional[str]]
    """Repository owner/name; or a folder: one that is there, or a name that begins with . or /"""
    episodes: int = 1024  # Greedy ones, for the results.
    half: bool = False  # Store the weights as float16; both returns stand in results.json.
    film: Unless = True  # Whether a film of an episode is written.
    private: bool = False  # Make a private repository.
    message: str = "Add an agent"  # Of the commit.

    def run(self) -> int:
        """Write, evaluate, and upload unless it is a folder."""
        run = existing_agent(self.run_folder)
        from arcade_torch.agents import hub
        from arcade_torch.tools.sharing import card
        from arcade_torch.tools.sharing.share import share

        at_least(self, episodes=1)
        import_again(run)
        into_folder = is_folder(self.repo)
        allowed = "owner/name, or a folder that begins with ./ or /"
        require(into_folder or hub.is_repo(self.repo), "the repository", self.repo, allowed)
        with tempfile.TemporaryDirectory() as scratch:
            folder = Path(self.repo).expanduser() if into_folder else Path(scratch) / "agent"
            check_writable_folder(folder)
            name = "" if into_folder else self.repo
            results = share(run, folder, name, self.episodes, self.half, self.film)
            place = str(folder)
            if not into_folder:
                place = hub.upload(folder, self.repo, self.message, self.private)
        say(f"mean return {results['mean_reward']:.3f} over {counted(self.episodes, 'episode')}")
        say(f"sha256 {results['sha256']['model.safetensors']}")
        say(f"pushed: {place}")
        if into_folder:
            say(f"a name for the hub: OWNER/{card.suggested_name(results)}")
        return 0


@dataclass(kw_only=True)
class Pull(Command):
    """Fetch an agent from the Hugging Face hub, or from a local folder, and check it.

    Its hash is checked before anything is read, nothing is unpickled, and no code is taken: where
    the memory is somebody's own, pass --import with its file. What is fetched can stand wherever a
    run folder can: play, record, evaluate, analyze, figure.

    Example: arcade-torch pull someone/ppo-lru-signposteasy-partial --revision v1 --out agents/one
    """

    repo: tyro.conf.PositionalRequiredArgs[tyro.conf.Positional[str]]
    """Repository owner/name, or a folder."""
    revision: str | None = None  # Branch, tag or commit; the newest commit by default.
    sha256: str | None = None  # What the hash of model.safetensors has to be.
    out: Path | None = None  # Folder that it goes to; agents/NAME by default.

    def run(self) -> int:
        """Fetch, check, write."""
        from arcade_torch.agents import hub
        from arcade_torch.agents.policy import agent_of
        from arcade_torch.agents.pretrained import read_fetched, read_shared
        from arcade_torch.agents.runs.bundle import (
            CONFIG,
            MOST_BYTES,
            WEIGHTS,
            check_hash,
            is_bundle,
        )
        from arcade_torch.agents.runs.files import checksum
        from arcade_torch.tools.sharing.place import FILMS, put_files
        from arcade_torch.tools.sharing.share import (
            EVALUATION,
            README,
            RESULTS,
            check_recorded,
        )

        if self.sha256 is not None:
            check_hash(self.sha256)
        extras = (README, RESULTS, EVALUATION, *FILMS)
        sizes = MOST_BYTES | dict.fromkeys(extras, MOST_EXTRA)
        source = agent_folder(Path(self.repo).expanduser())
        if is_folder(self.repo) or source.is_dir():
            require(self.revision is None, "--revision", self.revision, "left out: it is a folder")
            checkpoint = read_shared(source, self.sha256)
        else:
            allowed = "owner/name, or a folder"
            require(hub.is_repo(self.repo), "the repository", self.repo, allowed)
            source = hub.download(self.repo, sizes, extras, self.revision)
            checkpoint = read_fetched(source, self.sha256)
        agent = agent_of(checkpoint, "cpu")
        if source.is_dir() and not is_bundle(source):
            raise ValueError(
                f"{source} is no agent that was shared, it has no {WEIGHTS}: a run folder can be "
                "used as it is, or pushed into a folder first"
            )
        out = self.out or Path("agents") / source_name(self.repo)
        if out.exists():
            raise FileExistsError(f"{out} exists: choose another folder with --out")
        check_writable_folder(out)
        files = dict[str, bytes]()
        for name in (CONFIG, WEIGHTS, *extras):
            if (source / name).is_file():
                files[name] = read_bytes(source / name, sizes[name])
        check_recorded(files)
        put_files(files, out)
        config = agent.config
        say(f"{config.algorithm}-{config.memory} on {config.env} ({config.observability})")
        say(f"sha256 {checksum(out / WEIGHTS)}")
        say(f"pulled: {out}")
        return 0


def is_folder(repo: str) -> bool:
    """Whether somebody means a folder: one that is there, or a name that no repository has."""
    return repo.startswith((".", "/", "~")) or Path(repo).is_dir()


def source_name(repo: str) -> str:
    """The last part of a repository's or a folder's name."""
    return Path(repo).expanduser().resolve().name
