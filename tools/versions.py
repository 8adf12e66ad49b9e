"""What a result was made with."""

import platform
import subprocess
from pathlib import Path

from arcade_torch.agents.runs import folder


def versions() -> dict[str, str]:
    """Versions of what decides a result, the commit of this package, and the platform."""
    return folder.versions() | {"commit": commit(), "platform": f"{platform.system()} {platform.machine()}"}


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
