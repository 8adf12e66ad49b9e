"""Windows of experience to analyse: greedy episodes up to the decision that ended them, or to one
before it.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, Unpack, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import Tensor

from arcade_torch.agents.checked import require
from arcade_torch.agents.config import SEED_LIMIT
from arcade_torch.envs_jax.registry import is_mixture
from arcade_torch.envs_jax.validation import format_value
from arcade_torch.tools.imports import load_agent
from arcade_torch.tools.measures.arguments import check_played, check_twin
from arcade_torch.tools.measures.choices import check_choices, decide
from arcade_torch.tools.measures.envs import EpisodeBatch, keeps_generator
from arcade_torch.tools.measures.keys import Keys, Names
from arcade_torch.tools.measures.policy import Policy, as_policy

MAX_STEPS = 512  # longest window; what is cut, and where, stands with the functions
# a shorter trajectory says nothing about memory: recall density leaves it out and counts it
MIN_STEPS = 3
SIDE_BY_SIDE = 16  # episodes played at once where the caller brings no environments
ENDLESS = 100_000  # steps after which an episode is taken for one that never ends

End = Literal["last", "random"]
Twin = Literal["full", "partial"]


@dataclass(frozen=True)
class Window:
    """Consecutive steps of one episode; on the last frame the decision was taken that is looked
    at.
    """

    frames: Tensor  # [T, *frame], of our games uint8 [T, S, S, 3]
    # the action that led to each frame, as the env has it: int64 [T], or one-hot [T, A]
    last_action: Tensor
    # bool [T], true at index 0 at most, and only if the window begins with the episode
    is_init: Tensor
    action: Tensor  # int64 [T], the action chosen on each frame
    reward: Tensor  # float32 [T], what it earned
    state: Any  # recurrent state before the first frame, batch of one
    # whether the action at the last frame ended the episode (else the window ends earlier)
    ended: bool
    seed: int  # of the batch of episodes
    row: int = 0  # which episode of that batch
    first: int = 0  # step of the episode at which the window begins

    @property
    def n(self) -> int:
        """Index of the last step."""
        return self.frames.shape[0] - 1

    def up_to(self, n: int) -> "Window":
        """The same window ending with step ``n``."""
        if n == self.n:
            return self
        return replace(
            self,
            frames=self.frames[: n + 1],
            last_action=self.last_action[: n + 1],
            is_init=self.is_init[: n + 1],
            action=self.action[: n + 1],
            reward=self.reward[: n + 1],
            ended=False,
        )


def greedy_window(
    agent: Any,
    env: Any = None,
    *,
    seed: int = 0,
    observability: Twin | None = None,
    max_steps: int = MAX_STEPS,
    **names: Unpack[Names],
) -> Window:
    """Play one greedy episode and return what the agent saw.

    Args:
        agent: an agent, or the path of a run folder or checkpoint; with ``env`` given, a TensorDict
            policy or anything else that `as_policy` takes.
        env: any env of TorchRL, of batch size [] or [1]; by default one of the agent's own game.
        seed: of the episode; without ``env`` that of a held-out environment.
        observability: another twin than the one trained on (without ``env``).
        max_steps: the episode is cut after this many steps.
        **names: keywords of `as_policy`.

    Returns:
        The window. The frame after the ending action is never part of it.

    Raises:
        ValueError: the env is not a batch of one, or ``max_steps`` is below 1.
    """
    check_played(seed, observability, max_steps=(max_steps, 1))
    seed = held_out(seed) if env is None else seed
    is_users = env is not None
    # as many envs of its own as other measures play: what is compiled for those serves here too
    player, env = resolve_agent(agent, env, observability, **names)
    require(
        not is_users or tuple(env.batch_size) in ((), (1,)),
        "the batch size of env",
        list(env.batch_size),
        "[] or [1], for one episode",
    )
    (window,), _ = play(player, env, seed=seed, keep=max_steps, max_steps=max_steps, most=1)
    return window


def check_episodes(episodes: Any, seed: Any, end: Any, cap: Any, twin: Any = None) -> None:
    """Refuse what `greedy_windows` could not play, and an unknown twin (ValueError)."""
    require(end in get_args(End), "end", end, f"one of {', '.join(get_args(End))}")
    check_played(seed, twin, episodes=(episodes, 1), cap=(cap, MIN_STEPS))


def greedy_windows(
    agent: Any, env: Any, *, episodes: int, seed: int = 0, end: End = "last", cap: int = MAX_STEPS
) -> Iterator[Window]:
    """Play greedy episodes side by side, one window each; a batch of episodes is in memory at a
    time.

    Args:
        agent: has ``act(obs, state) -> (action, extras, state)`` and ``initial_state(batch_size)``,
            and acts greedily.
        env: any env of TorchRL, of batch size [] or [N]. Batch b plays with a seed made of ``seed``
            and b, so another N plays other episodes.
        episodes: number of windows.
        seed: of the episodes and of the random ends; of held-out environments, as in an evaluation.
        end: ``last``: the window ends with the frame on which the ending action was chosen;
            ``random``: with a frame drawn uniformly from index 2 on. An episode longer than ``cap``
                ends at a random frame in either case.
        cap: longest window: the last so many frames before its end, with the recurrent state before
            them.

    Raises:
        ValueError: a number is below 1, ``end`` is unknown, or the agent chooses other actions than
            the best of its outputs, by which decisions are compared.
    """
    check_episodes(episodes, seed, end, cap)
    size = EpisodeBatch(env, keys_of(agent)).size
    for group in range(-(-episodes // size)):
        rng = np.random.default_rng([seed, group])
        drawn = np.random.SeedSequence([seed, group]).generate_state(1)
        batch_seed = held_out(int(drawn[0]) % SEED_LIMIT)
        windows, lengths = play(agent, env, seed=batch_seed, keep=cap)
        ends = np.array([_end(int(length), end, cap, rng) for length in lengths])
        # these windows begin later than what was kept: play the very same again
        late = ends >= cap
        if late.any():
            del windows
            first = np.where(late, ends - cap + 1, 0).tolist()
            windows, again = play(agent, env, seed=batch_seed, keep=cap, first=first)
            if (again != lengths).any():
                raise ValueError(
                    f"env must play the same episodes after set_seed({batch_seed}), of which long "
                    f"ones are played twice, got lengths {lengths.tolist()} and {again.tolist()}: "
                    "let it draw from that seed alone, or take a larger cap"
                )
            ends = np.where(late, cap - 1, ends)
        wanted = windows[: episodes - group * size]
        for row, (window, n) in enumerate(zip(wanted, ends, strict=False)):
            if group == 0 or row == 0:  # of later batches one: it costs a tenth of a measure
                check_choices(agent, window)
            yield window.up_to(int(n))


def _end(length: int, end: End, cap: int, rng: np.random.Generator) -> int:
    """Index of the last frame of the window in an episode of ``length`` frames."""
    if end == "last" and length <= cap:
        return length - 1
    return int(rng.integers(cap - 1 if end == "last" else min(MIN_STEPS, length) - 1, length))


@torch.no_grad()
@keeps_generator
def play(
    agent: Any,
    env: Any,
    *,
    seed: int,
    keep: int,
    max_steps: int | None = None,
    first: Sequence[int] | None = None,
    most: int | None = None,
) -> tuple[list[Window], NDArray[np.int64]]:
    """Play the first episode of every env of a batch greedily.

    From frame ``first`` on (0 by default; one for every env) ``keep`` frames of each episode are
    kept; episodes are cut after ``max_steps``, never by default. With ``most`` only so many envs
    are played. Returns a window of each episode, and all lengths int64 [N].
    """
    episodes = EpisodeBatch(env, keys_of(agent), most)
    size = episodes.size
    starts = torch.tensor([0] * size if first is None else first, device="cpu")
    lengths = torch.zeros(size, dtype=torch.int64, device="cpu")
    ended = torch.zeros(size, dtype=torch.bool, device="cpu")
    obs = episodes.reset(seed)
    state = agent.initial_state(size)
    kept: TensorDictBase | None = None
    states: list[Any] = [None] * size
    playing = torch.ones(size, dtype=torch.bool, device="cpu")
    t = 0
    while playing.any() and (max_steps is None or t < max_steps):
        if t == ENDLESS:
            raise ValueError(f"an episode must end, got {t} steps without: give env a time limit")
        for row in (playing & (starts == t)).nonzero().flatten().tolist():
            states[row] = None if state is None else state[row : row + 1].clone()
        action, state = decide(agent, obs, state)
        rows = (playing & (starts <= t) & (t < starts + keep)).nonzero().flatten()
        seen = obs.select("pixels", "last_action", "is_init").set("action", action)
        obs, reward, done = episodes.step(action)
        seen.set("reward", reward)
        if kept is None:  # untouched memory is never really taken
            kept = seen.apply(
                lambda x: x.new_empty(size, keep, *x.shape[1:]), batch_size=[size, keep]
            )
        kept[rows, t - starts[rows]] = seen[rows]
        lengths += playing
        ended |= playing & done.cpu()
        playing &= ~ended
        t += 1
    assert kept is not None
    windows = []
    for row, (begin, length) in enumerate(zip(starts.tolist(), lengths.tolist(), strict=True)):
        steps = max(0, min(keep, length - begin))
        whole = bool(ended[row]) and begin + steps == length
        window = _window(kept[row, :steps], states[row], whole, seed, row)
        windows.append(replace(window, first=begin))
    return windows, lengths.numpy()


def keys_of(agent: Any) -> Keys:
    """Where an env has what this agent reads."""
    return agent.keys if isinstance(agent, Policy) else Keys()


def _window(steps: TensorDictBase, state: Any, ended: bool, seed: int, row: int) -> Window:
    """A window from what was kept of the steps of one episode, [T]."""
    return Window(
        frames=steps["pixels"],
        last_action=steps["last_action"],
        is_init=steps["is_init"].reshape(-1),
        action=steps["action"].reshape(-1),
        reward=steps["reward"].reshape(-1),
        state=state,
        ended=ended,
        seed=seed,
        row=row,
    )


def held_out(seed: int) -> int:
    """The seed of episodes that training never sees, as in an evaluation."""
    # imported here: who measures windows of their own needs no environment
    from arcade_torch.agents.evaluation import held_out_seed

    return held_out_seed(seed)


def resolve_agent(
    agent: Any,
    env: Any = None,
    observability: Twin | None = None,
    num_envs: int = SIDE_BY_SIDE,
    **names: Unpack[Names],
) -> tuple[Any, Any]:
    """Something that acts, and environments for it: by default of its own game, on the twin that is
    named.

    ``agent`` is an agent, the path of its run folder or checkpoint, or with ``env`` given anything
    that acts as an agent does or that `as_policy`, which gets ``names``, takes. Without ``env``
    there are ``num_envs``, on the device of the agent's network.

    Raises:
        ValueError: there is no environment for it, or more than one.
        TypeError: ``env`` is no environment of TorchRL.
    """
    if env is not None and not hasattr(env, "step_and_maybe_reset"):
        raise TypeError(
            f"env is {format_value(env)}, expected an environment of TorchRL, such as "
            "arcade_torch.make(...), or GymWrapper(env) around one of Gymnasium"
        )
    if isinstance(agent, str | Path):
        agent = load_agent(Path(agent))
    check_twin(observability)
    acts = hasattr(agent, "act") and hasattr(agent, "initial_state")
    player = agent if acts and not names else as_policy(agent, **names)
    if env is not None:
        if observability is not None:
            raise ValueError(
                "observability belongs to the environments: leave it out, or leave env out"
            )
        return player, env
    if not hasattr(agent, "config"):
        raise ValueError(
            f"{type(agent).__name__} does not say which game it plays: hand over env as well"
        )
    twin = observability or agent.config.observability
    if twin not in get_args(Twin):
        raise ValueError(
            f"this agent was trained on {twin} twins: name one of them, full or partial"
        )
    if is_mixture(agent.config.env):
        raise ValueError(
            f"this agent was trained on several games, {agent.config.env}: name one of them, "
            "--game on the command line, env=arcade_torch.make(...) in Python"
        )
    from arcade_torch.agents.evaluation import make_eval_env

    device = str(next(agent.network.parameters()).device)
    return player, make_eval_env(
        replace(agent.config, device=device, cuda_graphs=False), num_envs, twin
    )
