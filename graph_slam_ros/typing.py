"""Names of array types for the whole package."""

from collections.abc import Callable
from typing import Any, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.float64]
Index: TypeAlias = NDArray[np.int64]
Mask: TypeAlias = NDArray[np.bool_]
Numbers: TypeAlias = tuple[float, ...]
"""A point, a pose or a covariance, row by row: what messages and measurements carry."""

Result = TypeVar("Result")
Executor: TypeAlias = Callable[[Callable[[], Any]], Callable[[], Any]]
"""Begins work and returns what waits for its result."""
