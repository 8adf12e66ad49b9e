"""What a step asks of a GPU, read from the program that JAX lowers for one; no GPU is needed."""

import re

import jax
import jax.numpy as jnp
import pytest

from arcade_torch.compiled import CompiledGame
from arcade_torch.envs_jax import make, registered_ids
from arcade_torch.envs_jax.batch import env_keys

N = 4
MOST_SCATTERS = (
    0  # pieces that a step would put into the frame one by one, each a kernel of its own
)


@pytest.mark.parametrize("game", [id for id in registered_ids() if "Easy" in id])
def test_a_step_for_a_gpu_draws_in_few_passes_and_without_loops(game: str) -> None:
    compiled = CompiledGame(make(game))
    batch = jax.eval_shape(compiled.batched.init, env_keys(0, N), jnp.zeros(N, bool))
    action = jax.ShapeDtypeStruct((N,), jnp.int32)
    program = compiled.step.trace(batch, action).lower(lowering_platforms=("cuda",)).as_text()
    operations = re.findall(r'"?stablehlo\.(\w+)"?\(|= stablehlo\.(\w+) ', program)
    names = [one or other for one, other in operations]
    assert {"gather", "convert"} <= set(names)  # the text is read as it is written
    assert names.count("scatter") <= MOST_SCATTERS
    assert not {"while", "custom_call"} & set(names), (
        "a loop or a call into a library in every step"
    )
    filled = [
        line
        for line in program.splitlines()
        if "broadcast_in_dim" in line and line.endswith(f"{N}x128x128x3xui8>")
    ]
    assert len(filled) <= 1, "the frame is laid out once"
