"""An encoder with few weights, so that weights and gradients fit into small files."""

from torch import nn

from arcade_torch.models.encoders import SmallEncoder


class TinyEncoder(SmallEncoder):
    """``SmallEncoder`` with 2 channels and 8 features: 720 parameters instead of 158,400."""

    def __init__(self, obs_size: int) -> None:
        super().__init__(obs_size)
        self.feature_size = 8
        self.conv1 = nn.Conv2d(3, 2, 4, 4)
        self.conv2 = nn.Conv2d(2, 2, 3)
        self.linear = nn.Conv2d(
            2, 8, 6
        )  # recorded as nn.Linear(72, 8), which is the same weights in another shape


NETWORK = {
    "preset": "small",
    "obs_size": 128,
    "encoder": TinyEncoder,
    "hidden_size": 8,
    "towers": 2,
}
"""Options of every recorded network beside its memory."""
