"""The table of all that can be wrong: what it means, what mends it, what it hides.

A code of ``COUNTED`` is the name of a counter: it happens to a measurement. One of ``CHECKED`` is found by a check of
a recording, which measures it; docs/check.md says what. Diagnostics, the end of a replay, ``check``, the report, and
the tables of docs/troubleshooting.md and docs/check.md explain a code by its row here.
"""

from dataclasses import dataclass
from enum import Enum
from functools import partial


class Effect(Enum):
    """The effect on a measurement: not used, used after a change, nothing is lost; or what is counted nowhere."""

    REFUSED = "refused"
    REPAIRED = "repaired"
    NOTED = "noted"
    FOUND = "found"


@dataclass(frozen=True, slots=True)
class Row:
    """One row of the table.

    Attributes
    ----------
    meaning : what has happened, in one sentence without a full stop; empty where the finding itself has it; with
        ``{0.value}`` and the like where it needs what the finding has
    remedy : what mends it, beyond the settings of a finding; ``INPUT`` is the name of the input; empty where nothing is
        to be done
    hides : codes that are no finding of their own beside it, because they follow from it
    ends : whether other findings mean nothing while it is there
    """

    effect: Effect
    meaning: str
    remedy: str = ""
    hides: tuple[str, ...] = ()
    ends: bool = False


_refused, _repaired, _noted, _found = (partial(Row, effect) for effect in Effect)
_checked, _ends = partial(_found, ""), partial(_found, "", ends=True)

NO_IDS = ("landmarks.association=joint", "landmarks.id_from=none")
_COVARIANCE = "correct the driver, or set INPUT.noise=sigmas (odometry: odometry.noise=density)"
_SIGMAS = "INPUT.sigma_m, INPUT.sigma_rad: its standard deviations; of closures with INPUT.noise=sigmas"
_FRAMES = "publish the transform on /tf_static, or INPUT.mount, or frames.base as the messages name it"
_GAPS = "publish the moving transform at 10 Hz or more, all the time; inputs.tf_wait_s where it comes late"
_SPACE = "world.dimensions=3"
_DRIVER = "correct the driver (REP 103: metres, radians, x ahead, y to the left, turning left is positive)"
_DENSITY = "correct the driver; until then set odometry.noise=density"
_ONE_CLOCK = "synchronise the clocks (chrony, PTP); set use_sim_time for all nodes or for none"
_ONE_PUBLISHER = "one publisher: ros2 topic info -v TOPIC"
_TOPIC_EACH = "one publisher (ros2 topic info -v TOPIC), or a topic and an input for each (inputs.names)"
_ID = "one id for each landmark"
_NO_ID = f"{_ID}, or {', '.join(NO_IDS)}"
_WHEELS = "choose the topic of the wheels with --odom"

OF_STAMPS = (
    *("after_odometry", "before_odometry", "late", "odometry_gap", "duplicate_stamp", "other_publisher"),
    *("overflow", "frozen", "jump"),
)
"""What follows from stamps that are wrong, and from odometry that is refused."""
_OF_FIT = ("contradictory", "not_converged", "contradicted", "elsewhere", "displaced", "slip", "contested")
_FITTED = ("clock_offset", "clock_jump", "mount_place", "mount_moved", "mount_yaw", "odometry_scale", "turn_scale")
DOUBTS = (
    *(*_OF_FIT, *_FITTED, "range_scale", "odometry_over_confident", "not_seen_again", "ids_renewed"),
    *("ambiguous", "sides_unknown", "visits_contradict", "two_publishers"),
)
"""What may follow from an input that is wrong, or mostly refused."""
_OF_A_PATH = ("odometry_slips", "landmark_moved", "map_breaks", "id_reused", "ids_unsure", "outliers", "over_confident")

COUNTED: dict[str, Row] = {
    # -- stamps and order
    "bad_stamp": _refused("the stamp is negative, beyond 2^31 s, or has 1e9 ns or more", "correct the driver's stamps"),
    "zero_stamp": _refused("the stamp is zero", "have the driver fill in header.stamp"),
    "late": _refused("newer ones were used before it", "ordering.window_s (odometry), ordering.late_s; INPUT.offset_s"),
    "future": _refused("the stamp is ahead of the clock, or of odometry", "use_sim_time; INPUT.offset_s"),
    "far_in_time": _refused("the transform is dated 10 s away from the others of its frame", "one clock for all /tf"),
    "before_jump": _refused("it was sent before the clock jumped back and arrived after"),
    "before_odometry": _refused("it is older than all odometry", "begin with odometry; INPUT.offset_s"),
    "after_odometry": _refused("it is newer than the last odometry", "end with odometry; INPUT.offset_s"),
    "frozen": _noted("the robot moved past landmarks while odometry stood still", "its driver hangs, or it was towed"),
    "odometry_gap": _refused("odometry was silent, or jumped, then", "find out why its driver paused"),
    "overflow": _refused("too many messages waited", "inputs.queue of a node, ordering.max_waiting"),
    "duplicate": _noted("the same message has come before"),
    "duplicate_stamp": _refused("odometry has two poses for one stamp", _ONE_PUBLISHER),
    "sent_again": _noted("the transform was sent before with the same stamp"),
    "lost_in_transport": _refused("the middleware lost it", "INPUT.reliability: reliable; net.core.rmem_max"),
    # -- frames
    "frame_slash_stripped": _repaired("the name of a frame began with a slash"),
    "frame_empty": _refused("it names no frame", "header.frame_id of its driver; or INPUT.frame", ("frame_unknown",)),
    "frame_in_itself": _refused("a frame is its own parent", "correct the driver's frame names"),
    "frame_unknown": _refused("no transform links the message's frame to the robot", _FRAMES),
    "transform_gaps": _refused("/tf links the message's frame to the robot, but not at its stamp", _GAPS),
    "odom_frame_unknown": _refused("no transform links it to frames.odom", "set frames.odom to its frame"),
    "map_frame_unknown": _refused("no transform links it to frames.map", "set frames.map to its frame"),
    "child_frame_unknown": _refused("no transform links the message's child frame to the robot", _FRAMES),
    # -- numbers
    "undecodable": _refused("the bytes are not a message of this type", "INPUT.type, or record it again"),
    "plugin_failed": _refused("its plugin failed, or gave what is no measurement", "its first error is in the log"),
    "nonfinite": _refused("a number is NaN or infinite", "correct the driver"),
    "too_far": _refused("a coordinate is beyond 1e9 m", "correct the driver"),
    "beyond_max_distance": _refused("it is beyond INPUT.max_distance_m, or 100 km", "INPUT.max_distance_m"),
    "quaternion_normalized": _repaired("the quaternion was not quite of length one"),
    "zero_quaternion": _refused("the quaternion is zero", "have the driver fill in the orientation"),
    "denormal_quaternion": _refused("the quaternion's length is off by more than 10 %", "correct the driver"),
    "no_heading": _refused("the x axis is nearly vertical, so there is no heading in the plane", _SPACE),
    "out_of_plane": _noted("the pose is 0.5 m above or below the first, or tilted by 20 degrees", _SPACE, hides=DOUBTS),
    # -- noise
    "noise_unknown": _refused("neither the message nor the parameters have its noise", _SIGMAS),
    "covariance_unknown": _repaired("the covariance is zero: the configured noise is used"),
    "size_unknown": _noted("the size of a landmark is negative, above 1 km or no number: it is unknown"),
    "covariance_of_some_axes_unknown": _repaired("the twist's covariance lacks axes: configured noise is used"),
    "covariance_clamped": _repaired("a variance above 1e6 m^2 or 1e3 rad^2 was lowered to that"),
    "covariance_floored": _repaired("a variance that is nearly zero was raised"),
    "covariance_symmetrized": _repaired("the covariance was slightly asymmetric"),
    "covariance_asymmetric": _refused("the covariance is not symmetric", _COVARIANCE),
    "covariance_not_positive_definite": _refused("the covariance is not positive definite", _COVARIANCE),
    "nonfinite_covariance": _refused("the covariance has NaN, infinite or negative numbers", _COVARIANCE),
    # -- odometry
    "not_in_use": _noted("another odometry is used: the first alive of inputs.names", "a filter can fuse several"),
    "switched_to": _noted("this odometry took over from one that fell silent, or is of higher priority"),
    "switched_to_unlinked": _noted("this odometry took over; the motion between is unknown"),
    "gyro_waiting": _noted("the gyro's bias is unknown until it stands", "stand for a second; gyro.bias_sigma"),
    "gyro_silent": _noted("the gyro was silent longer than gyro.timeout_s", "gyro.timeout_s; INPUT.offset_s"),
    "gyro_doubted": _noted("it contradicts odometry in most turns", "rad/s, counter-clockwise; its TF or INPUT.mount"),
    "no_angular_velocity": _refused("the IMU says that it has no angular velocity", "INPUT.use=fix"),
    "jump": _noted("odometry jumped: a new segment; of tf: map -> odom", "odometry.max_speed_m_s; tf.report_jump_m"),
    "other_publisher": _refused("it does not continue the odometry in use", _ONE_PUBLISHER),
    "reset_to_zero": _noted("odometry was set back to zero: a new segment begins"),
    # -- landmarks
    "no_id": _refused("the detection has no identity", "landmarks.association=joint"),
    "id_too_long": _refused("the identity has more than 128 bytes", "shorter ids, or landmarks.id_from"),
    "id_conflict": _refused("one message has an identity at two places", _ID),
    "id_merged": _repaired("one message has an identity twice, at places that agree: their mean is used"),
    "id_of_an_unnamed": _refused("the identity is a name of landmarks without one", "INPUT.id_prefix"),
    "unclear_which": _refused("a detection without identity fits no landmark", "noise as large as the sensor's"),
    "surveyed_orientation_unused": _noted("it was first seen without an orientation", "a detector of orientations"),
    "not_for_a_pose": _refused("a range or bearing to a landmark that is known as a pose", "INPUT.id_prefix"),
    "not_used": _noted("landmarks.association is none", "landmarks.association=id"),
    "poor_tag": _noted("the tag is beyond INPUT.hamming_max or below INPUT.decision_margin_min"),
    "too_many": _refused("more than 1000 in a message: the nearest are used", "a scan is no list of landmarks"),
    "unknown_action": _refused("the marker's action is none of add, modify, delete", "correct the driver"),
    "lengths_differ": _refused("the message has not as many ids as poses", "correct the driver"),
    "range_not_positive": _refused("the range is zero, negative or beyond 1e9 m", "correct the driver"),
    "bearing_wrapped": _repaired("the bearing was beyond half a turn"),
    "bearing_out_of_range": _refused("an angle is far beyond a turn", "radians, not degrees"),
    "no_elevation": _refused("a bearing in space needs an elevation", "world.dimensions=2"),
    "sensor_tilted": _refused("an azimuth alone, of a sensor that is not level", "send the elevation"),
    "overhead": _refused("the landmark is straight above or below: no direction in the plane", _SPACE),
    "fields_unknown": _refused("it has neither x y z nor range, bearing, elevation", "a scan is no list of landmarks"),
    "fields_beyond_point": _refused("a field of the cloud lies outside its point", "correct the driver"),
    "too_many_points": _refused("the cloud has more than 100,000 points", "a scan is no list of landmarks"),
    "cut_off": _refused("the cloud has fewer bytes than it says", "correct the driver"),
    "undecided": _noted("a stretch of the drive may be of several places that look alike: it is left as it is"),
    "moves_left": _noted("the search for landmarks that are in the map twice reached its limit"),
    "reassigned": _noted("what was seen without identity turned out to be of another landmark"),
    "given_up": _noted("a new unnamed landmark was not seen again within a minute"),
    # -- fixes
    "no_fix": _refused("the receiver has no fix", "wait for one: a clear view of the sky"),
    "no_position": _refused("latitude and longitude are zero", "wait for a fix"),
    "not_on_earth": _refused("latitude, longitude or altitude is out of range", "degrees and metres"),
    "far_from_datum": _refused("the fix is more than 100 km from the map's origin", "INPUT.datum"),
    "other_datum": _refused("the fix counts from another origin than the map", "the same INPUT.datum for all"),
    "thinned": _noted("its error is that of the one before", "INPUT.correlation_s; keyframes.max_interval_s"),
    "mount_unknown": _repaired(
        "no transform has the place of the antenna: the base is assumed",
        '--set INPUT.mount="X Y Z 0 0 0", its place from the base in metres; zeros say that it is there',
    ),
    "mount_assumed": _noted("no transform has the place of the sensor: the base is assumed", _FRAMES),
    "map_moved": _noted("the first fix or surveyed landmark located the map", "anchor.sigma_m, anchor.sigma_rad"),
    "no_altitude": _repaired("the fix has no altitude: it counts in the horizontal only"),
    "no_orientation": _refused("the IMU says that it has no orientation", "its gyro alone: INPUT.use=gyro"),
    "not_in_this_space": _refused("such a fix does not exist in so many dimensions", "world.dimensions"),
    # -- closures
    "id_not_a_stamp": _refused("a closure's id is not the earlier stamp in nanoseconds", "see docs/inputs.md"),
    "closure_with_itself": _refused("a closure's two stamps are the same", "correct the publisher"),
    "no_result": _refused("a closure has no result with a pose", "correct the publisher"),
    "within_one_keyframe": _refused("a closure links two moments of one keyframe: it says nothing new"),
    "from_where_there_was_no_odometry": _refused(
        "its earlier stamp is outside odometry", "stamps by the robot's clock"
    ),
    "from_condensed_keyframe": _refused("its start left the map", "map.condense=false"),
    # -- the map
    "not_in_map": _noted("the map does not have it, and map.localize is true", "map.localize=false to add it"),
    "removed": _noted("an edge or a landmark that was removed by hand (~/remove)"),
    "unknown_edge": _noted("~/remove named an edge that is not there", "graph_slam explain RUN lists ids"),
    "unknown_landmark": _noted("~/remove named an unknown landmark", "ros2 topic echo ~/landmarks_estimate"),
    "needed_edge": _noted("~/remove named odometry or a prior: without it poses are undetermined"),
    "held_in_map": _noted("~/remove named a part of a map that is held", "map.localize=false"),
    "condensed_in_map": _noted("it is of a map with condensed visits", "edit a replay with map.condense=false"),
    "condensed": _refused("it left before its landmark was determined or confirmed", "map.window_keyframes"),
    "visit_condensed": _noted("a visit was added to its place, begins one, or is one keyframe"),
    "visit_wider": _noted("a visit fits its place with larger sigmas only (up to 3 times)"),
    "visit_lost": _noted("a visit that contradicts itself or its place: its odometry alone is kept"),
    "not_condensed": _noted("a keyframe that stays, for its edges or as too little is seen around it"),
    "held_keyframe": _noted("a keyframe that stays: its map is frozen, or held by map.localize"),
    "cleared": _noted("loop closures that ~/clear_closures took out"),
    "displaced": _noted("landmarks showed the robot elsewhere: carried, or slipped", "graph_slam explain RUN"),
    "slip": _noted("landmarks contradicted odometry for seconds: it counts less", "graph_slam check; odometry.noise"),
    "slip_taken_back": _noted("a slip was decided, and later sightings agree with odometry"),
    "displacement_taken_back": _noted("later sightings contradict a displacement", f"{_ID}; graph_slam check"),
    "new_while_elsewhere": _refused("an unknown landmark, while the robot's place is unknown", "give initialpose"),
    "quarantined": _refused("the solver works without these measurements only", "graph_slam explain RUN"),
    # -- the node and its solver
    "paused": _noted("it came while the node was paused", "~/resume"),
    "stopped": _refused("time jumped back and time.on_jump is stop", "~/reset, or --set time.on_jump=segment"),
    "worker_restarted": _noted("a job would have ended the solver's thread, which went on", "report it"),
    "unsolved": _noted("a solve, search or fit failed: what was known stands", "graph_slam check"),
    "fault": _noted("an error of this program: what was known stands", "report it with the log"),
}
"""By the name it is counted under; ``fault`` is for errors of the program, which are counted by their type."""

CHECKED: dict[str, Row] = {
    # -- inputs
    "no_odometry": _ends("record nav_msgs/Odometry, or odom -> base_link on /tf"),
    "no_landmarks": _checked("record a topic of landmarks"),
    "input_unused": _checked("record it as a type of docs/inputs.md, or name another topic with --odom or --landmarks"),
    "damaged": _checked("copy all of its files again, or record it again", ("no_closure", "silent", "gap")),
    # -- times
    "wrong_stamps": _ends("correct the driver: header.stamp has seconds and nanoseconds (0 to 999999999)", OF_STAMPS),
    "clock_domains": _checked(f"{_ONE_CLOCK}; or set INPUT.offset_s"),
    "latency": _checked(f"{_ONE_CLOCK}; or set INPUT.offset_s"),
    "clock_jump": _checked(f"{_ONE_CLOCK}; cut the recording there", hides=(*_OF_A_PATH, *_OF_FIT, "clock_offset")),
    "no_overlap": _ends(f"{_ONE_CLOCK}; or set INPUT.offset_s"),
    "odometry_short": _checked("record odometry from the beginning to the end; find out whether its driver stopped"),
    "time_jump": _checked("cut the recording in two; or time.on_jump", ("odometry_jumps", "corrected", "fit_unsure")),
    "constant_stamps": _ends("stamp each message when it is measured (header.stamp)", hides=OF_STAMPS),
    "coarse_stamps": _ends("stamp each message when it is measured, to the millisecond", hides=OF_STAMPS),
    "rounded_stamps": _checked("stamp each message when it is measured, to the millisecond"),
    "duplicates": _checked(_ONE_PUBLISHER, hides=("other_publisher", "duplicate_stamp")),
    "two_publishers": _checked(_TOPIC_EACH, hides=("other_publisher", "duplicate_stamp", "duplicates")),
    "out_of_order": _checked("set ordering.window_s", hides=("odometry_jumps", "corrected", "fit_unsure")),
    "gap": _checked("check the CPU and the disk of the recorder, and the driver"),
    "slow_odometry": _checked("publish odometry at 10 Hz or more"),
    # -- frames
    "frame_unlinked": _checked(_FRAMES, hides=("mount_assumed",)),
    "two_parents": _checked("let one node only publish each frame"),
    "seen_in_fixed_frame": _ends("publish them in the sensor's frame"),
    "odometry_in_map": _checked(_WHEELS),
    # -- odometry
    "pose_stands": _ends("have the driver fill in the pose", hides=("frozen",)),
    "static": _ends("choose another topic with --odom, or drive"),
    "units": _ends(_DRIVER, hides=("other_publisher", "odometry_gap", "jump", "late", "twist_scale")),
    "no_orientation_of_odometry": _ends("have the driver fill in the orientation of the pose"),
    "odometry_jumps": _checked("correct the driver; a run begins a segment above odometry.max_speed_m_s"),
    "odometry_reset": _checked("cut the recording there"),
    "corrected": _checked(_WHEELS),
    "twist_scale": _checked(_DENSITY),
    "twist_frame": _checked(_DENSITY),
    "twist_unrelated": _checked(_DENSITY),
    "covariance_tiny": _checked(_DENSITY, hides=_OF_A_PATH),
    "covariance_useless": _checked(_DENSITY),
    # -- fixes and headings
    "fix_mirrored": _checked("correct its driver (REP 103: east, north, up)"),
    "fix_frozen": _checked("have its driver send nothing while it has no fix"),
    "fix_jumps": _checked("mend its covariance, or set INPUT.sigma_m; a run leaves out what contradicts"),
    "heading_clockwise": _checked("correct its driver (REP 103: counter-clockwise from east)"),
    "heading_offset": _checked("correct its driver (0 is east), or where it is mounted"),
    # -- a gyro that is used as part of odometry
    "gyro_scale": _checked(
        "correct its driver (rad/s) or transform; or odometry.turn_factor, INPUT.mount", (*_OF_A_PATH, "clock_offset")
    ),
    "gyro_bias": _checked("let the robot stand when its gyro starts; or set gyro.bias_sigma"),
    "gyro_unrelated": _checked("check its topic, its frame and its clock"),
    # -- sightings and odometry
    "mirrored": _ends(_DRIVER, hides=("twist_unrelated", "twist_frame")),
    "axes": _ends("correct the sensor's transform, or its frame"),
    "unrelated": _ends("check the topic, the ids and the units of both"),
    "id_twice": _checked(_ID, hides=("id_conflict",)),
    "noise_zero": _ends("correct the driver; or set INPUT.noise=sigmas with INPUT.sigma_m"),
    "seen_once": _checked(_NO_ID, hides=("no_closure", "no_parallax", "not_observable", "not_seen_again")),
    "no_closure": _checked(f"record a drive with a loop; where there was one, ids change: {_ID}"),
    "no_parallax": _checked("record a drive past landmarks, with turns in sight of them"),
    # -- a replay in memory, and a fit that begins at its estimate
    "clock_offset": _checked(f"set INPUT.offset_s; {_ONE_CLOCK}", hides=("latency", *_OF_FIT)),
    "mount_place": _checked("measure it, and correct its transform; or set INPUT.mount_correction", hides=_OF_FIT),
    "mount_moved": _checked("fix the sensor on the robot, and cut the recording there", (*_OF_A_PATH, *_OF_FIT)),
    "mount_yaw": _checked("correct its transform, or set INPUT.mount_correction", hides=_OF_FIT),
    "odometry_scale": _ends("measure a way, and correct the wheel radius, or the size of the tags", hides=_OF_FIT),
    "turn_scale": _checked("correct the track width, or set odometry.turn_factor", hides=_OF_FIT),
    "range_scale": _ends("measure a way, and correct the tags' size, the sensor's driver, or odometry", _OF_FIT),
    "not_observable": _checked("drive what the text names"),
    "over_confident": _checked("INPUT.noise=sigmas, INPUT.sigma_m; robust.noise_scale=estimated allows for 3 times"),
    "odometry_over_confident": _checked("odometry.noise; robust.noise_scale=estimated allows for it", _OF_FIT),
    "odometry_slips": _checked("look at ground and tyres there; odometry.doubt finds slips; a gyro helps in turns"),
    "id_reused": _checked(_ID),
    "ids_unsure": _checked(_NO_ID),
    "ids_exchanged": _checked(_ID),
    "ids_renewed": _checked(_NO_ID, hides=("contested",)),
    "landmark_moves": _checked("let the detector leave out this id; a run leaves out what contradicts"),
    "landmark_moved": _checked("use landmarks that nobody moves"),
    "map_breaks": _checked("find out whether the robot was carried or slipped"),
    "outliers": _checked("correct the detector, or set landmarks.loss"),
    "fit_unsure": _checked("mend what else is found, or ids and the mount"),
    "silent": _checked("record a drive past landmarks all the way"),
}
"""What ``check`` finds, beyond counters."""

OF_RUNS: dict[str, Row] = {
    "solve_failed": _checked("distances or noise that no robot has: --set INPUT.max_distance_m=... INPUT.noise=sigmas"),
    "not_converged": _checked("--set solve.max_iterations=1000; graph_slam explain RUN lists what fits worst"),
    "contradictory": _checked("measurements contradict each other: graph_slam explain RUN says which"),
    "contradicted": _checked(
        "graph_slam explain RUN says why. Check units (metres and radians), signs (y and bearings to the left), the "
        "place of the sensor (TF or INPUT.mount), its clock (INPUT.offset_s) and ids that are used twice. If only its "
        "noise is larger than stated: --set INPUT.noise=sigmas --set INPUT.sigma_m=..."
    ),
    "contested": _checked("did it move, or is its id used twice?"),
    "unused": _checked(""),
    "not_seen_again": _checked(_NO_ID),
    "confused": _checked("landmarks.density_per_m, e.g. 0.4 if they are 2 m apart; classes, sizes or ids"),
    "ambiguous": _checked("graph_slam explain RUN"),
    "sides_unknown": _checked("more turns in sight of them, bearings, or surveyed landmarks (landmarks.surveyed)"),
    "visits_contradict": _checked("compare with --set map.condense=false; graph_slam check BAG; map.window_keyframes"),
    "elsewhere": _checked("check ids, units and clocks (graph_slam check BAG)"),
    "odometry_alone": _checked("graph_slam check BAG says what of the recording cannot be used"),
    "noise_too_large": _checked("--set INPUT.noise=sigmas --set INPUT.sigma_m=..."),
}
"""What the end of a run finds beyond these, and the node while it goes on."""

_SEE = "drive past known landmarks, or give initialpose"
_OR_BY = "a lifecycle manager, or node.autostart:=true"
_SLOWER = "a lower rate, or a larger keyframes.min_distance_m"
_DATED = "tf.transform_tolerance:={0.limit:.1f} dates it ahead; INPUT.offset_s for a clock that differs"
_LATE = "ordering.late_s:={0.limit:g}, or a faster detector; INPUT.offset_s for a clock that differs"
_STOP = "stop it, or tf.publish_tf=false"
_BEGIN_ANEW = "tf.stamp, tf.transform_tolerance; deactivate and activate the node, and listeners with it"

OF_NODE: dict[str, Row] = {
    "unconfigured": _found("nobody has configured it", f"ros2 lifecycle set NODE configure, {_OR_BY}"),
    "inactive": _found("nobody has activated it", f"ros2 lifecycle set NODE activate, {_OR_BY}"),
    "preparing": _found("{0.text}"),
    "loading": _found("loads the map of {0.text}"),
    "no_input": _found("no input", 'inputs.names: "odom detections"'),
    "unpublished": _found("nobody publishes {0.topic}", "start its driver, or remap: -r odom:=OTHER"),
    "unconnected": _found("{0.topic}: {0.text}", "INPUT.type, INPUT.reliability, INPUT.durability"),
    "nothing_came": _found("{0.topic}: {0.text} publishes it, but nothing has come yet", "look at the driver"),
    "its_turn": _found("{0.topic}: its first messages wait for their turn"),
    "input_silent": _found("{0.topic}: silent for {0.value:.1f} s", "look at the driver"),
    "comes_late": _found("{0.topic}: comes {0.value:.1f} s after its stamps, and so does map -> odom", _DATED),
    "nearly_late": _found(
        "{0.topic}: comes {0.value:.1f} s later than odometry of its time, and is soon refused", _LATE
    ),
    "no_clock": _found("use_sim_time is set and nothing comes on /clock", "publish it, or use_sim_time:=false"),
    "clock_stands": _found("/clock stands still while messages come, so map -> odom waits", "use_sim_time:=false"),
    "behind_last": _found("map -> odom is not sent: the last was dated {0.value:.0f} s later", _BEGIN_ANEW),
    "rival": _found("somebody else broadcasts map -> odom: {0.text}", _STOP),
    "static_rival": _found("somebody else publishes {0.topic} on /tf_static: {0.text}", _STOP),
    "twin": _found("another node has this node's name and does the same", "stop one, or rename it (-r __node:=NAME)"),
    "by_odometry_alone": _found("goes on by odometry alone since {0.text}, nothing recognised yet", _SEE),
    "unlocated": _found("where the robot is in the loaded map is not known yet", _SEE),
    "not_loaded": _found("output.load: the map was not loaded: {0.text}", "set another output.load and call ~/load"),
    "unwritten": _found("the run cannot be written", "make room; the log names the error"),
    "not_compiled": _found("kernels cannot be compiled ({0.text})", "try graph_slam warmup"),
    "worker_ended": _found("the solver's thread has ended", "restart the node, and report it with the log"),
    "callbacks": _found("{0.count} faults in callbacks in 10 s", "report it with the log"),
    "stuck": _found("solver stuck: it has been at one thing for {0.value:.1f} s", "wait; health.stuck_s is the limit"),
    "lagging": _found("the solver is {0.value:.1f} s behind, {0.count} messages wait", _SLOWER),
}
"""What the node finds of itself."""

TABLE = COUNTED | CHECKED | OF_RUNS | OF_NODE


def explain(code: str) -> Row:
    """The row of a code. Errors of the program are counted by their type and share one row."""
    return TABLE.get(code, COUNTED["fault"])


def remedy(source: str, code: str) -> str:
    """Return the remedy for this input; empty if nothing is to be done."""
    if source in ("tf", "tf_static") and code == "frame_empty":  # no parameter names the frames of a transform
        return "have the node that publishes the transform name both frames (header.frame_id and child_frame_id)"
    return explain(code).remedy.replace("INPUT", source.partition("#")[0] or "INPUT")  # a second odometry is odom#2
