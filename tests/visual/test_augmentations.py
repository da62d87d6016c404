"""Random shifts against their definition."""

import pytest
import torch as th

from sb3_por.visual.augmentations import RandomShift, shift


@pytest.mark.parametrize("dtype", [th.uint8, th.float32])
def test_shift_is_replicate_padding_and_a_crop(dtype):
    images = th.randint(0, 256, (81, 2, 7, 9)).to(dtype)
    offsets = th.cartesian_prod(th.arange(-4, 5), th.arange(-4, 5)).T
    shifted = shift(images, offsets)
    for image, out, down, right in zip(images, shifted, *offsets, strict=True):
        for y in range(7):
            for x in range(9):
                row, column = min(max(y + down, 0), 6), min(max(x + right, 0), 8)
                assert th.equal(out[:, y, x], image[:, row, column])


def test_shift_beyond_the_image_shows_its_border():
    images = th.arange(9.0).reshape(1, 1, 3, 3)
    assert th.equal(shift(images, th.tensor([[20], [-20]])), th.full((1, 1, 3, 3), 6.0))


def test_random_shift_draws_every_offset_evenly_and_keeps_its_input():
    images = th.zeros(2000, 1, 9, 9, dtype=th.uint8)
    images[:, 0, 4, 4] = 1
    before = images.clone()
    rows = RandomShift(2)(images)[:, 0].flatten(1).argmax(1) // 9
    counts = th.bincount(rows, minlength=9)
    assert counts[2:7].min() > 300 and counts[:2].sum() == counts[7:].sum() == 0
    assert th.equal(images, before)


def test_no_pad_no_change():
    images = th.rand(2, 3, 4, 4)
    assert RandomShift(0)(images) is images


def test_negative_pad_is_refused():
    with pytest.raises(ValueError, match="must not be negative"):
        RandomShift(-1)
