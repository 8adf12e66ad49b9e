"""Which devices torch and JAX use, and what they need to share a GPU."""

import os

import jax
import torch

from arcade_torch.dlpack import is_host, warn_frames_are_copied
from arcade_torch.envs_jax.validation import format_value
from arcade_torch.process import missing_platform


def share_gpu() -> bool:
    """Let JAX and torch live on one GPU: stop JAX from taking 75 % of its memory at the first use.

    Sets ``XLA_PYTHON_CLIENT_PREALLOCATE=false`` unless the user has set it, and only where torch
    has CUDA. It takes effect if it is called before JAX makes its first array; importing this
    module calls it.

    Returns:
        Whether this process is set up to share a GPU.
    """
    if not torch.cuda.is_available():
        return False
    return os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false").lower() in ("false", "0")


def why_no_cuda() -> str:
    """Say why torch cannot use a GPU, and how that is mended; empty where it can."""
    if torch.cuda.is_available():
        return ""
    if torch.version.cuda is None:
        return f"torch sees no GPU: torch {torch.__version__} is without CUDA, install one with it"
    return (
        f"torch sees no GPU: its CUDA is {torch.version.cuda}, but there is no usable driver or "
        "card, see what nvidia-smi says"
    )


def wait_for_torch(device: torch.device, jax_device: jax.Device) -> None:
    """Wait until torch has read the frames that it has let go of: on a GPU, JAX may take their
    memory for what is next.

    A step need not wait: JAX waits for its actions, which stand behind those reads in torch's
    current stream.
    """
    if not (is_host(device) or is_host(jax_device)):
        torch.cuda.current_stream(device).synchronize()


def pick_devices(device: torch.device | str | None) -> tuple[torch.device, jax.Device]:
    """Choose where tensors live and where JAX computes.

    Args:
        device: The device on which tensors are wanted, or None for the one that JAX computes on.

    Returns:
        The torch device (with an index for CUDA) and the JAX device. They are of different kinds
        only if CUDA is asked for and JAX has the CPU alone; then every frame is copied, and a
        warning says so once.

    Raises:
        ValueError: Unknown kind of device, no such GPU, torch without CUDA, or JAX without the
            device of JAX_PLATFORMS.
    """
    problem = missing_platform()
    if problem:
        raise ValueError(problem)
    if device is None:
        on_gpu = jax.default_backend() == "gpu" and torch.cuda.is_available()
        device = "cuda" if on_gpu else "cpu"
    try:
        wanted = torch.device(device)
    except (RuntimeError, TypeError, ValueError, OverflowError) as error:
        raise ValueError(
            f"device is {format_value(device)}, allowed: 'cpu', 'cuda', 'cuda:0', ..."
        ) from error
    if wanted.type == "cpu":
        return torch.device("cpu"), jax.devices("cpu")[0]
    if wanted.type != "cuda":
        raise ValueError(f"device is {str(device)!r}, allowed: 'cpu', 'cuda', 'cuda:0', ...")
    problem = why_no_cuda()
    if problem:
        raise ValueError(f"device is {str(device)!r}, but {problem}, or use 'cpu'")
    index = wanted.index if wanted.index is not None else torch.cuda.current_device()
    if index >= torch.cuda.device_count():
        raise ValueError(
            f"device is {str(device)!r}, but there are {torch.cuda.device_count()} GPUs"
        )
    wanted = torch.device("cuda", index)
    if jax.default_backend() != "gpu":
        warn_frames_are_copied()
        return wanted, jax.devices("cpu")[0]
    return wanted, jax.devices("gpu")[index]


share_gpu()  # on import: the user's JAX may start before the first env does
