"""How gradients reach a picture through a convolution and the pool behind it, as matrix products and shifted sums.

A window of the pool stands for a tile of the picture, stride times window pixels wide. Where in its tile, or in the
next one, a weight falls depends only on the place in the window. So for each place one product gives what every weight
contributes to every window, and these contributions are added where they belong: a plane of windows onto a plane of
pixels, moved by whole windows. Rows of windows end in zeros, as many as a contribution can move to the right, so that
a moved plane is one contiguous piece of memory.
"""

from collections.abc import Iterator

import torch
from torch import Tensor
from torch.nn import functional as F

__all__ = ["Tiles", "as_pictures", "as_tiles"]


class Tiles:
    """Buffers for the way back through one convolution, used again in each call.

    Args:
        weight: of the convolution, float [C', C, k, k]; no padding, dilation or groups.
        stride: of the convolution.
        window: side of the pool's windows, 1 without a pool; windows do not overlap.
        shape: of the cotangents, (K, n, h, w, C'), for h x w windows.
    """

    def __init__(self, weight: Tensor, stride: int, window: int, shape: torch.Size) -> None:
        (out, colours, kernel, _), (*_, h, w, _) = weight.shape, shape
        self.side = stride * window
        reach = (stride * (window - 1) + kernel - 1) // self.side  # windows that a contribution can move
        self.high, self.wide, count = h + reach, w + reach, shape[:2].numel()
        self.padded = weight.new_zeros(*shape[:2], h, self.wide, out)
        self.weight = weight.permute(2, 3, 1, 0).reshape(-1, out)
        self.products = weight.new_empty(self.weight.shape[0], count * h * self.wide)
        plane = (self.high + 1) * self.wide  # one row more: the zeros at a plane's end are moved too
        self.picture = weight.new_empty(*shape[:2], colours, self.side, self.side, plane)
        products = self.products.view(kernel, kernel, colours, *shape[:2], h * self.wide).permute(3, 4, 2, 0, 1, 5)
        self.sums = {place: list(self._sums(place, stride, products)) for place in _places(window)}

    def _sums(self, place: tuple[int, int], stride: int, products: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
        """What of the products is added to which part of the picture, for winners at one place of their windows."""
        kernel, length = products.shape[-2:]
        rows, columns = (_runs(stride * at, kernel, self.side) for at in place)
        for weights, pixels, down in rows:
            for across, beside, right in columns:
                shift = down * self.wide + right
                yield self.picture[..., pixels, beside, shift : shift + length], products[..., weights, across, :]

    def __call__(self, cotangents: Tensor, mask: Tensor) -> Tensor:
        """Pull cotangents of the pooled values back to the picture.

        Args:
            cotangents: float [K, n, h, w, C'].
            mask: what they are multiplied with at each place of their windows, float [k, k, n, h, w, C'] with k the
                side of the windows.

        Returns:
            float [K, n, C, p, p, h', w'], tiles of p x p pixels, see :func:`as_pictures`; a view of a buffer,
            good until the next call.
        """
        inner = self.padded[..., : cotangents.shape[3], :]
        self.picture.zero_()
        for place, sums in self.sums.items():
            torch.mul(cotangents, mask[place], out=inner)
            torch.mm(self.weight, self.padded.flatten(0, 3).t(), out=self.products)
            for target, contribution in sums:
                target.add_(contribution)
        return self.picture[..., : self.high * self.wide].unflatten(-1, (self.high, self.wide))  # type: ignore[no-any-return]


def _places(window: int) -> list[tuple[int, int]]:
    """Row and column of all places in a window."""
    return [(row, column) for row in range(window) for column in range(window)]


def _runs(start: int, kernel: int, side: int) -> list[tuple[slice, slice, int]]:
    """Weights of a kernel's row that fall into the same tile, for a kernel that begins ``start`` pixels into the first.

    Returns:
        (the weights, their pixels in the tile, number of the tile) for each tile.
    """
    runs, first = [], 0
    while first < kernel:
        tile, pixel = divmod(start + first, side)
        many = min(side - pixel, kernel - first)
        runs.append((slice(first, first + many), slice(pixel, pixel + many), tile))
        first += many
    return runs


def as_pictures(tiles: Tensor, height: int, width: int) -> Tensor:
    """Put tiles together.

    Args:
        tiles: [..., p, q, h, w]; the pixel in row y and column x is at [y % p, x % q, y // p, x // q].
        height: of the pictures.
        width: of the pictures.

    Returns:
        [..., height, width], zero where no tiles are.
    """
    whole = tiles.movedim((-4, -3), (-3, -1)).flatten(-2).flatten(-3, -2)[..., :height, :width]
    missing = (0, width - whole.shape[-1], 0, height - whole.shape[-2])
    return F.pad(whole, missing) if any(missing) else whole


def as_tiles(pictures: Tensor) -> Tensor:
    """Pictures [..., H, W, C] in tiles of one pixel, [..., C, 1, 1, H, W]; a view."""
    return pictures.movedim(-1, -3)[..., None, None, :, :]
