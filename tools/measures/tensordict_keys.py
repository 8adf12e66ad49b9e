"""Where a TensorDict policy reads and writes: its modules in their order, its inputs and recurrent
state, and the outputs that the measures look at.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from tensordict import unravel_key
from tensordict.nn import (
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModuleBase,
    TensorDictSequential,
)
from torch import Tensor
from torchrl.modules import EGreedyModule, GRUModule, LSTMModule, QValueModule

from arcade_torch.models.memory_module import MemoryModule
from arcade_torch.models.recurrence import Key
from arcade_torch.tools.measures.keys import Keys, Kind, Names
from arcade_torch.tools.measures.masked import logarithms

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
READ_AT_ONCE = (MemoryModule, LSTMModule, GRUModule)
"""Memories that read a sequence in one call, and give the state after it alone."""
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
        if self.kind == "probs":  # a distribution takes any numbers for shares
            actions = actions / actions.sum(-1, keepdim=True)
        if self.kind == "logits" and target == "probs":
            return actions.softmax(-1)
        if self.kind == "probs" and target == "logits":
            return logarithms(actions)
        return actions


def unravelled(keys: Sequence[Any]) -> set[Key]:
    """Keys as tensordict compares them; ``_`` is none, but an output that is thrown away."""
    return {unravel_key(key) for key in keys} - {"_"}


def parts_of(module: TensorDictModuleBase) -> Iterator[TensorDictModuleBase]:
    """The modules of a sequence in their order, those of sequences inside of it too."""
    if isinstance(module, TensorDictSequential) and type(module).forward in IN_A_ROW:
        for index in range(len(module)):
            yield from parts_of(module[index])
    else:
        yield module


def find_state_keys(
    module: TensorDictModuleBase, named: Sequence[Key] | Mapping[Key, Key] | None
) -> dict[Key, Key]:
    """Keys of the recurrent state, and where the next one is written: under "next" unless named."""
    if isinstance(named, Mapping):
        return {unravel_key(key): unravel_key(after) for key, after in named.items()}
    written = unravelled(module.out_keys)
    keys = dict[Key, Key]()
    candidates = module.in_keys if named is None else named
    for key in candidates:
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


def find_input_keys(
    module: TensorDictModuleBase, state_keys: Mapping[Key, Key], names: Names
) -> Keys:
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


def find_output(parts: Sequence[TensorDictModuleBase], names: Names) -> Output:
    """What the measures look at: what the actions are chosen by, or an entry with a usual name."""
    written = set[Key]()
    kinds = dict[Key, Kind]()
    for part in parts:
        written |= unravelled(part.out_keys)
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


def needed_parts(
    parts: Sequence[TensorDictModuleBase], keys: Sequence[Key], state_keys: Mapping[Key, Key]
) -> list[TensorDictModuleBase]:
    """The modules without which some entries could not be computed, at any step, in their order:
    also those that write the next state, where they read it.
    """
    wanted = set(keys)
    while True:
        needed = _writers(parts, wanted)
        read = set[Key]()
        for part in needed:
            read |= unravelled(part.in_keys)
        after = {state_keys[key] for key in read if key in state_keys}
        if after <= wanted:
            return needed
        wanted |= after


def _writers(parts: Sequence[TensorDictModuleBase], keys: set[Key]) -> list[TensorDictModuleBase]:
    """The modules that some entries are computed by, in their order."""
    wanted = set(keys)
    needed = list[TensorDictModuleBase]()
    for part in reversed(parts):
        written = unravelled(part.out_keys)
        if written & wanted and not isinstance(part, CHOOSERS):
            needed.append(part)
            wanted -= written
            wanted |= unravelled(part.in_keys)
    return needed[::-1]


def joined_by_state(
    parts: Sequence[TensorDictModuleBase], state_keys: Mapping[Key, Key]
) -> list[TensorDictModuleBase]:
    """The modules in their order; from the first to the last of those that pass a state on to one
    another they are one sequence, which has to go step by step.
    """
    last = list(range(len(parts)))  # the module up to which each is joined
    for key, after in state_keys.items():
        ends = _ends_of(parts, key, after)
        if ends is not None:
            last[ends[0]] = max(last[ends[0]], ends[1])
    joined = list[TensorDictModuleBase]()
    begin = 0
    while begin < len(parts):
        end = begin
        place = begin
        while place <= end:
            end = max(end, last[place])
            place += 1
        some = parts[begin:place]
        joined.append(some[0] if len(some) == 1 else TensorDictSequential(*some))
        begin = place
    return joined


def _ends_of(parts: Sequence[TensorDictModuleBase], key: Key, after: Key) -> tuple[int, int] | None:
    """The first and the last of the modules that have to be joined for a state; None where each can
    read sequences by itself: one that reads the state when all of the next one is written can.
    """
    readers = list[int]()
    writers = list[int]()
    users = list[int]()
    is_hidden = key == after  # whether a sequence does not show the states between its steps
    for place, part in enumerate(parts):
        reads = unravelled(part.in_keys)
        writes = unravelled(part.out_keys)
        if key in reads:
            readers.append(place)
        if after in writes:
            writers.append(place)
        if {key, after} & (reads | writes):
            users.append(place)
            is_hidden |= isinstance(part, READ_AT_ONCE)
    is_passed_on = bool(readers and writers) and readers[0] < writers[-1]
    if len(users) > 1 and (is_hidden or is_passed_on):
        return users[0], users[-1]
    return None
