"""What a result was made with."""

import contextlib
import platform
import subprocess
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path


def versions() -> dict[str, str]:
    """Versions of this package, its commit, Python and the packages that decide a result, those that are installed."""
    from arcade_torch import __version__

    found = {"arcade-torch": __version__, "commit": commit(), "python": platform.python_version()}
    for name in ("torch", "torchrl", "tensordict", "jax", "jaxlib", "numpy"):
        with contextlib.suppress(PackageNotFoundError):
            found[name] = version(name)
    return found | {"platform": f"{platform.system()} {platform.machine()}"}


def commit() -> str:
    """Short hash of the checkout this code runs from, or an empty string."""

    def git(*words: str) -> str:
        run = ["git", "-C", str(Path(__file__).resolve().parent), *words]
        return subprocess.run(run, capture_output=True, text=True, timeout=5, check=True).stdout.strip()

    try:
        git("ls-files", "--error-unmatch", Path(__file__).name)  # another repository may hold an installed copy
        return git("rev-parse", "--short=12", "HEAD") + ("+changes" if git("status", "--porcelain") else "")
    except (OSError, subprocess.SubprocessError):
        return ""
