"""The decoder of features: one 1x1 convolution from those of Gaussians to those of the teacher, as in Feature 3DGS.

A pixel's feature is a weighted sum, F = sum_i w_i f_i with sum_i w_i = alpha, and its decoded feature is W F + b. The
same decoder applied to a Gaussian gives W f_i + b, what a pixel shows that this Gaussian fills alone. Compositing
decoded Gaussians gives W F + alpha b: decoding first and compositing first differ by (1 - alpha) b, which is nothing
where a pixel is covered. Nothing is subtracted for it, neither here nor in Feature 3DGS: a pixel where nothing is
decodes to b.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

import torch

from drgs.checks.arguments import check_path, said
from drgs.io.archives import check_archive
from drgs.io.foreign import refuse_foreign
from drgs.io.outputs import atomic_write

_KEYS = ("conv.weight", "conv.bias")


class Decoder(torch.nn.Module):
    """(..., D) features of Gaussians or pixels -> (..., C) features of the teacher, W f + b.

    Its state is that of a `Conv2d(D, C, 1)`: `conv.weight` (C, D, 1, 1) and `conv.bias` (C,), torch's initial values.

    Args:
        width: Number D of features of a Gaussian.
        channels: Number C of features of the teacher.
    Reference:
        Zhou et al. 2024 (Feature 3DGS), section 3.3, the convolutional speed-up module.
    """

    def __init__(self, width: int, channels: int) -> None:
        super().__init__()
        for name, value in (("width", width), ("channels", channels)):
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise ValueError(f"Decoder: {name} must be a whole number >= 1, got {value!r}; choose another")
        self.conv = torch.nn.Conv2d(width, channels, 1)

    @classmethod
    def of_state(cls, state: Mapping[str, torch.Tensor], where: str) -> Decoder:
        """The decoder with these weights, as wide as they are.

        Args:
            state: `conv.weight` and `conv.bias`, e.g. of a file of Feature 3DGS.
            where: Name of what holds it, for the message.
        Raises:
            ValueError: If it is no state of a decoder, or holds a value that is not finite.
        """
        weight, bias = (state.get(key) if isinstance(state, Mapping) else None for key in _KEYS)
        shapes = [tuple(x.shape) if isinstance(x, torch.Tensor) else None for x in (weight, bias)]
        if (
            weight is None
            or bias is None
            or len(state) != len(_KEYS)
            or weight.ndim != 4
            or weight.shape[2:] != (1, 1)
            or 0 in weight.shape
            or bias.shape != weight.shape[:1]
        ):
            raise ValueError(
                f"{where}: a decoder must be conv.weight (C, D, 1, 1) and conv.bias (C,), got shapes {shapes[0]} and "
                f"{shapes[1]} among {len(state) if isinstance(state, Mapping) else 0} entries; name a decoder's file"
            )
        if not all(x.is_floating_point() and bool(torch.isfinite(x).all()) for x in (weight, bias)):
            raise ValueError(f"{where}: the weights of a decoder must be finite numbers, some are not; fit again")
        decoder = cls(weight.shape[1], weight.shape[0])
        decoder.load_state_dict({key: state[key] for key in _KEYS})
        return decoder

    @property
    def width(self) -> int:
        """D, features of a Gaussian."""
        return self.conv.in_channels

    @property
    def channels(self) -> int:
        """C, features of the teacher."""
        return self.conv.out_channels

    @property
    def matrix(self) -> torch.Tensor:
        """W, (C, D)."""
        return self.conv.weight[:, :, 0, 0]

    @property
    def bias(self) -> torch.Tensor:
        """b, (C,)."""
        assert self.conv.bias is not None  # Conv2d's own default, which its type does not know
        return self.conv.bias

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """Decode.

        Args:
            features: (..., D) features of Gaussians or pixels.
        Returns:
            (..., C) features of the teacher, differentiable in features and weights.
        Raises:
            ValueError: If the last axis has another length than D.
        """
        if features.shape[-1] != self.width:
            raise ValueError(
                f"Decoder: features must have {self.width} channels, got shape {tuple(features.shape)}; "
                "use the decoder that was fitted with them"
            )
        # A 1x1 convolution is this product, for channels that come last.
        return torch.nn.functional.linear(features, self.matrix, self.bias)

    def metric(self) -> torch.Tensor:
        """(D, D) float64 W^T W: |W g|^2 = g^T metric g, the squared length of a decoded change g of a feature."""
        weight = self.matrix.detach().double()  # a constant of what is measured with it
        return weight.T @ weight


def load_decoder(path: str | os.PathLike) -> Decoder:
    """A decoder from a file of `save_decoder`, or from Feature 3DGS's `decoder_chkpnt*.pth`.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it holds anything else; nothing in it is run.
    """
    path = check_path("load_decoder", path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: must be a decoder's state (.pth), found none; check the path")
    with path.open("rb") as file:
        is_zip = file.read(2) == b"PK"  # what torch writes, and what `refuse_foreign` would call by its general name
    if is_zip:
        check_archive(path)
    else:
        refuse_foreign(path, "a decoder's state (.pth)")
    try:
        if not is_zip:  # torch's reader would warn, or try other formats
            raise ValueError("no file that torch.save writes")
        state: Any = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # of a damaged file, whatever its bytes make the parsers raise
        raise ValueError(
            f"{path}: must be a decoder's state (.pth) of plain tensors, got {said(error)}; save it "
            "with torch.save(decoder.state_dict(), ...)"
        ) from None
    return Decoder.of_state(state, str(path))


def save_decoder(decoder: Decoder, path: str | os.PathLike) -> None:
    """Write a decoder's state as Feature 3DGS does, atomically."""
    with atomic_write(check_path("save_decoder", path)) as file:
        # A file holds values: torch would save the weights' gradients and their device, too.
        torch.save({key: x.detach().cpu() for key, x in decoder.state_dict().items()}, file)
