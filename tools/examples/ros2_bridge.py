"""elpd as a ROS 2 node: services to focus and to stop, topics for where the lens is and how cycles end.

    ros2 run ... or: python tools/examples/ros2_bridge.py [--ros-args -p socket:=/run/elpd/elpd.sock]

Services (``std_srvs/Trigger``; ``message`` is the answer as JSON): ``~/focus ~/home ~/stop ~/cancel ~/clear``. Topics:
``~/position_um`` (``std_msgs/Float64``), ``~/state ~/result ~/fault`` (``std_msgs/String``; the last two are JSON).
Stop and cancel are served beside a focus that is under way, in threads of their own.

Needs a sourced ROS 2 (rclpy, std_msgs, std_srvs): these are not on PyPI.
"""

from __future__ import annotations

import json
import sys
import threading
from typing import Any

from elpd.client import Client
from elpd.errors import ElpdError

SERVICES = ("focus", "home", "stop", "cancel", "clear")
COMES_BACK_S = 3600.0
"""How long to look for a daemon that has gone."""


class Bridge:
    """The daemon behind *node*, whose message types are handed in."""

    def __init__(self, node: Any, trigger: Any, string: Any, number: Any, group: Any) -> None:
        self._node = node
        self._string, self._number = string, number
        self._rig = Client(node.declare_parameter("socket", "").value or None)
        self._position = node.create_publisher(number, "~/position_um", 10)
        self._told = {name: node.create_publisher(string, f"~/{name}", 10) for name in ("state", "result", "fault")}
        for method in SERVICES:
            node.create_service(trigger, f"~/{method}", self._service(method), callback_group=group)
        self._events = self._rig.events(["state", "result", "fault", "position"], reconnect_s=COMES_BACK_S)
        self._teller = threading.Thread(target=self._tell, name="elpd-ros2-events", daemon=True)
        self._teller.start()

    def close(self) -> None:
        """End."""
        self._events.close()
        self._teller.join(5.0)
        self._rig.close()

    def _service(self, method: str) -> Any:
        def serve(_: Any, response: Any) -> Any:
            try:
                answer = self._rig.focus() if method == "focus" else self._rig.call(method)
            except ElpdError as error:
                response.success, response.message = False, f"{error.kind}: {error}"
            else:
                response.success = answer.get("outcome", "FOCUSED") == "FOCUSED"
                response.message = json.dumps(answer)
            return response

        return serve

    def _tell(self) -> None:
        try:
            for event in self._events:
                if event["event"] == "position" and event["position_um"] is not None:
                    self._position.publish(self._number(data=event["position_um"]))
                elif event["event"] in self._told:
                    said = event["state"] if event["event"] == "state" else json.dumps(event)
                    self._told[event["event"]].publish(self._string(data=said))
        except ElpdError as error:
            self._node.get_logger().error(str(error))


def main() -> int:
    """Spin until interrupted."""
    try:
        import rclpy  # noqa: PLC0415  (the message below is for those who lack it)
        from rclpy.callback_groups import ReentrantCallbackGroup  # noqa: PLC0415
        from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor  # noqa: PLC0415
        from std_msgs.msg import Float64, String  # noqa: PLC0415
        from std_srvs.srv import Trigger  # noqa: PLC0415
    except ImportError as error:
        print(
            f"ros2_bridge: there is no {error.name}; source a ROS 2 first (such as /opt/ros/jazzy/setup.bash)",
            file=sys.stderr,
        )
        return 2
    rclpy.init()
    node = rclpy.create_node("elpd")
    try:
        bridge = Bridge(node, Trigger, String, Float64, ReentrantCallbackGroup())
    except ElpdError as error:
        print(f"ros2_bridge: {error}", file=sys.stderr)
        rclpy.shutdown()
        return error.exit_code
    executor = MultiThreadedExecutor(len(SERVICES))
    executor.add_node(node)
    try:
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        bridge.close()
        rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
