"""Any Prophesee camera through OpenEB or the Metavision SDK, where its Python is installed.

The hardware layer's Python hands raw buffers to its own decoders and to nobody else, so this backend delivers event
arrays: complete, dated by the decoder's newest time, trigger edges among them. What Python does not get is the rate
controller's counts; where those matter (and they do for a sweep near the controller's limit), ``neuromorphic`` reads
the words themselves.

The layer's waiting call knows no deadline, so its polling call is asked every third of a millisecond.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from elpd.errors import CameraError, ConfigError, UsageError
from elpd.records import BiasSet, Encoding, Geometry, Trigger
from elpd.units import US_PER_S, SensorUs
from elpd_drivers.cameras.capture import CapturedCamera, open_captured
from elpd_drivers.cameras.refusals import explain
from elpd_drivers.cameras.ring import Captured
from elpd_drivers.cameras.source import CaptureSettings, SourceFacts, layout_of, need, read_table

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from numpy.typing import NDArray

    from elpd.ports import Clock

INSTALL = "install OpenEB or the Metavision SDK with its Python bindings, for this Python"
EVENTS = np.dtype({"names": ["x", "y", "p", "t"], "formats": ["<u2", "<u2", "<i2", "<i8"], "offsets": [0, 2, 4, 8],
                   "itemsize": 16})  # fmt: skip
"""``Metavision::EventCD`` as its bindings describe it."""

TURN_S = 0.0003
STEP_BACK_US = 16
"""As in ``words``, which would bring the kernels with it."""

USB3_LATENCY_US = 150.0


class BiasTables(BaseModel):
    """The two settings of the sensor's biases, by the layer's names (``bias_diff_on`` ...); others stay as they are."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    expose: dict[str, int] = {}
    focus: dict[str, int] = {}


class MetavisionSettings(CaptureSettings):
    """The table ``[camera]`` for the driver ``metavision``.

    ``rate_limit_mev_s`` bounds what the sensor sends; ``trigger`` listens to its main trigger input.
    """

    biases: BiasTables = BiasTables()
    rate_limit_mev_s: Annotated[float, Field(gt=0, le=1000)] | None = None
    trigger: bool = True


def encodings(settings: Mapping[str, Any]) -> frozenset[Encoding]:
    """Return how packets may be encoded."""
    del settings
    return frozenset({Encoding.ARRAY})


def open_camera(settings: Mapping[str, Any], clock: Clock) -> CapturedCamera:
    """Open a Prophesee camera, in a process of its own; see ``MetavisionSettings``.

    Raises ``ConfigError`` for a wrong table, ``CameraError`` if there is no such camera or it cannot be opened.
    """
    table = read_table(MetavisionSettings, settings)
    need("metavision_hal", INSTALL)
    return open_captured(f"{__name__}:open_source", table.model_dump(mode="json"), table, clock)


def open_source(settings: dict[str, Any]) -> MetavisionSource:
    """Open the camera, in the capture process."""
    import metavision_hal as hal  # noqa: PLC0415  (a library that may abort is loaded in the capture process alone)

    table = MetavisionSettings.model_validate(settings)
    try:
        device = hal.DeviceDiscovery.open(table.serial or "")
    except RuntimeError as error:
        raise CameraError(explain(str(error), "Metavision HAL")) from None
    if device is None:
        raise CameraError(
            f"camera: no Prophesee camera found (asked for: {table.serial or 'any'}); check the cable and the "
            "permissions, `elpd check` lists what is plugged in"
        )
    return MetavisionSource(device, hal, table)


class MetavisionSource:
    """A ``Source`` over an open device of the hardware layer. Use ``open_source``."""

    def __init__(self, device: Any, hal: Any, table: MetavisionSettings) -> None:
        self._device, self._hal, self._table = device, hal, table
        self._stream, self._decoder = device.get_i_events_stream(), device.get_i_events_stream_decoder()
        self._events: list[NDArray[Any]] = []
        self._edges: list[Trigger] = []
        self._until_us: int | None = None
        self._buffers = 0
        device.get_i_event_cd_decoder().add_event_buffer_callback(self._take_events)
        triggers = device.get_i_event_ext_trigger_decoder()
        if triggers is not None:
            triggers.add_event_buffer_callback(self._take_edges)
        facilities = {
            "window": device.get_i_roi(),
            "biases": device.get_i_ll_biases(),
            "mask": device.get_i_digital_event_mask(),
            "trigger": device.get_i_trigger_in(),
            "rate_limit": device.get_i_erc_module(),
            "temperature": device.get_i_monitoring(),
        }
        self._facility = {name: facility for name, facility in facilities.items() if facility is not None}
        geometry, identity = device.get_i_geometry(), device.get_i_hw_identification()
        latency_us = USB3_LATENCY_US + STEP_BACK_US if table.min_latency_us is None else table.min_latency_us
        self.facts = SourceFacts(
            geometry=Geometry(int(geometry.get_width()), int(geometry.get_height())),
            encoding=Encoding.ARRAY,
            model=str(identity.get_sensor_info().name),
            serial=str(identity.get_serial()),
            min_latency_us=latency_us,
            layout=layout_of(EVENTS),
            abilities=tuple(self._facility),
        )
        self._configure()
        self._stream.start()

    def read(self, timeout_s: float) -> Captured | None:
        """Wait for the layer's next buffer and let it decode it."""
        until = time.monotonic() + timeout_s
        while (ready := self._stream.poll_buffer()) == 0:
            if time.monotonic() >= until:
                return None
            time.sleep(TURN_S)
        if ready < 0:
            raise CameraError(explain("no such device", "Metavision HAL"))
        received_ns = time.monotonic_ns()
        buffer = self._stream.get_latest_raw_data()
        if buffer is None:
            return None
        self._decoder.decode(buffer)
        self._buffers += 1
        newest_us = int(self._decoder.get_last_timestamp()) - STEP_BACK_US
        if self._until_us is not None and newest_us < self._until_us - STEP_BACK_US:
            raise CameraError(
                f"camera: its clock jumped back by {(self._until_us - newest_us) / US_PER_S:.3f} s; it was reset, "
                "start again"
            )
        self._until_us = max(self._until_us or 0, newest_us)
        pieces, edges = self._events, self._edges
        self._events, self._edges = [], []
        events = pieces[0] if len(pieces) == 1 else np.concatenate([np.empty(0, EVENTS), *pieces])
        return Captured(
            events, received_ns, complete_until_us=self._until_us, events=len(events), triggers=tuple(edges)
        )

    def call(self, name: str, arguments: Sequence[Any]) -> Any:
        """Use an ability: a few register writes over USB."""
        uses: dict[str, Callable[..., Any]] = {
            "set_window": self._set_window,
            "apply_biases": self._apply_biases,
            "set_mask": self._set_mask,
            "enable_trigger": self._enable_trigger,
            "limit_rate": self._limit_rate,
            "temperature_c": lambda: float(self._facility["temperature"].get_temperature()),
        }
        try:
            return uses[name](*arguments)
        except RuntimeError as error:
            raise UsageError(f"camera: Metavision HAL refuses {name}: {error}") from None

    def notes(self) -> Mapping[str, float]:
        """Return what can be counted; the layer does not tell what it loses."""
        return {"buffers": self._buffers}

    def close(self) -> None:
        """Stop the stream; the layer closes the camera when it is forgotten. Idempotent."""
        if self._device is not None:
            self._stream.stop()
        self._device = None

    # --- below: how it is done -------------------------------------------------------------------------------------

    def _configure(self) -> None:
        """Bring the sensor into the state that the table says. Raises ``ConfigError`` for what it has not."""
        table = self._table
        for name, given in (
            ("biases", table.biases != BiasTables()),
            ("rate_limit", table.rate_limit_mev_s is not None),
        ):
            if given and name not in self._facility:
                raise ConfigError(f"camera.{name}: {self.facts.model} cannot do that; remove the key")
        if "biases" in self._facility:
            known = dict(self._facility["biases"].get_all_biases())
            for where, biases in (("expose", table.biases.expose), ("focus", table.biases.focus)):
                for name in biases:
                    if name not in known:
                        raise ConfigError(
                            f"camera.biases.{where}.{name}: {self.facts.model} has no such bias; it has "
                            f"{', '.join(sorted(known))}"
                        )
            self._normal = {name: known[name] for name in {*table.biases.expose, *table.biases.focus}}
            self._apply_biases(BiasSet.FOCUS.value)
        if table.rate_limit_mev_s is not None:
            self._limit_rate(table.rate_limit_mev_s)
        if "trigger" in self._facility:
            self._enable_trigger(table.trigger)

    def _set_window(self, window: list[int] | None) -> None:
        roi = self._facility["window"]
        if window is None:
            roi.enable(False)
            return
        roi.set_window(self._hal.I_ROI.Window(*window))
        roi.enable(True)

    def _apply_biases(self, name: str) -> None:
        """Set what is named in either table: to what this one says, else to what it was."""
        chosen = self._table.biases.expose if BiasSet(name) is BiasSet.EXPOSE else self._table.biases.focus
        for bias, normal in self._normal.items():
            self._facility["biases"].set(bias, chosen.get(bias, normal))

    def _set_mask(self, pixels: list[list[int]]) -> int:
        slots = self._facility["mask"].get_pixel_masks()
        for slot, (x, y) in zip(slots, pixels, strict=False):
            slot.set_mask(x, y, True)
        for slot in slots[len(pixels) :]:
            slot.set_mask(0, 0, False)
        return min(len(slots), len(pixels))

    def _enable_trigger(self, on: bool) -> None:  # noqa: FBT001  (as it comes off the line)
        main = self._hal.I_TriggerIn.Channel.MAIN
        (self._facility["trigger"].enable if on else self._facility["trigger"].disable)(main)

    def _limit_rate(self, mev_s: float | None) -> None:
        controller = self._facility["rate_limit"]
        if mev_s is not None:
            controller.set_cd_event_rate(round(mev_s * US_PER_S))
        controller.enable(mev_s is not None)

    def _take_events(self, events: NDArray[Any]) -> None:
        self._events.append(np.array(events, EVENTS))

    def _take_edges(self, edges: NDArray[Any]) -> None:
        self._edges += [
            Trigger(SensorUs(int(t)), int(channel), rising=bool(p))
            for p, t, channel in zip(edges["p"], edges["t"], edges["id"], strict=True)
        ]
