"""Memory models of a user: their check before a training."""

from dataclasses import replace

from arcade_torch.agents.config import TrainConfig
from arcade_torch.tools.errors import one_line
from arcade_torch.tools.imports import is_from_user

SKIP = "--no-check-memory trains it unchecked"


class MemoryRefusedError(RuntimeError):
    """A memory model of a user breaks a law, or cannot be checked; says how to go on."""


def check_memory_of(config: TrainConfig) -> None:
    """Check the memory model of a run, as wide as it will be trained, if it is a user's.

    Random numbers of the training are not touched.

    Raises:
        MemoryRefusedError: it breaks one of the laws of `check_memory`, or fails while it is
            checked.
        ValueError, TypeError: there is no such memory model, or it has other options.
    """
    if not is_from_user(config.memory):
        return
    from arcade_torch.agents.policy import build_network
    from arcade_torch.models import MemoryLawError, check_memory
    from arcade_torch.models.networks import MemoryBlock

    network = build_network(replace(config, device="cpu", cuda_graphs=False))
    block = next(module for module in network.modules() if isinstance(module, MemoryBlock))
    try:
        check_memory(block.cells[0], input_size=block.hidden_size)
    except MemoryLawError as error:
        raise MemoryRefusedError(f"memory {config.memory!r}: {error} {SKIP}") from error
    except Exception as error:
        raise MemoryRefusedError(
            f"memory {config.memory!r} failed when it was checked in float64, "
            f"{type(error).__name__}: {one_line(error)}; {SKIP}"
        ) from error
