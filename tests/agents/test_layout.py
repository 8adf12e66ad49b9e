"""Final observations are read where they belong: exactly, for any pattern of ends."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torch import nn

from arcade_torch.agents.batch_checks import NetworkInputs
from arcade_torch.agents.layout import as_steps, insert_final_observations, unroll
from arcade_torch.models import MemoryModule
from tests.agents.fakes import stream

MODULUS = 2**31 - 1


class RunningHash(nn.Module):
    """A memory whose state is a hash of all that it read since the start: equal or not, nothing
    between.
    """

    def forward(self, x, state, is_init):
        h, out = state["h"], []
        for t in range(x.shape[1]):
            h = torch.where(is_init[:, t, None], 0, h)
            h = (h * 48271 + x[:, t] + 1) % MODULUS
            out.append(h)
        return torch.stack(out, 1), TensorDict({"h": h}, [len(h)])

    def initial_state(self, batch_size):
        shape = (batch_size,) if isinstance(batch_size, int) else tuple(batch_size)
        return TensorDict({"h": torch.zeros(*shape, 1, dtype=torch.int64)}, shape)


def hash_network(store="sequence"):
    return MemoryModule(RunningHash(), "pixels", "out", store=store)


def experience(seed, rows, steps, ends, seams):
    """A stream whose frames are one number each, unknown states included."""
    s = stream(rows, steps, seed, ends, seams)
    s.pixels, s.final = (x.flatten(2).long().sum(-1, keepdim=True) for x in (s.pixels, s.final))
    s.state = TensorDict(
        {"memory": {"h": s.state["memory", "h"][:, :1].mul(1000).long().abs()}}, [rows]
    )
    return s


def by_hand(s):
    """Hash of every observation and of every true next one, step by step, with the state that led
    to each.
    """
    here, after = (
        torch.zeros_like(s.reward, dtype=torch.int64),
        torch.zeros_like(s.reward, dtype=torch.int64),
    )
    for row in range(len(here)):
        h = int(s.state["memory", "h"][row, 0])
        for t in range(here.shape[1]):
            h = 0 if s.is_init[row, t] else h
            h = (h * 48271 + int(s.pixels[row, t, 0]) + 1) % MODULUS
            here[row, t] = h
            after[row, t] = (h * 48271 + int(s.final[row, t, 0]) + 1) % MODULUS
    return here, after


def form_of(s, form):
    if form != "sequences":
        batch = s.stock() if form == "stock" else s.sequences("all")
        return batch
    batch = s.sequences("none")
    final = s.cut.clone()
    final[:, -1] = ~s.terminated[:, -1]
    places = int(final.sum(1).max()) + 1
    index, mask = (
        torch.full((len(final), places), final.shape[1] - 1),
        torch.zeros(len(final), places, dtype=torch.bool),
    )
    frames = torch.full((len(final), places, 1), -1)
    for row in range(len(final)):
        at = final[row].nonzero().flatten()
        index[row, : len(at)], mask[row, : len(at)], frames[row, : len(at)] = (
            at,
            True,
            s.final[row, at],
        )
    return batch.update({"final_pixels": frames, "final_index": index, "final_mask": mask})


@pytest.mark.parametrize(
    ("form", "store"),
    [
        ("sequences", "sequence"),
        ("sequences", "step"),
        ("all", "sequence"),
        ("all", "step"),
        ("stock", "sequence"),
    ],
)
@given(
    seed=st.integers(0, 10**6),
    rows=st.integers(1, 4),
    steps=st.integers(1, 12),
    ends=st.floats(0, 1),
    seams=st.sampled_from([0.0, 0.5]),
    burn_in=st.integers(0, 5),
    terminal=st.booleans(),
)
def test_every_next_observation_is_read_by_the_state_that_led_to_it(
    form, store, seed, rows, steps, ends, seams, burn_in, terminal
):
    s, burn_in = experience(seed, rows, steps, ends, seams), min(burn_in, steps - 1)
    if store == "step":
        s.state["memory", "h"][s.is_init[:, 0]] = 0  # as a reset leaves it
    network = hash_network(store)
    inputs = NetworkInputs(network)
    time_limit = "terminal" if terminal else "bootstrap"
    data = insert_final_observations(form_of(s, form), inputs, time_limit, burn_in)
    out = unroll(network, inputs, data, "out").squeeze(-1)
    position = data["position"]
    here, after = (x[:, burn_in:] for x in by_hand(s))
    assert torch.equal(out.gather(1, position), here)
    ended = s.terminated | s.truncated if terminal else s.terminated
    following = out.gather(1, (position + 1).clamp_max(out.shape[1] - 1))
    kept = ~ended[:, burn_in:]
    assert torch.equal(following[kept], after[kept])
    assert torch.equal(data["terminated"], ended[:, burn_in:])
    seam = torch.cat((s.is_init[:, 1:], torch.ones(rows, 1, dtype=torch.bool)), 1)
    assert torch.equal(data["cut"], (s.terminated | s.truncated | seam)[:, burn_in:])
    assert all(torch.equal(data[key], getattr(s, key)[:, burn_in:]) for key in ("reward", "action"))


@given(seed=st.integers(0, 10**6), steps=st.integers(2, 9), ends=st.floats(0, 1))
def test_rows_of_the_layout_are_the_layout_of_the_rows(seed, steps, ends):
    s, network = experience(seed, 4, steps, ends, 0.0), hash_network()
    inputs = NetworkInputs(network)
    data = insert_final_observations(form_of(s, "sequences"), inputs)
    rows = torch.tensor([2, 0, 2])
    assert (data[rows] == insert_final_observations(form_of(s, "sequences")[rows], inputs)).all()


@pytest.mark.parametrize("form", ["stock", "all"])
@pytest.mark.parametrize("burn_in", [0, 2, 5, 6])
def test_a_memory_that_stores_every_step_starts_from_the_states_it_was_given(burn_in, form):
    """``store="step"``: a sampler may have cut an episode, then the state stored at the cut counts,
    not zeros.
    """
    s, network = experience(1, 3, 8, 0.0, 0.0), hash_network("step")
    s.is_init[1, 5] = s.is_init[2, 0] = True
    batch, states = form_of(s, form), torch.randint(1000, (3, 8, 1))
    if form == "stock":
        batch["memory", "h"] = states
    else:
        states[:, 1:] = 0  # sequences have none of later steps
        batch["initial_state", "memory", "h"] = states[:, 0]
    h, wanted = states[:, 0], []
    for t in range(8):
        h = torch.where(s.is_init[:, t, None], states[:, t], h)
        h = (h * 48271 + s.pixels[:, t] + 1) % MODULUS
        wanted.append(h)
    inputs = NetworkInputs(network)
    data = insert_final_observations(batch, inputs, burn_in=burn_in)
    out = unroll(network, inputs, data, "out").gather(1, data["position"].unsqueeze(-1))
    assert torch.equal(out, torch.stack(wanted, 1)[:, burn_in:])


def test_only_memories_that_all_store_one_state_a_sequence_read_the_first_alone():
    for stores in (["sequence"] * 2, ["sequence", "step"], ["step", "sequence"], ["step"] * 2):
        pair = [
            MemoryModule(RunningHash(), "pixels", f"out{i}", f"m{i}", store=s)
            for i, s in enumerate(stores)
        ]
        assert NetworkInputs(TensorDictSequential(*pair)).reads_first_state_only == (
            "step" not in stores
        )


def test_sequences_become_steps_that_begin_with_their_state():
    s = experience(2, 3, 6, 0.3, 0.0)
    steps = as_steps(form_of(s, "sequences"), NetworkInputs(hash_network()), "action")
    assert steps.batch_size == (3, 6) and set(steps.keys()) == {
        "pixels",
        "is_init",
        "memory",
        "action",
    }
    assert torch.equal(steps["memory", "h"][:, 0], s.state["memory", "h"])
    stock = s.stock()
    assert as_steps(stock, NetworkInputs(hash_network())) is stock
