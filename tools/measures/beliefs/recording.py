"""Recordings of greedy episodes: recurrent states, features of frames and hidden facts."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import Tensor

from arcade_torch.agents.checked import require
from arcade_torch.agents.config import SEED_LIMIT
from arcade_torch.tools.measures.policy import FEW, Progress, policy_of
from arcade_torch.tools.measures.windows import held_out

Ints = NDArray[np.int64]
Floats = NDArray[np.floating[Any]]  # single precision as recorded: states may be wide
MIN_EPISODES = 8
NO_FACTS = "this game names no facts"


@dataclass(frozen=True)
class Recording:
    """What was recorded of E episodes of at most T steps; entries beyond an end are of no use."""

    states: Floats  # [E, T, D], the recurrent state after the frame of the step; D may be 0
    features: Floats  # [E, T, F], of the frame of the step
    facts: Mapping[str, NDArray[Any]]  # [E, T, ...], bool, integers or floats
    lengths: Ints  # [E]


@torch.no_grad()
def record(
    agent: Any,
    env: Any,
    *,
    episodes: int,
    max_steps: int,
    seed: int = 0,
    progress: Progress | None = None,
) -> Recording:
    """Play greedy episodes side by side, and keep states, features and facts of all steps.

    Everything is as for `arcade_torch.tools.beliefs`.
    """
    require(episodes >= MIN_EPISODES, "episodes", episodes, f"at least {MIN_EPISODES}")
    require(max_steps >= 1, "max_steps", max_steps, "at least 1")
    if not hasattr(env, "facts"):
        raise ValueError(
            f"{type(env).__name__} has no facts(): hand over an ArcadeEnv, or an env whose facts() "
            "gives tensors [N, ...] by name"
        )
    size = int(env.batch_size[0])
    parts = list[Recording]()
    with policy_of(agent).evaluating():
        for group in range(-(-episodes // size)):
            drawn = np.random.SeedSequence([seed, group]).generate_state(1)
            env.set_seed(held_out(int(drawn[0]) % SEED_LIMIT))
            part = _record_batch(agent, env, max_steps)
            parts.append(_first(part, episodes - group * size))
            if progress is not None:
                progress(min(episodes, (group + 1) * size), episodes)
    return _joined(parts)


def _record_batch(agent: Any, env: Any, max_steps: int) -> Recording:
    """The first episode of every env of a batch."""
    policy = policy_of(agent)
    size = int(env.batch_size[0])
    lengths = np.zeros(size, np.int64)
    playing = torch.ones(size, dtype=torch.bool)
    steps = list[tuple[Floats, Floats, dict[str, NDArray[Any]]]]()
    obs = env.reset()
    state = agent.initial_state(size)
    seen = list[TensorDictBase]()
    while playing.any() and len(steps) < max_steps:
        if len(seen) < FEW:
            seen.append(first_row(obs))
        facts = {name: value.cpu().numpy().copy() for name, value in env.facts().items()}
        features = policy.features(obs["pixels"])
        action, _, state = agent.act(obs, state)
        steps.append((flat_state(state, size), features.float().cpu().numpy(), facts))
        lengths += playing.numpy()
        step, obs = env.step_and_maybe_reset(obs.set("action", action))
        playing &= ~step.get(("next", "done")).reshape(-1).cpu()
    check_seen(agent, seen)
    states, all_features, all_facts = zip(*steps, strict=True)
    if not all_facts[0]:
        raise ValueError(f"{NO_FACTS}: give its class a method facts, see Game.facts")
    by_name = dict[str, NDArray[Any]]()
    for name in all_facts[0]:
        by_name[name] = np.stack([facts[name] for facts in all_facts], axis=1)
    return Recording(np.stack(states, 1), np.stack(all_features, 1), by_name, lengths)


def first_row(obs: TensorDictBase) -> TensorDictBase:
    """A copy of what a policy reads of the first env of a batch, [1]."""
    return obs.select("pixels", "last_action", "is_init")[:1].clone()


def check_seen(agent: Any, seen: Sequence[TensorDictBase]) -> None:
    """Refuse an agent that does not say the same again of the first frames of an episode: its state
    is not all that it remembers.
    """
    steps: TensorDictBase = torch.cat(list(seen))
    policy_of(agent).check(
        steps["pixels"],
        steps["last_action"],
        steps["is_init"].reshape(-1),
        agent.initial_state(1),
    )


def flat_state(state: Any, size: int) -> Floats:
    """A recurrent state as numbers, float32 [size, D]; complex numbers are pairs."""
    leaves = list[Floats]()
    for leaf in _leaves(state):
        numbers = torch.view_as_real(leaf) if leaf.is_complex() else leaf
        leaves.append(numbers.detach().reshape(size, -1).float().cpu().numpy())
    return np.concatenate(leaves, axis=1) if leaves else np.zeros((size, 0), np.float32)


def shifted_state(state: Any, by: Floats) -> Any:
    """A copy of a recurrent state whose numbers, in the order of `flat_state`, are moved by [size,
    D]; whole numbers stay.
    """
    moved = state.clone()
    place = 0
    for leaf in _leaves(moved):
        numbers = torch.view_as_real(leaf) if leaf.is_complex() else leaf
        width = numbers[0].numel()
        if numbers.is_floating_point():
            part = torch.from_numpy(by[:, place : place + width].reshape(numbers.shape))
            numbers += part.to(numbers)
        place += width
    return moved


def _leaves(state: Any) -> Iterator[Tensor]:
    """The tensors of a state, in the order of their names."""
    if isinstance(state, Tensor):
        yield state
    elif state is not None:
        for name in sorted(state.keys()):
            yield from _leaves(state.get(name))


def _first(part: Recording, count: int) -> Recording:
    """The first episodes of a recording."""
    facts = {name: values[:count] for name, values in part.facts.items()}
    return Recording(part.states[:count], part.features[:count], facts, part.lengths[:count])


def _joined(parts: Sequence[Recording]) -> Recording:
    """Recordings one after the other, padded with zeros to the longest."""
    steps = max(part.states.shape[1] for part in parts)

    def join(arrays: Sequence[NDArray[Any]]) -> NDArray[Any]:
        padded = list[NDArray[Any]]()
        for array in arrays:
            missing = [(0, 0)] * array.ndim
            missing[1] = (0, steps - array.shape[1])
            padded.append(np.pad(array, missing))
        return np.concatenate(padded)

    facts = dict[str, NDArray[Any]]()
    for name in parts[0].facts:
        facts[name] = join([part.facts[name] for part in parts])
    return Recording(
        join([part.states for part in parts]),
        join([part.features for part in parts]),
        facts,
        np.concatenate([part.lengths for part in parts]),
    )
