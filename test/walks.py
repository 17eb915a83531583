"""Run the node, and record which files of the package a message passes: ``python test/walks.py FILE --ros-args ...``.

That a file is imported, or makes an object, is no step; nor is what is in ``OF_COURSE``.
"""

import json
import sys
import threading
from collections import Counter, defaultdict
from pathlib import Path

import graph_slam_ros

PACKAGE = f"{Path(graph_slam_ros.__file__).parent}/"
BEGINS = {  # the calls with which a thread begins a walk, in the order in which they follow one another
    "node/subscriptions.py:received": "odometry",
    "node/session.py:process": "odometry",
    "node/publishers.py:after_message": "odometry",
    "node/session.py:save": "save",
    "node/node.py:__init__": "restart",
    "node/node.py:_configure": "restart",
    "node/runtime.py:begin": "restart",
    "node/node.py:_activate": "restart",
}
WITHIN = {  # calls on the way that belong to another walk; without a name, to none
    "odometry": {
        "slam/graph_slam.py:_on_observation": "sighting",
        "slam/graph_slam.py:_solve_if_due": "solve",
        "slam/frontend/keyframe_frontend.py:begin": "solve",
        "slam/frontend/keyframe_frontend.py:_append": "solve",
        "slam/anchor.py:begin": "solve",
        "slam/solution.py:begin": "solve",
        "runs/recorder.py:record": "solve",
        "runs/recorder.py:flush": "solve",
        "node/session.py:_estimated": "solve",
        "node/publishers.py:on_update": "solve",
        "slam/map_view.py:snapshot": "",
        "node/publishers.py:publish_due": "",
    },
    "restart": {
        "slam/graph_slam.py:__init__": "",
        "slam/graph_slam.py:process": "",
        "slam/map_view.py:snapshot": "",
        "runs/map_file.py:read_map": "",
        "warmup.py:warmup": "",
        "node/session.py:_estimated": "",
        "node/publishers.py:publish_due": "",
    },
}
OF_A_SIGHTING = {"messages/inputs/landmarks.py", "slam/frontend/gates.py"}
OF_COURSE = ("config/", "graph/", "lie/", "measurements/types.py", "measurements/counters.py", "errors.py")
BUT = "graph/graph.py"


class Recording:
    """A profile function: by walk and beginning, how often files were passed in this order."""

    def __init__(self):
        self.passed, self._of_thread = defaultdict(Counter), threading.local()

    def __call__(self, frame, event, argument):
        code, now = frame.f_code, self._of_thread.__dict__
        if not code.co_filename.startswith(PACKAGE):
            return
        stack = now.setdefault("stack", [])
        if event == "call":
            file = code.co_filename.removeprefix(PACKAGE)
            place = f"{file}:{code.co_name}"
            if not stack and place in BEGINS:
                stack.append((frame, BEGINS[place]))
                now["begun"], now["files"] = place, defaultdict(dict)
            if not stack:
                return
            within = WITHIN.get(stack[0][1], {}).get(place)
            if within:
                stack.append((frame, within))
            if code.co_name not in ("<module>", "__init__") and (file == BUT or not file.startswith(OF_COURSE)):
                now["files"][stack[-1][1]].setdefault(file)
            if within == "":
                stack.append((frame, within))
        elif event == "return" and stack and stack[-1][0] is frame:
            stack.pop()
            for walk, files in () if stack else now["files"].items():
                is_sighting = walk == "odometry" and not OF_A_SIGHTING.isdisjoint(files)
                self.passed["sighting" if is_sighting else walk, now["begun"]][tuple(files)] += 1

    def save(self, file):
        """By walk, for each beginning in order: the ways, each with how often it was taken."""
        found = defaultdict(list)
        for walk, begun in sorted(self.passed, key=lambda one: list(BEGINS).index(one[1])):
            found[walk].append([*self.passed[walk, begun].items()])
        Path(file).write_text(json.dumps(found))


def main():
    """As the node does; the recording is written at its end."""
    file, recording = sys.argv.pop(1), Recording()
    from graph_slam_ros.node.node import main as run

    threading.setprofile(recording)
    sys.setprofile(recording)
    try:
        return run()
    finally:
        sys.setprofile(None)
        recording.save(file)


if __name__ == "__main__":
    sys.exit(main())
