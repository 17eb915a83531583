"""What happens to recordings: twelve ways in which messages are lost, doubled, late, out of order or wrongly dated.

Each takes the messages of a recording in the order they came and returns others. What is known to be true is no
message; where stamps are changed, ``to_recorded`` of the result says when it was by the clock of the recording.
"""

import struct
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from graph_slam_ros.recordings.bag import BagMessage

S = 1_000_000_000
_STAMP = struct.Struct("<iI")  # a header comes first, after four bytes of encoding
_LISTS = ("/tf_static", "/tf")  # whose headers stand elsewhere


@dataclass(frozen=True)
class Mutated:
    """A recording to which something has happened.

    Attributes
    ----------
    to_recorded : of stamps [ns], those of the same instants before
    lost : the part of the messages that is no more, or of no use
    segments : of the path that is made of it
    """

    messages: list[BagMessage]
    to_recorded: Callable[[np.ndarray], np.ndarray] = lambda stamps_ns: stamps_ns
    lost: float = 0.0
    segments: int = 1


def stamp_ns(message):
    """Of its header."""
    sec, nanosec = _STAMP.unpack_from(message.cdr, 4)
    return sec * S + nanosec


def dated(message, stamp):
    """The message with another stamp in its header."""
    if message.topic in _LISTS:
        return message
    cdr = bytearray(message.cdr)
    _STAMP.pack_into(cdr, 4, *divmod(int(stamp), S))
    return replace(message, cdr=bytes(cdr))


def arriving(messages, delays_s):
    """In another order: each so much later."""
    later = [replace(m, log_ns=m.log_ns + int(d * S)) for m, d in zip(messages, delays_s, strict=True)]
    return sorted(later, key=lambda m: m.log_ns)


def _is_seen(m):
    return m.topic == "/landmarks"


def _middle_ns(messages):
    return (messages[0].log_ns + messages[-1].log_ns) // 2


def drop(messages, rng):
    """A fifth of all messages is lost."""
    keep = rng.random(len(messages)) >= 0.2
    return Mutated([m for m, k in zip(messages, keep, strict=True) if k or m.topic in _LISTS], lost=0.2)


def duplicate(messages, rng):
    """A fifth comes twice, the second time up to two seconds later."""
    again = [replace(m, log_ns=m.log_ns + int(2 * S * rng.random())) for m in messages if rng.random() < 0.2]
    return Mutated(sorted([*messages, *again], key=lambda m: m.log_ns))


def delay(messages, rng):
    """What is seen comes half a second to a second late."""
    return Mutated(arriving(messages, [rng.uniform(0.5, 1.0) if _is_seen(m) else 0.0 for m in messages]))


def reorder(messages, rng):
    """Everything comes up to 50 ms late."""
    return Mutated(arriving(messages, rng.uniform(0.0, 0.0499, len(messages))))


def offset(messages, rng):
    """The clock of what sees is 20 ms off."""
    by = int(rng.choice([-1, 1]) * 0.02 * S)
    return Mutated([dated(m, stamp_ns(m) + by) if _is_seen(m) else m for m in messages])


def gap(messages, rng):
    """For a tenth of the time nothing comes."""
    length = messages[-1].log_ns - messages[0].log_ns
    start = messages[0].log_ns + rng.uniform(0.2, 0.7) * length
    kept = [m for m in messages if not start < m.log_ns < start + 0.1 * length or m.topic in _LISTS]
    return Mutated(kept, lost=0.1)


def jump_forward(messages, rng):
    """In the middle the clock goes a minute forward."""
    return _jumped(messages, 60 * S)


def jump_back(messages, rng):
    """In the middle the clock of the robot, not of the recorder, goes back to before the recording began."""
    length_ns = messages[-1].log_ns - messages[0].log_ns
    return replace(_jumped(messages, -length_ns - 10 * S), lost=S / length_ns, segments=2)  # until it is sure


def _jumped(messages, by_ns):
    middle = _middle_ns(messages)
    after = [dated(m, stamp_ns(m) + by_ns) for m in messages if m.log_ns >= middle]
    first_ns = middle if by_ns > 0 else messages[0].log_ns

    def to_recorded(stamps):
        return np.where(stamps >= middle + by_ns // 2 if by_ns > 0 else stamps < first_ns - S, stamps - by_ns, stamps)

    return Mutated([m for m in messages if m.log_ns < middle] + after, to_recorded)


def loop(messages, rng):
    """It is played twice, without /clock, while another records."""
    length_ns = messages[-1].log_ns - messages[0].log_ns + S
    return Mutated([*messages, *(replace(m, log_ns=m.log_ns + length_ns) for m in messages)], segments=2)


def quantise(messages, rng):
    """Stamps are whole hundredths of a second."""
    unit = S // 100
    return Mutated([dated(m, (stamp_ns(m) + unit // 2) // unit * unit) for m in messages])


def nan_sprinkle(messages, rng):
    """In a twentieth there is one number that is none."""

    def spoilt(m):
        if m.topic in _LISTS or rng.random() >= 0.05:
            return m
        cdr = bytearray(m.cdr)
        places = range(4 + 8 * 5, len(cdr) - 7, 8)
        at = places[int(rng.integers(len(places)))] if places else len(cdr)
        cdr[at : at + 8] = struct.pack("<d", np.nan)[: len(cdr) - at]
        return replace(m, cdr=bytes(cdr))

    return Mutated([spoilt(m) for m in messages], lost=0.05)


def swap(messages, rng):
    """What one source tells in half a second comes before what the other does."""
    window, first = S // 2, messages[0].log_ns
    order = sorted(messages, key=lambda m: ((m.log_ns - first) // window, m.topic != "/landmarks", m.log_ns))
    return Mutated(order)


KINDS = {
    f.__name__: f
    for f in (
        drop, duplicate, delay, reorder, offset, gap, jump_forward, jump_back, loop, quantise, nan_sprinkle, swap,
    )
}  # fmt: skip
