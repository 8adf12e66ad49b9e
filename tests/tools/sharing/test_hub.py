"""Push and pull through ``huggingface_hub`` itself, against a hub on loopback."""

import hashlib
import importlib.util
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from arcade_torch.agents.hub import is_repo
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
