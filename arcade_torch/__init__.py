"""POPGym Arcade for PyTorch: ten pixel games as MDP/POMDP twins, stepped in JAX, seen by TorchRL
without a copy.

Public names are resolved on first use: importing the package costs little,
``arcade_torch.envs_jax`` loads no torch.
"""

from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

from arcade_torch import program

# before the imports that take long: a signal during them is answered in one line
if program.is_command_line():
    program.begin()

import arcade_torch.process

if find_spec("gymnasium") is not None:  # the memory models do without it
    import arcade_torch.gym  # noqa: F401  (puts the games into Gymnasium's registry)

__version__ = "0.2.0"

_PUBLIC = {
    "ArcadeCollector": "arcade_torch.collector",
    "ArcadeEnv": "arcade_torch.env",
    "JaxEnv": "arcade_torch.jax_env",
    "from_jax": "arcade_torch.jax_env",
    "make": "arcade_torch.factory",
    "registered_ids": "arcade_torch.envs_jax",
}

if TYPE_CHECKING:
    from arcade_torch.collector import ArcadeCollector
    from arcade_torch.env import ArcadeEnv
    from arcade_torch.envs_jax import registered_ids
    from arcade_torch.factory import make
    from arcade_torch.jax_env import JaxEnv, from_jax

__all__ = [
    "ArcadeCollector",
    "ArcadeEnv",
    "JaxEnv",
    "__version__",
    "from_jax",
    "make",
    "registered_ids",
]


if not TYPE_CHECKING:  # a checker is to find misspelt names

    def __getattr__(name: str) -> Any:
        """Import a public name when it is first asked for (PEP 562)."""
        if name not in _PUBLIC:
            raise AttributeError(
                f"module 'arcade_torch' has no attribute {name!r}; public names: "
                f"{', '.join(__all__)}"
            )
        return globals().setdefault(name, getattr(import_module(_PUBLIC[name]), name))


def __dir__() -> list[str]:
    """Public names, for completion."""
    return sorted(__all__)
