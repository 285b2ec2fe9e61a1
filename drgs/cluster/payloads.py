"""Data sent to workers, as bytes: pickled once, sent once to each worker in pieces, unpickled there at first use.

Tensors travel as NumPy arrays. A worker keeps the last few payloads, so that a scene is there for all of its views.
"""

from __future__ import annotations

import dataclasses
import hashlib
import io
import pickle
from typing import Any

import numpy as np
import torch

_MAX_PAYLOADS = 4  # payloads that a worker keeps: a scene, the quantities of its views, and a few of the call before
_MAX_UNFINISHED = 8  # payloads of which pieces are missing, at most; chosen
_PIECE_BYTES = 64 << 20  # bytes of a message; chosen: none blocks the scheduler for long


class Missing(LookupError):
    """A worker that has not got a payload: it has started since, or has dropped it."""


@dataclasses.dataclass(frozen=True)
class Payload:
    """Something that was pickled.

    Attributes:
        digest: SHA-256 of the bytes, by which workers know it.
        data: The bytes.
    """

    digest: str
    data: bytes

    @classmethod
    def of(cls, content: object) -> Payload:
        """Pickle anything that can be, closures included.

        Raises:
            ValueError: If it cannot.
        """
        file = io.BytesIO()
        try:
            _pickler()(file, protocol=5).dump(content)
        except (pickle.PicklingError, TypeError, AttributeError) as error:
            raise ValueError(
                f"cluster: what is sent to workers must be picklable, {type(content).__name__} is not ({error}); "
                "make it of plain data and functions"
            ) from None
        data = file.getvalue()
        return cls(hashlib.sha256(data).hexdigest(), data)

    def pieces(self) -> list[tuple[str, int, int, bytes]]:
        """(digest, number, count, bytes) of each message: the arguments of `keep`."""
        starts = range(0, max(len(self.data), 1), _PIECE_BYTES)
        return [(self.digest, i, len(starts), self.data[x : x + _PIECE_BYTES]) for i, x in enumerate(starts)]


def _pickler() -> type[pickle.Pickler]:
    """A pickler of functions without a name, and of tensors as arrays."""
    import cloudpickle

    class Pickler(cloudpickle.Pickler):
        def reducer_override(self, x: Any) -> Any:
            if isinstance(x, torch.Tensor) and x.dtype != torch.bfloat16:  # which NumPy does not have
                # NumPy sees values only: whether the tensor has a gradient is said beside them, and set again there.
                array = np.ascontiguousarray(x.detach().cpu().numpy())
                return _tensor, (array, tuple(x.shape), x.requires_grad, isinstance(x, torch.nn.Parameter))
            return super().reducer_override(x)

    return Pickler


def _tensor(array: np.ndarray, shape: tuple[int, ...], has_gradient: bool, is_parameter: bool) -> torch.Tensor:
    found = torch.from_numpy(array if array.flags.writeable else array.copy()).reshape(shape)
    if is_parameter:
        return torch.nn.Parameter(found, requires_grad=has_gradient)
    return found.requires_grad_(has_gradient)


# --------------------------------------------------------------------------------------------------- on the worker

_pieces: dict[str, dict[int, bytes]] = {}
_payloads: dict[str, bytes] = {}  # whole, not opened yet
_opened: dict[str, Any] = {}  # opened; the one that was used last comes last


def keep(digest: str, number: int, count: int, data: bytes) -> None:
    """Take a piece of a payload; only the worker's event loop calls it."""
    if digest in _payloads or digest in _opened:
        return
    found = _pieces.setdefault(digest, {})
    found[number] = data
    if len(found) == count:
        _payloads[digest] = b"".join(found[i] for i in range(count))
        del _pieces[digest]
    for old in list(_pieces)[:-_MAX_UNFINISHED]:  # of a client that has gone
        del _pieces[old]


def opened_payload(digest: str) -> Any:
    """The unpickled object of a payload, the same one each time.

    Raises:
        Missing: If the worker has not got it.
    """
    if digest in _opened:
        _opened[digest] = _opened.pop(digest)
        return _opened[digest]
    data = _payloads.pop(digest, None)
    if data is None:
        raise Missing(digest)
    for old in (*_opened, *_payloads)[: max(len(_opened) + len(_payloads) + 1 - _MAX_PAYLOADS, 0)]:
        _opened.pop(old, None)
        _payloads.pop(old, None)
    _opened[digest] = pickle.loads(data)
    return _opened[digest]
