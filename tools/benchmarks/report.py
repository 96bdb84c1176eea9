"""The report: one HTML file that holds its tables, plots and words, and refers to nothing.

It says first what the numbers are and are not: which methods saw the future, which were allowed a tuned offset, and
what a mean leaves out.
"""

from __future__ import annotations

from collections import Counter
from html import escape
from typing import TYPE_CHECKING, Any

from benchmarks.calibration import BEYOND_TWO_SIGMA, draw_calibration
from benchmarks.figures import curves, errors, per_method
from benchmarks.methods import CYCLE, OURS, all_methods
from benchmarks.sets import SETS
from benchmarks.verdict import MET, NOT_MET, UNMEASURED, measured

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from benchmarks.calibration import Calibration
    from benchmarks.rows import Row
    from benchmarks.scoring import Score
    from benchmarks.sets import CaseSet
    from benchmarks.verdict import Verdict

COLUMNS = {
    "cases": "cases",
    "MAE um": "mae_um",
    "paper MAE": "published_um",
    "rerun MAE": "rerun_um",
    "bias": "bias_um",
    "worst": "worst_um",
    "limit": "limit_um",
    "missed": "missed",
    "outside": "outside",
    "early": "early",
    "wrong way": "wrong_way",
    "rms err/σ": "spread",
    "beyond 2σ": "beyond_two",
    "to focus ms": "focusing_ms",
    "paper to focus ms": "published_focusing_ms",
    "crossed again": "crossed_again",
    "of it ms": "again_ms",
    "decided um": "decided_um",
    "to sharpest": "to_sharpest_um",
    "CPU ms": "cpu_ms",
    "paper run ms": "published_cpu_ms",
}
COUNTS_OF_TROUBLE = ("missed", "outside", "early", "wrong_way")
SIGNED = ("bias_um", "decided_um")
BAD = " class='bad'"

STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; margin: 2rem auto; max-width: 1900px; padding: 0 1rem; color: #111 }
p { max-width: 75rem }
table { border-collapse: collapse; margin: .6rem 0 1.6rem; font-size: 13px; font-variant-numeric: tabular-nums }
th, td { border-bottom: 1px solid #ddd; padding: .2rem .55rem; text-align: right; white-space: nowrap }
th { background: #f4f4f4; position: sticky; top: 0 } td.word, th.word { text-align: left }
tr.ours td { background: #eef6ff } td.bad { color: #b00020; font-weight: 600 }
.plots { display: flex; flex-wrap: wrap; gap: 1rem } .scroll { overflow-x: auto }
td.so { color: #7a5c00 } td.long { white-space: normal; min-width: 15rem }
td, th { vertical-align: top }
svg text { font-family: system-ui, sans-serif; font-size: 13px } svg .small { font-size: 11px; fill: #333 }
svg .title { font-weight: 600 } svg .frame { fill: none; stroke: #888 } svg .grid { stroke: #e8e8e8 }
svg .mark { stroke: #888; stroke-dasharray: 4 3 } summary { cursor: pointer; font-weight: 600; margin: .8rem 0 }
"""

WORDS = """
<p>One sweep per case; truth is the plane of least RMS spot radius. <b>Error</b> is estimate less truth. A mean over
answered cases says nothing about the others: <b>missed</b> counts cases without an answer, <b>outside</b> answers more
than one depth of focus off, <b>early</b> decisions more than that before focus, <b>wrong way</b> those that took the
approach for receding. Where there is nothing to focus on, every answer is outside. <b>Decided</b> is how far past
focus the lens was when the answer could first be given as it stands, the median: a method that looks at the whole
stack decides at its end, whatever it says about the past. <b>To focus</b> is the median time from the start of the
sweep until the lens could be back at the estimate, without braking. <b>elpd</b> and the peers see one recorded pass.
<b>A whole cycle</b> is our controller in charge of the lens on the same case: the same scene, motion, lens and sensor,
which has been looking since before the sweep; it crosses focus again where its own rule finds one pass not enough
(<b>crossed again</b>, of <b>to focus</b> so much). Its error is where the glass rests, its time ends when focus is
verified. <b>To sharpest</b> is the MAE against the place
where the noise-free picture has its highest contrast: off the axis it is not where the spot is smallest, and a method
that looks at pictures can hardly do better than their distance, unless it tells the directions of edges apart.
<b>Limit</b> is the median standard deviation that the
signs of the events around focus, held against a perfect picture, would leave at best (a Cramér-Rao-like bound,
tools/benchmarks/limit.py): a method may beat it only by using more of an event than its sign, and a bias is not in it.
<b>CPU</b> is the median processor time of the method for the whole sweep, in this implementation.</p>
<p><b>Paper</b> is the paper's MAE on its own 84 cases or its own rig, for ELP an estimate made in hindsight with a
built-in offset, and its times there, for ELP without aperture, braking and settling; <b>rerun</b> what a later
paper's authors found when they ran it. The cases here follow the paper's text; its pictures, lens and noise are not
public, so the columns stand beside each other and are not the same measurement.</p>
"""


def write_report(
    path: Path,
    rows: Sequence[Row],
    table: Sequence[Score],
    goals: Sequence[Verdict],
    truth: Sequence[Calibration],
    settings: dict[str, Any],
) -> None:
    """Write the report to *path*."""
    told = ", ".join(
        f"{key} {' '.join(map(str, value)) if isinstance(value, list) else value}" for key, value in settings.items()
    )
    body = [f"<h1>Autofocus benchmark</h1><p>{escape(told)}</p>", _goals(goals), _calibration(rows, truth), WORDS]
    for set_name in dict.fromkeys(score.set_name for score in table):
        chosen = SETS[set_name]
        body.append(f"<h2>{escape(set_name)}: {escape(chosen.about)}</h2><p>{_setting(chosen)}</p>")
        own_rows = [row for row in rows if row.set_name == set_name]
        own_scores = [score for score in table if score.set_name == set_name]
        motions = list(dict.fromkeys(score.motion for score in own_scores))
        body.append(_overview(own_scores, motions))
        for motion in motions:
            body.append(f"<h3>{escape(motion)}</h3>")
            body.append(_score_table([score for score in own_scores if score.motion == motion]))
        body.append("<h3>How errors are distributed</h3><div class='plots'>")
        for motion in motions:
            body.extend(errors([row for row in own_rows if row.motion == motion], motion))
        body.extend(draw_calibration(own_rows, "|error|/σ", method) for method in _asked(own_rows))
        body.append(
            f"</div>{per_method(own_rows)}<h3>ELP as published, filtered, over the sweep</h3><div class='plots'>"
        )
        body.extend(curves(own_rows, motions))
        body.append("</div>")
        body.append(_case_table(own_rows))
    page = (
        "<!doctype html><html lang='en'><head><meta charset='utf-8'><title>Autofocus benchmark</title>"
        f"<style>{STYLE}</style></head><body>{''.join(body)}</body></html>\n"
    )
    path.write_text(page, encoding="utf-8")


def _goals(goals: Sequence[Verdict]) -> str:
    """Return the table of goals: what was asked, by whom it was measured, the verdict, what others have."""
    told = (
        "Computed from the rows of this run. “One pass, recorded” are estimates of the causal detector, “whole cycles” "
        "where the glass came to rest on the same cases, crossed again where the controller chose to; cycles of the "
        "simulated rig are named by their file. An answer that was refused has no error: it is counted apart."
    )
    counts = Counter(one.verdict for one in goals)
    told += " Verdicts: " + ", ".join(f"{count} {verdict}" for verdict, count in counts.items()) + "."
    heads = ("goal", "measured on", "verdict", "trials", "measured", "beside")
    names = "".join(f"<th class='word'>{head}</th>" for head in heads)
    lines = [f"<h2>Goals</h2><p>{told}</p><div class='scroll'><table><tr>{names}</tr>"]
    before = ""
    for one in goals:
        kind = "word" if one.verdict in (MET, UNMEASURED) else "word bad" if one.verdict == NOT_MET else "word so"
        found = measured(one) if one.trials else "–"
        # One goal's lines stand together, and say once what it is.
        same, before = one.goal == before, one.goal
        lines.append(f"<tr><td class='word long'>{'' if same else escape(one.goal)}</td>")
        lines.append(f"<td class='word'>{escape(one.source)}</td><td class='{kind}'>{one.verdict}</td>")
        lines.append(f"<td class='word'>{one.trials} of {one.wanted}</td>")
        lines.extend(f"<td class='word long'>{escape(word)}</td>" for word in (found, one.beside))
        lines.append("</tr>")
    return "".join(lines) + "</table></div>"


def _calibration(rows: Sequence[Row], truth: Sequence[Calibration]) -> str:
    """Return how true our standard errors are: the quantile plot over all sets, and numbers for each."""
    if not truth:
        return ""
    told = f"By set, motion and frame rate: RMS of error/σ (true: 1), share beyond 2σ (normal: {BEYOND_TWO_SIGMA:.1%})"
    lines = [
        "<h2>Is the claimed standard error true?</h2><div class='plots'>",
        *(draw_calibration(rows, "All sets", method) for method in _asked(rows)),
        f"</div><details><summary>{told}</summary><table><tr><th class='word'>answers of</th>",
        "<th>answers</th><th>rms err/σ</th><th>beyond 2σ</th></tr>",
    ]
    for one in truth:
        lines.append(f"<tr><td class='word'>{escape(one.name)}</td><td>{one.answers}</td>")
        lines.append(f"<td>{one.rms:.2f}</td><td>{one.beyond_two:.1%}</td></tr>")
    return "".join(lines) + "</table></details>"


def _setting(chosen: CaseSet) -> str:
    sensor = chosen.retina
    travel_um = chosen.um_per_us * chosen.exposure_us
    exposed = f", frames exposed for {chosen.exposure_us / 1e3:g} ms ({travel_um:g} um)" if chosen.exposure_us else ""
    return (
        f"From {chosen.start_um:g} to {-chosen.start_um:g} um at {chosen.speed_um_s / 1e3:g} um/ms, depth of focus "
        f"{chosen.depth_of_focus_um:g} um, {chosen.size_px} x {chosen.size_px} pixels, thresholds {sensor.pos_thres:g} "
        f"± {sensor.sigma_thres:g}, photoreceptor {sensor.cutoff_hz:g} Hz, shot noise {sensor.shot_noise_rate_hz:g} Hz "
        f"a pixel, a pixel of motion is {chosen.motion_px:.2g} of the sensor's{exposed}."
    )


def _overview(table: Sequence[Score], motions: Sequence[str]) -> str:
    """Return the paper's kind of table: a line per method and frame rate, MAE per motion, its number in brackets."""
    methods = all_methods()
    heads = "".join(f"<th>{escape(motion)}</th>" for motion in motions)
    told = "MAE um; in brackets the paper's where it has one; +n cases without an answer, !n wrong answers"
    lines = [f"<h3>{told}</h3><div class='scroll'><table>"]
    lines.append(f"<tr><th class='word'>method</th><th class='word'>fps</th>{heads}</tr>")
    by_pair: dict[tuple[str, str], dict[str, Score]] = {}
    for score in table:
        by_pair.setdefault((score.method, score.rate), {})[score.motion] = score
    for (name, rate), found in by_pair.items():
        lines.append(
            f"<tr{' class=ours' if name in (OURS, CYCLE) else ''}><td class='word'>{escape(methods[name].title)}</td>"
        )
        lines.append(f"<td class='word'>{rate}</td>")
        lines.extend(f"<td>{_overview_cell(found[one]) if one in found else ''}</td>" for one in motions)
        lines.append("</tr>")
    return "".join(lines) + "</table></div>"


def _overview_cell(score: Score) -> str:
    published = "" if score.published_um is None else f" ({score.published_um:.2f})"
    missed = f" +{score.missed}" if score.missed else ""
    outside = f" <b>!{score.outside}</b>" if score.outside else ""
    return f"{_number(score.mae_um)}{published}{missed}{outside}"


def _score_table(table: Sequence[Score]) -> str:
    methods = all_methods()
    words = "".join(f"<th class='word'>{head}</th>" for head in ("method", "fps", "sees"))
    numbers = "".join(f"<th>{head}</th>" for head in COLUMNS)
    lines = [f"<div class='scroll'><table><tr>{words}{numbers}</tr>"]
    for score in table:
        method = methods[score.method]
        told = "".join(f"<td class='word'>{escape(word)}</td>" for word in (method.title, score.rate, method.sees))
        cells = ""
        for name in COLUMNS.values():
            value = getattr(score, name)
            cells += f"<td{BAD if value and name in COUNTS_OF_TROUBLE else ''}>{_cell(value, name)}</td>"
        lines.append(f"<tr{' class=ours' if score.method in (OURS, CYCLE) else ''}>{told}{cells}</tr>")
    return "".join(lines) + "</table></div>"


def _cell(value: float | None, name: str) -> str:
    return str(value) if isinstance(value, int) else _number(value, signed=name in SIGNED)


def _case_table(rows: Sequence[Row]) -> str:
    """Return every case's errors: a line per case, a column per method and frame rate."""
    pairs = list(dict.fromkeys((row.method, row.rate) for row in rows))
    by_case: dict[tuple[str, int], dict[tuple[str, str], Row]] = {}
    for row in rows:
        by_case.setdefault((row.case, row.seed), {})[row.method, row.rate] = row
    heads = "".join(f"<th>{escape(method)}<br>{rate}</th>" for method, rate in pairs)
    lines = [
        "<details><summary>Every case: error in um, “/” where there was no answer (its reason on hover)</summary>",
        "<div class='scroll'><table><tr><th class='word'>case</th><th>seed</th><th>events</th><th>limit</th>",
        f"{heads}</tr>",
    ]
    for (case, seed), found in by_case.items():
        any_row = next(iter(found.values()))
        lines.append(f"<tr><td class='word'>{escape(case)}</td><td>{seed}</td><td>{any_row.events}</td>")
        lines.append(f"<td>{_number(any_row.limit_um)}</td>")
        for pair in pairs:
            row = found.get(pair)
            if row is None:
                lines.append("<td></td>")
            elif row.error_um is None:
                lines.append(f"<td title='{escape(row.reason, quote=True)}'>/</td>")
            else:
                bad = BAD if abs(row.error_um) > SETS[row.set_name].depth_of_focus_um else ""
                lines.append(f"<td{bad}>{row.error_um:+.2f}</td>")
        lines.append("</tr>")
    return "".join(lines) + "</table></div></details>"


def _asked(rows: Sequence[Row]) -> list[str]:
    """Return which of ours there are."""
    return [method for method in (OURS, CYCLE) if any(row.method == method for row in rows)]


def _number(value: float | None, *, signed: bool = False) -> str:
    if value is None:
        return "–"
    return f"{value:+.2f}" if signed else f"{value:.2f}"
