"""TorchRL's own checker on the configurations: each id, both sizes, both twins."""

import pytest
from torchrl.envs.utils import check_env_specs

from arcade_torch import make, registered_ids

# The specs of a game are the same at all its difficulties: at 256 one of them stands for all.
CONFIGURATIONS = [(id, 128) for id in registered_ids()]
for _id in registered_ids():
    _rarely = [] if "Easy" in _id else [pytest.mark.slow]
    CONFIGURATIONS.append(pytest.param(_id, 256, marks=_rarely))


@pytest.mark.parametrize(("id", "obs_size"), CONFIGURATIONS)
def test_torchrl_s_checker_passes_on_both_twins(id: str, obs_size: int) -> None:
    """One env a size: the twin is a flag, so that switching compiles nothing."""
    env = make(id, num_envs=2, obs_size=obs_size)
    for observability in ("full", "partial"):
        env.set_observability(observability)
        check_env_specs(env, seed=0)
        assert env.observability.tolist() == [observability == "partial"] * 2
