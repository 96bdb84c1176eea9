"""One focus cycle: expose, choose, probe, sweep, stop, return, verify, report.

The cycle is a straight line read from top to bottom. A phase that finds out that focus cannot be had leaves by
``_Ended`` with an outcome and a sentence for the person; broken machinery leaves as ``DeviceError`` after the strongest
stop has been sent. Either way the lens ends at a declared place or at rest, and there is exactly one result.

The lens is not left where it stopped: the stop comes late by physics (a pixel must travel its leftover threshold and
one more before it can flip, and motors brake), so the cycle looks up where focus *was* and goes back there, from the
side the sweep came from, because backlash is invisible in read-back.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

from elpd.errors import CameraError, DeviceError, UsageError
from elpd.focus import safety
from elpd.focus.expose import AFTER_FACTOR, expose
from elpd.focus.picture import Picture
from elpd.focus.stage import Stage
from elpd.focus.sweep import Sweep, SweepEnd, SweepPlan, SweepReport
from elpd.focus.watch import Watch, WatchSettings
from elpd.ports import Biases, HardwareRoi
from elpd.records import (
    BiasSet,
    FocusEstimate,
    FocusResult,
    Outcome,
    Phase,
    PhaseTime,
    Roi,
    StopMode,
)
from elpd.units import NS_PER_MS, NS_PER_S, NS_PER_US, HostNs, after_ms
from elpd.vision.choose import propose_roi
from elpd.vision.reference import reference_from_frame

if TYPE_CHECKING:
    from collections.abc import Callable

    from elpd.focus.settings import CycleSettings, FocusRequest
    from elpd.ports import RigParts, RunSink
    from elpd.records import ElpSample, LensReport, TemporalImage
    from elpd.vision.reference import Reference

BIAS_SETTLE_MS = 10.0
"""After new biases or a new window a sensor needs a few ms before its events mean anything."""

FRAME_LIMIT_MS = 500.0
"""A camera with frames delivers one within this, or has none."""

REJOG_S = 0.25
"""What a controller without a velocity mode takes from one jog to the opposite one, beside braking."""

REST_LIMIT_MS = 1500.0
"""No lens this is for rings or brakes longer; past it the lens does not obey."""

APPROACH_MARGIN_UM = 2.0
"""How much further than the backlash the final approach begins."""

RETURN_SHARE = 0.5
"""The way back leads over the same ground as the way out, and beyond: half its events at the least."""

LIT_SHARE = 0.5
"""Half of the region's pixels answer when an aperture closes over a scene in the light; most do several times."""

ROI_MARGIN_PX = 14
"""Pixels around the ROI that the sensor keeps on: filters need neighbours, motion needs room."""


class Observer(Protocol):
    """Somebody who watches a cycle: a terminal, a page, a test."""

    def phase(self, name: str, /, **fields: Any) -> None:
        """Hear that a phase begins."""
        ...

    def sample(self, sample: ElpSample, score: float, /) -> None:
        """Hear of one window."""
        ...


class _Ended(Exception):  # noqa: N818  (an early end of the cycle, not an error)
    """Focus cannot be had; leave with an outcome."""

    def __init__(self, outcome: Outcome, reason: str) -> None:
        super().__init__(reason)
        self.outcome = outcome
        self.reason = reason


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
        Asked once per turn of any loop, in every phase; true ends the cycle as CANCELLED.

    """

    def __init__(
        self,
        parts: RigParts,
        settings: CycleSettings,
        request: FocusRequest,
        sink: RunSink,
        observer: Observer | None = None,
        cancelled: Callable[[], bool] = lambda: False,
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
        self.map: TemporalImage | None = None
        """The temporal map, once exposed, for whoever wants to store or show it."""

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
            try:
                self._stage.interrupt = self._interrupt
                outcome, reason = self._focus()
            except _Ended as ended:
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

    # --- the line of phases ---

    def _focus(self) -> tuple[Outcome, str]:
        self._phase(Phase.SETTLE_BEFORE)
        self._start_um = self._stage.to_um(self._stage.rest(REST_LIMIT_MS).steps)
        picture = self._picture()
        self._phase(Phase.CHOOSE)
        roi, reference = self._choose(picture)
        watch = self._arm(reference, roi, frames=picture.map is None)
        if self._request.dry_run:
            raise _Ended(Outcome.CANCELLED, "dry run: the reference has texture in the ROI; nothing was moved")
        passed = self._search(watch)
        self._phase(Phase.STOP)
        rest = self._stage.rest(REST_LIMIT_MS)
        self._stop_um = self._stage.to_um(rest.steps)
        self._stop_latency_us = self._latency_us(watch, rest)
        estimate = self._judge(watch, passed)
        self._return(estimate, passed)
        return Outcome.FOCUSED, self._sentence(estimate)

    def _picture(self) -> Picture:
        """Get a picture of the scene: a stored one, an opening aperture's, or the newest frame."""
        request, geometry = self._request, self._parts.camera.geometry
        if request.reference is not None:
            picture = Picture.of_file(request.reference, geometry)
            if self._parts.aperture is not None:
                self._parts.aperture.open()
                self._stage.wait_ms(AFTER_FACTOR * self._parts.aperture.opening_ms)
            return picture
        if self._parts.aperture is None:
            frame = self._stage.newest_frame(FRAME_LIMIT_MS)
            if frame is None:
                raise UsageError(
                    "this camera delivers no frames and the rig has no aperture to expose with; "
                    "give --reference IMAGE, or configure an aperture"
                )
            return Picture.of_frame(frame.pixels)
        self._phase(Phase.EXPOSE)
        self.map, (good, reason) = expose(self._stage, self._settings.transmittance)
        if self.map is not None:
            self._sink.note(
                "map",
                fired_fraction=self.map.fired_fraction,
                hot_pixels=self.map.hot_pixels,
                open_us=int(self.map.open_us),
                dynamic_range_db=self.map.dynamic_range_db,
            )
        if self.map is None or not good:
            raise _Ended(Outcome.NO_TEXTURE, reason)
        return Picture.of_map(self.map)

    def _choose(self, picture: Picture) -> tuple[Roi, Reference]:
        geometry = self._parts.camera.geometry
        roi = self._request.roi
        if roi is None:
            side = round(self._settings.roi_fraction * min(geometry.width, geometry.height))
            roi = propose_roi(picture.log_image, picture.valid, (side, side))
        if roi is None:
            raise _Ended(Outcome.NO_TEXTURE, "nothing in the picture has texture above its noise; aim at a subject")
        self._details["roi"] = [roi.x, roi.y, roi.width, roi.height]
        reference = picture.reference(roi)
        self._sink.note("roi", roi=self._details["roi"], texture=reference.texture, scale_px=reference.scale_px)
        if not reference.textured:
            raise _Ended(
                Outcome.NO_TEXTURE,
                f"the picture shows no structure above its own noise in the ROI ({reference.texture:.1f} sigma, "
                "at least 6 are needed); choose another ROI or add light",
            )
        return roi, reference

    def _arm(self, reference: Reference, roi: Roi, *, frames: bool) -> Watch:
        """Switch the sensor to focusing, let it settle, and learn what noise alone looks like."""
        camera, geometry, settings = self._parts.camera, self._parts.camera.geometry, self._settings
        if isinstance(camera, Biases):
            camera.apply_biases(BiasSet.FOCUS)
        if isinstance(camera, HardwareRoi):
            camera.set_window(widened(roi, ROI_MARGIN_PX, geometry.width, geometry.height))
        self._stage.wait_ms(BIAS_SETTLE_MS)
        watch = Watch(
            reference,
            roi,
            geometry,
            WatchSettings(settings.speed_um_s, settings.depth_of_focus_um, frames=frames),
            self._stage.position_um,
            lambda frame: reference_from_frame(frame.pixels, roi),
        )
        self._watch = watch
        self._stage.listener = watch.rest
        self._stage.wait_ms(BIAS_SETTLE_MS)
        self._stage.hear(safety.CAMERA_SILENCE_MS)
        watch.armed()
        return watch

    def _search(self, watch: Watch) -> SweepReport:
        """Sweep, reversing while focus lies behind, until it has been passed. Leaves with the lens told to stop."""
        self._phase(Phase.PROBE)
        capabilities, limits = self._parts.lens.capabilities, self._parts.lens.limits
        if not capabilities.stop_on_command:
            raise UsageError("this lens controller cannot stop on command: it cannot focus in one sweep")
        speed_um_s = min(self._settings.speed_um_s, self._stage.to_um(limits.max_speed_sps))
        braking_um = self._braking_um(speed_um_s)
        turn_s = 2 * speed_um_s / self._stage.to_um(limits.acceleration_sps2) + capabilities.stop_onset_ms / 500.0
        if not capabilities.native_velocity:
            turn_s += REJOG_S
        slow = braking_um > 5 * self._settings.depth_of_focus_um
        self._details["strategy"] = "sweep_and_return" if slow else "stop_on_detect"
        sweep = Sweep(self._stage, watch, cancelled=self._cancelled, observe=self._observe)
        sign = self._first_sign()
        reach_um = self._settings.max_travel_um
        turned_at_um: float | None = None
        lit, dark = False, True
        while True:
            self._details["sweep_sign"] = sign
            plan = SweepPlan(
                sign=sign,
                speed_um_s=speed_um_s,
                max_travel_um=reach_um,
                braking_um=braking_um,
                turn_s=turn_s,
                deadline_ns=self._deadline_ns,
                depth_of_focus_um=self._settings.depth_of_focus_um,
                stop_mode=StopMode.ABRUPT if capabilities.abrupt_stop else StopMode.RAMPED,
                turned_at_um=turned_at_um,
                lit=lit,
            )
            self._phase(Phase.SWEEP, sign=sign, position_um=self._here_um())
            self._stage.listener = self._stage.interrupt = None  # the sweep asks for itself, and stops the lens first
            report = sweep.run(plan)
            self._sink.note(
                "sweep",
                sign=sign,
                end=report.end.value,
                begun_um=report.begun_um,
                ended_um=self._here_um(),
                events=watch.events,
                reason=report.verdict.reason,
            )
            if report.end is SweepEnd.PASSED:
                self._stage.listener, self._stage.interrupt = watch.keep, self._interrupt
                return report
            if report.end is SweepEnd.RULE and report.verdict.outcome is not Outcome.NO_CROSSING:
                if report.verdict.outcome is Outcome.TOO_FEW_EVENTS and self._in_the_light(watch):
                    lit, reach_um = True, reach_um - abs(self._here_um() - report.begun_um)
                    continue  # far from focus a lens may go a long way before anything changes
                raise self._rule(report.verdict)
            dark = dark and report.end is SweepEnd.RULE and report.dark
            if self._reversals >= self._settings.max_reversals:
                if lit and dark:
                    raise _Ended(
                        Outcome.LENS_DID_NOT_MOVE,
                        "nothing changed while the lens should have moved, and yet the scene is in the light: the "
                        "aperture shows it; check the coupling, and that the motor turns",
                    )
                if report.end is SweepEnd.RULE:
                    raise self._rule(report.verdict)
                raise _Ended(
                    Outcome.NO_CROSSING,
                    f"focus seemed to lie behind {self._reversals + 1} times; "
                    "does the subject move in depth? raise focus.max_reversals or hold it still",
                )
            turned_at_um = self._here_um() if report.end is SweepEnd.BEHIND else None
            if report.end is SweepEnd.RULE:
                self._stage.rest(REST_LIMIT_MS)
            self._reversals += 1
            reach_um = self._settings.max_travel_um + abs(self._here_um() - report.begun_um) + 2 * braking_um
            sign = -sign

    def _in_the_light(self, watch: Watch) -> bool:
        """Ask the aperture, if it made this cycle's picture: every lit pixel answers when it closes."""
        aperture, stage = self._parts.aperture, self._stage
        if aperture is None or self.map is None:
            return False
        stage.listener, stage.interrupt = watch.count, self._interrupt
        stage.rest(REST_LIMIT_MS)
        before, begun_ns = watch.events_in_cycle, stage.now_ns()
        aperture.close()
        try:
            stage.wait_ms(aperture.opening_ms)
            stage.hear(safety.CAMERA_SILENCE_MS)
        finally:
            aperture.open()
        noise = watch.resting_rate_hz * (stage.now_ns() - begun_ns) / NS_PER_S
        answers = watch.events_in_cycle - before - noise
        stage.wait_ms(AFTER_FACTOR * aperture.opening_ms)
        _, _, width, height = self._details["roi"]
        return bool(answers > LIT_SHARE * width * height)

    def _judge(self, watch: Watch, passed: SweepReport) -> FocusEstimate:
        """Say where focus was, and refuse an answer that the evidence does not carry."""
        estimate = watch.estimate()
        if estimate is None:
            raise _Ended(
                Outcome.LOW_CONFIDENCE,
                "the sign changed, but no estimator agrees on where; try again with a larger ROI or more light",
            )
        self._estimate = estimate
        self._details["method"] = estimate.method
        self._details["contributions"] = [list(item) for item in estimate.contributions]
        self._sink.note("estimate", focus_um=estimate.focus_um, sigma_um=estimate.sigma_um, method=estimate.method)
        if watch.gap_near_crossing:
            raise _Ended(
                Outcome.EVENTS_LOST,
                f"events were lost while focus was passed ({self._stage.lost_events} known); "
                "choose a smaller ROI or a slower sweep",
            )
        limit_um = self._settings.max_sigma_dof * self._settings.depth_of_focus_um
        if estimate.sigma_um > limit_um:
            raise _Ended(
                Outcome.LOW_CONFIDENCE,
                f"focus is known to {estimate.sigma_um:.1f} um only (limit {limit_um:.1f}); "
                "choose a ROI with more contrast, more light, or less motion",
            )
        stop_um = self._stop_um
        sign = self._details["sweep_sign"]
        if stop_um is not None and sign * (estimate.focus_um - stop_um) > self._settings.depth_of_focus_um:
            raise _Ended(
                Outcome.LOW_CONFIDENCE,
                f"focus was put at {estimate.focus_um:.1f} um, which the sweep ({passed.begun_um:.1f} to "
                f"{stop_um:.1f}) has not reached",
            )
        return estimate

    def _return(self, estimate: FocusEstimate, passed: SweepReport) -> None:
        """Go back to where focus was, from the side the sweep came from, and see that the lens is there."""
        del passed
        self._phase(Phase.RETURN)
        stage, watch, settings = self._stage, self._watch, self._settings
        if watch is None or self._stop_um is None:
            raise AssertionError("a return needs a stop")
        limits = self._parts.lens.limits
        sign = self._details["sweep_sign"]
        way_back_um = abs(self._stop_um - estimate.focus_um)
        expected = watch.events_within(estimate.focus_um, self._stop_um)
        before, begun_ns = watch.events_in_cycle, stage.now_ns()
        stage.listener = watch.count
        beyond_um = estimate.focus_um - sign * (settings.backlash_um + APPROACH_MARGIN_UM)
        rest = None
        for target_um in (beyond_um, estimate.focus_um):
            bounded = min(max(stage.to_steps(target_um), limits.min_steps), limits.max_steps)
            rest = stage.move(stage.to_um(bounded), settings.speed_um_s, limits.acceleration_sps2)
        self._phase(Phase.VERIFY)
        if rest is None:
            raise AssertionError("two moves end in a rest")
        error_um = stage.to_um(rest.steps) - estimate.focus_um
        if abs(error_um) > max(0.25 * settings.depth_of_focus_um, 2 * stage.um_per_step):
            raise _Ended(
                Outcome.LENS_DID_NOT_MOVE,
                f"the lens rests {error_um:+.1f} um from where it was sent; check the motor current and the mechanics",
            )
        stage.hear(safety.CAMERA_SILENCE_MS)
        resting_hz = watch.resting_rate_hz
        seen = watch.events_in_cycle - before - round(resting_hz * (stage.now_ns() - begun_ns) / NS_PER_S)
        expected -= round(resting_hz * way_back_um / settings.speed_um_s)
        self._details["return_events"] = seen
        if way_back_um > settings.depth_of_focus_um and seen < RETURN_SHARE * expected:
            raise _Ended(
                Outcome.LENS_DID_NOT_MOVE,
                f"the controller says that the lens went back {way_back_um:.0f} um, but the scene did not change "
                f"({seen} events above noise, {expected} on the way out); check the coupling between motor and lens",
            )

    # --- the pieces ---

    def _check_request(self) -> None:
        geometry = self._parts.camera.geometry
        roi = self._request.roi
        if roi is not None and not roi.fits(geometry):
            raise UsageError(
                f"the ROI {roi.x},{roi.y},{roi.width},{roi.height} does not lie inside the sensor "
                f"({geometry.width}x{geometry.height}) or is empty; give X,Y,W,H inside it"
            )
        if roi is not None and min(roi.width, roi.height) < 8:
            raise UsageError(
                f"the ROI {roi.width}x{roi.height} is too small to hold texture (at least 8x8); draw a larger one"
            )

    def _first_sign(self) -> int:
        if self._settings.first_direction != "auto":
            return 1 if self._settings.first_direction == "up" else -1
        limits = self._parts.lens.limits
        here = self._here_um() / self._stage.um_per_step
        return 1 if limits.max_steps - here >= here - limits.min_steps else -1

    def _braking_um(self, speed_um_s: float) -> float:
        """Return the way from the stop command to rest."""
        capabilities, limits = self._parts.lens.capabilities, self._parts.lens.limits
        onset_ms = capabilities.stop_onset_ms + 2 * capabilities.stop_onset_sigma_ms
        ramp_um = 0.0
        if not capabilities.abrupt_stop:
            ramp_um = speed_um_s**2 / (2 * self._stage.to_um(limits.acceleration_sps2))
        return speed_um_s * onset_ms / 1000.0 + ramp_um

    def _rest_um(self) -> float:
        """Return where the lens rests: by its newest report if that says so, else after waiting for one."""
        report = self._stage.report
        resting = report is not None and not report.moving and self._phases[-1][0] is Phase.VERIFY
        return self._stage.to_um(
            report.steps if resting and report is not None else self._stage.rest(REST_LIMIT_MS).steps
        )

    def _here_um(self) -> float:
        return self._stage.to_um(self._parts.lens.position_at(self._stage.now_ns()).steps)

    def _interrupt(self) -> None:
        """End a phase that waits, if somebody asked for it or time is up."""
        ms_to_deadline = (self._deadline_ns - self._stage.now_ns()) / NS_PER_MS
        verdict = safety.decide(safety.Conditions(cancelled=self._cancelled(), ms_to_deadline=ms_to_deadline))
        if verdict.action is not safety.Action.CONTINUE:
            raise self._rule(verdict)

    def _rule(self, verdict: safety.Verdict) -> Exception:
        if verdict.action is safety.Action.FAULT:
            return CameraError(verdict.reason)
        if verdict.outcome is None:
            raise AssertionError(f"a rule without an outcome: {verdict}")
        return _Ended(verdict.outcome, verdict.reason)

    def _go_to_declared_place(self) -> None:
        """After anything but FOCUSED: hold, start or preset. A *settled* start, read before anything moved."""
        self._stage.listener = self._stage.interrupt = None
        self._parts.lens.stop(StopMode.RAMPED)
        self._stage.rest(REST_LIMIT_MS)
        place = {"hold": None, "start": self._start_um, "preset": self._settings.preset_um}[self._settings.on_failure]
        if place is None or abs(self._here_um() - place) < self._stage.um_per_step:
            return
        self._stage.move(place, self._settings.speed_um_s, self._parts.lens.limits.acceleration_sps2)

    def _stop_hard(self) -> None:
        """Send the strongest stop, whatever else is broken."""
        try:
            self._parts.lens.stop(StopMode.ABRUPT)
        except DeviceError as error:
            self._sink.note("stop failed", error=str(error))

    def _latency_us(self, watch: Watch, rest: LensReport) -> int | None:
        """Return the time from the closing of the deciding window to the motor's last step."""
        if watch.decided_us is None:
            return None
        decided_ns = self._stage.sensor_clock.to_host(watch.decided_us)
        lens, when = self._parts.lens, HostNs(rest.latest_ns)
        while when > decided_ns and abs(lens.position_at(when).steps - rest.steps) < 1.0:
            when = HostNs(when - NS_PER_MS // 8)
        return int(max(0, when - decided_ns) // NS_PER_US)

    def _sentence(self, estimate: FocusEstimate) -> str:
        return f"in focus at {estimate.focus_um:.2f} um, known to {estimate.sigma_um:.2f} um by {estimate.method}"

    def _phase(self, phase: Phase, **fields: Any) -> None:
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

    def _result(self, outcome: Outcome, reason: str, final_um: float) -> FocusResult:
        estimate = self._estimate
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
        )


def widened(roi: Roi, margin_px: int, width: int, height: int) -> Roi:
    """Return *roi* grown by a margin on all sides, cut to the sensor."""
    left, top = max(0, roi.x - margin_px), max(0, roi.y - margin_px)
    right = min(width, roi.x + roi.width + margin_px)
    bottom = min(height, roi.y + roi.height + margin_px)
    return Roi(left, top, right - left, bottom - top)


def result_fields(result: FocusResult) -> dict[str, Any]:
    """Return the stable JSON fields of a result (``DESIGN`` §7), with its details beside them."""
    return {
        "outcome": result.outcome.value,
        "reason": result.reason,
        "reversals": result.reversals,
        "focus_um": result.focus_um,
        "sigma_um": result.sigma_um,
        "stop_um": result.stop_um,
        "final_um": result.final_um,
        "stop_latency_us": result.stop_latency_us,
        "duration_ms": result.duration_ms,
        "phases": [{"name": phase.name, "ms": phase.ms} for phase in result.phases],
        "events": result.events,
        "lost": result.lost,
        "details": result.details,
    }
