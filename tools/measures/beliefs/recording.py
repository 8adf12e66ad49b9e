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
from arcade_torch.tools.measures.arguments import check_played
from arcade_torch.tools.measures.choices import decide
from arcade_torch.tools.measures.envs import EpisodeBatch, keeps_generator
from arcade_torch.tools.measures.policy import FEW, Progress, policy_of
from arcade_torch.tools.measures.windows import held_out, keys_of

Ints = NDArray[np.int64]
Floats = NDArray[np.floating[Any]]  # single precision as recorded: states may be wide
MIN_EPISODES = 8
CLASSES = "biu"
"""Kinds of types whose facts are classes."""
NO_FACTS = "this game names no facts"


@dataclass(frozen=True)
class Recording:
    """What was recorded of E episodes of at most T steps; entries beyond an end are of no use."""

    states: Floats  # [E, T, D], the recurrent state after the frame of the step; D may be 0
    features: Floats  # [E, T, F], of the frame of the step
    facts: Mapping[str, NDArray[Any]]  # [E, T, ...], bool, integers or floats
    lengths: Ints  # [E]

    def __post_init__(self) -> None:
        """Refuse what no probe can read (ValueError)."""
        episodes, steps = self.states.shape[:2]
        lengths = np.asarray(self.lengths)
        fits = lengths.shape == (episodes,) and ((lengths >= 1) & (lengths <= steps)).all()
        require(fits, "lengths", lengths.tolist(), f"from 1 to {steps} for each of {episodes}")
        exists = np.arange(steps) < lengths[:, None]
        for name, values in (("states", self.states), ("features", self.features)):
            self._check_shape(name, values)
            require(bool(np.isfinite(values[exists]).all()), name, "NaN or infinity", "finite")
        for name, values in self.facts.items():
            fact = f"the fact {name!r}"
            self._check_shape(fact, values)
            allowed = "bool, integers or floats"
            require(values.dtype.kind in CLASSES + "f", fact, str(values.dtype), allowed)
            has_infinity = values.dtype.kind == "f" and np.isinf(values[exists]).any()
            require(not has_infinity, fact, "infinity", "finite, or NaN where it has no value")

    def _check_shape(self, name: str, values: NDArray[Any]) -> None:
        """Refuse values that are none of each episode and step."""
        episodes, steps = self.states.shape[:2]
        fits = values.shape[:2] == (episodes, steps)
        require(fits, name, list(values.shape), f"[{episodes}, {steps}, ...] as the states are")


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
    check_played(seed, episodes=(episodes, MIN_EPISODES), max_steps=(max_steps, 1))
    if not hasattr(env, "facts"):
        raise ValueError(
            f"{type(env).__name__} has no facts(): hand over an ArcadeEnv, or an env whose facts() "
            "gives tensors [N, ...] by name"
        )
    played = EpisodeBatch(env, keys_of(agent))
    size = played.size
    parts = list[Recording]()
    with policy_of(agent).evaluating():
        for group in range(-(-episodes // size)):
            drawn = np.random.SeedSequence([seed, group]).generate_state(1)
            batch_seed = held_out(int(drawn[0]) % SEED_LIMIT)
            part = _record_batch(agent, played, batch_seed, max_steps)
            parts.append(_first(part, episodes - group * size))
            if progress is not None:
                progress(min(episodes, (group + 1) * size), episodes)
    return _joined(parts)


@keeps_generator
def _record_batch(agent: Any, played: EpisodeBatch, seed: int, max_steps: int) -> Recording:
    """The first episode of every env of a batch."""
    policy = policy_of(agent)
    size = played.size
    lengths = np.zeros(size, np.int64)
    playing = torch.ones(size, dtype=torch.bool, device="cpu")
    steps = list[tuple[Floats, Floats, dict[str, NDArray[Any]]]]()
    obs = played.reset(seed)
    state = agent.initial_state(size)
    seen = list[TensorDictBase]()
    while playing.any() and len(steps) < max_steps:
        if len(seen) < FEW:
            seen.append(first_row(obs))
        facts = facts_of(played)
        features = policy.features(obs["pixels"])
        action, state = decide(agent, obs, state)
        steps.append((flat_state(state, size), features.float().cpu().numpy(), facts))
        lengths += playing.numpy()
        obs, _, done = played.step(action)
        playing &= ~done.cpu()
    check_seen(agent, seen)
    states, all_features, all_facts = zip(*steps, strict=True)
    if not all_facts[0]:
        raise ValueError(f"{NO_FACTS}: give its class a method facts, see Game.facts")
    by_name = dict[str, NDArray[Any]]()
    for name in all_facts[0]:
        by_name[name] = np.stack([facts[name] for facts in all_facts], axis=1)
    return Recording(np.stack(states, 1), np.stack(all_features, 1), by_name, lengths)


def facts_of(played: EpisodeBatch) -> dict[str, NDArray[Any]]:
    """The facts of the present states by name, each [N, ...].

    Raises:
        ValueError: a fact has not one value for each of the N envs.
    """
    facts = dict[str, NDArray[Any]]()
    for name, value in played.env.facts().items():
        values = torch.as_tensor(value, device="cpu").numpy().copy()
        facts[name] = values if played.is_batch else values[None]
        require(
            facts[name].shape[:1] == (played.size,),
            f"the fact {name!r}",
            list(facts[name].shape),
            f"[{played.size}, ...], one for each env",
        )
    return facts


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
