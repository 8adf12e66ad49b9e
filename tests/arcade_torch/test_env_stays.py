"""An env lives where it was made: it names itself, moves to no other device, and is neither copied
nor pickled.
"""

import copy
import io
import pickle
import re
from functools import partial
from typing import Any

import pytest
import torch
from tensordict import TensorDictBase
from torchrl.collectors import Collector
from torchrl.envs import EnvBase, EnvCreator, ParallelEnv, SerialEnv, StepCounter, TransformedEnv

from arcade_torch.env import ArcadeEnv
from arcade_torch.factory import make
from tests.arcade_torch.stub import GAME, MIXED
from tests.few import few

N, T = 3, 4


def rollout(env: EnvBase) -> TensorDictBase:
    torch.manual_seed(0)
    return env.rollout(T)


@pytest.mark.parametrize("device", ["cpu", torch.device("cpu"), "cpu:0"])
def test_an_env_is_its_own_copy_on_its_own_device(device: Any) -> None:
    env = ArcadeEnv(GAME, N)
    assert env.to(device) is env
    assert (
        env.device
        == env.observation_spec.device
        == env.rollout(T)["pixels"].device
        == torch.device("cpu")
    )


@pytest.mark.parametrize(
    "device", ["meta", "cuda:7", "mps", torch.device("meta"), "nowhere", torch.float32]
)
def test_an_env_refuses_another_device_in_one_line_and_goes_on(device: Any) -> None:
    env, plain = ArcadeEnv(GAME, N, seed=2), ArcadeEnv(GAME, N, seed=2)
    with pytest.raises(
        ValueError, match=r"^device is [^\n]*(allowed: 'cpu', 'cuda'|torch sees no GPU|GPUs)[^\n]*$"
    ):
        env.to(device)
    assert (
        env.device == env.observation_spec.device == env.action_spec.device == torch.device("cpu")
    )
    assert (rollout(env) == rollout(plain)).all()


@pytest.mark.parametrize("wrap", [lambda env: env, lambda env: TransformedEnv(env, StepCounter())])
def test_the_refusal_says_how_to_get_an_env_there(
    wrap: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    env, plain = (wrap(ArcadeEnv(GAME, N, seed=2)) for _ in range(2))
    monkeypatch.setattr(
        "arcade_torch.env.pick_devices", lambda device: (torch.device("cuda", 0), None)
    )
    message = "this env stays on cpu, where it was made: make one with device='cuda:0'"
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        env.to("cuda")
    assert (rollout(env) == rollout(plain)).all()


@pytest.mark.parametrize("wrap", [lambda env: env, lambda env: TransformedEnv(env, StepCounter())])
def test_torchrls_collector_may_name_the_device(wrap: Any) -> None:
    collector = Collector(
        wrap(ArcadeEnv(GAME, N)), frames_per_batch=N * T, total_frames=N * T, device="cpu"
    )
    assert [batch.shape for batch in collector] == [(N, T)]


def copied_by(way: str, thing: Any) -> Any:
    if way == "pickle":
        return pickle.dumps(thing)
    if way == "torch.save":
        return torch.save(thing, io.BytesIO())
    return copy.deepcopy(thing) if way == "deepcopy" else copy.copy(thing)


@pytest.mark.parametrize("way", ["deepcopy", "copy", "pickle", "torch.save"])
@pytest.mark.parametrize("wrapped", [False, True])
def test_a_copy_of_an_env_is_refused_in_one_line(way: str, wrapped: bool) -> None:
    env: Any = ArcadeEnv(GAME, N)
    if wrapped and way != "copy":  # a shallow copy of a transformed env holds the env itself
        env = TransformedEnv(env, StepCounter())
    message = (
        "an ArcadeEnv cannot be copied or pickled: make a second one, and pass get_state() to its "
        "set_state(); workers take a function that makes one, such as "
        "functools.partial(arcade_torch.make, ...)"
    )
    with pytest.raises(TypeError, match=f"^{re.escape(message)}$"):
        copied_by(way, env)


def test_what_the_refusal_of_a_copy_advises_works() -> None:
    env = ArcadeEnv(GAME, N, seed=3)
    env.rollout(T, break_when_any_done=False)
    other = ArcadeEnv(GAME, N, seed=4)
    action = torch.ones(N, dtype=torch.int64)
    roots = other.set_state(env.get_state()), env.observe()
    one, two = (
        each.step(root.set("action", action))
        for each, root in zip((other, env), roots, strict=True)
    )
    assert (one["next"].exclude("done") == two["next"].exclude("done")).all()


@pytest.mark.timeout(300)
@pytest.mark.parametrize("kind", [ParallelEnv, SerialEnv])
@pytest.mark.parametrize("created", few([False, True], often=[True]))
def test_factories_go_on_working(kind: Any, created: bool) -> None:
    factory: Any = partial(make, "SignpostEasy", num_envs=N)
    options = {"mp_start_method": "spawn"} if kind is ParallelEnv else {}
    env = kind(2, EnvCreator(factory) if created else factory, **options)
    try:
        assert env.rollout(T)["pixels"].shape == (2, N, T, 128, 128, 3)
    finally:
        env.close()


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({}, "ArcadeEnv(StubEasy-v0, num_envs=3, observability='full', device='cpu')"),
        (
            {"observability": "partial"},
            "ArcadeEnv(StubEasy-v0, num_envs=3, observability='partial', device='cpu')",
        ),
        (
            {"observability": [True, False, True]},
            "ArcadeEnv(StubEasy-v0, num_envs=3, observability='mixed', device='cpu')",
        ),
        (
            {"game": MIXED},
            "ArcadeEnv(2*StubEasy-v0+CoinEasy-v0, num_envs=3, observability='full', device='cpu')",
        ),
    ],
)
def test_an_env_says_what_it_is(options: dict[str, Any], text: str) -> None:
    env = ArcadeEnv(**{"game": GAME, "num_envs": N, **options})
    assert repr(env) == text
    assert text in repr(TransformedEnv(env, StepCounter()))


def test_the_text_follows_a_change_of_the_twin() -> None:
    env = ArcadeEnv(GAME, N)
    env.set_observability("partial")
    assert "observability='partial'" in repr(env)
