"""Names of Dr.Jit's array types for signatures, which everything in the engine is written with.

The classes depend on the backend (`runtime.dr_types`), so that type checkers see `Any`.
"""

from __future__ import annotations

from types import ModuleType
from typing import Any

Lib = ModuleType  # the module of the backend's array types (runtime.dr_types): `lib` of every signature

Float = Any  # Float, or Float64 where a Gaussian is projected
UInt32 = Any
UInt64 = Any
Int32 = Any
Mask = Any  # Bool
