"""``RecurrentMemory`` on memories of other libraries, as docs/guides/memory.md brings them.

`make test-suites` installs them; elsewhere tests of what is missing are skipped. xlstm, which asks
for kernels of its own, is tried where it is installed.
"""

import importlib
import os
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from arcade_torch.models import RecurrentMemory, check_memory

WIDTH = 8


def package(name: str) -> Any:
    """A module of another library."""
    is_required = "SUITES_ARE_THERE" in os.environ and not name.startswith("xlstm")
    return importlib.import_module(name) if is_required else pytest.importorskip(name)


def closed_form(**options: Any) -> RecurrentMemory:
    cell = package("ncps.torch").CfC(WIDTH, WIDTH, **options)
    return RecurrentMemory(cell, WIDTH, WIDTH)


def wired() -> RecurrentMemory:
    wiring = package("ncps.wirings").AutoNCP(16, WIDTH)
    return RecurrentMemory(package("ncps.torch").CfC(WIDTH, wiring), WIDTH, WIDTH)


def liquid() -> RecurrentMemory:
    return RecurrentMemory(package("ncps.torch").LTC(WIDTH, WIDTH), WIDTH, WIDTH)


def min_gru() -> RecurrentMemory:
    module = package("minGRU_pytorch.minGRU").minGRU(WIDTH)

    def run(module: nn.Module, x: Tensor, state: Any) -> tuple[Tensor, Any]:
        return module(x, state, return_next_prev_hidden=True)  # type: ignore[no-any-return]

    return RecurrentMemory(module, WIDTH, WIDTH, run=run)


def mamba() -> RecurrentMemory:
    mambapy = package("mambapy.mamba")
    config = mambapy.MambaConfig(d_model=WIDTH, n_layers=2, d_state=4)

    def start(module: Any, batch_size: int) -> Any:
        state = torch.zeros(batch_size, config.d_inner, config.d_state)
        inputs = torch.zeros(batch_size, config.d_inner, config.d_conv - 1)
        return [(state, inputs) for _ in module.layers]

    def run(module: Any, x: Tensor, caches: Any) -> tuple[Tensor, Any]:
        outputs = []
        for step in x.unbind(1):
            y, caches = module.step(step, list(caches))
            outputs.append(y)
        return torch.stack(outputs, 1), caches

    return RecurrentMemory(mambapy.Mamba(config), WIDTH, WIDTH, run=run, start=start)


def cloned(state: Any) -> Any:
    """A state in nested dictionaries and tuples whose tensors may be written to."""
    if isinstance(state, dict):
        return {key: cloned(part) for key, part in state.items()}
    if isinstance(state, tuple):
        return tuple(cloned(part) for part in state)
    return state if state is None else state.clone()


def xlstm() -> RecurrentMemory:
    stack = package("xlstm.xlstm_block_stack")
    layer = package("xlstm.blocks.mlstm.layer").mLSTMLayerConfig(num_heads=2)
    block = package("xlstm.blocks.mlstm.block").mLSTMBlockConfig(mlstm=layer)
    config = stack.xLSTMBlockStackConfig(
        mlstm_block=block, context_length=64, num_blocks=2, embedding_dim=WIDTH
    )

    def run(module: Any, x: Tensor, state: Any) -> tuple[Tensor, Any]:
        outputs = []
        for t in range(x.shape[1]):
            y, state = module.step(x[:, t : t + 1], cloned(state))
            outputs.append(y)
        return torch.cat(outputs, 1), state

    return RecurrentMemory(stack.xLSTMBlockStack(config), WIDTH, WIDTH, run=run)


@pytest.mark.parametrize(
    "make",
    [
        closed_form,
        lambda: closed_form(mixed_memory=True),
        wired,
        liquid,
        min_gru,
        xlstm,
    ],
    ids=["ncps CfC", "ncps CfC with mixed memory", "ncps AutoNCP", "ncps LTC", "minGRU", "xlstm"],
)
def test_it_keeps_the_laws(make: Callable[[], RecurrentMemory]) -> None:
    check_memory(make())


def test_mambapy_keeps_the_laws_in_the_type_of_its_decay() -> None:
    check_memory(mamba(), dtype=torch.float32)
