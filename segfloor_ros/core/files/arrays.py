"""Named arrays, as the parts of a saved map are kept."""

from __future__ import annotations

from collections.abc import Mapping, Sized
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

Arrays = dict[str, NDArray[Any]]


@dataclass
class MapFile:
    """The parts of a map by the name of the stage that they belong to, and a header of plain values
    (numbers, texts, lists, dictionaries).
    """

    header: dict[str, Any]
    parts: dict[str, Arrays] = field(default_factory=dict)


def joined(arrays: list[NDArray[Any]], empty: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return arrays (N_i, ...) as one (sum N_i, ...) and their lengths; empty: one of no rows."""
    lengths = np.array([len(array) for array in arrays], np.int64)
    return np.concatenate([empty, *arrays]), lengths


def split(array: NDArray[Any], lengths: NDArray[Any]) -> list[NDArray[Any]]:
    """Return the arrays that `joined` made one of. Raises ValueError where lengths do not fit."""
    if lengths.sum() != len(array):
        raise ValueError(f'{len(array)} rows, but {lengths.sum()} are expected')
    return np.split(array, np.cumsum(lengths)[:-1].tolist()) if len(lengths) else []


def take(arrays: Arrays, kept: NDArray[np.bool_], lengths: Mapping[str, str]) -> Arrays:
    """Return the rows of columns (K, ...) that are kept (K,). lengths: of columns that `joined`
    made by row, the names of those with their lengths; they need not be there. Raises IndexError or
    ValueError where they do not fit.
    """
    there = {name: count for name, count in lengths.items() if name in arrays}
    of_rows = {name: np.repeat(kept, arrays[count]) for name, count in there.items()}
    return {name: array[of_rows.get(name, kept)] for name, array in arrays.items()}


def check_lengths(arrays: Mapping[str, Sized]) -> None:
    """Raise ValueError unless all arrays have the same length."""
    if len({len(array) for array in arrays.values()}) > 1:
        raise ValueError('columns of different lengths')
