"""Whatever bytes come to any input: nothing is raised, what leaves can be used, and what does not is counted."""

import functools
import math
from dataclasses import fields, is_dataclass

import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from messages import CLOUD, DECODERS, STAMP_NS, STORE, cloud, counted, listening, part, quaternion, transforms
from reliability import tell, times
from rosbags.typesys.base import Nodetype
from rows import each

from graph_slam_ros.measurements.types import to_record
from graph_slam_ros.messages.inputs import CONVERTERS

S = 1_000_000_000
FRAMES = {  # those that make sense where a message is used so, and those of what it tells of
    "odometry": (("odom", "world"), ("base_link", "mast")),
    "fix": (("map", "base_link", "mast"), ("base_link", "mast")),
    "gyro": (("base_link", "mast", "turret"), ("base_link",)),
    "landmarks": (("base_link", "mast", "turret", "odom"), ("tag1", "tag2", "tag3", "hand")),
    "closure": (("base_link", "mast", "turret"), ("base_link",)),
}
WILD_TEXTS = ("", "nowhere", "map", "base_link", "/base_link", "/", "tag2", "ä" * 100, "\n", "nan", "9" * 30)
WILD_NUMBERS = math.nan, math.inf, -math.inf, 0.0, -1.0, 5e-324, 1e-300, 1e9, 1e154, 1.7e308, -1.7e308
LINKS = (
    ("base_link", "mast", (0.2, 0.0, 1.0), quaternion(0.1, 0.2, 0.3)),
    ("base_link", "a:1", (2.0, 1.0, 0.0), quaternion()),
    ("world", "odom", (3.0, 1.0, 0.0), quaternion(yaw=1.0)),
)
SIGMAS = {"sigma_m": 0.1, "sigma_rad": 0.1}
POINT_FIELDS = "x", "y", "z", "range", "bearing", "elevation", "id", "sigma", "sigma_bearing", "intensity"


class Sender:
    """Messages that make sense by their definitions, as far as that can be; then some of their numbers are absurd."""

    def __init__(self, seed, use):
        self.rng = np.random.default_rng(seed)
        self.frames, self.children = FRAMES[use]
        self.texts = ("7", str(STAMP_NS - S)) if use == "closure" else ("a", "b", "7")

    def pick(self, values):
        return values[self.rng.integers(len(values))]

    def message(self, name, length):
        """With so many entries of what is as long as it likes."""
        if name == "builtin_interfaces/msg/Time":
            sec, nanosec = divmod(STAMP_NS + int(self.rng.integers(-S, S)), S)
            return part(name, sec=sec, nanosec=nanosec)
        if name == "geometry_msgs/msg/Quaternion":
            return quaternion(*self.rng.uniform(-math.pi, math.pi, 3).tolist())
        if name == CLOUD:
            layout = [(one, self.pick(("i4", "u4", "f4", "f8"))) for one in POINT_FIELDS if self.rng.random() < 0.6]
            points = np.abs(self.rng.normal(0.0, 3.0, (length, len(layout))))
            cdr = cloud(layout, *map(tuple, points.tolist()), frame=self.pick(self.frames))
            return STORE.deserialize_cdr(cdr, name)
        of = {field: self.value(field, *described, length) for field, described in STORE.fielddefs[name][1]}
        return STORE.types[name](**of)

    def value(self, field, node, of, length):
        if node == Nodetype.NAME:
            return self.message(of, length)
        if node == Nodetype.BASE:
            return self.scalar(field, of[0])
        (inner, what), size = of
        count = size if node == Nodetype.ARRAY else length
        if "covariance" in field and inner == Nodetype.BASE:
            root = self.rng.standard_normal((math.isqrt(count),) * 2) * self.pick((0.0, 1e-3, 0.1, 1.0))
            return (root @ root.T).ravel()
        several = [self.value(field, inner, what, length) for _ in range(count)]
        return np.array(several, dtype=what[0]) if inner == Nodetype.BASE and what[0] != "string" else several

    def scalar(self, field, kind):
        if kind == "string":
            return self.pick(self.texts if "frame" not in field else self.children if "child" in field else self.frames)
        if kind.startswith("float"):
            usual = {"latitude": 48.0, "longitude": 11.0}.get(field)
            return float(abs(self.rng.normal(0.0, 3.0)) if usual is None else self.rng.normal(usual, 1e-4))
        return (
            0 if field in ("action", "status") or kind in ("byte", "char", "octet", "bool") else self.pick((0, 1, 2, 3))
        )

    def spoil(self, message, wildness):
        """Make some numbers and texts absurd, each of its parts for itself."""
        for field, (node, of) in STORE.fielddefs[message.__msgtype__][1]:
            value, is_wild = getattr(message, field), self.rng.random() < wildness
            several = value if isinstance(value, list) else [value]
            for one in several:
                if is_dataclass(one):
                    self.spoil(one, wildness)
            if not is_wild:
                continue
            if node == Nodetype.SEQUENCE and isinstance(value, list):
                del value[self.rng.integers(3) :]
            elif isinstance(value, np.ndarray) and value.size and value.dtype.kind == "f":
                value[self.rng.integers(value.size)] = self.pick(WILD_NUMBERS)
            elif isinstance(value, str):
                setattr(message, field, self.pick(WILD_TEXTS))
            elif node == Nodetype.BASE and of[0].startswith("float"):
                with np.errstate(over="ignore", under="ignore"):
                    setattr(message, field, float(np.dtype(of[0]).type(self.pick(WILD_NUMBERS))))
            elif node == Nodetype.BASE and of[0][:3] in ("int", "uin"):
                limits = np.iinfo(of[0])
                setattr(message, field, int(self.pick((limits.min, limits.max, limits.max // 2))))

    def damaged(self, cdr):
        out = bytearray(cdr[: self.rng.integers(len(cdr)) if self.rng.random() < 0.5 else None])
        for _ in range(self.rng.integers(1, 4) if out else 0):
            out[self.rng.integers(len(out))] ^= 1 << int(self.rng.integers(8))
        return bytes(out)


def says_something(message):
    """Whether there is anything in it that must be used or counted: of most transforms there is nothing to say."""
    if type(message).__name__.endswith("TFMessage"):
        return False
    if hasattr(message, "width"):
        return message.width * message.height > 0
    entries = [getattr(message, f.name) for f in fields(message) if isinstance(getattr(message, f.name), list)]
    return any(getattr(one, "action", 0) not in (2, 3) for each in entries for one in each) if entries else True


def check(m):
    record = to_record(m)
    assert 0 < m.stamp_ns < 2**63
    for one in record.get("sightings", [record]):
        for name, value in one.items():
            if isinstance(value, tuple):
                assert np.isfinite(value).all()
                if "covariance" in name:
                    assert np.linalg.eigvalsh(np.reshape(value, (math.isqrt(len(value)), -1)))[0] > 0.0


def play(b, cdr, message):
    """A message while the robot's turret turns: what became of it."""
    before = counted(b)
    out = b.convert("any", cdr)
    for k in range(-2, 3):
        turret = ("base_link", "turret", (1.0, 0.0, 0.0), quaternion(yaw=0.1 * k))
        out += b.convert("tf", transforms(turret, stamp_ns=STAMP_NS + k * S))
    out += b.finish()
    for m in out:
        check(m)
    became = "accepted" if out else "rejected" if counted(b) != before else "says nothing"
    assert became != "says nothing" or message is None or not says_something(message)
    return became


FUZZ = functools.partial(
    settings, deadline=None, derandomize=True, database=None, suppress_health_check=list(HealthCheck)
)
CASES = [(name, use, n) for name, uses in CONVERTERS.items() for use in uses for n in (2, 3)]


@each("type_name, use, dimensions", CASES)
def test_whatever_comes_is_used_or_counted_and_nothing_is_raised(type_name, use, dimensions):
    count, found, borders = times(2_000, 500_000) // len(CASES) + 1, [], {}

    def hears(sigmas):
        """A border; of several odometries on one topic one would be left out, so each has one of its own."""
        if use == "odometry" or len(sigmas) not in borders:
            given = {"use": use, "frame_prefix": "tag", **sigmas}
            borders[len(sigmas)] = listening(
                "any", type_name, *LINKS, dimensions=dimensions, decoders=DECODERS, inputs={"tf": True}, settings=given
            )
        return borders[len(sigmas)]

    @FUZZ(max_examples=count)
    @given(
        seed=st.integers(0, 2**32),
        length=st.integers(0, 3),
        wildness=st.sampled_from((0.0, 0.02, 0.2)),
        is_damaged=st.sampled_from((False, False, False, True)),
        sigmas=st.sampled_from((SIGMAS, SIGMAS, {})),
    )
    def attempt(seed, length, wildness, is_damaged, sigmas):
        sender = Sender(seed, use)
        message = sender.message(type_name, length)
        sender.spoil(message, wildness)
        cdr = bytes(STORE.serialize_cdr(message, type_name))
        cdr, message = (sender.damaged(cdr), None) if is_damaged else (cdr, message)
        found.append(play(hears(sigmas), cdr, message))

    attempt()
    assert found.count("accepted")
    assert found.count("rejected")
    tell("messages", tried=len(found), rejected=found.count("rejected"), failed=0)
