"""Windows of experience to analyse: one greedy episode up to the decision that ended it."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

MAX_STEPS = 512
"""Longest window; a longer episode is cut there, and the window says so."""


@dataclass(frozen=True)
class Window:
    """Consecutive steps of one episode; the last frame is the one on which the ending action was chosen.

    Attributes:
        frames: uint8 [T, S, S, 3].
        last_action: int64 [T], the action that led to each frame.
        is_init: bool [T], true at index 0 at most, and only if the window begins with the episode.
        action: int64 [T], the action chosen on each frame.
        reward: float32 [T], what it earned.
        state: recurrent state before the first frame, batch of one.
        ended: whether the action at the last frame ended the episode (else the window was cut by its length).
        seed: of the episode.
    """

    frames: Tensor
    last_action: Tensor
    is_init: Tensor
    action: Tensor
    reward: Tensor
    state: Any
    ended: bool
    seed: int

    @property
    def n(self) -> int:
        """Index of the last step."""
        return self.frames.shape[0] - 1


def greedy_window(
    agent: Any, env: Any, *, seed: int = 0, max_steps: int = MAX_STEPS, keep: int | None = None
) -> Window:
    """Play one greedy episode and return what the agent saw.

    Args:
        agent: has ``act(obs, state) -> (action, extras, state)`` and ``initial_state(batch_size)``, and acts greedily.
        env: ``ArcadeEnv`` with one environment.
        seed: of the episode.
        max_steps: the episode is cut after this many steps.
        keep: the window holds the last so many steps (its ``state`` is the one before them); all by default.

    Returns:
        The window. The frame after the ending action is never part of it.

    Raises:
        ValueError: the env is not a batch of one, or a length is below 1.
    """
    if tuple(env.batch_size) != (1,):
        raise ValueError(f"a window is played in a batch of one environment, got batch size {list(env.batch_size)}")
    if max_steps < 1 or (keep is not None and keep < 1):
        raise ValueError(f"max_steps and keep must be at least 1, got {max_steps} and {keep}")
    env.set_seed(seed)
    obs, state = env.reset(), agent.initial_state(1)
    columns: dict[str, list[Tensor]] = {"pixels": [], "last_action": [], "is_init": [], "action": [], "reward": []}
    states: list[Any] = []
    ended = False
    with torch.no_grad():
        for _ in range(max_steps):
            states.append(state.clone())
            action, _, state = agent.act(obs, state)
            for name in ("pixels", "last_action", "is_init"):
                columns[name].append(obs.get(name)[0].clone())
            following = env.step(obs.clone(False).set("action", action)).get("next")
            columns["action"].append(action[0].clone())
            columns["reward"].append(following.get("reward").reshape(()).clone())
            ended = bool(following.get("done").any())
            if ended:
                break
            obs = following.exclude("reward")
    first = 0 if keep is None else max(0, len(states) - keep)
    parts = {name: torch.stack(values[first:]) for name, values in columns.items()}
    return Window(
        parts["pixels"],
        parts["last_action"].reshape(-1),
        parts["is_init"].reshape(-1),
        parts["action"].reshape(-1),
        parts["reward"],
        states[first],
        ended,
        seed,
    )
