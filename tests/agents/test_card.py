"""What a GPU would stumble over, asked without one."""

import subprocess
import sys
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torch.utils import backend_registration
from torch.utils._python_dispatch import TorchDispatchMode
from torchrl.envs.utils import ExplorationType, set_exploration_type

from arcade_torch.agents import preset
from arcade_torch.agents.cuda_graph import WARM_UPS, GraphedFunction, GraphedPolicy
from arcade_torch.agents.policy import EpsilonGreedy, make_policy
from arcade_torch.agents.trainer import Trainer
from arcade_torch.agents.training import own_random_numbers
from arcade_torch.models import make_network, memory_names

from ..few import MEMORIES as MEMORIES_OFTEN
from .fake_device import prepare
from .repeated import Repeated
from .test_training import assert_same_run

ROOT = Path(__file__).resolve().parents[2]
every_algorithm = pytest.mark.parametrize("algorithm", ["pqn", "ppo", "dqn"])


@pytest.mark.parametrize(
    "memories", [MEMORIES_OFTEN, pytest.param((), id="all", marks=pytest.mark.slow)]
)
def test_on_a_fake_device_nothing_runs_on_the_cpu_is_copied_or_waits(
    memories: tuple[str, ...],
) -> None:
    """Acting, preparing a window and a gradient step of all algorithms."""
    if not hasattr(backend_registration, "_setup_privateuseone_for_python_backend"):
        pytest.skip("this torch has no such backend: the function is a private one")
    command = [sys.executable, "-m", "tests.agents.fake_device", *memories]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]
    rows = [line.split("|")[1:-1] for line in done.stdout.splitlines() if line.startswith("| ")]
    assert len(rows) == 1 + 3 * len(memories or memory_names()) * 3
    for row in rows[1:]:
        assert [int(number) for number in row[4:]] == [0, 0, 0], done.stdout


class Asked(TorchDispatchMode):
    """Counts the operators by which the host asks for a value."""

    def __init__(self) -> None:
        super().__init__()
        self.count = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        self.count += "_local_scalar_dense" in str(func)
        return func(*args, **(kwargs or {}))


@every_algorithm
def test_a_gradient_step_asks_for_no_value(algorithm: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """But for the optimiser, which counts on the CPU where it is not captured."""
    trainer = Trainer(preset("smoke", algorithm=algorithm, env="CartPoleEasy"))
    data = prepare(trainer.learner, trainer.collector.collect())
    monkeypatch.setattr(trainer.learner.optimizer, "step", lambda: None)
    with Asked() as asked:
        trainer.learner._plain_step(data[:2])
    assert asked.count == 0
    with Asked() as asked:
        bool(torch.ones(1) > 0)
    assert asked.count == 1  # the check can fail


MEMORIES = ["lru", *[pytest.param(name, marks=pytest.mark.slow) for name in ("gru", "gdn")]]


@every_algorithm
@pytest.mark.parametrize("memory", MEMORIES)
@pytest.mark.filterwarnings("ignore")
def test_losses_and_acting_are_one_graph_each(algorithm: str, memory: str) -> None:
    """A break in the graph is a wait, or Python that a CUDA graph would not repeat."""
    numbers = {"num_envs": 4, "num_steps": 8, "minibatches": 2}
    options = {"algorithm": algorithm, "memory": memory, algorithm: numbers}
    trainer = Trainer(preset("smoke", env="SkittlesEasy", **options))
    data = prepare(trainer.learner, trainer.collector.collect())[:2]

    def loss(data: TensorDict) -> Tensor:
        losses = trainer.learner.loss(data)
        return sum(value for key, value in losses.items() if key.startswith("loss"))

    def act(td: TensorDict) -> Tensor:
        return trainer.network(td)["logits" if algorithm == "ppo" else "action_value"]

    torch._dynamo.reset()
    options = {"fullgraph": True, "backend": "aot_eager"}
    torch.testing.assert_close(torch.compile(loss, **options)(data.clone()), loss(data.clone()))
    step = TensorDict(trainer.collector._obs, [4]).update(trainer.collector._state)
    torch.testing.assert_close(torch.compile(act, **options)(step.clone()), act(step.clone()))


def test_random_actions_are_drawn_where_the_policy_is() -> None:
    """Before: TorchRL moved ``eps`` alone, so every random action was drawn on the CPU."""
    policy = make_policy(make_network("small", "mlp"))
    explorer = policy[-1]
    assert isinstance(explorer, EpsilonGreedy)
    assert make_policy(make_network("small", "mlp").to("meta"))[-1].eps.device.type == "meta"
    explorer.to("meta")
    assert explorer.eps.device.type == explorer.spec["action"].device.type == "meta"
    assert explorer.spec["action"].rand((3,)).device.type == "meta"


def test_a_run_has_the_random_numbers_of_its_own_device_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Before: those of all GPUs were forked and seeded."""
    gpus = [torch.Generator().manual_seed(number) for number in range(3)]
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "init", lambda: None)
    monkeypatch.setattr(torch.cuda, "default_generators", gpus)
    host = torch.default_generator.get_state()
    states = [gpu.get_state() for gpu in gpus]
    with own_random_numbers(torch.device("cuda:1"), 7):
        assert gpus[1].initial_seed() == torch.default_generator.initial_seed() == 7
        assert torch.equal(gpus[0].get_state(), states[0])
        assert torch.equal(gpus[2].get_state(), states[2])
    for gpu, state in zip(gpus, states, strict=True):
        assert torch.equal(gpu.get_state(), state)
    assert torch.equal(torch.default_generator.get_state(), host)


def test_a_replayed_function_gives_what_the_function_gives() -> None:
    scale = torch.ones(())

    def function(data: TensorDict) -> TensorDict:
        return TensorDict({"y": data["x"] * scale, "n": {"z": data["n", "w"] + 1}}, [2])

    Repeated.recordings.clear()
    graphed = GraphedFunction(function, Repeated)
    held = []
    for step in range(8):
        x, w = torch.randn(2, 3), torch.randn(2)
        data = TensorDict({"x": x, "n": {"w": w}}, [2])
        copy = data.clone()
        scale.fill_(step)
        result = graphed(data)
        assert torch.equal(result["y"], x * step) and torch.equal(result["n", "z"], w + 1)
        assert (data == copy).all()
        held.append((result, result.clone()))
    assert all((result == copy).all() for result, copy in held)  # no later call writes to it
    (recording,) = Repeated.recordings
    assert (recording.warm_ups, recording.replays) == (WARM_UPS, 8 - WARM_UPS)
    graphed(TensorDict({"x": torch.ones(2, 4), "n": {"w": torch.ones(2)}}, [2]))
    assert len(Repeated.recordings) == 2  # another shape


def test_a_replayed_policy_acts_and_explores_as_the_policy_does() -> None:
    network = make_network("small", "gru")
    policy = make_policy(network, epsilon=0.5)
    replayed = GraphedPolicy(policy, Repeated)
    state: Tensor = network.initial_state(4)
    twin = state.clone()
    for kind in (ExplorationType.RANDOM, ExplorationType.DETERMINISTIC):
        for step in range(6):
            frames = torch.randint(256, (4, 8, 8, 48), dtype=torch.uint8)
            td = TensorDict({"pixels": frames, "last_action": torch.zeros(4).long()}, [4])
            td["is_init"] = torch.rand(4, 1) < 0.3
            with torch.no_grad(), set_exploration_type(kind):
                torch.manual_seed(step)
                one = policy(td.copy().set("memory", state))
                torch.manual_seed(step)
                other = replayed(td.copy().set("memory", twin))
            assert (one.select(*other.keys(True, True)) == other).all()
            assert other["pixels"] is frames or torch.equal(other["pixels"], frames)
            state, twin = one["next", "memory"], other["next", "memory"]


OTHER_DEFAULT = """
import sys
import torch, torchrl.collectors, torchrl.objectives
from arcade_torch.agents import preset, train
for place, default in (("a", "cpu"), ("b", "meta")):
    torch.set_default_device(default)
    for algorithm in ("pqn", "ppo", "dqn"):
        options = {"env": "CartPoleEasy", "total_frames": 256, "device": "cpu"}
        train(preset("smoke", algorithm=algorithm, **options), f"{sys.argv[1]}/{place}-{algorithm}")
"""


@pytest.mark.slow
def test_a_run_on_the_cpu_is_the_same_whatever_torchs_default_device_is(tmp_path: Path) -> None:
    """Before: orders of minibatches and weights were drawn on the default device, or failed."""
    command = [sys.executable, "-c", OTHER_DEFAULT, str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]
    for algorithm in ("pqn", "ppo", "dqn"):
        assert_same_run(tmp_path / f"a-{algorithm}", tmp_path / f"b-{algorithm}")
