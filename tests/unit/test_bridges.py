"""The bridges of tools/examples: MQTT over a real broker, ROS 2 over a node of a few lines."""

from __future__ import annotations

import importlib.util
import json
import queue
import shutil
import socket
import subprocess
import sys
from collections import defaultdict
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import paho.mqtt.client as mqtt
import pytest
from sockets import serving

from elpd.service.messages import FaultEvent, PositionEvent, StateEvent

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from fake_engine import FakeEngine

EXAMPLES = Path(__file__).parents[2] / "tools/examples"
LIMIT_S = 20.0


def example(name: str) -> Any:
    specification = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    assert specification is not None
    assert specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "elpd.sock"


@pytest.fixture
def engine(path: Path) -> Iterator[FakeEngine]:
    with serving(path) as engine:
        yield engine


# --- MQTT --------------------------------------------------------------------------------------------------------

MOSQUITTO = shutil.which("mosquitto") or shutil.which("mosquitto", path="/usr/sbin")


@pytest.fixture
def port(tmp_path: Path) -> Iterator[int]:
    """A broker on this machine."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = int(free.getsockname()[1])
    (tmp_path / "broker.conf").write_text(f"listener {port} 127.0.0.1\nallow_anonymous true\n")
    assert MOSQUITTO is not None
    command = [MOSQUITTO, "-c", str(tmp_path / "broker.conf"), "-v"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as broker:
        assert broker.stderr is not None
        for line in broker.stderr:
            if "running" in line:
                break
        else:
            pytest.fail("the broker did not begin")
        broker.stderr.close()
        yield port
        broker.terminate()


@contextmanager
def connected(port: int, topics: str) -> Iterator[tuple[mqtt.Client, Callable[[str], Any]]]:
    """A client of the broker, and what waits for the next message of a topic."""
    told: defaultdict[str, queue.Queue[Any]] = defaultdict(queue.Queue)
    ready: queue.Queue[None] = queue.Queue()
    client = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2)
    client.on_message = lambda _client, _data, message: (
        None if "/do/" in message.topic else told[message.topic].put(json.loads(message.payload))
    )
    client.on_subscribe = lambda *_: ready.put(None)
    client.connect("127.0.0.1", port)
    client.subscribe(topics, qos=1)
    client.loop_start()
    ready.get(timeout=LIMIT_S)

    yield client, lambda topic: told[topic].get(timeout=LIMIT_S)
    client.disconnect()
    client.loop_stop()


@pytest.mark.skipif(MOSQUITTO is None, reason="mosquitto is not installed")
def test_a_broker_hears_and_commands_the_daemon(port: int, path: Path, engine: FakeEngine) -> None:
    with connected(port, "lab/#") as (person, next_of):
        person.publish("lab/do/focus", "{}", qos=1, retain=True).wait_for_publish(LIMIT_S)
        broker = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2)
        bridge = example("mqtt_bridge").Bridge(broker, "lab", path)
        broker.connect("127.0.0.1", port)
        broker.loop_start()
        bridge.start()
        assert bridge.listening.wait(LIMIT_S)
        assert next_of("lab/online") == 1
        assert next_of("lab/status")["state"] == "READY"

        person.publish("lab/do/jog", '{"id": "mine", "by_um": 3}', qos=1)
        engine.heard(lambda: "jog" in engine.calls)
        assert "focus" not in engine.calls, "a retained command is nobody's wish of now"
        person.publish("lab/do/stop", qos=1)  # while the jog is under way
        assert next_of("lab/answer/stop")["result"] == {"stopped": True, "was_moving": True}
        assert next_of("lab/answer/jog")["id"] == "mine"

        for topic, payload, kind in (
            ("shutdown", "{}", "UsageError"),
            ("jog", "[3]", "UsageError"),
            ("jog", "{", "UsageError"),
        ):
            person.publish(f"lab/do/{topic}", payload, qos=1)
            assert next_of(f"lab/answer/{topic}")["error"]["kind"] == kind

        engine.tell(FaultEvent(kind="LensError", message="lens: no reply"))
        assert next_of("lab/fault")["kind"] == "LensError"
        bridge.close()
        assert next_of("lab/online") == 0
        broker.disconnect()
        broker.loop_stop()


# --- ROS 2 -------------------------------------------------------------------------------------------------------


@dataclass
class Node:
    """As much of a node as the bridge uses."""

    socket: str
    services: dict[str, Any] = field(default_factory=dict)
    published: queue.Queue[tuple[str, Any]] = field(default_factory=queue.Queue)

    def declare_parameter(self, name: str, default: str) -> Any:
        return SimpleNamespace(value=getattr(self, name, default))

    def create_publisher(self, kind: Any, topic: str, depth: int) -> Any:
        return SimpleNamespace(publish=lambda message: self.published.put((topic, message.data)))

    def create_service(self, kind: Any, name: str, serve: Any, *, callback_group: Any) -> None:
        self.services[name] = serve


def test_a_node_serves_and_tells(path: Path, engine: FakeEngine) -> None:
    node = Node(str(path))
    message = SimpleNamespace
    bridge = example("ros2_bridge").Bridge(node, object, message, message, None)
    assert sorted(node.services) == ["~/cancel", "~/clear", "~/focus", "~/home", "~/stop"]
    stopped = node.services["~/stop"](None, SimpleNamespace())
    assert (stopped.success, json.loads(stopped.message)["stopped"]) == (True, True)
    engine.begin("home")
    refused = node.services["~/focus"](None, SimpleNamespace())
    assert (refused.success, refused.message) == (False, "BusyError: something runs")
    engine.tell(StateEvent(state="READY", mode="manual"))
    engine.tell(PositionEvent(position_um=3.5, moving=False))
    engine.tell(FaultEvent(kind=None))
    told = [node.published.get(timeout=LIMIT_S) for _ in range(3)]
    assert told[:2] == [("~/state", "READY"), ("~/position_um", 3.5)]
    assert json.loads(told[2][1])["event"] == "fault"
    bridge.close()


@pytest.mark.skipif(importlib.util.find_spec("rclpy") is not None, reason="this machine has ROS 2")
def test_without_ros_the_node_says_what_it_lacks() -> None:
    ended = subprocess.run([sys.executable, EXAMPLES / "ros2_bridge.py"], capture_output=True, text=True, check=False)
    assert ended.returncode == 2
    assert ended.stderr == "ros2_bridge: there is no rclpy; source a ROS 2 first (such as /opt/ros/jazzy/setup.bash)\n"
