"""What ``make gpu`` needs before its first stage: packages, and a card that torch and JAX both see.

Imports nothing but the standard library, so that it can also say what is missing on a bare Python.
"""

import os
import re
import subprocess
import sys
from configparser import ConfigParser
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
TEST_PACKAGES = ("hypothesis", "pytest", "pytest-timeout")
"""Of the extra `dev`, what the stages run."""
LOOK = """
import torch
import jax
from arcade_torch.devices import why_no_cuda
backend = jax.default_backend()
major = (torch.version.cuda or "13").split(".")[0]
if why_no_cuda():
    print(why_no_cuda())
elif backend != "gpu":
    more = "make install GPU=" + ("12" if major == "12" else "1")
    print(f"JAX computes on the {backend}: pip install 'jax[cuda{major}]', or {more}")
"""


def needed() -> list[str]:
    """Requirements of the package, of its commands and of its tests, as ``setup.cfg`` has them."""
    setup = ConfigParser(interpolation=None)
    setup.read(ROOT / "setup.cfg", encoding="utf-8")
    extras = setup["options.extras_require"]
    development = [line for line in _lines(extras["dev"]) if _name(line) in TEST_PACKAGES]
    return [*_lines(setup["options"]["install_requires"]), *_lines(extras["tools"]), *development]


def _lines(text: str) -> list[str]:
    return [line.strip() for line in text.splitlines() if line.strip()]


def _name(requirement: str) -> str:
    return re.split(r"[^A-Za-z0-9_.-]", requirement, maxsplit=1)[0]


def missing_packages() -> list[str]:
    """Requirements of which nothing is installed, JAX with its plugin for a GPU."""
    missing = []
    for requirement in needed():
        try:
            version(_name(requirement))
        except PackageNotFoundError:
            missing.append(re.sub("^jax(?=[^a-z])", "jax[cuda13]", requirement))
    return missing


def stop_without_packages() -> None:
    """Exit with one line that names all that is missing, and how to install it."""
    missing = missing_packages()
    if missing:
        wanted = " ".join(f"'{requirement}'" for requirement in missing)
        names = ", ".join(_name(requirement) for requirement in missing)
        sys.exit(
            f"make gpu needs {names}, not installed for {sys.executable}: "
            f"{sys.executable} -m pip install {wanted} (or: make install GPU=1)"
        )


def why_no_card() -> str:
    """Why torch or JAX would not use a card, in one line; empty where both do.

    Asked in a process of its own, which lets go of the card at its end.
    """
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH")))),
        "XLA_PYTHON_CLIENT_PREALLOCATE": "false",
    }
    answer = subprocess.run(
        [sys.executable, "-c", LOOK],
        capture_output=True,
        text=True,
        env=environment,
        cwd=ROOT,
        check=False,
    )
    if answer.returncode:
        return (answer.stderr.strip().splitlines() or ["torch or JAX ends without a word"])[-1]
    return answer.stdout.strip()
