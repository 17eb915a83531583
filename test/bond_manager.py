"""The end of a bond that Nav2's lifecycle manager has, by the state machine of bondcpp.

``python bond_manager.py ID`` says ``formed``, and ``broken: dead`` where the other has ended it. A line ``end`` on its
standard input makes it break the bond; it says ``broken: acknowledged`` when the other has.
"""

import select
import sys
import time
from uuid import uuid4

import rclpy
from bond.msg import Status

PERIOD_S, DEAD_PERIOD_S = 0.25, 0.05
WAITING, ALIVE, DYING, DEAD = range(4)


def main(name):
    rclpy.init()
    node = rclpy.create_node("lifecycle_manager", start_parameter_services=False)
    instance, state, said_s = str(uuid4()), WAITING, 0.0
    publisher = node.create_publisher(Status, "bond", 5)

    def on_status(status):
        nonlocal state
        if status.id != name or status.instance_id == instance or state == DEAD:
            return
        if not status.active:
            print("broken: acknowledged" if state == DYING else "broken: dead", flush=True)
            state = DEAD
        elif state == WAITING:
            print("formed", flush=True)
            state = ALIVE

    node.create_subscription(Status, "bond", on_status, 100)
    while state != DEAD:
        rclpy.spin_once(node, timeout_sec=0.02)
        if select.select([sys.stdin], [], [], 0.0)[0] and sys.stdin.readline() == "end\n":
            state, said_s = DYING, 0.0
        if time.monotonic() - said_s > (DEAD_PERIOD_S if state == DYING else PERIOD_S) and state != DEAD:
            said_s = time.monotonic()
            publisher.publish(Status(id=name, instance_id=instance, active=state != DYING))
    node.destroy_node()
    rclpy.shutdown()


if __name__ == "__main__":
    main(sys.argv[1])
