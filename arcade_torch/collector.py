"""``ArcadeCollector``: windows of experience from one env, every observation written once."""

import functools
from collections import OrderedDict, deque
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import nullcontext
from typing import Any

import numpy as np
import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import nn
from torchrl.collectors import BaseCollector
from torchrl.envs.utils import ExplorationType, exploration_type, set_exploration_type
from torchrl.modules import set_recurrent_mode

from arcade_torch.collector_arguments import check_arguments, check_options, check_random_frames
from arcade_torch.compiled import TERMINATED, TRUNCATED
from arcade_torch.dlpack import is_host, to_torch
from arcade_torch.env import ArcadeEnv
from arcade_torch.envs_jax.validation import kind_of, plain
from arcade_torch.jax_env import JaxEnv
from arcade_torch.policies import (
    ROOT_KEYS,
    Policy,
    PolicyRunner,
    copy_weights,
    random_actions,
)
from arcade_torch.process import warn
from arcade_torch.raw_step import RawStep
from arcade_torch.rollout_buffer import Entry, FinalFrames, RolloutBuffer
from arcade_torch.suite_actions import as_got
from arcade_torch.validation import check_flags, whole


class ArcadeCollector(BaseCollector):
    """Collects windows of T steps from N envs.

    Two products. ``collect()`` gives **sequences**: TensorDict [N] of entries [N, L, ...] with L =
    overlap + T, and the recurrent state before index 0 (``initial_state``). **Iteration** gives the
    T new steps in the layout of TorchRL's collectors, TensorDict [N, T], so that TorchRL's losses
    and trainers take it. Both are the data that ``env.rollout`` and TorchRL's ``Collector`` give,
    to the bit; only ``state`` (of an env with ``state_in_td=True``) is left out.

    The first window acts ``overlap`` more steps, to fill the overlap; they are not counted as
    frames. The same happens after somebody else stepped, reset or loaded the env: no window holds
    steps from both sides of such a change, and the policy's state begins anew there, as do the
    episodes that had ended.

    Args:
        env: An ``ArcadeEnv``, or the env of another suite that ``from_jax`` gave; not wrapped
            (TorchRL's ``Collector`` is for transformed envs). Where "frames" and ``pixels`` stand
            in the following, of another suite's env its observation is meant, under its own keys.
        policy: A TensorDict module or a callable that reads root keys and writes ``action``; None
            for random actions. Its recurrent state (primers of ``make_tensordict_primer``) is
            carried from ``("next", key)`` to ``key``. A module that reads ``is_init`` begins anew
            by itself; for others the primers' values are put back. What it writes to the root is
            there at its next step too.
        frames_per_batch: N * T.
        total_frames: Iteration ends after so many frames; -1 for never. ``collect`` does not look
            at it.
        overlap: Steps of the previous window that stand in front of ``collect``'s sequences. Their
            ``initial_state`` is the one that was theirs when they were acted. What is written to a
            batch in place does not come back in them, but for frames, which are not copied twice.
        compress: uint8 [N, S, S, 3] -> uint8 [N, ...], what is stored of a frame. The policy sees
            the compressed frame too, so that acting and learning see the same. For envs that
            observe one array.
        final_frames: Which final frames are drawn: ``"all"``, and batches hold dense ``("next",
            "pixels")``; those of steps that were ``"truncated"`` and not terminated (a bootstrap
            needs no others), as ``final_pixels`` of sequences; or ``"none"``. Iterated batches hold
            next frames with ``"all"`` alone.
        init_random_frames: Act at random for so many frames; the policy still runs, for its state.
        seed: Seed of env and random actions; None leaves the env as it is.
        return_same_td: Whether all batches share one storage, so that a batch is overwritten by the
            next one: half the memory, for loops that are done with a batch before the next one is
            collected.
        compact_obs: Leave ``("next", "pixels")`` out of iterated batches.
        store: Keys to store beside the standard ones (a prefix stands for all below it); None for
            everything that the policy writes, but for private names such as ``_ou_steps``.
        store_states: Whether batches hold a policy's recurrent state at every step, as TorchRL's
            losses expect. Turn it off for large states.
        exploration_type: As in TorchRL's collectors.
        post_collect_hook: Called with every iterated batch.

    Raises:
        TypeError: ``env`` is neither an ``ArcadeEnv`` nor a ``JaxEnv``, or ``policy`` nothing that
            can act.
        ValueError: Sizes that do not fit, an unknown choice, or two memories under one state key.

    Example:
        >>> from arcade_torch import make
        >>> env = make("CartPoleEasy", num_envs=2)
        >>> collector = ArcadeCollector(env, None, frames_per_batch=8, total_frames=16)
        >>> [tuple(batch.shape) for batch in collector]
        [(2, 4), (2, 4)]
    """

    def __init__(
        self,
        env: ArcadeEnv | JaxEnv,
        policy: Policy | None = None,
        frames_per_batch: int = 2048,
        total_frames: int = -1,
        *,
        overlap: int = 0,
        compress: Callable[[torch.Tensor], torch.Tensor] | None = None,
        final_frames: FinalFrames = "all",
        init_random_frames: int = 0,
        seed: int | None = None,
        return_same_td: bool = False,
        compact_obs: bool = False,
        store: Iterable[NestedKey] | None = None,
        store_states: bool = True,
        exploration_type: ExplorationType = ExplorationType.RANDOM,
        post_collect_hook: Callable[[TensorDictBase], None] | None = None,
    ) -> None:
        check_options(exploration_type, store, compress, post_collect_hook)
        super().__init__(post_collect_hook=post_collect_hook)
        frames_per_batch = whole("frames_per_batch", frames_per_batch)
        total_frames = whole("total_frames", total_frames)
        overlap = whole("overlap", overlap)
        seed = None if seed is None else whole("seed", seed)
        check_flags(
            "return_same_td compact_obs store_states", (return_same_td, compact_obs, store_states)
        )
        check_arguments(env, policy, frames_per_batch, overlap, final_frames, compress)
        self.env: ArcadeEnv | JaxEnv = env
        self.policy = policy
        self.frames_per_batch = frames_per_batch
        self.requested_frames_per_batch = frames_per_batch
        self.total_frames = float("inf") if total_frames < 0 else total_frames
        self.init_random_frames = check_random_frames(init_random_frames)
        self.return_same_td = return_same_td
        self.compact_obs = compact_obs
        self.exploration_type = exploration_type
        self.closed = False
        self._weight_updater = None
        self._weight_sync_schemes: dict[str, Any] | None = None
        self._num_envs = env.num_envs
        self._steps = frames_per_batch // env.num_envs
        self._overlap = overlap
        self._compress = compress
        self._final_frames = final_frames
        self._draws_in_place = compress is None and env.draws_safely()
        self._generator = torch.Generator(env.device)
        self._generator.manual_seed(int(torch.randint(2**31, (), device="cpu")))
        self._finals = env.final_observations(self._overlap + self._steps)
        self._runner = PolicyRunner(
            policy, env.num_envs, env.device, env.observation_keys, store, store_states
        )
        self._buffer: RolloutBuffer | None = None
        self._frames = 0
        self._iter = -1
        self._next_traj_id = 0
        self._gave_numbers = False  # to batches that somebody may hold
        self.reset()
        if seed is not None:
            self.set_seed(seed)

    def reset(self) -> None:
        """Start over: the next window begins with new episodes, which get new numbers."""
        self._obs: dict[NestedKey, torch.Tensor] | None = None
        self._seen = (-1, -1)  # the env's generation that the observation is of
        self._acted = 0  # steps since the first reset
        self._state = TensorDict({}, batch_size=[self._num_envs])
        # recurrent states before the coming windows
        self._window_starts: deque[TensorDict] = deque()
        self._begin_trajectories()

    @property
    def frames(self) -> int:
        """Env steps collected so far, without those that filled the first overlap."""
        return self._frames

    def collect(self, random: bool = False) -> TensorDict:
        """Collect one window.

        Args:
            random: Act uniformly at random; the policy still runs, for its state.

        Returns:
            TensorDict [N]: ``pixels`` uint8 [N, L, ...], ``action`` and ``last_action`` int64 [N,
            L], ``is_init`` bool, ``step_count`` int64, ``episode_reward`` float32 [N, L, 1], what
            the policy wrote [N, L, ...], ``("next", ...)`` with reward, done, terminated,
            truncated, step_count and episode_reward [N, L, 1], and ``initial_state`` TensorDict
            [N], the policy's recurrent state before step 0 under the policy's own keys.

            The observations that follow a step: with ``final_frames="all"`` dense ``("next",
            "pixels")`` [N, L, ...]. Otherwise they are the ``pixels`` at the following index but
            for K places an env: ``final_pixels`` uint8 [N, K, ...], ``final_index`` int64 [N, K],
            the step in [0, L) after which each was seen, ascending where ``final_mask`` bool [N, K]
            is true; unused places say L - 1 and hold any frame. The last place is that of step L -
            1, unused where that step terminated; the others are those of steps that were truncated
            and not terminated, and L - 1 steps hold ``ceil((L - 1) / max_steps)`` of them at most.
            With ``"none"`` there is the last place alone, unused where the last step ended its
            episode.

        Raises:
            RuntimeError: The collector has been shut down, or a game truncated before its time
                limit.
        """
        buffer, initial_state = self._collect_window(random, dense=self._final_frames == "all")
        return buffer.sequences(initial_state)

    def iterator(self) -> Iterator[TensorDictBase]:
        """Yield TensorDict [N, T] in TorchRL's layout until ``total_frames`` have been
        collected.
        """
        while self._frames < self.total_frames:
            compact = self.compact_obs or self._final_frames != "all"
            buffer, _ = self._collect_window(random=False, dense=not compact)
            batch = buffer.transitions(compact)
            batch["collector", "traj_ids"] = self._trajectories(buffer)
            if self.post_collect_hook is not None:
                self.post_collect_hook(batch)
            self._numbered = self._iter  # a window that a hook refused was not
            self._gave_numbers = True
            yield batch

    @torch.no_grad()
    def _collect_window(self, random: bool, dense: bool) -> tuple[RolloutBuffer, TensorDict]:
        """Act the steps of one window; returns its storage, and the recurrent state before its
        first step.
        """
        if self.closed:
            raise RuntimeError("the collector has been shut down: make a new one")
        if self.pre_collect_hook is not None:
            self.pre_collect_hook()
        buffer, obs = self._look()
        first_window = self._acted == 0
        # Taken away until the window is whole: whatever ends it early, the next one begins with new
        # storage.
        self._seen = (-1, -1)  # first, for then it is known that the others are gone
        self._buffer = None
        self._obs = {}  # nothing holds the first frames
        first = buffer.begin(carry=not first_window, reuse=self.return_same_td, dense=dense)
        began_with = {key: value for key, value in obs.items() if key in ROOT_KEYS}
        random = random or self.policy is None or self._frames < self.init_random_frames
        # of the whole process: threads must not take turns
        as_wanted = exploration_type() is self.exploration_type
        exploring = nullcontext() if as_wanted else set_exploration_type(self.exploration_type)
        with exploring, set_recurrent_mode(False):  # whatever a memory's own default is
            for step in range(first, buffer.length):
                obs = self._advance(buffer, obs, step, random)
        last = {key: obs[key] for key in self.env.observation_keys}
        wanted = buffer.finish(began_with, last)
        self._write_finals(buffer, wanted)
        buffer.keep_overlap()
        initial_state = self._window_starts.popleft()
        self._frames += self._num_envs * self._steps
        self._iter += 1
        self._buffer = buffer
        self._obs = obs
        self._seen = self.env.generation
        return buffer, initial_state

    def _write_finals(self, buffer: RolloutBuffer, wanted: np.ndarray) -> None:
        """Draw the final observations of steps, bool [N, L], and store them."""
        for rows, steps, drawn, counting in self._finals.draw(wanted):
            final: dict[NestedKey, torch.Tensor] = {}
            for key, array in drawn.items():
                final[key] = to_torch(array, self.env.device)[counting]
            buffer.write_final(rows, steps, self._compressed(final))

    def _look(self) -> tuple[RolloutBuffer, dict[NestedKey, torch.Tensor]]:
        """Give the storage of the next window and the observation that it begins with, whatever
        happened to the env since the last one.
        """
        if self._obs is None:
            self._observe(self.env.reset())
        # somebody else moved the env: what was seen before leads nowhere
        elif self.env.generation[0] != self._seen[0]:
            self._acted = 0
            self._begin_trajectories()
            self._observe(self.env.maybe_reset(self.env.observe()))
        elif self.env.generation != self._seen:
            self._observe(self.env.observe())
        if self._acted == 0:
            self._state = self._runner.initial_state()
            self._window_starts.clear()
        assert self._obs is not None
        # there is none yet, or what it held was a window that was lost
        if self._buffer is None:
            self._buffer = self._new_buffer(self._obs)
        return self._buffer, self._obs

    def _new_buffer(self, obs: dict[NestedKey, torch.Tensor]) -> RolloutBuffer:
        """A place to store observations such as this one."""
        env = self.env
        observation = {}
        for key in env.observation_keys:
            observation[key] = Entry(tuple(obs[key].shape[1:]), obs[key].dtype)
        task = None
        if isinstance(env, ArcadeEnv):
            max_steps = min(game.max_steps for game in env.games)
            if env.task_in_td:
                task = env.task
        else:
            max_steps = env.least_steps_to_truncation
        return RolloutBuffer(
            self._num_envs,
            self._overlap,
            self._steps,
            observation=observation,
            action=Entry(tuple(env.action_spec.shape[1:]), env.action_spec.dtype),
            device=env.device,
            final_frames=self._final_frames,
            max_steps=max_steps,
            task=task,
        )

    def _observe(self, root: TensorDictBase) -> None:
        """Take over a root tensordict as what is acted on next."""
        self._obs = {key: root[key] for key in ROOT_KEYS if key in root}
        self._obs.update(self._compressed({key: root[key] for key in self.env.observation_keys}))
        self._seen = self.env.generation

    def _compressed(
        self, observation: dict[NestedKey, torch.Tensor]
    ) -> dict[NestedKey, torch.Tensor]:
        """An observation as it is stored."""
        if self._compress is None:
            return observation
        return {key: self._compress(frames) for key, frames in observation.items()}

    def _advance(
        self, buffer: RolloutBuffer, obs: dict[NestedKey, torch.Tensor], step: int, random: bool
    ) -> dict[NestedKey, torch.Tensor]:
        """Act, step and store; what is not drawn into the storage is copied while JAX computes the
        step.
        """
        if self._acted % self._steps == 0:
            self._window_starts.append(self._runner.begin_anew(self._state, obs["is_init"]).clone())
        action, extras, self._state = self._runner(obs, self._state)
        if random or action is None:
            action = random_actions(self.env.action_spec, self._generator)
            self._runner.show_action(action)
        store_action = functools.partial(buffer.write_action, step, obs, action)
        into = buffer.place(step + 1) if self._draws_in_place else None
        raw = self.env.step_raw(action, while_computing=store_action, into=into)
        buffer.write_outcome(step, raw.numbers)
        buffer.write_extras(step, extras)
        if self._final_frames != "none" and self._may_have_ended(raw.numbers):
            self._finals.add(step, raw.final)
        self._acted += 1
        # behind the last step all of it, for the next window begins there
        reads = ROOT_KEYS if step == buffer.length - 1 else self._runner.reads
        return self._following(raw, action, reads)

    def _following(
        self, raw: RawStep, action: torch.Tensor, reads: Collection[NestedKey]
    ) -> dict[NestedKey, torch.Tensor]:
        """What is acted on after a step: the observation, and of the other root keys those that are
        read.
        """
        following = dict(self._compressed(raw.observation))
        following.update(raw.root_numbers(reads))
        if "last_action" in reads:
            last_action = as_got(action)
            following["last_action"] = last_action.to(self.env.action_spec.dtype, copy=True)
        if "task" in reads and isinstance(self.env, ArcadeEnv) and self.env.task_in_td:
            following["task"] = self.env.task
        return following

    def _may_have_ended(self, numbers: torch.Tensor) -> bool:
        """Whether a final observation may be wanted. On a GPU nobody waits to see; on the CPU a
        look is free, and states that are kept scatter memory.
        """
        first = TERMINATED if self._final_frames == "all" else TRUNCATED
        return not is_host(numbers.device) or bool(numbers.numpy()[:, first:].any())

    def _begin_trajectories(self) -> None:
        """Give the episodes of all envs new numbers."""
        first = self._next_traj_id
        self._next_traj_id = first + self._num_envs
        self._traj_ids = torch.arange(
            first, self._next_traj_id, dtype=torch.int64, device=self.env.device
        )
        self._numbered = self._iter  # the last window whose episodes were numbered

    def _trajectories(self, buffer: RolloutBuffer) -> torch.Tensor:
        """Episode numbers int64 [N, T] of the new steps, as TorchRL's collectors count them.

        After windows that were not numbered (``collect``), all envs go on with new numbers.
        """
        if self._iter != self._numbered + 1:
            self._begin_trajectories()
        done = buffer.done[:, self._overlap :].T  # [T, N]: numbered in order of time
        new = torch.cumsum(done.reshape(-1), 0).reshape(done.shape) - 1 + self._next_traj_id
        ids = torch.cat([self._traj_ids.unsqueeze(0), new * done]).cummax(0).values
        self._traj_ids = ids[-1].clone()
        self._next_traj_id += int(done.sum())
        return ids[:-1].T.contiguous()

    def set_seed(self, seed: int, static_seed: bool = False) -> int:
        """Seed env and random actions, and start over with new episodes.

        Returns:
            A seed for whatever is made next; with ``static_seed`` the same one.
        """
        seed = plain(seed)
        following: int = self.env.set_seed(seed, static_seed=static_seed)
        self._generator.manual_seed(seed)
        self.reset()
        return following

    def _maybe_fallback_update(
        self, policy_or_weights: Any = None, *, model_id: str | None = None
    ) -> None:
        """Weights are live, since the policy is shared; only other weights have to be copied."""
        if policy_or_weights is None or policy_or_weights is self.policy:
            return
        if not isinstance(self.policy, nn.Module):
            raise TypeError(f"the policy is {kind_of(self.policy)}, which has no weights to update")
        copy_weights(self.policy, policy_or_weights)

    def state_dict(self) -> OrderedDict[str, Any]:
        """Everything that determines the coming batches: env, recurrent state, overlap, counters,
        policy weights.

        Only tensors, numbers, strings and containers, so that ``torch.load(weights_only=True)``
        reads it. Random numbers that a policy draws from torch's global generator are the caller's
        to save. After ``shutdown`` the episodes are gone, and a warning says so.
        """
        if self.closed:
            warn(
                "a state_dict behind shutdown() holds no episodes, so that new ones begin where it "
                "is loaded: take it before"
            )
        out: OrderedDict[str, Any] = OrderedDict(frames=self._frames, iter=self._iter)
        out["acted"] = self._acted
        # by somebody else since the last window: see _look
        out["moved"] = self.env.generation[0] != self._seen[0]
        out["sizes"] = [self._num_envs, self._steps, self._overlap]
        out["generator"] = self._generator.get_state()
        if isinstance(self.policy, nn.Module):
            out["policy_state_dict"] = self.policy.state_dict()
        out["env_state_dict"] = self.env.get_extra_state()
        out["traj_ids"] = self._traj_ids.clone()
        out["next_traj_id"] = self._next_traj_id
        out["numbered"] = self._numbered
        out["begun"] = self._obs is not None
        if self._obs is None or self._buffer is None:
            return out
        out["recurrent_state"] = self._state.clone().to_dict()
        out["left"] = self._runner.root_outputs()
        out["window_starts"] = [state.clone().to_dict() for state in self._window_starts]
        out["overlap"] = self._buffer.overlap_state()
        return out

    def load_state_dict(
        self, state_dict: dict[str, Any], strict: bool = True, **kwargs: Any
    ) -> None:
        """Go on where ``state_dict`` was taken: the next batch is the one that would have come
        then.

        Args:
            state_dict: What ``state_dict`` gave for a collector of the same sizes.
            strict: Whether the policy's weights must all be there.
            **kwargs: Ignored.

        Raises:
            ValueError: It is of another game, or of other sizes, or has an overlap with other
                ``final_frames``, or of a collector of TorchRL's.
        """
        if "sizes" not in state_dict:
            raise ValueError(
                "the state_dict is of no ArcadeCollector; of TorchRL's, load the weights alone: "
                "policy.load_state_dict(state_dict['policy_state_dict'])"
            )
        saved = list(state_dict["sizes"])
        sizes = [self._num_envs, self._steps, self._overlap]
        if saved != sizes:
            raise ValueError(
                f"the saved collector has (envs, steps, overlap) {saved}, this one has {sizes}"
            )
        self.env.set_extra_state(state_dict["env_state_dict"])
        if isinstance(self.policy, nn.Module) and (strict or "policy_state_dict" in state_dict):
            self.policy.load_state_dict(state_dict["policy_state_dict"], strict=strict)
        self._generator.set_state(state_dict["generator"].cpu())
        self.reset()
        self._frames = int(state_dict["frames"])
        self._iter = int(state_dict["iter"])
        self._load_trajectories(state_dict)
        if "recurrent_state" not in state_dict:
            # of a window that was lost: _look begins anew where the env is
            self._obs = {} if state_dict.get("begun", False) else None
            return
        self._load_windows(state_dict)

    def _load_trajectories(self, state_dict: dict[str, Any]) -> None:
        """Load the numbers of the episodes, unless batches that somebody may hold have them: this
        collector went on behind an older state, or the state is of a version that saved none.
        """
        saved_next = int(state_dict.get("next_traj_id", 0))
        are_taken = self._gave_numbers and self._next_traj_id > saved_next
        if "traj_ids" in state_dict and not are_taken:
            self._traj_ids = state_dict["traj_ids"].to(self.env.device)
            self._next_traj_id = saved_next
        self._numbered = int(state_dict.get("numbered", self._iter))

    def _load_windows(self, state_dict: dict[str, Any]) -> None:
        """Load what the coming windows go on with: observation, overlap, recurrent states."""
        initial = self._runner.initial_state()
        state = self._as_state(state_dict["recurrent_state"], initial)
        starts = [self._as_state(start, initial) for start in state_dict["window_starts"]]
        acted = int(state_dict["acted"])
        if acted and len(starts) != -(-self._overlap // self._steps):
            raise ValueError(
                f"the saved collector has {len(starts)} states before its coming windows"
            )
        # somebody may still hold batches of the old storage
        self._obs = {}
        self._buffer = None
        # where others had moved the env, _look begins anew
        moved = state_dict.get("moved", acted == 0)
        if not moved:
            self._observe(self.env.observe())
        self._look()[0].load_overlap_state(state_dict["overlap"])
        if moved:
            return
        # last, for an overlap that was refused is none to go on with
        self._acted = acted
        self._state = state
        self._runner.load_root_outputs(state_dict.get("left", {}))
        self._window_starts.extend(starts)

    def _as_state(self, state: dict[str, Any], initial: TensorDict) -> TensorDict:
        """A saved recurrent state; a ValueError if its entries are not those of the policy."""
        saved = TensorDict(state, batch_size=[self._num_envs]).to(self.env.device)
        if _layout(saved) != _layout(initial):
            raise ValueError("the saved recurrent state is not one of this policy")
        return saved

    def shutdown(
        self, timeout: float | None = None, close_env: bool = True, raise_on_error: bool = True
    ) -> None:
        """Give the storage back. The arguments are ignored: no process has to end, the env has
        nothing to close.
        """
        self.closed = True
        self._buffer = None
        self._obs = None

    def __repr__(self) -> str:
        """Sizes and env."""
        sizes = f"envs={self._num_envs}, steps={self._steps}, overlap={self._overlap}"
        played = self.env.game if isinstance(self.env, ArcadeEnv) else self.env
        return f"ArcadeCollector({played!r}, {sizes})"


def _layout(td: TensorDictBase) -> dict[NestedKey, tuple[torch.dtype, torch.Size]]:
    """Type and shape of every entry."""
    return {key: (value.dtype, value.shape) for key, value in td.items(True, True)}
