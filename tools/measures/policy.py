"""What the analyses ask of a policy: two functions, and which of its outputs is meant.

Saliency, recall density and contamination work on anything that can be cut in two: ``encode`` looks
at single frames, ``remember`` is everything behind it. Agents and networks of this package have
both as methods; wrap any other module in a `Policy`.

Example:
    >>> encoder, head = torch.nn.Linear(12, 4), torch.nn.Linear(4, 5)
    >>> policy = Policy(
    ...     encode=lambda frames: encoder(frames.flatten(-3) / 255),
    ...     remember=lambda features, action, is_init, state: (head(features.cumsum(1)), state),
    ... )
    >>> policy.encode(torch.zeros(7, 2, 2, 3)).shape
    torch.Size([7, 4])
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal, get_args

import torch
from torch import Tensor, nn

Target = Literal["auto", "q", "logits", "probs", "value"]
Progress = Callable[[int, int], None]  # called with (done, of how many)
TARGETS = ("q", "logits", "probs", "value")  # outputs that can be asked for by name


def read_plain(out: Tensor, output: str) -> Tensor:
    """Read outputs that are one number per action, or a single value."""
    if output == "probs":
        return out.softmax(-1)
    return out.amax(-1, keepdim=True) if output == "value" else out


@dataclass(frozen=True)
class Policy:
    """A policy in two functions.

    ``encode`` turns frames, float or uint8 0..255 [N, H, W, C], into features [N, E], each frame on
    its own. ``remember`` is ``(features [B, T, E], last_action int64 [B, T], is_init bool [B, T],
    state) -> (out [B, T, A], state)``, causal in time; ``initial_state`` gives, for a batch size,
    the state before the first frame: a TensorDict [B], a tensor [B, ...] or None.
    """

    encode: Callable[[Tensor], Tensor]
    remember: Callable[[Tensor, Tensor, Tensor, Any], tuple[Tensor, Any]]
    initial_state: Callable[[int], Any] = lambda batch_size: None
    # what its outputs mean: (out, one of TARGETS) -> [..., A or 1]
    read: Callable[[Tensor, str], Tensor] = read_plain
    offers: tuple[str, ...] = TARGETS  # which of `TARGETS` its outputs can be read as
    module: nn.Module | None = None  # put into evaluation mode while an analysis runs

    def greedy(self, out: Tensor) -> Tensor:
        """The best action of outputs [..., R], int64 [...]."""
        return self.read(out, "q" if "q" in self.offers else "logits").argmax(-1)

    @torch.no_grad()
    def act(self, obs: Any, state: Any) -> tuple[Tensor, dict[str, Tensor], Any]:
        """Greedy actions for a batch of observations, as an agent gives them."""
        steps = obs["pixels"].shape[0], 1
        features = self.encode(obs["pixels"]).unsqueeze(1)
        out, state = self.remember(
            features, obs["last_action"].reshape(steps), obs["is_init"].reshape(steps), state
        )
        return self.greedy(out[:, 0]), {}, state

    @torch.no_grad()
    def features(
        self, frames: Tensor, chunk: int = 16, dtype: torch.dtype = torch.float32
    ) -> Tensor:
        """Features [T, E] of frames [T, H, W, C] without a graph, ``chunk`` frames at a time."""
        return torch.cat([self.encode(part.to(dtype)) for part in frames.split(chunk)])

    @contextmanager
    def evaluating(self) -> Iterator[None]:
        """Evaluation mode for a while; the mode before comes back."""
        module = nn.Identity() if self.module is None else self.module
        training = module.training
        module.eval()
        try:
            yield
        finally:
            module.train(training)


def policy_of(model: Any) -> Policy:
    """The two functions of whatever an analysis was given.

    Args:
        model: an agent with an attribute ``network``, a network with ``encode``, ``remember`` and
            ``initial_state``, a `Policy`, or a pair ``(encode, remember)``.

    Raises:
        TypeError: ``model`` has none of these forms.
    """
    if isinstance(model, Policy):
        return model
    if isinstance(model, tuple) and len(model) == 2 and all(callable(part) for part in model):
        return Policy(model[0], model[1])
    network = getattr(model, "network", model)
    if all(hasattr(network, name) for name in ("encode", "remember", "initial_state")):
        module = network if isinstance(network, nn.Module) else None
        read = getattr(model, "outputs", None) or getattr(network, "select", None) or read_plain
        offers = getattr(model, "offers", None) or getattr(network, "offers", None) or TARGETS
        return Policy(
            network.encode, network.remember, network.initial_state, read, tuple(offers), module
        )
    forms = "an agent, a network with encode and remember, a Policy or a pair (encode, remember)"
    raise TypeError(f"model must be {forms}, got {type(model).__name__}")


def resolve(model: Any, target: str) -> str:
    """The output that is meant: ``auto`` is Q-values or, for a policy without them, action
    probabilities.

    Raises:
        ValueError: ``target`` is none of `TARGETS`, or this model does not offer it.
    """
    if target not in get_args(Target):
        raise ValueError(f"target must be one of {', '.join(TARGETS)} or auto, got {target!r}")
    names = policy_of(model).offers
    if target == "auto":
        return next(name for name in ("q", "probs", *names) if name in names)
    if target not in names:
        raise ValueError(
            f"this agent offers {', '.join(names)}, not {target!r}: choose one of these as target"
        )
    return target


def outputs(model: Any, target: str = "auto") -> Callable[[Tensor], Tensor]:
    """How the scalars that an analysis looks at, [..., K], follow from what ``remember`` returns,
    [..., R].

    ``target`` is ``q``, ``logits``, ``probs``, ``value`` or ``auto``, see `resolve`.
    """
    policy = policy_of(model)
    name = resolve(model, target)
    return lambda out: policy.read(out, name)
