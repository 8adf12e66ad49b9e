"""Envs of TorchRL in the measures: other names, frames, batches and actions, and Gymnasium's."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.data import (
    Binary,
    Bounded,
    Categorical,
    Composite,
    MultiCategorical,
    MultiOneHot,
    OneHot,
    Unbounded,
)
from torchrl.envs import (
    EnvBase,
    GymEnv,
    InitTracker,
    RenameTransform,
    SerialEnv,
    TransformedEnv,
)
from torchrl.modules import GRUModule, LSTMModule, QValueModule
from torchrl.modules.utils import get_primers_from_module

import arcade_torch
from arcade_torch.agents import Agent, preset
from arcade_torch.agents.policy import build_network
from arcade_torch.tools import (
    as_policy,
    contamination,
    counterfactual,
    greedy_window,
    recall_density,
    saliency,
)
from arcade_torch.tools.measures.contamination.measure import contamination_example
from arcade_torch.tools.measures.frames import channel_axis, pictures, white_of
from arcade_torch.tools.measures.saliency.measure import episode_saliency
from arcade_torch.tools.measures.windows import play

LENGTH = 14
ACTIONS = 4
WIDTH = 8
KINDS = {
    "uint8, HWC": (torch.uint8, (5, 6, 3)),
    "floats, CHW": (torch.float32, (2, 5, 6)),
    "truth values": (torch.bool, (6, 6, 4)),
    "grey": (torch.float32, (5, 6)),
    "vector": (torch.float32, (7,)),
}


class Foreign(EnvBase):
    """Frames of noise under ("view", "image") and actions under "move", without start flags."""

    def __init__(
        self, kind: str = "uint8, HWC", batch: tuple[int, ...] = (), one_hot: bool = False
    ) -> None:
        super().__init__(batch_size=torch.Size(batch))
        self.kind, self.frame = KINDS[kind]
        self.generator = torch.Generator()
        image = Binary if self.kind == torch.bool else Unbounded
        spec = image(shape=(*batch, *self.frame), dtype=self.kind)
        view = Composite(image=spec, shape=batch)
        before = Unbounded(shape=(*batch, ACTIONS), dtype=torch.int64)
        fields = {"view": view, "before": before} if one_hot else {"view": view}
        self.observation_spec = Composite(fields, shape=batch)
        shape = (*batch, ACTIONS) if one_hot else batch
        action = OneHot(ACTIONS, shape) if one_hot else Categorical(ACTIONS, shape)
        self.action_spec = Composite(move=action, shape=batch)
        self.reward_spec = Unbounded(shape=(*batch, 1))
        self.one_hot = one_hot
        self.t = 0

    def _observe(self, before: Tensor | None = None) -> dict[str, Any]:
        shape = (*self.batch_size, *self.frame)
        image = torch.rand(shape, generator=self.generator)
        if self.kind == torch.uint8:
            image = 255 * image
        image = image > 0.5 if self.kind == torch.bool else image.to(self.kind)
        entries: dict[str, Any] = {"view": TensorDict({"image": image}, self.batch_size)}
        if self.one_hot:
            nothing = torch.zeros(*self.batch_size, ACTIONS, dtype=torch.int64)
            entries["before"] = nothing if before is None else before.long()
        return entries

    def _reset(self, tensordict: TensorDictBase | None = None, **_: Any) -> TensorDictBase:
        self.t = 0
        return TensorDict(self._observe(), self.batch_size)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.t += 1
        done = torch.full((*self.batch_size, 1), self.t >= LENGTH)
        entries = self._observe(tensordict["move"])
        entries |= {"reward": torch.ones(*self.batch_size, 1), "done": done, "terminated": done}
        return TensorDict(entries, self.batch_size)

    def _set_seed(self, seed: int | None) -> None:
        self.generator.manual_seed(seed or 0)


class Flat(nn.Module):
    """Frames of any shape and type, flat, and scaled where they are whole numbers of 0 to 255."""

    def __init__(self, shape: tuple[int, ...], scale: float) -> None:
        super().__init__()
        self.linear, self.axes, self.scale = (
            nn.Linear(int(np.prod(shape)), WIDTH),
            len(shape),
            scale,
        )

    def forward(self, frames: Tensor) -> Tensor:
        return torch.tanh(3 * self.linear((frames.float() / self.scale - 0.5).flatten(-self.axes)))


class Beside(nn.Module):
    """Features with the one-hot action before."""

    def forward(self, features: Tensor, before: Tensor) -> Tensor:
        return torch.cat([features, before.float()], -1)


def policy_of(kind: str = "uint8, HWC", one_hot: bool = False, memory: bool = True) -> Any:
    torch.manual_seed(0)
    dtype, shape = KINDS[kind]
    encode = Flat(shape, 255 if dtype == torch.uint8 else 1)
    parts = [TensorDictModule(encode, [("view", "image")], ["features"])]
    width = WIDTH + ACTIONS * one_hot
    if one_hot:
        parts.append(TensorDictModule(Beside(), ["features", "before"], ["features"]))
    if memory:
        parts.append(GRUModule(width, width, in_key="features", out_key="features"))
    head = nn.Linear(width, ACTIONS, bias=False)
    nn.init.normal_(head.weight)
    parts.append(TensorDictModule(head, ["features"], ["action_value"]))
    space = "one_hot" if one_hot else "categorical"
    names = ["move", "action_value", "chosen"]
    return TensorDictSequential(*parts, QValueModule(action_space=space, out_keys=names))


NAMES: dict[str, Any] = {
    "pixels_key": ("view", "image"),
    "action_key": "move",
    "last_action_key": "before",
}


# Every kind of frame with both kinds of action, every pair of frame, action and batch, once.
CASES = [
    pytest.param(
        kind, one_hot, batch, marks=[] if (i + one_hot + len(batch)) % 2 == 0 else pytest.mark.slow
    )
    for i, kind in enumerate(KINDS)
    for one_hot in (False, True)
    for batch in ((), (3,))
]


@pytest.mark.parametrize(("kind", "one_hot", "batch"), CASES)
def test_every_measure_takes_any_frames_actions_and_batches_with_the_same_names(
    kind: str, one_hot: bool, batch: tuple[int, ...]
) -> None:
    policy = policy_of(kind, one_hot)
    env = Foreign(kind, batch, one_hot)
    density = recall_density(policy, env, episodes=3, **NAMES)
    assert density.lengths.tolist() == [LENGTH] * 3 and density.ended.all()
    changes = contamination(policy, env, sigmas=(0.0, 1.0), delays=(0, 1, 3), starts=6, **NAMES)
    assert np.nanmax(changes.change[:, 0]) < 1e-5 and not np.nansum(changes.flip[:, 0])
    assert changes.mean("change")[1, 0] > 0.01 and changes.clean_error < 1e-5
    example = contamination_example(policy, env, horizon=5, **NAMES)
    assert example.frames.shape[-1] == 3 and example.values.shape[1] == ACTIONS
    feedback = contamination(policy, env, delays=(0, 2), starts=4, feedback=True, **NAMES)
    assert feedback.clean_error < 1e-5
    effects = counterfactual(policy, env, episodes=3, donors=2, **NAMES)
    assert effects.clean_error < 1e-5 and (effects.by_lag("change")[:, 0] > 0).all()
    window = greedy_window(policy, Foreign(kind, batch[:0], one_hot), **NAMES)
    gradients = saliency(
        policy, window.frames, window.last_action, window.is_init, window.state, **NAMES
    )
    assert window.n == LENGTH - 1 and (gradients.per_frame > 0).all()
    shape = KINDS[kind][1]
    pixels = {3: (5, 6) if kind != "truth values" else (6, 6)}.get(len(shape), shape)
    assert gradients.maps.shape == (LENGTH, *pixels)
    np.testing.assert_allclose(gradients.maps.reshape(LENGTH, -1).sum(1), gradients.per_frame, 1e-4)


@pytest.mark.parametrize("one_hot", [False, True])
@pytest.mark.parametrize("batch", [(), (2,)])
def test_replaying_a_window_gives_the_outputs_and_actions_of_torchrls_own_rollout(
    batch: tuple[int, ...], one_hot: bool
) -> None:
    policy = policy_of(one_hot=one_hot)
    env = Foreign(batch=batch, one_hot=one_hot)
    wrapped = as_policy(policy, **NAMES)
    windows, lengths = play(wrapped, env, seed=5, keep=LENGTH)
    primed = TransformedEnv(Foreign(batch=batch, one_hot=one_hot), InitTracker())
    primed.append_transform(get_primers_from_module(policy, warn=False))
    primed.set_seed(5)
    with torch.no_grad():
        rollout = primed.rollout(LENGTH, policy)
    assert lengths.tolist() == [LENGTH] * len(windows)
    for row, window in enumerate(windows):
        acted = rollout[row] if batch else rollout
        assert torch.equal(window.frames, acted["view", "image"])
        chosen = acted["move"].long()
        assert torch.equal(window.action, chosen.argmax(-1) if one_hot else chosen)
        if one_hot:
            assert torch.equal(window.last_action, acted["before"])
        outputs, _ = wrapped.unroll(
            wrapped.features(window.frames)[None],
            window.last_action[None],
            window.is_init[None],
            window.state,
        )
        torch.testing.assert_close(outputs[0].detach(), acted["action_value"], atol=1e-6, rtol=1e-5)


def test_without_memory_the_past_has_no_gradient_and_noise_on_it_changes_nothing() -> None:
    policy = policy_of(memory=False)
    density = recall_density(policy, Foreign(batch=(2,)), episodes=4, **NAMES)
    assert all(share[-1] == 1.0 and not share[:-1].any() for share in density.shares)
    changes = contamination(policy, Foreign(), delays=(0, 1, 2), starts=8, **NAMES)
    assert not np.nansum(changes.change[..., 1:]) and changes.mean("change")[-1, 0] > 0


def test_a_last_action_that_an_env_does_not_have_is_the_action_before() -> None:
    windows, _ = play(as_policy(policy_of(), **NAMES), Foreign(batch=(2,)), seed=1, keep=LENGTH)
    assert any(len(window.action.unique()) > 1 and window.action.any() for window in windows)
    for window in windows:
        assert torch.equal(window.last_action[1:], window.action[:-1])
        assert window.last_action[0] == 0
        assert window.is_init.tolist() == [True] + [False] * (LENGTH - 1)


def test_a_policy_plays_in_evaluation_mode_and_goes_back_to_training() -> None:
    policy = policy_of()
    torch.manual_seed(0)
    dropped = TensorDictModule(nn.Dropout(0.9), ["features"], ["features"])
    policy = TensorDictSequential(policy[0], dropped, *[policy[i] for i in range(1, len(policy))])
    wrapped = as_policy(policy.train(), **NAMES)
    (window,), _ = play(wrapped, Foreign(), seed=3, keep=LENGTH)
    with wrapped.evaluating():
        features = wrapped.features(window.frames)
    outputs, _ = wrapped.unroll(features[None], None, window.is_init[None], window.state)
    assert torch.equal(outputs[0].argmax(-1), window.action)
    assert dropped.training and policy.training


def test_gymnasiums_cartpole_alone_and_in_a_serial_env() -> None:
    torch.manual_seed(0)
    policy = TensorDictSequential(
        TensorDictModule(nn.Linear(4, WIDTH), ["observation"], ["features"]),
        LSTMModule(WIDTH, WIDTH, in_key="features", out_key="remembered"),
        TensorDictModule(nn.Linear(WIDTH, 2), ["remembered"], ["logits"]),
    )

    def env() -> Any:
        return GymEnv("CartPole-v1", categorical_action_encoding=True)

    one = recall_density(policy, env(), episodes=3)
    two = recall_density(policy, SerialEnv(2, env), episodes=3)
    assert one.target == two.target == "probs"
    assert (one.lengths > 5).all() and (two.lengths > 5).all()
    window = greedy_window(policy, env(), seed=3)
    assert window.frames.shape == (window.n + 1, 4)
    again = greedy_window(policy, env(), seed=3)
    assert torch.equal(window.frames, again.frames)


def test_an_agent_of_ours_plays_an_env_with_other_names_as_its_own() -> None:
    def env() -> Any:
        return arcade_torch.make("MineSweeperEasy", num_envs=1, observability="partial", seed=7)

    config = preset("smoke", env="MineSweeperEasy", observability="partial", memory="gru")
    agent = Agent(config, build_network(config).eval())
    keys = ["pixels", "is_init"], ["image", "begins"]
    renamed = TransformedEnv(env(), RenameTransform(*keys))
    names: dict[str, Any] = {"pixels_key": "image", "is_init_key": "begins"}
    usual = episode_saliency(agent, env(), max_steps=6)
    other = episode_saliency(agent, renamed, max_steps=6, **names)
    np.testing.assert_array_equal(usual.frames, other.frames)
    np.testing.assert_array_equal(usual.maps, other.maps)


class ByType(nn.Module):
    """Scales frames where they are bytes, and takes floats as they are."""

    def forward(self, frames: Tensor) -> Tensor:
        scaled = frames.float() / 255 if frames.dtype == torch.uint8 else frames
        return scaled.flatten(1).mean(1, keepdim=True) * torch.arange(1.0, 1 + ACTIONS)


def test_rewards_and_ends_have_the_names_that_the_env_says() -> None:
    """Before: ``'NoneType' object is not subscriptable``."""
    names = {"reward": "gain", "done": "over", "terminated": "lost"}
    renamed = TransformedEnv(Foreign(), RenameTransform(list(names), list(names.values())))
    window = greedy_window(policy_of(), renamed, seed=3, **NAMES)
    expected = greedy_window(policy_of(), Foreign(), seed=3, **NAMES)
    assert torch.equal(window.reward, expected.reward) and len(window.reward) == LENGTH
    assert torch.equal(window.frames, expected.frames)


def test_what_an_env_has_several_of_is_refused_in_one_line() -> None:
    """Before: tracebacks out of TensorDicts."""
    two = Foreign()
    two.reward_spec = Unbounded(shape=(2,))
    two._step = lambda td: Foreign._step(two, td).set("reward", torch.ones(2))  # type: ignore
    with pytest.raises(ValueError, match=r"^the entry \('next', 'reward'\) of env must be one num"):
        greedy_window(policy_of(), two, **NAMES)
    both = Foreign()
    both.reward_spec = Composite(mine=Unbounded(shape=(1,)), yours=Unbounded(shape=(1,)))
    with pytest.raises(ValueError, match=r"^the rewards of env must be one.*'mine', 'yours'"):
        greedy_window(policy_of(), both, **NAMES)
    names = NAMES | {"action_key": "action"}
    with pytest.raises(ValueError, match=r"^the action of env must be under 'action', .*'move'"):
        greedy_window(policy_of(), Foreign(), **names)


def test_what_would_be_measured_wrong_is_refused_in_one_line() -> None:
    bytes_alone = TensorDictModule(ByType(), [("view", "image")], ["action_value"])
    for measure in (recall_density, contamination):
        with pytest.raises(ValueError, match=r"^the policy must read floats of 0 to 255 as it"):
            measure(bytes_alone, Foreign(), **NAMES)
    with pytest.raises(
        ValueError, match=r"^the env must have the frames under \('view', 'image'\), g"
    ):
        greedy_window(policy_of(), GymEnv("CartPole-v1"), pixels_key=("view", "image"))
    more = TensorDictModule(nn.Linear(4, 2 * ACTIONS), ["observation"], ["action_value"])
    for cartpole in (
        GymEnv("CartPole-v1"),
        GymEnv("CartPole-v1", categorical_action_encoding=True),
    ):
        more.module.bias.data = 100 * torch.arange(2.0 * ACTIONS)  # the last is always best
        with pytest.raises(ValueError, match=r"^actions must be below 2, the number of the env's"):
            greedy_window(more, cartpole)
    continuous = TensorDictModule(Flat((7,), 1), [("view", "image")], ["move"])
    with pytest.raises(ValueError, match=r"^the policy must write action_value, logits or probs"):
        greedy_window(continuous, Foreign("vector"), **NAMES)
    with pytest.raises(ValueError, match=r"^the batch size of env must be \[\] or \[N\]; got"):
        recall_density(policy_of(), Foreign(batch=(2, 1)), **NAMES)


@pytest.mark.parametrize(
    ("shape", "channels", "axis"),
    [
        ((84, 84, 3), None, -1),
        ((4, 84, 84), None, 0),
        ((10, 10, 6), None, -1),
        ((3, 3, 3), None, -1),
        ((84, 84, 3), "first", 0),
        ((84, 84), None, None),
        ((7,), None, None),
    ],
)
def test_the_channels_are_the_shorter_end(shape: Any, channels: Any, axis: int | None) -> None:
    assert channel_axis(shape, channels) == axis


def test_white_and_pictures_of_frames() -> None:
    bytes_ = torch.randint(256, (2, 5, 6, 3), dtype=torch.uint8)
    floats = (bytes_ / 255).movedim(-1, 1)
    assert white_of(bytes_) == 255 and white_of(floats) == 1 and white_of(floats, 2.0) == 2
    np.testing.assert_array_equal(pictures(bytes_), bytes_.numpy())
    np.testing.assert_array_equal(pictures(floats), bytes_.numpy())
    np.testing.assert_array_equal(pictures(bytes_.float(), white=255.0), bytes_.numpy())
    grey = pictures(floats[:, :1])
    assert grey.shape == (2, 5, 6, 3) and (grey[..., 0] == grey[..., 2]).all()
    planes = torch.zeros(1, 6, 6, 4, dtype=torch.bool)
    planes[0, 2, 3, 1] = True
    coloured = pictures(planes)
    assert coloured.shape == (1, 6, 6, 3) and coloured[0, 2, 3].any() and not coloured[0, 0].any()
    assert pictures(torch.rand(3, 7)).shape == (3, 1, 7, 3)
    with pytest.raises(ValueError, match=r"^float frames must be shares of white, got 255"):
        white_of(torch.full((1, 2, 2, 3), 255.0))


class Choices(Foreign):
    """Reads other actions."""

    def __init__(self, spec: Any, batch: tuple[int, ...] = ()) -> None:
        super().__init__("vector", batch)
        self.action_spec = Composite(move=spec, shape=batch)


@pytest.mark.parametrize(
    ("spec", "batch"),
    [
        (Bounded(-1.0, 1.0, (1,)), ()),
        (Bounded(-1.0, 1.0, (2,)), (2,)),
        (MultiCategorical([4, 4]), ()),
        (MultiOneHot([2, 2]), ()),
        (Bounded(0, 3, (2, 2), dtype=torch.int64), (2,)),
    ],
    ids=["continuous", "one for two envs", "two choices", "two one-hot", "two whole numbers"],
)
def test_actions_that_are_not_one_choice_are_refused_in_one_line(
    spec: Any, batch: tuple[int, ...]
) -> None:
    """Before: two one-hot choices got a single one, and a continuous action was 0 or 1."""
    if batch and spec.shape[0] != batch[0]:
        spec = spec.expand(*batch, *spec.shape)
    for measure in (counterfactual, contamination):
        with pytest.raises(ValueError, match=r"^the action 'move' of env must be one choice") as it:
            measure(policy_of("vector"), Choices(spec, batch), **NAMES)
        assert "\n" not in str(it.value)


def test_one_choice_of_any_form_is_played() -> None:
    for spec, batch in (
        (Categorical(ACTIONS), ()),
        (Categorical(ACTIONS, (1,)), ()),
        (Categorical(ACTIONS, (3, 1)), (3,)),
        (OneHot(ACTIONS), ()),
        (OneHot(ACTIONS, (3, ACTIONS), dtype=torch.float32), (3,)),
        (Bounded(0, ACTIONS - 1, (3,), dtype=torch.int64), (3,)),
        (Bounded(0, ACTIONS - 1, (1,), dtype=torch.int32), ()),
    ):
        window = play(as_policy(policy_of("vector"), **NAMES), Choices(spec, batch), seed=0, keep=4)
        assert window[0][0].action.shape == (4,), (spec, batch)


def test_one_output_is_no_choice() -> None:
    """Before: an index out of range, out of torch."""
    one = TensorDictModule(nn.Linear(7, 1), [("view", "image")], ["action_value"])
    for measure in (counterfactual, contamination):
        with pytest.raises(
            ValueError, match=r"^the policy's outputs must be of two actions at least"
        ):
            measure(one, Foreign("vector"), pixels_key=("view", "image"), action_key="move")


class Corridor:
    """Walk right for four cells; the observation is the cell."""

    def reset(self, key: Any) -> tuple[Any, Any]:
        """Begin."""
        return jnp.zeros(4, jnp.float32).at[0].set(1), jnp.int32(0)

    def step(self, key: Any, state: Any, action: Any) -> tuple[Any, ...]:
        """Go on."""
        state = state + action
        there = state >= 3
        seen = jnp.zeros(4, jnp.float32).at[state].set(1)
        return seen, state, there.astype(jnp.float32), there, {}


@pytest.mark.parametrize("size", [1, 3])
def test_an_env_of_jax_is_played_to_its_ends(size: int) -> None:
    from arcade_torch import from_jax

    def walk(seen: Tensor) -> Tensor:
        return torch.stack([0.1 + 0 * seen[..., 0], 1 + seen[..., 1]], -1)

    policy = TensorDictModule(walk, ["observation"], ["action_value"])
    env = from_jax(
        Corridor(), num_envs=size, max_steps=10, action_spec=Categorical(2, shape=(size,)), seed=0
    )
    exchanges = counterfactual(policy, env, episodes=4, donors=2)
    assert exchanges.lengths.tolist() == [3] * 4 and not exchanges.flip[..., 0].any()
    assert recall_density(policy, env, episodes=2).deltas.tolist() == [0, 0, 1] * 2
