"""``ArcadeCollector``: windows of experience from one ``ArcadeEnv``, every frame written once."""

import functools
from collections import OrderedDict, deque
from collections.abc import Callable, Iterator
from typing import Any, Literal

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import nn
from torchrl.collectors import BaseCollector
from torchrl.envs.utils import ExplorationType, set_exploration_type

from arcade_torch.dlpack import to_torch
from arcade_torch.env import ArcadeEnv, RawStep
from arcade_torch.policies import ROOT_KEYS, Actor, Extras, ModuleActor, RandomActor
from arcade_torch.window import Window

FinalFrames = Literal["all", "truncated", "none"]
_FINAL_FRAMES = ("all", "truncated", "none")


class ArcadeCollector(BaseCollector):
    """Collects windows of T steps from N envs.

    Two products. ``collect()`` gives **sequences**: TensorDict [N] of entries [N, L, ...] with L = context + T, every
    frame stored once, the recurrent state once a window (``initial_state``, the state before index 0), and the frames
    that follow no other in a small pool (see ``arcade_torch.frames``). **Iteration** gives the T new steps in the
    layout of TorchRL's collectors, TensorDict [N, T], so that TorchRL's losses and trainers take it. Both are the data
    that ``env.rollout`` and TorchRL's ``Collector`` give, to the bit.

    The first window acts ``context`` more steps, to fill the context; they are not counted as frames.

    Args:
        env: The env, not wrapped (TorchRL's ``Collector`` is for transformed envs).
        policy: An ``Actor``, a TorchRL policy (reads root keys, writes ``action`` and perhaps ``("next", <state>)``),
            or None for random actions.
        frames_per_batch: N * T.
        total_frames: Iteration ends after so many frames; -1 for never. ``collect`` does not look at it.
        context: Steps of the previous window that stand in front of ``collect``'s sequences. Their ``initial_state`` is
            the one that was theirs when they were acted.
        compress: uint8 [N, S, S, 3] -> uint8 [N, ...], what is stored of a frame. The policy sees the compressed frame
            too, so that acting and learning see the same.
        final_frames: Which final frames are drawn and kept: of all ends, of those that were truncated and not
            terminated (a bootstrap needs no others), or none.
        init_random_frames: Act at random for so many frames; the policy still runs, for its state.
        seed: Seed of env and random actions; None leaves the env as it is.
        return_same_td: Whether a batch may be overwritten by the next one; False hands out copies.
        compact_obs: Leave ``("next", "pixels")`` out of iterated batches; ``next_pixels(batch)`` builds it.
        store_states: Whether iterated batches and sequences hold a TorchRL policy's recurrent state at every step, as
            TorchRL's losses expect. Turn it off for large states.
        exploration_type: As in TorchRL's collectors.
        post_collect_hook: Called with every iterated batch.

    Raises:
        TypeError: ``env`` is not an ``ArcadeEnv``, or ``policy`` nothing that can act.
        ValueError: Sizes that do not fit, or an unknown choice.

    Example:
        >>> from arcade_torch import make
        >>> collector = ArcadeCollector(make("CartPoleEasy", num_envs=2), None, frames_per_batch=8, total_frames=16)
        >>> [tuple(batch.shape) for batch in collector]
        [(2, 4), (2, 4)]
    """

    def __init__(
        self,
        env: ArcadeEnv,
        policy: Actor | Callable[[TensorDictBase], TensorDictBase] | None = None,
        frames_per_batch: int = 2048,
        total_frames: int = -1,
        *,
        context: int = 0,
        compress: Callable[[torch.Tensor], torch.Tensor] | None = None,
        final_frames: FinalFrames = "all",
        init_random_frames: int = 0,
        seed: int | None = None,
        return_same_td: bool = True,
        compact_obs: bool = False,
        store_states: bool = True,
        exploration_type: ExplorationType = ExplorationType.RANDOM,
        post_collect_hook: Callable[[TensorDictBase], None] | None = None,
    ) -> None:
        super().__init__(post_collect_hook=post_collect_hook)
        _check_arguments(env, policy, frames_per_batch, context, final_frames)
        self.env: ArcadeEnv = env
        self.policy = policy
        self.requested_frames_per_batch = self.frames_per_batch = frames_per_batch
        self.total_frames = float("inf") if total_frames < 0 else total_frames
        self.init_random_frames = init_random_frames
        self.return_same_td, self.compact_obs = return_same_td, compact_obs
        self.exploration_type = exploration_type
        self.closed = False
        self._weight_updater = None
        self._weight_sync_schemes: dict[str, Any] | None = None
        self._num_envs, self._steps, self._context = env.num_envs, frames_per_batch // env.num_envs, context
        self._compress, self._final_frames = compress, final_frames
        self._generator = torch.Generator(env.device)
        self._generator.manual_seed(int(torch.randint(2**31, ())))
        self._endings = env.final_states()
        self._random = RandomActor(env.game.num_actions, self._generator)
        self._actor = self._make_actor(policy, store_states)
        self._reads = tuple(getattr(self._actor, "obs_keys", ROOT_KEYS))
        self._window: Window | None = None
        self._frames, self._iter = 0, -1
        self._start_over()
        if seed is not None:
            self.set_seed(seed)

    def _make_actor(self, policy: Any, store_states: bool) -> Actor:
        if policy is None:
            return self._random
        if hasattr(policy, "act") and hasattr(policy, "initial_state"):
            actor: Actor = policy
            return actor
        return ModuleActor(policy, store_states, self.env.device)

    def _start_over(self) -> None:
        """Forget the running episodes: the next window begins with a reset."""
        self._obs: dict[str, torch.Tensor] | None = None
        self._generation = -1
        self._acted = 0  # steps since the first reset
        self._state = TensorDict({}, batch_size=[self._num_envs])
        self._window_starts: deque[TensorDict] = deque()  # recurrent states before the coming windows
        self._traj_ids = torch.arange(self._num_envs, device=self.env.device)
        self._next_traj_id = self._num_envs

    # -- collecting -------------------------------------------------------------------------------------------------

    @property
    def frames(self) -> int:
        """Env steps collected so far, without those that filled the first context."""
        return self._frames

    def collect(self) -> TensorDict:
        """Collect one window.

        Returns:
            TensorDict [N]: ``pixels`` uint8 [N, L, ...], ``action`` and ``last_action`` int64 [N, L], ``is_init`` bool,
            ``step_count`` int64, ``episode_reward`` float32 [N, L, 1], what the actor wanted stored [N, L, ...],
            ``("next", ...)`` with reward, done, terminated, truncated, step_count, episode_reward and ``frame_slot``
            [N, L, 1], ``initial_state`` TensorDict [N], and ``next_pool``. Rows may be selected: ``batch[rows]``.

        Raises:
            RuntimeError: The collector has been shut down.
        """
        window, initial_state = self._collect_window()
        sequences = window.sequences(initial_state)
        return sequences if self.return_same_td else sequences.clone()

    def iterator(self) -> Iterator[TensorDictBase]:
        """Yield TensorDict [N, T] in TorchRL's layout until ``total_frames`` have been collected."""
        while self._frames < self.total_frames:
            window, _ = self._collect_window()
            batch = window.transitions(self.compact_obs)
            batch["collector"] = TensorDict({"traj_ids": self._trajectories(window)}, batch_size=batch.batch_size)
            batch = batch if self.return_same_td else batch.clone()
            if self.post_collect_hook is not None:
                self.post_collect_hook(batch)
            yield batch

    @torch.no_grad()
    def _collect_window(self) -> tuple[Window, TensorDict]:
        """Act the steps of one window; returns it and the recurrent state before its first step."""
        if self.closed:
            raise RuntimeError("the collector has been shut down: make a new one")
        if self.pre_collect_hook is not None:
            self.pre_collect_hook()
        first_window = self._acted == 0
        window = self._look()
        window.begin(carry_context=not first_window)
        self._endings.clear()
        first = 0 if first_window else self._context
        began_with = {key: value for key, value in (self._obs or {}).items() if key != "pixels"}
        random = self._frames < self.init_random_frames
        with set_exploration_type(self.exploration_type):
            for step in range(first, window.length):
                self._advance(window, step, random)
        window.finish(first, began_with)
        for steps, rows, frames in self._endings.draw():
            window.write_final_frames(steps, rows, self._compressed(frames))
        self._frames += self._num_envs * self._steps
        self._iter += 1
        return window, self._window_starts.popleft()

    def _look(self) -> Window:
        """Have a current observation and a place to store it, whatever happened to the env since the last window."""
        if self._obs is None:
            self._observe(self.env.reset())
            self._state = self._actor.initial_state(self._num_envs)
            self._window_starts.clear()
        elif self.env.generation != self._generation:
            self._observe(self.env.observe())
        assert self._obs is not None
        if self._window is None:
            shape = self._obs["pixels"].shape[1:]
            task = self.env.task if self.env.task_in_td else None
            self._window = Window(self._num_envs, self._context, self._steps, shape, self.env.device, task)
        return self._window

    def _observe(self, root: TensorDictBase) -> None:
        """Take over a root tensordict as what is acted on next."""
        self._obs = {key: root[key] for key in ROOT_KEYS if key in root}
        self._obs["pixels"] = self._compressed(self._obs["pixels"])
        self._generation = self.env.generation

    def _compressed(self, frames: torch.Tensor) -> torch.Tensor:
        return frames if self._compress is None else self._compress(frames)

    def _advance(self, window: Window, step: int, random: bool) -> None:
        """Act, step and store; the frame is copied to the storage while JAX computes the step."""
        obs, state = self._obs, self._state
        assert obs is not None
        if self._acted % self._steps == 0:
            self._window_starts.append(state.clone())
        action, extras, self._state = self._act(obs, state, random)
        raw = self.env.step_raw(action, meanwhile=functools.partial(window.write_action, step, obs["pixels"], action))
        window.write_outcome(step, raw.step.numbers)
        window.write_extras(step, extras)
        frames = self._compressed(raw.pixels)
        if step == window.length - 1:
            window.write_tail(frames)
        if raw.any_done and self._final_frames != "none":
            self._keep_final_states(step, raw)
        self._acted += 1
        self._obs = self._root_of(raw, action, ROOT_KEYS if step == window.length - 1 else self._reads)
        self._obs["pixels"] = frames

    def _root_of(self, raw: RawStep, action: torch.Tensor, keys: tuple[str, ...]) -> dict[str, torch.Tensor]:
        """What follows a step, without the frames; of the rest only what is asked for."""
        device, root, out = self.env.device, raw.step.root, {}
        if "last_action" in keys:
            out["last_action"] = action.to(torch.int64, copy=True)
        if "is_init" in keys:
            out["is_init"] = to_torch(raw.step.outcome.done, device).unsqueeze(-1)
        if "step_count" in keys:
            out["step_count"] = to_torch(root.step_count, device).to(torch.int64).unsqueeze(-1)
        if "episode_reward" in keys:
            out["episode_reward"] = to_torch(root.episode_reward, device).clone().unsqueeze(-1)
        if "task" in keys and self.env.task_in_td:
            out["task"] = self.env.task
        return out

    def _act(
        self, obs: dict[str, torch.Tensor], state: TensorDict, random: bool
    ) -> tuple[torch.Tensor, Extras, TensorDict]:
        root = TensorDict(obs, batch_size=[self._num_envs])
        action, extras, state = self._actor.act(root, state)
        if random:
            action = self._random.draw(self._num_envs)
        return action, extras, state

    def _keep_final_states(self, step: int, raw: RawStep) -> None:
        """Keep the final states whose frames are wanted."""
        outcome = raw.step.outcome
        wanted = np.asarray(outcome.done)
        if self._final_frames == "truncated":
            wanted = np.asarray(outcome.truncated) & ~np.asarray(outcome.terminated)
        if wanted.any():
            self._endings.add(step, np.flatnonzero(wanted), raw.step)

    def _trajectories(self, window: Window) -> torch.Tensor:
        """Episode numbers int64 [N, T] of the new steps, as TorchRL's collectors count them."""
        done = window.done[:, window.context :].T  # [T, N]: numbered in order of time
        new = torch.cumsum(done.reshape(-1), 0).reshape(done.shape) - 1 + self._next_traj_id
        ids = torch.cat([self._traj_ids.unsqueeze(0), new * done]).cummax(0).values
        self._traj_ids = ids[-1].clone()
        self._next_traj_id += int(done.sum())
        return ids[:-1].T

    # -- TorchRL's collector protocol -------------------------------------------------------------------------------

    def set_seed(self, seed: int, static_seed: bool = False) -> int:
        """Seed env and random actions, and start over with new episodes.

        Args:
            seed: The seed.
            static_seed: Whether the seed is returned as it is.

        Returns:
            A seed for whatever is made next.
        """
        following: int = self.env.set_seed(seed, static_seed=static_seed)
        self._generator.manual_seed(seed)
        self._start_over()
        return following

    def reset(self) -> None:
        """Start over with new episodes."""
        self._start_over()

    def _maybe_fallback_update(self, policy_or_weights: Any = None, *, model_id: str | None = None) -> None:
        """Weights are live, since the policy is shared; only other weights have to be copied."""
        if policy_or_weights is None or policy_or_weights is self.policy:
            return
        if not isinstance(self.policy, nn.Module):
            raise TypeError(f"the policy is a {type(self.policy).__name__}, which has no weights to update")
        weights = policy_or_weights
        if isinstance(weights, nn.Module):
            weights = TensorDict.from_module(weights)
        elif isinstance(weights, dict):
            weights = TensorDict(weights, []).unflatten_keys(".")
        TensorDict.from_module(self.policy).data.update_(weights.data)

    def state_dict(self) -> OrderedDict[str, Any]:
        """Everything that determines the coming batches: env, recurrent state, context, counters, policy weights.

        Only tensors, numbers, strings and containers, so that ``torch.load(weights_only=True)`` reads it. Random
        numbers that a policy draws from torch's global generator are the caller's to save.
        """
        out: OrderedDict[str, Any] = OrderedDict(frames=self._frames, iter=self._iter, acted=self._acted)
        out["sizes"] = [self._num_envs, self._steps, self._context]
        out["generator"] = self._generator.get_state()
        if isinstance(self.policy, nn.Module):
            out["policy_state_dict"] = self.policy.state_dict()
        if self._obs is None:
            out["env_state_dict"] = self.env.get_state().to_dict()
            return out
        assert self._window is not None
        out["env_state_dict"] = self.env.get_state().to_dict()
        out["recurrent_state"] = self._state.clone().to_dict()
        out["window_starts"] = [state.clone().to_dict() for state in self._window_starts]
        out["context"] = self._window.context_state()
        out["traj_ids"], out["next_traj_id"] = self._traj_ids.clone(), self._next_traj_id
        return out

    def load_state_dict(self, state_dict: dict[str, Any], strict: bool = True, **kwargs: Any) -> None:
        """Go on where ``state_dict`` was taken: the next batch is the one that would have come then.

        Args:
            state_dict: What ``state_dict`` gave for a collector of the same sizes.
            strict: Whether the policy's weights must all be there.
            **kwargs: Ignored.

        Raises:
            ValueError: It is of a collector with other sizes, or of another game.
        """
        sizes = [self._num_envs, self._steps, self._context]
        if list(state_dict["sizes"]) != sizes:
            raise ValueError(
                f"the saved collector has (envs, steps, context) {list(state_dict['sizes'])}, this one has {sizes}"
            )
        self.env.set_state(TensorDict(state_dict["env_state_dict"], batch_size=[self._num_envs]))
        if isinstance(self.policy, nn.Module) and (strict or "policy_state_dict" in state_dict):
            self.policy.load_state_dict(state_dict["policy_state_dict"], strict=strict)
        self._generator.set_state(state_dict["generator"].cpu())
        self._start_over()
        self._frames, self._iter = int(state_dict["frames"]), int(state_dict["iter"])
        self._acted = int(state_dict["acted"])
        if "recurrent_state" not in state_dict:
            return
        self._actor.initial_state(self._num_envs)
        self._state = self._as_state(state_dict["recurrent_state"])
        self._window_starts.extend(self._as_state(state) for state in state_dict["window_starts"])
        self._traj_ids = state_dict["traj_ids"].to(self.env.device)
        self._next_traj_id = int(state_dict["next_traj_id"])
        self._observe(self.env.observe())
        self._look().load_context_state(state_dict["context"])

    def _as_state(self, state: dict[str, Any]) -> TensorDict:
        return TensorDict(state, batch_size=[self._num_envs]).to(self.env.device)

    def shutdown(self, timeout: float | None = None, close_env: bool = True, raise_on_error: bool = True) -> None:
        """Give the storage back and close the env.

        Args:
            timeout: Ignored, there is no other process.
            close_env: Whether the env is closed too.
            raise_on_error: Ignored.
        """
        self.closed = True
        self._window = self._obs = None
        if close_env and not self.env.is_closed:
            self.env.close()

    def __repr__(self) -> str:
        """Sizes and env."""
        sizes = f"envs={self._num_envs}, steps={self._steps}, context={self._context}"
        return f"ArcadeCollector({self.env.game!r}, {sizes})"


def _check_arguments(env: Any, policy: Any, frames_per_batch: int, context: int, final_frames: str) -> None:
    """Refuse what cannot work, before anything is allocated."""
    if not isinstance(env, ArcadeEnv):
        raise TypeError(f"env is a {type(env).__name__}, expected an ArcadeEnv; others go with torchrl's Collector")
    if env.one_hot:
        raise ValueError("ArcadeCollector stores actions as integers: make the env with categorical_actions=True")
    if policy is not None and not callable(policy) and not isinstance(policy, Actor):
        raise TypeError(
            f"policy is a {type(policy).__name__}, expected a TensorDictModule, an object with act and initial_state, "
            f"or None for random actions"
        )
    if frames_per_batch < env.num_envs or frames_per_batch % env.num_envs:
        raise ValueError(f"frames_per_batch is {frames_per_batch}, expected a multiple of num_envs ({env.num_envs})")
    if context < 0:
        raise ValueError(f"context is {context}, expected 0 or more")
    if final_frames not in _FINAL_FRAMES:
        raise ValueError(f"final_frames is {final_frames!r}, allowed: {', '.join(map(repr, _FINAL_FRAMES))}")
