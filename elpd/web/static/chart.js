// The curve: one line for each direction of travel, the last one strongest; where ELP crossed zero, where focus is, where
// the lens is.

import uPlot from "./vendor/uPlot.esm.js";
import { columns, crossing, ways } from "./curve.js";

const SHOWN_WAYS = 4;

const ink = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
const FONT_PX = 11;

/** A chart in `place`; `tell(text)` hears what is under the cursor. */
export function createChart(place, tell = () => {}) {
  let marks = { focus: null, lens: null, crossing: null };
  let chart = null;

  function options() {
    const colours = [ink("curve"), ink("curve-before"), ink("faint"), ink("faint")];
    const series = [{}];
    for (let nth = 0; nth < SHOWN_WAYS; nth += 1) {
      series.push({ stroke: colours[nth], width: nth === 0 ? 2 : 1.4, spanGaps: true, points: { show: false } });
      series.push({ paths: () => null, points: { show: true, size: 2.5, fill: colours[nth], stroke: colours[nth], width: 0 } });
    }
    const axis = { stroke: ink("quiet"), font: `${FONT_PX}px ${getComputedStyle(place).fontFamily}`, grid: { stroke: ink("line"), width: 1 }, ticks: { show: false } };
    return {
      width: place.clientWidth || 320,
      height: place.clientHeight || 220,
      padding: [18, 26, 0, 0],
      legend: { show: false },
      cursor: { drag: { x: false, y: false }, points: { show: false }, y: false },
      scales: { x: { time: false, range: spanX }, y: { range: spanY } },
      axes: [
        { ...axis, size: 30, gap: 4, values: (_, values) => values.map((value, nth) => (nth === values.length - 1 ? `${value} µm` : `${value}`)) },
        { ...axis, size: 44, gap: 4, values: (self, values) => values.map((value) => (self.data[0].length ? short(value) : "")) },
      ],
      series,
      hooks: {
        drawAxes: [zeroLine],
        draw: [drawMarks],
        setCursor: [(self) => tell(under(self))],
      },
    };
  }

  function spanX(_, low, high) {
    const known = [low, high, marks.focus, marks.lens].filter((value) => value !== null && Number.isFinite(value));
    if (!known.length) return [0, 100];
    const [from, to] = [Math.min(...known), Math.max(...known)];
    const room = Math.max(4, (to - from) * 0.04);
    return [from - room, to + room];
  }

  function spanY(_, low, high) {
    if (!Number.isFinite(low) || low === null) return [-1, 1];
    const [from, to] = [Math.min(low, 0), Math.max(high, 0)];
    const room = (to - from || 1) * 0.08;
    return [from - room, to + room];
  }

  function under(self) {
    const { idx } = self.cursor;
    if (idx === null || idx === undefined) return "";
    for (let nth = 1; nth < self.series.length; nth += 2) {
      const value = self.data[nth][idx];
      if (value !== null && value !== undefined) return `${self.data[0][idx].toFixed(2)} µm   ELP ${short(value)}`;
    }
    return "";
  }

  function zeroLine(self) {
    const y = Math.round(self.valToPos(0, "y", true)) + 0.5;
    stroke(self, ink("quiet"), [], (ctx) => {
      ctx.moveTo(self.bbox.left, y);
      ctx.lineTo(self.bbox.left + self.bbox.width, y);
    });
  }

  function drawMarks(self) {
    const at = (value) => Math.round(self.valToPos(value, "x", true)) + 0.5;
    const inside = (value) => value !== null && value !== undefined && Number.isFinite(value) && at(value) >= self.bbox.left - 1 && at(value) <= self.bbox.left + self.bbox.width + 1;
    const upright = (value, colour, dash, text) => {
      if (!inside(value)) return;
      stroke(self, colour, dash, (ctx) => {
        ctx.moveTo(at(value), self.bbox.top);
        ctx.lineTo(at(value), self.bbox.top + self.bbox.height);
      });
      if (text) label(self, at(value), text, colour);
    };
    if (marks.focus === null) upright(marks.crossing, ink("curve"), [4, 4], "crossing");
    else upright(marks.crossing, ink("quiet"), [3, 5], "");
    upright(marks.focus, ink("good"), [], marks.focus === null ? "" : `focus ${marks.focus.toFixed(1)}`);
    if (inside(marks.lens)) {
      const { ctx } = self;
      const size = 6 * devicePixelRatio;
      const [x, y] = [at(marks.lens), self.bbox.top + self.bbox.height];
      ctx.save();
      ctx.fillStyle = ink("ink");
      ctx.beginPath();
      ctx.moveTo(x, y - size);
      ctx.lineTo(x - size * 0.8, y + size * 0.4);
      ctx.lineTo(x + size * 0.8, y + size * 0.4);
      ctx.fill();
      ctx.restore();
    }
  }

  function label(self, x, text, colour) {
    const { ctx } = self;
    ctx.save();
    ctx.font = `500 ${FONT_PX * devicePixelRatio}px ${getComputedStyle(place).fontFamily}`;
    const width = ctx.measureText(text).width;
    const left = Math.min(Math.max(x - width / 2, self.bbox.left), self.bbox.left + self.bbox.width - width);
    ctx.fillStyle = colour;
    ctx.textAlign = "left"; // whatever the axes have left behind
    ctx.textBaseline = "bottom";
    ctx.fillText(text, left, self.bbox.top - 2);
    ctx.restore();
  }

  function rebuild() {
    const data = chart?.data ?? [[], ...Array.from({ length: 2 * SHOWN_WAYS }, () => [])];
    chart?.destroy();
    chart = new uPlot(options(), data, place);
  }

  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", rebuild);
  new ResizeObserver(() => {
    if (chart && place.clientWidth) chart.setSize({ width: place.clientWidth, height: place.clientHeight });
  }).observe(place);
  rebuild();

  return {
    /** Show samples and marks; returns where ELP crossed zero, and how many ways there are. */
    show(samples, { focus = null, lens = null } = {}) {
      marks = { focus, lens, crossing: crossing(samples) };
      const last = ways(samples).slice(-SHOWN_WAYS).reverse().map(columns);
      while (last.length < SHOWN_WAYS) last.push([[], [], []]);
      chart.setData(last.some((way) => way[0].length) ? uPlot.join(last) : [[], ...Array.from({ length: 2 * SHOWN_WAYS }, () => [])]);
      return { crossing: marks.crossing, ways: last.filter((way) => way[0].length).length };
    },
    /** Move the lens's mark alone. */
    lens(position) {
      if (marks.lens === position) return;
      marks.lens = position;
      chart.setData(chart.data);
    },
    points: () => chart.data[0].length,
  };
}

function stroke(self, colour, dash, path) {
  const { ctx } = self;
  ctx.save();
  ctx.strokeStyle = colour;
  ctx.lineWidth = devicePixelRatio;
  ctx.setLineDash(dash.map((one) => one * devicePixelRatio));
  ctx.beginPath();
  path(ctx);
  ctx.stroke();
  ctx.restore();
}

function short(value) {
  const size = Math.abs(value);
  if (size >= 1e6) return `${(value / 1e6).toFixed(size < 1e7 ? 1 : 0)}M`;
  if (size >= 1e3) return `${(value / 1e3).toFixed(size < 1e4 ? 1 : 0)}k`;
  return `${size < 10 ? Number(value.toPrecision(2)) : Math.round(value)}`;
}
