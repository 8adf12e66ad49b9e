"""Convolutions, max pools and LeakyReLUs, differentiated with respect to their input from a tape.

All that such a gradient depends on, beside the weights, is which value of each pool's window won and whether it was
positive: two bytes for each pooled value, less than a tenth of what autograd keeps. The last step of the way back, to
the frames, is by far the widest; it is done by ``tiles.py``.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from arcade_torch.models.pullback import Pull
from arcade_torch.models.tiles import Tiles

__all__ = ["in_phases", "recorded_on_tape"]


@torch.no_grad()
def recorded_on_tape(
    layers: nn.Sequential, frames: Tensor, dtype: torch.dtype, divisor: float
) -> tuple[Tensor, Pull] | None:
    """Record convolutions, each followed by an optional max pool without overlap and a LeakyReLU.

    Args:
        layers: the encoder; 1x1 pixels are left at its end.
        frames: uint8 or float [N, S, S, C].
        dtype: of the parameters.
        divisor: the frames are divided by it first.

    Returns:
        ``(features [N, E], Pull)``, or None if the layers are others than these.
    """
    tape = list[_Layer]()
    x = frames.permute(0, 3, 1, 2).to(dtype) / divisor
    for conv, pool, activation in _in_threes(layers):
        done = _Layer.forward(conv, pool, activation, x)
        if done is None:
            return None
        tape.append(done[0])
        x = done[1]
    if x.shape[2:] != (1, 1):
        return None

    @torch.no_grad()
    def pull(cotangents: Tensor, index: Tensor) -> Iterator[Tensor]:
        g = cotangents[:, :, None, None] / divisor  # division is where the numbers are fewest
        for layer in reversed(tape[1:]):
            g = layer.backward(g, layer.mask(index))
        size = 1 if one_by_one(g.device) else len(index)
        groups = g.split(size, dim=1)
        to_frames = Tiles(tape[0].conv.weight, tape[0].conv.stride[0], tape[0].window, groups[0].shape)
        for group, part in zip(groups, index.split(size), strict=True):
            yield to_frames(group, tape[0].mask(part))

    return x.flatten(1), pull


def one_by_one(device: torch.device) -> bool:
    """Whether to do the last step a frame at a time: what it then needs stays in a CPU's cache."""
    return device.type == "cpu"


def _in_threes(layers: nn.Sequential) -> Iterator[tuple[nn.Module, nn.Module | None, nn.Module | None]]:
    """Convolution, pool or None, activation."""
    rest = list(layers)
    while rest:
        conv = rest.pop(0)
        pool = rest.pop(0) if rest and isinstance(rest[0], nn.MaxPool2d) else None
        yield conv, pool, rest.pop(0) if rest else None


@dataclass(frozen=True)
class _Layer:
    """One convolution with what follows it, and what it did to some frames.

    Attributes:
        conv: the convolution.
        height: of what went into it.
        width: of what went into it.
        shape: height and width of what came out, before the pool.
        window: side of the pool, 1 without one.
        slope: of the LeakyReLU below zero.
        winner: uint8 [N, h, w, C], how far behind the first value of its window the largest lies, rows unrolled; None
            without a pool.
        positive: bool [N, h, w, C], whether the largest is.
    """

    conv: nn.Conv2d
    height: int
    width: int
    shape: tuple[int, int]
    window: int
    slope: float
    winner: Tensor | None
    positive: Tensor

    @classmethod
    def forward(
        cls, conv: nn.Module, pool: nn.Module | None, activation: nn.Module | None, x: Tensor
    ) -> "tuple[_Layer, Tensor] | None":
        """The layer and its output [N, C, h, w], or None if it is not of the kind :func:`recorded_on_tape` knows."""
        if type(conv) is not nn.Conv2d or type(activation) is not nn.LeakyReLU:
            return None
        kernel, plain = conv.kernel_size, conv.dilation == (1, 1) and conv.groups == 1 and conv.padding == (0, 0)
        if not plain or kernel[0] != kernel[1] or conv.stride[0] != conv.stride[1]:
            return None
        # In phases as for autograd: where values tie, rounding says which of them wins.
        y = out = in_phases(x, conv) if suits_phases(conv, *x.shape[2:]) else conv(x)
        window, winner = 1, None
        if pool is not None:
            pooled = _pooled(pool, y)
            if pooled is None:
                return None
            window, out, winner = pooled
        (height, width), (high, wide) = x.shape[2:], y.shape[2:]
        positive = (out > 0).permute(0, 2, 3, 1)
        layer = cls(conv, height, width, (high, wide), window, activation.negative_slope, winner, positive)
        return layer, F.leaky_relu_(out, activation.negative_slope)

    def mask(self, index: Tensor) -> Tensor:
        """What cotangents of some frames, int64 [n], are multiplied with: slopes for winners, zeros for the others.

        Returns:
            float [k, k, n, h, w, C], row and column in windows of k x k first.
        """
        slopes = self.positive.index_select(0, index).to(self.conv.weight.dtype).mul_(1 - self.slope).add_(self.slope)
        if self.winner is None:
            return slopes[None, None]
        side = torch.arange(self.window, device=index.device)
        places = (side[:, None] * self.shape[1] + side).to(torch.uint8)[..., None, None, None, None]
        mask = slopes.new_empty(self.window, self.window, *slopes.shape)
        return torch.eq(self.winner.index_select(0, index), places, out=mask).mul_(slopes)

    def backward(self, g: Tensor, mask: Tensor) -> Tensor:
        """Pull cotangents back.

        Args:
            g: float [K, n, h, w, C].
            mask: of the same frames.

        Returns:
            float [K, n, height, width, C'].
        """
        (k, _, _, h, w, channels), lead, (high, wide) = mask.shape, g.shape[:2], self.shape
        covered = (h * k, w * k) == (high, wide)  # what no window covers stays zero
        full = (g.new_empty if covered else g.new_zeros)(*lead, high, wide, channels)
        windows = full[:, :, : h * k, : w * k].unflatten(2, (h, k)).unflatten(4, (w, k))
        torch.mul(g[:, :, :, None, :, None], mask.permute(2, 3, 0, 4, 1, 5), out=windows)
        weight, stride = self.conv.weight, self.conv.stride[0]
        made = [(out - 1) * stride + kernel for out, kernel in zip((high, wide), weight.shape[2:], strict=True)]
        missing = (self.height - made[0], self.width - made[1])
        batch = full.flatten(0, 1).permute(0, 3, 1, 2)
        pulled = F.conv_transpose2d(batch, weight, stride=stride, output_padding=missing)
        return pulled.permute(0, 2, 3, 1).unflatten(0, lead)  # type: ignore[no-any-return]


def _pooled(pool: nn.Module, y: Tensor) -> tuple[int, Tensor, Tensor] | None:
    """Side of the windows, largest values, and where in its window each lies; None if windows are not plain tiles."""
    if type(pool) is not nn.MaxPool2d or not isinstance(pool.kernel_size, int):
        return None
    side, wide = pool.kernel_size, y.shape[3]
    out, place = F.max_pool2d(y, side, pool.stride, pool.padding, pool.dilation, pool.ceil_mode, return_indices=True)
    h, w = out.shape[2:]
    tiles = pool.stride == side or (h, w) == (1, 1)
    plain = pool.padding == 0 and pool.dilation == 1 and not pool.ceil_mode
    if not (tiles and plain and (side - 1) * (wide + 1) < 256):
        return None
    rows, columns = torch.arange(h, device=y.device) * side, torch.arange(w, device=y.device) * side
    first = (rows[:, None] * wide + columns).to(torch.uint8)
    return side, out, (place.to(torch.uint8) - first).permute(0, 2, 3, 1)  # modulo 256: the difference is exact


def suits_phases(conv: nn.Conv2d, height: int, width: int) -> bool:
    """Whether :func:`in_phases` can stand for a convolution, and is worth it: stride 2, few channels, even sides."""
    return conv.stride == (2, 2) and conv.in_channels < 8 and height % 2 == 0 and width % 2 == 0


def in_phases(x: Tensor, conv: nn.Conv2d) -> Tensor:
    """A convolution of stride 2 as one of stride 1 over the four phases of the picture, [N, C, H, W] with even H, W.

    The same sums in another order. Its gradient with respect to the picture is two to three times as fast on a CPU:
    three channels fill a fifth of a vector register, twelve most of one. Forward it is slower, so it is
    for frames whose gradient is wanted.
    """
    batch, channels, height, width = x.shape
    # Channels last, as frames arrive: rows of two pixels stay together in memory, there and back.
    phases = x.permute(0, 2, 3, 1).reshape(batch, height // 2, 2, width // 2, 2 * channels).transpose(2, 3)
    phases = phases.reshape(batch, height // 2, width // 2, 4 * channels).permute(0, 3, 1, 2)
    return F.conv2d(phases, weight_in_phases(conv.weight), conv.bias)


def weight_in_phases(weight: Tensor) -> Tensor:
    """The weight of a convolution of stride 2 as that of one of stride 1 over the four phases of the picture.

    Args:
        weight: [C', C, k, k].

    Returns:
        [C', 4 C, K, K] with K = ceil(k / 2), channels-last; inputs in the order row, column, channel.
    """
    out, channels, kernel, _ = weight.shape
    half = (kernel + 1) // 2
    padded = F.pad(weight, (0, kernel % 2, 0, kernel % 2)).reshape(out, channels, half, 2, half, 2)
    phases = padded.permute(0, 3, 5, 1, 2, 4).reshape(out, 4 * channels, half, half)
    return phases.contiguous(memory_format=torch.channels_last)
