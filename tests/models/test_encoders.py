"""Encoders: published sizes, exact pooling, scaling from random play, gradients to float frames."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn
from torch.nn import functional as F

from arcade_torch.models import PaperEncoder, SmallEncoder


def frames(*shape, size=128):
    return torch.randint(0, 256, (*shape, size, size, 3), dtype=torch.uint8)


def picture(patches):
    """The pooled picture [..., side, side, 3] of a small encoder's compressed frame."""
    *lead, rows, columns, values = patches.shape
    side = round((values / 3) ** 0.5)
    squares = patches.reshape(*lead, rows, columns, side, side, 3).transpose(-4, -3)
    return squares.reshape(*lead, rows * side, columns * side, 3)


@pytest.mark.parametrize(("size", "count"), [(128, 505_472), (256, 1_558_656)])
def test_the_papers_encoder_has_the_published_size_and_512_features(size, count):
    encoder = PaperEncoder(size)
    assert sum(p.numel() for p in encoder.parameters()) == count
    assert encoder(frames(2, size=size)).shape == (2, 512)


def test_the_papers_encoder_equals_the_textbook_order_activation_then_pool():
    encoder = PaperEncoder(128)
    convolutions = [m for m in encoder.layers if isinstance(m, nn.Conv2d)]
    pixels = frames(3)
    x = pixels.permute(0, 3, 1, 2).float() / 255
    for convolution, pool in zip(convolutions, [(2, 2), (2, 2), (3, 1), None], strict=True):
        x = F.leaky_relu(convolution(x), 0.01)
        x = x if pool is None else F.max_pool2d(x, *pool)
    torch.testing.assert_close(encoder(pixels), x.flatten(1))


@pytest.mark.parametrize("size", [128, 256])
def test_the_gradient_of_the_papers_encoder_with_respect_to_frames_is_that_of_its_layers(size):
    encoder = PaperEncoder(size).double()
    pixels = frames(2, size=size).double().requires_grad_()
    plain = encoder.layers(pixels.permute(0, 3, 1, 2) / 255).flatten(1)
    features = encoder(pixels)
    torch.testing.assert_close(features, plain, rtol=0, atol=1e-12)
    cotangent = torch.randn_like(plain)
    wanted = torch.autograd.grad(plain, [pixels, *encoder.parameters()], cotangent)
    found = torch.autograd.grad(features, [pixels, *encoder.parameters()], cotangent)
    torch.testing.assert_close(found, wanted, rtol=1e-9, atol=1e-12)


@given(
    side=st.sampled_from([32, 64]),
    block=st.sampled_from([1, 2, 4]),
    lead=st.lists(st.integers(0, 3), max_size=2),
    high=st.sampled_from([1, 2, 256]),
    seed=st.integers(0, 99),
)
@settings(max_examples=25, deadline=None)
def test_small_pooling_is_the_floor_of_the_block_mean(side, block, lead, high, seed):
    block *= 64 // side  # up to 256 pixels
    size = side * block
    generator = torch.Generator().manual_seed(seed)
    pixels = torch.randint(
        256 - high, 256, (*lead, size, size, 3), dtype=torch.uint8, generator=generator
    )
    pooled = SmallEncoder(size, side).compress(pixels)
    sums = pixels.long().reshape(*lead, side, block, side, block, 3).sum((-4, -2))
    assert (
        pooled.dtype == torch.uint8
        and pooled.shape == (*lead, 8, 8, 3 * (side // 8) ** 2)
        and pooled.is_contiguous()
    )
    assert torch.equal(picture(pooled), (sums // block**2).to(torch.uint8))


def test_pooling_does_not_write_to_the_frames():
    pixels = frames(2)
    before = pixels.clone()
    SmallEncoder().compress(pixels)
    SmallEncoder()(pixels)
    assert torch.equal(pixels, before)


def test_pooling_many_frames_at_once_equals_pooling_each():
    pixels = frames(33, 2)
    encoder = SmallEncoder()
    assert torch.equal(
        encoder.compress(pixels), torch.stack([encoder.compress(row) for row in pixels])
    )


def test_pooling_reads_frames_that_are_not_contiguous():
    pixels = frames(4, 6)
    assert torch.equal(
        SmallEncoder().compress(pixels[:, ::2]),
        SmallEncoder().compress(pixels[:, ::2].contiguous()),
    )


@pytest.mark.parametrize("make", [PaperEncoder, SmallEncoder])
def test_leading_dimensions_are_kept_and_do_not_mix(make):
    encoder = make()
    pixels = frames(2, 3)
    features = encoder(pixels)
    assert features.shape == (2, 3, encoder.feature_size)
    torch.testing.assert_close(encoder(pixels[1, 2]), features[1, 2])


def test_full_and_compressed_frames_give_the_same_features():
    encoder = SmallEncoder()
    pixels = frames(3)
    assert torch.equal(encoder(pixels), encoder(encoder.compress(pixels)))


@pytest.mark.parametrize(("size", "seen", "stored"), [(128, 119, 120), (256, 217, 218)])
def test_the_papers_encoder_depends_on_the_upper_left_part_which_is_all_it_stores(
    size, seen, stored
):
    encoder, pixels = PaperEncoder(size).eval(), frames(2, size=size)
    assert encoder.stored_shape == (stored, stored, 3)
    assert encoder.compress(pixels).shape == (2, stored, stored, 3)
    with torch.no_grad():
        features = encoder(pixels)
        whole = encoder.layers(pixels.permute(0, 3, 1, 2) / 255).flatten(1)
        torch.testing.assert_close(features, whole)
        torch.testing.assert_close(encoder(encoder.compress(pixels)), features)
        for axis in (1, 2):
            changed = pixels.clone()
            changed.narrow(axis, seen, size - seen).fill_(7)
            assert torch.equal(encoder(changed), features)
            changed.select(axis, seen - 1).fill_(7)
            assert not torch.equal(encoder(changed), features)


@pytest.mark.parametrize("make", [PaperEncoder, SmallEncoder])
def test_float_frames_equal_uint8_frames_and_have_gradients(make):
    encoder = make().double()
    blocky = (
        frames(2, size=32).repeat_interleave(4, 1).repeat_interleave(4, 2)
    )  # block means without a remainder
    smooth = blocky.double().requires_grad_()
    torch.testing.assert_close(encoder(smooth), encoder(blocky))
    encoder(smooth)[:, :7].square().sum().backward()
    assert (smooth.grad != 0).double().mean() > 0.2
    direction = torch.randn_like(smooth)
    with torch.no_grad():
        slope = (encoder(smooth + 1e-5 * direction) - encoder(smooth - 1e-5 * direction))[
            :, :7
        ] / 2e-5
        expected = (2 * encoder(smooth)[:, :7] * slope).sum()
    torch.testing.assert_close((smooth.grad * direction).sum(), expected, rtol=1e-4, atol=1e-8)


def test_compressed_float_frames_are_read_too():
    encoder = SmallEncoder()
    pooled = encoder.compress(frames(2))
    assert torch.equal(encoder(pooled.float()), encoder(pooled))


@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32])
def test_a_picture_that_is_pooled_already_is_taken_as_it_is(dtype):
    encoder = SmallEncoder()
    pooled = frames(2, 3, size=32).to(dtype)
    assert torch.equal(picture(encoder.compress(pooled)), pooled)
    large = pooled.repeat_interleave(4, -3).repeat_interleave(4, -2)
    assert torch.equal(encoder(pooled), encoder(large))


@pytest.mark.parametrize("compressed", [False, True])
def test_calibration_centres_each_pixel_and_scales_all_to_rms_one(compressed):
    encoder = SmallEncoder()
    pixels = (frames(300, 2) // 3 + torch.arange(128, dtype=torch.uint8).view(128, 1, 1)).to(
        torch.uint8
    )
    pooled = encoder.compress(pixels)
    encoder.calibrate(pooled if compressed else pixels)
    x = (picture(pooled).permute(0, 1, 4, 2, 3) - encoder.mean) * encoder.inverse_rms
    torch.testing.assert_close(x.mean((0, 1)), torch.zeros(3, 32, 32), rtol=0, atol=1e-4)
    torch.testing.assert_close(x.square().mean(), torch.tensor(1.0), rtol=0, atol=1e-4)
    assert {"mean", "inverse_rms"} <= set(encoder.state_dict())


def test_calibration_on_frames_that_never_change_stays_finite():
    encoder = SmallEncoder()
    encoder.calibrate(frames(1).expand(5, -1, -1, -1))
    assert torch.isfinite(encoder(frames(2))).all() and encoder.inverse_rms == 1


def test_wrong_sizes_get_one_clear_line():
    with pytest.raises(
        ValueError,
        match=r"\[\.\.\., 128, 128, 3\].*compressed \[\.\.\., 8, 8, 48\], got \[2, 3, 128, 128\]",
    ):
        SmallEncoder()(torch.zeros(2, 3, 128, 128))
    with pytest.raises(ValueError, match="128 and 256, got 64"):
        PaperEncoder(64)
    with pytest.raises(ValueError, match="got 100"):
        SmallEncoder(100)
    with pytest.raises(ValueError, match="side 32 or 64 and no larger; got 32 and 64"):
        SmallEncoder(32, 64)
    with pytest.raises(ValueError, match="at least one"):
        SmallEncoder().calibrate(frames(0))


@pytest.mark.parametrize("side", [32, 64])
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-5), (torch.float64, 1e-10)])
def test_the_small_encoder_and_its_gradients_are_those_of_the_documented_stack_on_scaled_frames(
    dtype, tolerance, side
):
    encoder, pixels = SmallEncoder(128, side, side), frames(40) // 2
    encoder.calibrate(pixels)
    encoder.to(dtype)
    weights = [encoder.conv1, encoder.conv2, encoder.linear]
    x = (
        picture(encoder.compress(pixels)).permute(0, 3, 1, 2).to(dtype) - encoder.mean
    ) * encoder.inverse_rms
    x = F.leaky_relu(
        F.conv2d(x.contiguous(), encoder.conv1.weight, encoder.conv1.bias, stride=side // 8)
    )
    x = F.leaky_relu(F.conv2d(x, encoder.conv2.weight, encoder.conv2.bias))
    x = F.linear(x.flatten(1), encoder.linear.weight.flatten(1), encoder.linear.bias)
    plain, found = F.leaky_relu(F.layer_norm(x, (128,))), encoder(pixels)
    parameters = [p for layer in weights for p in layer.parameters()]
    assert len(parameters) == len(list(encoder.parameters()))
    cotangent = torch.randn_like(plain)
    wanted = [plain, *torch.autograd.grad(plain, parameters, cotangent)]
    for one, other in zip(
        [found, *torch.autograd.grad(found, parameters, cotangent)], wanted, strict=True
    ):
        torch.testing.assert_close(
            one, other, rtol=0, atol=tolerance * float(other.detach().abs().max())
        )


@pytest.mark.parametrize("make", [PaperEncoder, SmallEncoder])
def test_frames_that_were_divided_by_255_already_are_refused(make):
    """Before: they were divided again, and the network saw black."""
    encoder = make(128)
    frames = torch.randint(0, 256, (2, 128, 128, 3), dtype=torch.uint8)
    torch.testing.assert_close(encoder(frames.float()), encoder(frames), atol=0.05, rtol=0.1)
    assert encoder(torch.zeros(2, 128, 128, 3)).isfinite().all()
    with pytest.raises(
        ValueError,
        match=r"floats go up to 1, expected uint8, or floats from 0 to 255 \(not 0 to 1\)",
    ):
        encoder(frames / 255)
    vectorised = torch.func.vmap(encoder)(frames.float()[:, None])
    torch.testing.assert_close(vectorised.squeeze(1), encoder(frames.float()), atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("side", [32, 64])
def test_in_bfloat16_the_small_encoder_is_as_near_as_its_rounding(side):
    """Pixels minus their mean are exact there: what is left is the rounding of weights and
    layers.
    """
    encoder = SmallEncoder(128, side, side)
    pixels = frames(40) // 2
    encoder.calibrate(pixels)
    exact = encoder(pixels)
    wanted = torch.autograd.grad(exact, list(encoder.parameters()), exact.detach())
    encoder.amp = True
    rounded = encoder(pixels)
    assert rounded.dtype == torch.float32
    assert (rounded - exact).norm() < 0.02 * exact.norm()
    gradients = torch.autograd.grad(rounded, list(encoder.parameters()), exact.detach())
    for one, other in zip(gradients, wanted, strict=True):
        assert (one - other).norm() < 0.2 * other.norm()
    smooth = pixels.float().requires_grad_()
    encoder(smooth).square().sum().backward()
    assert (smooth.grad != 0).any()


@pytest.mark.parametrize("make", [PaperEncoder, SmallEncoder])
def test_weights_can_be_made_orthogonal(make):
    """Before: torch refused the order of their memory, and Stable-Baselines3 does it to all."""
    encoder = make()
    for layer in encoder.modules():
        if isinstance(layer, nn.Conv2d):
            nn.init.orthogonal_(layer.weight)
    rows = encoder.conv2.weight.flatten(1) if make is SmallEncoder else encoder.layers[0].weight
    rows = rows.flatten(1)
    torch.testing.assert_close(rows @ rows.T, torch.eye(len(rows)), rtol=0, atol=1e-4)
