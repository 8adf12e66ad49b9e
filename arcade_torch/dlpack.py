"""Tensors and arrays over the same memory: torch <-> JAX through DLPack, without a copy.

What is shared is shared both ways: a write through torch shows in JAX, whose arrays are meant never
to change. Tensors that come from JAX are therefore **read only by contract**; clone before writing
in place.
"""

import functools
import importlib.util
import warnings

import jax
import numpy as np
import torch
from torch.utils.dlpack import from_dlpack

from arcade_torch.process import warn

_WIDE = {torch.int64: torch.int32, torch.uint64: torch.uint32, torch.float64: torch.float32}
# below it JAX copies; on a GPU its programs refuse the argument
_ALIGNMENT_BYTES = {"cpu": 64, "cuda": 16}


# torch says once in a process that memory is read only, as that of JAX is
with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    torch.from_numpy(np.frombuffer(bytes(1), np.uint8))


def is_host(value: jax.Array | jax.Device | torch.device) -> bool:
    """Whether something is on the CPU, where the host reads memory without waiting for a
    transfer.
    """
    if isinstance(value, torch.device):
        return value.type == "cpu"
    platform = value.platform  # a method of JAX's arrays, an attribute of its devices
    return (platform() if callable(platform) else platform) == "cpu"


def to_torch(array: jax.Array | np.ndarray, device: torch.device | None = None) -> torch.Tensor:
    """See a JAX array, or a numpy view of one, as a tensor. Waits until the array has been
    computed.

    Args:
        array: Any JAX array but typed random keys (export their ``jax.random.key_data``).
        device: Where the tensor is wanted; default: where the array is. On another device than the
            array's, the data is copied.

    Returns:
        The tensor, over the same memory when the device is the same. Read only by contract.

    Example:
        >>> import jax.numpy as jnp
        >>> x = jnp.arange(3)
        >>> to_torch(x).data_ptr() == x.unsafe_buffer_pointer()
        True
    """
    if isinstance(array, np.ndarray) or is_host(array):
        tensor = torch.from_numpy(np.asarray(array))  # half the price of DLPack
    else:
        # not the capsule form, which would not hand torch's stream to JAX
        tensor = from_dlpack(array)
    if device is None or tensor.device == device:
        return tensor
    if device.type == "cuda" and tensor.device.type == "cpu":
        warn_frames_are_copied()
        return tensor.pin_memory().to(device)
    return tensor.to(device)


def to_jax(tensor: torch.Tensor) -> jax.Array:
    """See a tensor as a JAX array, or say why that would need a copy.

    JAX would copy silently in the refused cases; ask for the copy yourself instead
    (``.to(torch.int32)``, ``.contiguous()``, ``.clone()``).

    Args:
        tensor: At most 32 bits an element, dense, detached, and aligned to 64 bytes on the CPU, to
            16 on a GPU (fresh tensors are).

    Returns:
        An array over the same memory. Do not write to the tensor as long as JAX may read it.

    Raises:
        TypeError: A 64-bit type, which JAX would turn into the 32-bit one.
        ValueError: The tensor requires grad, is not dense, or is not aligned.

    Example:
        >>> to_jax(torch.zeros(2, dtype=torch.int64))
        Traceback (most recent call last):
            ...
        TypeError: torch.int64 would be copied on its way to JAX: convert it ...
    """
    if tensor.dtype in _WIDE and not jax.config.read("jax_enable_x64"):
        raise TypeError(
            f"{tensor.dtype} would be copied on its way to JAX: convert it yourself with "
            f".to({_WIDE[tensor.dtype]})"
        )
    if tensor.requires_grad:
        raise ValueError("the tensor requires grad, JAX cannot record it: pass tensor.detach()")
    if not (tensor.is_contiguous() or _is_dense(tensor)):
        raise ValueError(
            f"strides {tensor.stride()} of shape {tuple(tensor.shape)} have holes: pass "
            ".contiguous()"
        )
    alignment = _ALIGNMENT_BYTES.get(tensor.device.type, 1)
    if tensor.data_ptr() % alignment:
        raise ValueError(
            f"the tensor does not begin at a multiple of {alignment} bytes, "
            f"JAX {'would copy' if is_host(tensor.device) else 'cannot compute with'} it: pass "
            ".clone()"
        )
    array: jax.Array = jax.dlpack.from_dlpack(tensor)
    return array


def _is_dense(tensor: torch.Tensor) -> bool:
    """Whether some order of the axes makes the tensor contiguous."""
    order = sorted(
        range(tensor.ndim), key=lambda axis: (tensor.stride(axis), tensor.shape[axis]), reverse=True
    )
    return tensor.permute(order).is_contiguous()


def int32_argument(tensor: torch.Tensor, jax_device: jax.Device) -> np.ndarray | jax.Array:
    """Make integers ready for a compiled function: a private int32 copy.

    The copy is deliberate: JAX reads arguments after the call has returned, when the caller may
    write to them. Where JAX computes on the CPU it is a numpy array, three times cheaper than
    DLPack.
    """
    if is_host(jax_device):
        return tensor.to("cpu", torch.int32, copy=True).numpy()
    return to_jax(tensor.to(torch.int32, copy=True))


def upload(array: np.ndarray, device: torch.device) -> torch.Tensor:
    """Copy an array to a device; the host does not wait."""
    tensor = torch.from_numpy(array)
    return tensor if is_host(device) else tensor.pin_memory().to(device, non_blocking=True)


@functools.cache
def warn_frames_are_copied() -> None:
    """Say once that torch is on CUDA and JAX is not, and which package is missing."""
    major = (torch.version.cuda or "12").split(".")[0]
    package = f"jax-cuda{major}-plugin"
    have = "is missing"
    if importlib.util.find_spec(package.replace("-", "_")):
        have = "is installed but found no GPU"
    warn(
        f"torch is on CUDA but JAX computes on the CPU ({package} {have}): every frame is copied "
        f"to the GPU. Install it with: pip install 'jax[cuda{major}]'"
    )
