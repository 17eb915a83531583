"""Real messages, as CDR bytes, and a border to hand them to."""

import math

import numpy as np
from foreign import DEFINITIONS
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.base import Nodetype

from graph_slam_ros.lie import se2
from graph_slam_ros.messages.from_msg import MessageConverter
from graph_slam_ros.messages.interfaces import typestore
from graph_slam_ros.messages.to_msg import covariance6, encode, header, make, point, vector
from graph_slam_ros.recordings.bag import BagWriter, Topic
from graph_slam_ros.recordings.definitions import recorded_decoder
from graph_slam_ros.slam import Config, Counters

STAMP_NS = 1_700_000_000_123_456_789
TWIST = np.diag([0.04, 0.01, 0.02])
DETECTIONS = "vision_msgs/msg/Detection3DArray"
CLOUD = "sensor_msgs/msg/PointCloud2"
DATATYPES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}  # of a PointField


def quaternion(roll=0.0, pitch=0.0, yaw=0.0, norm=1.0):
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(a / 2), math.sin(a / 2)) for a in (roll, pitch, yaw))
    x, y = sr * cp * cy - cr * sp * sy, cr * sp * cy + sr * cp * sy
    z, w = cr * cp * sy - sr * sp * cy, cr * cp * cy + sr * sp * sy
    return make("geometry_msgs/msg/Quaternion", x=x * norm, y=y * norm, z=z * norm, w=w * norm)


def pose(x=0.0, y=0.0, z=0.0, q=None):
    return make("geometry_msgs/msg/Pose", position=point(x, y, z), orientation=q or quaternion())


def odometry(at=None, frame="odom", child="base_link", stamp_ns=STAMP_NS, twist=TWIST, nanosec=None, sec=None):
    head = header(stamp_ns, frame)
    head.stamp.sec = head.stamp.sec if sec is None else sec
    head.stamp.nanosec = head.stamp.nanosec if nanosec is None else nanosec
    full = np.ravel(twist) if np.size(twist) == 36 else covariance6(np.asarray(twist), 0.0)
    speed = make("geometry_msgs/msg/Twist", linear=vector(0, 0), angular=vector(0, 0))
    return encode(
        make(
            "nav_msgs/msg/Odometry",
            header=head,
            child_frame_id=child,
            pose=make("geometry_msgs/msg/PoseWithCovariance", pose=at or pose(), covariance=np.zeros(36)),
            twist=make("geometry_msgs/msg/TwistWithCovariance", twist=speed, covariance=full),
        )
    )


def detection(at=None, covariance=None, name="a", frame="", class_id="kind", results=1, bbox=None, size=(0, 0)):
    if covariance is None:
        covariance = np.diag([0.01, 0.04, 0.09])
    full = np.zeros((6, 6))
    full[: len(covariance), : len(covariance)] = covariance
    posed = make("geometry_msgs/msg/PoseWithCovariance", pose=at or pose(2.0, 1.0), covariance=full.ravel())
    hypothesis = make("vision_msgs/msg/ObjectHypothesis", class_id=class_id, score=1.0)
    return make(
        "vision_msgs/msg/Detection3D",
        header=header(STAMP_NS, frame),
        results=[make("vision_msgs/msg/ObjectHypothesisWithPose", hypothesis=hypothesis, pose=posed)] * results,
        bbox=make("vision_msgs/msg/BoundingBox3D", center=bbox or pose(), size=vector(*size)),
        id=name,
    )


def detections(*found, frame="base_link", stamp_ns=STAMP_NS):
    return encode(make("vision_msgs/msg/Detection3DArray", header=header(stamp_ns, frame), detections=list(found)))


def transforms(*links, stamp_ns=STAMP_NS):
    """Each link: parent, child, (x, y, z), quaternion."""
    stamped = [
        make(
            "geometry_msgs/msg/TransformStamped",
            header=header(stamp_ns, parent),
            child_frame_id=child,
            transform=make("geometry_msgs/msg/Transform", translation=vector(*at), rotation=q),
        )
        for parent, child, at, q in links
    ]
    return encode(make("tf2_msgs/msg/TFMessage", transforms=stamped))


def posed(type_name, at, frame="map", covariance=None, stamp_ns=STAMP_NS):
    """PoseStamped or PoseWithCovarianceStamped."""
    if covariance is not None:
        at = make("geometry_msgs/msg/PoseWithCovariance", pose=at, covariance=np.asarray(covariance, float).ravel())
    return encode(make(f"geometry_msgs/msg/{type_name}", header=header(stamp_ns, frame), pose=at))


def recorded(type_name, definition):
    """Of a type that is known by a recording's definition alone: its decoder, and an encoder of plain fields."""
    store = get_typestore(Stores.EMPTY)
    theirs = get_types_from_msg(definition, type_name)
    store.register({**typestore().fielddefs, **theirs})

    def message(name, **fields):
        return store.types[name](**fields)

    def encoded(**fields):
        return bytes(store.serialize_cdr(message(type_name, **fields), type_name))

    return recorded_decoder(Topic("/t", type_name, 1, definition)), message, encoded


def everything():
    """Our types and those of packages that need not be there."""
    store, theirs = get_typestore(Stores.EMPTY), {}
    for name, definition in DEFINITIONS.items():
        theirs |= get_types_from_msg(definition, name)
    store.register(typestore().fielddefs | theirs)
    return store


STORE = everything()
DECODERS = {name: (lambda cdr, name=name: STORE.deserialize_cdr(cdr, name)) for name in DEFINITIONS}


def part(name, **given):
    """A message of any of these types, zero but for what is given."""
    fields = STORE.fielddefs[name][1]
    return STORE.types[name](**{field: given.get(field, _zero(*described)) for field, described in fields})


def sent(name, **given):
    """The bytes of such a message."""
    return bytes(STORE.serialize_cdr(part(name, **given), name))


def _zero(node, of):
    if node == Nodetype.NAME:
        return quaternion() if of == "geometry_msgs/msg/Quaternion" else part(of)
    if node == Nodetype.BASE:
        return {"string": "", "bool": False}.get(of[0], 0.0 if of[0].startswith("float") else 0)
    (inner, what), size = of
    count = size if node == Nodetype.ARRAY else 0
    is_number = inner == Nodetype.BASE and what[0] != "string"
    return np.zeros(count, what[0]) if is_number else [_zero(inner, what) for _ in range(count)]


class Border(MessageConverter):
    """A border whose counters are at hand."""

    def __init__(self, config, decoders):
        self.counts = Counters()
        super().__init__(config, self.counts, decoders)


def border(*links, decoders=None, **sections):
    """A border of this configuration that has been told of these fixed links, and waits for no others but if told."""
    sections["inputs"] = {"tf": False, **sections.get("inputs", {})}
    out = Border(Config.from_mapping(sections), decoders)
    if links:
        out.convert("tf_static", transforms(*links))
    return out


def scanner(dimensions=2, *links, **settings):
    """A border that hears a point cloud."""
    return listening("scan", CLOUD, *links, dimensions=dimensions, settings=settings)


def receiver(dimensions=3, *links, **settings):
    """A border that hears a receiver of satellites."""
    return listening("gps", "sensor_msgs/msg/NavSatFix", *links, dimensions=dimensions, settings=settings)


def compass(dimensions, *links, **settings):
    """A border that hears an IMU."""
    return listening("imu", "sensor_msgs/msg/Imu", *links, dimensions=dimensions, settings=settings)


def listening(name, type_name, *links, dimensions=2, decoders=None, settings=None, **sections):
    """A border with one input more."""
    inputs = {"names": f"odom detections {name}", **(sections.pop("inputs", None) or {})}
    mine = {"type": type_name, **(settings or {})}
    sections = {"inputs": inputs, name: mine, "world": {"dimensions": dimensions}, **sections}
    return border(*links, decoders=decoders, **sections)


def heard(b, name, cdr):
    """The one measurement of a message, or None."""
    out = b.convert(name, cdr)
    assert len(out) <= 1
    return out[0] if out else None


def counted(b):
    return b.counts.as_dict()


def only(sightings):
    (sighting,) = sightings.sightings
    return sighting


LANDMARKS = {"a": (6.0, 1.0), "b": (-2.0, 7.0), "c": (1.0, -6.0), "tag36h11:4": (7.0, 7.0)}
DATUM = 48.0, 11.0, 500.0


def record_drive(file, seconds=30):
    """A robot that drives round a circle with every kind of input: a turret, tags on /tf, a receiver, another SLAM."""
    truth = drifting = se2.IDENTITY
    with BagWriter(file) as bag:
        link = "base_link", "camera", (0.5, 0.0, 1.0), quaternion()
        bag.write("/tf_static", "tf2_msgs/msg/TFMessage", STAMP_NS, transforms(link))
        for k in range(10 * seconds):
            stamp_ns = STAMP_NS + k * 100_000_000
            x, y, yaw = drifting
            at, turret = pose(x, y, 0.0, quaternion(yaw=yaw)), 0.05 * k

            def send(topic, type_name, cdr, late_ns=0, stamp_ns=stamp_ns):
                bag.write(topic, type_name, stamp_ns + late_ns, cdr)

            send("/odom", "nav_msgs/msg/Odometry", odometry(at, stamp_ns=stamp_ns))
            found = []
            for name, there in list(LANDMARKS.items())[:3]:
                local = se2.act(se2.inverse((0.0, 0.0, turret)), se2.act(se2.inverse(truth), there))
                found.append(detection(pose(*map(float, local)), np.eye(2) * 0.01, name))
            send("/landmarks", DETECTIONS, detections(*found, frame="turret", stamp_ns=stamp_ns), 1_000_000)
            moving = [
                ("odom", "base_link", (x, y, 0.0), quaternion(yaw=yaw)),
                ("base_link", "turret", (0.0, 0.0, 0.0), quaternion(yaw=turret)),
                ("camera", "tag36h11:4", (*_seen_from_camera(truth), -1.0), quaternion()),
            ]
            send("/tf", "tf2_msgs/msg/TFMessage", transforms(*moving, stamp_ns=stamp_ns), 2_000_000)
            correction = "map", "odom", (9.0, 9.0, 0.0), quaternion(yaw=1.0)
            send("/tf", "tf2_msgs/msg/TFMessage", transforms(correction, stamp_ns=stamp_ns), 3_000_000)
            if k % 10 == 0:
                send("/fix", "sensor_msgs/msg/NavSatFix", gnss(*_geodetic(truth), stamp_ns=stamp_ns), 4_000_000)
            truth = se2.compose(truth, (0.1, 0.0, 0.02))
            drifting = se2.compose(drifting, (0.1, 0.0, 0.0205))
    return file


def _seen_from_camera(truth):
    x, y = se2.act(se2.inverse(truth), LANDMARKS["tag36h11:4"])
    return float(x) - 0.5, float(y)


def _geodetic(truth):
    """Of a place near the datum, to millimetres: by the radii of curvature there."""
    latitude, longitude, height = DATUM
    a, e2 = 6378137.0, 0.00669437999014
    w = 1.0 - e2 * math.sin(math.radians(latitude)) ** 2
    north = math.degrees(truth[1] / (a * (1.0 - e2) / w**1.5 + height))
    east = math.degrees(truth[0] / ((a / math.sqrt(w) + height) * math.cos(math.radians(latitude))))
    return latitude + north, longitude + east, height


def gnss(latitude=48.0, longitude=11.0, altitude=500.0, covariance=None, kind=2, status=0, **head):
    """sensor_msgs/NavSatFix."""
    message = make(
        "sensor_msgs/msg/NavSatFix",
        header=header(head.get("stamp_ns", STAMP_NS), head.get("frame", "base_link")),
        status=make("sensor_msgs/msg/NavSatStatus", status=status, service=1),
        latitude=float(latitude),
        longitude=float(longitude),
        altitude=float(altitude),
        position_covariance=np.asarray(np.eye(3) if covariance is None else covariance, dtype=float).ravel(),
        position_covariance_type=kind,
    )
    return encode(message)


def imu(q, covariance, frame="base_link", stamp_ns=STAMP_NS, rate=(0.0, 0.0, 0.0), rate_covariance=(0.0,) * 9):
    """sensor_msgs/Imu."""
    zero = make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
    return encode(
        make(
            "sensor_msgs/msg/Imu",
            header=header(stamp_ns, frame),
            orientation=q,
            orientation_covariance=np.asarray(covariance, dtype=float).ravel(),
            angular_velocity=vector(*rate),
            angular_velocity_covariance=np.asarray(rate_covariance, dtype=float).ravel(),
            linear_acceleration=zero,
            linear_acceleration_covariance=np.zeros(9),
        )
    )


def cloud(
    layout, *points, padding=3, big=False, height=1, row_padding=0, frame="base_link", stamp_ns=STAMP_NS, **changes
):
    """Points of (name, kind) fields with unused bytes between them, at the end of each and of each row."""
    order, offset, fields, formats, offsets = ">" if big else "<", 0, [], [], []
    for name, kind in layout:
        offset += padding
        field = {"name": name, "offset": offset, "datatype": DATATYPES[kind], "count": 1}
        fields.append(typestore().types["sensor_msgs/msg/PointField"](**field))
        formats.append(order + kind)
        offsets.append(offset)
        offset += int(kind[1])
    step = offset + padding
    dtype = np.dtype({"names": [name for name, _ in layout], "formats": formats, "offsets": offsets, "itemsize": step})
    width = len(points) // height
    rows = [np.array(list(points[k * width : (k + 1) * width]), dtype=dtype).tobytes() for k in range(height)]
    values = {
        "height": height,
        "width": width,
        "fields": fields,
        "is_bigendian": big,
        "point_step": step,
        "row_step": width * step + row_padding,
        "data": np.frombuffer(b"".join(row + b"\xff" * row_padding for row in rows), dtype=np.uint8),
        "is_dense": True,
    }
    return encode(make(CLOUD, header=header(stamp_ns, frame), **(values | changes)))


def closing(dimensions, *links):
    """A border that hears of closures."""
    return listening("loops", DETECTIONS, *links, dimensions=dimensions, settings={"use": "closure"})
