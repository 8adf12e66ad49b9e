"""``compile``, ``cuda_graphs`` and ``amp``: faster ways to the same agent, up to rounding."""

import dataclasses
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch._dynamo.testing import CompileCounter
from torch._subclasses.fake_tensor import DataDependentOutputException, FakeTensorMode
from torchrl.objectives import SoftUpdate

from arcade_torch.agents import (
    DQNLoss,
    PQNLoss,
    Trainer,
    build_network,
    cuda_graph,
    load,
    make_policy,
    preset,
    train,
    trainer,
    training,
)
from arcade_torch.agents.config import TrainConfig
from arcade_torch.agents.policy import compile_network
from arcade_torch.models import (
    Encoder,
    PaperEncoder,
    SmallEncoder,
    make_actor_critic,
    make_network,
    memory_names,
)
from tests.agents.fakes import look_into
from tests.agents.repeated import Repeated
from tests.agents.test_training import assert_goes_on_to_the_bit, assert_same_run

RUN = preset("smoke", env="SignpostEasy-v0", total_frames=192, checkpoint_every=64)
ENVS, STEPS = 4, 10


@pytest.fixture(autouse=True)
def _without_a_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        trainer, "COMPILE_BACKEND", "eager"
    )  # captured as for inductor, then run as it stands
    torch.compiler.reset()


@pytest.fixture(scope="module")
def batch() -> TensorDict:
    """A window of frames that need no game."""
    shape = ENVS, STEPS
    flags = torch.zeros(*shape, 1, dtype=torch.bool)
    truncated, is_init = flags.clone(), flags.clone()
    truncated[:, 5] = is_init[:, 6] = True
    after = {
        "reward": torch.randn(*shape, 1),
        "terminated": flags,
        "truncated": truncated,
        "done": truncated,
    }
    frames = torch.randint(256, (ENVS, STEPS + 2, 32, 32, 3), dtype=torch.uint8)
    roots = {"pixels": frames[:, :STEPS], "final_pixels": frames[:, STEPS:], "is_init": is_init}
    index = torch.tensor([[5, STEPS - 1]]).expand(ENVS, -1)
    actions = {key: torch.randint(5, shape) for key in ("action", "last_action")}
    places = {"final_index": index, "final_mask": torch.ones_like(index, dtype=torch.bool)}
    return TensorDict(roots | actions | places | {"next": after}, [ENVS])


def network_of(memory: str, seed: int = 0) -> Any:
    torch.manual_seed(seed)
    return make_network("small", memory, hidden_size=16)


def with_state(batch: TensorDict, network: Any) -> TensorDict:
    return batch.copy().set(
        "initial_state", TensorDict({"memory": network.initial_state(ENVS)}, [ENVS])
    )


@pytest.mark.parametrize("memory", ["lru", pytest.param("attention", marks=pytest.mark.slow)])
@pytest.mark.parametrize("backend", ["eager", pytest.param("aot_eager", marks=pytest.mark.slow)])
def test_loss_gradients_and_target_network_are_those_of_the_plain_network(
    batch: TensorDict, memory: str, backend: str
) -> None:
    """In 0.1 ``--compile`` silently had no target network: the copy kept the bound method of the
    online one.
    """
    plain, compiled, other = network_of(memory), network_of(memory), network_of(memory, 1)
    compile_network(compiled, backend)
    assert list(compiled.state_dict()) == list(plain.state_dict())
    data, found = with_state(batch, plain), []
    for network in (plain, compiled):
        loss = DQNLoss(network, delay_value=True)
        SoftUpdate(loss, eps=0.5)
        loss.target_value_network_params.data.update_(TensorDict.from_module(other).data)
        loss(data)["loss"].backward()
        found.append([look_into(loss, data)[2], *(p.grad for p in network.parameters())])
    for one, same in zip(*found, strict=True):
        torch.testing.assert_close(one, same, rtol=1e-4, atol=1e-5)
    target, online = (look_into(DQNLoss(network), data)[2] for network in (other, plain))
    torch.testing.assert_close(found[1][0], target, rtol=1e-4, atol=1e-5)
    assert (target - online).abs().max() > 1e-2


@pytest.mark.parametrize(
    "memory",
    ["lru", *(pytest.param(name, marks=pytest.mark.slow) for name in ("gru", "attention"))],
)
def test_a_network_is_compiled_once_for_acting_and_once_for_learning(
    batch: TensorDict, memory: str
) -> None:
    counter, network = CompileCounter(), network_of(memory)
    compile_network(network, counter)
    loss, data = PQNLoss(network), with_state(batch, network)
    optimizer = torch.optim.SGD(network.parameters(), lr=1e-3)
    prepared = loss.prepare(data)
    policy = make_policy(network, explore=False)

    def learn(times: int) -> None:
        for i in range(times):
            optimizer.zero_grad()
            loss(prepared[torch.tensor([i % 4, (i + 1) % 4])])["loss"].backward()
            optimizer.step()

    def act() -> None:
        with torch.no_grad():
            roots = {key: data[key][:, 0] for key in ("pixels", "last_action", "is_init")}
            policy(TensorDict(roots, [ENVS]).update(data["initial_state"]))

    learn(2)
    act()
    act()
    graphs = counter.frame_count
    assert graphs > 0
    for _ in range(10):
        learn(20)
        act()
    assert counter.frame_count == graphs


@pytest.mark.slow
def test_generated_code_agrees_too(batch: TensorDict) -> None:
    found = []
    for backend in ("inductor", "eager"):
        network = network_of("lru")
        compile_network(network, backend)
        PQNLoss(network)(with_state(batch, network))["loss"].backward()
        found.append([p.grad for p in network.parameters()])
    for one, same in zip(*found, strict=True):
        torch.testing.assert_close(one, same, rtol=1e-4, atol=1e-5)


def test_a_compiled_run_goes_on_to_the_bit_and_its_agent_is_loaded_plain(tmp_path: Path) -> None:
    folder = assert_goes_on_to_the_bit(dataclasses.replace(RUN, compile=True), tmp_path)
    assert load(folder).network.encoder._compiled_call_impl is None


# -- cuda_graphs -----------------------------------------------------------------------------------


@pytest.mark.parametrize("memory", memory_names())
@pytest.mark.parametrize("kind", ["q", "actor-critic"])
def test_acting_asks_for_the_value_of_no_tensor(kind: str, memory: str) -> None:
    network = (make_network if kind == "q" else make_actor_critic)("small", memory, hidden_size=16)
    # Tensors without values: a graph has none to ask.
    with (
        FakeTensorMode(allow_non_fake_inputs=True),
        torch.no_grad(),
    ):
        roots = {
            "pixels": torch.zeros(ENVS, 32, 32, 3, dtype=torch.uint8),
            "last_action": torch.zeros(ENVS).long(),
        }
        step = TensorDict(roots | {"is_init": torch.zeros(ENVS, 1).bool()}, [ENVS])
        step["memory"] = network.initial_state(ENVS)
        out = network(step)["action_value" if kind == "q" else "logits"]
        assert out.shape == (ENVS, 5)
        with pytest.raises(DataDependentOutputException):
            bool(out.sum() > 0)  # the check can fail


@pytest.mark.parametrize("algorithm", ["pqn", "ppo", "dqn"])
def test_a_run_that_is_replayed_is_the_run(
    algorithm: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a recording that repeats the work on its own memory in the place of a CUDA graph; acting
    and gradient steps have one layout each.
    """
    config = preset(
        "smoke", algorithm=algorithm, env="CartPoleEasy-v0", memory="gru", total_frames=256
    )
    train(config, tmp_path / "plain")
    Repeated.recordings.clear()
    monkeypatch.setattr(cuda_graph, "CudaRecording", Repeated)
    monkeypatch.setattr(training, "Trainer", _with_graphs)
    train(config, tmp_path / "graphed")
    assert_same_run(tmp_path / "plain", tmp_path / "graphed")
    acting, step = sorted(Repeated.recordings, key=lambda one: -one.replays)
    assert step.replays > 1 and acting.replays >= 28


def _with_graphs(config: TrainConfig, folder: Path) -> Trainer:
    """A trainer that was told of graphs where the config would refuse them."""
    object.__setattr__(config := dataclasses.replace(config), "cuda_graphs", True)
    return Trainer(config, folder)


@pytest.mark.gpu
@pytest.mark.parametrize("algorithm", ["pqn", "ppo", "dqn"])
def test_a_run_with_graphs_is_a_run(algorithm: str, tmp_path: Path, cuda: str) -> None:
    config = preset(
        "smoke", algorithm=algorithm, env="SignpostEasy", device=cuda, total_frames=1024
    )
    results = [
        train(dataclasses.replace(config, cuda_graphs=on), tmp_path / str(on))
        for on in (True, False)
    ]
    assert (
        all(result.status == "finished" for result in results)
        and load(tmp_path / "True").config.cuda_graphs
    )
    one, other = (load(tmp_path / str(on)).network.state_dict() for on in (True, False))
    for name, weight in one.items():
        if algorithm != "ppo":  # which draws its actions inside the graph
            torch.testing.assert_close(weight, other[name], rtol=1e-2, atol=1e-3)


# -- amp -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [PaperEncoder, SmallEncoder])
def test_amp_features_and_gradients_are_float32_and_close_to_exact_ones(
    kind: type[Encoder],
) -> None:
    encoder = kind(128)  # type: ignore[call-arg]
    frames = torch.randint(256, (4, 128, 128, 3), dtype=torch.uint8)
    exact = encoder(frames)
    encoder.amp = True
    found = encoder(frames)
    assert found.dtype is torch.float32 and not torch.equal(found, exact)
    assert (found - exact).abs().max() < 0.02 * exact.abs().max()  # bfloat16 has 8 bits
    found.sum().backward()
    gradients = [p.grad for p in encoder.parameters()]
    assert all(g is not None and g.dtype is torch.float32 and g.isfinite().all() for g in gradients)


@pytest.mark.parametrize("algorithm", ["pqn", "ppo"])
def test_every_encoder_of_a_network_follows_the_config(algorithm: str) -> None:
    for amp in (False, True):
        network = build_network(preset("smoke", algorithm=algorithm, amp=amp))
        encoders = [module for module in network.modules() if isinstance(module, Encoder)]
        assert encoders and all(encoder.amp is amp for encoder in encoders)


def test_an_amp_run_goes_on_to_the_bit_and_its_agent_acts_as_it_was_trained(tmp_path: Path) -> None:
    assert load(
        assert_goes_on_to_the_bit(dataclasses.replace(RUN, amp=True), tmp_path)
    ).network.encoder.amp
