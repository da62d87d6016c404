"""Random shifts of images by whole pixels, on uint8, before anything is cast to float."""

import torch as th


class RandomShift:
    """
    Shift each image of a batch by its own random whole number of pixels: replicate padding and a random crop of
    the original size (DrQ). DrQ's and DrQ-v2's float implementations shift by whole pixels too, hence this is exact.

    Offsets are drawn with torch's generator of the images' device.

    :param pad: Largest shift in pixels, in each direction; 0 returns the images as they are
    """

    def __init__(self, pad: int = 4):
        if pad < 0:
            raise ValueError(f"The augmentation pad must not be negative, not {pad}.")
        self.pad = pad

    def __call__(self, images: th.Tensor) -> th.Tensor:
        """
        :param images: Shape ``(batch, channels, height, width)``, any dtype
        :return: A new tensor of the same shape and dtype, with channels last in memory
        """
        if self.pad == 0:
            return images
        offsets = th.randint(0, 2 * self.pad + 1, (2, len(images)), device=images.device)
        return shift(images, offsets - self.pad)


def shift(images: th.Tensor, offsets: th.Tensor) -> th.Tensor:
    """
    Move the view of each image, repeating the border.

    :param images: Shape ``(batch, channels, height, width)``
    :param offsets: Shape ``(2, batch)``: rows down and columns to the right by which the view of each image moves
    :return: ``out[b, c, y, x] = images[b, c, clamp(y + offsets[0, b]), clamp(x + offsets[1, b])]``
    """
    if images.device.type == "cpu":
        return _shift_by_slices(images, offsets)
    height, width = images.shape[-2:]
    rows = (th.arange(height, device=images.device) + offsets[0, :, None]).clamp_(0, height - 1)
    columns = (th.arange(width, device=images.device) + offsets[1, :, None]).clamp_(0, width - 1)
    batch = th.arange(len(images), device=images.device)
    # Advanced indices around a slice put the channels last
    return images[batch[:, None, None], :, rows[:, :, None], columns[:, None, :]].permute(0, 3, 1, 2)


def _shift_by_slices(images: th.Tensor, offsets: th.Tensor) -> th.Tensor:
    """On CPU copying slices with numpy is several times faster than any gather in torch."""
    images = images.contiguous(memory_format=th.channels_last)
    shifted = th.empty_like(images)
    # In the order of the memory: a row of the slice is one copy, of all its channels
    source, target = images.movedim(1, -1).numpy(), shifted.movedim(1, -1).numpy()
    height, width = images.shape[-2:]
    downs, rights = offsets[0].clamp(1 - height, height - 1).tolist(), offsets[1].clamp(1 - width, width - 1).tolist()
    for image, out, down, right in zip(source, target, downs, rights, strict=True):
        # Rows and columns of the output that show the image itself; what is beyond them repeats the border
        top, bottom = max(0, -down), min(height, height - down)
        left, end = max(0, -right), min(width, width - right)
        out[top:bottom, left:end] = image[top + down : bottom + down, left + right : end + right]
        out[top:bottom, :left] = out[top:bottom, left : left + 1]
        out[top:bottom, end:] = out[top:bottom, end - 1 : end]
        out[:top] = out[top : top + 1]
        out[bottom:] = out[bottom - 1 : bottom]
    return shifted
