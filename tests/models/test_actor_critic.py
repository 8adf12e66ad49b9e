"""Actor and critic, the feed-forward network, heads: published sizes, one tower or two, what an
output means.
"""

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from arcade_torch.models import make_network
from arcade_torch.models.actor_critic import ActorCriticNetwork, make_actor_critic
from arcade_torch.models.presets import make_head
from arcade_torch.models.stateless import FeedForward
from tests.models.pixels import count, inputs, run


def test_the_feed_forward_network_has_the_published_size_and_no_last_action():
    network = make_network("paper", "feedforward")
    assert count(network) == 704_901
    assert [type(m) for m in network.block.layers] == [nn.Linear, nn.LayerNorm, nn.LeakyReLU] * 2
    assert isinstance(network.head, nn.Linear)
    pixels, last_action, is_init = inputs(1, 2, 128)
    state = network.initial_state(1)
    with torch.no_grad():
        one, after = run(network, pixels, last_action, is_init, state)
        other, _ = run(network, pixels, (last_action + 1) % 5, ~is_init, state)
    assert torch.equal(one, other) and after.is_empty() and state.is_empty()


def test_the_feed_forward_network_looks_at_each_frame_alone():
    network = make_network("small", "feedforward")
    pixels, last_action, is_init = inputs(2, 4)
    out, _ = run(network, pixels, last_action, is_init, network.initial_state(2))
    alone = [
        run(
            network,
            pixels[:, t : t + 1],
            last_action[:, :1],
            is_init[:, :1],
            network.initial_state(2),
        )[0]
        for t in (3, 1)
    ]
    torch.testing.assert_close(torch.cat(alone, 1), out[:, [3, 1]])
    assert FeedForward(7, 3).initial_state([2, 4]).batch_size == (2, 4)


def test_the_papers_towers_have_the_published_layers():
    network = make_actor_critic("paper", "mlp")
    middle = [nn.Linear, nn.Linear, nn.LayerNorm, nn.LeakyReLU, nn.Linear]
    assert [type(m) for m in network.actor.head] == [type(m) for m in network.critic.head] == middle
    head = (512 * 256 + 256) + (256 * 256 + 256) + 2 * 256
    body = 505_472 + (517 * 512 + 512) + 2 * (262_656 + 512 * 512 + 512)
    assert count(network.actor) == body + head + 256 * 5 + 5
    assert count(network.critic) == body + head + 256 + 1
    published = make_actor_critic("paper", "mlp", use_last_action=False)
    assert count(published.actor) == count(network.actor) - 5 * 512
    assert count(make_actor_critic("paper", "feedforward")) == 2 * 704_901 - 4 * 257


def test_two_towers_share_no_weight_and_begin_differently():
    network = make_actor_critic("small", "gru", towers=2)
    mine, theirs = network.actor.state_dict(), network.critic.state_dict()
    names = [name for name in mine if mine[name].shape == theirs[name].shape and "weight" in name]
    assert names and all(not torch.equal(mine[name], theirs[name]) for name in names)


@pytest.mark.parametrize("memory", ["gru", "lru", "mlp", "feedforward"])
def test_each_tower_alone_gives_its_half_of_the_output(memory):
    network = make_actor_critic("small", memory, towers=2)
    pixels, last_action, is_init = inputs(3, 6)
    state = network.initial_state(3)
    with torch.no_grad():
        out, after = run(network, pixels, last_action, is_init, state)
        heads = network.by_head(out)
        alone, mine = run(network.actor, pixels, last_action, is_init, state["actor"])
        single, theirs = run(network.critic, pixels, last_action, is_init, state["critic"])
    torch.testing.assert_close(heads["logits"], alone)
    torch.testing.assert_close(heads["state_value"], single)
    for name, expected in (("actor", mine), ("critic", theirs)):
        for key in expected.keys(True, True):
            torch.testing.assert_close(after[name][key], expected[key])


@pytest.mark.parametrize("memory", ["gru", "mlp"])
def test_one_tower_gives_both_and_each_half_alone(memory):
    network = make_actor_critic("small", memory)
    pixels, last_action, is_init = inputs(3, 6)
    state = network.initial_state(3)
    assert count(network) == count(make_network("small", memory, num_outputs=6))
    with torch.no_grad():
        out, _ = run(network, pixels, last_action, is_init, state)
        flags = is_init[:, :1].clone()
        step = TensorDict(
            {"pixels": pixels[:, 0], "last_action": last_action[:, 0], "is_init": flags}, [3]
        )
        whole = network(step.copy())
        acted = network.actor(step.copy())
        valued = network.critic(step.copy())
    assert "state_value" not in acted and "logits" not in valued
    for logits in (whole["logits"], acted["logits"]):
        torch.testing.assert_close(logits, out[:, 0, :5])
    for value in (whole["state_value"], valued["state_value"]):
        torch.testing.assert_close(value, out[:, 0, 5:])
    for half in (network.actor, network.critic, network.estimator):
        assert [id(p) for p in half.parameters()] == [id(p) for p in network.parameters()]
    states = [key for key in network.actor.out_keys if key != "logits"]
    assert states == [("next", *key) for key in network.actor.state_keys]
    assert network.critic.out_keys == ["state_value", *states]


def test_one_network_alone_needs_both_heads():
    with pytest.raises(ValueError, match=r"heads logits and state_value .* got action_value"):
        ActorCriticNetwork(make_network("small", "mlp"))


@pytest.mark.parametrize("nested", [False, True])
@pytest.mark.parametrize(
    ("towers", "old_names"),
    [
        (1, {"towers.both.": "actor.module.0."}),
        (2, {"towers.actor.": "actor.", "towers.critic.": "critic."}),
    ],
)
def test_weights_of_the_first_design_still_load(towers, old_names, nested):
    one = make_actor_critic("small", "gru", towers=towers)
    other = make_actor_critic("small", "gru", towers=towers)
    weights = {}
    for name, value in one.state_dict().items():
        for new, old in old_names.items():
            name = name.replace(new, old)
        assert "towers" not in name
        weights[f"0.{name}" if nested else name] = value
    target = nn.Sequential(other) if nested else other
    target.load_state_dict(weights)
    for mine, theirs in zip(one.parameters(), other.parameters(), strict=True):
        assert torch.equal(mine, theirs)


def test_an_output_is_read_by_name():
    network = make_actor_critic("small", "mlp")
    out = torch.randn(2, 3, 6)
    assert network.select(out, "logits").shape == (2, 3, 5) and network.select(
        out, "value"
    ).shape == (2, 3, 1)
    torch.testing.assert_close(network.select(out, "probs").sum(-1), torch.ones(2, 3))
    with pytest.raises(ValueError, match="offers logits, probs, value, not 'q'"):
        network.select(out, "q")


def test_its_head_goes_by_both_names():
    one, other = (
        make_actor_critic("paper", "gru", head="linear"),
        make_actor_critic(actor_critic_head="linear"),
    )
    assert type(one.actor.head) is type(other.actor.head) is nn.Linear


def test_calibration_reaches_both_towers():
    network = make_actor_critic("small", "mlp", towers=2)
    network.calibrate(inputs(4, 3, 128)[0])
    assert (
        torch.equal(network.actor.encoder.mean, network.critic.encoder.mean)
        and network.actor.encoder.mean.any()
    )


def test_wrong_names_get_one_clear_line():
    with pytest.raises(ValueError, match="mean 'small'"):
        make_actor_critic("smal")
    with pytest.raises(TypeError, match=r"width.*allowed are encoder"):
        make_actor_critic("small", "gru", width=3)
    with pytest.raises(ValueError, match=r"towers must be one of 1, 2, got 3"):
        make_actor_critic("small", "gru", towers=3)
    with pytest.raises(ValueError, match="actor_critic"):
        make_head("none", 4, 5)
