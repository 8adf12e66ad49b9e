"""TorchRL's own checker: a few ids on every change; each id, both sizes, both twins as slow tests."""

import pytest
from torchrl.envs.utils import check_env_specs

from arcade_torch import make, registered_ids
from tests.few import GAMES

# The specs of a game are the same at all its difficulties: one of them stands for all.
CONFIGURATIONS = []
for _id in registered_ids():
    _often = [] if "Easy" in _id and _id.startswith(GAMES) else [pytest.mark.slow]
    CONFIGURATIONS.append(pytest.param(_id, 128, marks=_often))
    CONFIGURATIONS.append(pytest.param(_id, 256, marks=_often))


@pytest.mark.parametrize(("id", "obs_size"), CONFIGURATIONS)
def test_torchrl_s_checker_passes_on_both_twins(id: str, obs_size: int) -> None:
    """One env a size: the twin is a flag, so that switching compiles nothing."""
    env = make(id, num_envs=2, obs_size=obs_size)
    for observability in ("full", "partial"):
        env.set_observability(observability)
        check_env_specs(env, seed=0)
        assert env.observability.tolist() == [observability == "partial"] * 2
