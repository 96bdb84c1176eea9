"""One focus cycle: expose, choose, probe, sweep, stop, return, verify, report.

The cycle is a straight line read from top to bottom. A phase that finds out that focus cannot be had leaves by
``Ended`` with an outcome and a sentence for the person; broken machinery leaves as ``DeviceError`` after the strongest
stop has been sent. Either way the lens ends at a declared place or at rest, and there is exactly one result.

The lens is not left where it stopped: the stop comes late by physics (a pixel must travel its leftover threshold and
one more before it can flip, and motors brake), so the cycle looks up where focus *was* and goes back there, from the
side the sweep came from, because backlash is invisible in read-back.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, Protocol

from elpd.errors import DeviceError, UsageError
from elpd.focus import guards, judging, recross, safety
from elpd.focus.aftermath import WatchSettings
from elpd.focus.approach import WayBack, come_to_rest, verify
from elpd.focus.aside import stand_aside
from elpd.focus.ended import Beside, Ended, ended_by
from elpd.focus.fields import result_fields
from elpd.focus.passes import Play
from elpd.focus.scene import Scene, check_roi, widened
from elpd.focus.search import Search
from elpd.focus.stage import REST_LIMIT_MS, Stage
from elpd.focus.watch import Watch
from elpd.ports import Biases, HardwareRoi, PixelMask
from elpd.records import (
    BiasSet,
    Cancel,
    FocusEstimate,
    FocusResult,
    Outcome,
    Phase,
    PhaseTime,
    Roi,
    StopMode,
)
from elpd.undisturbed import undisturbed
from elpd.units import NS_PER_MS, HostNs, after_ms
from elpd.vision.crossing import ROI_MARGIN_PX
from elpd.vision.reference import reference_from_frame
from elpd.vision.resting import LISTEN_MS

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from elpd.focus.picture import Picture
    from elpd.focus.settings import CycleSettings, FocusRequest
    from elpd.focus.sweep import SweepReport
    from elpd.ports import RigParts, RunSink
    from elpd.records import ElpSample, TemporalImage
    from elpd.vision.reference import Reference
    from elpd.vision.sharpest import Sharpest

BIAS_SETTLE_MS = 10.0
"""After new biases or a new window a sensor needs a few ms before its events mean anything."""


class Observer(Protocol):
    """Somebody who watches a cycle: a terminal, a page, a test."""

    def phase(self, name: str, /, **fields: Any) -> None:
        """Hear that a phase begins."""
        ...

    def sample(self, sample: ElpSample, score: float, /) -> None:
        """Hear of one window."""
        ...


class FocusCycle:
    """One request on one rig. Build it, ``run`` it once, throw it away.

    Parameters
    ----------
    parts
        The rig.
    settings, request
        What to do.
    sink
        Where the notes go (a journal, or nowhere).
    observer
        Somebody who watches; never waited for.
    cancelled
        Asked once per turn of any loop, in every phase; true ends the cycle as CANCELLED, and ``Cancel.HOLD`` leaves
        the lens where it stopped, whatever place was declared.

    """

    def __init__(
        self,
        parts: RigParts,
        settings: CycleSettings,
        request: FocusRequest,
        sink: RunSink,
        observer: Observer | None = None,
        cancelled: Callable[[], int] = lambda: False,
    ) -> None:
        self._parts = parts
        self._settings = settings
        self._request = request
        self._sink = sink
        self._observer = observer
        self._cancelled = cancelled
        self._stage = Stage(parts)
        self._begun_ns = parts.clock.now_ns()
        self._deadline_ns = after_ms(self._begun_ns, settings.deadline_ms)
        self._phases: list[tuple[Phase, HostNs]] = []
        self._watch: Watch | None = None
        self._reversals = 0
        self._start_um: float | None = None
        self._stop_um: float | None = None
        self._stop_latency_us: int | None = None
        self._estimate: FocusEstimate | None = None
        self._details: dict[str, Any] = {}
        self._warnings: list[str] = []
        self._scene = Scene(self._stage, request, settings, sink, self._phase)

    def sharpest(self, depths: float) -> Sharpest | None:
        """Return the picture in focus and what it loses over so many depths of focus; ``None`` if it was not seen."""
        if self._watch is None or self._estimate is None:
            return None
        return self._watch.after.sharpest(self._estimate.focus_um, depths * self._settings.depth_of_focus_um)

    @undisturbed()
    def run(self) -> FocusResult:
        """Run the cycle to its one result.

        Raises
        ------
        UsageError
            Before anything moves: a ROI outside the sensor, a reference that does not fit.
        DeviceError
            Broken machinery; the strongest stop has been sent.

        """
        self._check_request()
        try:
            self._parts.camera.start()
            self._stage.listen_for_marks()
            try:
                self._stage.interrupt = self._interrupt
                outcome, reason = self._focus()
            except Ended as ended:
                outcome, reason = ended.outcome, ended.reason
                self._go_to_declared_place()
            self._stage.interrupt = None
            final_um = self._rest_um()
        except BaseException:  # whatever it was, no lens is left running
            self._stop_hard()
            raise
        finally:
            self._parts.camera.stop()
        self._phase(Phase.DONE)
        result = self._result(outcome, reason, final_um)
        self._sink.note("result", **result_fields(result))
        return result

    @property
    def map(self) -> TemporalImage | None:
        """The temporal map, once exposed, for whoever wants to store or show it."""
        return self._scene.map

    @property
    def delays(self) -> Mapping[str, tuple[float, ...]]:
        """How old the newest packets were, us, by stage."""
        return self._stage.delays.by_stage()

    # --- the line of phases ---

    def _focus(self) -> tuple[Outcome, str]:
        self._phase(Phase.SETTLE_BEFORE)
        self._start_um = self._stage.to_um(self._stage.rest(REST_LIMIT_MS).steps)
        picture = self._scene.picture()
        self._phase(Phase.CHOOSE)
        roi, reference = self._scene.choose(picture, self._details)
        watch = self._arm(reference, roi, picture)
        if self._request.dry_run:
            raise Ended(Outcome.CANCELLED, "dry run: the reference has texture in the ROI; nothing was moved")
        try:
            passed = self._search(watch)
        except Beside:
            passed = self._search_from_aside()
            assert self._watch is not None, "it was armed anew"
            watch = self._watch
        self._phase(Phase.STOP)
        sign = self._details["sweep_sign"]
        assert passed.stop is not None, "a sweep that has passed focus sent its stop"
        way = WayBack(self._stage, self._settings, sign)
        ended = come_to_rest(self._stage, watch, passed.stop, way, sign)
        self._stop_um, self._stop_latency_us = ended.um, ended.latency_us
        first, furthest_um = watch.after.estimate(), ended.um
        if recross.is_needed(watch, first, self._settings):
            first, furthest_um = self._pass_again(watch, first, sign, furthest_um)
            way = WayBack(self._stage, self._settings, sign, self._settings.speed_um_s)
        estimate = self._judge(watch, first, sign, (passed.begun_um, furthest_um))
        self._phase(Phase.RETURN)
        rest = way.arrive(estimate.focus_um)
        self._phase(Phase.VERIFY)
        self._details["return_events"] = verify(self._stage, watch, self._settings, way, rest, estimate.focus_um)
        return Outcome.FOCUSED, self._sentence(estimate)

    def _arm(self, reference: Reference, roi: Roi, picture: Picture) -> Watch:
        """Switch the sensor to focusing, let it settle, and learn what noise alone looks like."""
        camera, geometry, settings = self._parts.camera, self._parts.camera.geometry, self._settings
        if isinstance(camera, Biases):
            camera.apply_biases(BiasSet.FOCUS)
        if isinstance(camera, HardwareRoi):
            camera.set_window(widened(roi, ROI_MARGIN_PX, geometry.width, geometry.height))
        sensor = self._request.sensor
        if sensor is not None and sensor.hot_pixels and isinstance(camera, PixelMask):
            self._details["masked_pixels"] = camera.set_mask(sensor.hot_pixels)
        self._stage.wait_ms(BIAS_SETTLE_MS)
        watch = Watch(
            reference,
            roi,
            geometry,
            WatchSettings(
                settings.speed_um_s,
                settings.depth_of_focus_um,
                Play.known(settings),
                frames=picture.map is None,
                background_activity_us=settings.background_activity_us,
            ),
            self._stage.position_um,
            lambda frame: reference_from_frame(frame.pixels, roi),
            sensor,
            picture.levels,
        )
        self._watch = watch
        self._stage.listener = watch.rest
        self._stage.wait_ms(BIAS_SETTLE_MS)
        if watch.resting.restless:
            self._stage.wait_ms(LISTEN_MS)
        self._stage.hear(safety.CAMERA_SILENCE_MS)
        watch.armed()
        self._stage.lost_at_rest = self._stage.lost_events
        self._guard(watch)
        return watch

    def _guard(self, watch: Watch) -> None:
        """Say what the sensor at rest warns of, and sweep slowly enough for a lamp that flickers."""
        resting = watch.resting
        self._warnings += guards.of_rest(resting)
        if resting.flicker is None:
            return
        speed_um_s = guards.speed_under(resting.flicker, resting.residue, self._settings)
        self._settings = replace(self._settings, speed_um_s=speed_um_s)
        watch.under_a_lamp(resting.flicker, speed_um_s)
        self._warnings.append(guards.of_lamp(resting.flicker, speed_um_s))

    def _search_from_aside(self) -> SweepReport:
        """Go off focus, where the lens began in it, and look for it as from anywhere else: with a picture of there."""
        self._stage.listener, self._stage.interrupt = None, self._interrupt
        self._warnings = []  # the sensor at rest is asked anew
        towards = stand_aside(self._stage, self._settings, int(self._details["sweep_sign"]))
        picture = self._scene.picture()
        self._phase(Phase.CHOOSE)
        roi, reference = self._scene.choose(picture, self._details)
        return self._search(self._arm(reference, roi, picture), towards)

    def _search(self, watch: Watch, from_aside: int = 0) -> SweepReport:
        """Find focus; whatever comes of it, the result knows the direction, the strategy and the reversals."""
        self._phase(Phase.PROBE)
        search = Search(
            self._stage,
            watch,
            self._settings,
            self._deadline_ns,
            exposed=self.map is not None,
            shown=self._request.reference is None and self._parts.aperture is None,
            sink=self._sink,
            enter=self._phase,
            observe=self._observe,
            cancelled=self._cancelled,
            interrupt=self._interrupt,
            from_aside=from_aside,
            reversals=self._reversals,
        )
        try:
            return search.run()
        finally:
            self._reversals = search.reversals
            self._details["strategy"], self._details["sweep_sign"] = search.strategy, search.sign

    def _pass_again(
        self, watch: Watch, first: FocusEstimate | None, sign: int, furthest_um: float
    ) -> tuple[FocusEstimate | None, float]:
        """Go over focus again; return what all passes say and the furthest place."""
        self._phase(Phase.RECROSS)
        if first is not None:
            self._sink.note("one pass", focus_um=first.focus_um, sigma_um=first.sigma_um)
        return recross.pass_again(self._stage, watch, self._settings, first, sign, self._deadline_ns, furthest_um)

    def _judge(
        self, watch: Watch, estimate: FocusEstimate | None, sign: int, way_um: tuple[float, float]
    ) -> FocusEstimate:
        """Note what is known of focus, and refuse an answer that the evidence does not carry."""
        if estimate is None:
            raise Ended(
                Outcome.LOW_CONFIDENCE,
                "the sign changed, but no estimator agrees on where; try again with a larger ROI or more light",
            )
        self._estimate = estimate
        self._warnings += guards.of_depths(watch.after.depths_um) + guards.of_late_lamp(watch.after.flicker)
        self._details["method"] = estimate.method
        self._details["contributions"] = [list(item) for item in estimate.contributions]
        self._sink.note("estimate", focus_um=estimate.focus_um, sigma_um=estimate.sigma_um, method=estimate.method)
        lost = self._stage.lost_events if watch.after.gap_near_crossing else None
        judging.demand(estimate, self._settings, sign, way_um, lost)
        return estimate

    # --- the pieces ---

    def _check_request(self) -> None:
        if not self._parts.lens.capabilities.stop_on_command:
            raise UsageError(
                "this lens controller cannot be stopped while it moves, and a one-step focus must stop on the moment; "
                "nothing was moved; move it to a known place (`elpd move UM`), or drive the lens by a controller that "
                "stops: the README's table says how each does"
            )
        if self._request.roi is not None:
            check_roi(self._request.roi, self._parts.camera.geometry)

    def _rest_um(self) -> float:
        """Return where the lens rests: by its newest report if that says so, else after waiting for one."""
        report = self._stage.report
        resting = report is not None and not report.moving and self._phases[-1][0] is Phase.VERIFY
        return self._stage.to_um(
            report.steps if resting and report is not None else self._stage.rest(REST_LIMIT_MS).steps
        )

    def _interrupt(self) -> None:
        """End a phase that waits, if somebody asked for it or time is up."""
        ms_to_deadline = (self._deadline_ns - self._stage.now_ns()) / NS_PER_MS
        verdict = safety.decide(safety.Conditions(cancelled=bool(self._cancelled()), ms_to_deadline=ms_to_deadline))
        if verdict.action is not safety.Action.CONTINUE:
            raise ended_by(verdict)

    def _go_to_declared_place(self) -> None:
        """After anything but FOCUSED: hold, start or preset. A *settled* start, read before anything moved."""
        self._stage.listener = self._stage.interrupt = None
        self._parts.lens.stop(StopMode.RAMPED)
        self._stage.rest(REST_LIMIT_MS)
        if self._cancelled() >= Cancel.HOLD:
            return
        place = {"hold": None, "start": self._start_um, "preset": self._settings.preset_um}[self._settings.on_failure]
        if place is None or abs(self._stage.here_um() - place) < self._stage.um_per_step:
            return
        self._stage.move(place, self._settings.speed_um_s)

    def _stop_hard(self) -> None:
        """Send the strongest stop, whatever else is broken."""
        try:
            self._parts.lens.stop(StopMode.ABRUPT)
        except DeviceError as error:
            self._sink.note("stop failed", error=str(error))

    def _sentence(self, estimate: FocusEstimate) -> str:
        return f"in focus at {estimate.focus_um:.2f} um, known to {estimate.sigma_um:.2f} um by {estimate.method}"

    def _phase(self, phase: Phase, /, **fields: Any) -> None:
        now = self._stage.now_ns()
        if not self._phases or self._phases[-1][0] is not phase:
            self._phases.append((phase, now))
        self._sink.note("phase", name=phase.value, at_ms=(now - self._begun_ns) / NS_PER_MS, **fields)
        if self._observer is not None:
            self._observer.phase(phase.value, **fields)

    def _observe(self, sample: ElpSample, score: float) -> None:
        self._sink.note(
            "window",
            begin_us=int(sample.begin_us),
            end_us=int(sample.end_us),
            elp=int(sample.elp),
            energy=int(sample.energy),
            n_on=int(sample.n_on),
            n_off=int(sample.n_off),
            position_um=sample.position_um,
            score=score,
        )
        if self._observer is not None:
            self._observer.sample(sample, score)

    def _told(self) -> tuple[str, ...]:
        """Return every warning, those about what was lost or clipped last."""
        told = [*self._warnings, *guards.of_loss(self._stage.lost_events)]
        if self._watch is not None:
            told += guards.of_marks(self._stage.marks)
            told += guards.of_shedding(self._watch.shedding.shed_us)
            roi, frame = self._watch.roi, self._stage.frame
            told += guards.of_rate(self._watch.rate.plateau_mev_s())
            told += guards.of_frame(
                None if frame is None else frame.pixels[roi.y :, roi.x :][: roi.height, : roi.width]
            )
        return tuple(told)

    def _result(self, outcome: Outcome, reason: str, final_um: float) -> FocusResult:
        estimate = self._estimate
        shake_rad_s = self._stage.shake.rms_rad_s
        if shake_rad_s is not None:
            self._details["shake_rad_s"] = shake_rad_s
        ends = [at for _, at in self._phases[1:]]
        phases = tuple(
            PhaseTime(phase.value, (end - at) / NS_PER_MS) for (phase, at), end in zip(self._phases, ends, strict=False)
        )
        return FocusResult(
            outcome=outcome,
            reason=reason,
            reversals=self._reversals,
            focus_um=None if estimate is None else estimate.focus_um,
            sigma_um=None if estimate is None else estimate.sigma_um,
            stop_um=self._stop_um,
            final_um=final_um,
            stop_latency_us=self._stop_latency_us,
            duration_ms=self._stage.elapsed_ms(self._begun_ns),
            phases=phases,
            events=0 if self._watch is None else self._watch.events_in_cycle,
            lost=self._stage.lost_events,
            details=self._details,
            warnings=self._told(),
            depths_um=() if self._watch is None else self._watch.depths_um,
        )
