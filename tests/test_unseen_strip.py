"""What of a game the paper's encoder cannot see: its convolutions and pools leave the right and
lower edge over.
"""

import pytest
import torch
from torch import Tensor

import arcade_torch
from arcade_torch.models import PaperEncoder

SEEN = {128: 119, 256: 217}


def suits(name: str, size: int) -> Tensor:
    """The different pictures of the upper right corner, where AutoEncode answers and CountRecall
    asks.
    """
    env = arcade_torch.make(name, num_envs=32, observability="partial", seed=0, obs_size=size)
    pixels = env.rollout(40, break_when_any_done=False)["pixels"].flatten(0, 1)
    frames = pixels[:1].repeat(len(pixels), 1, 1, 1)
    corner = (slice(None), slice(0, size // 8), slice(size - size // 9, None))
    frames[corner] = pixels[corner]  # everything else is as in one frame
    return torch.unique(frames, dim=0)


@pytest.mark.parametrize(
    "name", ["AutoEncodeEasy", pytest.param("CountRecallHard", marks=pytest.mark.slow)]
)
@pytest.mark.parametrize("size", [128, 256])
def test_the_suit_in_the_corner_is_seen_in_part_at_128_pixels_and_not_at_all_at_256(
    name: str, size: int
) -> None:
    frames = suits(name, size)
    assert len(frames) == 4
    with torch.no_grad():
        features = PaperEncoder(size)(frames)
    assert len(torch.unique(frames[:, :, : SEEN[size]].flatten(1), dim=0)) == (
        4 if size == 128 else 1
    )
    assert len(torch.unique(features, dim=0)) == (4 if size == 128 else 1)


def test_at_256_pixels_the_lower_part_of_breakouts_board_is_not_seen() -> None:
    env = arcade_torch.make("BreakoutEasy", num_envs=16, seed=0, obs_size=256)
    pixels = env.rollout(40, break_when_any_done=False)["pixels"].flatten(0, 1)
    frames = pixels[:1].repeat(len(pixels), 1, 1, 1)
    frames[:, SEEN[256] :] = pixels[:, SEEN[256] :]
    frames = torch.unique(frames, dim=0)  # the paddle in many places, all else as in one frame
    assert len(frames) > 3
    with torch.no_grad():
        assert len(torch.unique(PaperEncoder(256)(frames[:8]), dim=0)) == 1
