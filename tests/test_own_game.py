"""The example of a game of one's own: its rules, its twins, and that the stock tools take it."""

import importlib.util
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch

import arcade_torch
from arcade_torch.agents.evaluation import evaluate
from arcade_torch.agents.presets import preset
from arcade_torch.agents.trainer import Trainer
from arcade_torch.envs_jax import (
    BatchedGame,
    Game,
    check_game,
    env_keys,
    make,
    probe_ids,
    register,
    registered_ids,
)
from arcade_torch.envs_jax.game import Rules
from arcade_torch.envs_jax.oracles import make_oracle, oracle_return, random_return
from arcade_torch.tools import cli
from arcade_torch.tools.play.recording import scene
from tests.own_registry import own_registry  # noqa: F401

FILE = Path(__file__).resolve().parents[1] / "examples/own_game.py"
pytestmark = pytest.mark.usefixtures("own_registry")


@pytest.fixture
def pairs(own_registry: None) -> Any:  # noqa: F811
    spec = importlib.util.spec_from_file_location("own_game_example", FILE)
    assert spec is not None and spec.loader is not None
    spec.loader.exec_module(importlib.util.module_from_spec(spec))
    return make("PairsEasy")


def way(start: int, goal: int) -> list[int]:
    """Moves from one card to another, and the turn."""
    down, right = goal // 4 - start // 4, goal % 4 - start % 4
    return [1 if down > 0 else 0] * abs(down) + [3 if right > 0 else 2] * abs(right) + [4]


def test_the_file_is_short_and_keeps_the_contract(pairs: Any) -> None:
    assert len(FILE.read_text().splitlines()) < 150
    for size in (128, 256):
        check_game(make("PairsEasy", obs_size=size), play=True)


def test_whoever_remembers_finds_all_pairs_and_two_that_differ_are_turned_back(pairs: Any) -> None:
    batched = BatchedGame(pairs)
    batch = batched.init(env_keys(0, 1), jnp.ones(1, bool))
    cards = np.asarray(batch.state.cards[0])
    assert sorted(cards) == sorted(list(range(8)) * 2)
    different = [int(np.flatnonzero(cards != cards[0])[0])]
    order = [
        0,
        *different,
        *(int(card) for face in range(8) for card in np.flatnonzero(cards == face)),
    ]
    place, total, hidden = 0, 0.0, batched.render(batch)
    for count, goal in enumerate(order):
        for action in way(place, goal):
            batch, outcome = batched.step(batch, np.full(1, action, np.int32))
            total += float(outcome.reward[0])
        place = goal
        if count == 1:
            assert total == 0 and (batch.state.turned >= 0).all()
            shown = batched.render(batch)
            back, _ = batched.step(batch, np.zeros(1, np.int32))
            assert (back.state.turned == -1).all() and not back.state.found.any()
            assert (np.asarray(shown) != np.asarray(hidden)).any()
    assert total == pytest.approx(1) and outcome.terminated.all() and not outcome.truncated.any()


def test_the_pomdp_hides_the_cards_that_are_down_and_nothing_else(pairs: Any) -> None:
    draw = jax.jit(pairs.render)
    state = pairs.reset(jax.random.PRNGKey(1))
    other = state._replace(cards=state.cards[::-1])
    assert np.array_equal(draw(state, True), draw(other, True))
    assert not np.array_equal(draw(state, False), draw(other, False))
    up = state._replace(found=jnp.ones(16, bool))
    assert np.array_equal(draw(up, True), draw(up, False))


def test_it_trains_and_is_evaluated_with_the_stock_tools(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [
        "--preset",
        "smoke",
        "--env",
        "PairsEasy",
        "--observability",
        "partial",
        "--out",
        str(tmp_path / "run"),
    ]
    assert cli.main(["train", "--import", str(FILE), *words]) == cli.EXIT_OK
    assert cli.main(["evaluate", str(tmp_path / "run"), "--episodes", "4"]) == cli.EXIT_OK
    assert "PairsEasy-v0 (partial)" in capsys.readouterr().out


def test_a_frame_of_the_wrong_shape_is_refused_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    right = "return self.layers.draw(state.found.sum() // 2, codes)"
    source = FILE.read_text().replace('register("PairsEasy-v0"', 'register("PairsWrong-v0"')
    assert right in source
    (tmp_path / "wrong.py").write_text(source.replace(right, f"{right}[:, :64]"))
    words = ["--preset", "smoke", "--env", "PairsWrong", "--out", str(tmp_path / "run")]
    assert cli.main(["train", "--import", str(tmp_path / "wrong.py"), *words]) == cli.EXIT_BAD_INPUT
    err = capsys.readouterr().err
    assert (
        err
        == "arcade-torch: PairsWrong-v0: render gives uint8 [128, 64, 3], wanted uint8 [128, 128, 3]\n"
    )
    assert not (tmp_path / "run").exists()


class ToyState(NamedTuple):
    """How often the player moved."""

    count: jax.Array  # int32


class Toy(Game[ToyState]):
    """Five steps; action 4 pays. The POMDP hides the count."""

    max_steps, return_range = 5, (0.0, 5.0)

    def __init__(self, *, id: str, obs_size: int, rules: Rules, pay: float = 1.0) -> None:
        self.id, self.obs_size, self.rules, self.pay = id, obs_size, rules, pay

    def reset(self, key: jax.Array) -> ToyState:
        return ToyState(jnp.int32(0))

    def step(
        self, key: jax.Array, state: ToyState, action: jax.Array
    ) -> tuple[ToyState, Any, Any, Any]:
        count = state.count + 1
        return (
            ToyState(count),
            (action == 4) * jnp.float32(self.pay),
            jnp.bool_(False),
            count >= self.max_steps,
        )

    def render(self, state: ToyState, partial: Any) -> jax.Array:
        shade = jnp.where(partial, 0, 40 * state.count + 50).astype(jnp.uint8)
        return jnp.broadcast_to(shade, (self.obs_size, self.obs_size, 3))


class Fire:
    """Always fires."""

    def __init__(self, game: Toy) -> None:
        del game

    def act(self, seen: Any, is_init: np.ndarray) -> np.ndarray:
        return np.full(len(is_init), 4, np.int32)


def test_one_line_registers_a_game_for_make_oracles_gymnasium_and_the_sheet(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    register("ToyEasy-v0", Toy)

    assert make("ToyEasy", pay=0.5).pay == 0.5 and "ToyEasy-v0" in registered_ids()
    assert arcade_torch.make("ToyEasy", num_envs=2).rollout(5)["next", "truncated"][:, -1].all()
    frame, _ = gymnasium.make("arcade_torch/ToyEasy-v0", observability="partial", pay=0.5).reset(
        seed=0
    )
    assert frame.shape == (128, 128, 3) and not frame.any()
    full, hidden = scene("ToyEasy", 128)  # a game without an oracle is played at random
    assert full.min() == full.max() > 50 and not hidden.any()
    with pytest.raises(
        ValueError, match=r"ToyEasy-v0 has no state oracle: name one in Toy\.oracles"
    ):
        make_oracle(make("ToyEasy"))
    monkeypatch.setattr(Toy, "oracles", {"state": Fire})
    assert (oracle_return(make("ToyEasy"), episodes=3) == 5).all()


def test_a_probe_stays_out_of_the_benchmark_and_of_gymnasium() -> None:
    register("ToyEasy-v0", Toy, probe=True)
    assert "ToyEasy-v0" in probe_ids() and "ToyEasy-v0" not in registered_ids()
    assert "arcade_torch/ToyEasy-v0" not in gymnasium.registry and make("ToyEasy").max_steps == 5


@pytest.mark.parametrize("actions", [[4, 7], [[4], [4]], [0.5, 4.0]])
def test_an_oracle_that_gives_no_actions_is_refused(
    actions: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Odd(Fire):
        def act(self, seen: Any, is_init: np.ndarray) -> np.ndarray:
            return np.asarray(actions)

    register("ToyEasy-v0", Toy)
    monkeypatch.setattr(Toy, "oracles", {"state": Odd})
    with pytest.raises(ValueError, match=r"the player gives .*, expected integers \[2\] from 0"):
        oracle_return(make("ToyEasy"), episodes=2)


class Endless(Toy):
    """Never ends."""

    def step(
        self, key: jax.Array, state: ToyState, action: jax.Array
    ) -> tuple[ToyState, Any, Any, Any]:
        return *super().step(key, state, action)[:3], jnp.bool_(False)


def test_whoever_plays_episodes_to_the_end_does_not_wait_for_ever_for_one_that_has_none() -> None:
    register("EndlessEasy-v0", Endless)
    message = "EndlessEasy-v0: an episode runs on after 6 steps, and max_steps is 5"
    with pytest.raises(ValueError, match=message):
        random_return(make("EndlessEasy"), episodes=2)

    class Still:
        def initial_state(self, num_envs: int) -> None:
            return None

        def act(self, obs: Any, state: None) -> Any:
            return torch.zeros(len(obs), dtype=torch.int64), None, None

    with pytest.raises(ValueError, match=message):
        evaluate(Still(), env=arcade_torch.make("EndlessEasy", num_envs=2))


@pytest.mark.slow
def test_a_training_says_at_once_that_an_episode_has_no_end() -> None:
    register("EndlessEasy-v0", Endless)
    trainer = Trainer(preset("smoke", env="EndlessEasy", observability="full"))
    with pytest.raises(ValueError, match=r"EndlessEasy-v0: an episode runs on after \d+ steps"):
        for _ in range(8):
            trainer.update()


def test_a_game_that_counts_in_python_is_refused() -> None:
    class Counts(Toy):
        steps = 0

        def step(self, key: jax.Array, state: ToyState, action: jax.Array) -> Any:
            self.steps += 1
            return super().step(key, ToyState(state.count * 0 + self.steps), action)

    register("CountsEasy-v0", Counts)
    with pytest.raises(
        ValueError, match="CountsEasy-v0: step is another function when it is called again"
    ):
        make("CountsEasy")


def test_keys_of_the_new_style_and_bfloat16_may_be_part_of_a_state() -> None:
    class Keyed(Toy):
        def reset(self, key: jax.Array) -> Any:
            return {"count": jnp.int32(0), "key": jax.random.key(3), "low": jnp.bfloat16(0.5)}

        def step(self, key: jax.Array, state: Any, action: jax.Array) -> Any:
            chance, following = jax.random.split(state["key"])
            count = state["count"] + 1
            reward = jax.random.uniform(chance) + state["low"].astype(jnp.float32)
            after = {"count": count, "key": following, "low": state["low"] + 1}
            return after, reward, jnp.bool_(False), count >= self.max_steps

        def render(self, state: Any, partial: Any) -> jax.Array:
            return super().render(ToyState(state["count"]), partial)

    register("KeyedEasy-v0", Keyed)
    env = arcade_torch.make("KeyedEasy", num_envs=2)
    env.rollout(2)
    saved = env.get_state()
    expected = env.rollout(2, auto_reset=False, tensordict=env.set_state(saved))["next", "reward"]
    assert len(expected[0].unique()) == 2 and (expected > 2.5).all()
    another = arcade_torch.make("KeyedEasy", num_envs=2, seed=1)
    root = another.set_state(saved)
    given = another.rollout(2, auto_reset=False, tensordict=root)["next", "reward"]
    assert torch.equal(given, expected)
