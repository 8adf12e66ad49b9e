"""What a result was made with."""

import platform
import subprocess
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

_PACKAGES = ("torch", "torchrl", "tensordict", "jax", "jaxlib", "numpy")


def versions() -> dict[str, str]:
    """Versions of this package, its commit, Python and the packages that decide a result.

    Nothing is imported for it. A package that is not installed is left out.
    """
    from arcade_torch import __version__

    found = {"arcade-torch": __version__, "commit": commit(), "python": platform.python_version()}
    for name in _PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    found["platform"] = f"{platform.system()} {platform.machine()}"
    return found


def commit() -> str:
    """Short hash of the checkout this code runs from, or an empty string."""
    here = Path(__file__).resolve().parent
    try:
        words = ["git", "-C", str(here)]
        ours = subprocess.run(
            [*words, "ls-files", "--error-unmatch", Path(__file__).name], capture_output=True, timeout=5
        )
        top = subprocess.run([*words, "rev-parse", "--short=12", "HEAD"], capture_output=True, text=True, timeout=5)
        dirty = subprocess.run([*words, "status", "--porcelain"], capture_output=True, text=True, timeout=5)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    if ours.returncode or top.returncode:
        return ""
    return top.stdout.strip() + ("+changes" if dirty.stdout.strip() else "")
