"""What a policy keeps from step to step without saying so, and how its state begins:
``ArcadeCollector`` beside TorchRL's collector.
"""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torchrl.collectors import Collector
from torchrl.data import Bounded, Unbounded
from torchrl.envs import TensorDictPrimer, TransformedEnv
from torchrl.modules import MultiStepActorWrapper, OrnsteinUhlenbeckProcessModule

from arcade_torch import ArcadeCollector, from_jax
from arcade_torch.models import MemoryModule, make_memory

N = 3
T = 8
CHOICES = 5
STEPS = 6


class Line:
    """Walk along a line; the observation is the place and the number of the step."""

    def reset(self, key: Any) -> Any:
        return jnp.zeros(2), (jnp.float32(0), jnp.int32(0))

    def step(self, key: Any, state: Any, action: Any) -> Any:
        place = state[0] + action.sum()
        count = state[1] + 1
        obs = jnp.stack([place, count.astype(jnp.float32)])
        return obs, (place, count), place, count >= STEPS, {}


def make(actions: str = "discrete") -> Any:
    spec = Bounded(-1, 1, shape=(N, 1))
    if actions == "discrete":
        spec = Bounded(0, CHOICES - 1, shape=(N, 1), dtype=torch.int64)
    return from_jax(Line(), num_envs=N, action_spec=spec)


def noise() -> Any:
    """An action of 0 with noise that hangs on the noise of the step before."""
    return TensorDictSequential(
        TensorDictModule(lambda obs: 0 * obs[:, :1], ["observation"], ["action"]),
        OrnsteinUhlenbeckProcessModule(
            spec=Bounded(-1, 1, shape=(N, 1)), annealing_num_steps=10, theta=0.05, sigma=0.1
        ),
    )


def plans() -> Any:
    """Three actions at once, which are taken one after the other."""

    def plan(obs: torch.Tensor) -> torch.Tensor:
        begins = obs[:, 1:].long()
        return ((begins + torch.arange(3)) % CHOICES).unsqueeze(-1)

    return MultiStepActorWrapper(TensorDictModule(plan, ["observation"], ["action"]), n_steps=3)


def counts() -> Callable[[TensorDictBase], TensorDictBase]:
    """Counts its calls in an entry of its own."""

    def policy(td: TensorDictBase) -> TensorDictBase:
        calls = td.get("calls", torch.zeros(N, 1, dtype=torch.int64))
        td["calls"] = calls + 1
        td["action"] = calls % CHOICES
        return td

    return policy


def repeats() -> Callable[[TensorDictBase], TensorDictBase]:
    """Takes the action before once more at every other step."""

    def policy(td: TensorDictBase) -> TensorDictBase:
        new = td["step_count"] % CHOICES
        td["action"] = td.get("action", new).where(td["step_count"] % 2 == 1, new)
        return td

    return policy


POLICIES = {
    "noise": (noise, "continuous"),
    "plans": (plans, "discrete"),
    "counts": (counts, "discrete"),
    "repeats": (repeats, "discrete"),
}


def batch_of(kind: Any, name: str) -> TensorDictBase:
    policy, actions = POLICIES[name]
    collector = kind(make(actions), policy(), frames_per_batch=N * T, total_frames=2 * N * T)
    torch.manual_seed(1)
    return torch.cat([batch.clone() for batch in collector], 1)


@pytest.mark.parametrize("name", POLICIES)
def test_entries_that_a_policy_writes_are_there_at_the_next_step(name: str) -> None:
    stock = batch_of(Collector, name)
    ours = batch_of(ArcadeCollector, name)
    keys = set(ours.keys(True, True))
    assert keys == set(stock.keys(True, True))
    assert [key for key in keys if not torch.equal(ours[key], stock[key])] == []
    assert stock["action"].unique().numel() > 1


@pytest.mark.parametrize("between", ["save", "reset"])
def test_what_a_policy_wrote_is_saved_and_forgotten_with_the_episodes(between: str) -> None:
    collector = ArcadeCollector(make(), counts(), frames_per_batch=N * T)
    collector.collect()
    if between == "save":
        saved = collector.state_dict()
        collector = ArcadeCollector(make(), counts(), frames_per_batch=N * T)
        collector.load_state_dict(saved)
    else:
        collector.reset()
    first = 0 if between == "reset" else T
    assert collector.collect()["action"][0, :, 0].tolist() == [
        step % CHOICES for step in range(first, first + T)
    ]


def test_random_actions_are_those_that_the_next_step_sees() -> None:
    seen = []

    def policy(td: TensorDictBase) -> TensorDictBase:
        seen.append(td.get("action", torch.zeros_like(td["last_action"])).clone())
        td["action"] = torch.zeros_like(td["last_action"])
        return td

    collector = ArcadeCollector(make(), policy, frames_per_batch=N * T, init_random_frames=N * T)
    batch = collector.collect()
    assert batch["action"].any()
    assert torch.equal(torch.stack(seen, 1)[:, 1:], batch["action"][:, :-1])


class Skilled(TensorDictModuleBase):
    """Acts by a state that begins as a primer says, and writes it for the next step or not."""

    def __init__(self, writes: bool, **options: Any) -> None:
        super().__init__()
        self.in_keys = ["observation", "skill"]
        self.out_keys = ["action"]
        self.writes = writes
        self.options = options

    def make_tensordict_primer(self) -> TensorDictPrimer:
        return TensorDictPrimer({"skill": Unbounded((2,))}, expand_specs=True, **self.options)

    def forward(self, td: TensorDictBase) -> TensorDictBase:
        td["action"] = td["skill"][:, :1].long().abs() % CHOICES
        if self.writes:
            td["next", "skill"] = td["skill"] + 1
        return td


def tens() -> Callable[..., torch.Tensor]:
    """Gives 10 at the first call, 20 at the second, and so on."""
    calls = iter(range(10, 10000, 10))
    return lambda: torch.full((N, 2), float(next(calls)))


def skills_of(policy: Any) -> torch.Tensor:
    """float [N, T, 2], the states that a window of ``ArcadeCollector`` began its steps with."""
    collector = ArcadeCollector(make(), policy, frames_per_batch=N * T)
    batch = collector.collect()
    assert torch.equal(batch["initial_state", "skill"], batch["skill"][:, 0])
    skills: torch.Tensor = batch["skill"]
    return skills


def test_a_state_that_a_policy_does_not_write_stays() -> None:
    """As ``TensorDictPrimer`` leaves it."""
    policy = Skilled(writes=False, default_value=3.0)
    primed = TransformedEnv(make(), policy.make_tensordict_primer())
    stock = primed.rollout(T, policy, break_when_any_done=False)["skill"]
    assert torch.equal(skills_of(policy), stock)
    assert (stock == 3).all()


@pytest.mark.parametrize("writes", [True, False])
def test_a_random_state_is_drawn_for_every_episode(writes: bool) -> None:
    skills = skills_of(Skilled(writes, random=True))
    within = skills[:, :STEPS] - skills[:, :1]
    steps = torch.arange(STEPS).reshape(1, -1, 1) * float(writes)
    assert torch.allclose(within, steps.expand(within.shape), atol=1e-5)
    assert (skills[:, 0] != skills[:, STEPS]).all()
    assert skills[:, 0].unique().numel() == 2 * N


@pytest.mark.parametrize("writes", [True, False])
def test_a_function_gives_the_state_of_every_episode(writes: bool) -> None:
    skills = skills_of(Skilled(writes, default_value=tens()))
    assert (skills[:, 0] % 10 == 0).all()
    assert (skills[:, STEPS] % 10 == 0).all()
    assert (skills[:, 0] != skills[:, STEPS]).all()


def test_one_function_may_give_all_states() -> None:
    def default(reset: Any = None) -> TensorDict:
        return TensorDict({"skill": torch.full((N, 2), 7.0)}, [N])

    policy = Skilled(False, default_value=default, single_default_value=True)
    assert (skills_of(policy) == 7).all()


@pytest.mark.parametrize("store_states", [True, False])
def test_a_state_begins_anew_beside_a_memory_that_does_so_by_itself(store_states: bool) -> None:
    memory = MemoryModule(make_memory("mingru", 2, 4), in_key="observation", out_key="remembered")
    policy = TensorDictSequential(memory, Skilled(True, default_value=3.0))
    collector = ArcadeCollector(make(), policy, N * T, store_states=store_states)
    batch = collector.collect()
    assert torch.equal(batch["action"], (3 + batch["step_count"]) % CHOICES)


def test_a_policy_may_give_another_tensordict_than_it_got() -> None:
    policy = Skilled(False, default_value=3.0)
    forward = policy.forward
    policy.forward = lambda td: forward(td).select("action")  # type: ignore[method-assign]
    batch = ArcadeCollector(make(), policy, N * T).collect()
    assert (batch["action"] == 3).all()
