"""The machine and this process: what a result was made with, cores, threads, and memory that is
kept.
"""

import ctypes
import math
import os
import platform
import signal
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from arcade_torch.agents import TrainConfig

_MALLOC = {-4: 0, -1: 2**31 - 1, -2: 2**28}
"""Of <malloc.h>: M_MMAP_MAX, M_TRIM_THRESHOLD, M_TOP_PAD."""
PARENT_VARIABLE = "ARCADE_TORCH_PARENT"
"""Process id that a worker watches: when that process is gone the worker stops with a
checkpoint."""
_WATCH = "watch-parent"


def versions() -> dict[str, str]:
    """Versions of what decides a result, the commit of this package (empty if unknown), and the
    platform.
    """
    from arcade_torch.agents.runs import folder

    return folder.versions() | {
        "commit": _commit(),
        "platform": f"{platform.system()} {platform.machine()}",
    }


def _commit() -> str:
    def git(*words: str) -> str:
        run = ["git", "-C", str(Path(__file__).resolve().parent), *words]
        return subprocess.run(
            run, capture_output=True, text=True, timeout=5, check=True
        ).stdout.strip()

    try:
        # another repository may hold an installed copy
        git("ls-files", "--error-unmatch", Path(__file__).name)
        commit = git("rev-parse", "--short=12", "HEAD")
        return f"{commit}+changes" if git("status", "--porcelain") else commit
    except (OSError, subprocess.SubprocessError):
        return ""


def machine() -> dict[str, Any]:
    """Devices, cores and versions that something is measured with; of cards, empty without one."""
    import jax
    import torch

    device = jax.devices()[0]
    return {
        "jax_device": f"{device.platform} ({device.device_kind})",
        "torch_device": "cuda" if torch.cuda.is_available() else "cpu",
        "processor": platform.processor() or platform.machine(),
        "cores": len(available_cores()),
        "torch_threads": torch.get_num_threads(),
        **_cards(),
    } | versions()


def _cards() -> dict[str, Any]:
    """The first card that torch sees, its memory in GiB, how many there are, the driver, and the
    CUDA that torch was built for.
    """
    import torch

    about = dict.fromkeys(("card", "card_memory_gib", "cards", "driver"), "")
    if torch.cuda.is_available():
        properties = torch.cuda.get_device_properties(0)
        about["card"] = properties.name
        about["card_memory_gib"] = f"{properties.total_memory / 2**30:.1f}"
        about["cards"] = str(torch.cuda.device_count())
        about["driver"] = _driver()
    return about | {"torch_cuda": torch.version.cuda or ""}


def _driver() -> str:
    """Version of NVIDIA's driver, empty where ``nvidia-smi`` does not say."""
    words = ["nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"]
    try:
        answer = subprocess.run(words, capture_output=True, text=True, timeout=30, check=True)
    except (OSError, subprocess.SubprocessError):
        return ""
    return (answer.stdout.split() or [""])[0]


def available_cores() -> list[int]:
    """Numbers of the processor cores this process may use, at least one."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Let torch use so many threads inside, and as many as before afterwards."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def bfloat16_time(config: "TrainConfig", frames: int = 64) -> float:
    """How long the network's encoder takes for some frames, forwards and backwards, in bfloat16,
    where float32 takes 1.

    Measured in turn, the least of three counts. Of two processors with AVX-512 and bfloat16 and
    without AMX a Xeon takes 1.15 to 1.3, an EPYC .35 to .6.
    """
    import torch

    from arcade_torch.agents import build_network
    from arcade_torch.models import Encoder

    network = build_network(config)
    encoder = next(module for module in network.modules() if isinstance(module, Encoder))
    pixels = torch.zeros(frames, *encoder.stored_shape, dtype=torch.uint8, device=config.device)
    least = {True: math.inf, False: math.inf}
    for amp in [True, False] * 3:
        encoder.amp = amp
        begin = time.perf_counter()
        encoder(pixels).square().sum().backward()
        least[amp] = min(least[amp], time.perf_counter() - begin)
    return least[True] / least[False]


def keep_freed_memory() -> bool:
    """Have the C library use freed memory again instead of handing it back to the system.

    The feature maps of one minibatch take hundreds of megabytes. By default glibc maps every such
    tensor anew, and the system fills each of its pages with zeros before it is written; this
    process then keeps what it once had. No number that is computed changes. A gradient step of the
    paper's network with LRU took 0.46 s of one core instead of 0.66 s, and the process 1.3 GB
    instead of 0.85 GB. Elsewhere than on glibc nothing happens.

    Source: ``mallopt(3)``, ``M_MMAP_MAX`` and ``M_TRIM_THRESHOLD``.
    """
    if platform.libc_ver()[0] != "glibc":
        return False
    mallopt = ctypes.CDLL(None).mallopt
    return all(mallopt(name, value) == 1 for name, value in _MALLOC.items())


def watch_parent() -> None:
    """In a worker: stop with a checkpoint when the study that started it is gone; elsewhere nothing
    happens.
    """
    parent = os.environ.get(PARENT_VARIABLE)

    def look() -> None:
        while str(os.getppid()) == parent:
            time.sleep(2.0)
        os.kill(os.getpid(), signal.SIGTERM)

    watches = any(thread.name == _WATCH for thread in threading.enumerate())
    if parent is not None and not watches:
        threading.Thread(target=look, daemon=True, name=_WATCH).start()
