"""Gradients without a graph: equal to autograd's, ties and all, and given up where they would be wrong."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor, nn
from torch.nn import functional as F

from arcade_torch.models import PaperEncoder, SmallEncoder, make_actor_critic, make_network, tape
from arcade_torch.models.pullback import Pull, gathered, record_of, recorded_twice
from arcade_torch.models.tape import recorded_on_tape
from arcade_torch.models.tiles import Tiles, as_pictures, as_tiles

F64 = torch.float64


def frames(count: int, size: int) -> Tensor:
    """Noise, and frames of few colours as games have them: equal values meet in the pools' windows."""
    noise = torch.randint(0, 256, (count, size, size, 3), dtype=torch.uint8)
    noise[0] = 93
    noise[1] = (torch.arange(size) // 9 % 2 * 200).to(torch.uint8)[:, None, None]
    return noise


def pulled(pull: Pull, cotangents: Tensor, index: Tensor, size: int = 128) -> Tensor:
    return gathered(pull(cotangents, index), size, size)


def by_autograd(encode: nn.Module, pixels: Tensor, cotangents: Tensor, index: Tensor) -> Tensor:
    """One backward pass for each row of cotangents, through the module as it is."""
    leaf = pixels.to(cotangents.dtype).requires_grad_()
    features = encode(leaf)[index]
    rows = [torch.autograd.grad(features, leaf, row, retain_graph=True)[0][index] for row in cotangents]
    return torch.stack(rows)


@pytest.mark.parametrize(("dtype", "tolerance"), [(F64, 1e-12), (torch.float32, 1e-5)])
@pytest.mark.parametrize("make", [PaperEncoder, lambda: PaperEncoder(256), SmallEncoder], ids=["128", "256", "small"])
def test_what_comes_back_is_what_autograd_gives(make, dtype: torch.dtype, tolerance: float) -> None:
    encoder = make().to(dtype)
    pixels, index = frames(4, encoder.obs_size), torch.tensor([0, 1, 3])
    cotangents = torch.randn(3, 3, encoder.feature_size, dtype=dtype)
    features, pull = encoder.record(pixels, dtype)
    with torch.no_grad():
        torch.testing.assert_close(features, encoder(pixels.to(dtype)), rtol=tolerance, atol=tolerance)
    wanted = by_autograd(encoder, pixels, cotangents, index)
    for _ in range(2):  # a recording can be pulled at more than once
        found = pulled(pull, cotangents, index, encoder.obs_size)
        assert float((found - wanted).abs().max() / wanted.abs().max()) < tolerance


def test_all_frames_and_rows_at_once_as_on_a_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    encoder, pixels, index = PaperEncoder().to(F64), frames(3, 128), torch.tensor([2, 0])
    cotangents = torch.randn(2, 2, 512, dtype=F64)
    alone = pulled(encoder.record(pixels, F64)[1], cotangents, index)
    monkeypatch.setattr(tape, "one_by_one", lambda device: False)
    together = pulled(encoder.record(pixels, F64)[1], cotangents, index)
    torch.testing.assert_close(together, alone, rtol=1e-10, atol=1e-12 * float(alone.abs().max()))


def test_the_papers_encoder_is_read_from_its_tape() -> None:
    encoder = PaperEncoder()
    assert recorded_on_tape(encoder.layers, frames(2, 128), torch.float32, 255) is not None
    calls: list[int] = []
    encoder.layers[3].register_forward_hook(lambda *_: calls.append(1))
    _, pull = encoder.record(frames(2, 128))
    pulled(pull, torch.randn(1, 2, 512), torch.arange(2))
    assert len(calls) == 1, "the encoder ran a second time"


def test_parameters_and_graphs_are_left_alone() -> None:
    encoder, pixels = PaperEncoder(), frames(2, 128)
    features, pull = encoder.record(pixels)
    gradients = pulled(pull, torch.randn(1, 2, 512), torch.arange(2))
    assert not features.requires_grad and not gradients.requires_grad
    assert all(parameter.grad is None for parameter in encoder.parameters())


@pytest.mark.parametrize(
    "layers",
    [
        [nn.Conv2d(3, 4, 3), nn.MaxPool2d(3, 2), nn.LeakyReLU(), nn.Conv2d(4, 5, 3), nn.LeakyReLU()],  # windows overlap
        [nn.Conv2d(3, 4, 3, padding=1), nn.MaxPool2d(8), nn.LeakyReLU()],
        [nn.Conv2d(3, 4, 8), nn.GELU()],
        [nn.Conv2d(3, 4, 8), nn.MaxPool2d(1)],
        [nn.Conv2d(3, 4, 3), nn.AvgPool2d(2), nn.LeakyReLU()],
        [nn.Conv2d(3, 4, 3), nn.LeakyReLU()],  # 6x6 pixels are left
        [nn.Conv2d(3, 6, 8, groups=3), nn.LeakyReLU()],
        [nn.Conv2d(3, 4, (8, 8), stride=(1, 2)), nn.LeakyReLU()],
    ],
    ids=["overlap", "padding", "gelu", "no activation", "average", "pixels left", "groups", "strides"],
)
def test_other_layers_are_not_taken_for_known_ones(layers: list[nn.Module]) -> None:
    assert recorded_on_tape(nn.Sequential(*layers), frames(2, 8), torch.float32, 1) is None


@pytest.mark.parametrize("stride", [1, 2, 3])
@pytest.mark.parametrize("kernel", [1, 2, 3, 4])
@pytest.mark.parametrize("size", [8, 9])
def test_any_stride_and_kernel(size: int, kernel: int, stride: int) -> None:
    first = nn.Conv2d(3, 4, kernel, stride)
    left = (size - kernel) // stride + 1
    layers = nn.Sequential(first, nn.LeakyReLU(0.2), nn.Conv2d(4, 5, left), nn.LeakyReLU(0.1)).to(F64)
    pixels, cotangents = torch.rand(3, size, size, 3, dtype=F64), torch.randn(2, 3, 5, dtype=F64)
    recorded = recorded_on_tape(layers, pixels, F64, 1)
    assert recorded is not None
    plain = _Channels(layers)
    torch.testing.assert_close(recorded[0], plain(pixels))
    found = pulled(recorded[1], cotangents, torch.arange(3), size)
    torch.testing.assert_close(found, by_autograd(plain, pixels, cotangents, torch.arange(3)))


@given(
    kernel=st.integers(1, 7),
    stride=st.integers(1, 3),
    window=st.integers(1, 3),
    grid=st.tuples(st.integers(1, 4), st.integers(1, 4)),
    sizes=st.tuples(*[st.integers(1, 3)] * 4),
    spare=st.integers(0, 5),
)
def test_tiles_are_the_gradient_of_a_convolution_and_a_pool(kernel, stride, window, grid, sizes, spare) -> None:
    rows, count, colours, channels = sizes
    side = [(windows * window - 1) * stride + kernel + spare for windows in grid]
    draw = torch.Generator().manual_seed(0)
    weight = torch.randn(channels, colours, kernel, kernel, dtype=F64, generator=draw)
    x = torch.randn(count, colours, *side, dtype=F64, generator=draw).requires_grad_()
    y = F.conv2d(x, weight, stride=stride)[..., : grid[0] * window, : grid[1] * window]
    windows = y.unflatten(3, (-1, window)).unflatten(2, (-1, window))  # [n, C', h, k, w, k]
    pooled = windows.amax((3, 5))
    mask = (windows == pooled[:, :, :, None, :, None]).to(F64).permute(3, 5, 0, 2, 4, 1)
    tiles = Tiles(weight, stride, window, torch.Size((rows, count, *grid, channels)))
    for _ in range(2):  # the buffers are used again
        cotangents = torch.randn(rows, count, *grid, channels, dtype=F64, generator=draw)
        found = as_pictures(tiles(cotangents, mask), *side)
        for row, mine in zip(cotangents, found, strict=True):
            (wanted,) = torch.autograd.grad(pooled, x, row.permute(0, 3, 1, 2), retain_graph=True)
            torch.testing.assert_close(mine, wanted)


@given(p=st.integers(1, 3), q=st.integers(1, 3), h=st.integers(1, 3), w=st.integers(1, 3), spare=st.integers(0, 2))
def test_every_pixel_of_a_tile_finds_its_place(p: int, q: int, h: int, w: int, spare: int) -> None:
    tiles = torch.arange(2.0 * p * q * h * w).view(2, p, q, h, w) + 1
    pictures = as_pictures(tiles, h * p + spare, w * q)
    for y in range(h * p):
        for x in range(w * q):
            assert torch.equal(pictures[:, y, x], tiles[:, y % p, x % q, y // p, x // q])
    assert not pictures[:, h * p :].any()
    assert torch.equal(as_pictures(as_tiles(pictures[..., None]), *pictures.shape[1:])[:, 0], pictures)


class _Channels(nn.Module):
    """Layers on frames with channels last."""

    def __init__(self, layers: nn.Module) -> None:
        super().__init__()
        self.layers = layers

    def forward(self, pixels: Tensor) -> Tensor:
        return self.layers(pixels.permute(0, 3, 1, 2)).flatten(1)


def test_a_subclass_that_sees_something_else_is_not_recorded_as_its_parent() -> None:
    class Inverted(PaperEncoder):
        def features(self, pixels: Tensor) -> Tensor:
            return super().features(255 - pixels)

    class Louder(type(make_network("paper", "lru"))):
        def encode(self, pixels: Tensor) -> Tensor:
            return 2 * super().encode(pixels)

    encoder, pixels = Inverted(), frames(2, 128)
    features, pull = encoder.record(pixels)
    with torch.no_grad():
        torch.testing.assert_close(features, encoder(pixels.float()))
    cotangents = torch.randn(1, 2, 512)
    wanted = by_autograd(encoder, pixels, cotangents, torch.arange(2))
    torch.testing.assert_close(pulled(pull, cotangents, torch.arange(2)), wanted)

    network = make_network("paper", "lru")
    assert record_of(network, "encode") is not None
    network.__class__ = Louder
    assert record_of(network, "encode") is None
    assert record_of(nn.Linear(2, 2), "forward") is None


def test_half_precision_is_recorded_as_it_acts() -> None:
    encoder = PaperEncoder()
    encoder.amp = True
    pixels = frames(2, 128)
    with torch.no_grad():
        assert torch.equal(encoder.record(pixels)[0], encoder(pixels.float()))


def test_both_towers_of_an_actor_critic() -> None:
    network, pixels = make_actor_critic("paper", "lru"), frames(2, 128)
    features, pull = network.record(pixels)
    with torch.no_grad():
        torch.testing.assert_close(features, network.encode(pixels.float()))
    cotangents, index = torch.randn(2, 2, 1024), torch.arange(2)
    leaf = pixels.float().requires_grad_()
    again = network.encode(leaf)
    wanted = torch.stack([torch.autograd.grad(again, leaf, row, retain_graph=True)[0] for row in cotangents])
    torch.testing.assert_close(
        pulled(pull, cotangents, index), wanted, rtol=1e-4, atol=1e-5 * float(wanted.abs().max())
    )
    cotangents[..., 512:] = 0
    mine, _ = network.actor.record(pixels)[1], None
    torch.testing.assert_close(pulled(pull, cotangents, index), pulled(mine, cotangents[..., :512], index))
    assert not pulled(pull, torch.zeros(2, 2, 1024), index).any()


def test_frames_are_kept_as_they_came() -> None:
    seen: list[torch.dtype] = []

    def encode(pixels: Tensor) -> Tensor:
        seen.append(pixels.dtype)
        return pixels.flatten(1) ** 2

    pixels = frames(2, 32)
    features, pull = recorded_twice(encode, pixels, F64)
    found = pulled(pull, torch.ones(1, 1, 32 * 32 * 3, dtype=F64), torch.tensor([1]), 32)
    assert seen == [F64, F64] and features.dtype == F64
    torch.testing.assert_close(found[0, 0], 2 * pixels[1].to(F64))
