"""Whatever bytes come to any input: nothing is raised, what leaves can be used, and what does not is counted."""

import math
from collections import Counter
from dataclasses import fields
from types import SimpleNamespace

import numpy as np
import pytest
from foreign import DEFINITIONS
from messages import STAMP_NS, counted, listening, quaternion, transforms
from reliability import tell, times
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.base import Nodetype

from graph_slam_ros.measurements.types import to_record
from graph_slam_ros.messages.inputs import CONVERTERS
from graph_slam_ros.messages.inputs.landmark_types import LANDMARK_TYPES, fields_used
from graph_slam_ros.messages.interfaces import typestore

S = 1_000_000_000
FRAMES = {  # those that make sense where a message is used so, and those of what it tells of
    "odometry": (("odom", "odom", "odom", "world"), ("base_link", "base_link", "mast")),
    "fix": (("map", "map", "map", "base_link", "mast"), ("base_link", "mast")),
    "gyro": (("base_link", "mast", "turret"), ("base_link",)),
    "landmarks": (("base_link", "mast", "turret", "odom"), ("tag1", "tag2", "tag3", "hand")),
    "closure": (("base_link", "mast", "turret"), ("base_link",)),
}
NEVER_NEGATIVE = ("range", "sigma", "sigma_bearing", "decision_margin", "weight", "sensor_std")
WILD_FRAMES = ("", "nowhere", "map", "odom", "base_link", "/base_link", "/", "tag2", "ä" * 100)
WILD_TEXTS = ("", "ä" * 100, "\n", "0", str(STAMP_NS), "nan", "9" * 30)
WILD_NUMBERS = (math.nan, math.inf, -math.inf, 0.0, -1.0, 5e-324, 1e-300, 1e9, 1e154, 1.7e308, -1.7e308)
KINDS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
POINT_FIELDS = ("x", "y", "z", "range", "bearing", "elevation", "id", "sigma", "sigma_bearing", "intensity")


def everything():
    """Our types and those of packages that need not be there."""
    store, theirs = get_typestore(Stores.EMPTY), {}
    for name, definition in DEFINITIONS.items():
        theirs |= get_types_from_msg(definition, name)
    store.register(typestore().fielddefs | theirs)
    return store


STORE = everything()
DECODERS = {name: (lambda cdr, name=name: STORE.deserialize_cdr(cdr, name)) for name in DEFINITIONS}


class Sender:
    """Draws messages by their definitions: with sense, but each number and text for itself is now and then absurd."""

    def __init__(self, seed, use):
        self.rng = np.random.default_rng(seed)
        self.frames, self.children = FRAMES[use]
        self.texts = ("7", str(STAMP_NS - S)) if use == "closure" else ("a", "b", "7")
        self.wildness = 0.0
        self.length = 0  # of what is as long as it likes, unless it is wild

    def pick(self, values):
        return values[self.rng.integers(len(values))]

    def is_wild(self):
        return self.rng.random() < self.wildness

    def message(self, name):
        if name == "builtin_interfaces/msg/Time":
            return self.stamp()
        if name == "geometry_msgs/msg/Quaternion":
            return self.quaternion()
        if name == "sensor_msgs/msg/PointCloud2":
            return self.cloud()
        drawn = {field: self.value(field, *description) for field, description in STORE.fielddefs[name][1]}
        return STORE.types[name](**drawn)

    def value(self, field, node, of):
        if node == Nodetype.NAME:
            return self.message(of)
        if node == Nodetype.BASE:
            return self.scalar(field, of[0])
        (inner, what), size = of
        count = size if node == Nodetype.ARRAY else int(self.rng.integers(4)) if self.is_wild() else self.length
        if inner == Nodetype.BASE and what[0] != "string":
            if "covariance" in field:
                return self.covariance(math.isqrt(count))
            return np.array([self.scalar(field, what[0]) for _ in range(count)], dtype=what[0])
        return [self.value(field, inner, what) for _ in range(count)]

    def scalar(self, field, kind):
        if kind == "string":
            if "frame" in field:
                sensible = self.children if "child" in field else self.frames
                return self.pick(WILD_FRAMES if self.is_wild() else sensible)
            return self.pick(WILD_TEXTS if self.is_wild() else self.texts)
        if kind == "bool":
            return bool(self.rng.integers(2))
        if kind.startswith("float"):
            centre, spread = {"latitude": (48.0, 1e-4), "longitude": (11.0, 1e-4)}.get(field, (0.0, 3.0))
            sensible = centre + spread * self.rng.standard_normal()
            sensible = abs(sensible) if any(name in field for name in NEVER_NEGATIVE) else sensible
            drawn = self.pick(WILD_NUMBERS) if self.is_wild() else sensible
            with np.errstate(over="ignore", under="ignore"):
                return float(np.dtype(kind).type(drawn))
        if kind in ("byte", "char", "octet"):
            return 0
        limits = np.iinfo(kind)
        if field in ("action", "status") and self.rng.random() < 0.8:
            return 0
        return int(self.pick((limits.min, limits.max, limits.max // 2)) if self.is_wild() else self.rng.integers(4))

    def stamp(self):
        sec, nanosec = divmod(STAMP_NS + int(self.rng.integers(-S, S)), S)
        if self.is_wild():
            sec, nanosec = self.pick(((0, 0), (-1, 5), (2**31 - 1, S - 1), (0, 1), (sec, S), (sec, 2**32 - 1)))
        return STORE.types["builtin_interfaces/msg/Time"](sec=sec, nanosec=nanosec)

    def quaternion(self):
        norm = self.pick((0.0, math.nan, math.inf, 0.95, 1.05, 3.0, 1e200)) if self.is_wild() else 1.0
        return quaternion(*self.rng.uniform(-math.pi, math.pi, 3).tolist(), norm)

    def covariance(self, size):
        root = self.rng.standard_normal((size, size)) * self.pick((0.0, 1e-3, 0.1, 1.0))
        out = root @ root.T
        if self.is_wild():
            out[self.rng.integers(size), self.rng.integers(size)] = self.pick(WILD_NUMBERS)
        if self.is_wild():
            with np.errstate(over="ignore", invalid="ignore"):
                out *= self.pick((0.0, -1.0, 1e-300, 1e12, 1e200))
        return out.ravel()

    def cloud(self):
        """Points whose layout is right, unless it is wild."""
        names = [name for name in POINT_FIELDS if self.rng.random() < 0.6]
        kinds = [int(self.pick((5, 6, 7, 8))) for _ in names]
        layout = np.dtype([(name, KINDS[kind]) for name, kind in zip(names, kinds, strict=True)])
        points = np.zeros(int(self.rng.integers(4)), layout)
        for name in names:
            drawn = [self.scalar(name, "float64") for _ in points]
            with np.errstate(invalid="ignore", over="ignore"):
                points[name] = np.array(drawn, dtype=float).astype(layout[name])
        size = layout.itemsize
        described = [
            STORE.types["sensor_msgs/msg/PointField"](name=name, offset=layout.fields[name][1], datatype=kind, count=1)
            for name, kind in zip(names, kinds, strict=True)
        ]
        out = STORE.types["sensor_msgs/msg/PointCloud2"](
            header=self.message("std_msgs/msg/Header"),
            height=1,
            width=len(points),
            fields=described,
            is_bigendian=False,
            point_step=size,
            row_step=size * len(points),
            data=np.frombuffer(points.tobytes(), np.uint8),
            is_dense=True,
        )
        for field in ("height", "width", "point_step", "row_step"):
            if self.is_wild():
                setattr(out, field, self.scalar(field, "uint32"))
        for field in described:
            if self.is_wild():
                field.offset, field.datatype = self.scalar("", "uint32"), self.scalar("", "uint8")
        return out

    def damaged(self, cdr):
        out = bytearray(cdr)
        if self.rng.random() < 0.5:
            del out[self.rng.integers(len(out)) :]
        for _ in range(self.rng.integers(1, 4) if out else 0):
            out[self.rng.integers(len(out))] ^= 1 << int(self.rng.integers(8))
        return bytes(out)


def says_something(message):
    """Whether there is anything in it that must be used or counted."""
    if type(message).__name__.endswith("TFMessage"):
        return False  # of most transforms there is nothing to say
    if hasattr(message, "width"):
        return message.width * message.height > 0
    entries = [getattr(message, f.name) for f in fields(message) if isinstance(getattr(message, f.name), list)]
    shown = [one for each in entries for one in each if getattr(one, "action", 0) not in (2, 3)]
    return bool(shown) if entries else True


def check(m):
    record = to_record(m)
    assert 0 < m.stamp_ns < 2**63
    for part in record.get("sightings", [record]):
        for name, value in part.items():
            if not isinstance(value, tuple):
                continue
            assert np.isfinite(value).all()
            if "covariance" in name:
                size = math.isqrt(len(value))
                assert np.linalg.eigvalsh(np.reshape(value, (size, size)))[0] > 0.0


def play(seed, type_name, use, dimensions, count, sigma=0.1):
    """Messages of an input, damaged or not, while the robot's turret turns: what came of them, and what was counted."""
    sender = Sender(seed, use)
    b = listening(
        "any",
        type_name,
        ("base_link", "mast", (0.2, 0.0, 1.0), quaternion(0.1, 0.2, 0.3)),
        ("base_link", "a:1", (2.0, 1.0, 0.0), quaternion()),
        ("world", "odom", (3.0, 1.0, 0.0), quaternion(yaw=1.0)),
        dimensions=dimensions,
        decoders=DECODERS,
        inputs={"tf": True},
        ordering={"max_waiting": 5},
        settings={"use": use, "frame_prefix": "tag", "sigma_m": sigma, "sigma_rad": sigma},
    )
    out, became = [], judged(b)
    for k in range(count):
        told = counted(b).get("any", {}).get("undecodable", 0)
        sender.length = int(sender.rng.integers(4))
        sender.wildness = float(sender.pick((0.0, 0.01, 0.1)))
        cdr = bytes(STORE.serialize_cdr(sender.message(type_name), type_name))
        if sender.rng.random() < 0.2:
            cdr = sender.damaged(cdr)
        out += b.convert("any", cdr)
        became["rejected"] += counted(b).get("any", {}).get("undecodable", 0) - told
        turret = ("base_link", "turret", (1.0, 0.0, 0.0), quaternion(yaw=0.1 * k))
        out += b.convert("tf", transforms(turret, stamp_ns=STAMP_NS + (k % 20 - 10) * S // 10))
    out += b.finish()
    assert not b._pending
    for m in out:
        check(m)
    assert became["accepted"] + became["rejected"] + became["says nothing"] == count
    return became, counted(b)


def judged(b):
    """What becomes of each message of the input, once it waits for nothing: a count that goes on."""
    became, convert = Counter(), b._converted

    def converted(source, message):
        told, waiting = counted(b), len(b._pending)
        out = convert(source, message)
        if source.name == "any" and len(b._pending) == waiting:
            verdict = "accepted" if out else "rejected" if counted(b) != told else "says nothing"
            assert verdict != "says nothing" or not says_something(message)
            became[verdict] += 1
        return out

    b._converted = converted
    return became


CASES = [(name, use, n) for name, uses in CONVERTERS.items() for use in uses for n in (2, 3)]


@pytest.mark.parametrize("type_name, use, dimensions", CASES)
def test_whatever_comes_is_used_or_counted_and_nothing_is_raised(type_name, use, dimensions):
    count = times(5_000, 500_000) // len(CASES) + 1
    for seed, sigma in enumerate((0.1, 0.0)):
        sent = count // 5 if seed else count - count // 5
        became, told = play(seed, type_name, use, dimensions, sent, sigma)
        assert became["accepted"] or not sigma, "some are good"
        assert told["any"].get("undecodable") or not sigma, "some are not even messages"
        tell("messages", tried=sent, rejected=became["rejected"], failed=0)


def only_used(name, message, used):
    """A message with no other fields than those that its row names."""
    described, out = dict(STORE.fielddefs[name][1]), {}
    for field in used.get(name, " ".join(described)).split():
        kind, of = described[field]
        value = getattr(message, field)
        if kind == Nodetype.NAME:
            value = only_used(of, value, used)
        elif kind in (Nodetype.ARRAY, Nodetype.SEQUENCE) and of[0][0] == Nodetype.NAME:
            value = [only_used(of[0][1], one, used) for one in value]
        out[field] = value
    return SimpleNamespace(**out)


def test_the_messages_of_every_row_of_landmark_types_are_in_the_tests():
    assert LANDMARK_TYPES.keys() == DEFINITIONS.keys(), "test/foreign.py has the recorded definition of each"


@pytest.mark.parametrize("type_name", LANDMARK_TYPES)
def test_a_type_of_landmarks_is_read_by_no_other_fields_than_its_row_names(type_name):
    sender = Sender(0, "landmarks")
    sender.length = 3
    tags = [f"{family}:{number}" for family in sender.texts for number in range(4)]  # whose poses are on /tf alone
    links = [("base_link", frame, (1.0, 0.0, 0.0), quaternion()) for frame in ("mast", "turret", *tags)]
    source = listening("any", type_name, *links, decoders=DECODERS)._sources["any"]
    found = []
    for _ in range(10):
        message = only_used(type_name, sender.message(type_name), fields_used())
        found += LANDMARK_TYPES[type_name].read(source, message)
    assert found
