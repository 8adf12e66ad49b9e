"""A TensorDict policy as the two functions that the measures ask for.

The modules of a policy are sorted once, by their keys. Those that read nothing but frames are the
encoder, which sees every frame once. The rest, memory and heads, reads sequences from a recurrent
state that is handed to it: our ``MemoryModule`` and TorchRL's ``LSTMModule`` and ``GRUModule`` in
one call, any other module with a state step by step, as it acts. A policy that reads frames and
state in one module cannot be cut in two; its features are the frames.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase, unravel_key
from tensordict.nn import (
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModuleBase,
    TensorDictSequential,
)
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import (
    EGreedyModule,
    GRUModule,
    LSTMModule,
    QValueModule,
    set_recurrent_mode,
)

from arcade_torch.models.memory import Key, MemoryModule
from arcade_torch.tools.measures.keys import Keys, Kind, Names, action_index

STANDARD_OUTPUTS: Mapping[Key, Kind] = {"action_value": "q", "logits": "logits", "probs": "probs"}
"""What the outputs under TorchRL's usual names are."""
OFFERS: Mapping[Kind, tuple[str, ...]] = {
    "q": ("q", "value"),
    "logits": ("logits", "probs"),
    "probs": ("logits", "probs"),
}
"""How outputs of a kind can be read; with a value beside them also as "value"."""
CHOOSERS = (QValueModule, EGreedyModule, ProbabilisticTensorDictModule)
"""Modules that choose an action and compute nothing that a measure looks at."""
IN_A_ROW = (TensorDictSequential.forward, ProbabilisticTensorDictSequential.forward)
"""What runs the modules of a sequence one after the other, and does nothing else."""


@dataclass(frozen=True)
class Output:
    """Which entry the measures look at, what it is, and where the value of a state stands."""

    key: Key
    kind: Kind
    value_key: Key | None = None

    @property
    def keys(self) -> list[Key]:
        """The entries, the value last."""
        return [self.key] if self.value_key is None else [self.key, self.value_key]

    @property
    def offers(self) -> tuple[str, ...]:
        """How the outputs can be read."""
        beside = () if self.value_key is None else ("value",)
        return OFFERS[self.kind] + beside

    def read(self, out: Tensor, target: str) -> Tensor:
        """Read outputs [..., A], with a value [..., A + 1], as one of `offers`."""
        actions = out if self.value_key is None else out[..., :-1]
        if target == "value":
            return actions.amax(-1, keepdim=True) if self.kind == "q" else out[..., -1:]
        if self.kind == "logits" and target == "probs":
            return actions.softmax(-1)
        if self.kind == "probs" and target == "logits":
            return actions.log()
        return actions


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
        reads_last_action: whether it reads ``keys.last_action``.

    Raises:
        ValueError: it reads entries that no measure hands over, its outputs cannot be told, or its
            recurrent state has no start.
    """

    def __init__(self, module: TensorDictModuleBase, names: Names) -> None:
        self.module = module
        parts = list(_parts(module))
        self.state_keys = _state_keys(module, names.get("state_keys"))
        self.keys = _input_keys(module, self.state_keys, names)
        self.reads_last_action = self.keys.last_action in _unravelled(module.in_keys)
        self.output = _output(parts, names)
        needed = _needed(parts, self.output.keys)
        self.only_part = needed[0] if len(needed) == 1 else None
        self._encoder, self._rest = self._split(needed)
        self._features = self._boundary()
        self.splits = self.keys.pixels not in self._features
        self._shapes = dict[Key, torch.Size]()
        self._start = _start_of(module, self.state_keys, names.get("initial_state"))

    def _split(
        self, needed: Sequence[TensorDictModuleBase]
    ) -> tuple[list[TensorDictModuleBase], list[TensorDictModuleBase]]:
        """The modules that see nothing but frames, and those behind them."""
        visible = {self.keys.pixels}
        touched = set[Key]()  # by what stands behind the encoder
        encoder = list[TensorDictModuleBase]()
        rest = list[TensorDictModuleBase]()
        for part in needed:
            reads = _unravelled(part.in_keys)
            writes = _unravelled(part.out_keys)
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
            encoded |= _unravelled(part.out_keys)
        features = list[Key]()
        written = set[Key]()
        for part in self._rest:
            features += [unravel_key(key) for key in part.in_keys if unravel_key(key) in encoded]
            written |= _unravelled(part.out_keys)
        features += [key for key in self.output.keys if key in encoded - written]
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
        state = start if state is None else start.clone(recurse=False).update(state)
        for module in self._rest:
            state = self._run(module, steps, is_init, state, start)
        return torch.cat([steps[key] for key in self.output.keys], -1), state

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
        """Run one module over sequences, write its outputs into ``steps``, and return the state."""
        keys = [key for key in self.state_keys if key in _unravelled(module.in_keys)]
        if isinstance(module, MemoryModule):
            return _read_with_memory(module, steps, is_init, state)
        if not keys:
            flat = steps.reshape(-1)
            written = module(flat).select(*module.out_keys, strict=False)
            steps.update(written.reshape(steps.batch_size))
            return state
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
            ValueError: the actions are not discrete.
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
        if action is not None:
            return action_index(action, self.keys.action), after
        out = torch.cat([step[key] for key in self.output.keys], -1)
        return self.output.read(out, OFFERS[self.output.kind][0]).argmax(-1), after


def _unravelled(keys: Sequence[Any]) -> set[Key]:
    return {unravel_key(key) for key in keys}


def _parts(module: TensorDictModuleBase) -> Iterator[TensorDictModuleBase]:
    """The modules of a sequence in their order, those of sequences inside of it too."""
    if isinstance(module, TensorDictSequential) and type(module).forward in IN_A_ROW:
        for index in range(len(module)):
            yield from _parts(module[index])
    else:
        yield module


def _state_keys(
    module: TensorDictModuleBase, named: Sequence[Key] | Mapping[Key, Key] | None
) -> dict[Key, Key]:
    """Keys of the recurrent state, and where the next one is written: under "next" unless named."""
    if isinstance(named, Mapping):
        return {unravel_key(key): unravel_key(after) for key, after in named.items()}
    written = _unravelled(module.out_keys)
    keys = dict[Key, Key]()
    for key in module.in_keys if named is None else named:
        after = unravel_key(("next", key))
        if named is not None or after in written:
            keys[unravel_key(key)] = after
    missing = [after for after in keys.values() if after not in written]
    if missing:
        raise ValueError(
            f"the policy must write the next state under {missing}, got {sorted(written, key=str)}:"
            " name pairs, state_keys={state key: key of the next state}"
        )
    return keys


def _input_keys(module: TensorDictModuleBase, state_keys: Mapping[Key, Key], names: Names) -> Keys:
    """Where a policy reads; a ValueError if it reads more than a measure hands over."""
    last_action = unravel_key(names.get("last_action_key", "last_action"))
    is_init = unravel_key(names.get("is_init_key", "is_init"))
    pixels = names.get("pixels_key")
    read = [unravel_key(key) for key in module.in_keys]
    handed_over = {last_action, is_init, "is_init", *state_keys}
    others = [key for key in dict.fromkeys(read) if key not in handed_over]
    if pixels is None and len(others) == 1:
        pixels = others[0]
    if others != [pixels]:
        wanted = "the frames" if pixels is None else f"the frames ({pixels!r})"
        raise ValueError(
            f"the policy must read {wanted}, the last action, start flags and its state alone, got "
            f"{others} beside what is known: name pixels_key, last_action_key, is_init_key or "
            "state_keys"
        )
    action = unravel_key(names.get("action_key", "action"))
    return Keys(unravel_key(pixels), action, last_action, is_init)


def _output(parts: Sequence[TensorDictModuleBase], names: Names) -> Output:
    """What the measures look at: what the actions are chosen by, or an entry with a usual name."""
    written = set[Key]()
    kinds = dict[Key, Kind]()
    for part in parts:
        written |= _unravelled(part.out_keys)
        kinds |= _kinds_read_by(part)
    for usual, kind_of_usual in STANDARD_OUTPUTS.items():
        if usual in written:
            kinds.setdefault(usual, kind_of_usual)
    named = names.get("output_key")
    key = next(iter(kinds), None) if named is None else unravel_key(named)
    kind = names.get("output_kind") or (None if key is None else kinds.get(key))
    if key is None or kind is None or key not in written:
        raise ValueError(
            f"the policy must write action_value, logits or probs [*, A], got {key!r} among "
            f"{sorted(written, key=str)}: name output_key, and say what it is with output_kind "
            '("q", "logits" or "probs")'
        )
    value = unravel_key(names.get("value_key", "state_value"))
    has_value = kind != "q" and value in written
    return Output(key, kind, value if has_value else None)


def _kinds_read_by(part: TensorDictModuleBase) -> dict[Key, Kind]:
    """What a module that chooses actions takes its inputs for."""
    if isinstance(part, QValueModule):
        return {unravel_key(part.in_keys[0]): "q"}
    kinds = dict[Key, Kind]()
    if isinstance(part, ProbabilisticTensorDictModule):
        for name, key in zip(part.dist_keys, part.in_keys, strict=True):
            if name in ("logits", "probs"):
                kinds[unravel_key(key)] = name
    return kinds


def _needed(
    parts: Sequence[TensorDictModuleBase], keys: Sequence[Key]
) -> list[TensorDictModuleBase]:
    """The modules without which some entries could not be computed, in their order."""
    wanted = set(keys)
    needed = list[TensorDictModuleBase]()
    for part in reversed(parts):
        written = _unravelled(part.out_keys)
        if written & wanted and not isinstance(part, CHOOSERS):
            needed.append(part)
            wanted -= written
            wanted |= _unravelled(part.in_keys)
    return needed[::-1]


def _start_of(
    module: TensorDictModuleBase,
    state_keys: Mapping[Key, Key],
    given: TensorDictBase | None,
) -> Callable[[int], TensorDictBase]:
    """The function that gives the state at the start of an episode for a batch size."""
    parameter = next(module.parameters(), torch.empty(0))

    def start(batch_size: int) -> TensorDictBase:
        state = TensorDict({}, [batch_size], device=parameter.device)
        for part in module.modules():
            state.update(_start_of_part(part, batch_size, parameter))
        if given is not None:
            state.update(given.expand(batch_size))
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
    return state if prefix is None else state.clone(recurse=False).set(prefix, after)


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
    after = state.clone(recurse=False)
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
    state = state.clone(recurse=False)
    outputs = list[TensorDictBase]()
    for t in range(is_init.shape[1]):
        step = steps[:, t].clone(recurse=False)
        for key in states:
            step[key] = _started(is_init[:, t], start[key], state[key])
        with set_recurrent_mode(False):
            step = module(step)
        for key, next_key in states.items():
            state[key] = step[next_key]
        outputs.append(step.select(*module.out_keys))
    steps.update(torch.stack(outputs, 1))
    return state


def _started(is_init: Tensor, start: Tensor, state: Tensor) -> Tensor:
    """The initial state where an episode begins, else the state; [B, ...]."""
    flags = is_init.bool().reshape(-1, *[1] * (state.ndim - 1))
    return torch.where(flags, start, state)
