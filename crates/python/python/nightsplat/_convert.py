"""Arguments as the native module takes them."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt


def assignments(settings: Mapping[str, object] | None, section: str = "") -> list[str]:
    """Settings as assignments, such as `tone.curve="ap3"`; a section is a dictionary, and None is no value."""
    found: list[str] = []
    for name, value in (settings or {}).items():
        if isinstance(value, Mapping):
            found += assignments(value, f"{section}{name}.")
        elif value is not None:
            found.append(f"{section}{name}={_toml(section + name, value)}")
    return found


def _toml(key: str, value: object) -> str:
    if isinstance(value, os.PathLike):
        value = os.fspath(value)
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(_toml(key, one) for one in value)}]"
    # Flags, numbers and texts of TOML are written as in JSON.
    if isinstance(value, (bool, int, float)):
        return json.dumps(value)
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    from ._native import UsageError

    raise UsageError(f"{key} is {value!r}; pass a bool, a number, a text, a path, or a list of them")


def planes(array: object) -> npt.NDArray[np.float32]:
    """An image (H, W, 3) of uint8, of uint16 or of floats as (3, H, W) of float32, black 0 and white 1."""
    values = np.asarray(array)
    if values.ndim != 3 or values.shape[2] != 3 or values.size == 0 or values.dtype.kind not in "fu":
        from ._native import UsageError

        raise UsageError(
            f"an array of shape {values.shape} of {values.dtype} is no image; pass (H, W, 3) of uint8, of uint16, "
            "or of floats from 0 to 1"
        )
    white = np.float32(1) if values.dtype.kind == "f" else np.float32(np.iinfo(values.dtype).max)
    return np.ascontiguousarray(np.moveaxis(values.astype(np.float32) / white, 2, 0))


def numbers(name: str, array: object, shape: Sequence[int], dtype: np.dtype[Any]) -> npt.NDArray[Any]:
    """Numbers in an array of this shape, where -1 is any length, in the order of C."""
    values = np.ascontiguousarray(np.asarray(array, dtype=dtype))
    fits = values.ndim == len(shape) and all(want in (-1, have) for want, have in zip(shape, values.shape))
    if not fits:
        from ._native import UsageError

        wanted = ", ".join("N" if want < 0 else str(want) for want in shape)
        raise UsageError(f"{name} has the shape {values.shape}; it must be ({wanted})")
    return values
