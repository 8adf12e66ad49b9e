"""``ArcadeEnv``: a batch of JAX games as one TorchRL environment whose frames are the memory that
JAX wrote.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, NoReturn

import jax
import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Composite

from arcade_torch import default_seeds, validation
from arcade_torch.base_env import BaseEnv
from arcade_torch.compiled import (
    EPISODE_REWARD,
    REWARD,
    STEP_COUNT,
    TERMINATED,
    CompiledGame,
    Ended,
)
from arcade_torch.devices import pick_devices, wait_for_torch
from arcade_torch.dlpack import int32_argument, is_host, to_torch
from arcade_torch.envs_jax.batch import Batch, choose_rows, env_keys
from arcade_torch.envs_jax.game import Game
from arcade_torch.envs_jax.mixture import MixedGames, Mixture
from arcade_torch.envs_jax.validation import (
    Observability,
    changed_flags,
    check_fits,
    check_num_envs,
    partial_flags,
    plain,
)
from arcade_torch.final_observations import FinalObservations
from arcade_torch.frame_memory import FrameMemory
from arcade_torch.process import check_process
from arcade_torch.raw_step import Place, RawStep
from arcade_torch.snapshot import Snapshots
from arcade_torch.specs import make_specs


class Live(NamedTuple):
    """Where the episodes are."""

    batch: Batch  # without flags of an end
    ended: Ended
    ends: torch.Tensor  # bool [N, 2], what a root says: where its last step terminated or truncated
    generation: int = 0  # changes of the state
    view: int = 0  # changes of the observability


_UNCHECKED = {"validated": True, "inplace": False, "non_blocking": False}
"""For ``TensorDict._set_str``: an entry that needs no check. ``set`` takes eight times as long."""


class ArcadeEnv(BaseEnv):
    """A batch of N episodes of one game or of several, as a TorchRL environment with
    ``batch_size=[N]``.

    Every key of the root and of ``"next"``: ``pixels`` uint8 [N, S, S, 3] (zero copy: **never write
    to it in place**), ``last_action`` int64 [N] (the action that led here; it survives an episode's
    end, and is 0 at the very first step), ``is_init`` bool [N, 1], ``step_count`` int64 [N, 1],
    ``episode_reward`` float32 [N, 1], ``done``, ``terminated``, ``truncated`` bool [N, 1];
    ``"next"`` has ``reward`` float32 [N, 1] too. ``("next", "pixels")`` at an end is the true final
    frame; the following root is the first frame of the new episode. With several games also
    ``task`` int64 [N]: which of ``games`` an env plays, at every step and in every episode the
    same.

    Envs that an entry ``_step`` (bool [N]) leaves out stay where they are: their ``"next"`` repeats
    the root, reward 0.

    ``step_and_maybe_reset`` (which ``rollout`` and ``Collector`` use) is one compiled call. Equal
    seeds and actions give equal bits, whatever N, and whichever path is taken.

    Threads may each step envs of their own at the same time; one env belongs to one thread at a
    time. Other processes have to be spawned: in one that was forked after this package was loaded
    and JAX had started, no env can be made.

    Args:
        game: A game, several as ``MixedGames``, or a compiled one (whose functions are then
            shared).
        num_envs: N.
        observability: ``"full"``, ``"partial"``, or bool [N], true = partial.
        seed: Seed of the batch; None draws one from torch.
        device: Device of all tensors; None for the device that JAX computes on.
        categorical_actions: Actions are int64 [N]; False: one-hot [N, num_actions].
        state_in_td: Adds ``state`` (what ``get_state`` gives) to the root and to ``"next"``, and
            makes every step start from the ``state`` it is handed, so that a planner can branch.
            The twin is the one that was set last; resets go on with the random keys of the last
            step, whichever branch that was on. ``FrameSkipTransform``, which steps from one
            tensordict again and again, repeats the first step there.
        task_in_td: Whether there is a key ``task``; None: if there are several games.
        debug: Whether actions are checked on CUDA too.

    Raises:
        ValueError: See ``make``.
        TypeError: See ``make``.
    """

    batch_locked = True
    _supports_set_state = True

    def __init__(
        self,
        game: Game[Any] | MixedGames | CompiledGame,
        num_envs: int = 16,
        observability: Observability = "full",
        *,
        seed: int | None = 0,
        device: torch.device | str | None = None,
        categorical_actions: bool = True,
        state_in_td: bool = False,
        task_in_td: bool | None = None,
        debug: bool = False,
    ) -> None:
        check_process()
        num_envs = check_num_envs(num_envs)
        flags_given = (categorical_actions, state_in_td, task_in_td, debug)
        validation.check_flags("categorical_actions state_in_td task_in_td debug", flags_given)
        flags = partial_flags(observability, num_envs)
        torch_device, jax_device = pick_devices(device)
        super().__init__(device=torch_device, batch_size=[num_envs])
        self._compiled = game if isinstance(game, CompiledGame) else CompiledGame(game)
        check_fits(num_envs, self._compiled.batched.game.obs_size)
        self._batched = self._compiled.batched
        self._jax_device = jax_device
        self._check_actions = debug or is_host(torch_device)
        self.one_hot = not categorical_actions
        self._state_in_td = state_in_td
        self._task = torch.from_numpy(self._batched.task(num_envs)).to(torch_device)
        self.task_in_td = len(self.games) > 1 if task_in_td is None else task_in_td
        self._no_ends = torch.zeros(num_envs, 2, dtype=torch.bool, device=torch_device)
        no = jax.device_put(np.zeros(num_envs, np.bool_), jax_device)
        self._none_ended: Ended = (no, no)
        self._live = Live(self._first_batch(flags), self._none_ended, self._no_ends)
        shape = (num_envs, self.game.obs_size, self.game.obs_size, 3)
        self._memory = FrameMemory(shape, jax_device)
        self._final_memory = FrameMemory(shape, jax_device)
        self._snapshots = Snapshots(self._batched, self._with_ends(), torch_device, jax_device)
        self._set_specs()
        self._begun = False
        self._set_seed(seed)

    @property
    def game(self) -> Game[Any] | Mixture:
        """The game that is played, or what the games have in common: id, limits of steps and
        returns, picture size.
        """
        return self._batched.game

    @property
    def games(self) -> tuple[Game[Any], ...]:
        """The games that are played, by task number."""
        return tuple(group.game for group in self._batched.groups)

    @property
    def task(self) -> torch.Tensor:
        """int64 [N], which of ``games`` each env plays. A copy."""
        return self._task.clone()

    @property
    def num_envs(self) -> int:
        """Number of envs in the batch."""
        return int(self.batch_size[0])

    @property
    def observability(self) -> torch.Tensor:
        """bool [N], true where the env shows its POMDP twin. A copy."""
        return to_torch(self._live.batch.partial, self.device).clone()

    def __repr__(self) -> str:
        """Game, number of envs, twin and device."""
        partial = self.observability
        twin = "full" if not partial.any() else "partial" if partial.all() else "mixed"
        device = str(self.device)
        return (
            f"ArcadeEnv({self.game.id}, num_envs={self.num_envs}, observability={twin!r}, "
            f"{device=})"
        )

    def to(self, device: torch.device | str) -> "ArcadeEnv":
        """The env itself: it stays on the device it was made for, and refuses any other
        (ValueError).
        """
        wanted = pick_devices(device)[0]
        if wanted != self.device:
            raise ValueError(
                f"this env stays on {self.device}, where it was made: make one with "
                f"device='{wanted}'"
            )
        return self

    def __reduce__(self) -> NoReturn:
        raise TypeError(
            "an ArcadeEnv cannot be copied or pickled: make a second one, and pass get_state() to "
            "its set_state(); workers take a function that makes one, such as "
            "functools.partial(arcade_torch.make, ...)"
        )

    def set_observability(self, observability: Observability) -> None:
        """Change which twin is shown, also in mid-episode; only the frames drawn from now on
        change.

        Args:
            observability: ``"full"``, ``"partial"``, or bool [N], true = partial.

        Raises:
            ValueError: Neither of the words, and not bools of that shape.
        """
        flags = changed_flags(observability, self.num_envs)
        wait_for_torch(self.device, self._jax_device)
        partial = jax.device_put(flags, self._jax_device)
        live = self._live
        self._live = live._replace(batch=live.batch._replace(partial=partial), view=live.view + 1)

    def get_state(self) -> TensorDict:
        """Copy everything that determines the future: game states, random keys, observability,
        counts.

        Returns:
            TensorDict [N]; plain tensors, safe to save, index, stack and hand to another env of the
            same game. Episodes that have ended stay so: a step gives their flags again and the
            reward 0, until they are reset.
        """
        return self._snapshots.export(self._with_ends())

    def set_state(self, state: TensorDictBase) -> TensorDict:
        """Go on from a snapshot.

        Args:
            state: What ``get_state`` gave, here or on another env of the same game with as many
                envs.

        Returns:
            The root tensordict of that state: what a policy acts on next. ``done`` is false
            everywhere.

        Raises:
            ValueError: The state of another game or batch size, or a broken one.
        """
        self._go_on_from(state)
        return self.observe()

    def observe(self) -> TensorDict:
        """Draw the live state.

        Returns:
            The root tensordict: what a policy acts on next; ``done`` where an episode has ended and
            waits for a reset, and nowhere until the first step behind ``set_state``.
        """
        wait_for_torch(self.device, self._jax_device)
        frames = to_torch(self._batched.render(self._with_ends()), self.device)
        return self._root(self._live.batch, self._live.ended, frames)

    def facts(self) -> TensorDict:
        """Name what the present states hold, whatever the frames show; see ``Game.facts``.

        Returns:
            TensorDict [N] of bool and integers (classes) and float32 (numbers), empty for games
            that name none. Tensors lie over memory that JAX wrote for them alone.

        Raises:
            ValueError: Several games that have no fact in common.
        """
        wait_for_torch(self.device, self._jax_device)
        facts = dict[str, torch.Tensor]()
        for name, values in self._batched.facts(self._with_ends()).items():
            facts[name] = to_torch(values, self.device)
        return TensorDict(facts, batch_size=self.batch_size, device=self.device)

    @property
    def generation(self) -> tuple[int, int]:
        """How often the state (by steps, resets, loads) and the observability have changed, so that
        a collector notices changes that it has not made.
        """
        return self._live.generation, self._live.view

    def get_extra_state(self) -> dict[str, Any]:
        """The env's part of ``state_dict``: its state, and which episodes have ended."""
        return {**self.get_state().to_dict(), "ends": self._live.ends.clone()}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Load the env's part of a ``state_dict``."""
        saved = validation.saved_state(state, self.num_envs, self.device).clone()
        self._go_on_from(saved, saved.get("ends", None))

    def step_raw(
        self,
        action: torch.Tensor,
        while_computing: Callable[[], object] | None = None,
        into: Place | None = None,
    ) -> RawStep:
        """Step, begin anew where an episode ended, and draw once: one compiled call and no
        tensordict.

        Args:
            action: Integers [N] in 0..4 (one-hot [N, 5] with ``categorical_actions=False``). Not
                read after the return.
            while_computing: Called while JAX computes, for work that needs no result of this step.
            into: Where to draw: a canvas, the index on its second axis, and the frames there; None:
                memory of the env.

        Returns:
            The step; export from it what is needed.

        Raises:
            TypeError: Actions that are not integers.
            ValueError: Actions of a wrong shape or out of range.
        """
        argument = int32_argument(self._integers(action), self._jax_device)
        batch = self._live.batch if self._live.ended is self._none_ended else self._with_ends()
        if into is None:
            step = self._compiled.step(batch, argument, self._memory.spare())
        else:
            canvas, index, frames = into
            step = self._compiled.step_into(canvas, index, batch, argument)
        if while_computing is not None:
            while_computing()
        if into is None:
            frames = to_torch(self._memory.show(step.pixels), self.device)
        else:
            canvas.wait()
        self._go_on(step.root)  # on the CPU the step is done; argument lives until here
        numbers = to_torch(step.numbers, self.device)
        final = (step.final_state, step.root.partial)
        return RawStep({"pixels": frames}, numbers, final)

    @property
    def observation_keys(self) -> tuple[str, ...]:
        """Keys of the observation."""
        return ("pixels",)

    def draws_safely(self) -> bool:
        """Whether steps may draw into memory that tensors lie over. Not where a step calls code of
        the game that may fail: the memory would be lost with the step.
        """
        return not self._compiled.calls_back(self._live.batch)

    def final_observations(self, max_steps: int) -> FinalObservations:
        """A store for the states of up to ``max_steps`` steps; draws the final ones when asked."""
        return FinalObservations(self._compiled, self.num_envs, max_steps, self._jax_device)

    def set_seed(self, seed: int | None = None, static_seed: bool = False) -> Any:
        """Seed the batch, see TorchRL's `EnvBase`; ``seed`` may be of numpy or torch too."""
        return super().set_seed(plain(seed), static_seed)

    def _first_batch(self, partial: np.ndarray) -> Batch:
        """Episodes that begin, of the twins ``partial`` (bool [N])."""
        wait_for_torch(self.device, self._jax_device)
        keys = self._keys(0)
        flags = jax.device_put(partial, self._jax_device)
        with jax.default_device(self._jax_device):
            blank = jax.device_put(self._batched.blank(keys, flags), self._jax_device)
        # what every reset runs: to begin by ``init`` would compile the game's reset once more
        first: Batch = self._batched.reset_render(blank, np.ones(self.num_envs, np.bool_))[0]
        return first

    def _set_specs(self) -> None:
        """Tell TorchRL what the entries are."""
        game = self.game
        tasks = len(self.games) if self.task_in_td else 0
        action, observation, reward, done = make_specs(
            self.num_envs, game.obs_size, game.num_actions, tasks, self.one_hot, self.device
        )
        self.action_spec = action
        self.reward_spec = reward
        self.done_spec = done
        if self._state_in_td:
            state = self._snapshots.spec()
            observation["state"] = state
            self.state_spec = Composite(
                state=state.clone(), shape=(self.num_envs,), device=self.device
            )
        self.observation_spec = observation

    def _set_seed(self, seed: int | None) -> None:
        """Give every env a new random key and forget the last action; running episodes go on until
        they are reset.
        """
        if seed is None:
            seed = int(torch.randint(2**32, (), device="cpu"))
        default_seeds.forget(self)
        wait_for_torch(self.device, self._jax_device)
        key = self._keys(seed)
        last_action = jax.device_put(np.zeros(self.num_envs, np.int32), self._jax_device)
        seeded = self._live.batch._replace(key=key, last_action=last_action)
        self._go_on(seeded, self._live.ended, self._live.ends)

    def _keys(self, seed: int) -> jax.Array:
        """The random keys of a seed, uint32 [N, 2]; computed where the env is, too."""
        with jax.default_device(self._jax_device):
            computed = env_keys(seed, self.num_envs)
        keys: jax.Array = jax.device_put(computed, self._jax_device)
        return keys

    def _reset(
        self, tensordict: TensorDictBase | None = None, set_state: bool = False, **kwargs: Any
    ) -> TensorDictBase:
        check_process()
        if set_state and tensordict is not None and "state" in tensordict:
            return self.set_state(tensordict["state"])
        if not self._begun:
            default_seeds.warn_of_twins(self)
            self._begun = True
        # A mask that is true everywhere is no special case: other random numbers would be drawn
        # than on the fused path.
        rows = np.ones(self.num_envs, np.bool_)
        if tensordict is not None and "_reset" in tensordict:
            rows = validation.mask(tensordict, "_reset", self.num_envs).cpu().numpy()
        wait_for_torch(self.device, self._jax_device)
        batch, pixels = self._batched.reset_render(self._live.batch, rows)
        ended = self._none_ended if rows.all() else self._still_ended(~rows)
        root = self._root(batch, ended, to_torch(pixels, self.device))
        if tensordict is not None and not rows.all():
            validation.check_merge(tensordict, root)
            validation.fill_up(tensordict, root)
        self._go_on(batch, ended, self._live.ends)  # which counts in the rows that stay
        return root

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        # go on from the state the caller handed over, and show the twin that was set last
        if self._state_in_td:
            self._go_on_from(tensordict.get("state", None), partial=self._live.batch.partial)
        action = self._integers(validation.tensor(tensordict, "action"))
        argument = int32_argument(action, self._jax_device)
        before = self._live
        batch, ended, pixels, packed = self._compiled.step_only(
            before.batch, before.ended, argument, self._memory.spare()
        )
        frames = to_torch(self._memory.show(pixels), self.device)
        numbers = to_torch(packed, self.device)
        # not the flags that are handed out: those may be written to
        ends = numbers[:, TERMINATED:] > 0
        self._go_on(batch, ended, ends)
        following = self._next(frames, action, numbers)
        if self._state_in_td:
            following["state"] = self._snapshots.export(self._with_ends())
        if "_step" in tensordict:
            return self._only_marked(tensordict, before, following)
        return following

    def _only_marked(
        self, tensordict: TensorDictBase, before: Live, following: TensorDict
    ) -> TensorDictBase:
        """Take the step back in envs that ``_step`` leaves out: ``"next"`` repeats their root, the
        reward is 0.
        """
        marked = validation.mask(tensordict, "_step", self.num_envs)
        stepped = self._live
        # where it stays if the next line refuses
        self._go_on(before.batch, before.ended, before.ends)
        validation.check_merge(tensordict, following)
        if validation.lacks_entries(tensordict, following):
            validation.fill_up(tensordict, self.observe())
        mask = jax.device_put(marked.cpu().numpy(), self._jax_device)
        padded = self._batched.pad(stepped.batch)
        padded_before = self._batched.pad(before.batch)
        batch = choose_rows(mask, padded, padded_before)
        ended = choose_rows(mask, stepped.ended, before.ended)
        ends = stepped.ends.where(marked.unsqueeze(-1), before.ends)
        self._go_on(self._batched.unpad(batch), ended, ends)
        return validation.only_marked(tensordict, following, marked)

    def _step_and_maybe_reset(
        self, tensordict: TensorDictBase
    ) -> tuple[TensorDictBase, TensorDictBase]:
        self._assert_tensordict_shape(tensordict)
        if self._state_in_td or "_step" in tensordict or self._post_step_mdp_hooks is not None:
            stock: tuple[TensorDictBase, TensorDictBase] = super()._step_and_maybe_reset(tensordict)
            return stock
        action = validation.tensor(tensordict, "action")
        raw = self.step_raw(action)
        last_action = action.to(torch.float32).argmax(-1) if self.one_hot else action
        following = self._next(raw.pixels, last_action, raw.numbers)
        # all envs are drawn again, which is no dearer than to copy their frames
        if following["done"].any():
            at_ends = self._live.batch._replace(state=raw.final[0])
            drawn = self._compiled.draw(at_ends, self._final_memory.spare())
            final_frames = to_torch(self._final_memory.show(drawn), self.device)
            following._set_str("pixels", final_frames, **_UNCHECKED)
        validation.keep_what_was_written(tensordict, following)
        tensordict.set("next", following)
        root: TensorDictBase = self._step_mdp(tensordict)
        counts = raw.root_numbers(("is_init", "step_count", "episode_reward"))
        ends = self._no_ends.clone()  # it is handed out
        for key, value in self._entries(raw.pixels, last_action, counts, ends).items():
            root._set_str(key, value, **_UNCHECKED)
        return tensordict, root

    def _assert_tensordict_shape(self, tensordict: TensorDictBase) -> None:
        validation.check_tensordict(tensordict, self.num_envs)

    def _integers(self, action: torch.Tensor) -> torch.Tensor:
        """The actions as integers [N]; raises if they are not what the spec says, or in a process
        that cannot step.
        """
        check_process()
        num_actions = self.game.num_actions
        if self.one_hot:
            validation.check_one_hot(action, (self.num_envs, num_actions), self._check_actions)
            return action.to(torch.float32).argmax(-1)
        validation.check_integers(action, self.num_envs, num_actions, self._check_actions)
        return action

    def _go_on(
        self, batch: Batch, ended: Ended | None = None, ends: torch.Tensor | None = None
    ) -> None:
        """Put another state in place, all at once: an interrupt leaves the old state or the new
        one.

        Args:
            batch: Without flags of an end.
            ended: Where it has ended; None: nowhere.
            ends: bool [N, 2], what a root says of that: where its last step terminated or
                truncated; None: nowhere.
        """
        ended = self._none_ended if ended is None else ended
        ends = self._no_ends if ends is None else ends
        live = Live(batch, ended, ends, self._live.generation + 1, self._live.view)
        self.__dict__["_live"] = live  # ``nn.Module`` sets attributes slowly

    def _go_on_from(
        self,
        state: TensorDictBase | None,
        ends: torch.Tensor | None = None,
        partial: jax.Array | None = None,
    ) -> None:
        """Put a snapshot in place.

        Args:
            state: The snapshot.
            ends: See ``_go_on``.
            partial: bool [N], the twins to show; None: those of the snapshot.
        """
        batch = self._snapshots.load(state)
        if partial is not None:
            batch = batch._replace(partial=partial)
        terminated, truncated = self._batched.ends(batch)
        some_ended = np.asarray(terminated).any() or np.asarray(truncated).any()
        ended = (terminated, truncated) if some_ended else None
        self._go_on(self._batched.without_ends(batch), ended, ends)

    def _still_ended(self, rows: np.ndarray) -> Ended:
        """Where, of the envs ``rows`` (bool [N]), the live batch has ended."""
        terminated = self._live.ended[0] & rows
        truncated = self._live.ended[1] & rows
        # Fused steps are faster where none has; but a look at memory of a GPU would wait for it.
        if is_host(self.device) and not (np.asarray(terminated) | np.asarray(truncated)).any():
            return self._none_ended
        return terminated, truncated

    def _with_ends(self) -> Batch:
        """The live batch with the flags of an end."""
        return self._flagged(self._live.batch, self._live.ended)

    def _flagged(self, batch: Batch, ended: Ended) -> Batch:
        """A batch with the flags of an end; those that a mixture adds are made where the env is."""
        with jax.default_device(self._jax_device):
            return self._batched.with_ends(batch, *ended)

    def _root(self, batch: Batch, ended: Ended, frames: torch.Tensor) -> TensorDict:
        """Root tensordict of a live batch and of where it has ended.

        Everything but the frames is copied: torch must not write to live memory.
        """
        step_count = to_torch(batch.step_count, self.device).to(torch.int64).unsqueeze(-1)
        episode_reward = to_torch(batch.episode_reward, self.device).clone().unsqueeze(-1)
        counts = {
            "is_init": step_count == 0,
            "step_count": step_count,
            "episode_reward": episode_reward,
        }
        ends = self._live.ends & (step_count > 0)
        root = self._entries(frames, to_torch(batch.last_action, self.device), counts, ends)
        if self._state_in_td:
            root["state"] = self._snapshots.export(self._flagged(batch, ended))
        return TensorDict(root, batch_size=self.batch_size, device=self.device)

    def _next(
        self, frames: torch.Tensor, action: torch.Tensor, numbers: torch.Tensor
    ) -> TensorDict:
        """The ``"next"`` tensordict. Frames are zero copy, since JAX never reads them again.
        Rewards are copies: ``consolidate`` of a tensordict does not work with columns.
        """
        is_init = torch.zeros(self.num_envs, 1, dtype=torch.bool, device=self.device)
        step_count = numbers[:, STEP_COUNT, None].to(torch.int64)
        episode_reward = numbers[:, EPISODE_REWARD, None].view(torch.float32).contiguous()
        counts = {"is_init": is_init, "step_count": step_count, "episode_reward": episode_reward}
        following = self._entries(frames, action, counts, numbers[:, TERMINATED:] > 0)
        following["reward"] = numbers[:, REWARD, None].view(torch.float32).contiguous()
        return TensorDict._new_unsafe(following, batch_size=self.batch_size, device=self.device)

    def _entries(
        self,
        frames: torch.Tensor,
        action: torch.Tensor,
        counts: dict[str, torch.Tensor],
        ends: torch.Tensor,
    ) -> dict[str, torch.Tensor]:
        """The entries that root and ``"next"`` have in common; ``ends`` is bool [N, 2]: terminated,
        truncated.
        """
        entries = {"pixels": frames, "last_action": action.to(torch.int64, copy=True)}
        entries.update(counts)
        entries["done"] = ends.any(-1, keepdim=True)
        entries["terminated"] = ends[:, :1]
        entries["truncated"] = ends[:, 1:]
        if self.task_in_td:
            entries["task"] = self.task
        return entries
