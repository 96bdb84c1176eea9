// The trend over the runs: a dot for each that found focus, with its standard error; a tick below for each that did not.

import uPlot from "./vendor/uPlot.esm.js";
import { $, say, show } from "./dom.js";
import { MEASURES, series, summary } from "./trend.js";
import { moment } from "./words.js";

const ink = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
const FONT_PX = 11;
const FEWEST = 2;
const NEAR_PX = 24;

/** Draws into the card of the runs; `open(name)` is called for the run that is pressed. */
export function mountTrend(open) {
  const place = $("trend-plot");
  let runs = [];
  let shown = null;
  let chart = null;

  const measure = () => document.querySelector("[name=trend]:checked").value;

  function build() {
    const font = `${FONT_PX}px ${getComputedStyle(place).fontFamily}`;
    const axis = { stroke: ink("quiet"), font, grid: { stroke: ink("line"), width: 1 }, ticks: { show: false } };
    const { digits, unit } = MEASURES[measure()];
    chart?.destroy();
    chart = new uPlot(
      {
        width: place.clientWidth || 320,
        height: place.clientHeight || 150,
        padding: [12, 10, 4, 0],
        legend: { show: false },
        cursor: { drag: { x: false, y: false }, points: { show: false }, y: false },
        scales: { x: { time: false, range: (_, low, high) => [low - 0.5, high + 0.5] }, y: { range: spanY } },
        axes: [
          { show: false },
          { ...axis, size: 68, gap: 4, values: (_, values) => values.map((one, nth) => (nth === values.length - 1 ? `${one.toFixed(digits)} ${unit}` : one.toFixed(digits))) },
        ],
        series: [{}, { paths: () => null, points: { show: true, size: 6, fill: ink("good"), stroke: ink("good"), width: 0 } }],
        hooks: { draw: [drawErrors, drawFailures], setCursor: [(self) => say($("trend-readout"), under(self))] },
      },
      [shown.number, shown.good],
      place,
    );
  }

  function spanY(_, low, high) {
    if (low === null || !Number.isFinite(low)) return [0, 1];
    const known = shown.good.flatMap((one, nth) => (one === null ? [] : [one - (shown.error[nth] ?? 0), one + (shown.error[nth] ?? 0)]));
    const [from, to] = [Math.min(low, ...known), Math.max(high, ...known)];
    const room = Math.max((to - from) * 0.12, Math.abs(to) * 1e-4, 10 ** -MEASURES[measure()].digits);
    return [measure() === "rest" ? from - room : Math.max(0, from - room), to + room];
  }

  function under(self) {
    const { idx } = self.cursor;
    const run = idx === null || idx === undefined ? null : shown.runs[idx];
    if (!run) return "";
    const { of, digits, unit } = MEASURES[measure()];
    const value = shown.good[idx] === null ? (run.outcome ?? "error").replaceAll("_", " ").toLowerCase() : `${of(run).toFixed(digits)} ${unit}`;
    return `${moment(run.at)}   ${value}`;
  }

  function drawErrors(self) {
    upright(self, ink("good"), shown.error, (nth) => [shown.good[nth] - shown.error[nth], shown.good[nth] + shown.error[nth]].map((one) => self.valToPos(one, "y", true)));
  }

  function drawFailures(self) {
    const foot = self.bbox.top + self.bbox.height;
    upright(self, ink("bad"), shown.bad, () => [foot, foot - 10 * devicePixelRatio], 3);
  }

  function upright(self, colour, values, ends, width = 1) {
    const { ctx } = self;
    ctx.save();
    ctx.strokeStyle = colour;
    ctx.lineWidth = width * devicePixelRatio;
    ctx.beginPath();
    for (let nth = 0; nth < values.length; nth += 1) {
      if (values[nth] === null) continue;
      const x = self.valToPos(nth, "x", true);
      const [from, to] = ends(nth);
      ctx.moveTo(x, from);
      ctx.lineTo(x, to);
    }
    ctx.stroke();
    ctx.restore();
  }

  function draw() {
    show($("trend"), runs.length >= FEWEST);
    if (runs.length < FEWEST) return;
    shown = series(runs, measure());
    build();
    place.dataset.points = shown.good.filter((one) => one !== null).length;
    say($("trend-from"), moment(shown.runs[0].at));
    say($("trend-to"), moment(shown.runs.at(-1).at));
    const text = summary(runs, measure());
    say($("trend-summary"), shown.bad.some((one) => one !== null) ? `${text} Red: not in focus.` : text);
    place.ariaLabel = `${runs.length} runs, oldest first. ${text}`;
  }

  place.addEventListener("click", (event) => {
    const left = event.clientX - chart.over.getBoundingClientRect().left;
    const nth = chart.posToIdx(left);
    if (shown.runs[nth] && Math.abs(chart.valToPos(nth, "x") - left) < NEAR_PX) open(shown.runs[nth].name);
  });
  $("trend-of").addEventListener("change", draw);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
  new ResizeObserver(() => {
    if (chart && place.clientWidth) chart.setSize({ width: place.clientWidth, height: place.clientHeight });
  }).observe(place);

  return (now) => {
    runs = now;
    draw();
  };
}
