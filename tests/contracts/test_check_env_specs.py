"""TorchRL's own checker on every configuration: each id, both sizes, both twins."""

import pytest
from torchrl.envs.utils import check_env_specs

from arcade_torch import make, registered_ids


@pytest.mark.parametrize("obs_size", [128, 256])
@pytest.mark.parametrize("id", registered_ids())
def test_torchrl_s_checker_passes_on_both_twins(id: str, obs_size: int) -> None:
    """One env a size: the twin is a flag, so that switching compiles nothing."""
    env = make(id, num_envs=2, obs_size=obs_size)
    for observability in ("full", "partial"):
        env.set_observability(observability)
        check_env_specs(env, seed=0)
        assert env.observability.tolist() == [observability == "partial"] * 2
