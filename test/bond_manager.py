"""The end of a bond that Nav2's lifecycle manager has, by the state machine of bondcpp.

``python bond_manager.py ID SECONDS`` says ``formed``, and ``broken: dead`` or ``broken: silent`` (for so many seconds).
A line ``end`` on its standard input makes it break the bond; it says ``broken: acknowledged`` when the other has.
"""

import select
import sys
import time
from uuid import uuid4

import rclpy
from bond.msg import Status
from rclpy.node import Node

PERIOD_S, DEAD_PERIOD_S = 0.25, 0.05
WAITING, ALIVE, DYING, DEAD = range(4)


class Manager(Node):
    """One bond."""

    def __init__(self, name, timeout_s):
        super().__init__("lifecycle_manager", start_parameter_services=False)
        self._name, self._timeout_s, self._instance = name, timeout_s, str(uuid4())
        self.state, self._heard_s, self._said_s = WAITING, 0.0, 0.0
        self._publisher = self.create_publisher(Status, "bond", 5)
        self.create_subscription(Status, "bond", self._on_status, 100)

    def _on_status(self, status):
        if status.id != self._name or status.instance_id == self._instance or self.state == DEAD:
            return
        self._heard_s = time.monotonic()
        if status.active:
            if self.state == WAITING:
                self._become(ALIVE, "formed")
        else:
            self._become(DEAD, "broken: acknowledged" if self.state == DYING else "broken: dead")

    def _become(self, state, said):
        self.state = state
        print(said, flush=True)

    def _say(self, is_active):
        self._said_s = time.monotonic()
        self._publisher.publish(Status(id=self._name, instance_id=self._instance, active=is_active))

    def turn(self):
        rclpy.spin_once(self, timeout_sec=0.02)
        now = time.monotonic()
        if self.state == ALIVE and now - self._heard_s > self._timeout_s:
            self._become(DEAD, "broken: silent")
        if now - self._said_s > (DEAD_PERIOD_S if self.state == DYING else PERIOD_S) and self.state != DEAD:
            self._say(self.state != DYING)
        if select.select([sys.stdin], [], [], 0.0)[0] and sys.stdin.readline() == "end\n":
            self.state = DYING
            self._say(False)


if __name__ == "__main__":
    rclpy.init()
    manager = Manager(sys.argv[1], float(sys.argv[2]))
    while manager.state != DEAD:
        manager.turn()
    manager.destroy_node()
    rclpy.shutdown()
