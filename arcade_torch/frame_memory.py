"""Memory of frames that is used again: new memory costs page faults. Loads no torch."""

import weakref
from collections import deque
from collections.abc import Callable
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt

# what a function that draws may draw over; None: it takes new memory
Spare = jax.Array | None


class Reused:
    """Up to ``most`` (2 or more) blocks of memory, each given again once nobody can see it.

    A block is watched through the numpy array that was handed out over it. Whatever is made of that
    keeps it alive (views, tensors, views of tensors, arrays of JAX), so when it is gone, nobody
    looks.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._blocks: list[tuple[Any, weakref.ref[Any]]] = []

    def take(self, make: Callable[[], Any]) -> Any:
        """Return an unreferenced block, or a new one that ``make`` allocates."""
        # a cache still has the latest
        for place, (block, seen) in reversed(list(enumerate(self._blocks))):
            if seen() is None:
                del self._blocks[place]
                return block
        return make()

    def hand_out(self, block: Any, array: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Remember that ``array`` lies over the block, and return it; the oldest block too many is
        forgotten.
        """
        newest = self._blocks[-(self._most - 1) :]
        self._blocks = [*newest, (block, weakref.ref(array))]
        return array


class FrameMemory:
    """Reuses the memory of frames that are no longer referenced, for compiled functions that draw.

    JAX stands behind ``Reused``: it does not write to memory that is seen from outside, but takes
    new. On a GPU nothing is reused: there memory is JAX's own to give again, and torch may read it
    later than Python says.
    """

    def __init__(self, shape: tuple[int, ...], device: jax.Device, most: int = 3) -> None:
        self._shape = shape
        self._device = device
        self._reuses = device.platform == "cpu"
        # 3: what a caller acts on, what that came from, and what is drawn next
        self._reused = Reused(most)

    def spare(self) -> Spare:
        """Memory to be given to the function that draws, once; None where nothing is reused."""
        return self._reused.take(self._allocate) if self._reuses else None

    def _allocate(self) -> jax.Array:
        """New memory; without the context JAX makes it on its default device and copies it."""
        with jax.default_device(self._device):
            return jnp.empty(self._shape, np.uint8, device=self._device)

    def show(self, frames: jax.Array) -> jax.Array | npt.NDArray[np.uint8]:
        """What may be handed out of the frames that were drawn: a read-only view, on a GPU the
        frames themselves.
        """
        return self._reused.hand_out(frames, np.asarray(frames)) if self._reuses else frames


class Canvas:
    """Memory of JAX on the CPU that steps draw into part by part, while arrays of numpy lie over
    it.

    JAX would not draw where it knows that somebody looks, so they are laid over the bare address.
    They keep the canvas alive, and the canvas the memory. Who draws answers for the parts that were
    shown.

    A function that draws is donated the memory and gives it back: between these two, nobody holds
    it. A signal that raises there (Ctrl-C) would let go of it, and whoever looks would read freed
    memory. Python handles signals between its own instructions only, so ``draw`` calls and keeps in
    one of them.
    """

    def __init__(self, shape: tuple[int, ...]) -> None:
        memory = jnp.empty(shape, np.uint8, device=jax.devices("cpu")[0]).block_until_ready()
        self._results: deque[tuple[jax.Array, ...]] = deque([(memory,)], maxlen=1)
        self.address = memory.unsafe_buffer_pointer()
        self.__array_interface__ = {
            "shape": shape,
            "typestr": "|u1",
            "data": (self.address, False),
            "version": 3,
        }

    @property
    def memory(self) -> jax.Array:
        """Where is drawn, as the last function gave it back."""
        return self._results[0][0]

    def draw(
        self, function: Callable[..., tuple[jax.Array, ...]], *args: Any
    ) -> tuple[jax.Array, ...]:
        """Call a compiled function that draws.

        Args:
            function: Takes the memory, which it is donated, and ``args``; gives a flat tuple, the
                memory first.
            *args: What else it takes.

        Returns:
            What it gave but for the memory.
        """
        arguments = [(argument,) for argument in (self.memory, *args)]
        self._results.extend(map(function, *arguments))
        return self._results[0][1:]

    def wait(self) -> None:
        """Wait until ``memory``, which a function gave back that it was donated to, has been
        drawn.
        """
        if self.memory.block_until_ready().unsafe_buffer_pointer() != self.address:
            raise RuntimeError(
                "JAX did not draw where it was told to: report this, with the version of JAX"
            )


@lru_cache(maxsize=1)
def draws_in_place() -> bool:
    """Whether this version of JAX writes into memory of the CPU that it was donated."""
    canvas = Canvas((2, 2))
    drawn = jax.jit(lambda memory: memory.at[1].set(1), donate_argnums=0)(canvas.memory)
    return bool(drawn.unsafe_buffer_pointer() == canvas.address)
