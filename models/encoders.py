"""Pixel encoders: from uint8 frames [..., S, S, 3] to features [..., E].

An encoder also says what of a frame is worth storing (``compress``) and learns its input scaling
from random play (``calibrate``); both do nothing where there is nothing to do. Float frames in the
range 0..255 are accepted as well, and gradients reach them.
"""

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from arcade_torch.models.arguments import check_sizes, is_whole

__all__ = ["Encoder", "PaperEncoder", "SmallEncoder"]


class Encoder(nn.Module):
    """What the encoders share.

    Args:
        obs_size: S, side of a full frame in pixels.
        stored_shape: of a compressed frame, three numbers.
        feature_size: E.
    """

    def __init__(
        self, obs_size: int, stored_shape: tuple[int, int, int], feature_size: int
    ) -> None:
        super().__init__()
        self.obs_size = obs_size
        self.sides: tuple[int, ...] = (obs_size,)
        """Sides of the pictures that ``compress`` takes."""
        self.stored_shape = stored_shape
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
            same dtype, [..., *stored_shape].
        """
        return pixels

    def calibrate(self, pixels: Tensor) -> None:
        """Set the input scaling from frames of random play, uint8 [..., S, S, 3] or compressed;
        here nothing to do.
        """

    def forward(self, pixels: Tensor) -> Tensor:
        """Encode frames.

        Args:
            pixels: uint8 or float (0..255), full [..., S, S, 3] or compressed
                [..., *stored_shape].

        Returns:
            float [..., E], dtype of the parameters.

        Raises:
            ValueError: the last three dimensions are neither, the frames are floats in 0..1, or
                neither uint8 nor floats.
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
        """Encode compressed frames [N, *stored_shape] -> [N, E]."""
        raise NotImplementedError

    def _frames(self, pixels: Tensor) -> Tensor:
        """Compressed frames with one batch dimension, [N, *stored_shape]."""
        self._check_frames(pixels)
        _check_floats(pixels)
        frames = pixels.reshape(-1, *pixels.shape[-3:])
        return frames if self._is_stored(pixels) else self.compress(frames)

    def _is_stored(self, pixels: Tensor) -> bool:
        """Whether frames are compressed."""
        return tuple(pixels.shape[-3:]) == self.stored_shape

    def _check_frames(self, pixels: Any) -> None:
        """Raise ValueError unless these are frames, full or compressed, of bytes or floats."""
        if not isinstance(pixels, Tensor):
            raise ValueError(f"frames must be a tensor, got {type(pixels)}")
        shape = tuple(pixels.shape[-3:])
        if not self._is_stored(pixels) and shape not in [(side, side, 3) for side in self.sides]:
            size = f"[..., {self.obs_size}, {self.obs_size}, 3]"
            stored = f"[..., {', '.join(map(str, self.stored_shape))}]"
            raise ValueError(
                f"frames must be {size} (height, width, colour)"
                + ("" if stored == size else f" or compressed {stored}")
                + f", got {list(pixels.shape)}"
            )
        if pixels.dtype != torch.uint8 and not pixels.is_floating_point():
            raise ValueError(f"frames must be uint8 or floats, from 0 to 255, got {pixels.dtype}")


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
            "(not 0 to 1): take ToTensorImage away, or multiply by 255"
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
        if not is_whole(obs_size) or obs_size not in _PAPER_LAYERS:
            raise ValueError(f"the paper's encoder exists for obs_size 128 and 256, got {obs_size}")
        seen = _side_seen(_PAPER_LAYERS[obs_size])
        side = seen + seen % 2
        super().__init__(obs_size, (side, side, 3), _PAPER_CHANNELS[-1])
        layers: list[nn.Module] = []
        for i, ((kernel, stride), pool) in enumerate(_PAPER_LAYERS[obs_size]):
            layers.append(nn.Conv2d(_PAPER_CHANNELS[i], _PAPER_CHANNELS[i + 1], kernel, stride))
            if pool is not None:
                layers.append(nn.MaxPool2d(*pool))
            layers.append(nn.LeakyReLU(inplace=True))
        self.layers = nn.Sequential(*layers)

    def compress(self, pixels: Tensor) -> Tensor:
        """The upper left part, which is all that the features depend on.

        Args:
            pixels: uint8 or float (0..255) [..., S, S, 3].

        Returns:
            a view, [..., s, s, 3] with s = 120 for S = 128 and 218 for 256.

        Raises:
            ValueError: no frames of this size, neither full nor compressed.
        """
        self._check_frames(pixels)
        rows, columns, _ = self.stored_shape
        return pixels[..., :rows, :columns, :]

    def features(self, frames: Tensor) -> Tensor:
        """[N, s, s, 3] -> [N, 512]."""
        x = frames.permute(0, 3, 1, 2).to(self.like.dtype) / 255
        return self.layers(x).flatten(1)  # type: ignore[no-any-return]


PATCHES = 8  # patches of the small encoder on a side of a frame


class SmallEncoder(Encoder):
    """A CNN for one CPU core: frames pooled, 8 x 8 patches, one convolution, one layer over all
    places, 128 features.

    A compressed frame is pooled to side x side pixels (uint8, floor of the block's mean) and stands
    in patches, uint8 [8, 8, k * k * 3] with k = side / 8: 3 KiB for 32 pixels, 12 for 64. So
    frames are pooled and ordered once, and the first layer, a convolution whose windows do not
    overlap, is one product of patches and weights. Input scaling: minus a per-pixel mean, divided
    by one number, the RMS of the centred pixels; :meth:`calibrate` sets both (before that: division
    by 255). Float frames are pooled without the floor.

    Args:
        obs_size: S, 32 times a power of two up to 256.
        side: of the pooled frame in pixels, 32 or 64, at most S.
        channels: of a patch.

    Raises:
        ValueError: another size, or no channels.
    """

    def __init__(self, obs_size: int = 128, side: int = 32, channels: int = 32) -> None:
        check_sizes(side=side)
        if not is_whole(channels) or channels < 1:
            raise ValueError(f"channels must be a whole number from 1, got {channels!r}")
        is_size = is_whole(obs_size) and obs_size in (32, 64, 128, 256)
        if side not in (32, 64) or not is_size or side > obs_size:
            raise ValueError(
                "obs_size must be 32, 64, 128 or 256, and side 32 or 64 and no larger; got "
                f"{obs_size} and {side}"
            )
        patch = side // PATCHES
        super().__init__(obs_size, (PATCHES, PATCHES, patch * patch * 3), 128)
        self.side = side
        self.sides = (obs_size, side)
        self.conv1 = nn.Conv2d(3, channels, patch, patch)
        self.conv2 = nn.Conv2d(channels, 32, 3)
        self.linear = nn.Conv2d(32, 128, 6)
        self.register_buffer("mean", torch.zeros(side, side, 3).permute(2, 0, 1))
        self.register_buffer("inverse_rms", torch.tensor(1 / 255))
        self.mean: Tensor
        self.inverse_rms: Tensor

    def compress(self, pixels: Tensor) -> Tensor:
        """Average pooling, and the order of patches.

        Args:
            pixels: uint8 (floor of the mean) or float (the mean, differentiable) [..., S, S, 3],
                pooled already, [..., side, side, 3], or compressed already.

        Returns:
            same dtype, [..., 8, 8, k * k * 3].

        Raises:
            ValueError: none of these.
        """
        self._check_frames(pixels)
        if self._is_stored(pixels):
            return pixels
        lead = pixels.shape[:-3]
        if pixels.is_floating_point():
            block = pixels.shape[-2] // self.side
            blocks = pixels.reshape(*lead, self.side, block, self.side, block, 3)
            return self._patches(blocks.mean(dim=(-4, -2)))
        # the sums of more frames leave the cache of a core: a third slower
        together = 2**18 // pixels.shape[-2] ** 2
        if pixels.device.type == "cpu" and lead.numel() > together:
            chunks = pixels.reshape(-1, *pixels.shape[-3:]).split(together)
            pooled = torch.cat([self._patches(self._pool(chunk)) for chunk in chunks])
        else:
            pooled = self._patches(self._pool(pixels))
        return pooled.reshape(*lead, *self.stored_shape)

    def _patches(self, pooled: Tensor) -> Tensor:
        """Pooled frames [..., side, side, 3] in patches, [..., 8, 8, k * k * 3]."""
        patch = self.side // PATCHES
        lead = pooled.shape[:-3]
        squares = pooled.reshape(*lead, PATCHES, patch, PATCHES, patch, 3)
        return squares.transpose(-4, -3).reshape(*lead, *self.stored_shape)

    def _pool(self, pixels: Tensor) -> Tensor:
        """uint8 [..., S, S, 3] -> uint8 [N, side, side, 3], floor of the block mean."""
        size = pixels.shape[-2]
        block = size // self.side
        # Sums fit int16 (8 * 8 * 255). Whole lines are added, never pixels of three values: rows
        # first, then each line to itself, moved by 1, 2 and 4 pixels; what every block-th pixel
        # then holds is the sum of its block.
        lines = pixels.reshape(-1, block, size * 3).unbind(1)
        total = lines[0].to(torch.int16)
        for line in lines[1:]:
            total = total.add_(line)
        for step in (3, 6, 12)[: block.bit_length() - 1]:
            total = total[:, :-step] + total[:, step:]
        mean = total.unfold(1, 3, 3 * block) >> (2 * (block.bit_length() - 1))
        return mean.to(torch.uint8).reshape(-1, self.side, self.side, 3)

    @torch.no_grad()
    def calibrate(self, pixels: Tensor) -> None:
        """Set mean and RMS from frames of random play (3,200 frames are plenty).

        Args:
            pixels: uint8 or float (0..255), full [..., S, S, 3] or compressed [..., 8, 8, k * k *
                3].

        Raises:
            ValueError: no frames, of another size, or with entries that are NaN or infinite.
        """
        chunks = pixels.reshape(-1, *pixels.shape[-3:]).split(256)
        frames = torch.cat([self._frames(chunk) for chunk in chunks])
        if frames.shape[0] == 0:
            raise ValueError("calibrate needs at least one frame, got none")
        centred = frames.to(self.mean.device, torch.float64)
        mean = centred.mean(0)
        if not mean.isfinite().all():
            raise ValueError("frames must be finite, got NaN or infinity")
        # one grey level: frames that never change
        rms = (centred - mean).square().mean().sqrt().clamp_min(1.0)
        patch = self.side // PATCHES
        squares = mean.reshape(PATCHES, PATCHES, patch, patch, 3).transpose(1, 2)
        self.mean.copy_(squares.reshape(self.side, self.side, 3).permute(2, 0, 1))
        self.inverse_rms.copy_(1 / rms)

    def features(self, frames: Tensor) -> Tensor:
        """[N, 8, 8, k * k * 3] -> [N, 128]."""
        mean = self._patches(self.mean.permute(1, 2, 0))
        weight = self.conv1.weight * self.inverse_rms  # rather the weights than every pixel
        weight = weight.permute(0, 2, 3, 1).flatten(1)  # [C, k * k * 3], the order of a patch
        layers = self._in_bfloat16 if self.amp else self._in_float32
        return F.leaky_relu_(F.layer_norm(layers(frames, mean, weight), (self.feature_size,)))

    def _in_float32(self, frames: Tensor, mean: Tensor, weight: Tensor) -> Tensor:
        """The three layers as products and a convolution."""
        x = frames.to(mean.dtype) - mean  # half the time of subtracting from bytes
        x = F.leaky_relu_(F.linear(x, weight, self.conv1.bias)).permute(0, 3, 1, 2)
        return self._all_places(F.leaky_relu_(self.conv2(x)))

    def _in_bfloat16(self, frames: Tensor, mean: Tensor, weight: Tensor) -> Tensor:
        """The same in bfloat16.

        Pixels minus a whole number are exact there; what that leaves of the mean goes, times the
        weights, into a bias for every place.
        """
        whole = mean.round()
        bias = F.linear(whole - mean, weight, self.conv1.bias).to(torch.bfloat16)
        x = F.linear(torch.sub(frames, whole.to(torch.bfloat16)), weight) + bias
        x = F.leaky_relu_(x).permute(0, 3, 1, 2)
        return self._all_places(F.leaky_relu_(self.conv2(x)))

    def _all_places(self, x: Tensor) -> Tensor:
        """The last layer, [N, 32, 6, 6] -> [N, 128]; pixel by pixel, as the values lie."""
        weight = self.linear.weight.permute(0, 2, 3, 1).flatten(1)
        return F.linear(x.permute(0, 2, 3, 1).flatten(1), weight, self.linear.bias)
