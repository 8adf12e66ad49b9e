"""``cuda_graphs``: acting's step can be captured, and is replayed where there is a GPU."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torch._subclasses.fake_tensor import DataDependentOutputException, FakeTensorMode

from arcade_torch.agents import load, preset, train, train_seeds, trainer
from arcade_torch.agents.actor import Step
from arcade_torch.agents.algorithms import ALGORITHMS
from arcade_torch.agents.graphs import graphed
from arcade_torch.models import memory_names

ENVS = 3


def step_of(algorithm: str, memory: str) -> tuple[Step, Callable[[int], TensorDictBase]]:
    chosen = ALGORITHMS[algorithm]
    network = chosen.make_network("small", memory)
    return chosen.make_actor(network, None).step, network.initial_state


def seen(device: str = "cpu") -> tuple[Tensor, Tensor, Tensor]:
    pixels = torch.randint(256, (ENVS, 128, 128, 3), dtype=torch.uint8, device=device)
    return (
        pixels,
        torch.zeros(ENVS, dtype=torch.int64, device=device),
        torch.zeros(ENVS, 1, dtype=torch.bool).to(device),
    )


@pytest.mark.parametrize("memory", memory_names())
@pytest.mark.parametrize("algorithm", ["pqn", "ppo"])
def test_no_step_asks_for_the_value_of_a_tensor(algorithm: str, memory: str) -> None:
    with FakeTensorMode(), torch.no_grad():  # whose tensors have no values; a captured graph could not ask either
        step, initial_state = step_of(algorithm, memory)
        state = initial_state(ENVS)
        assert not any(entry.requires_grad for entry in state.values(True, True))  # refused as an argument of a graph
        out, after = step(*seen(), state)
        assert out.shape[0] == ENVS and after.batch_size == state.batch_size
        with pytest.raises(DataDependentOutputException):
            bool(out.sum() > 0)  # the check can fail


def test_an_actor_plays_through_the_step_it_was_given() -> None:
    for algorithm, chosen in ALGORITHMS.items():
        network = chosen.make_network("small", "mlp")
        actor, calls = chosen.make_actor(network, None), []
        plain = actor.step
        obs = TensorDict(dict(zip(("pixels", "last_action", "is_init"), seen(), strict=True)), [ENVS])
        expected = actor.act(obs, actor.initial_state(ENVS))[0]

        def counted(*args: object, plain: Step = plain, calls: list[object] = calls) -> tuple[Tensor, TensorDictBase]:
            calls.append(args)
            return plain(*args)  # type: ignore[arg-type]

        actor.step = counted
        assert torch.equal(actor.act(obs, actor.initial_state(ENVS))[0], expected) and len(calls) == 1, algorithm


def test_without_a_cuda_device_there_is_one_clear_line(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="cuda_graphs must be false on device 'cpu'; it needs a CUDA device; got True"):
        preset("smoke", cuda_graphs=True)
    with pytest.raises(ValueError, match="CUDA graphs need a CUDA device; got 'cpu'"):
        graphed(step_of("pqn", "gru")[0], "cpu")
    config = preset("smoke", device="cuda", cuda_graphs=True)
    assert config.from_dict(config.to_dict()) == config
    with pytest.raises(ValueError, match="cuda_graphs must be false for several seeds in one process; got True"):
        train_seeds(config, [0, 1], tmp_path)


@pytest.mark.gpu
@pytest.mark.parametrize("memory", memory_names())
def test_replayed_steps_are_those_of_the_network(memory: str) -> None:
    network = ALGORITHMS["pqn"].make_network("small", memory).cuda()
    plain = ALGORITHMS["pqn"].make_actor(network, None).step
    replayed, states = graphed(plain, "cuda"), [network.initial_state(ENVS)] * 2
    with torch.no_grad():
        for _ in range(5):
            frames = seen("cuda")
            one, states[0] = plain(*frames, states[0])
            other, states[1] = replayed(*frames, states[1])
            torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-5)
            for parameter in network.parameters():
                parameter.mul_(1.01)  # in place, as an optimiser does


@pytest.mark.gpu
@pytest.mark.parametrize("algorithm", ["pqn", "ppo", "dqn"])
def test_a_run_with_graphs_is_a_run(algorithm: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = []
    monkeypatch.setattr(trainer, "graphed", lambda *args: made.append(graphed(*args)) or made[-1])
    config = preset("smoke", algorithm=algorithm, env="SignpostEasy", device="cuda", total_frames=192)
    train(dataclasses.replace(config, cuda_graphs=True), tmp_path / "graphs")
    assert len(made) == 1 and load(tmp_path / "graphs").config.cuda_graphs
