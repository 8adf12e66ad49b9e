"""A function of a TensorDict as one CUDA graph: its kernels are launched once, together, and the
host waits for none of them.

tensordict's ``CudaGraphModule`` waits for the whole device before each replay, JAX included, and
forbids every other thread to call CUDA while it captures, which XLA's threads do.
"""

from collections.abc import Callable
from typing import Any, Protocol

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs.utils import exploration_type

Function = Callable[[TensorDictBase], TensorDictBase]
Work = Callable[[], None]

WARM_UPS = 3
"""Calls that run as they are before a graph is captured: optimisers make their state in the first,
libraries choose their kernels."""


class Recording(Protocol):
    """What records the work of a call, and repeats it."""

    def warm_up(self, work: Work) -> None:
        """Do the work as it is."""

    def record(self, work: Work) -> None:
        """Take the work down without doing it."""

    def replay(self) -> None:
        """Do what was recorded, on the memory that it was recorded on."""


class CudaRecording:
    """A ``torch.cuda.CUDAGraph``. Random numbers go on at every replay: torch counts on for the
    global generator.
    """

    def __init__(self) -> None:
        self._graph = torch.cuda.CUDAGraph()
        self._stream = torch.cuda.Stream()

    def warm_up(self, work: Work) -> None:
        """Do the work on the stream of the capture; the current stream goes on behind it."""
        current = torch.cuda.current_stream()
        self._stream.wait_stream(current)
        with torch.cuda.stream(self._stream):
            work()
        current.wait_stream(self._stream)

    def record(self, work: Work) -> None:
        """Capture; other threads may call CUDA meanwhile."""
        options = {"stream": self._stream, "capture_error_mode": "thread_local"}
        with torch.cuda.graph(self._graph, **options):  # type: ignore[arg-type]
            work()

    def replay(self) -> None:
        """Launch all kernels on the current stream."""
        self._graph.replay()


class _Captured:
    """The graph of one layout of inputs."""

    def __init__(self, function: Function, recording: Recording) -> None:
        self._function = function
        self._recording = recording
        self._calls = 0
        self._inputs: TensorDictBase | None = None
        self._result: TensorDictBase | None = None

    def __call__(self, data: TensorDictBase) -> TensorDictBase:
        self._calls += 1
        if self._calls <= WARM_UPS:
            self._recording.warm_up(lambda: self._run(data.copy()))
            assert self._result is not None
            return self._result
        if self._inputs is None:
            inputs = data.clone()
            self._recording.record(lambda: self._run(inputs.copy()))
            self._inputs = inputs
        else:
            torch._foreach_copy_(_leaves(self._inputs), _leaves(data))
        self._recording.replay()
        return self._copied(data)

    def _run(self, data: TensorDictBase) -> None:
        self._result = self._function(data)

    def _copied(self, data: TensorDictBase) -> TensorDictBase:
        """The result apart from the memory that the next replay writes; inputs that it hands on are
        the caller's.
        """
        assert self._result is not None and self._inputs is not None
        inputs = dict(self._inputs.items(True, True))
        result = self._result.empty()
        for key, value in self._result.items(True, True):
            is_input = value is inputs.get(key)
            result.set(key, data.get(key) if is_input else value.clone())
        return result


def _leaves(data: TensorDictBase) -> list[Tensor]:
    """All tensors, in an order that depends on their names alone."""
    return [value for _, value in sorted(data.items(True, True), key=lambda item: str(item[0]))]


class GraphedFunction:
    """Runs a function a few times as it is, then captures it as a CUDA graph, and replays that.

    For every layout of inputs (names, shapes, types) and every exploration type there is a graph of
    its own. What the function reads beside its input has to stay where it is in memory: weights
    that are changed in place, a step size in a tensor.

    Args:
        function: from a TensorDict to a TensorDict; asks for the value of no tensor. Its Python
            runs while it is captured, and never again.
        make_recording: what captures; None for a CUDA graph.
    """

    def __init__(
        self, function: Function, make_recording: Callable[[], Recording] | None = None
    ) -> None:
        self.function = function
        self._make_recording = make_recording or CudaRecording
        self._captured: dict[Any, _Captured] = {}

    def __call__(self, data: TensorDictBase) -> TensorDictBase:
        """What the function gives, in memory that no later call writes; ``data`` stays as it is."""
        layout = [exploration_type()]
        for key, value in data.items(True, True):
            layout.append((key, value.shape, value.dtype))
        signature = frozenset(layout)
        if signature not in self._captured:
            self._captured[signature] = _Captured(self.function, self._make_recording())
        return self._captured[signature](data)


class GraphedPolicy(TensorDictModuleBase):
    """A policy that acts by a CUDA graph.

    Args:
        policy: any TensorDict module.
        make_recording: see :class:`GraphedFunction`.
    """

    takes_one_layout = True
    """For ``ArcadeCollector``: the same entries at every step, and none that the last one wrote."""

    def __init__(
        self,
        policy: TensorDictModuleBase,
        make_recording: Callable[[], Recording] | None = None,
    ) -> None:
        super().__init__()
        self.policy = policy
        self.in_keys = policy.in_keys
        self.out_keys = policy.out_keys
        self._graphed = GraphedFunction(policy, make_recording)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Act as the policy does."""
        return self._graphed(tensordict)
