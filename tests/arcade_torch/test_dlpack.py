"""Memory is shared, and where it cannot be, somebody says so."""

import re

import jax
import jax.numpy as jnp
import pytest
import torch

from arcade_torch import devices, dlpack


@pytest.mark.parametrize("dtype", [jnp.bool_, jnp.uint8, jnp.int32, jnp.float32])
def test_an_array_becomes_a_tensor_over_the_same_memory(dtype: jnp.dtype) -> None:
    array = jnp.ones((4, 3), dtype)
    tensor = dlpack.to_torch(array)
    assert tensor.data_ptr() == array.unsafe_buffer_pointer()
    assert tensor.shape == (4, 3)


@pytest.mark.parametrize("dtype", [torch.bool, torch.uint8, torch.int32, torch.float32])
def test_a_tensor_becomes_an_array_over_the_same_memory(dtype: torch.dtype) -> None:
    tensor = torch.ones(64, dtype=dtype)
    assert dlpack.to_jax(tensor).unsafe_buffer_pointer() == tensor.data_ptr()


def test_a_permuted_tensor_is_shared_too() -> None:
    tensor = torch.arange(24, dtype=torch.int32).reshape(2, 3, 4).permute(2, 0, 1)
    array = dlpack.to_jax(tensor)
    assert array.unsafe_buffer_pointer() == tensor.data_ptr()
    assert array.tolist() == tensor.tolist()


def test_a_frame_stays_shared_when_it_is_permuted_for_a_convolution() -> None:
    array = jnp.zeros((2, 8, 8, 3), jnp.uint8)
    channels_first = dlpack.to_torch(array).permute(0, 3, 1, 2)
    assert channels_first.data_ptr() == array.unsafe_buffer_pointer()
    assert channels_first.is_contiguous(memory_format=torch.channels_last)


@pytest.mark.parametrize(
    ("tensor", "error", "message"),
    [
        (torch.zeros(2, dtype=torch.int64), TypeError, "convert it yourself with .to(torch.int32)"),
        (
            torch.zeros(2, dtype=torch.float64),
            TypeError,
            "convert it yourself with .to(torch.float32)",
        ),
        (torch.zeros(2, requires_grad=True), ValueError, "pass tensor.detach()"),
        (torch.zeros(4, 4)[:, ::2], ValueError, "have holes: pass .contiguous()"),
        (torch.zeros(64)[1:], ValueError, "JAX would copy it: pass .clone()"),
    ],
)
def test_what_jax_would_copy_in_silence_is_refused(
    tensor: torch.Tensor, error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=re.escape(message)):
        dlpack.to_jax(tensor)


@pytest.mark.parametrize("dtype", [torch.int64, torch.int32])
def test_the_argument_of_a_compiled_function_is_a_private_copy(dtype: torch.dtype) -> None:
    action = torch.arange(5, dtype=dtype)
    argument = dlpack.int32_argument(action, jax.devices("cpu")[0])
    action.zero_()
    assert argument.dtype == "int32"
    assert argument.tolist() == [0, 1, 2, 3, 4]


def test_both_sides_may_forget_the_memory_first() -> None:
    tensor = dlpack.to_torch(jax.jit(lambda x: x + 1)(jnp.zeros(1000)))
    array = dlpack.to_jax(torch.full((1000,), 3.0))
    for _ in range(50):
        jnp.full(1000, 7.0).block_until_ready()
        torch.full((1000,), 9.0)
    assert (tensor == 1).all()
    assert (array == 3).all()


def test_the_warning_about_copied_frames_names_the_package_and_comes_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    dlpack.warn_frames_are_copied.cache_clear()
    with pytest.warns(
        UserWarning, match=r"jax-cuda13-plugin is missing.*pip install 'jax\[cuda13\]'"
    ) as caught:
        dlpack.warn_frames_are_copied()
        dlpack.warn_frames_are_copied()
    assert len(caught) == 1


def test_sharing_a_gpu_respects_what_the_user_has_set(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.delenv("XLA_PYTHON_CLIENT_PREALLOCATE", raising=False)
    assert devices.share_gpu()
    monkeypatch.setenv("XLA_PYTHON_CLIENT_PREALLOCATE", "true")
    assert not devices.share_gpu()
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert not devices.share_gpu()
