"""Files of a repository on the Hugging Face hub, through ``huggingface_hub`` (the extra ``hub``),
which is imported on first use.
"""

import re
from collections.abc import Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

_REPO = re.compile(r"[A-Za-z0-9][\w.-]{0,95}/[A-Za-z0-9][\w.-]{0,95}", re.ASCII)


class HubError(RuntimeError):
    """A repository cannot be read or written; says how to go on."""


def is_repo(name: str) -> bool:
    """Whether a text can be the name of a repository, ``owner/name``.

    Example:
        >>> is_repo("popgym/ppo-lru-signpost"), is_repo("./agents/one")
        (True, False)
    """
    return _REPO.fullmatch(name) is not None


def download(
    repo: str, files: Mapping[str, int], optional: Sequence[str] = (), revision: str | None = None
) -> Path:
    """Fetch files of a repository into the hub's cache.

    Args:
        repo: ``owner/name``.
        files: names, each with the most bytes that are fetched.
        optional: those that may be missing.
        revision: branch, tag or commit; the newest commit of the main branch by default. All files
            are of one commit.

    Returns:
        The folder in the cache.

    Raises:
        HubError: the package is not installed, a file is missing or too large, or the hub cannot be
            reached.
    """
    hub = _package()
    folder: Path | None = None
    commit = revision
    for name, most_bytes in files.items():
        try:
            about = hub.get_hf_file_metadata(hub.hf_hub_url(repo, name, revision=commit))
            if about.size is None or about.size > most_bytes:
                raise HubError(
                    f"{name} of {repo} has {about.size or 'an unknown number of'} bytes, at most "
                    f"{most_bytes:,} are fetched"
                )
            commit = about.commit_hash or commit
            file = Path(hub.hf_hub_download(repo, name, revision=commit))
            folder = file.parents[name.count("/")]
        except HubError:
            raise
        except Exception as error:
            if name in optional and type(error).__name__.endswith("EntryNotFoundError"):
                continue
            raise _refused(repo, name, error) from error
    if folder is None:
        raise HubError(f"{repo} holds none of {', '.join(files)}")
    return folder


def upload(folder: Path, repo: str, message: str, private: bool = False) -> str:
    """Make a repository, if there is none, and put the files of a folder into it.

    Returns:
        The address of its page.

    Raises:
        HubError: the package is not installed, nobody is logged in, or the hub refuses.
    """
    hub = _package()
    try:
        address = hub.create_repo(repo, private=private, exist_ok=True)
        hub.upload_folder(repo_id=repo, folder_path=str(folder), commit_message=message)
    except Exception as error:
        raise _refused(repo, "", error) from error
    return str(address)


def _package() -> Any:
    """``huggingface_hub``, or how to get it."""
    try:
        return import_module("huggingface_hub")
    except ModuleNotFoundError as error:
        raise HubError(
            "the package huggingface_hub is missing: pip install '.[hub]'; a local folder works "
            "without"
        ) from error


def _refused(repo: str, name: str, error: Exception) -> HubError:
    """What the hub says, in a line."""
    lines = str(error).strip().splitlines() or [type(error).__name__]
    place = f"{name} of {repo}" if name else repo
    return HubError(
        f"{place}: {type(error).__name__}, {lines[0][:200]}; is the name right, and are you logged "
        "in (hf auth login) where it is private or yours to write?"
    )
