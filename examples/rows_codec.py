"""A format of Gaussians: 14 float32 each, behind the mark ROWS (docs/extending.md)."""

import numpy as np
import torch

import drgs
from drgs.codecs import Codec

WIDTHS = (3, 4, 3, 1, 3)  # mean, quaternion, log scales, logit of the opacity, SH of degree 0


def load_rows(path):
    """14 float32 a Gaussian behind the mark ROWS."""
    data = path.read_bytes()[4:]
    if len(data) % 56:
        raise ValueError(f"{path}: must have 56 bytes a Gaussian, got {len(data)} bytes; copy it again")
    rows = torch.from_numpy(np.frombuffer(data, "<f4").reshape(-1, 14).astype(np.float32))
    means, quats, log_scales, logits, sh = (x.contiguous() for x in rows.split(WIDTHS, dim=1))
    g = drgs.Gaussians(means, quats, log_scales, logits[:, 0], sh[:, None])
    g.validate(str(path))  # refuses NaN and infinite values, and names the first
    return g


def encode_rows(g):
    """The bytes of a file."""
    columns = [g.means, g.quats, g.log_scales, g.logit_opacities[:, None], g.sh[:, 0]]
    return b"ROWS" + torch.cat(columns, dim=1).numpy().astype("<f4").tobytes()


ROWS = Codec(".rows", load_rows, lambda path, head: head.startswith(b"ROWS"), encode=encode_rows)
