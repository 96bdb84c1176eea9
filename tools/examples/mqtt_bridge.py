"""elpd on an MQTT broker: what the daemon tells is published, and a few commands are taken.

    python tools/examples/mqtt_bridge.py [--broker HOST[:PORT]] [--prefix elpd] [--socket PATH]

Published: ``PREFIX/online`` (``1``, and ``0`` by the broker when this ends; retained), ``PREFIX/status`` (retained, new
with every change), ``PREFIX/state``, ``PREFIX/result``, ``PREFIX/fault``, ``PREFIX/phase``. Taken: ``PREFIX/do/METHOD``
with the parameters as a JSON object, or nothing; the answer goes to ``PREFIX/answer/METHOD``, with the request's key
``id``, if it has one. A command that a broker has kept (retained) is not taken: nobody is there who means it now.

Whoever may publish to the broker may move the lens: let it listen to this machine alone, or ask for a password.
Needs ``pip install paho-mqtt``.
"""

from __future__ import annotations

import argparse
import json
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

from elpd.client import Client
from elpd.errors import ElpdError, UsageError

if TYPE_CHECKING:
    from pathlib import Path

    import paho.mqtt.client as mqtt

AT_ONCE = {"stop", "cancel"}
COMMANDS = AT_ONCE | {"focus", "home", "move", "jog", "clear", "preset", "mode", "roi", "temperature"}
TOLD = ("state", "result", "fault", "phase")
COMES_BACK_S = 3600.0
"""How long to look for a daemon that has gone."""


class Bridge:
    """One daemon on one broker."""

    def __init__(self, broker: mqtt.Client, prefix: str, path: str | Path | None = None) -> None:
        self._broker = broker
        self._prefix = prefix
        self._rig = Client(path)
        self._events = self._rig.events(TOLD, reconnect_s=COMES_BACK_S)
        self._workers = ThreadPoolExecutor(4, "elpd-mqtt")
        self._teller = threading.Thread(target=self._tell, name="elpd-mqtt-events", daemon=True)
        broker.will_set(f"{prefix}/online", "0", qos=1, retain=True)
        broker.on_connect = self._connected
        broker.on_message = self._asked
        self.listening = threading.Event()
        """Set once commands are taken."""
        broker.on_subscribe = lambda *_: self.listening.set()

    def start(self) -> None:
        """Begin to tell."""
        self._teller.start()

    def close(self) -> None:
        """End."""
        self._events.close()
        self._teller.join(5.0)
        self._workers.shutdown()
        self._broker.publish(f"{self._prefix}/online", "0", qos=1, retain=True).wait_for_publish(5.0)
        self._rig.close()

    def _connected(self, broker: mqtt.Client, *_: object) -> None:
        broker.subscribe(f"{self._prefix}/do/#", qos=1)
        broker.publish(f"{self._prefix}/online", "1", qos=1, retain=True)
        self._workers.submit(self._publish_status)

    def _asked(self, broker: mqtt.Client, _: object, message: mqtt.MQTTMessage) -> None:
        del broker
        if message.retain:
            return
        method = message.topic.rsplit("/", 1)[-1]
        if method in AT_ONCE:
            self._do(method, message.payload)  # here and now: the workers may all be waiting for a cycle
        else:
            self._workers.submit(self._do, method, message.payload)

    def _do(self, method: str, payload: bytes) -> None:
        answer: dict[str, Any] = {}
        try:
            params = _params(payload)
            answer = {"id": params.pop("id")} if "id" in params else {}
            if method not in COMMANDS:
                raise UsageError(f"{method!r} is not taken here; {', '.join(sorted(COMMANDS))} are")
            answer["result"] = self._rig.call(method, params)
        except ElpdError as error:
            answer["error"] = {"kind": error.kind, "message": str(error)}
        self._broker.publish(f"{self._prefix}/answer/{method}", json.dumps(answer), qos=1)

    def _tell(self) -> None:
        try:
            for event in self._events:
                if event["event"] == "reconnected" or event["event"] in {"state", "fault", "result"}:
                    self._publish_status()
                self._broker.publish(f"{self._prefix}/{event['event']}", json.dumps(event), qos=1)
        except ElpdError as error:
            print(f"mqtt_bridge: {error}", file=sys.stderr)

    def _publish_status(self) -> None:
        try:
            status = json.dumps(self._rig.status())
        except ElpdError as error:
            status = json.dumps({"state": None, "error": {"kind": error.kind, "message": str(error)}})
        self._broker.publish(f"{self._prefix}/status", status, qos=1, retain=True)


def _params(payload: bytes) -> dict[str, Any]:
    try:
        params = json.loads(payload or b"{}")
    except ValueError as error:
        raise UsageError(f"the parameters are not JSON ({error})") from None
    if not isinstance(params, dict):
        raise UsageError("the parameters are one JSON object, or nothing")
    return params


def main() -> int:
    """Run until interrupted."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--broker", default="localhost:1883", metavar="HOST[:PORT]")
    parser.add_argument("--prefix", default="elpd")
    parser.add_argument("--socket", help="the daemon's socket, if it is not where it usually is")
    asked = parser.parse_args()
    try:
        import paho.mqtt.client as mqtt  # noqa: PLC0415  (the message below is for those who lack it)
    except ImportError:
        print("mqtt_bridge: this needs paho-mqtt: pip install paho-mqtt", file=sys.stderr)
        return 2
    host, _, port = asked.broker.partition(":")
    broker = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2, client_id="elpd-bridge")
    try:
        bridge = Bridge(broker, asked.prefix, asked.socket)
        broker.connect(host, int(port or 1883))
    except (ElpdError, OSError, ValueError) as error:
        print(f"mqtt_bridge: {error}", file=sys.stderr)
        return 4
    bridge.start()
    try:
        broker.loop_forever()
    except KeyboardInterrupt:
        broker.loop_start()
        bridge.close()
        broker.disconnect()
        broker.loop_stop()
    return 0


if __name__ == "__main__":
    sys.exit(main())
