"""A run as one HTML page that needs nothing else: numbers, plots, the picture that was aimed at.

Everything is read from the run's folder; nothing is run again and nothing is written there. The page has no script and
asks nobody for anything, so it can be mailed, archived, printed, attached to a bug report.
"""

from __future__ import annotations

import base64
import json
import re
from contextlib import suppress
from html import escape
from importlib.resources import files
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from elpd.errors import FormatError
from elpd.record.journal import DECISIONS_FILE
from elpd.record.playback import TapeReader
from elpd.record.replay import RecordedRun, load_run
from elpd.record.svg_plot import SvgPlot, span
from elpd.record.tape import frame_name
from elpd.vision.first_events import FirstEventMap
from elpd.vision.pictures import display
from elpd.vision.temporal_map import iris, temporal_image

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from numpy.typing import NDArray

SMOOTHED_WINDOWS = 5
JPEG_QUALITY = 80

Note = dict[str, Any]


def report_html(path: Path) -> str:
    """Return the page of the run in *path*. Raises ``FormatError`` if it is no run."""
    run = load_run(path)
    notes = read_notes(path)
    title = f"{path.resolve().name}: {_outcome(run)}"
    sections = [
        _head(run, path),
        _plots(notes, run.result),
        _picture(path, notes),
        _details(run),
        _settings(run),
    ]
    style = (files("elpd.record") / "report.css").read_text(encoding="utf-8")
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta http-equiv="Content-Security-Policy" '
        "content=\"default-src 'none'; style-src 'unsafe-inline'; img-src data:\">\n"
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>\n{style}</style>\n</head>\n<body>\n"
        + "\n".join(section for section in sections if section)
        + "\n</body>\n</html>\n"
    )


def read_notes(path: Path) -> list[Note]:
    """Return the notes of a run as far as they can be read: one that was cut off tells what it has."""
    notes: list[Note] = []
    with suppress(OSError, ValueError):
        notes.extend(map(json.loads, (path / DECISIONS_FILE).read_text(encoding="ascii").splitlines()))
    return notes


# --- sections ----------------------------------------------------------------------------------------------------


def _head(run: RecordedRun, path: Path) -> str:
    result = run.result or {}
    good = "good" if result.get("outcome") == "FOCUSED" else "bad"
    reason = result.get("reason") or (run.error or {}).get("message") or "this run has no ending: it was cut off"
    found = ""
    if result.get("focus_um") is not None:
        sigma = "" if result.get("sigma_um") is None else f" <small>± {result['sigma_um']:.2f}</small>"
        found = f'<p class="found">{result["focus_um"]:.2f} <small>µm</small>{sigma}</p>'
    remarks = "".join(f"<li>{escape(_prose(str(text)))}</li>" for text in result.get("warnings", []))
    cut = f'<p class="remark">The record is not complete: {escape(str(run.truncated))}</p>' if run.truncated else ""
    return (
        f'<header><p class="name">{escape(path.resolve().name)} · elpd {escape(str(run.elpd))}</p>'
        f'<h1 class="{good}">{escape(_outcome(run))}</h1>{found}<p>{escape(_prose(str(reason)))}</p>'
        f"{f'<ul>{remarks}</ul>' if remarks else ''}{cut}</header>"
    )


def _plots(notes: list[Note], result: Note | None) -> str:
    windows = [note for note in notes if note["event"] == "window" and _is_number(note["position_um"])]
    if len(windows) < 2:
        return "<section><h2>Sweep</h2><p>The lens never swept, so there is no curve.</p></section>"
    before = sum(len(_moving(way)) > 1 for way in split_ways(notes)) > 1
    earlier = '<span><b class="earlier"></b> before a reversal: negative, focus lies behind</span>' if before else ""
    return (
        f"<section><h2>Event Laplacian Product over the lens position</h2>{_curve(notes, windows, result or {})}"
        f'<p class="legend"><span><b class="last"></b> the last sweep</span>{earlier}'
        "<span>dots are single windows, lines the mean of five</span></p></section>"
        f"<section><h2>The lens over time</h2>{_path(windows)}<h2>Events per window</h2>{_rate(windows)}</section>"
    )


def _curve(notes: list[Note], windows: list[Note], result: Note) -> str:
    moving = _moving(windows)
    marks = [(result.get("stop_um"), "stop", "motor at rest"), (result.get("focus_um"), "focus", "focus")]
    known = [(float(um), name, f"{text} {um:.1f} µm") for um, name, text in marks if um is not None and _is_number(um)]
    x_range = span([note["position_um"] for note in moving], *(um for um, _, _ in known))
    plot = SvgPlot(
        "ELP over the lens position", x_range, span([note["elp"] for note in moving], 0), ("lens position, µm", "ELP")
    )
    if _is_number(result.get("focus_um")) and _is_number(result.get("sigma_um")):
        plot.band(result["focus_um"] - result["sigma_um"], result["focus_um"] + result["sigma_um"], "sigma")
    ways = [way for way in split_ways(notes) if way]
    for nth, way in enumerate(ways):
        kind = "last" if nth == len(ways) - 1 else "earlier"
        points = [(note["position_um"], note["elp"]) for note in _moving(way)]
        if len(points) > 1:
            plot.dots(points, f"dots {kind}")
            plot.line(zip((um for um, _ in points), _smooth([elp for _, elp in points]), strict=True), f"line {kind}")
    for um, name, text in known:
        plot.upright(um, name, text, low=name == "stop")
    return plot.text()


def _path(windows: list[Note]) -> str:
    begin_us = windows[0]["begin_us"]
    points = [((note["end_us"] - begin_us) / 1e3, note["position_um"]) for note in windows]
    plot = SvgPlot(
        "Lens position over time",
        span([ms for ms, _ in points]),
        span([um for _, um in points]),
        ("ms since the first window", "µm"),
        (900.0, 210.0),
    )
    plot.line(points, "line last")
    return plot.text()


def _rate(windows: list[Note]) -> str:
    begin_us = windows[0]["begin_us"]
    spans = [
        ((note["begin_us"] - begin_us) / 1e3, (note["end_us"] - begin_us) / 1e3, float(note["n_on"] + note["n_off"]))
        for note in windows
    ]
    plot = SvgPlot(
        "Events per window over time",
        span([end for _, end, _ in spans], 0),
        span([count for _, _, count in spans], 0),
        ("ms since the first window", "events"),
        (900.0, 170.0),
    )
    plot.bars(spans, "bars")
    return plot.text()


def _picture(path: Path, notes: list[Note]) -> str:
    """Show what the region was chosen on: the temporal map, made again from the recorded events, or a frame."""
    try:
        image, words = _aimed_at(path, notes)
    except (FormatError, OSError, ValueError) as error:
        return f"<section><h2>Picture</h2><p>It cannot be made again: {escape(str(error))}</p></section>"
    if image is None:
        return ""
    height, width = image.shape
    coded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()
    source = f"data:image/jpeg;base64,{base64.b64encode(coded).decode()}"
    roi = next((note["roi"] for note in notes if note["event"] == "roi"), None)
    box = "" if roi is None else '<rect class="roi" x="{}" y="{}" width="{}" height="{}"/>'.format(*map(int, roi))
    words += "" if roi is None else f" The region is {roi[2]} × {roi[3]} pixels at {roi[0]}, {roi[1]}."
    return (
        f'<section><h2>Picture</h2><svg class="picture" viewBox="0 0 {width} {height}" role="img" '
        f'aria-label="{escape(words)}"><image href="{source}" width="{width}" height="{height}"/>{box}</svg>'
        f"<p>{escape(words)}</p></section>"
    )


def _aimed_at(path: Path, notes: list[Note]) -> tuple[NDArray[np.uint8] | None, str]:
    exposed = next((note for note in notes if note["event"] == "map"), None)
    if exposed is not None:
        with TapeReader(path) as tape:
            opening_us = 1000.0 * (tape.facts.opening_ms or 0.0)
            open_us = int(exposed["open_us"])
            gathered = FirstEventMap(tape.facts.geometry, None, round(open_us + 2 * opening_us) if opening_us else None)
            for packet in tape.packets():
                gathered.add_packet(packet)
                if gathered.complete:
                    break
        image = temporal_image(gathered.believed(), iris, None)
        return display(image.log_intensity, image.valid), "The temporal map, in log intensity."
    for nth in range(1, 1000):
        if not (path / frame_name(nth)).exists():
            break
        image_file = path / frame_name(nth)
        pixels = cv2.imread(str(image_file), cv2.IMREAD_GRAYSCALE)
        if pixels is not None:
            return np.asarray(pixels, np.uint8), "The first recorded frame."
    return None, ""


def _details(run: RecordedRun) -> str:
    result = run.result
    if result is None:
        return ""
    rows = [
        ("Rests at", _um(result.get("final_um"))),
        ("Motor at rest after the stop", _um(result.get("stop_um"))),
        ("From the decision to rest", _ms(result.get("stop_latency_us"), 1e3)),
        ("Whole cycle", _ms(result.get("duration_ms"))),
        ("Reversals", str(result.get("reversals"))),
        ("Events in the region", f"{result.get('events', 0):,}"),
        ("Events known to be lost", f"{result.get('lost', 0):,}"),
        ("Strategy", str((result.get("details") or {}).get("strategy", "–")).replace("_", " ")),
        *((f"Plane in focus at ({nth})", _um(um)) for nth, um in enumerate(result.get("depths_um") or [], 1)),
        *(
            (f"Simulator: {name.removesuffix('_um').replace('_', ' ')}", _um(um))
            for name, um in (run.truth or {}).items()
        ),
    ]
    estimators = (result.get("details") or {}).get("contributions") or []
    voted = [
        (str(name), f"{um:.2f} µm ± {sigma:.2f}", f"{100 * weight:.0f} %") for name, um, sigma, weight in estimators
    ]
    parts = ["<section><h2>Numbers</h2>", _table(rows)]
    if voted:
        parts += [
            "<h2>Who voted for this position</h2>",
            _table([("estimator", "position", "weight"), *voted], head=True),
        ]
    phases = [(str(one["name"]).replace("_", " "), one["ms"]) for one in result.get("phases") or []]
    if phases:
        longest = max(ms for _, ms in phases) or 1.0
        bars = "".join(
            f'<tr><th>{escape(name)}</th><td class="bar"><meter max="{longest:.3f}" value="{ms:.3f}"></meter></td>'
            f"<td>{ms:.1f} ms</td></tr>"
            for name, ms in phases
        )
        parts.append(f"<h2>Phases</h2><table>{bars}</table>")
    return "".join([*parts, "</section>"])


def _settings(run: RecordedRun) -> str:
    text = json.dumps({"request": run.request, "config": run.config}, indent=2)
    return (
        f"<section><details><summary>Request and configuration</summary><pre>{escape(text)}</pre></details></section>"
    )


# --- pieces ------------------------------------------------------------------------------------------------------


def split_ways(notes: list[Note]) -> list[list[Note]]:
    """Gather the windows of each direction of travel: a phase named sweep or recross begins one."""
    ways: list[list[Note]] = [[]]
    for note in notes:
        if note["event"] == "phase" and note["name"] in {"sweep", "recross"}:
            ways.append([])
        elif note["event"] == "window" and _is_number(note["position_um"]):
            ways[-1].append(note)
    return ways


def _moving(windows: list[Note]) -> list[Note]:
    """Leave out the windows in which the lens still stood: they are many, in one place."""
    return [
        note
        for before, note in zip([None, *windows], windows, strict=False)
        if before is None or note["position_um"] != before["position_um"]
    ]


def _smooth(values: list[float]) -> list[float]:
    half = SMOOTHED_WINDOWS // 2
    return [float(np.mean(values[max(0, nth - half) : nth + half + 1])) for nth in range(len(values))]


def _table(rows: Iterable[tuple[str, ...]], *, head: bool = False) -> str:
    text = []
    for nth, (first, *others) in enumerate(rows):
        tag = "th" if head and nth == 0 else "td"
        cells = "".join(f"<{tag}>{escape(cell)}</{tag}>" for cell in others)
        text.append(f"<tr><th>{escape(first)}</th>{cells}</tr>")
    return f"<table>{''.join(text)}</table>"


def _outcome(run: RecordedRun) -> str:
    if run.result is not None:
        return str(run.result.get("outcome", "no outcome")).replace("_", " ").capitalize()
    return "Error" if run.error is not None else "Cut off"


def _prose(text: str) -> str:
    """Write a cycle's sentence as people read it: it has um where µm is meant."""
    return re.sub(r"(?<=\d )um\b", "µm", text)


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and bool(np.isfinite(value))


def _um(value: Any) -> str:
    return f"{value:.2f} µm" if _is_number(value) else "–"


def _ms(value: Any, per_ms: float = 1.0) -> str:
    return f"{value / per_ms:.1f} ms" if _is_number(value) else "–"
