"""A machine that takes itself for one with an NVIDIA card: Dr.Jit writes its kernels, torch keeps track of devices.

Three things stand in for the card:

    libcuda.c    the driver: Dr.Jit loads its modules there, which are kept as text, and launches do nothing
    Device       torch: tensors live on the CPU, some of them are said to be on the card, and an operation on tensors of
                 both is refused, as a CUDA build of torch refuses it
    Answers      what kernels compute: all numbers that the program reads back are those of a run on LLVM, in the order
                 in which they are read, so that every decision is the one that a card would have led to

What the program waits for is counted: by Dr.Jit in libcuda.c, by torch in `Device.waits`.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

__all__ = ["COUNTS", "Answers", "Device", "build", "counts"]

COUNTS = ("launches", "synchronizations", "copies", "copied_bytes", "fills", "allocated_bytes", "peak_bytes", "modules")


def build(folder: Path) -> Path:
    """libcuda.so, compiled from libcuda.c by gcc.

    Raises:
        FileNotFoundError: Without gcc.
    """
    compiler = shutil.which("gcc")
    if compiler is None:
        raise FileNotFoundError("gcc was not found; apt-get install gcc")
    made = folder / "libcuda.so"
    source = Path(__file__).with_name("libcuda.c")
    subprocess.run([compiler, "-O1", "-shared", "-fPIC", str(source), "-o", str(made)], check=True)
    return made


def counts() -> dict[str, int]:
    """What the driver has counted so far; `allocated_bytes` and `peak_bytes` are not sums but what is held."""
    library = ctypes.CDLL(os.environ["DRJIT_LIBCUDA_PATH"])
    return dict(zip(COUNTS, (ctypes.c_longlong * len(COUNTS)).in_dll(library, "card_counts"), strict=True))


# -- torch ---------------------------------------------------------------------------------------------------------

_CARD = torch.device("cuda", 0)
_WAITS = ("_local_scalar_dense", "nonzero", "masked_select", "_unique2", "unique_dim", "unique_consecutive")


class Device:
    """Tensors that are said to be on the card; a context within which torch knows of them.

    Attributes:
        waits: How often torch would have waited for the card: for numbers that Python asks for, for sizes that depend
            on numbers, and for copies to the host.
    """

    current: ClassVar[Device | None] = None

    def __init__(self) -> None:
        self.waits = 0
        self.goes_there = False  # the call in progress names the card as its device

    def __enter__(self) -> Device:
        Device.current = self
        self._dispatched = _Dispatched(self)
        self._called = _Called(self)
        self._dispatched.__enter__()
        self._called.__enter__()
        return self

    def __exit__(self, *reason: Any) -> None:
        self._called.__exit__(*reason)
        self._dispatched.__exit__(*reason)
        Device.current = None

    @staticmethod
    def has(x: torch.Tensor) -> bool:
        """Whether a tensor is said to be there."""
        try:
            return getattr(_below(x).untyped_storage(), "on_card", False)
        except (NotImplementedError, RuntimeError):  # no storage
            return False

    @staticmethod
    def put(x: torch.Tensor, there: bool = True) -> torch.Tensor:
        """Say where a tensor is, which no other one shares its numbers with."""
        _below(x).untyped_storage().on_card = there
        return x


def _below(x: torch.Tensor) -> torch.Tensor:
    """The tensor below wrappers of `torch.func`."""
    functorch = torch._C._functorch
    while functorch.is_functorch_wrapped_tensor(x):
        x = functorch.get_unwrapped(x)
    return x


def _tensors(x: Any) -> Iterator[torch.Tensor]:
    if isinstance(x, torch.Tensor):
        yield x
    elif isinstance(x, list | tuple):
        for y in x:
            yield from _tensors(y)
    elif isinstance(x, dict):
        yield from _tensors(list(x.values()))


class _Move(torch.autograd.Function):
    """A copy to the other side, whose gradient comes back."""

    @staticmethod
    def forward(x: torch.Tensor, there: bool) -> torch.Tensor:
        return Device.put(x.detach().clone(), there)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Any) -> None:
        pass

    @staticmethod
    def backward(ctx: Any, g: torch.Tensor) -> tuple:
        return Device.put(g.clone(), not Device.has(g)), None

    @staticmethod
    def jvp(ctx: Any, tangent: torch.Tensor, _: None) -> torch.Tensor:
        return Device.put(tangent.clone(), not Device.has(tangent))


class _Called(TorchFunctionMode):
    """Calls of torch as Python writes them: where a device is asked for, named or changed."""

    def __init__(self, device: Device) -> None:
        super().__init__()
        self.device = device

    def __torch_function__(self, function: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        kwargs = dict(kwargs or {})
        x = args[0] if args and isinstance(args[0], torch.Tensor) else None
        name = getattr(function, "__name__", "")
        if function is torch.device or name == "_parse_to":  # names, which nothing follows from yet
            return function(*args, **kwargs)
        if x is not None:
            if function == torch.Tensor.device.__get__:
                return _CARD if Device.has(x) else function(*args)
            if function == torch.Tensor.is_cuda.__get__:
                return Device.has(x)
            if name in ("numpy", "__array__") and Device.has(x):
                raise TypeError("can't convert cuda:0 device type tensor to numpy. Use Tensor.cpu() to copy the tensor")
            if name == "cpu":
                return self._moved(x, False)
            if name == "cuda":
                return self._moved(x, True)
            if name == "to":
                return self._to(x, list(args[1:]), kwargs)
        args = tuple(self._named(y) for y in args)
        kwargs = {key: self._named(y) for key, y in kwargs.items()}
        try:
            result = function(*args, **kwargs)
            if self.device.goes_there and isinstance(result, torch.Tensor) and not Device.has(result):
                # Of numbers of Python's no operation is seen; of a tensor of the host's this is a copy.
                result = Device.put(result) if name == "tensor" else self._moved(result, True)
        finally:
            self.device.goes_there = False
        return result

    def _named(self, y: Any) -> Any:
        """An argument, the CPU in place of the card, which is remembered."""
        named = y if isinstance(y, torch.device) else None
        if isinstance(y, str) and y.startswith("cuda"):
            named = torch.device(y)
        if named is None or named.type != "cuda":
            return y
        self.device.goes_there = True
        return torch.device("cpu")

    def _to(self, x: torch.Tensor, args: list, kwargs: dict) -> torch.Tensor:
        """`Tensor.to`, of devices and types."""
        there = Device.has(x)
        for place, y in [*enumerate(args), *kwargs.items()]:
            if isinstance(y, torch.device) or (isinstance(y, str) and y != ""):
                there = str(y).startswith("cuda")
            elif isinstance(y, torch.Tensor):
                there = Device.has(y)
            else:
                continue
            if not isinstance(y, torch.Tensor):
                (args if isinstance(place, int) else kwargs)[place] = torch.device("cpu")  # type: ignore[index]
        return self._moved(torch.Tensor.to(x, *args, **kwargs), there)

    def _moved(self, x: torch.Tensor, there: bool) -> torch.Tensor:
        if Device.has(x) == there:
            return x
        self.device.waits += not there
        with self.device._dispatched.moving():
            return _Move.apply(x, there)


class _Dispatched(TorchDispatchMode):
    """Every operation, those of gradients included: of where its tensors are, and where its result is."""

    def __init__(self, device: Device) -> None:
        super().__init__()
        self.device = device
        self.is_moving = False

    @contextlib.contextmanager
    def moving(self) -> Iterator[None]:
        """Copies from one side to the other are allowed."""
        before, self.is_moving = self.is_moving, True
        try:
            yield
        finally:
            self.is_moving = before

    def __torch_dispatch__(self, function: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        kwargs = kwargs or {}
        given = list(_tensors([args, kwargs]))
        name = function.overloadpacket.__name__
        there = [Device.has(x) for x in given]
        if any(there):
            self._check(name, given, there)
            indexed = name.startswith("index") and any(x.dtype in (torch.bool, torch.uint8) for x in given[1:2])
            self.device.waits += name in _WAITS or indexed
        result = function(*args, **kwargs)
        home = any(there) or (self.device.goes_there and not given)
        if home and not self.is_moving:
            kept = {id(x) for x in given}
            for x in _tensors(result):
                if id(x) not in kept:
                    Device.put(x)
        return result

    def _check(self, name: str, given: list, there: list[bool]) -> None:
        """Refuse what a card refuses: tensors of both sides, but for single numbers and for places from the host."""
        # `embedding_bag` makes its offsets itself, on what it takes for the device.
        free = name in ("copy_", "_to_copy") or name.startswith("_embedding_bag") or self.is_moving
        if name == "copy_" and there[0] != there[-1]:
            self.device.waits += not there[0]
        # Of dual numbers torch makes tangents of 0 itself, on what it takes for the device: these are not checked.
        if free or torch.autograd.forward_ad._current_level >= 0:
            return
        if name in ("index", "index_put_", "index_put", "_index_put_impl_") and there[0]:
            return
        strangers = [x for x, on in zip(given, there, strict=True) if not on and x.ndim > 0]
        if strangers:
            sides = ", ".join(
                f"{tuple(x.shape)} {'cuda:0' if on else 'cpu'}" for x, on in zip(given, there, strict=True)
            )
            raise RuntimeError(f"Expected all tensors to be on the same device, got {sides} in {name}")


# -- Dr.Jit --------------------------------------------------------------------------------------------------------


class Answers:
    """Numbers that a program reads back from Dr.Jit's arrays, written down on LLVM and given again on the card.

    answers = Answers()
    with answers.written(): work()                   # on llvm_ad_rgb
    with Device(), answers.given(): work()           # on cuda_ad_rgb
    """

    def __init__(self, largest: int | None = None) -> None:
        """
        Args:
            largest: Of tensors with more numbers than that zeros are given, where no decision depends on them.
        """
        self.kept: list[tuple[str, Any]] = []
        self.at = 0
        self.largest = largest

    @contextlib.contextmanager
    def written(self) -> Iterator[None]:
        """Write down what is read."""
        self.kept.clear()

        def note(what: str, x: Any, read: Callable[[], Any]) -> Any:
            found = read()
            values = found
            if isinstance(found, torch.Tensor):
                large = self.largest is not None and found.numel() > self.largest
                values = found.new_zeros(()).expand(found.shape) if large else found.detach().clone()
            self.kept.append((what, np.array(values) if isinstance(values, np.ndarray) else values))
            return found

        with _patched(note):
            yield

    @contextlib.contextmanager
    def given(self) -> Iterator[None]:
        """Give again what was read."""
        self.at = 0

        def again(what: str, x: Any, read: Callable[[], Any]) -> Any:
            import drjit as dr

            if self.at == len(self.kept) or self.kept[self.at][0] != what:
                known = self.kept[self.at][0] if self.at < len(self.kept) else "nothing more"
                raise RuntimeError(f"read-back {self.at}: LLVM has read {known}, the card reads {what}")
            values = self.kept[self.at][1]
            self.at += 1
            if isinstance(values, torch.Tensor):
                dr.eval(x)
                return Device.put(values.clone())
            read()  # for what it launches and waits for
            return np.array(values) if isinstance(values, np.ndarray) else values

        with _patched(again):
            yield
        if self.at != len(self.kept):
            raise RuntimeError(f"LLVM has read {len(self.kept)} times, the card {self.at} times")


@contextlib.contextmanager
def _patched(read: Callable[[str, Any, Callable[[], Any]], Any]) -> Iterator[None]:
    """Every way in which numbers leave Dr.Jit goes through `read(what, array, original)`."""
    import drjit as dr

    from drgs import runtime

    base = dr.ArrayBase
    backend = dr.backend_v(runtime.dr_types().Float)
    # Flat arrays of numbers only: of a nested one a part is another array, and a tensor's parts are tensors.
    given = [t for t in vars(runtime.dr_types()).values() if isinstance(t, type) and issubclass(t, base)]
    flat = {t for t in given if dr.depth_v(t) == 1 and not dr.is_tensor_v(t)}
    before: list[tuple[Any, str, Any]] = []
    inside = False

    def hook(owner: Any, name: str, label: Callable[[Any, tuple], str | None]) -> None:
        original = getattr(owner, name)

        def hooked(self: Any, *args: Any, **kwargs: Any) -> Any:
            nonlocal inside
            # `dr.wrap` takes tensors of the host to the card by way of arrays of LLVM.
            what = None if inside or dr.backend_v(self) != backend else label(self, args)
            if what is None:
                return original(self, *args, **kwargs)
            inside = True
            try:
                return read(what, self, lambda: original(self, *args, **kwargs))
            finally:
                inside = False

        before.append((owner, name, vars(owner).get(name)))
        setattr(owner, name, hooked)

    def of(name: str) -> Callable[[Any, tuple], str]:
        return lambda self, args: f"{name} of {type(self).__name__} [{dr.width(self)}]"

    def single(self: Any, args: tuple) -> str | None:
        if not args or not isinstance(args[0], int):
            return None
        return f"item of {type(self).__name__} [{dr.width(self)}]"

    hook(base, "torch", of("torch"))
    hook(base, "numpy", of("numpy"))
    for t in flat:
        hook(t, "__getitem__", single)
    compress = dr.compress

    def compressed(mask: Any) -> Any:
        found: Any = None

        def places() -> np.ndarray:
            nonlocal found
            found = compress(mask)
            return found.numpy()

        nonlocal inside
        inside = True
        try:
            values = read(f"compress of {dr.width(mask)}", mask, places)
        finally:
            inside = False
        UInt32 = runtime.dr_types().UInt32
        return found if dr.width(found) == len(values) else UInt32(np.ascontiguousarray(values))

    dr.compress = compressed
    try:
        yield
    finally:
        dr.compress = compress
        for owner, name, old in reversed(before):
            if old is None:
                delattr(owner, name)
            else:
                setattr(owner, name, old)
