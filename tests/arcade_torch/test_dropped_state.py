"""TorchRL carries a policy's recurrent state only in a primed env: a bare one says so, once, and
only then.
"""

import multiprocessing
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import jax.numpy as jnp
import pytest
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import Categorical
from torchrl.envs import SerialEnv, StepCounter, TransformedEnv
from torchrl.modules import LSTMModule, QValueModule
from torchrl.modules.utils import get_primers_from_module

from arcade_torch import validation
from arcade_torch.collector import ArcadeCollector
from arcade_torch.env import ArcadeEnv
from arcade_torch.jax_env import from_jax
from arcade_torch.models import MemoryModule, make_memory
from tests.arcade_torch.stub import GAME

N, T = 4, 12
MESSAGE = (
    r"the policy wrote .* for the next step, .* a memory forgets: "
    r".*get_primers_from_module.*ArcadeCollector$"
)


@pytest.fixture(autouse=True)
def not_warned_yet() -> Iterator[None]:
    validation.warn_state_is_dropped.cache_clear()
    yield
    validation.warn_state_is_dropped.cache_clear()


def stub_env(**options: Any) -> ArcadeEnv:
    return ArcadeEnv(GAME, N, **options)


def suite_env() -> Any:
    """An env that is not ours, whose one number stands under the key that our policies read."""

    class Count:
        def reset(self, key: Any) -> Any:
            return jnp.zeros((8, 1, 1)), jnp.int32(0)

        def step(self, key: Any, state: Any, action: Any) -> Any:
            return jnp.ones((8, 1, 1)), state + 1, 1.0, state >= 4, {}

    spec = Categorical(5, shape=(N,))
    return from_jax(Count(), num_envs=N, obs_key="pixels", action_spec=spec)


def policy_of(*memory: TensorDictModule, hidden: str) -> TensorDictSequential:
    encode = TensorDictModule(
        lambda pixels: pixels[..., 0, 0].float() / 255, ["pixels"], ["features"]
    )
    head = TensorDictModule(nn.Linear(8, 5), [hidden], ["action_value"])
    return TensorDictSequential(encode, *memory, head, QValueModule(action_space="categorical"))


def ours() -> TensorDictSequential:
    torch.manual_seed(1)
    return policy_of(
        MemoryModule(make_memory("gru", 8, 8), "features", "remembered"), hidden="remembered"
    )


def torchrls() -> TensorDictSequential:
    torch.manual_seed(1)
    memory = LSTMModule(input_size=8, hidden_size=8, in_key="features", out_key="remembered")
    return policy_of(memory, hidden="remembered")


def without_memory() -> TensorDictSequential:
    torch.manual_seed(1)
    return policy_of(
        MemoryModule(make_memory("mlp", 8, 8), "features", "remembered"), hidden="remembered"
    )


def primed(policy: nn.Module, env: Any) -> TransformedEnv:
    return TransformedEnv(env, get_primers_from_module(policy, warn=False))


def rollout(env: Any, policy: Callable[[TensorDictBase], TensorDictBase] | None) -> TensorDictBase:
    with torch.no_grad():
        return env.rollout(T, policy, break_when_any_done=False)


def collected(env: Any, policy: Any, **options: Any) -> TensorDictBase:
    return next(iter(Collector(env, policy, frames_per_batch=N * T, total_frames=N * T, **options)))


@pytest.mark.parametrize("policy", [ours(), torchrls()])
@pytest.mark.parametrize(
    "run",
    [rollout, partial(collected, auto_register_policy_transforms=False)],
    ids=["rollout", "Collector"],
)
def test_a_bare_env_says_once_that_the_state_is_dropped(policy: nn.Module, run: Any) -> None:
    with pytest.warns(UserWarning, match=MESSAGE) as warned:
        dropped = run(stub_env(), policy)
        run(stub_env(), policy)
    assert len([one for one in warned if "a memory forgets" in str(one.message)]) == 1
    whole = rollout(primed(policy, stub_env()), policy)
    assert not torch.allclose(
        dropped["action_value"], whole["action_value"], atol=1e-3
    )  # it is no false alarm


@pytest.mark.parametrize("env", [stub_env, lambda: suite_env()], ids=["ours", "from_jax"])
def test_a_rollout_that_stops_at_the_first_end_says_so_too(env: Callable[[], Any]) -> None:
    """The default of ``rollout``; it said nothing of ``LSTMModule``."""
    with pytest.warns(UserWarning, match=MESSAGE), torch.no_grad():
        env().rollout(3, torchrls())
    silent(lambda: rollout(env(), torchrls()))  # once in all


@pytest.mark.parametrize("policy", [ours(), torchrls()])
def test_a_worker_process_says_so_in_the_log(
    policy: nn.Module, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """TorchRL silences warnings in the processes of its collectors."""
    monkeypatch.setattr(multiprocessing, "parent_process", lambda: object())
    silent(lambda: rollout(stub_env(), policy))
    assert sum("a memory forgets" in message for message in caplog.messages) == 1
    of_the_memory = sum("begins anew at every step" in message for message in caplog.messages)
    assert of_the_memory == isinstance(policy[1], MemoryModule)


def test_the_warning_is_one_line_that_names_the_entries() -> None:
    with pytest.warns(UserWarning, match="wrote memory.h for") as warned:
        rollout(stub_env(), ours())
    assert all("\n" not in str(one.message) for one in warned)


def silent(run: Callable[[], object]) -> None:
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        run()
    assert not [str(one.message) for one in found if "a memory forgets" in str(one.message)]


@pytest.mark.parametrize("policy", [ours(), torchrls()])
def test_where_the_state_is_carried_nothing_is_said(policy: nn.Module) -> None:
    silent(lambda: rollout(primed(policy, stub_env()), policy))
    silent(lambda: rollout(primed(policy, TransformedEnv(stub_env(), StepCounter())), policy))
    silent(lambda: rollout(primed(policy, SerialEnv(2, stub_env)), policy))
    silent(lambda: collected(primed(policy, stub_env()), policy))
    silent(lambda: collected(stub_env(), policy, auto_register_policy_transforms=True))
    silent(lambda: ArcadeCollector(stub_env(), policy, N * T).collect())
    silent(lambda: next(iter(ArcadeCollector(stub_env(), policy, N * T))))


def writes_at_the_root(td: TensorDictBase) -> TensorDictBase:
    td["logits"], td["action_log_prob"] = torch.zeros(N, 5), torch.zeros(N)
    return td.set("action", torch.ones(N, dtype=torch.int64))


@pytest.mark.parametrize("policy", [None, writes_at_the_root, without_memory()])
@pytest.mark.parametrize("options", [{}, {"task_in_td": True}, {"state_in_td": True}])
def test_a_policy_without_memory_is_no_alarm(policy: Any, options: dict[str, Any]) -> None:
    silent(lambda: rollout(stub_env(**options), policy))
    silent(lambda: collected(stub_env(**options), policy))


def test_a_step_taken_again_is_no_alarm() -> None:
    """The tensordict of a step holds the entries of ``"next"`` that the env knows."""
    env = stub_env()
    td = env.reset().set("action", torch.ones(N, dtype=torch.int64))
    silent(lambda: env.step_and_maybe_reset(env.step_and_maybe_reset(td)[0]))
