"""Pixel encoders: from uint8 frames [..., S, S, 3] to features [..., E].

An encoder also says what of a frame is worth storing (``compress``) and learns its input scaling
from random play (``calibrate``); both do nothing where there is nothing to do. Float frames in the
range 0..255 are accepted as well, and gradients reach them.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

__all__ = ["Encoder", "PaperEncoder", "SmallEncoder"]


class Encoder(nn.Module):
    """What the encoders share.

    Args:
        obs_size: S, side of a full frame in pixels.
        stored_size: s, side of a compressed frame in pixels.
        feature_size: E.
    """

    def __init__(self, obs_size: int, stored_size: int, feature_size: int) -> None:
        super().__init__()
        self.obs_size = obs_size
        self.stored_size = stored_size
        self.feature_size = feature_size
        self.amp = False
        """Whether convolutions and products are taken in bfloat16; weights and features stay as
        they are.
        """
        self.register_buffer("like", torch.empty(0), persistent=False)
        self.like: Tensor
        """An empty tensor with the dtype and the device of the parameters."""

    def compress(self, pixels: Tensor) -> Tensor:
        """The part of a frame that the encoder looks at; here the frame itself.

        Args:
            pixels: uint8 (or float, 0..255) [..., S, S, 3].

        Returns:
            same dtype, [..., s, s, 3].
        """
        return pixels

    def calibrate(self, pixels: Tensor) -> None:
        """Set the input scaling from frames of random play, uint8 [..., S, S, 3] or compressed;
        here nothing to do.
        """

    def forward(self, pixels: Tensor) -> Tensor:
        """Encode frames.

        Args:
            pixels: uint8 or float (0..255), full [..., S, S, 3] or compressed [..., s, s, 3].

        Returns:
            float [..., E], dtype of the parameters.

        Raises:
            ValueError: the last three dimensions are neither, or the frames are floats in 0..1.
        """
        frames = self._frames(pixels)
        if self.amp:
            with torch.autocast(frames.device.type, torch.bfloat16):
                features = self.features(frames)
            features = features.to(self.like.dtype)
        else:
            features = self.features(frames)
        return features.reshape(*pixels.shape[:-3], self.feature_size)

    def features(self, frames: Tensor) -> Tensor:
        """Encode compressed frames [N, s, s, 3] -> [N, E]."""
        raise NotImplementedError

    def _frames(self, pixels: Tensor) -> Tensor:
        """Compressed frames with one batch dimension, [N, s, s, 3]."""
        size = tuple(pixels.shape[-3:])
        full = (self.obs_size, self.obs_size, 3)
        stored = (self.stored_size, self.stored_size, 3)
        if size not in (full, stored):
            raise ValueError(
                f"frames must be [..., {self.obs_size}, {self.obs_size}, 3] (height, width, colour)"
                + (
                    ""
                    if full == stored
                    else f" or compressed [..., {self.stored_size}, {self.stored_size}, 3]"
                )
                + f", got {list(pixels.shape)}"
            )
        _check_floats(pixels)
        frames = pixels.reshape(-1, *size)
        return frames if size == stored else self.compress(frames)


def _check_floats(pixels: Tensor) -> None:
    """Refuse frames that somebody has divided by 255 already: the encoder does that itself.

    Floats are looked at where that waits for nothing: on the CPU, outside of compiled and
    vectorised functions.
    """
    if (
        not pixels.is_floating_point()
        or pixels.device.type != "cpu"
        or torch.compiler.is_compiling()
    ):
        return
    try:
        largest = float(pixels.detach().amax()) if pixels.numel() else 0.0
    except RuntimeError:  # vmap
        return
    if 0.0 < largest <= 1.0:
        raise ValueError(
            f"frames of floats go up to {largest:.3g}, expected uint8, or floats from 0 to 255 "
            "(not 0 to 1): "
            "take ToTensorImage away, or multiply by 255"
        )


# (kernel, stride) of the four convolutions and of the pool behind each; None: no pool.
_PAPER_LAYERS: dict[int, list[tuple[tuple[int, int], tuple[int, int] | None]]] = {
    128: [((5, 2), (2, 2)), ((3, 2), (2, 2)), ((3, 2), (3, 1)), ((1, 1), None)],
    256: [((7, 2), (2, 2)), ((3, 2), (2, 2)), ((3, 2), (2, 2)), ((3, 2), None)],
}
_PAPER_CHANNELS = (3, 64, 128, 256, 512)


def _side_seen(layers: list[tuple[tuple[int, int], tuple[int, int] | None]]) -> int:
    """Side of the upper left part of a frame that the one pixel behind the last layer depends
    on.
    """
    side = 1
    for convolution, pool in reversed(layers):
        for kernel, stride in filter(None, (pool, convolution)):
            side = (side - 1) * stride + kernel
    return side


class PaperEncoder(Encoder):
    """The paper's CNN: four convolutions (64, 128, 256, 512 channels), LeakyReLU, three max pools,
    512 features.

    Frames are divided by 255 here, once. The pool stands before the LeakyReLU (it is monotone, so
    the result is the same and the activation handles a quarter of the values), and everything is
    channels-last, which is how frames arrive: together 2.7 times as fast on a CPU as the textbook
    order.

    Convolutions and pools without padding leave over what does not fill their last window, so that
    the features never depend on the last 9 rows and columns of 128, or 39 of 256. :meth:`compress`
    cuts these off (up to the next even number): the features stay the same, with an eighth fewer
    values to compute and store, or a quarter.

    Args:
        obs_size: 128 (505,472 parameters) or 256 (1,558,656).

    Raises:
        ValueError: another size.

    Source: POPGym Arcade, network tables; third pool as the reference implementation has it (3x3,
        stride 1).
    """

    def __init__(self, obs_size: int = 128) -> None:
        if obs_size not in _PAPER_LAYERS:
            raise ValueError(f"the paper's encoder exists for obs_size 128 and 256, got {obs_size}")
        seen = _side_seen(_PAPER_LAYERS[obs_size])
        super().__init__(obs_size, seen + seen % 2, _PAPER_CHANNELS[-1])
        layers: list[nn.Module] = []
        for i, ((kernel, stride), pool) in enumerate(_PAPER_LAYERS[obs_size]):
            layers.append(nn.Conv2d(_PAPER_CHANNELS[i], _PAPER_CHANNELS[i + 1], kernel, stride))
            if pool is not None:
                layers.append(nn.MaxPool2d(*pool))
            layers.append(nn.LeakyReLU(inplace=True))
        self.layers = nn.Sequential(*layers)
        self.layers.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def compress(self, pixels: Tensor) -> Tensor:
        """The upper left part, which is all that the features depend on.

        Args:
            pixels: uint8 or float (0..255) [..., S, S, 3].

        Returns:
            a view, [..., s, s, 3] with s = 120 for S = 128 and 218 for 256.
        """
        return pixels[..., : self.stored_size, : self.stored_size, :]

    def features(self, frames: Tensor) -> Tensor:
        """[N, s, s, 3] -> [N, 512]."""
        x = frames.permute(0, 3, 1, 2).to(self.like.dtype) / 255
        return self.layers(x).flatten(1)  # type: ignore[no-any-return]


class SmallEncoder(Encoder):
    """A CNN for one CPU core: frames pooled, 8 x 8 patches, one convolution, one layer over all
    places, 128 features.

    Pooled frames are uint8 (floor of the block's mean; 3 KiB at 32 pixels), so they are pooled once
    and stored pooled. Input scaling: minus a per-pixel mean, divided by one number, the RMS of the
    centred pixels; :meth:`calibrate` sets both (before that: division by 255). Float frames are
    pooled without the floor.

    Args:
        obs_size: S, 32 times a power of two up to 256.
        side: of the pooled frame in pixels, 32 or 64, at most S.
        channels: of a patch.

    Raises:
        ValueError: another size.
    """

    def __init__(self, obs_size: int = 128, side: int = 32, channels: int = 32) -> None:
        if side not in (32, 64) or obs_size not in (32, 64, 128, 256) or side > obs_size:
            raise ValueError(
                "obs_size must be 32, 64, 128 or 256, and side 32 or 64 and no larger; got "
                f"{obs_size} and {side}"
            )
        super().__init__(obs_size, side, 128)
        self.conv1 = nn.Conv2d(3, channels, side // 8, side // 8)
        self.conv2 = nn.Conv2d(channels, 32, 3)
        self.linear = nn.Conv2d(32, 128, 6)
        self.linear.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.register_buffer("mean", torch.zeros(side, side, 3).permute(2, 0, 1))
        self.register_buffer("inverse_rms", torch.tensor(1 / 255))
        self.mean: Tensor
        self.inverse_rms: Tensor

    def compress(self, pixels: Tensor) -> Tensor:
        """Average pooling.

        Args:
            pixels: uint8 (floor of the mean) or float (the mean, differentiable) [..., S, S, 3].

        Returns:
            same dtype, [..., s, s, 3].
        """
        lead = pixels.shape[:-3]
        side = self.stored_size
        block = self.obs_size // self.stored_size
        if pixels.is_floating_point():
            return pixels.reshape(*lead, side, block, side, block, 3).mean(dim=(-4, -2))
        # beyond that the sums leave the cache: half as fast
        if pixels.device.type == "cpu" and lead.numel() > 64:
            chunks = pixels.reshape(-1, *pixels.shape[-3:]).split(64)
            return torch.cat([self._pool(chunk) for chunk in chunks]).reshape(*lead, side, side, 3)
        return self._pool(pixels).reshape(*lead, side, side, 3)

    def _pool(self, pixels: Tensor) -> Tensor:
        """uint8 [..., S, S, 3] -> uint8 [N * s, s, 3], floor of the block mean."""
        block = self.obs_size // self.stored_size
        # Sums fit int16 (8 * 8 * 255). Whole lines are added, never pixels of three values: rows
        # first, then each line to itself, moved by 1, 2 and 4 pixels; what every block-th pixel
        # then holds is the sum of its block.
        lines = pixels.reshape(-1, block, self.obs_size * 3).unbind(1)
        total = lines[0].to(torch.int16)
        for line in lines[1:]:
            total = total.add_(line)
        for step in (3, 6, 12)[: block.bit_length() - 1]:
            total = total[:, :-step] + total[:, step:]
        mean = total.unfold(1, 3, 3 * block) >> (2 * (block.bit_length() - 1))
        return mean.to(torch.uint8)

    @torch.no_grad()
    def calibrate(self, pixels: Tensor) -> None:
        """Set mean and RMS from frames of random play (3,200 frames are plenty).

        Args:
            pixels: uint8, full [..., S, S, 3] or compressed [..., s, s, 3].

        Raises:
            ValueError: no frames, or of another size.
        """
        chunks = pixels.reshape(-1, *pixels.shape[-3:]).split(256)
        frames = torch.cat([self._frames(chunk) for chunk in chunks])
        if frames.shape[0] == 0:
            raise ValueError("calibrate needs at least one frame, got none")
        centred = frames.to(self.mean.device, torch.float64)
        mean = centred.mean(0)
        # one grey level: frames that never change
        rms = (centred - mean).square().mean().sqrt().clamp_min(1.0)
        self.mean.copy_(mean.permute(2, 0, 1))
        self.inverse_rms.copy_(1 / rms)

    def features(self, frames: Tensor) -> Tensor:
        """[N, s, s, 3] -> [N, 128]."""
        # colours stay last, as they arrive
        x = torch.sub(frames, self.mean.permute(1, 2, 0)).permute(0, 3, 1, 2)
        weight = self.conv1.weight * self.inverse_rms  # rather the weights than every pixel
        # three channels: bfloat16 takes twice as long on a CPU
        with torch.autocast(x.device.type, enabled=False):
            x = F.leaky_relu_(F.conv2d(x, weight, self.conv1.bias, self.conv1.stride))
        x = F.leaky_relu_(self.conv2(x))
        return F.leaky_relu_(F.layer_norm(self.linear(x).flatten(1), (self.feature_size,)))
