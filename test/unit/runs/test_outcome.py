"""What the end of a run says of its odometries and its gyro."""

from rows import each

from graph_slam_ros.runs.outcome import doubts, findings, shortcomings

LANDMARKS = {"use": "landmarks", "received": 90, "used": 90, "believed": 90}
ODOMETRY = {"use": "odometry", "received": 100, "used": 100, "believed": None}
ALARM = {"held_back": 8, "ended_ns": None, "segment": None, "text": "the landmarks say that the robot is elsewhere"}
GYRO = {"name": "imu", "bias": [0.01], "sigma": [0.001], "state": "used", "ratio": 1.0}


def summary(counters, gyro=None, **inputs):
    """A run whose landmarks are well."""
    out = {"counters": counters, "inputs": {"odom": ODOMETRY, "tags": LANDMARKS, **inputs}, "landmarks": 9}
    out |= {"sightings": 90, "failing": "", "waiting": {}, "keyframes": 50, "span_s": 10.0, "edges": 140, "chi2": 1.0}
    return out | {"solves": 3} | ({"gyro": gyro} if gyro else {})


def used(count, use="gyro"):
    return {"use": use, "received": 200, "used": count, "believed": None}


def test_a_gyro_that_is_wrong_or_not_used_and_no_convergence_and_an_alarm_are_shortcomings_with_what_mends_them():
    assert not [*shortcomings(summary({}, GYRO, imu=used(200)))]
    wrong = GYRO | {"state": "doubted", "ratio": 57.3}
    (said,) = shortcomings(summary({"imu": {"gyro_doubted": 80}}, wrong, imu=used(200)))
    assert said.startswith("imu: gyro and odometry contradict each other, it turns 57.3 times as much as odometry")
    assert "degrees" in said
    (said,) = shortcomings(summary({"imu": {"gyro_waiting": 51}}, GYRO | {"state": "waiting"}, imu=used(200)))
    assert said.startswith("imu: in 51 of 100 steps odometry turned") and "gyro.bias_sigma" in said
    (said,) = shortcomings(summary({"imu": {"gyro_silent": 51}}, GYRO, imu=used(20)))
    assert said.startswith("imu: in 51 of 100 steps odometry turned without the gyro: ")
    assert "gyro.timeout_s" in said and "imu.offset_s" in said
    assert not [*shortcomings(summary({"imu": {"gyro_silent": 50}}, GYRO, imu=used(20)))]
    (said,) = shortcomings(summary({"imu": {"gyro_silent": 100}}, GYRO, imu=used(0)))
    assert said == "imu: nothing of 200 messages was used: gyro_silent 100 (" + said.partition("(")[2]
    (said,) = shortcomings(summary({}) | {"converged": False, "stop": "max_iterations"})
    assert said.startswith("the last solve did not converge (max_iterations): ") and "--set solve.max_iter" in said
    assert findings(summary({}) | {"converged": True, "stop": "cost"}) == findings({"keyframes": 2}) == []
    (said,) = shortcomings(summary({}) | {"displacements": [ALARM]})
    assert "not decided" in said and not [*shortcomings(summary({}) | {"displacements": [ALARM | {"segment": 4}]})]


@each("lost, condensed, is_said", [(0, 40, False), (1, 5, False), (2, 60, False), (2, 28, True), (6, 30, True)])
def test_visits_that_contradict_the_others_are_said(lost, condensed, is_said):
    said = list(doubts(summary({"map": {"visit_lost": lost, "visit_condensed": condensed}})))
    assert len(said) == is_said
    assert all(f"{lost} of {lost + condensed} visits" in one and "map.condense=false" in one for one in said)


def test_several_odometries_on_one_topic_are_said_and_a_remedy_names_the_input():
    two = summary({"odom#2": {"late": 9}}, **{"odom#2": ODOMETRY | {"received": 10, "used": 1}})
    (said,) = doubts(two)
    assert said.startswith("odom: 2 odometries are on its topic")
    (refused,) = shortcomings(two)
    assert refused.startswith("odom#2: most of it was refused") and "odom.offset_s" in refused
    assert not list(doubts(summary({})))
    (jumps,) = shortcomings(summary({"odom": {"jump": 40}, "odom#2": {"jump": 9}}, **{"odom#2": ODOMETRY}))
    assert jumps.startswith("odom: 49 jumps")
    assert [*shortcomings(summary({}, vo=used(0, "odometry") | {"received": 0}))] == ["vo: no message came"]
    assert not [*shortcomings(summary({}, vo=used(0, "odometry") | {"received": 90}))]


@each("known, two_places, is_said", [(23, 27, True), (66, 8, False), (3, 3, False), (0, 27, False)])
def test_ranges_alone_that_leave_many_landmarks_without_a_side_are_said(known, two_places, is_said):
    waiting = {str(k): "2 places fit: (1.56, -2.35) and (-2.20, -1.20)" for k in range(two_places)}
    waiting["seen once"] = "1 sighting by range: too few"
    said = list(doubts(summary({}) | {"landmarks": known, "waiting": waiting}))
    assert len(said) == is_said
    right = "ranges alone: of 27 of 51 landmarks two places fit, one on either side"
    assert all(one.startswith(right) and "landmarks.surveyed" in one for one in said)


def test_what_follows_from_odometry_that_is_refused_is_not_said_beside_it():
    late = {"code": "clock_offset", "text": "clock_offset: tags: late", "settings": {"tags.offset_s": -0.7}}
    well, refused = ({"odom": ODOMETRY | {"used": used}} for used in (100, 20))
    for inputs, is_said in ((refused, False), (well, True)):
        said = " ".join(shortcomings(summary({"odom": {"bad_stamp": 80}}, **inputs) | {"uncorrected": [late]}))
        assert ("clock_offset" in said) == is_said
    counters = {"odom": {"bad_stamp": 80, "frozen": 9}, "tags": {"odometry_gap": 900}}
    assert [one[:5] for one in shortcomings(summary(counters, **refused)) if "alone" not in one] == ["odom:"]


def test_an_input_whose_cause_is_known_has_no_general_advice():
    fixes = {"use": "fix", "received": 90, "used": 90, "believed": 70}
    found = {"code": "fix_frozen", "severity": "warning", "text": "/gps: stands", "settings": []}
    assert [one.partition(":")[0] for one in doubts(summary({}, gps=fixes))] == ["gps"]
    (said,) = doubts(summary({}, gps=fixes) | {"check": found | {"evidence": {"input": "gps"}}})
    assert said.startswith("fix_frozen: /gps: stands")


def test_frames_that_are_unknown_since_transforms_name_none_send_to_their_publisher():
    counters = {"tf": {"frame_empty": 90}, "tags": {"frame_unknown": 90}}
    said = " ".join(shortcomings(summary(counters, tags=LANDMARKS | {"used": 0, "believed": 0})))
    assert "frame_unknown 90" in said and "header.frame_id and child_frame_id" in said and "mount" not in said
