"""A TensorDict policy as the two functions that the measures ask for.

The modules of a policy are sorted once, by their keys. Those before the heads that read nothing but
frames are the encoder, which sees every frame once. The rest, memory and heads, reads sequences
from a recurrent state that is handed to it: our ``MemoryModule`` and TorchRL's ``LSTMModule`` and
``GRUModule`` in one call, any other module with a state step by step, as it acts, and so do modules
together that pass a state on to one another. A policy that reads frames and state in one module
cannot be cut in two; its features are the frames.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase, unravel_key
from tensordict.nn import (
    TensorDictModuleBase,
)
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import (
    GRUModule,
    LSTMModule,
    set_recurrent_mode,
)

from arcade_torch.agents.checked import require
from arcade_torch.models.memory_module import MemoryModule
from arcade_torch.models.recurrence import Key
from arcade_torch.tools.measures.keys import Names, action_index
from arcade_torch.tools.measures.masked import refuse_nan
from arcade_torch.tools.measures.tensordict_keys import (
    CHOOSERS,
    OFFERS,
    find_input_keys,
    find_output,
    find_state_keys,
    joined_by_state,
    needed_parts,
    parts_of,
    unravelled,
)


class TensorDictPolicy:
    """Reads a TensorDict policy as `encode` and `remember`, and acts with it.

    Args:
        module: the policy; with ``names`` as for ``as_policy``.

    Attributes:
        keys: where it reads and writes.
        state_keys: of its recurrent state, each with the key that the next state is written to.
        output: what the measures look at.
        splits: whether frames are encoded apart from the rest.
        only_part: the one module that computes the outputs, None if there are several.
        chooses_itself: whether modules of somebody's own stand beside those that the outputs need,
            which may choose the action.
        reads_last_action: whether it reads ``keys.last_action``.

    Raises:
        ValueError: it reads entries that no measure hands over, its outputs cannot be told, or its
            recurrent state has no start.
    """

    def __init__(self, module: TensorDictModuleBase, names: Names) -> None:
        self.module = module
        parts = list(parts_of(module))
        self.state_keys = find_state_keys(module, names.get("state_keys"))
        self.keys = find_input_keys(module, self.state_keys, names)
        self.reads_last_action = self.keys.last_action in unravelled(module.in_keys)
        self.output = find_output(parts, names)
        needed = needed_parts(parts, self.output.keys, self.state_keys)
        self.only_part = needed[0] if len(needed) == 1 else None
        self.chooses_itself = any(
            part not in needed and not isinstance(part, CHOOSERS) for part in parts
        )
        self._encoder, rest = self._split(needed)
        self._rest = joined_by_state(rest, self.state_keys)
        self._features = self._boundary()
        self.splits = self.keys.pixels not in self._features
        self._shapes = dict[Key, torch.Size]()
        self._start = _start_of(module, self.state_keys, names.get("initial_state"))

    def _split(
        self, needed: Sequence[TensorDictModuleBase]
    ) -> tuple[list[TensorDictModuleBase], list[TensorDictModuleBase]]:
        """The modules that see nothing but frames, and those behind them: heads are behind, with
        memory or without, unless they read the frames themselves.
        """
        heads = set(self.output.keys)
        encoder, rest = self._split_before(needed, heads)
        return (encoder, rest) if encoder else self._split_before(needed, set())

    def _split_before(
        self, needed: Sequence[TensorDictModuleBase], heads: set[Key]
    ) -> tuple[list[TensorDictModuleBase], list[TensorDictModuleBase]]:
        """`_split`, with what writes one of ``heads`` behind the encoder."""
        visible = {self.keys.pixels}
        # by what stands behind the encoder; a state that is written in its place belongs there
        touched = heads | {key for key, after in self.state_keys.items() if key == after}
        encoder = list[TensorDictModuleBase]()
        rest = list[TensorDictModuleBase]()
        for part in needed:
            reads = unravelled(part.in_keys)
            writes = unravelled(part.out_keys)
            if reads <= visible and not writes & touched:
                encoder.append(part)
                visible |= writes
            else:
                rest.append(part)
                touched |= reads | writes
                visible -= writes
        return encoder, rest

    def _boundary(self) -> list[Key]:
        """What the encoder, or the env, hands to the rest: in the order in which it is read."""
        encoded = {self.keys.pixels}
        for part in self._encoder:
            encoded |= unravelled(part.out_keys)
        features = list[Key]()
        written = set[Key]()
        wanted = list(self.output.keys)
        for part in self._rest:
            reads = [unravel_key(key) for key in part.in_keys]
            features += [key for key in reads if key in encoded]
            wanted += [self.state_keys[key] for key in reads if key in self.state_keys]
            written |= unravelled(part.out_keys)
        features += [key for key in wanted if key in encoded - written]
        if not features:
            raise ValueError(
                f"{self.output.key!r} does not depend on {self.keys.pixels!r}: name the entry that "
                "holds the frames (pixels_key)"
            )
        return list(dict.fromkeys(features))

    def encode(self, frames: Tensor) -> Tensor:
        """Frames [N, ...], each on its own, to features [N, E]: all that the rest reads of them."""
        steps = TensorDict({self.keys.pixels: frames}, [len(frames)], device=frames.device)
        for part in self._encoder:
            steps = part(steps)
        features = []
        for key in self._features:
            value = steps[key]
            self._shapes[key] = value.shape[1:]
            features.append(value.reshape(len(frames), -1))
        return features[0] if len(features) == 1 else torch.cat(features, -1)

    def remember(
        self, features: Tensor, last_action: Tensor, is_init: Tensor, state: TensorDictBase | None
    ) -> tuple[Tensor, TensorDictBase]:
        """Everything behind `encode`: sequences of features from a recurrent state on.

        Args:
            features: [B, T, E], of `encode`.
            last_action: [B, T], or one-hot [B, T, A], as the policy reads it.
            is_init: bool [B, T]; where it is set the state is the initial one.
            state: TensorDict [B] before step 0; None is the initial one.

        Returns:
            (outputs [B, T, A], with a value [B, T, A + 1]; the state after the last step).
        """
        batch = features.shape[:2]
        steps = TensorDict({}, batch, device=features.device)
        sizes = [self._shapes[key].numel() for key in self._features]
        for key, part in zip(self._features, features.split(sizes, -1), strict=True):
            steps[key] = part.reshape(*batch, *self._shapes[key])
        if self.reads_last_action:
            steps[self.keys.last_action] = last_action
        self._set_flags(steps, is_init)
        start = self.initial_state(batch[0])
        before = start if state is None else start.clone(recurse=False).update(state)
        after = before.clone(recurse=False)
        for module in self._rest:
            after.update(self._run(module, steps, is_init, before, start))
        outputs = [steps[key] for key in self.output.keys]
        for key, output in zip(self.output.keys, outputs, strict=True):
            require(
                output.ndim == steps.ndim + 1,
                f"the policy's output {key!r}",
                list(output.shape[steps.ndim :]),
                "one number an action, [*, A]: a distribution of values needs its mean beside it, "
                "named with output_key",
            )
        return torch.cat(outputs, -1), after

    def _set_flags(self, steps: TensorDictBase, is_init: Tensor) -> None:
        """Write start flags [*batch, 1] where the policy reads them, and where TorchRL's modules
        do.
        """
        flags = is_init.bool().reshape(*steps.batch_size, 1)
        steps[self.keys.is_init] = flags
        steps["is_init"] = flags

    def _run(
        self,
        module: TensorDictModuleBase,
        steps: TensorDictBase,
        is_init: Tensor,
        state: TensorDictBase,
        start: TensorDictBase,
    ) -> TensorDictBase:
        """Run one module over sequences, write its outputs into ``steps``, and return the state
        after them, as far as it reads it.
        """
        keys = [key for key in self.state_keys if key in unravelled(module.in_keys)]
        if isinstance(module, MemoryModule):
            return _read_with_memory(module, steps, is_init, state)
        if not keys:
            flat = steps.reshape(-1)
            written = module(flat).select(*module.out_keys, strict=False)
            steps.update(written.reshape(steps.batch_size))
            return state.empty()
        states = {key: self.state_keys[key] for key in keys}
        if isinstance(module, LSTMModule | GRUModule):
            return _read_at_once(module, steps, is_init, state, start, states)
        return _read_by_steps(module, steps, is_init, state, start, states)

    def initial_state(self, batch_size: int) -> TensorDictBase:
        """The recurrent state before the first frame, TensorDict [B]; empty for a policy without
        memory.
        """
        return self._start(batch_size)

    @torch.no_grad()
    def act(self, obs: Any, state: TensorDictBase) -> tuple[Tensor, TensorDictBase]:
        """The policy's greedy actions, int64 [N], by the whole module, and the next state.

        Raises:
            ValueError: the actions are not discrete, or the outputs no numbers.
        """
        pixels = obs["pixels"]
        step = TensorDict({self.keys.pixels: pixels}, [len(pixels)], device=pixels.device)
        if self.reads_last_action:
            step[self.keys.last_action] = obs["last_action"]
        self._set_flags(step, obs["is_init"])
        step.update(state.clone(recurse=False))  # a policy may write its state in place
        with set_exploration_type(ExplorationType.DETERMINISTIC), set_recurrent_mode(False):
            step = self.module(step)
        after = state.clone(recurse=False)
        for key, next_key in self.state_keys.items():
            after[key] = step[next_key]
        action = step.get(self.keys.action, None)
        values = step.get(self.output.key, None)  # a sequence may keep them to itself
        if values is not None:
            refuse_nan(values)
        if action is not None:
            return action_index(action, self.keys.action), after
        out = torch.cat([step[key] for key in self.output.keys], -1)
        return self.output.read(out, OFFERS[self.output.kind][0]).argmax(-1), after

    def act_with_network(self, obs: Any, state: TensorDictBase) -> tuple[Tensor, TensorDictBase]:
        """`act`, with the state as ``only_part``, a network of ours, has it."""
        network: Any = self.only_part
        by_tower = hasattr(network, "towers")
        towers = dict(network.towers.items()) if by_tower else {"": network}
        keyed = TensorDict({}, state.batch_size, device=state.device)
        for name, tower in towers.items():
            if tower.state_keys:
                keyed.set(tower.state_key, state[name] if by_tower else state)
        action, after = self.act(obs, keyed)
        states = state.clone(recurse=False)
        for name, tower in towers.items():
            if tower.state_keys:
                after_tower = after[tower.state_key]
                states = states.set(name, after_tower) if by_tower else after_tower
        return action, states


def _start_of(
    module: TensorDictModuleBase,
    state_keys: Mapping[Key, Key],
    given: TensorDictBase | Mapping[str, Any] | None,
) -> Callable[[int], TensorDictBase]:
    """The function that gives the state at the start of an episode for a batch size."""
    first: Any = given
    if given is not None and not isinstance(given, TensorDictBase):
        first = TensorDict(dict(given), [])
    if first is not None:
        size = list(first.batch_size)
        require(size in ([], [1]), "initial_state", size, "of batch size []")
    parameter = next(module.parameters(), torch.empty(0))

    def start(batch_size: int) -> TensorDictBase:
        state = TensorDict({}, [batch_size], device=parameter.device)
        for part in module.modules():
            state.update(_start_of_part(part, batch_size, parameter))
        if first is not None:
            state.update(first.expand(batch_size))
        return state

    example = start(1)
    missing = [key for key in state_keys if key not in example.keys(True, True)]
    if missing:
        raise ValueError(
            f"the recurrent state must have a start, got none for {missing}: hand it over as "
            "initial_state, a TensorDict of batch size [], or give its module a "
            "make_tensordict_primer"
        )
    return start


def _start_of_part(part: nn.Module, batch_size: int, parameter: Tensor) -> TensorDictBase:
    """The initial state of one module, TensorDict [batch_size]; empty where it has none."""
    state = TensorDict({}, [batch_size], device=parameter.device)
    if isinstance(part, MemoryModule):
        start = part.memory.initial_state(batch_size)  # type: ignore[operator]
        return state.set(_prefix(part), start) if part.state_keys else state
    if not hasattr(part, "make_tensordict_primer"):
        return state
    primer: Any = part.make_tensordict_primer()  # type: ignore[operator]
    defaults = primer.default_value if isinstance(primer.default_value, Mapping) else {}
    for key, spec in primer.primers.items(True, True):
        dtype = parameter.dtype if spec.dtype.is_floating_point else spec.dtype
        value = torch.as_tensor(defaults.get(key, 0), dtype=dtype, device=parameter.device)
        state.set(key, value.expand(batch_size, *spec.shape).clone())
    return state


def _prefix(module: MemoryModule) -> Key:
    """The key below which the whole state of a memory stands."""
    key = module.state_keys[0]
    example = module.memory.initial_state(1)  # type: ignore[operator]
    path = next(iter(example.keys(True, True)))
    depth = 1 if isinstance(path, str) else len(path)
    prefix: Key = unravel_key(key[: len(key) - depth])
    return prefix


def _read_with_memory(
    module: MemoryModule, steps: TensorDictBase, is_init: Tensor, state: TensorDictBase
) -> TensorDictBase:
    """Let a memory of ours read sequences."""
    before = module.memory.initial_state(len(steps))  # type: ignore[operator]
    prefix = _prefix(module) if module.state_keys else None
    if prefix is not None:
        before.update(state[prefix])
    y, after = module.memory(steps[module.in_key], before, is_init.bool())
    steps[module.out_key] = y
    return state.empty() if prefix is None else state.empty().set(prefix, after)


def _read_at_once(
    module: TensorDictModuleBase,
    steps: TensorDictBase,
    is_init: Tensor,
    state: TensorDictBase,
    start: TensorDictBase,
    states: Mapping[Key, Key],
) -> TensorDictBase:
    """Let a module of TorchRL read sequences in recurrent mode, with the initial state at starts
    inside of them.
    """
    count = is_init.shape[1]
    for key in states:
        first = _started(is_init[:, 0], start[key], state[key])
        later = start[key].unsqueeze(1).expand(-1, count - 1, *start[key].shape[1:])
        steps[key] = torch.cat([first.unsqueeze(1), later], 1)
    # cuDNN has no backward pass in evaluation mode
    with set_recurrent_mode(True), torch.backends.cudnn.flags(enabled=False):
        written = module(steps)
    after = state.empty()
    for key, next_key in states.items():
        after[key] = written[next_key][:, -1]
    return after


def _read_by_steps(
    module: TensorDictModuleBase,
    steps: TensorDictBase,
    is_init: Tensor,
    state: TensorDictBase,
    start: TensorDictBase,
    states: Mapping[Key, Key],
) -> TensorDictBase:
    """Let any module with a state read sequences, as it acts."""
    state = state.select(*states)
    outputs = list[TensorDictBase]()
    for t in range(is_init.shape[1]):
        step = steps[:, t].clone(recurse=False)
        for key in states:
            step[key] = _started(is_init[:, t], start[key], state[key])
        with set_recurrent_mode(False):
            step = module(step)
        for key, next_key in states.items():
            state[key] = step[next_key]
        outputs.append(step.select(*unravelled(module.out_keys)))
    steps.update(torch.stack(outputs, 1))
    return state


def _started(is_init: Tensor, start: Tensor, state: Tensor) -> Tensor:
    """The initial state where an episode begins, else the state; [B, ...]."""
    flags = is_init.bool().reshape(-1, *[1] * (state.ndim - 1))
    return torch.where(flags, start, state)
