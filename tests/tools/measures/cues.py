"""An env of TorchRL that is none of ours: vectors in place of frames, with names of its own."""

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torch.nn.functional import one_hot
from torchrl.data import Binary, Categorical, Composite, OneHot, Unbounded
from torchrl.envs import EnvBase

CUES = 4
STEPS = 8


class CueEnv(EnvBase):
    """Every step shows one of four cues as a vector; nobody rewards anything."""

    def __init__(
        self,
        size: int | None = 4,
        is_one_hot: bool = False,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        shape = [] if size is None else [size]
        super().__init__(batch_size=shape)
        self.dtype_of_cues = dtype
        flag = Binary(1, shape=(*shape, 1), dtype=torch.bool)
        count = Unbounded((*shape, 1), dtype=torch.int64)
        self.observation_spec = Composite(
            {"cue": Unbounded((*shape, CUES), dtype=dtype), "count": count}, shape=shape
        )
        action: Any = Categorical(CUES, shape=shape)
        if is_one_hot:
            action = OneHot(CUES, shape=(*shape, CUES))
        self.full_action_spec = Composite({"action": action}, shape=shape)
        self.reward_spec = Unbounded((*shape, 1))
        self.full_done_spec = Composite({"done": flag, "terminated": flag.clone()}, shape=shape)
        self.generator = torch.Generator()

    def _set_seed(self, seed: int | None) -> None:
        self.generator.manual_seed(seed or 0)

    def _observe(self, count: Tensor) -> TensorDict:
        cue = torch.randint(CUES, self.batch_size, generator=self.generator)
        done = count >= STEPS
        entries = {"cue": one_hot(cue, CUES).to(self.dtype_of_cues), "count": count}
        return TensorDict(entries | {"done": done, "terminated": done}, self.batch_size)

    def _reset(self, tensordict: TensorDictBase | None = None) -> TensorDictBase:
        return self._observe(torch.zeros((*self.batch_size, 1), dtype=torch.int64))

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        after = self._observe(tensordict["count"] + 1)
        return after.set("reward", torch.zeros(*self.batch_size, 1))
