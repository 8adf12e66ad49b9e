"""Every memory model inside every loss of TorchRL that takes discrete actions, and inside ours.

A cell passes if the loss is finite, every network's memory receives a gradient, and the targets
(where there are any) move under ``SoftUpdate``. The table of docs/losses.md is made by

    python -m tests.contracts.test_torchrl_losses
"""

import copy
import functools
import re
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictSequential
from torch import nn
from torchrl.modules import set_recurrent_mode
from torchrl.objectives import (
    A2CLoss,
    ClipPPOLoss,
    DiscreteCQLLoss,
    DiscreteSACLoss,
    LossModule,
    ReinforceLoss,
    SoftUpdate,
    ValueEstimators,
)
from torchrl.objectives import DQNLoss as TorchRLDQNLoss
from torchrl.objectives.value import GAE

from arcade_torch.agents.dqn import DQNLoss
from arcade_torch.agents.policy import make_actor
from arcade_torch.agents.ppo import PPOLoss
from arcade_torch.agents.pqn import PQNLoss
from arcade_torch.models import memory_names
from tests.contracts.pomdp import ACTIONS, CONTROL, STEPS, collected, explorer, network
from tests.few import MEMORIES as OFTEN
from tests.few import few_memories

PAGE = Path(__file__).resolve().parents[2] / "docs/losses.md"
MEMORIES = (
    "lru",
    "mingru",
    "gru",
    "linear_transformer",
    "attention",
    "gdn",
    "ttt",
    "lstm",
    "frame_stack",
    "mlp",
    "ffm",
    "shm",
    "rtu",
    "deltaproduct",
    "rwkv7",
    "s5",
    "mamba",
    "slstm",
    "mlstm",
    "gtrxl",
    "bmru",
)


class Row(NamedTuple):
    """A loss."""

    make: Callable[[str], tuple[LossModule, TensorDictBase]]
    """from the name of a memory to the loss and a batch that its networks collected"""
    has_targets: bool


@functools.cache
def collect_once(kind: str, memory: str) -> tuple[nn.ModuleList, TensorDictBase]:
    """Networks of a kind, and a batch that they collected."""
    torch.manual_seed(0)
    if kind == "value":
        value, policy = explorer(memory)
        return nn.ModuleList([value]), collected(policy)
    actor = make_actor(network(memory, "logits", "actor"))
    other = network(memory, "state_value", "critic") if kind == "actor-critic" else network(memory)
    return nn.ModuleList([actor, other]), collected(TensorDictSequential(other, actor)).exclude(
        "state_value"
    )


def experience(kind: str, memory: str) -> Any:
    """Copies of what :func:`collect_once` gives: the networks, then the batch."""
    networks, batch = collect_once(kind, memory)
    return *copy.deepcopy(networks), batch.clone()


def of_values(make: Callable[..., LossModule], has_targets: bool = True, **options: object) -> Row:
    """A loss of a network of Q-values."""

    def cell(memory: str) -> tuple[LossModule, TensorDictBase]:
        value, batch = experience("value", memory)
        return make(value, **options), batch

    return Row(cell, has_targets)


def of_policies(make: Callable[..., LossModule], advantages: str, **options: object) -> Row:
    """A loss of actor and critic; advantages by ``GAE`` in one of its forms, or by the loss
    itself.
    """

    def cell(memory: str) -> tuple[LossModule, TensorDictBase]:
        actor, critic, batch = experience("actor-critic", memory)
        loss = make(actor, critic, **options)
        if advantages == "loss":
            if make is not PPOLoss:
                loss.make_value_estimator(ValueEstimators.GAE, gamma=0.9, lmbda=0.8)
            return loss, batch
        shifted = {"shifted": True, "shifted_budget": STEPS + 1} if advantages == "shifted" else {}
        with set_recurrent_mode(True):  # a loss does so by itself, GAE called on its own does not
            batch = GAE(gamma=0.9, lmbda=0.8, value_network=critic, **shifted)(batch)
        assert batch["advantage"].isfinite().all()
        return loss, batch

    return Row(cell, has_targets=False)


def discrete_sac(memory: str) -> tuple[LossModule, TensorDictBase]:
    """Two critics under ``vmap``."""
    actor, value, batch = experience("actor-value", memory)
    return DiscreteSACLoss(
        actor, value, action_space="categorical", num_actions=ACTIONS, num_qvalue_nets=2
    ), batch


CATEGORICAL = {"action_space": "categorical"}
LOSSES: dict[str, Row] = {
    "DQNLoss(delay_value=True)": of_values(TorchRLDQNLoss, delay_value=True, **CATEGORICAL),
    "DQNLoss(double_dqn=True)": of_values(
        TorchRLDQNLoss, delay_value=True, double_dqn=True, **CATEGORICAL
    ),
    **{
        f"{loss.__name__}, {text}": of_policies(loss, form)
        for loss in (ClipPPOLoss, A2CLoss, ReinforceLoss)
        for form, text in (
            ("loss", "its own estimator"),
            ("plain", "GAE"),
            ("shifted", "GAE(shifted=True)"),
        )
    },
    "DiscreteSACLoss": Row(discrete_sac, has_targets=True),
    "DiscreteCQLLoss": of_values(DiscreteCQLLoss, **CATEGORICAL),
    "ours: PQNLoss": of_values(PQNLoss, has_targets=False),
    "ours: DQNLoss(delay_value=True)": of_values(DQNLoss, delay_value=True),
    "ours: PPOLoss, its own estimator": of_policies(PPOLoss, "loss"),
    "ours: PPOLoss, GAE": of_policies(PPOLoss, "plain"),
}


def memory_gradients(loss: LossModule) -> dict[str, float]:
    """Largest gradient in the memory of each network of a loss."""
    found: dict[str, float] = {}
    for name, parameter in loss.named_parameters():
        owner, _, rest = name.partition(".")
        if (
            owner.endswith("_params")
            and not owner.startswith("target_")
            and is_memory(rest.replace("___", "."))
        ):
            grad = 0.0 if parameter.grad is None else float(parameter.grad.abs().max())
            found[owner] = max(grad, found.get(owner, 0.0))
    return found


def check(loss: LossModule, batch: TensorDictBase, has_targets: bool) -> None:
    """One gradient step, and one step of the targets if there are any.

    Raises:
        AssertionError: something is not as it must be; and whatever the loss raises.
    """
    targets = {name: child for name, child in loss.named_children() if name.startswith("target_")}
    assert bool(targets) == has_targets
    updater = SoftUpdate(loss, eps=0.5) if targets else None
    out = loss(batch)
    losses = [value for key, value in out.items() if key.startswith("loss")]
    assert losses and all(bool(value.isfinite().all()) for value in losses), "a loss is not finite"
    sum(losses).backward()  # type: ignore[union-attr]
    gradients = memory_gradients(loss)
    networks = {
        name
        for name, _ in loss.named_children()
        if name.endswith("_params") and name not in targets
    }
    assert set(gradients) == networks
    assert all(0 < value < float("inf") for value in gradients.values()), f"gradients {gradients}"
    if updater is not None:
        before = {name: params.clone() for name, params in targets.items()}
        with torch.no_grad():
            for parameter in loss.parameters():
                parameter.add_(1)
        updater.step()
        for name, params in targets.items():
            moved = (params.data - before[name].data).flatten_keys(".")
            memory = [value for key, value in moved.items() if is_memory(key) and value.numel()]
            assert memory and all(bool(((value - 0.5).abs() < 1e-4).all()) for value in memory), (
                "targets did not move"
            )


def is_memory(name: str) -> bool:
    """Whether a parameter belongs to the memory: our blocks, or the layers of ``GRUModule``."""
    return "block." in name or "weight_hh" in name or "weight_ih" in name


@functools.cache
def outcome(loss: str, memory: str) -> str:
    """A cell of the table: "yes", or the error in a few words."""
    torch.manual_seed(0)
    cell = LOSSES[loss]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            check(*cell.make(memory), has_targets=cell.has_targets)
    except Exception as error:  # the control is expected to fail, in whatever way
        return (
            f"{type(error).__name__}: "
            f"{str(error).strip().splitlines()[0] if str(error).strip() else ''}"
        )
    return "yes"


def table() -> str:
    """The table of docs/losses.md."""
    columns = (*MEMORIES, CONTROL)
    lines = [
        f"| loss | {' | '.join(f'`{name}`' for name in columns)} |",
        f"|---|{'---|' * len(columns)}",
    ]
    for loss in LOSSES:
        cells = ["yes" if outcome(loss, memory) == "yes" else "no" for memory in columns]
        lines.append(f"| {loss} | {' | '.join(cells)} |")
    return "\n".join(lines)


def test_every_memory_is_in_the_matrix() -> None:
    assert set(memory_names()) == set(MEMORIES)


@pytest.mark.parametrize("memory", few_memories(MEMORIES))
@pytest.mark.parametrize("loss", LOSSES)
def test_the_memory_learns_in_the_loss(loss: str, memory: str) -> None:
    assert outcome(loss, memory) == "yes"


def test_the_table_in_the_documentation_has_every_loss_and_memory_and_is_true_of_a_few() -> None:
    (page,) = re.findall(r"(?:^\|.*`lru`.*\n)(?:^\|.*\n)*", PAGE.read_text("utf-8"), re.MULTILINE)
    head, _, *rows = [
        [cell.strip(" `") for cell in row.split("|")[1:-1]] for row in page.splitlines()
    ]
    assert head == ["loss", *MEMORIES, CONTROL]
    assert [row[0] for row in rows] == list(LOSSES)
    for loss, *cells in rows:
        for memory, cell in zip(head[1:], cells, strict=True):
            if memory in {*OFTEN, CONTROL}:
                assert cell == ("yes" if outcome(loss, memory) == "yes" else "no"), (loss, memory)


@pytest.mark.slow
def test_the_table_in_the_documentation_is_that_of_the_matrix() -> None:
    assert table() in PAGE.read_text(encoding="utf-8"), (
        "run: python -m tests.contracts.test_torchrl_losses"
    )


def write_page() -> None:
    """Put the table into the page, in the place of the one that is there."""
    text = PAGE.read_text(encoding="utf-8")
    old = re.search(r"^\| loss \|.*\n(\|.*\n)*", text, re.MULTILINE)
    assert old is not None
    PAGE.write_text(text.replace(old[0], table() + "\n"), encoding="utf-8")
    for loss in LOSSES:
        for memory in (*MEMORIES, CONTROL):
            if (found := outcome(loss, memory)) != "yes":
                print(f"{loss}, {memory}: {found}")


if __name__ == "__main__":
    write_page()
