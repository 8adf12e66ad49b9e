"""What the analyses ask of a policy: two functions, and which of its outputs is meant.

Saliency, recall density and contamination work on anything that can be cut in two: ``encode`` looks
at single frames, ``remember`` is everything behind it. `as_policy` makes both of a TensorDict
policy, an agent or a network; `Policy` takes two functions of yours.

Example:
    >>> from tensordict.nn import TensorDictModule, TensorDictSequential
    >>> from torchrl.modules import GRUModule
    >>> flatten = torch.nn.Sequential(torch.nn.Flatten(), torch.nn.Linear(12, 4))
    >>> policy = as_policy(
    ...     TensorDictSequential(
    ...         TensorDictModule(flatten, ["pixels"], ["features"]),
    ...         GRUModule(4, 4, in_key="features", out_key="remembered"),
    ...         TensorDictModule(torch.nn.Linear(4, 5), ["remembered"], ["action_value"]),
    ...     )
    ... )
    >>> features = policy.features(torch.zeros(2, 7, 2, 2, 3), batch_ndim=2)  # each frame once
    >>> outputs, state = policy.unroll(features)
    >>> outputs.shape, policy.offers
    (torch.Size([2, 7, 5]), ('q', 'value'))
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Unpack, get_args

import torch
from tensordict import unravel_key
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from arcade_torch.agents.forward import evaluating, state_of, state_of_rows
from arcade_torch.models.actor_critic import ActorCriticNetwork
from arcade_torch.models.networks import MemoryNetwork
from arcade_torch.tools.measures.arguments import check_white, no_policy
from arcade_torch.tools.measures.frames import float_type, floats_are_taken
from arcade_torch.tools.measures.keys import Channels, Keys, Names, refuse_unknown
from arcade_torch.tools.measures.masked import are_near, logarithms, refuse_nan

Target = Literal["auto", "q", "logits", "probs", "value"]
Progress = Callable[[int, int], None]  # called with (done, of how many)
DIFFERENT = 0.1  # of the outputs: more than the rounding of grey levels in a policy
ROUNDING = 5e-3  # of the outputs: more than batches of other shapes change them, on a card too
HALF_ROUNDING = 5e-2  # the same in half precision
FEW = 4  # frames that a policy is tried on before it is measured
TARGETS = ("q", "logits", "probs", "value")  # outputs that can be asked for by name


def read_plain(out: Tensor, output: str) -> Tensor:
    """Read outputs that are one number per action, or a single value."""
    if output == "probs":
        return out.softmax(-1)
    return out.amax(-1, keepdim=True) if output == "value" else out


@dataclass(frozen=True)
class Policy:
    """A policy in two functions.

    ``encode`` turns frames [N, ...], as the env gives them or as floats of the same values, into
    features [N, E], each frame on its own. ``remember`` is ``(features [B, T, E], last_action int64
    [B, T], is_init bool [B, T], state) -> (out [B, T, A], state)``, causal in time;
    ``initial_state`` gives, for a batch size, the state before the first frame: a TensorDict [B], a
    tensor [B, ...] (that of ``torch.nn.GRU`` has its layers first) or None.
    """

    encode: Callable[[Tensor], Tensor]
    remember: Callable[[Tensor, Tensor, Tensor, Any], tuple[Tensor, Any]]
    initial_state: Callable[[int], Any] = lambda batch_size: None
    # what its outputs mean: (out, one of TARGETS) -> [..., A or 1]
    read: Callable[[Tensor, str], Tensor] = read_plain
    offers: tuple[str, ...] = TARGETS  # which of `TARGETS` its outputs can be read as
    module: nn.Module | None = None  # put into evaluation mode while an analysis runs
    keys: Keys = field(default_factory=Keys)  # where an env has the frames, start flags and actions
    channels: Channels | None = None  # which axis of a frame they are; None: the shorter end
    # the value of a white pixel; None: 255 for whole numbers, 1 for floats
    white: float | None = None
    # (observations, state) -> (greedy actions, state); None: the best output
    step: Callable[[Any, Any], tuple[Tensor, Any]] | None = None
    splits: bool = True  # False: the features are the frames, encoding them saves nothing
    needs_last_action: bool = False  # whether it must be handed over; zeros are no default then
    # the types of frames that it was tried on, see `check`
    _tried: set[torch.dtype] = field(default_factory=set, init=False, repr=False, compare=False)

    def greedy(self, out: Tensor) -> Tensor:
        """The best action of outputs [..., R], int64 [...]."""
        return self._of_actions(out).argmax(-1)

    def _of_actions(self, out: Tensor) -> Tensor:
        """The numbers of actions [..., A] among outputs [..., R]."""
        return self.read(out, "q") if "q" in self.offers else self.logits(out)

    def logits(self, out: Tensor) -> Tensor:
        """Logits [..., A], those of a policy that offers probabilities alone their logarithms."""
        if "logits" in self.offers or "probs" not in self.offers:
            return self.read(out, "logits")
        return logarithms(self.read(out, "probs"))

    @torch.no_grad()
    def act(self, obs: Any, state: Any) -> tuple[Tensor, dict[str, Tensor], Any]:
        """Greedy actions for a batch of observations, as an agent gives them, in evaluation mode.

        ``obs`` holds ``pixels`` [N, ...], ``last_action`` [N] and ``is_init`` [N, 1]. Outputs that
        are no numbers are refused (ValueError).
        """
        with self.evaluating():
            if self.step is not None:
                action, state = self.step(obs, state)
                return action, {}, state
            rows = obs["pixels"].shape[0]
            features = self.encode(obs["pixels"]).unsqueeze(1)
            actions = obs["last_action"].reshape(rows, 1)
            flags = obs["is_init"].reshape(rows, 1)
            out, state = self.remember(features, actions, flags, state_of_rows(state, rows))
            values = self._of_actions(out[:, 0])
            refuse_nan(values)
            return values.argmax(-1), {}, state_of_rows(state, rows)

    @torch.no_grad()
    def features(
        self,
        frames: Tensor,
        chunk: int = 16,
        dtype: torch.dtype | None = None,
        *,
        batch_ndim: int = 1,
    ) -> Tensor:
        """Features [T, E] of frames [T, ...] without a graph, each frame encoded once, ``chunk`` at
        a time, as floats of ``dtype``, by default `float_type`; with ``batch_ndim=2`` [N, T, E] of
        sequences [N, T, ...].
        """
        batch = frames.shape[:batch_ndim]
        flat = frames.flatten(0, batch_ndim - 1)
        dtype = dtype or float_type(frames)
        features = torch.cat([self.encode(part.to(dtype)) for part in flat.split(chunk)])
        return features.reshape(*batch, -1)

    def unroll(
        self,
        features: Tensor,
        last_action: Tensor | None = None,
        is_init: Tensor | None = None,
        state: Any = None,
        *,
        target: str = "auto",
    ) -> tuple[Tensor, Any]:
        """Run memory and heads over sequences in evaluation mode; gradients flow.

        Args:
            features: [N, T, E], see `features`.
            last_action: int64 [N, T], or one-hot [N, T, A], the action that led to each frame;
                zeros by default.
            is_init: bool [N, T], whether a frame opens an episode; all false by default.
            state: recurrent state before step 0, batch [N], or as one tensor of floats [N, F]
                (`flatten_state`); the initial one by default.
            target: the outputs that are wanted, see `resolve`.

        Returns:
            (outputs [N, T, A], of the target ``value`` [N, T, 1]; the state after the last step).
        """
        batch = features.shape[:2]
        if last_action is None:
            last_action = self.no_actions(batch, features.device)
        if is_init is None:
            is_init = torch.zeros(batch, dtype=torch.bool, device=features.device)
        state = state_of_rows(state_of(state, self.initial_state, batch[0]), batch[0])
        name = resolve(self, target)
        with self.evaluating():
            out, state = self.remember(features, last_action, is_init.bool(), state)
        return self.read(out, name), state_of_rows(state, batch[0])

    def forward_frames(
        self,
        frames: Tensor,
        last_action: Tensor | None = None,
        is_init: Tensor | None = None,
        state: Any = None,
        *,
        target: str = "auto",
    ) -> Tensor:
        """Outputs of the last decision of sequences of frames [N, T, ...], [N, A]: encoder, memory
        and heads in evaluation mode, with gradients to the frames.

        Everything else is as for `unroll`. The signature is that of a forward function of Captum.
        """
        batch = frames.shape[:2]
        with self.evaluating():
            features = self.encode(frames.flatten(0, 1)).unflatten(0, batch)
        outputs, _ = self.unroll(features, last_action, is_init, state, target=target)
        return outputs[:, -1]

    def no_actions(self, batch: Sequence[int], device: torch.device) -> Tensor:
        """Last actions where none are handed over: zeros, int64 ``batch``.

        Raises:
            ValueError: the policy reads last actions, in a form that only its env knows.
        """
        if self.needs_last_action:
            raise ValueError(
                f"last_action must be handed over, this policy reads {self.keys.last_action!r}: "
                "the action that led to each frame, as the env gives it"
            )
        return torch.zeros(batch, dtype=torch.int64, device=device)

    def forward_step(
        self,
        frame: Tensor,
        state: Any,
        last_action: Tensor | None = None,
        is_init: Tensor | None = None,
        *,
        target: str = "auto",
    ) -> Tensor:
        """Outputs of one decision, [N, A], from a frame [N, ...] and the recurrent state before it;
        as one tensor (`flatten_state`) the state can be attributed to as well.
        """
        actions = None if last_action is None else last_action.unsqueeze(1)
        flags = None if is_init is None else is_init.reshape(-1, 1)
        return self.forward_frames(frame.unsqueeze(1), actions, flags, state, target=target)

    @torch.no_grad()
    def check(
        self,
        frames: Tensor,
        last_action: Tensor,
        is_init: Tensor,
        state: Any,
        dtype: torch.dtype | None = None,
    ) -> None:
        """Refuse a policy that a measure would read wrongly: one that says other things when frames
        are read in one go than when it acts on them one by one, or, of a TensorDict, that takes
        floats for other frames than whole numbers of the same values.

        ``frames`` [T, ...], ``last_action`` [T] and ``is_init`` [T] are those that it saw from
        ``state`` on; the first few are tried. A policy that few frames were tried on is not tried
        again, so that a measure of many windows pays for one.
        """
        dtype = dtype or float_type(frames)
        if dtype in self._tried:
            return
        few = slice(0, FEW)
        actions = last_action[None, few]
        starts = is_init[None, few].bool()
        target = resolve(self, "auto")
        with self.evaluating():
            with floats_are_taken(frames.dtype):
                features = self.features(frames[few], dtype=dtype)[None]
            # a policy may change its state in place
            first = None if state is None else state.clone()
            alone = [self.features(frame[None], dtype=dtype) for frame in frames[few]]
            together, _ = self.unroll(features, actions, starts, first, target=target)
            one_by_one = list[Tensor]()
            state = None if state is None else state.clone()
            for t, feature in enumerate(alone):
                at = slice(t, t + 1)
                out, state = self.unroll(
                    feature[None], actions[:, at], starts[:, at], state, target=target
                )
                one_by_one.append(out)
        rounding = ROUNDING if together.dtype.itemsize > 2 else HALF_ROUNDING
        refuse_nan(together)
        if not are_near(torch.cat(one_by_one, 1), together, rounding):
            raise ValueError(
                "the policy must say of frames in one go what it says of them one by one: in "
                "evaluation mode nothing may be drawn at random, entries of a batch may not mix, "
                "no later frame may count, and the state must be what is handed over and given "
                "back, no attribute of a module"
            )
        if self.step is not None and not frames.is_floating_point():
            frame = frames[None, :1]
            exact = self.forward_frames(frame, actions[:, :1], target=target)
            floats = self.forward_frames(frame.float(), actions[:, :1], target=target)
            if not are_near(floats, exact, DIFFERENT):
                raise ValueError(
                    f"the policy must read floats of 0 to 255 as it reads {frames.dtype}, got "
                    "other outputs: convert frames of any type alike (frames.float() / 255)"
                )
        if len(frames) >= FEW:
            self._tried.add(dtype)

    @contextmanager
    def evaluating(self) -> Iterator[None]:
        """Evaluation mode for a while; the modes before come back."""
        with evaluating(nn.Identity() if self.module is None else self.module):
            yield


def as_policy(model: Any, **names: Unpack[Names]) -> Policy:
    """Make of a model what every measure takes: a `Policy`.

    Measures call it with the keywords that they do not know, so these can be handed to them.

    Args:
        model: a TensorDict policy, such as a ``TensorDictSequential`` with our ``MemoryModule`` or
            TorchRL's ``LSTMModule`` or ``GRUModule``, or one without memory; an agent, a network
            with ``encode``, ``remember`` and ``initial_state``, a `Policy`, or a pair ``(encode,
            remember)``.
        **names: all optional. ``pixels_key``: the frames; by default the one entry that a policy
            reads beside the others. ``last_action_key``, ``is_init_key``, ``action_key``: by
            default the words before ``_key``; an env that lacks the first two need not have them.
            ``output_key`` and ``output_kind`` ("q", "logits", "probs"): what is looked at; by
            default what ``QValueModule`` or a distribution reads, or ``action_value``, ``logits``
            or ``probs``. ``value_key``: ``state_value`` by default. ``state_keys``: of the
            recurrent state, by default those whose next state is written under "next"; else pairs
            {key: key of the next state}. ``initial_state``: its start, a TensorDict of batch size
            [] or a dictionary; by default that of the module or its primer. ``channels`` ("first",
            "last"): by default the shorter of the two ends of a frame. ``white``: the value of a
            white pixel, by default 255 for whole numbers and 1 for floats.

    Raises:
        TypeError: ``model`` has none of these forms, or there is no such keyword.
        ValueError: a TensorDict policy reads or writes entries that say nothing to a measure, or
            ``white`` is no number above 0.
    """
    refuse_unknown(names)
    check_white(names.get("white"))
    model = getattr(model, "_orig_mod", model)  # of torch.compile
    network = getattr(model, "network", model)
    if isinstance(model, Policy):
        policy = model
        for rows in (1, 2):
            state_of_rows(policy.initial_state(rows), rows)
    elif isinstance(model, tuple) and len(model) == 2 and all(callable(part) for part in model):
        policy = Policy(model[0], model[1])
    elif all(hasattr(network, name) for name in ("encode", "remember", "initial_state")):
        policy = _of_network(model, network)
    elif isinstance(model, TensorDictModuleBase):
        return _of_module(model, names)
    else:
        raise TypeError(no_policy(model))
    return _renamed(policy, names) if names else policy


policy_of = as_policy
"""The name of before."""


def _of_network(model: Any, network: Any) -> Policy:
    """The policy of an agent, or of a network with the methods of ours."""
    module = network if isinstance(network, nn.Module) else None
    read = getattr(model, "outputs", None) or getattr(network, "select", None)
    offers = getattr(model, "offers", None) or getattr(network, "offers", None)
    if isinstance(network, MemoryNetwork) and read is None and "action_value" not in network.heads:
        read, offers = _heads_of(network)
    return Policy(
        network.encode,
        network.remember,
        network.initial_state,
        read or read_plain,
        tuple(offers or TARGETS),
        module,
    )


def _heads_of(network: MemoryNetwork) -> tuple[Callable[[Tensor, str], Tensor], tuple[str, ...]]:
    """How the outputs of a network with logits, a value, or both are read, and as what."""
    targets = {"logits": ("logits", "probs"), "state_value": ("value",)}
    offers = tuple(name for key in network.heads for name in targets.get(str(key), ()))

    def read(out: Tensor, target: str) -> Tensor:
        heads = network.by_head(out)
        if target == "value":
            return heads["state_value"]
        return heads["logits"].softmax(-1) if target == "probs" else heads["logits"]

    return read, offers


def _of_module(module: TensorDictModuleBase, names: Names) -> Policy:
    """The policy of a TensorDict module; one that only acts for a network of ours is that network,
    which can be cut in two.
    """
    # imported here: who has two functions needs no TorchRL
    from arcade_torch.tools.measures.tensordict_policy import TensorDictPolicy

    wrapper = TensorDictPolicy(module, names)
    reads_as_usual = set(names) <= set(RENAMES)
    if isinstance(wrapper.only_part, MemoryNetwork | ActorCriticNetwork) and reads_as_usual:
        step = wrapper.act_with_network if wrapper.chooses_itself else None
        network = replace(as_policy(wrapper.only_part), module=module, step=step)
        return _renamed(network, names)
    return Policy(
        encode=wrapper.encode,
        remember=wrapper.remember,
        initial_state=wrapper.initial_state,
        read=wrapper.output.read,
        offers=wrapper.output.offers,
        module=module,
        keys=wrapper.keys,
        channels=names.get("channels"),
        white=names.get("white"),
        step=wrapper.act,
        splits=wrapper.splits,
        needs_last_action=wrapper.reads_last_action,
    )


def _renamed(policy: Policy, names: Names) -> Policy:
    """The same policy on an env with other names, and frames of another kind."""
    fixed = [name for name in names if name not in RENAMES]
    if fixed:
        raise ValueError(
            f"{', '.join(fixed)} say how a TensorDict policy is read; this policy takes "
            f"{', '.join(RENAMES)}"
        )
    changes = dict[str, Any]()
    keys = policy.keys
    for name, value in names.items():
        if value is None:
            continue
        if name.endswith("_key"):
            keys = replace(keys, **{name.removesuffix("_key"): unravel_key(value)})
        else:
            changes[name] = value
    return replace(policy, keys=keys, **changes)


RENAMES = ("pixels_key", "action_key", "last_action_key", "is_init_key", "channels", "white")
"""The keywords of `as_policy` that any policy takes."""


def resolve(model: Any, target: str) -> str:
    """The output that is meant: ``auto`` is Q-values or, for a policy without them, action
    probabilities.

    Raises:
        ValueError: ``target`` is none of `TARGETS`, or this model does not offer it.
    """
    if target not in get_args(Target):
        raise ValueError(f"target must be one of {', '.join(TARGETS)} or auto, got {target!r}")
    names = as_policy(model).offers
    if target == "auto":
        return next(name for name in ("q", "probs", *names) if name in names)
    if target not in names:
        raise ValueError(
            f"this agent offers {', '.join(names)}, not {target!r}: choose one of these as target"
        )
    return target


def outputs(model: Any, target: str = "auto") -> Callable[[Tensor], Tensor]:
    """How the scalars that an analysis looks at, [..., K], follow from what ``remember`` returns,
    [..., R]; ``target`` as for `resolve`.
    """
    policy = as_policy(model)
    name = resolve(policy, target)
    return lambda out: policy.read(out, name)
