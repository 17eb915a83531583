"""Numbers of tests go from one process of pytest to another: a type it cannot send ends the whole run."""

import numpy as np
import pytest
import reliability
from execnet.gateway_base import dumps


@pytest.fixture(autouse=True)
def nothing_yet(monkeypatch):
    for name in ("_TOLD", "_WORST"):
        monkeypatch.setattr(reliability, name, getattr(reliability, name).copy())
        getattr(reliability, name).clear()


def test_numbers_of_numpy_can_be_sent():
    reliability.tell("one", tried=np.int64(3), median=tuple(np.array([1.0, 2.0])), worst={"m": np.float64(0.5)})
    dumps(reliability.told())
    assert list(reliability.lines()) == ["RELIABILITY one tried=3 median=[1.0, 2.0] worst_m=0.5"]


def test_what_cannot_be_sent_fails_its_own_test():
    with pytest.raises(AttributeError):
        reliability.tell("one", tried=object())
