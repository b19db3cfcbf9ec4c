"""Many requests at once: every one is answered."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from nodes.node_process import PATIENCE, watching
from perch_msgs.action import Perch
from perch_msgs.srv import SetController
from rclpy.action import ActionClient
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile

CALLS, GOALS = 300, 200
ROOM = QoSProfile(depth=CALLS)  # a client of ROS keeps ten answers that it has not looked at yet


class Crowd:
    """Somebody who asks all at once."""

    def __init__(self, node: Node, executor: SingleThreadedExecutor) -> None:
        self.node, self._executor = node, executor

    def wait(self, done) -> None:
        """Hear answers until `done`."""
        for _ in range(round(PATIENCE / 0.01)):
            if done():
                return
            self._executor.spin_once(timeout_sec=0.01)


@pytest.fixture
def crowd(graph) -> Iterator[Crowd]:
    """Beside the nodes."""
    with watching() as (node, executor):
        yield Crowd(node, executor)


def test_every_choice_of_a_law_is_answered(crowd):
    client = crowd.node.create_client(SetController, "set_controller", qos_profile=ROOM)
    crowd.wait(client.service_is_ready)
    futures = [client.call_async(SetController.Request(type=("geometric", "pid")[k % 2])) for k in range(CALLS)]
    crowd.wait(lambda: all(future.done() for future in futures))
    assert sum(future.done() for future in futures) == CALLS
    assert [future.result().error_code for future in futures] == [0, 1] * (CALLS // 2)


def test_every_goal_is_answered(crowd):
    client = ActionClient(crowd.node, Perch, "perch", goal_service_qos_profile=ROOM, result_service_qos_profile=ROOM)
    crowd.wait(client.server_is_ready)
    futures = [client.send_goal_async(Perch.Goal(mode=9)) for _ in range(GOALS)]
    crowd.wait(lambda: all(future.done() for future in futures))
    assert sum(future.done() for future in futures) == GOALS
    results = [future.result().get_result_async() for future in futures if future.result().accepted]
    crowd.wait(lambda: all(result.done() for result in results))
    assert [result.result().result.error_code for result in results] == [Perch.Result.BAD_GOAL] * len(results) and results
    client.destroy()
