"""How long a lifecycle manager waits for the node's transitions: Nav2's gives up after 5 s."""

import time
from statistics import median
from typing import Any

import rclpy
from lifecycle_msgs.srv import ChangeState
from rclpy.node import Node

from benchmarks import options
from benchmarks.live.processes import PATIENCE_S, asked, percentile, reply, ros, until
from benchmarks.live.started import Process, node
from benchmarks.table import Row

_HERE, _TRANSITIONS = "benchmarks.live.lifecycle", ("configure", "activate", "deactivate", "cleanup")


def measure(short: bool) -> list[Row]:
    """One row for each transition, of nodes that are started anew."""
    took: dict[str, list[float]] = {name: [] for name in _TRANSITIONS}
    for _ in range(3 if short else 10):
        manager = Process(_HERE)
        with node({"node.autostart": False}, manager):
            manager.answer()
            for name in _TRANSITIONS:
                took[name].append(manager.ask(transition=name))
        options.say(f"lifecycle: { ({name: round(of[-1], 2) for name, of in took.items()}) }")
    return [
        {"transition": name, "starts": len(of), "median s": median(of), "longest s": percentile(of, 1.0)}
        for name, of in took.items()
    ]


def manage() -> None:
    """Ask for the transitions that are told; answers the seconds that each took."""
    with ros():
        manager = Node("manager")
        client = manager.create_client(ChangeState, "/graph_slam/change_state")

        def rest() -> None:
            rclpy.spin_once(manager, timeout_sec=0.02)

        until(client.service_is_ready, rest, "service of the node", 6 * PATIENCE_S)
        reply("ready")
        while True:
            request: Any = ChangeState.Request()
            request.transition.label = asked()["transition"]
            start = time.monotonic()
            future = client.call_async(request)
            until(future.done, rest, "answer", 6 * PATIENCE_S)
            if not future.result().success:
                raise SystemExit(f"{request.transition.label} failed")
            reply(time.monotonic() - start)


if __name__ == "__main__":
    manage()
