"""``from_jax``: any JAX environment with gymnax's two functions, as a batch of TorchRL envs."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Categorical, Composite, TensorSpec, Unbounded

from arcade_torch import suite_actions, validation
from arcade_torch.base_env import BaseEnv
from arcade_torch.devices import pick_devices, wait_for_torch
from arcade_torch.dlpack import is_host, to_jax, to_torch
from arcade_torch.envs_jax.batch import choose_rows, env_keys
from arcade_torch.envs_jax.validation import check_num_envs
from arcade_torch.final_observations import KeptObservations
from arcade_torch.process import check_process
from arcade_torch.raw_step import Place, RawStep
from arcade_torch.snapshot import TreeSnapshots
from arcade_torch.suite import Outcome, Suite, name_of
from arcade_torch.suite_episodes import BatchedSuite, Episodes
from arcade_torch.suite_observations import leaf_names

__all__ = ["JaxEnv", "from_jax"]


class JaxEnv(BaseEnv):
    """N episodes of one JAX environment, as a TorchRL environment with ``batch_size=[N]``; made by
    :func:`from_jax`.

    Every key of the root and of ``"next"``: the observation (one array under ``obs_key``, a tree of
    arrays under the names that it has), ``last_action`` [N, ...], ``is_init`` bool [N, 1],
    ``step_count`` int64 [N, 1], ``episode_reward`` float32 [N, 1], ``done``, ``terminated``,
    ``truncated`` bool [N, 1]; ``"next"`` has ``reward`` float32 [N, 1] too. At an end the
    observation in ``"next"`` is the true final one, and the following root begins a new episode.

    Observations are the memory that JAX wrote: **never write to them in place**. Env ``i`` has
    random keys of its own, so that it walks the same path whatever N is. ``step_and_maybe_reset``,
    which ``rollout`` and TorchRL's ``Collector`` use, is one compiled call, and gives the bits of
    ``step`` and ``reset``. Envs that an entry ``_step`` (bool [N]) leaves out stay where they are:
    their ``"next"`` repeats the root, with the reward 0. One that has ended stays at its end until
    it is reset: a step gives its flags again, and the reward 0.
    """

    batch_locked = True

    def __init__(
        self,
        suite: Suite,
        num_envs: int,
        *,
        obs_key: str | None,
        action_spec: TensorSpec | None,
        seed: int | None,
        device: torch.device | str | None,
        debug: bool,
    ) -> None:
        check_process()
        num_envs = check_num_envs(num_envs)
        validation.check_flags("debug", (debug,))
        torch_device, jax_device = pick_devices(device)
        super().__init__(device=torch_device, batch_size=[num_envs])
        self.suite = suite
        self._jax_device = jax_device
        self._check_actions = debug or is_host(torch_device)
        self.action_spec = suite_actions.action_spec(suite, action_spec, num_envs, torch_device)
        one_action = suite_actions.action_of_one(self.action_spec)
        self._action_dtype = one_action.dtype
        suite.check(one_action)
        self._batched = BatchedSuite(suite, one_action)
        self._live: Episodes
        self._ends: torch.Tensor | None
        self._count = 0
        self._set_seed(seed)
        self._obs_names = leaf_names(self._live.obs, obs_key)
        self.observation_spec = self._observation_spec()
        self.reward_spec = Unbounded((num_envs, 1), dtype=torch.float32, device=torch_device)
        self.done_spec = Composite(
            done=self._flag(),
            terminated=self._flag(),
            truncated=self._flag(),
            shape=(num_envs,),
            device=torch_device,
        )
        self._snapshots = TreeSnapshots(
            self._live, num_envs, torch_device, jax_device, kind=f"a state of {name_of(suite.env)}"
        )

    @property
    def num_envs(self) -> int:
        """Number of envs in the batch."""
        return int(self.batch_size[0])

    @property
    def max_steps(self) -> int | None:
        """The time limit that is counted here; None where there is none, or the suite counts."""
        return self.suite.max_steps

    @property
    def least_steps_to_truncation(self) -> int:
        """So many steps of an env lie between two truncations at least."""
        return 1 if self.suite.truncates_itself else self.max_steps or 1

    def __repr__(self) -> str:
        """Env, number and device."""
        return (
            f"JaxEnv({name_of(self.suite.env)}, num_envs={self.num_envs}, device='{self.device}')"
        )

    def get_state(self) -> TensorDict:
        """Copy everything that determines the future.

        Returns:
            TensorDict [N] of plain tensors: keys, the env's state, observation, counts, and
            ``ends`` bool [N, 2], which episodes have terminated or been truncated.
        """
        state = self._snapshots.export(self._live)
        state["ends"] = self._ended()
        return state

    def set_state(self, state: TensorDictBase) -> TensorDict:
        """Go on from what ``get_state`` gave.

        Returns:
            The root tensordict to act on next; ``done`` is false everywhere.

        Raises:
            ValueError: The state of another env or batch size.
            TypeError: No tensordict.
        """
        self._go_on_from(state)
        return self._root()

    def get_extra_state(self) -> dict[str, Any]:
        """The env's part of ``state_dict``: its state, and which episodes have ended."""
        return dict(self.get_state().to_dict())

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Load the env's part of a ``state_dict``."""
        self._go_on_from(validation.saved_state(state, self.num_envs, self.device))

    # What an ArcadeCollector needs beside TorchRL's methods.

    @property
    def observation_keys(self) -> tuple[Any, ...]:
        """Keys of the observation, strings or tuples of strings."""
        return tuple(self._obs_names)

    @property
    def generation(self) -> tuple[int, int]:
        """How often the state has changed (by steps, resets, loads), so that a collector notices
        changes that it has not made; and 0, for there is no other view.
        """
        return self._count, 0

    def observe(self) -> TensorDict:
        """Show the live state.

        Returns:
            The root tensordict; ``done`` where an episode has ended and waits for a reset.
        """
        root = self._root()
        ends = self._ended().unsqueeze(-1)
        root["terminated"] = ends[:, 0]
        root["truncated"] = ends[:, 1]
        root["done"] = ends.any(1)
        return root

    def step_raw(
        self,
        action: torch.Tensor,
        while_computing: Callable[[], object] | None = None,
        into: Place | None = None,
    ) -> RawStep:
        """Step, and begin anew where an episode ended: one compiled call and no tensordict.

        Args:
            action: As ``action_spec`` has it; not read after the return.
            while_computing: Called while JAX computes, for work that needs no result of this step.
            into: None; only our own games are drawn into somebody's memory.

        Returns:
            The step.

        Raises:
            ValueError: Actions of a wrong shape or out of range.
        """
        live, final, numbers = self._batched.advance_and_pack(self._live, self._argument(action))
        if while_computing is not None:
            while_computing()
        self._go_on(live)
        return RawStep(self._observation(live.obs), to_torch(numbers, self.device), final)

    def draws_safely(self) -> bool:
        """Whether steps may draw into memory that tensors lie over: they may not."""
        return False

    def final_observations(self, max_steps: int) -> KeptObservations:
        """A store for the observations that steps led to, before the resets."""
        return KeptObservations(self._obs_names)

    def _observation_spec(self) -> Composite:
        """The spec of everything but action, reward and ends."""
        shape = (self.num_envs, 1)
        spec = Composite(shape=(self.num_envs,), device=self.device)
        for name, leaf in zip(self._obs_names, jax.tree.leaves(self._live.obs), strict=True):
            value = to_torch(leaf, self.device)
            if value.dtype is torch.bool:
                spec[name] = Categorical(2, shape=value.shape, dtype=torch.bool, device=self.device)
            else:
                spec[name] = Unbounded(value.shape, dtype=value.dtype, device=self.device)
        spec["last_action"] = self.action_spec.clone()
        spec["is_init"] = self._flag()
        spec["step_count"] = Unbounded(shape, dtype=torch.int64, device=self.device)
        spec["episode_reward"] = Unbounded(shape, dtype=torch.float32, device=self.device)
        return spec

    def _flag(self) -> Categorical:
        return Categorical(2, shape=(self.num_envs, 1), dtype=torch.bool, device=self.device)

    def _set_seed(self, seed: int | None) -> None:
        """Draw all episodes anew."""
        if seed is None:
            seed = int(torch.randint(2**32, (), device="cpu"))
        wait_for_torch(self.device, self._jax_device)
        with jax.default_device(self._jax_device):  # on another GPU than the first one, too
            keys = jax.device_put(env_keys(seed, self.num_envs), self._jax_device)
            self._go_on(self._batched.begin(keys))

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDict:
        check_process()
        rows = np.ones(self.num_envs, np.bool_)
        if tensordict is not None and "_reset" in tensordict:
            rows = validation.mask(tensordict, "_reset", self.num_envs).cpu().numpy()
        wait_for_torch(self.device, self._jax_device)
        ends = None if rows.all() else self._ends
        if ends is not None:
            ends = ends & ~torch.from_numpy(rows).to(self.device).unsqueeze(-1)
        self._go_on(self._batched.begin_anew(self._live, rows), ends)
        if tensordict is None or rows.all():
            return self._root()
        root = self.observe()
        validation.fill_up(tensordict, root)
        return root

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = validation.tensor(tensordict, "action")
        after, outcome = self._batched.advance(self._live, self._argument(action))
        if self._waits_for_reset():
            after, outcome = self._stay_at_ends(after, outcome)
        following: TensorDictBase = self._next(after, outcome, action)
        ends = torch.cat([following["terminated"], following["truncated"]], dim=1)
        if "_step" in tensordict:
            marked = validation.mask(tensordict, "_step", self.num_envs)
            validation.check_merge(tensordict, following)
            if validation.lacks_entries(tensordict, following):
                validation.fill_up(tensordict, self.observe())
            rows = jax.device_put(marked.cpu().numpy(), self._jax_device)
            after = choose_rows(rows, after, self._live)
            following = validation.only_marked(tensordict, following, marked)
            ends = torch.where(marked.reshape(-1, 1), ends, self._ended())
        self._go_on(after, ends)
        return following

    def _step_and_maybe_reset(
        self, tensordict: TensorDictBase
    ) -> tuple[TensorDictBase, TensorDictBase]:
        self._assert_tensordict_shape(tensordict)
        is_partial = "_step" in tensordict
        if is_partial or self._post_step_mdp_hooks is not None or self._waits_for_reset():
            stock: tuple[TensorDictBase, TensorDictBase] = super()._step_and_maybe_reset(tensordict)
            if not is_partial:
                self.__dict__["_ends"] = None  # whatever had ended has begun anew
            return stock
        action = validation.tensor(tensordict, "action")
        argument = self._argument(action)
        live, after, outcome = self._batched.advance_and_begin_anew(self._live, argument)
        self._go_on(live)
        following = self._next(after, outcome, action)
        validation.keep_what_was_written(tensordict, following)
        tensordict.set("next", following)
        root: TensorDictBase = self._step_mdp(tensordict)
        root.update(self._root())
        return tensordict, root

    def _assert_tensordict_shape(self, tensordict: TensorDictBase) -> None:
        validation.check_tensordict(tensordict, self.num_envs)

    def _argument(self, action: torch.Tensor) -> np.ndarray | jax.Array:
        """A private copy of the actions for a compiled function, checked; the process too."""
        check_process()
        suite_actions.check_action(action, self.action_spec, self._check_actions)
        dtype = torch.int32 if self._action_dtype == np.int32 else torch.float32
        if is_host(self._jax_device):
            return action.detach().to("cpu", dtype, copy=True).numpy()
        return to_jax(action.detach().to(dtype, copy=True))

    def _go_on(self, live: Episodes, ends: torch.Tensor | None = None) -> None:
        """Put another state in place, all at once.

        Args:
            live: The episodes.
            ends: bool [N, 2], where they have terminated or been truncated and wait for a reset;
                None: nowhere.
        """
        # ``nn.Module`` sets attributes slowly, and one by one
        self.__dict__.update(_live=live, _ends=ends, _count=self._count + 1)

    def _go_on_from(self, state: TensorDictBase) -> None:
        """Put a snapshot in place."""
        live = self._snapshots.load(state)
        self._go_on(live, validation.saved_ends(state, self.num_envs, self.device))

    def _ended(self) -> torch.Tensor:
        """bool [N, 2], where episodes have terminated or been truncated and wait for a reset."""
        if self._ends is not None:
            return self._ends.clone()
        return torch.zeros(self.num_envs, 2, dtype=torch.bool, device=self.device)

    def _waits_for_reset(self) -> bool:
        """Whether an episode may have ended that was not reset; on a GPU nobody waits to see."""
        return self._ends is not None and (not is_host(self.device) or bool(self._ends.any()))

    def _stay_at_ends(self, after: Episodes, outcome: Outcome) -> tuple[Episodes, Outcome]:
        """Take a step back where an episode had ended before it: there the flags are those of the
        end, and the reward is 0.
        """
        ends = self._ended()
        ended = jax.device_put(ends.any(1).cpu().numpy(), self._jax_device)
        terminated, truncated = jax.device_put(ends.T.cpu().numpy(), self._jax_device)
        at_end = Outcome(jnp.zeros_like(outcome.reward), terminated, truncated)
        stays: tuple[Episodes, Outcome] = choose_rows(ended, (self._live, at_end), (after, outcome))
        return stays

    def _root(self) -> TensorDict:
        """The root tensordict of the live episodes."""
        last_action = to_torch(self._live.last_action, self.device)
        no = torch.zeros(self.num_envs, 1, dtype=torch.bool, device=self.device)
        return self._tensordict(self._entries(self._live, last_action, no, no.clone()))

    def _next(self, after: Episodes, outcome: Outcome, action: torch.Tensor) -> TensorDict:
        """The ``"next"`` tensordict."""
        last_action = suite_actions.as_got(action)
        terminated = to_torch(outcome.terminated, self.device).unsqueeze(-1).clone()
        truncated = to_torch(outcome.truncated, self.device).unsqueeze(-1).clone()
        entries = self._entries(after, last_action, terminated, truncated)
        entries["reward"] = to_torch(outcome.reward, self.device).clone().unsqueeze(-1)
        return self._tensordict(entries)

    def _entries(
        self,
        episodes: Episodes,
        last_action: torch.Tensor,
        terminated: torch.Tensor,
        truncated: torch.Tensor,
    ) -> dict[Any, torch.Tensor]:
        """The entries that root and ``"next"`` have in common; the flags are bool [N, 1]."""
        step_count = to_torch(episodes.step_count, self.device).to(torch.int64).unsqueeze(-1)
        episode_reward = to_torch(episodes.episode_reward, self.device).clone().unsqueeze(-1)
        entries = self._observation(episodes.obs)
        entries["last_action"] = last_action.to(self.action_spec.dtype, copy=True)
        entries["is_init"] = step_count == 0
        entries["step_count"] = step_count
        entries["episode_reward"] = episode_reward
        entries["done"] = terminated | truncated
        entries["terminated"] = terminated
        entries["truncated"] = truncated
        return entries

    def _observation(self, obs: Any) -> dict[Any, torch.Tensor]:
        """An observation by name, zero copy."""
        entries = {}
        for name, leaf in zip(self._obs_names, jax.tree.leaves(obs), strict=True):
            entries[name] = to_torch(leaf, self.device)
        return entries

    def _tensordict(self, entries: dict[Any, torch.Tensor]) -> TensorDict:
        """Entries as a tensordict [N]; names may be nested."""
        if all(isinstance(name, str) for name in entries):
            return TensorDict._new_unsafe(entries, batch_size=self.batch_size, device=self.device)
        td = TensorDict({}, batch_size=self.batch_size, device=self.device)
        for name, value in entries.items():
            td.set(name, value)
        return td


def from_jax(
    env: Any,
    params: Any = None,
    num_envs: int = 16,
    *,
    max_steps: int | None = None,
    obs_key: str | None = None,
    action_spec: TensorSpec | None = None,
    seed: int | None = 0,
    device: torch.device | str | None = None,
    debug: bool = False,
) -> JaxEnv:
    """See a JAX environment as a batch of TorchRL envs: stepped on the device, reset where an
    episode ends, observations handed over without a copy.

    It has to have gymnax's two functions, pure and without a batch: ``reset_env(key, params) ->
    (obs, state)`` and ``step_env(key, state, action, params) -> (obs, state, reward, done, info)``,
    or ``reset`` and ``step`` that begin no episodes by themselves. ``terminated, truncated`` may
    stand in the place of ``done``; gymnax's ``is_truncated`` is asked where it exists.

    Args:
        env: The environment.
        params: Its parameters; None for ``env.default_params``, or for functions without the last
            argument where there are none.
        num_envs: Number of envs in the batch.
        max_steps: Time limit in steps: there an episode is truncated. Give it for an env that only
            knows ``done`` and counts itself, or its limits look like terminations. None: what the
            params say (``max_steps_in_episode``, ``max_timesteps``), or no limit.
        obs_key: Key of one array; None: ``"pixels"`` for uint8 [H, W, C], else ``"observation"``.
        action_spec: Spec of the actions [num_envs, ...]; None: from ``env.action_space``.
        seed: Seed of the batch; None draws one from torch.
        device: Device of all tensors; None for the one that JAX computes on.
        debug: Whether actions are checked on CUDA too.

    Returns:
        The env, for TorchRL's transforms and collectors, and for ``ArcadeCollector``.

    Raises:
        TypeError: The env lacks a function, or one gives something else.
        ValueError: A size out of range, an unknown action space, an observation with a name of the
            env's own keys; or functions that are not pure, or that give other arrays each.

    Example:
        >>> class Count:  # any object with the two functions
        ...     def reset(self, key):
        ...         return jnp.zeros(1), jnp.int32(0)
        ...     def step(self, key, state, action):
        ...         return jnp.ones(1) * state, state + 1, action * 1.0, state >= 2, {}
        >>> env = from_jax(Count(), num_envs=1, action_spec=Categorical(3, shape=(1,)))
        >>> env.rollout(4, break_when_any_done=False)["next", "done"].flatten().tolist()
        [False, False, True, False]
    """
    return JaxEnv(
        Suite(env, params, max_steps),
        num_envs,
        obs_key=obs_key,
        action_spec=action_spec,
        seed=seed,
        device=device,
        debug=debug,
    )
