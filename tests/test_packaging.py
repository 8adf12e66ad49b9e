"""What a user installs: one import package, complete, and working from any directory."""

import os
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import venv
import zipfile
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[1]
LINKED = ("envs_jax", "models", "agents", "tools")
# What the build reads. Nothing else is copied, so that old build output cannot slip into the wheel.
SOURCES = (
    *LINKED,
    "arcade_torch",
    "setup.cfg",
    "pyproject.toml",
    "MANIFEST.in",
    "README.md",
    "LICENSE",
)
METADATA = (
    "CHANGELOG.md",
    "CONTRIBUTING.md",
    "SECURITY.md",
    "constraints.txt",
    "constraints-oldest.txt",
)

STEP_AN_ENV = """
import importlib.util, pathlib, sys
import arcade_torch

installed = pathlib.Path(arcade_torch.__file__).resolve()
assert pathlib.Path(sys.prefix).resolve() in installed.parents, f"imported from {installed}"
for name in ("models", "agents", "tools", "envs_jax"):
    spec = importlib.util.find_spec(name)
    assert spec is None or pathlib.Path(sys.prefix).resolve() not in pathlib.Path(spec.origin or "/").parents, spec

import arcade_torch.agents, arcade_torch.models, arcade_torch.tools
env = arcade_torch.make("MineSweeperEasy", num_envs=2, seed=0)
rollout = env.rollout(3, break_when_any_done=False)
assert rollout["pixels"].shape == (2, 3, 128, 128, 3), rollout["pixels"].shape
print("stepped", arcade_torch.__version__)
"""


def run(*command: str | Path, cwd: Path) -> str:
    """Run a command that must succeed, away from the checkout and its import path."""
    environment = {
        key: value for key, value in os.environ.items() if key not in {"PYTHONPATH", "PYTHONHOME"}
    }
    result = subprocess.run(
        [str(part) for part in command],
        cwd=cwd,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, (
        f"{' '.join(map(str, command))}\n{result.stdout}\n{result.stderr}"
    )
    return result.stdout


def build(what: str, source: Path, target: Path) -> Path:
    """Build "wheel" or "sdist" from a source tree with the installed setuptools; nothing is
    downloaded.
    """
    run(
        sys.executable,
        "-m",
        "build",
        "--no-isolation",
        f"--{what}",
        "--outdir",
        target,
        source,
        cwd=target.parent,
    )
    (made,) = target.glob("*.whl" if what == "wheel" else "*.tar.gz")
    return made


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the checkout as a clone would have it: links stay links."""
    copy = tmp_path_factory.mktemp("packaging") / "source"
    copy.mkdir()
    for name in (*SOURCES, *METADATA):
        if (ROOT / name).is_dir():
            shutil.copytree(
                ROOT / name,
                copy / name,
                symlinks=True,
                ignore=shutil.ignore_patterns("__pycache__"),
            )
        else:
            shutil.copy(ROOT / name, copy / name)
    return copy


@pytest.fixture(scope="module")
def sdist(source: Path) -> Path:
    return build("sdist", source, source.parent / "sdist")


@pytest.fixture(scope="module")
def wheel(source: Path) -> Path:
    return build("wheel", source, source.parent / "wheel")


@pytest.fixture(scope="module")
def installed(wheel: Path) -> Path:
    """An empty environment that got nothing but the wheel."""
    environment = wheel.parents[1] / "environment"
    venv.create(environment, with_pip=False, symlinks=True)
    python = environment / "bin" / "python"
    command = (
        "-m",
        "pip",
        "--python",
        python,
        "install",
        "--quiet",
        "--no-index",
        "--no-deps",
        wheel,
    )
    run(sys.executable, *command, cwd=wheel.parent)
    return environment


def site_packages(environment: Path) -> Path:
    (found,) = environment.glob("lib/python*/site-packages")
    return found


def files_in(wheel: Path) -> set[str]:
    with zipfile.ZipFile(wheel) as archive:
        return {name for name in archive.namelist() if ".dist-info/" not in name}


def test_the_wheel_holds_every_source_file_and_nothing_else(wheel: Path, source: Path) -> None:
    wanted = {
        path.relative_to(source).as_posix() for path in (source / "arcade_torch").glob("*.py")
    }
    wanted |= {
        path.relative_to(source).as_posix()
        for path in (source / "arcade_torch" / "gym").glob("*.py")
    }
    wanted.add("arcade_torch/py.typed")
    for folder in LINKED:
        wanted |= {
            f"arcade_torch/{path.relative_to(source).as_posix()}"
            for path in (source / folder).rglob("*.py")
        }
    for data in ("templates", "data"):
        folder = source / "tools" / data
        wanted |= {
            f"arcade_torch/tools/{data}/{path.name}" for path in folder.glob("*") if path.is_file()
        }
    shipped = source / "agents" / "shipped"
    wanted |= {
        f"arcade_torch/agents/shipped/{path.relative_to(shipped).as_posix()}"
        for path in shipped.rglob("*")
        if path.is_file()
    }
    assert files_in(wheel) == wanted
    assert any(name.startswith("arcade_torch/tools/templates/") for name in wanted), (
        "the report needs its template"
    )


def test_site_packages_gets_one_package_and_its_metadata(installed: Path) -> None:
    found = sorted(
        path.name for path in site_packages(installed).iterdir() if path.name != "__pycache__"
    )
    assert len(found) == 2, found
    assert found[0] == "arcade_torch"
    assert found[1].startswith("arcade_torch-") and found[1].endswith(".dist-info")
    assert not any(path.is_symlink() for path in site_packages(installed).rglob("*"))


def test_the_installed_wheel_steps_an_env_from_another_directory(
    installed: Path, tmp_path: Path
) -> None:
    # The dependencies come from the environment of the tests: a path entry adds them behind the new
    # environment's own.
    shared = site_packages(installed) / "dependencies.pth"
    shared.write_text(sysconfig.get_paths()["purelib"] + "\n")
    try:
        assert "stepped" in run(installed / "bin" / "python", "-c", STEP_AN_ENV, cwd=tmp_path)
        command = installed / "bin" / "arcade-torch"
        assert "MineSweeperEasy" in run(command, "list", cwd=tmp_path)
    finally:
        shared.unlink()


def test_a_wheel_built_from_the_sdist_is_the_same(sdist: Path, wheel: Path, tmp_path: Path) -> None:
    with tarfile.open(sdist) as archive:
        names = archive.getnames()
        assert not any(member.issym() or member.islnk() for member in archive.getmembers())
        safely: Any = {"filter": "data"} if hasattr(tarfile, "data_filter") else {}  # since 3.11.4
        archive.extractall(tmp_path, **safely)
    top = {name.split("/")[1] for name in names if "/" in name}
    assert not top & set(LINKED), "the code folders belong inside arcade_torch"
    assert {
        "arcade_torch",
        "setup.cfg",
        "pyproject.toml",
        "LICENSE",
        "CHANGELOG.md",
        "constraints.txt",
    } <= top
    (unpacked,) = (path for path in tmp_path.iterdir() if path.is_dir())
    assert files_in(build("wheel", unpacked, tmp_path / "again")) == files_in(wheel)


def test_constraints_pin_every_declared_dependency_inside_its_range() -> None:
    import configparser

    from packaging.requirements import Requirement
    from packaging.utils import canonicalize_name

    lines = [
        line
        for line in (ROOT / "constraints.txt").read_text().splitlines()
        if line and line[0] != "#"
    ]
    pinned = {
        canonicalize_name(name): version for name, version in (line.split("==") for line in lines)
    }
    config = configparser.ConfigParser()
    config.read(ROOT / "setup.cfg")
    declared = config["options"]["install_requires"].split()
    for extra in ("tools", "dev", "docs"):
        declared += config["options.extras_require"][extra].split()
    for requirement in map(Requirement, declared):
        version = pinned.get(canonicalize_name(requirement.name))
        assert version is not None, f"constraints.txt does not pin {requirement.name}"
        assert requirement.specifier.contains(version), f"{requirement} does not allow {version}"
    assert f"torch=={pinned['torch']}" in (ROOT / "Makefile").read_text(), (
        "Makefile installs another torch"
    )
