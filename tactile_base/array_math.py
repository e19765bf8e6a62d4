"""What laws for one or for many are written with: numbers, or arrays of NumPy, PyTorch or JAX.

A law that takes `math` works on floats by default, and on arrays of any of the three with theirs; functions
have the names that the three libraries have in common::

    def law(y, z, math=NUMBERS):
        return math.clip(math.arctan2(y, z), -1.0, 1.0)

    law(0.1, 0.2)
    on = array_math("torch:cuda")
    on.numpy(law(on.array([0.1, 0.3]), on.array([0.2, 0.2]), on))
"""

from __future__ import annotations

import importlib
import math
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_base.settings import SettingError, unknown_name

_NAMES = (
    "sqrt", "exp", "sin", "cos", "arctan2", "clip", "where", "abs", "minimum", "maximum",
    "amax", "argmax", "sign", "stack", "take", "zeros_like", "isfinite",
)  # fmt: skip
_LIBRARIES = {"numpy": "numpy", "torch": "torch", "jax": "jax.numpy"}

#: For floats.
NUMBERS = SimpleNamespace(
    sqrt=math.sqrt,
    exp=math.exp,
    sin=math.sin,
    cos=math.cos,
    arctan2=math.atan2,
    clip=lambda value, lower, upper: min(max(value, lower), upper),
    where=lambda condition, one, other: one if condition else other,
    abs=abs,
    minimum=min,
    maximum=max,
)


class ArrayMath(SimpleNamespace):
    """The functions of one library, with arrays of doubles on one device.

    Attributes
    ----------
    name : as it was asked for
    """

    name: str

    def array(self, values: ArrayLike) -> Any:
        """Numbers as this library's doubles, on its device; integers, conditions and complex ones as such."""
        values = np.asarray(values)
        return self.put(values.astype(np.float64) if values.dtype.kind == "f" else values)

    def numpy(self, values: Any) -> NDArray[Any]:
        """As NumPy's."""
        return np.asarray(values.cpu() if hasattr(values, "cpu") else values)


def array_math(name: str = "numpy") -> ArrayMath:
    """The functions of LIBRARY or LIBRARY:DEVICE: numpy, torch, torch:cuda, jax, jax:gpu.

    Raises `SettingError` for a library or device that is not there.
    """
    library, _, device = name.partition(":")
    if library not in _LIBRARIES or (library == "numpy" and device):
        raise SettingError(f"device {name}: library {unknown_name(library, list(_LIBRARIES))}, as torch:cuda")
    try:
        module = importlib.import_module(_LIBRARIES[library])
    except ImportError as error:
        raise SettingError(f"device {name}: {library} is not installed here ({error})") from None
    found = ArrayMath(name=name, **{each: getattr(module, each) for each in _NAMES})
    try:
        found.put = _putter(library, module, device)
        found.array([0.0])
    except (RuntimeError, AssertionError) as error:
        raise SettingError(f"device {name}: {str(error).splitlines()[0]}") from None
    return found


def _putter(library: str, module: Any, device: str) -> Any:
    """What takes arrays of NumPy onto a device."""
    if library == "torch":
        return lambda values: module.as_tensor(values, device=device or "cpu")
    if library == "jax":
        jax = importlib.import_module("jax")
        jax.config.update("jax_enable_x64", True)
        where = jax.devices(device)[0] if device else None
        return lambda values: jax.device_put(values, where)
    return lambda values: values
