"""Live cameras through neuromorphic-drivers: EVK4, EVK3 HD, CenturyArks, DAVIS346, DVXplorer, without a vendor's SDK.

Prophesee cameras are read raw: the library's own parser drops trigger channels it does not know and the rate
controller's counts, and our kernels read words anyway. iniVation cameras are taken as the arrays that the library
makes, with their frames and trigger edges.

Rows: the library counts the rows of its masks from below, as its own pictures show them, while the rows in the words
(and Prophesee's registers) count from above. Windows and masks are turned over here.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from elpd.errors import CameraError, UsageError
from elpd.records import BiasSet, Encoding, Frame, Geometry, ImuSample, Trigger
from elpd.units import SensorUs
from elpd_drivers.cameras.capture import CapturedCamera, open_captured
from elpd_drivers.cameras.neuromorphic_tables import (
    BUFFERS_IN_FLIGHT,
    MODELS,
    NeuromorphicSettings,
    check_bounds,
    choose,
    configured,
)
from elpd_drivers.cameras.refusals import explain
from elpd_drivers.cameras.ring import Captured
from elpd_drivers.cameras.source import SourceFacts, layout_of, need, read_table

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from elpd.ports import Clock
    from elpd_drivers.cameras.words import WordStream

INSTALL = "pip install 'elpd[neuromorphic]'"
EVENTS = np.dtype([("t", "<u8"), ("x", "<u2"), ("y", "<u2"), ("on", "?")])
OF_ARRAYS = frozenset({"inivation_davis346", "inivation_dvxplorer"})
"""Cameras that the library reads; of the others it passes on the words."""

MASK_SLOTS = {"prophesee_evk4": 64, "inivation_davis346": 8}
USB3_LATENCY_US = 150.0
"""Assumed until measured: a micro-frame of 125 us and its interrupt. ``camera.min_latency_us`` replaces it."""


def encodings(settings: Mapping[str, Any]) -> frozenset[Encoding]:
    """Return how packets of the camera that is asked for may be encoded: words or arrays, by its maker."""
    kind = MODELS.get(settings.get("model", "auto"))
    if kind is None:
        return frozenset({Encoding.EVT3, Encoding.ARRAY})
    return frozenset({Encoding.ARRAY if kind in OF_ARRAYS else Encoding.EVT3})


def open_camera(settings: Mapping[str, Any], clock: Clock) -> CapturedCamera:
    """Open a camera through neuromorphic-drivers, in a process of its own; see ``NeuromorphicSettings``.

    Raises ``ConfigError`` for a wrong table, ``CameraError`` if there is no such camera or it cannot be opened.
    """
    table = read_table(NeuromorphicSettings, settings)
    need("neuromorphic_drivers", INSTALL)
    return open_captured(f"{__name__}:open_source", table.model_dump(mode="json"), table, clock)


def open_source(settings: dict[str, Any]) -> NeuromorphicSource:
    """Open the camera, in the capture process."""
    import neuromorphic_drivers as nd  # noqa: PLC0415  (a library that may abort is loaded in the capture process alone)

    table = NeuromorphicSettings.model_validate(settings)
    try:
        kind, serial = choose(nd, table)
        module = getattr(nd, kind)
        configuration = configured(module, table)
        device = nd.open(
            configuration,
            iterator_timeout=0.005,
            raw=kind not in OF_ARRAYS,
            serial=serial,
            ring_configuration=module.RingConfiguration(
                ring_length=table.usb_packets, parallel_submissions=BUFFERS_IN_FLIGHT
            ),
            iterator_maximum_raw_packets=1,
        )
    except RuntimeError as error:
        raise CameraError(explain(str(error), "neuromorphic-drivers")) from None
    check_bounds(table.biases, device.biases_bounds(), kind)
    return NeuromorphicSource(device, module, kind, configuration, table)


@dataclass(slots=True)
class _Seen:
    """What the library has said so far."""

    dropped: int = 0
    overflows: int = 0
    backlog: int = 0
    most_backlog: int = 0


class NeuromorphicSource:
    """A ``Source`` over an open device of the library. Use ``open_source``."""

    def __init__(self, device: Any, module: Any, kind: str, configuration: Any, table: NeuromorphicSettings) -> None:
        self._device, self._module, self._kind = device, module, kind
        self._configuration, self._biases = configuration, table.biases
        self._exposure_us = table.exposure_us
        self._with_imu = table.imu
        self._seen = _Seen()
        self._words = _word_stream(kind)
        properties = device.properties()
        latency_us = USB3_LATENCY_US if table.min_latency_us is None else table.min_latency_us
        if self._words is not None and table.min_latency_us is None:
            from elpd_drivers.cameras.words import STEP_BACK_US  # noqa: PLC0415  (with the kernels, where they are used)

            latency_us += STEP_BACK_US
        self.facts = SourceFacts(
            geometry=Geometry(int(properties.width), int(properties.height)),
            encoding=Encoding.ARRAY if self._words is None else Encoding.EVT3,
            model=str(device.name().value),
            serial=str(device.serial()),
            min_latency_us=latency_us,
            layout=layout_of(EVENTS) if self._words is None else None,
            abilities=tuple(_abilities(kind, configuration)),
        )

    def read(self, timeout_s: float) -> Captured | None:
        """Wait for the library's next packet; its patience was set when it was opened."""
        del timeout_s
        try:
            status, packet = next(self._device)
        except RuntimeError as error:
            raise CameraError(explain(str(error), "neuromorphic-drivers")) from None
        now_ns = time.monotonic_ns()
        if status.ring is None or packet is None:
            return None
        received_ns = now_ns - round(1e9 * (status.system_time - status.ring.system_time))
        seen = self._seen
        seen.dropped, seen.backlog = status.ring.dropped_packets, status.ring.backlog
        seen.most_backlog = max(seen.most_backlog, seen.backlog)
        if self._words is not None:
            gap = bool(status.ring.overflow_indices)
            seen.overflows += gap
            return self._words.captured(packet, received_ns, gap_before=gap, backlog=seen.backlog)
        return self._arrays(status, packet, received_ns)

    def call(self, name: str, arguments: Sequence[Any]) -> Any:
        """Use an ability; the library writes the registers from a thread of its own, within some milliseconds."""
        if name == "temperature_c":
            return float(self._device.temperature_celsius())
        if name == "enable_imu":
            self._with_imu = bool(arguments[0])
            return None
        change: dict[str, Callable[..., dict[str, Any]]] = {
            "set_window": self._window,
            "apply_biases": self._bias_set,
            "set_mask": self._mask,
        }
        self._configuration = replace(self._configuration, **change[name](*arguments))
        self._device.update_configuration(self._configuration)
        return min(len(arguments[0]), MASK_SLOTS[self._kind]) if name == "set_mask" else None

    def notes(self) -> Mapping[str, float]:
        """Return what the library counted, and what the sensor's rate controller held back."""
        return {
            "usb_packets_dropped": self._seen.dropped,
            "usb_overflows": self._seen.overflows,
            "usb_backlog": self._seen.backlog,
            "most_usb_backlog": self._seen.most_backlog,
            "rate_controller_dropped": 0 if self._words is None else self._words.held_back,
        }

    def close(self) -> None:
        """Stop the sensor and give the device back. Idempotent."""
        self._device.close()

    # --- below: how it is done -------------------------------------------------------------------------------------

    def _arrays(self, status: Any, packet: Any, received_ns: int) -> Captured:
        """Turn a packet of arrays into ours. Raises ``CameraError`` if the library's layout is another than known."""
        events = packet.polarity_events
        if events is None:
            events = np.empty(0, EVENTS)
        elif events.dtype != EVENTS:
            raise CameraError(
                f"camera: neuromorphic-drivers delivers events as {events.dtype}, known is {EVENTS}; install the "
                f"version that elpd was made for: {INSTALL}"
            )
        gap = any(
            indices is not None and len(indices) > 0
            for indices in (packet.polarity_events_overflow_indices, packet.trigger_events_overflow_indices)
        )
        samples = packet.imu_events if self._with_imu else None
        self._seen.overflows += gap
        return Captured(
            events,
            received_ns,
            complete_until_us=int(status.ring.current_t),
            events=len(events),
            frames=tuple(_frame(frame, self._exposure_us) for frame in getattr(packet, "frames", ())),
            triggers=() if packet.trigger_events is None else tuple(_edges(packet.trigger_events)),
            gap_before=gap,
            backlog=status.ring.backlog,
            imu=() if samples is None else tuple(_samples(samples)),
        )

    def _window(self, window: list[int] | None) -> dict[str, Any]:
        height = self.facts.geometry.height
        mask = self._module.RowColumnMask(set=window is not None)
        if window is not None:
            x, y, w, h = window
            mask.clear_rectangle(x=x, y=height - y - h, width=w, height=h)
        return {"x_mask": mask.x_mask(), "y_mask": mask.y_mask()}

    def _bias_set(self, name: str) -> dict[str, Any]:
        chosen = self._biases.expose if BiasSet(name) is BiasSet.EXPOSE else self._biases.focus
        return {"biases": self._module.Biases(**chosen)}

    def _mask(self, pixels: list[list[int]]) -> dict[str, Any]:
        geometry = self.facts.geometry
        for x, y in pixels:
            if not (0 <= x < geometry.width and 0 <= y < geometry.height):
                raise UsageError(
                    f"camera: pixel {x},{y} lies outside the sensor of {geometry.width}x{geometry.height}; "
                    "give only pixels inside it"
                )
        chosen = pixels[: MASK_SLOTS[self._kind]]
        if self._kind == "inivation_davis346":
            codes = [1 + x + geometry.width * y for x, y in chosen]
            return {"pixel_mask": tuple(codes + [0] * (MASK_SLOTS[self._kind] - len(codes)))}
        import neuromorphic_drivers as nd  # noqa: PLC0415  (see open_source)

        mask = nd.PropheseeEvk4PixelMask()
        for slot, (x, y) in enumerate(chosen):
            mask.set(slot, x, geometry.height - 1 - y)
        return {"pixel_mask": mask.pixel_mask()}


def _abilities(kind: str, configuration: Any) -> list[str]:
    known = {field.name for field in fields(configuration)}
    abilities = {
        # Of a DAVIS346, too, the library can set one, but with it switches the frames off until it opens anew.
        "window": "x_mask" in known,
        "biases": "biases" in known,
        "mask": kind in MASK_SLOTS,
        "imu": kind.startswith("inivation"),
        "temperature": kind == "prophesee_evk4",
    }
    return [name for name, has in abilities.items() if has]


def _word_stream(kind: str) -> WordStream | None:
    if kind.startswith("inivation"):
        return None
    from elpd_drivers.cameras.words import WordStream  # noqa: PLC0415  (with the kernels, where they are used)

    return WordStream(Encoding.EVT3)


def _frame(frame: Any, exposure_us: int) -> Frame:
    """Date a frame: the middle of its exposure. Where the library missed an edge, the set exposure stands in."""
    begin, end = frame.exposure_start_t, frame.exposure_end_t
    if begin is None and end is None:
        begin = frame.start_t
    if begin is None:
        begin = end - exposure_us
    if end is None:
        end = begin + exposure_us
    return Frame(SensorUs(int((begin + end) // 2)), SensorUs(int(frame.t)), int(end - begin), frame.pixels)


def _edges(events: Any) -> list[Trigger]:
    """Return trigger edges; of a pulse, which begins and ends at once, the rising one."""
    polarity = events["polarity"] if "polarity" in events.dtype.names else events["rising"]
    return [
        Trigger(SensorUs(int(t)), int(channel), rising=int(edge) > 0)
        for t, channel, edge in zip(events["t"], events["id"], polarity, strict=True)
    ]


def _samples(events: Any) -> list[ImuSample]:
    """Return the library's inertial samples, which have our units: m/s^2, rad/s and degrees Celsius."""
    return [
        ImuSample(SensorUs(t), (ax, ay, az), (gx, gy, gz), celsius)
        for t, ax, ay, az, gx, gy, gz, celsius in events.tolist()
    ]
