"""The network's step while acting, replayed as one CUDA graph."""

import torch
from tensordict.nn import CudaGraphModule

from arcade_torch.agents.actor import Step

__all__ = ["graphed"]


def graphed(step: Step, device: torch.device | str) -> Step:
    """The same step, captured at its second call and replayed since: one launch instead of one an operation.

    Acting reads one frame of every environment, which takes a GPU less time than Python needs to launch the work.
    Weights may change in place; shapes must stay those of the first call. Results are copies.

    Args:
        step: an actor's; nothing in it may depend on values of tensors.
        device: where its tensors are, a CUDA device.

    Returns:
        A function with the same arguments and results.

    Raises:
        ValueError: ``device`` is no CUDA device, or this machine has none.
    """
    if torch.device(device).type != "cuda" or not torch.cuda.is_available():
        raise ValueError(f"CUDA graphs need a CUDA device; got {str(device)!r}. Leave cuda_graphs out to act without")
    replay: Step = CudaGraphModule(step, device=torch.device(device))
    return replay
