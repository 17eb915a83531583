"""The data of a page, packed: JSON that refers to columns, and the columns in one compressed block."""

import base64
import json
import zlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from graph_slam_ros.cli.console import escaped
from graph_slam_ros.errors import GraphSlamError

MOST_TEXT = 200  # characters of a name that are shown
UNKNOWN = -(2**31)  # of a column of integers: not a number
_FORMATS = {"f4": np.float32, "f8": np.float64, "i4": np.int32, "u1": np.uint8}


def shown(text: str, most: int = MOST_TEXT) -> str:
    r"""A name as a page shows it: hidden characters as Python writes them (``\x1b``), and not too long."""
    text = escaped(text)
    return text if len(text) <= most else f"{text[: most - 3]}..."


class Packing:
    """The columns of a page."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self._size = 0

    def column(self, values: ArrayLike, kind: str = "f4") -> dict[str, Any]:
        """Numbers; ``kind`` is f4, f8, i4 or u1."""
        array = np.ascontiguousarray(values, dtype=_FORMATS[kind]).ravel()
        bytes_of = array.view(np.uint8).reshape(len(array), -1) if len(array) else np.zeros((0, 1), np.uint8)
        return self._add(kind, bytes_of.T.tobytes(), len(array), 1.0)  # bytes of one place together: they are alike

    def fixed(self, values: ArrayLike, step: float, *, is_path: bool = False) -> dict[str, Any]:
        """Numbers rounded to a multiple of ``step``; ``is_path``: each is near the one before."""
        array = np.asarray(values, dtype=float).ravel()
        scaled = np.rint(array / step)
        is_known = np.isfinite(scaled) & (np.abs(scaled) < 2**30)
        whole = np.where(is_known, scaled, UNKNOWN).astype(np.int64)
        if is_path and is_known.all():
            whole = np.diff(whole, prepend=0)
            return self.column(whole, "i4") | {"step": step, "sum": True}
        return self.column(whole, "i4") | {"step": step}

    def texts(self, several: Sequence[str]) -> dict[str, Any]:
        """Texts, none of which holds a zero character."""
        data = "\0".join(text.replace("\0", "") for text in several).encode("utf-8", "replace")
        return self._add("s", data, len(several), 1.0)

    def _add(self, kind: str, data: bytes, count: int, step: float) -> dict[str, Any]:
        out = {"packed": kind, "at": self._size, "bytes": len(data), "count": count, "step": step}
        self._parts.append(data)
        self._size += len(data)
        return out

    def block(self) -> str:
        """All columns, compressed, as base64."""
        return base64.b64encode(zlib.compress(b"".join(self._parts), 6)).decode()


def json_for_script(value: Any) -> str:
    """JSON that may stand in a script element: nothing in it ends that, whatever the names in it are."""
    try:
        text = json.dumps(value, allow_nan=False, separators=(",", ":"), ensure_ascii=True)
    except ValueError as error:
        raise GraphSlamError(f"report: a number is not finite ({error})") from None
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
