"""CartPole and NoisyCartPole, checked against the classic equations and the pictures' geometry."""

import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from arcade_torch.envs_jax import make
from arcade_torch.envs_jax.cartpole import rules
from arcade_torch.envs_jax.cartpole.oracle import Belief, _arrow_edges, _update
from arcade_torch.envs_jax.cartpole.renderer import Geometry, arrow_level, arrow_pictures, pole_span
from arcade_torch.envs_jax.cartpole.rules import THETA_LIMIT
from arcade_torch.envs_jax.render.palette import CHARCOAL, COPPER, PINK

from .conftest import Walk, draw, one, random_actions


def classic(pose, action):
    """One Euler step in float64, written from the textbook equations."""
    x, x_dot, theta, theta_dot = (float(v) for v in pose)
    force = {2: -10.0, 3: 10.0}.get(int(action), 0.0)
    temp = (force + 0.05 * theta_dot**2 * math.sin(theta)) / 1.1
    theta_acc = (9.8 * math.sin(theta) - math.cos(theta) * temp) / (
        0.5 * (4 / 3 - 0.1 * math.cos(theta) ** 2 / 1.1)
    )
    x_acc = temp - 0.05 * theta_acc * math.cos(theta) / 1.1
    return np.array(
        [
            x + 0.02 * x_dot,
            x_dot + 0.02 * x_acc,
            theta + 0.02 * theta_dot,
            theta_dot + 0.02 * theta_acc,
        ]
    )


def poses(walk):
    return np.stack(
        [walk.states.x, walk.states.x_dot, walk.states.theta, walk.states.theta_dot], -1
    )


def test_the_trajectory_equals_the_classic_equations():
    actions = random_actions(30, 8)
    pose = poses(Walk(make("CartPoleEasy"), actions))
    for env in range(8):
        expected = pose[0, env].astype(np.float64)
        for t in range(30):
            expected = classic(expected, actions[t, env])
            np.testing.assert_allclose(pose[t + 1, env], expected, atol=1e-5)


def test_pushing_one_way_ends_after_about_ten_paid_steps():
    walk = Walk(make("CartPoleEasy"), np.full((15, 64), 3))
    ends = walk.outcomes.terminated.argmax(0) + 1
    assert ends.min() >= 8 and ends.max() <= 11
    assert not walk.outcomes.truncated.any()


@pytest.mark.parametrize("rules", ["default", "reference"])
def test_the_return_is_the_share_of_steps_survived(rules):
    """The step that crosses a limit is paid; the reference ends one unpaid step later with the same
    return.
    """
    walk = Walk(make("CartPoleEasy", rules=rules), np.full((15, 32), 2))
    crossed = (np.abs(walk.states.theta[1:]) > 0.20944).argmax(0) + 1
    end = walk.outcomes.done.argmax(0) + 1
    late = rules == "reference"
    assert np.array_equal(end, crossed + late)
    paid = np.array([walk.outcomes.reward[:n, env].sum() for env, n in enumerate(end)])
    np.testing.assert_allclose(paid, crossed / 200, atol=1e-6)
    assert np.array_equal(walk.states.score[end, np.arange(32)], crossed)


@pytest.mark.parametrize(
    ("id", "limit"),
    [
        ("CartPoleEasy", 200),
        ("CartPoleMedium", 400),
        ("CartPoleHard", 600),
        ("NoisyCartPoleHard", 200),
    ],
)
def test_the_time_limit_truncates_but_does_not_terminate(id, limit):
    game = make(id)
    state = one(game, time=limit - 1, theta=0.0, theta_dot=0.0)
    new, reward, terminated, truncated = game.step(jax.random.PRNGKey(1), state, jnp.int32(0))
    assert (int(new.time), bool(terminated), bool(truncated)) == (limit, False, True)
    assert float(reward) == pytest.approx(1 / limit)
    earlier = game.step(jax.random.PRNGKey(1), one(game, time=limit - 2), jnp.int32(0))
    assert not bool(earlier[3])


def test_the_reference_truncates_one_unpaid_step_late():
    game = make("CartPoleEasy", rules="reference")
    _, reward, _, truncated = game.step(jax.random.PRNGKey(1), one(game, time=199), jnp.int32(0))
    assert not bool(truncated) and float(reward) == pytest.approx(1 / 200)
    _, reward, _, truncated = game.step(jax.random.PRNGKey(1), one(game, time=200), jnp.int32(0))
    assert bool(truncated) and float(reward) == 0


def test_both_flags_may_be_true_at_once():
    game = make("CartPoleEasy")
    _, _, terminated, truncated = game.step(
        jax.random.PRNGKey(1), one(game, time=199, theta=0.209, theta_dot=3.0), jnp.int32(0)
    )
    assert bool(terminated) and bool(truncated)


def test_noise_changes_pictures_but_not_the_dynamics():
    actions = random_actions(20, 16)
    quiet, noisy = Walk(make("CartPoleEasy"), actions), Walk(make("NoisyCartPoleHard"), actions)
    quiet_start, noisy_start = poses(quiet)[0], poses(noisy)[0]
    assert np.array_equal(quiet_start, noisy_start)
    np.testing.assert_array_equal(poses(quiet), poses(noisy))
    assert (quiet.states.noise == 0).all() and (noisy.states.noise != 0).all()


@pytest.mark.parametrize(
    ("id", "sigma"),
    [("NoisyCartPoleEasy", 0.1), ("NoisyCartPoleMedium", 0.2), ("NoisyCartPoleHard", 0.3)],
)
def test_the_noise_has_the_level_s_standard_deviation(id, sigma):
    noise = Walk(make(id), random_actions(50, 64)).states.noise
    assert noise.shape == (51, 64, 4)
    np.testing.assert_allclose(noise.std((0, 1)), sigma, rtol=0.05)
    assert abs(noise.mean()) < 0.02 * sigma / 0.1
    flat = noise.reshape(-1, 4)
    assert np.abs(np.corrcoef(flat.T) - np.eye(4)).max() < 0.06


def test_the_same_noise_is_drawn_in_both_twins():
    game = make("NoisyCartPoleHard")
    state = one(game, time=5)
    full, partial = draw(game, state, False), draw(game, state, True)
    geo = Geometry(128)
    arrows = slice(geo.offset + geo.boxes[0][1], geo.offset + geo.boxes[0][1] + geo.box)
    assert np.array_equal(full[arrows], partial[arrows])


def has(frame, colour):
    return bool((np.asarray(frame) == np.array(colour)).all(-1).any())


@pytest.mark.parametrize("size", [128, 256])
def test_the_pomdp_shows_cart_and_pole_in_the_first_frame_only(size):
    game = make("CartPoleEasy", obs_size=size)
    first, later = one(game), one(game, time=1, score=1)
    assert np.array_equal(draw(game, first, True), draw(game, first, False))
    for colour in (PINK, COPPER):
        assert has(draw(game, later, False), colour) and not has(draw(game, later, True), colour)


@pytest.mark.parametrize("size", [128, 256])
def test_the_cart_stands_where_the_geometry_says(size):
    game, scale = make("CartPoleEasy", obs_size=size), size // 128
    bottom = 16 * scale + 64 * scale - 1
    for x in (-2.4, -1.0, 0.0, 0.77, 2.4):
        row = draw(game, one(game, x=x, theta=0.0), False)[bottom]
        columns = np.flatnonzero((row == np.array(PINK)).all(-1))
        left = 16 * scale + int(x * 32 * scale / 2.4 + 32 * scale + 1e-4)
        assert (columns[0], columns[-1]) == (left, left + 32 * scale - 1)


@pytest.mark.parametrize("size", [128, 256])
@pytest.mark.parametrize("theta", [-0.2, -0.05, 0.0, 0.1, 0.209])
def test_the_pole_is_exactly_the_pixels_near_its_segment(size, theta):
    """Row intervals against the plain definition: distance to a segment at most the radius."""
    geo = Geometry(size)
    rows, columns, pivot = np.arange(*geo.strip), np.arange(geo.field), 30.0
    low, high = (
        np.asarray(v)
        for v in pole_span(geo, jnp.float32(pivot), jnp.float32(theta), jnp.asarray(rows))
    )
    drawn = (columns >= low[:, None]) & (columns <= high[:, None])
    dx, dy = math.sin(theta), -math.cos(theta)
    px, py = columns[None] - pivot, rows[:, None] - geo.pivot_y
    along = np.clip(px * dx + py * dy, 0, geo.pole_length)
    distance = np.hypot(px - along * dx, py - along * dy)
    disagree = drawn != (distance <= geo.pole_radius)
    assert np.abs(distance[disagree] - geo.pole_radius).max(initial=0) < 1e-3
    assert drawn.sum() > geo.pole_length * geo.pole_radius


@pytest.mark.parametrize(("size", "radius", "head"), [(128, 3, 6), (256, 5, 8)])
def test_cart_pole_and_arrows_stand_where_the_published_ones_do(size, radius, head):
    """The upright pole over the middle of the cart; each arrow in its box, as thick and with as
    long a head as its speed says (classes 0 to 3). The ring of the bent one begins at its top, for
    it turns clockwise."""
    game, unit = make("CartPoleEasy", obs_size=size), size // 128
    pole = [
        (24 * unit - radius, 56 * unit + radius + 1),
        (48 * unit - radius, 48 * unit + radius + 1),
    ]
    for number, (speed, thickness) in enumerate(((0.5, 2), (1.0, 2), (3.0, 4), (4.0, 4))):
        frame = draw(game, one(game, x=0.0, theta=0.0, x_dot=speed, theta_dot=speed), False)
        field = frame[16 * unit : 112 * unit, 16 * unit : 112 * unit]
        places = [
            np.nonzero((field == colour).all(-1)) for colour in ((245, 74, 140), (191, 120, 69))
        ]
        cart, copper = ([(at.min(), at.max() + 1) for at in place] for place in places)
        assert cart == [(48 * unit, 64 * unit), (32 * unit, 64 * unit)] and copper == pole
        ink = (field == (204, 204, 204)).all(-1)
        flat, bent = (
            ink[69 * unit : 91 * unit, left : left + 22 * unit] for left in (5 * unit, 69 * unit)
        )
        assert ink.sum() == flat.sum() + bent.sum(), "nothing beside the boxes"
        across, shaft, middle = flat.sum(0), 22 * unit - head - number, 11 * unit
        assert (
            (across[:shaft] == thickness).all() and across[shaft] > thickness and across[-2:].any()
        )
        assert (
            bent[0].any() and not bent[:, :middle].any() and bent[:, middle].sum() == thickness
        ), "its ring begins"


def test_noise_beyond_the_limits_is_drawn_at_the_limits():
    game = make("NoisyCartPoleHard")
    for sign in (-1, 1):
        edge = one(game, x=2.4 * sign, theta=THETA_LIMIT * sign, noise=np.zeros(4))
        beyond = edge._replace(noise=jnp.array([1.0, 0.0, 0.5, 0.0]) * sign)
        assert np.array_equal(draw(game, beyond, False), draw(game, edge, False))


def test_a_pole_to_the_right_leans_to_the_right():
    game = make("CartPoleEasy")
    frame = draw(game, one(game, x=0.0, theta=0.2), False)
    tip = np.argwhere((frame == np.array(COPPER)).all(-1))
    assert tip[tip[:, 0].argmin(), 1] > 64 + 3


@pytest.mark.parametrize("size", [128, 256])
def test_logarithmic_arrows_have_eight_pictures_for_speeds_up_to_four(size):
    speeds = np.linspace(0, 4, 4001).astype(np.float32)
    level = np.asarray(arrow_level(speeds, "log", 22))
    assert sorted(set(level)) == [0, 1, 2, 3]
    np.testing.assert_allclose(
        [speeds[(level == k).argmax()] for k in (1, 2, 3)], [0.65, 1.72, 3.48], atol=0.01
    )
    for pictures in arrow_pictures(Geometry(size), "log"):
        levels = len(pictures) // 2
        shown = np.concatenate([pictures[:4], pictures[levels : levels + 4]])
        assert len(np.unique(shown.reshape(8, -1), axis=0)) == 8


@pytest.mark.parametrize("size", [128, 256])
def test_linear_arrows_tell_every_length_apart(size):
    geo = Geometry(size)
    for pictures in arrow_pictures(geo, "linear"):
        ink = (pictures != np.array(CHARCOAL)).any(-1).sum((1, 2))
        assert len(pictures) == 2 * (geo.box + 1) and ink[0] == ink[geo.box + 1] == 0
        assert len(np.unique(pictures.reshape(len(pictures), -1), axis=0)) == 2 * geo.box + 1
    assert list(np.asarray(arrow_level(np.array([0.0, 2.0, 4.0, 9.0]), "linear", geo.box))) == [
        0,
        geo.box // 2,
        geo.box,
        geo.box,
    ]


@pytest.mark.parametrize("slot", [0, 1])
def test_arrows_point_where_the_velocity_goes(slot):
    """The flat arrow's head is right of the middle for v > 0; the bent one's quarter ring is upper
    right.
    """
    name = ("x_dot", "theta_dot")[slot]
    game, frames = make("CartPoleEasy"), {}
    for v in (-1.0, 1.0):
        place = game.screen.arrows[slot]
        frame = draw(game, one(game, **{name: v}), False)
        frames[v] = (
            frame[place.y : place.y + 22, place.x : place.x + 22] != np.array(CHARCOAL)
        ).any(-1)
    if slot == 0:
        assert frames[1.0][:, 11:].sum() > frames[1.0][:, :11].sum()
        assert np.array_equal(frames[-1.0], frames[1.0][:, ::-1])
    else:
        assert np.argwhere(frames[1.0])[:, 0].max() >= 10
        assert frames[1.0][:11, 11:].sum() > 20, "the ring lies in the upper right quadrant"
        assert not np.array_equal(frames[1.0], frames[-1.0])


def test_every_visible_variable_changes_the_mdp_picture():
    game = make("CartPoleEasy")
    base = one(game, x=0.0, x_dot=0.0, theta=0.0, theta_dot=0.0, time=3, score=3)
    frame = draw(game, base, False)
    for name, value in {"x": 1.0, "x_dot": 1.0, "theta": 0.1, "theta_dot": 1.0, "score": 4}.items():
        changed = base._replace(**{name: jnp.asarray(value, getattr(base, name).dtype)})
        assert not np.array_equal(frame, draw(game, changed, False)), name


@pytest.mark.parametrize("arrow", ["log", "linear"])
def test_a_belief_follows_the_pose_from_the_arrows_alone(arrow):
    """The frames oracle's filter beside the rules: what it believes from the twentieth step on is
    near the truth, whatever it believed of the episode before.
    """
    envs, particles = 8, 400
    edges = _arrow_edges(make("CartPoleEasy", arrow=arrow))
    low, high = np.asarray(edges).T
    update = jax.jit(jax.vmap(partial(_update, edges=edges, sigma=0.0)))
    move = jax.jit(jax.vmap(rules.move))
    poses = np.random.default_rng(0).uniform(-0.05, 0.05, (envs, 4)).astype(np.float32)
    state = jax.jit(rules.at_pose)(poses.T, np.zeros((envs, 4), np.float32))
    of_before = np.full((envs, particles, 4), 9.0, np.float32)
    one_alone = np.full((envs, particles), -1e3, np.float32)
    one_alone[:, 0] = 0.0
    belief = Belief(of_before, one_alone, jax.random.split(jax.random.PRNGKey(0), envs))
    action = np.zeros(envs, np.int32)
    errors = []
    for t in range(60):
        truth = np.stack([state.x, state.x_dot, state.theta, state.theta_dot], -1)
        velocity = truth[:, 1::2, None]
        codes = ((low <= velocity) & (velocity < high)).argmax(-1)
        belief, action = update(belief, action, codes, np.full(envs, t == 0))
        weights = np.exp(np.asarray(belief.log_weight, np.float64))
        weights /= weights.sum(1, keepdims=True)
        mean = (weights[..., None] * np.asarray(belief.pose)).sum(1)
        errors.append(np.abs(mean - truth))
        state = move(state, action)
    x, x_dot, theta, theta_dot = np.mean(errors[20:], axis=(0, 1))
    assert x < 0.06 and x_dot < 0.03 and theta < 0.02 and theta_dot < 0.06
    assert np.abs(state.theta).max() < THETA_LIMIT
