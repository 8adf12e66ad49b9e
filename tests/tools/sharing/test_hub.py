"""Push and pull through ``huggingface_hub`` itself, against a hub on loopback."""

import hashlib
import importlib.util
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest

from arcade_torch.agents import from_pretrained
from arcade_torch.agents import hub as hub_module
from arcade_torch.agents.hub import HubError, download, is_repo
from arcade_torch.agents.runs.files import CheckpointError
from arcade_torch.agents.runs.shipped import SHIPPED
from tests.tools.sharing.fake_hub import FakeHub, serving

AGENT = "signpost-partial-lru"
REPO = "somebody/ppo-lru"

needs_hub = pytest.mark.skipif(
    importlib.util.find_spec("huggingface_hub") is None,
    reason="needs the hub extra: pip install '.[hub]'",
)


@pytest.fixture
def hub() -> Iterator[tuple[FakeHub, str]]:
    with serving() as pair:
        yield pair


def arcade(address: str, home: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """The command line in a process of its own: the address is read when the client is imported."""
    settings = {"HF_ENDPOINT": address, "HF_HOME": str(home), "HF_TOKEN": "hf_" + "x" * 34}
    settings |= {"HF_HUB_DISABLE_TELEMETRY": "1", "HF_HUB_DISABLE_XET": "1", "NO_PROXY": "*"}
    command = [sys.executable, "-m", "arcade_torch.tools", *words]
    return subprocess.run(
        command, env=os.environ | settings, capture_output=True, text=True, timeout=300
    )


@needs_hub
def test_an_agent_goes_to_the_hub_and_comes_back_to_the_bit(
    hub: tuple[FakeHub, str], tmp_path: Path
) -> None:
    server, address = hub
    words = ("push", AGENT, REPO, "--episodes", "4", "--no-film", "--half")
    pushed = arcade(address, tmp_path / "home", *words)
    assert pushed.returncode == 0, pushed.stderr
    assert f"pushed: {address}/{REPO}" in pushed.stdout
    commit, files = server.files(REPO)
    assert server.token.startswith("Bearer hf_")
    names = {"config.json", "model.safetensors", "README.md", "results.json"}
    assert set(files) == names | {".eval_results/arcade-torch.yaml"}
    sha256 = hashlib.sha256(files["model.safetensors"]).hexdigest()
    out = tmp_path / "pulled"
    again = ("pull", REPO, "--sha256", sha256, "--revision", commit, "--out", str(out))
    pulled = arcade(address, tmp_path / "home", *again)
    assert pulled.returncode == 0, pulled.stderr
    for name, data in files.items():
        assert (out / name).read_bytes() == data


@needs_hub
def test_what_the_hub_refuses_is_one_line(hub: tuple[FakeHub, str], tmp_path: Path) -> None:
    server, address = hub
    home = tmp_path / "home"
    missing = arcade(address, home, "pull", "no/body", "--out", str(tmp_path / "out"))
    assert missing.returncode == 2 and missing.stderr.count("\n") == 1, missing.stderr
    assert "of no/body: RepositoryNotFoundError" in missing.stderr
    files = {name: (SHIPPED / AGENT / name).read_bytes() for name in ("config.json",)}
    files["model.safetensors"] = (SHIPPED / "signpost-full-lru/model.safetensors").read_bytes()
    server.commit(REPO, files)
    other = arcade(address, home, "pull", REPO, "--out", str(tmp_path / "out"))
    assert other.returncode == 2 and "is not the one that" in other.stderr, other.stderr
    server.commit(REPO, {"config.json": b" " * (2**20 + 1)})
    large = arcade(address, home, "pull", REPO, "--out", str(tmp_path / "out"))
    assert large.returncode == 2 and "at most 1,048,576 are fetched" in large.stderr
    assert not any(line.startswith("GET") and "config" in line for line in server.asked[-2:])
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["a/b", "Some-body/ppo_lru.v1"])
def test_names_of_repositories(name: str) -> None:
    assert is_repo(name)


@pytest.mark.parametrize(
    "name", ["a", "a/b/c", "../b", "a/../b", "a/ b", "https://x/y", "/a/b", ""]
)
def test_names_of_none(name: str) -> None:
    assert not is_repo(name)


class HfHubHTTPError(OSError):
    """As in huggingface_hub.errors: the hub has answered."""


class RemoteEntryNotFoundError(HfHubHTTPError):
    """There is no such file in the repository."""


class LocalEntryNotFoundError(FileNotFoundError):
    """The hub could not be asked, and the file is not in the cache."""


class FakeClient:
    """As much of huggingface_hub as is used: a cache with one commit, and what asking raises."""

    def __init__(self, cache: Path, ask: Callable[[str], object]) -> None:
        self.snapshot = cache / "models--a--b" / "snapshots" / "c0ffee"
        self.ask = ask

    def hf_hub_url(self, repo: str, name: str, revision: str | None) -> str:
        return name

    def get_hf_file_metadata(self, name: str) -> SimpleNamespace:
        self.ask(name)
        return SimpleNamespace(size=1, commit_hash="c0ffee")

    def hf_hub_download(self, repo: str, name: str, revision: str | None) -> str:
        return str(self.snapshot / name)

    def try_to_load_from_cache(self, repo: str, name: str, revision: str | None) -> str | None:
        file = self.snapshot / name
        return str(file) if file.is_file() and revision in (None, "c0ffee") else None


def fails(error: Exception, name: str = "") -> Callable[[str], object]:
    """Asking that fails, for one file or for all."""

    def ask(asked: str) -> None:
        if not name or asked == name:
            raise error

    return ask


@pytest.fixture
def client(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[[Callable[[str], object]], FakeClient]:
    def make(ask: Callable[[str], object]) -> FakeClient:
        fake = FakeClient(tmp_path, ask)
        monkeypatch.setattr(hub_module, "_package", lambda: fake)
        return fake

    return make


Client = Callable[[Callable[[str], object]], FakeClient]


@pytest.mark.parametrize(
    ("error", "remedy"),
    [
        (TimeoutError("timed out"), "is the network up"),
        (LocalEntryNotFoundError("cannot find it"), "is the network up"),
        (RemoteEntryNotFoundError("404 Client Error."), "404 Client Error; was it put there by"),
        (HfHubHTTPError("401 Client Error."), "are you logged in"),
        (OSError(28, "No space left on device"), "No space left on device"),
    ],
)
def test_a_failed_download_says_what_helps(client: Client, error: Exception, remedy: str) -> None:
    """Before: every one of them asked for another name or a login."""
    client(fails(error))
    with pytest.raises(HubError, match=remedy) as told:
        download("a/b", {"config.json": 10})
    assert "logged in" in remedy or "logged in" not in str(told.value)


def test_without_a_network_an_agent_comes_from_the_cache(client: Client) -> None:
    """Before: refused, so that nodes without a network could not load what is on their disk."""
    fake = client(fails(ConnectionError("unreachable")))
    shutil.copytree(SHIPPED / AGENT, fake.snapshot)
    with pytest.warns(UserWarning, match="a/b: the hub cannot be reached, commit c0ffee is taken"):
        assert from_pretrained("a/b").config.memory == "lru"
    with pytest.raises(HubError, match="is the network up"):
        from_pretrained("a/b", revision="v2")


def test_a_network_that_fails_on_the_way_leaves_no_file_out(client: Client) -> None:
    """Before: a README that could not be asked for was passed over like one that is not there."""
    client(fails(LocalEntryNotFoundError("cannot find it"), "README.md"))
    with pytest.raises(HubError, match=r"README\.md of a/b: .*is the network up"):
        download("a/b", {"config.json": 10, "README.md": 10}, ["README.md"])


def test_a_damaged_copy_in_the_cache_says_what_to_delete(client: Client) -> None:
    """Before: the same line at every try, for the hub's client never looks at what it has."""
    fake = client(lambda name: None)
    shutil.copytree(SHIPPED / AGENT, fake.snapshot)
    weights = fake.snapshot / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:500])
    folder = fake.snapshot.parent.parent
    with pytest.raises(CheckpointError, match=f"cannot be read.*delete {folder} and fetch it"):
        from_pretrained("a/b")
