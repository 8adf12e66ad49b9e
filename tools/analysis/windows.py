"""Windows of experience to analyse: greedy episodes up to the decision that ended them, or to one before it."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import Tensor

from arcade_torch.tools.analysis.policy import policy_of

MAX_STEPS = 512  # longest window; what is cut, and where, stands with the functions
MIN_STEPS = 3  # a shorter trajectory says nothing about memory: recall density leaves it out and counts it
SIDE_BY_SIDE = 16  # episodes played at once where the caller brings no environments

End = Literal["last", "random"]
Twin = Literal["full", "partial"]


@dataclass(frozen=True)
class Window:
    """Consecutive steps of one episode; on the last frame the decision was taken that is looked at.

    Attributes:
        frames: uint8 [T, S, S, 3].
        last_action: int64 [T], the action that led to each frame.
        is_init: bool [T], true at index 0 at most, and only if the window begins with the episode.
        action: int64 [T], the action chosen on each frame.
        reward: float32 [T], what it earned.
        state: recurrent state before the first frame, batch of one.
        ended: whether the action at the last frame ended the episode (else the window ends earlier).
        seed: of the batch of episodes.
        row: which episode of that batch.
    """

    frames: Tensor
    last_action: Tensor
    is_init: Tensor
    action: Tensor
    reward: Tensor
    state: Any
    ended: bool
    seed: int
    row: int = 0

    @property
    def n(self) -> int:
        """Index of the last step."""
        return self.frames.shape[0] - 1

    def up_to(self, n: int) -> "Window":
        """The same window ending with step ``n``."""
        if n == self.n:
            return self
        cut = {name: getattr(self, name)[: n + 1] for name in ("frames", "last_action", "is_init", "action", "reward")}
        return replace(self, **cut, ended=False)


def greedy_window(agent: Any, env: Any, *, seed: int = 0, max_steps: int = MAX_STEPS) -> Window:
    """Play one greedy episode and return what the agent saw.

    Args:
        agent: has ``act(obs, state) -> (action, extras, state)`` and ``initial_state(batch_size)``, and acts greedily.
        env: ``ArcadeEnv`` with one environment.
        seed: of the episode.
        max_steps: the episode is cut after this many steps.

    Returns:
        The window. The frame after the ending action is never part of it.

    Raises:
        ValueError: the env is not a batch of one, or ``max_steps`` is below 1.
    """
    if tuple(env.batch_size) != (1,):
        raise ValueError(f"a window is played in a batch of one environment, got batch size {list(env.batch_size)}")
    if max_steps < 1:
        raise ValueError(f"max_steps must be at least 1, got {max_steps}")
    (window,), _ = play(agent, env, seed=seed, keep=max_steps, max_steps=max_steps)
    return window


def greedy_windows(
    agent: Any, env: Any, *, episodes: int, seed: int = 0, end: End = "last", cap: int = MAX_STEPS
) -> Iterator[Window]:
    """Play greedy episodes side by side, one window each; a batch of episodes is in memory at a time.

    Args:
        agent: as for `greedy_window`.
        env: ``ArcadeEnv`` of any batch size N. Batch b plays with a seed made of ``seed`` and b, so another N plays
            other episodes.
        episodes: number of windows.
        seed: of the episodes and of the random ends; of held-out environments, as in an evaluation.
        end: ``last``: the window ends with the frame on which the ending action was chosen; ``random``: with a frame
            drawn uniformly from index 2 on. An episode longer than ``cap`` ends at a random frame in either case.
        cap: longest window: the last so many frames before its end, with the recurrent state before them.

    Raises:
        ValueError: a number is below 1, or ``end`` is unknown.
    """
    if end not in get_args(End):
        raise ValueError(f"end must be one of {', '.join(get_args(End))}, got {end!r}")
    if episodes < 1 or cap < MIN_STEPS:
        raise ValueError(f"episodes must be at least 1 and the cap at least {MIN_STEPS}, got {episodes} and {cap}")
    size = int(env.batch_size[0])
    for group in range(-(-episodes // size)):
        rng, batch_seed = np.random.default_rng([seed, group]), _episode_seed(seed, group)
        windows, lengths = play(agent, env, seed=batch_seed, keep=cap)
        ends = np.array([_end(int(length), end, cap, rng) for length in lengths])
        if (late := ends >= cap).any():  # these windows begin later than what was kept: play the very same again
            del windows
            first = np.where(late, ends - cap + 1, 0).tolist()
            windows, _ = play(agent, env, seed=batch_seed, keep=cap, first=first)
            ends = np.where(late, cap - 1, ends)
        for window, n in zip(windows[: episodes - group * size], ends, strict=False):
            yield window.up_to(int(n))


def _episode_seed(seed: int, group: int) -> int:
    """Environment seed of a batch of episodes: held out from training, and different for every (seed, group)."""
    from arcade_torch.agents.config import SEED_LIMIT
    from arcade_torch.agents.evaluation import held_out_seed

    drawn = np.random.SeedSequence([seed, group]).generate_state(1, np.uint32)[0]
    return held_out_seed(int(drawn) % SEED_LIMIT)


def _end(length: int, end: End, cap: int, rng: np.random.Generator) -> int:
    """Index of the last frame of the window in an episode of ``length`` frames."""
    last = length - 1
    if end == "random":
        return int(rng.integers(min(MIN_STEPS - 1, last), length))
    return last if length <= cap else int(rng.integers(cap - 1, length))


@torch.no_grad()
def play(
    agent: Any, env: Any, *, seed: int, keep: int, max_steps: int | None = None, first: Sequence[int] | None = None
) -> tuple[list[Window], NDArray[np.int64]]:
    """Play the first episode of every env of a batch greedily.

    From frame ``first`` on (0 by default; one for every env) ``keep`` frames of each episode are kept; episodes are cut
    after ``max_steps``, never by default. Returns a window of each episode, and all lengths int64 [N].
    """
    size = int(env.batch_size[0])
    starts = torch.as_tensor([0] * size if first is None else first)
    lengths, ended = torch.zeros(size, dtype=torch.int64), torch.zeros(size, dtype=torch.bool)
    env.set_seed(seed)
    obs, state = env.reset(), agent.initial_state(size)
    kept: TensorDictBase | None = None
    states: list[Any] = [None] * size
    playing, t = torch.ones(size, dtype=torch.bool), 0
    while playing.any() and (max_steps is None or t < max_steps):
        for row in (playing & (starts == t)).nonzero().flatten().tolist():
            states[row] = None if state is None else state[row : row + 1].clone()
        action, _, state = agent.act(obs, state)
        rows = (playing & (starts <= t) & (t < starts + keep)).nonzero().flatten()
        seen = obs.select("pixels", "last_action", "is_init").set("action", action)
        step, obs = env.step_and_maybe_reset(obs.set("action", action))
        seen.set("reward", step.get(("next", "reward")))
        if kept is None:  # untouched memory is never really taken
            kept = seen.apply(lambda x: x.new_empty(size, keep, *x.shape[1:]), batch_size=[size, keep])
        kept[rows, t - starts[rows]] = seen[rows]
        lengths += playing
        ended |= playing & step.get(("next", "done")).reshape(-1).cpu()
        playing &= ~ended
        t += 1
    assert kept is not None
    windows = []
    for row, (begin, length) in enumerate(zip(starts.tolist(), lengths.tolist(), strict=True)):
        steps = max(0, min(keep, length - begin))
        seen = {name: value if name == "pixels" else value.reshape(-1) for name, value in kept[row, :steps].items()}
        whole = bool(ended[row]) and begin + steps == length
        windows.append(Window(seen.pop("pixels"), **seen, state=states[row], ended=whole, seed=seed, row=row))
    return windows, lengths.numpy()


def resolve_agent(agent: Any, env: Any = None, observability: Twin | None = None) -> tuple[Any, Any]:
    """Something that acts, and environments for it: by default 16 of the agent's own game, on the twin that is named.

    Args:
        agent: an agent, the path of its run folder or checkpoint, or with ``env`` given anything `policy_of` takes.
        env: environments.
        observability: another twin than the one trained on (without ``env``).

    Raises:
        ValueError: there is no environment for it, or more than one.
    """
    if isinstance(agent, str | Path):
        from arcade_torch.agents import load

        agent = load(agent)
    player = agent if hasattr(agent, "act") and hasattr(agent, "initial_state") else policy_of(agent)
    if env is not None and observability is not None:
        raise ValueError("observability belongs to the environments: leave it out, or leave env out")
    if env is None and not hasattr(agent, "config"):
        raise ValueError(f"{type(agent).__name__} does not say which game it plays: hand over env as well")
    return player, _own_env(agent, SIDE_BY_SIDE, observability) if env is None else env


def _own_env(agent: Any, num_envs: int, observability: Twin | None) -> Any:
    """Environments of an agent's own game, on the device of its network."""
    from arcade_torch.agents.evaluation import make_eval_env

    twin = observability or agent.config.observability
    if twin not in get_args(Twin):
        raise ValueError(f"this agent was trained on {twin} twins: name one of them, full or partial")
    device = str(next(agent.network.parameters()).device)
    return make_eval_env(replace(agent.config, device=device), num_envs, twin)


def episode_window(
    agent: Any, *, seed: int = 0, observability: Twin | None = None, max_steps: int = MAX_STEPS
) -> Window:
    """Play one greedy episode in the agent's own game; the seed is one of held-out environments."""
    from arcade_torch.agents.evaluation import held_out_seed

    return greedy_window(agent, _own_env(agent, 1, observability), seed=held_out_seed(seed), max_steps=max_steps)
