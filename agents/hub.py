"""Files of a repository on the Hugging Face hub, through ``huggingface_hub`` (the extra ``hub``),
which is imported on first use.
"""

import re
import warnings
from collections.abc import Iterable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

_UNANSWERED = (
    "LocalEntryNotFoundError",
    "ConnectionError",
    "Timeout",
    "TimeoutError",
    "TransportError",
    "ChunkedEncodingError",
)
"""Classes of errors of ``huggingface_hub``, ``requests`` and ``httpx`` without an answer."""
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
            are of one commit. Where the hub cannot be reached, what the cache has of it is taken,
            with a warning.

    Returns:
        The folder in the cache.

    Raises:
        HubError: the package is not installed, a file is missing or too large, or the hub cannot be
            reached and the cache has no such commit.
    """
    hub = _package()
    folder: Path | None = None
    commit = revision
    for name, most_bytes in files.items():
        try:
            file, commit = _fetch(hub, repo, name, commit, most_bytes)
        except HubError:
            raise
        except Exception as error:
            if folder is None and _is_unanswered(error):
                kept = _cached(hub, repo, files, optional, revision)
                if kept is not None:
                    return kept
            if name in optional and _is_missing(error):
                continue
            raise _refused(repo, name, error) from error
        folder = file.parents[name.count("/")]
    if folder is None:
        raise HubError(f"{repo} holds none of {', '.join(files)}")
    return folder


def _fetch(
    hub: Any, repo: str, name: str, revision: str | None, most_bytes: int
) -> tuple[Path, str | None]:
    """A file of a repository, in the cache, if it is no larger than that; and its commit."""
    about = hub.get_hf_file_metadata(hub.hf_hub_url(repo, name, revision=revision))
    if about.size is None or about.size > most_bytes:
        raise HubError(
            f"{name} of {repo} has {about.size or 'an unknown number of'} bytes, at most "
            f"{most_bytes:,} are fetched"
        )
    commit = about.commit_hash or revision
    return Path(hub.hf_hub_download(repo, name, revision=commit)), commit


def _cached(
    hub: Any, repo: str, names: Iterable[str], optional: Sequence[str], revision: str | None
) -> Path | None:
    """The folder in the cache with what was fetched before, and a warning; None if a file is not
    there.
    """
    folder: Path | None = None
    commit = revision
    for name in names:
        file = hub.try_to_load_from_cache(repo, name, revision=commit)
        if isinstance(file, str):
            folder = Path(file).parents[name.count("/")]
            commit = folder.name
        elif name not in optional:
            return None
    if folder is not None:
        text = f"{repo}: the hub cannot be reached, commit {commit} is taken from {folder}"
        warnings.warn(text, stacklevel=4)
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
    """What the hub says, in a line, and what may help."""
    lines = str(error).strip().splitlines() or [type(error).__name__]
    place = f"{name} of {repo}" if name else repo
    remedy = ""
    if _is_unanswered(error):
        remedy = "; is the network up?"
    elif _is_missing(error):
        remedy = "; was it put there by arcade-torch push?"
    elif "HfHubHTTPError" in _kinds(error):
        remedy = (
            "; is the name right, and are you logged in (hf auth login) where it is private or "
            "yours to write?"
        )
    said = lines[0][:200].rstrip(".")
    return HubError(f"{place}: {type(error).__name__}, {said}{remedy}")


def _kinds(error: Exception) -> set[str]:
    """Names of the classes of an error: they stand in other modules in every release of the
    package, which passes on those of its own library for HTTP.
    """
    return {kind.__name__ for kind in type(error).__mro__}


def _is_unanswered(error: Exception) -> bool:
    """Whether the hub could not be asked, or did not finish its answer."""
    return not _kinds(error).isdisjoint(_UNANSWERED)


def _is_missing(error: Exception) -> bool:
    """Whether the hub says that it has no such file."""
    return not _is_unanswered(error) and any(
        kind.endswith("EntryNotFoundError") for kind in _kinds(error)
    )
