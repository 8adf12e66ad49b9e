"""The twelve laws that pin the analyses, by number; the files beside this one go further into each
of them.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from arcade_torch.agents.runs.files import read_csv
from arcade_torch.models import memory_names
from arcade_torch.tools import Policy, contamination, recall_density, saliency
from arcade_torch.tools.figures.style import seeds_note
from arcade_torch.tools.measures.bootstrap import measured_coverage, pooled
from arcade_torch.tools.measures.gap_bias.paper import PAPER_RETURNS, paper_table
from arcade_torch.tools.measures.recall_density.measure import density_of_windows
from arcade_torch.tools.measures.windows import greedy_windows
from tests.tools.measures.toys import (
    ACTIONS,
    F64,
    SIZE,
    Net,
    ToyEnv,
    frames,
    linear_policy,
    matrices,
    window,
)

# agent: MDP, POMDP, Gap, Bias; POMDP, Gap, Bias without Tetris; SEM MDP, POMDP; half-width MDP,
# POMDP
TABLE = {
    "MLP": (0.672, 0.439, 0.233, 0.0, 0.451, 0.259, 0.0, 0.0010, 0.0011, 0.0025, 0.0031),
    "LRU": (0.659, 0.594, 0.065, -0.013, 0.659, 0.073, 0.022, 0.0010, 0.0013, 0.0029, 0.0042),
    "GRU": (0.652, 0.565, 0.088, -0.020, 0.626, 0.098, 0.014, 0.0014, 0.0017, 0.0047, 0.0052),
    "MinGRU": (0.613, 0.471, 0.142, -0.059, 0.522, 0.158, -0.029, 0.0017, 0.0015, 0.0074, 0.0041),
    "FART": (0.476, 0.421, 0.055, -0.196, 0.467, 0.061, -0.182, 0.0018, 0.0017, 0.0056, 0.0047),
    "attention": (
        0.510,
        0.403,
        0.107,
        -0.161,
        0.447,
        0.119,
        -0.143,
        0.0024,
        0.0014,
        0.0094,
        0.0047,
    ),
    "TTTL": (0.415, 0.408, 0.008, -0.257, 0.452, 0.009, -0.249, 0.0023, 0.0032, 0.0064, 0.0093),
    "GDN": (0.522, 0.469, 0.054, -0.150, 0.520, 0.060, -0.130, 0.0028, 0.0027, 0.0079, 0.0079),
    "human": (0.570, 0.335, 0.236, -0.101, 0.370, 0.248, -0.091, 0.0140, 0.0108, 0.0337, 0.0306),
}


def geometric_mass(rho: float, steps: int, x: float) -> float:
    """Closed form: mass of delta_t = rho^(n-t) (1 - rho) / (1 - rho^(n+1)) before normalised time
    x.
    """
    whole = min(int(x * steps + 1e-9), steps)
    before = (rho ** (steps - whole) - rho**steps) / (1 - rho**steps)
    share = rho ** (steps - 1 - whole) * (1 - rho) / (1 - rho**steps) if whole < steps else 0.0
    return before + (x * steps - whole) * share


@given(rho=st.floats(0.2, 0.95), steps=st.integers(3, 40))
def test_law_01_a_linear_memory_has_the_closed_form_in_value_norms_and_bins(
    rho: float, steps: int
) -> None:
    encoder, head = matrices()
    gradient = (head @ encoder).abs().sum()  # sum over actions of the L1 norm of C^T w_a
    policy = linear_policy(rho)
    l1, squared = (
        saliency(policy, frames(steps), norm=norm, dtype=F64).per_frame for norm in ("l1", "l2sq")
    )
    np.testing.assert_allclose(l1, float(gradient) * rho ** np.arange(steps - 1, -1, -1), rtol=1e-9)
    np.testing.assert_allclose(squared[1:] / squared[:-1], rho**-2, rtol=1e-9)
    found = density_of_windows(linear_policy(rho, dtype=torch.float32), [window(steps)])
    for bins in (3, 16):
        edges = [geometric_mass(rho, steps, part / bins) for part in range(bins + 1)]
        np.testing.assert_allclose(found.mass(bins), np.diff(edges), rtol=1e-4, atol=1e-7)


def test_law_02_without_memory_all_mass_is_on_the_last_frame_and_noise_on_others_changes_nothing() -> (
    None
):
    for model in (Net("mlp", torch.float32), linear_policy(0.0, dtype=torch.float32)):
        player = Policy(model.encode, model.remember, model.initial_state)
        found = recall_density(player, ToyEnv([16, 17, 20, 40]), episodes=8)
        assert all(share[-1] == 1.0 and not share[:-1].any() for share in found.shares)
        for bins in (1, 2, 3, 5, 16):
            np.testing.assert_allclose(found.mass(bins), np.eye(1, bins, bins - 1)[0], atol=1e-12)
        moved = contamination(player, ToyEnv([16, 20]), delays=(0, 1, 2, 5), starts=12)
        assert (np.nan_to_num(moved.flip[..., 1:]) == 0).all() and (
            np.nan_to_num(moved.change[..., 1:]) == 0
        ).all()
        assert (
            moved.mean("change")[:, 0].min() > 0
        )  # the ceiling: noise on the decision's own frame


@pytest.mark.parametrize("steps", [3, 4, 10, 16, 17, 257])
def test_law_03_density_sums_to_one_and_is_blind_to_the_scale_of_pixels_and_values(
    steps: int,
) -> None:
    shares = {}
    for scale, gain in ((1.0, 1.0), (255.0, 1.0), (1.0, 1000.0)):
        policy = linear_policy(0.9, dtype=torch.float32, pixel_scale=scale, gain=gain)
        found = density_of_windows(policy, [window(steps)])
        shares[scale, gain] = found.shares[0]
        assert found.shares[0].sum() == pytest.approx(1.0, rel=1e-6)
        for bins in (1, 3, 7, 16, 300):
            assert found.mass(bins).sum() == pytest.approx(1.0, rel=1e-6)
    first, *others = shares.values()
    for other in others:
        np.testing.assert_allclose(other, first, rtol=1e-4, atol=1e-9)


@pytest.mark.parametrize("name", memory_names())
def test_law_04_all_gradients_before_a_start_flag_are_exactly_zero(name: str) -> None:
    found = density_of_windows(Net(name, torch.float32), [window(7, starts=(0, 3))])
    assert (found.shares[0][:3] == 0).all()
    assert found.shares[0][-1] > 0


@pytest.mark.parametrize("width", [2, 3])
def test_law_05_a_sliding_window_sees_its_width_and_two_layers_twice_that(width: int) -> None:
    n = 8
    one = saliency(Net("attention", window=width), frames(n + 1), dtype=F64).per_frame
    assert (one[: n - width + 1] == 0).all() and one[n - width + 1] > 0
    two = saliency(Net("attention", layers=2, window=width), frames(n + 1), dtype=F64).per_frame
    assert (two[: n - 2 * width + 2] == 0).all() and two[n - 2 * width + 2] > 0


@pytest.mark.parametrize("name", memory_names())
def test_law_06_one_batched_pass_equals_a_loop_over_actions_and_finite_differences(
    name: str,
) -> None:
    net, steps = Net(name), 4
    o = frames(steps).to(F64)
    looped = torch.stack(gradients(net, o)).square().sum((0, 4))
    found = saliency(net, o, dtype=F64)
    np.testing.assert_allclose(found.per_frame, looped.sum((1, 2)), rtol=1e-9, atol=1e-20)
    if name == "bmru":
        return  # a step function: its gradients are those of another function

    def value(shift: float) -> Tensor:
        moved = o.clone()
        moved[1, 1, 2, 0] += shift
        return outputs_of(net, moved)

    slope = (-value(2e-1) + 8 * value(1e-1) - 8 * value(-1e-1) + value(-2e-1)) / 1.2  # fourth order
    exact = torch.stack([gradient[1, 1, 2, 0] for gradient in gradients(net, o)])
    np.testing.assert_allclose(slope.detach(), exact, rtol=1e-6, atol=1e-10)


def test_law_06_opposite_effects_cancel_in_the_sum_but_not_per_action() -> None:
    def remember(e: Tensor, a: Tensor, s: Tensor, state: object) -> tuple[Tensor, object]:
        return torch.cat([e, -e], -1), state  # Q_0 = +x, Q_1 = -x

    policy = Policy(lambda o: o.flatten(-3).sum(-1, keepdim=True), remember)
    assert saliency(policy, frames(1), reduce="sum", norm="l1").per_frame == 0
    assert saliency(policy, frames(1), norm="l1").per_frame == 2 * SIZE * SIZE * 3
    assert density_of_windows(policy, [window(3)], reduce="sum").silent == 1


def outputs_of(net: Net, o: Tensor) -> Tensor:
    """Outputs at the last step, computed in one piece."""
    steps = o.shape[0]
    flags, actions = (
        torch.zeros(1, steps, dtype=torch.bool),
        torch.zeros(1, steps, dtype=torch.int64),
    )
    return net.remember(net.encode(o)[None], actions, flags, net.initial_state(1))[0][0, -1]


def gradients(net: Net, o: Tensor) -> list[Tensor]:
    """dQ_a/do of every action, each by one backward pass through everything."""
    found = []
    for action in range(ACTIONS):
        leaf = o.clone().requires_grad_()
        found += torch.autograd.grad(outputs_of(net, leaf)[action], leaf)
    return found


@pytest.mark.parametrize("chunk", [1, 2, 5, 64])
def test_law_07_two_stages_equal_plain_differentiation_for_any_chunk(chunk: int) -> None:
    net, o = Net("gru"), frames(5).to(F64)
    wanted = torch.stack(gradients(net, o))
    found = saliency(net, o, norm="l1", chunk=chunk, dtype=F64)
    np.testing.assert_allclose(found.maps, wanted.abs().sum((0, 4)), rtol=1e-5)
    np.testing.assert_allclose(found.per_frame, wanted.abs().sum((0, 2, 3, 4)), rtol=1e-9)


class _Plain(torch.autograd.Function):
    """A square whose gradient asks for values, which vmap has no answer to."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        ctx.save_for_backward(x)
        return x.square()

    @staticmethod
    def backward(ctx: Any, g: Tensor) -> Tensor:
        assert g.abs().max().item() >= 0
        return 2 * ctx.saved_tensors[0] * g


@pytest.mark.parametrize("reduce", ["per_action", "sum"])
def test_law_07_a_memory_that_cannot_be_batched_is_differentiated_action_by_action(
    reduce: Literal["sum"],
) -> None:
    net = Net("mingru")

    def through(square: Callable[[Tensor], Tensor]) -> Policy:
        def remember(
            e: Tensor, last_action: Tensor, is_init: Tensor, state: Any
        ) -> tuple[Tensor, Any]:
            return net.remember(square(e), last_action, is_init, state)

        return Policy(net.encode, remember, net.initial_state)

    wanted = saliency(through(torch.square), frames(5), dtype=F64, reduce=reduce)
    found = saliency(through(_Plain.apply), frames(5), dtype=F64, reduce=reduce)
    assert wanted.maps.any()
    np.testing.assert_allclose(found.maps, wanted.maps, rtol=1e-9)
    with pytest.raises(RuntimeError, match="Batching rule"):
        leaf = frames(2).to(F64).requires_grad_()
        torch.autograd.grad(
            _Plain.apply(leaf), leaf, torch.ones(3, *leaf.shape, dtype=F64), is_grads_batched=True
        )


def test_law_08_probabilities_of_two_actions_give_the_density_of_their_log_odds() -> None:
    base = linear_policy(0.8)

    def remember(e: Tensor, a: Tensor, s: Tensor, state: object) -> tuple[Tensor, object]:
        z, state = base.remember(e / 1e4, a, s, state)
        return torch.cat([z[..., :1], torch.zeros_like(z[..., :1])], -1), state

    policy = Policy(base.encode, remember, base.initial_state)
    odds, probs = (
        saliency(policy, frames(6), norm="l1", target=t, dtype=F64) for t in ("logits", "probs")
    )
    np.testing.assert_allclose(probs.shares(), odds.shares(), rtol=1e-9)
    p = 1 / (1 + np.exp(-float(odds.output[0])))
    np.testing.assert_allclose(
        probs.per_frame, 2 * p * (1 - p) * odds.per_frame, rtol=1e-5
    )  # both actions, alike
    with pytest.raises(
        ValueError, match="the sum of all probabilities is always 1: take reduce per_action"
    ):
        saliency(policy, frames(2), reduce="sum", target="probs")


@given(
    lengths=st.lists(st.integers(1, 14), min_size=1, max_size=4),
    end=st.sampled_from(["last", "random"]),
    cap=st.integers(3, 9),
    seed=st.integers(0, 5),
)
def test_law_09_no_window_holds_a_start_but_its_own_and_n_is_where_the_ending_action_was_chosen(
    lengths: list[int], end: str, cap: int, seed: int
) -> None:
    env, policy = ToyEnv(lengths), linear_policy(0.5, dtype=torch.float32)
    found = list(
        greedy_windows(policy, env, episodes=2 * len(lengths), seed=seed, end=end, cap=cap)
    )  # type: ignore[arg-type]
    assert len(found) == 2 * len(lengths)
    for w in found:
        steps = w.frames[:, 0, 0, 0].int()
        first, length = int(steps[0]), lengths[w.row]
        assert steps.tolist() == list(range(first, first + w.n + 1)) and w.n < cap
        assert w.is_init.tolist() == [first == 0] + [False] * w.n
        assert w.ended == (int(steps[-1]) == length - 1)
        assert w.ended or end == "random" or length > cap
        assert w.last_action[1:].tolist() == w.action[:-1].tolist()
        state, picks = policy.initial_state(1), []
        # The state before the window is the one that was reached by playing.
        for t in range(first + w.n + 1):
            if t == first:
                torch.testing.assert_close(
                    state, w.state, rtol=1e-4, atol=1e-2
                )  # values are in the hundreds
            env.seed = w.seed
            obs = {
                "pixels": env.frame(w.row, t)[None],
                "last_action": torch.zeros(1, dtype=torch.int64),
            }
            action, _, state = policy.act(obs | {"is_init": torch.tensor([[t == 0]])}, state)
            picks.append(int(action))
        assert picks[first:] == w.action.tolist()


@pytest.mark.parametrize("name", ["lru", "gru", "attention"])
@pytest.mark.parametrize("feedback", [False, True])
def test_law_10_no_noise_and_the_identity_permutation_reproduce_the_clean_outputs(
    name: str, feedback: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    shuffled = "arcade_torch.tools.measures.contamination.measure.shuffle_order"
    monkeypatch.setattr(shuffled, lambda total, *_: np.arange(total))
    player = Policy(
        *(
            getattr(Net(name, torch.float32), part)
            for part in ("encode", "remember", "initial_state")
        )
    )
    still = contamination(
        player, ToyEnv([14, 20]), sigmas=(0.0,), delays=(0, 1, 5), starts=12, feedback=feedback
    )
    same = contamination(
        player, ToyEnv([14, 20]), delays=(0, 1, 3), starts=6, shuffle=True, feedback=feedback
    )
    for found in (still, same):
        assert (
            np.nanmax(found.flip) == 0
            and np.nanmax(found.change) < 1e-5
            and found.clean_error < 1e-5
        )


@pytest.mark.parametrize("agent", TABLE)
def test_law_11_the_published_table_comes_out_to_three_decimals(agent: str) -> None:
    paper = paper_table()
    row = paper.table.row(agent)
    rest = next(row for row in paper.table.without["Tetris"] if row.agent == agent)
    values = [
        x.value for x in (row.mdp, row.pomdp, row.gap, row.bias, rest.pomdp, rest.gap, rest.bias)
    ]
    assert values == pytest.approx(TABLE[agent][:7], abs=6e-4)
    errors = [paper.mdp[agent].sem, paper.pomdp[agent].sem]
    errors += [paper.mdp[agent].half_width, paper.pomdp[agent].half_width]
    assert errors == pytest.approx(TABLE[agent][7:], abs=6e-5)
    mdp, pomdp, free = (
        paper.mdp[agent].half_width,
        paper.pomdp[agent].half_width,
        paper.mdp["MLP"].half_width,
    )
    halves = [x.high - x.value for x in (row.mdp, row.pomdp, row.gap, row.bias)]
    bias = 0.0 if agent == "MLP" else np.hypot(mdp, free)
    assert halves == pytest.approx([mdp, pomdp, np.hypot(mdp, pomdp), bias], abs=1e-9)
    tetris = [
        each
        for each in read_csv(PAPER_RETURNS)
        if (each["model"], each["env"]) == (agent, "Tetris")
    ]
    without = (30 * mdp / 1.96) ** 2 - sum((float(each["mdp_std"]) / 2) ** 2 / 5 for each in tetris)
    assert rest.mdp.high - rest.mdp.value == pytest.approx(1.96 * without**0.5 / 27, abs=1e-9)
    assert f"{row.gap.value:+.3f}" in str(paper.printed().rows)


def test_law_11_the_quoted_differences_come_out() -> None:
    table = paper_table().table
    gdn, mingru = table.row("GDN"), table.row("MinGRU")
    assert (round(gdn.pomdp.value, 3), round(mingru.pomdp.value, 3)) == (0.469, 0.471)
    assert round(gdn.bias.value - mingru.bias.value, 3) == -0.091
    assert round(mingru.gap.value - gdn.gap.value, 3) == 0.089


def test_law_12_identical_seeds_have_no_width_and_the_measured_coverage_stands_on_the_figure() -> (
    None
):
    _, mean, low, high = pooled(np.full((5, 2, 3), 0.25))
    assert (mean == 0.25).all() and (low == 0.25).all() and (high == 0.25).all()
    five, two = measured_coverage((5,), ()), measured_coverage((2,), ())
    assert five == pytest.approx(0.84, abs=0.03)  # a nominal 95 % interval
    assert f"measured coverage with 5 seeds {100 * five:.0f} %" in seeds_note([5, 5], 0.95)
    assert seeds_note([5, 2], 0.95).endswith(f"measured coverage with 2 seeds {100 * two:.0f} %")
    assert pooled([0.0, 0.0, 3.0]).mean == 1
    assert np.isnan(pooled(np.ones((1, 2))).low).all()
    assert "no interval" in seeds_note([1], 0.95)
    assert seeds_note([1, 3], 0.95).startswith("n = 1 to 3 seeds; bars: 95 % bootstrap interval")


def test_the_twelve_laws_are_all_here() -> None:
    text = Path(__file__).read_text(encoding="utf-8")
    assert all(f"def test_law_{number:02d}_" in text for number in range(1, 13))
