// Node's own test runner over the page's pure modules; `tests/browser/test_modules.py` runs it.

import assert from "node:assert/strict";
import { test } from "node:test";

const from = (name) => import(`${process.env.ELPD_STATIC}/${name}.js`);
const roi = await from("roi");
const curve = await from("curve");
const store = await from("store");
const { parse } = await from("stream");
const trend = await from("trend");
const words = await from("words");

const SENSOR = { width: 1280, height: 720 };
const random = (() => {
  let seed = 1;
  return (low, high) => {
    seed = (seed * 48271) % 2147483647;
    return low + (seed / 2147483647) * (high - low);
  };
})();

function inside(box) {
  for (const value of Object.values(box)) assert.ok(Number.isInteger(value), JSON.stringify(box));
  assert.ok(box.x >= 0 && box.y >= 0 && box.width >= roi.SMALLEST && box.height >= roi.SMALLEST, JSON.stringify(box));
  assert.ok(box.x + box.width <= SENSOR.width && box.y + box.height <= SENSOR.height, JSON.stringify(box));
}

test("whatever is dragged wherever, the region lies inside the sensor", () => {
  for (let nth = 0; nth < 2000; nth += 1) {
    const point = () => ({ x: random(-3000, 3000), y: random(-3000, 3000) });
    const box = roi.between(point(), point(), SENSOR);
    inside(box);
    inside(roi.move(box, random(-3000, 3000), random(-3000, 3000), SENSOR));
    const handle = roi.HANDLES[Math.floor(random(0, 8))];
    inside(roi.resize(box, handle, random(-3000, 3000), random(-3000, 3000), SENSOR));
    inside(roi.clamp({ ...point(), width: random(-100, 9000), height: random(-100, 9000) }, SENSOR));
  }
});

test("moving keeps the size, resizing keeps the opposite corner", () => {
  const box = { x: 400, y: 200, width: 300, height: 200 };
  assert.deepEqual(roi.move(box, 10000, -10000, SENSOR), { x: 980, y: 0, width: 300, height: 200 });
  assert.deepEqual(roi.resize(box, "nw", -50, 20, SENSOR), { x: 350, y: 220, width: 350, height: 180 });
  assert.deepEqual(roi.resize(box, "e", -1000, 999, SENSOR), { x: 400, y: 200, width: roi.SMALLEST, height: 200 });
  assert.deepEqual(roi.between({ x: 50, y: 60 }, { x: 20, y: 10 }, SENSOR), { x: 20, y: 10, width: 30, height: 50 });
});

test("a press takes the nearest handle, else the inside, else nothing", () => {
  const box = { x: 400, y: 200, width: 300, height: 200 };
  const at = (x, y) => roi.grip(box, { x, y }, 12, 12);
  assert.equal(at(404, 197), "nw");
  assert.equal(at(699, 300), "e");
  assert.equal(at(550, 300), "inside");
  assert.equal(at(380, 300), null);
  assert.equal(roi.grip(null, { x: 1, y: 1 }, 12, 12), null);
});

/** A probe the wrong way, the sweep, and the way back; ELP crosses at `focus`. */
function cycle(focus = 1560) {
  const elp = (um, sign) => -sign * 500 * (um - focus);
  const rows = [];
  for (let um = 1358; um > 1350; um -= 0.9) rows.push([um, elp(um, -1), 0, rows.length]);
  for (let um = 1350; um < 1612; um += 1.2) rows.push([um, elp(um, 1), 0, rows.length]);
  return rows;
}

test("samples part into one way for each direction of travel", () => {
  const still = Array.from({ length: 20 }, (_, nth) => [1358, 0, 0, nth]);
  const found = curve.ways([...still, ...cycle()]);
  assert.equal(found.length, 2);
  assert.ok(found[0].at(-1)[0] < 1351 && found[1].at(-1)[0] > 1600);
  for (const way of found) {
    const [positions, smoothed, measured] = curve.columns(way);
    assert.ok(positions.every((um, nth) => nth === 0 || um > positions[nth - 1]));
    assert.equal(smoothed.length, positions.length);
    assert.equal(measured.length, positions.length);
  }
});

test("a step back smaller than a window's travel is no turn", () => {
  const rows = Array.from({ length: 50 }, (_, nth) => [nth * 2 - (nth % 7 === 6 ? 3 : 0), 1, 0, nth]);
  assert.equal(curve.ways(rows).length, 1);
});

test("the crossing is where the smoothed curve of the last way falls through zero, and nowhere else", () => {
  const found = curve.crossing(cycle(1560));
  assert.ok(Math.abs(found - 1560) < 1, String(found));
  assert.equal(curve.crossing(cycle(1700)), null); // not reached
  assert.equal(curve.crossing(cycle(1300)), null); // behind all the time: never rises
  assert.equal(curve.crossing([]), null);
  assert.equal(curve.crossing([[null, 3, 0, 0], [1, 2, 0, 1]]), null);
});

test("events are taken whole however they are cut", () => {
  const text = 'id: ab.1\nevent: phase\ndata: {"phase":"probe"}\n\n: still here\n\nevent: link\ndata: {"connected":true}\n\nid: ab.2\nevent: sam';
  for (let cut = 0; cut <= text.length; cut += 1) {
    const first = parse(text.slice(0, cut));
    const second = parse(first.rest + text.slice(cut));
    assert.deepEqual([...first.events, ...second.events], [
      { kind: "phase", id: "ab.1", data: { phase: "probe" } },
      { kind: "link", id: null, data: { connected: true } },
    ]);
    assert.equal(second.rest, "id: ab.2\nevent: sam");
  }
});

test("a cycle goes from its first phase to its result, and the next begins anew", () => {
  let state = store.initial();
  const send = (kind, fields) => (state = store.take(state, kind, fields));
  send("phase", { phase: "probe" });
  send("sample", { position_um: 1, elp: 2, score: 3, t_us: 4 });
  send("phase", { phase: "sweep", progress: 0.5 });
  assert.deepEqual([state.cycle.seen, state.cycle.phase, state.cycle.progress], [["probe", "sweep"], "sweep", 0.5]);
  send("result", { outcome: "FOCUSED" });
  send("phase", { phase: "done" });
  assert.equal(state.cycle.result.outcome, "FOCUSED");
  assert.deepEqual(state.samples, [[1, 2, 3, 4]]);
  send("phase", { phase: "expose" });
  assert.deepEqual([state.cycle.seen, state.cycle.result, state.samples], [["expose"], null, []]);
  send("a message of the year 3000", {});
  send("fault", { kind: "LensError", message: "gone" });
  assert.equal(state.fault.message, "gone");
  send("fault", { kind: null });
  assert.equal(state.fault, null);
});

test("what is not known counts as motion", () => {
  let state = store.initial();
  assert.ok(store.mayMove(state));
  state = store.take(state, "stream", { open: true });
  state = store.take(state, "link", { connected: true });
  state = store.take(state, "state", { state: "READY", mode: "one-shot" });
  assert.ok(store.mayMove(state), "the lens has not been heard of");
  state = store.take(state, "position", { position_um: 5, moving: false });
  assert.ok(!store.mayMove(state));
  assert.ok(store.mayMove(store.take(state, "position", { position_um: 5, moving: null })));
  assert.ok(store.mayMove(store.take(state, "link", { connected: false })));
});

test("listeners hear of the newest state once for many messages", () => {
  const frames = [];
  const made = store.createStore((frame) => frames.push(frame));
  const heard = [];
  made.listen((state) => heard.push(state.mode));
  made.send("state", { state: "READY", mode: "manual" });
  made.send("state", { state: "READY", mode: "scheduled" });
  assert.equal(frames.length, 1);
  frames[0]();
  assert.deepEqual(heard, [null, "scheduled"]);
});

test("numbers read well, and what is not known is a dash", () => {
  assert.equal(words.count(812_000), "812 k");
  assert.equal(words.count(12), "12");
  assert.equal(words.um(null), "–");
  assert.equal(words.duration(4210), "1.2 h");
  assert.equal(words.adviceTitle("losing-events"), "Events are lost");
  assert.equal(words.adviceTitle("map-not-kept"), "Map not kept");
  assert.equal(words.outcomeText("NO_TEXTURE"), "No texture in the region");
});

const RUNS = [
  { outcome: "FOCUSED", final_um: 1560.4, focus_um: 1560.9, sigma_um: 1.1, duration_ms: 260 },
  { outcome: "NO_CROSSING", final_um: 1300, focus_um: null, sigma_um: null, duration_ms: 600 },
  { outcome: "CANCELLED", final_um: 1400, focus_um: null, sigma_um: null, duration_ms: 90 },
  { outcome: null, final_um: null, focus_um: null, sigma_um: null, duration_ms: null },
  { outcome: "FOCUSED", final_um: null, focus_um: 1558.0, sigma_um: 0.9, duration_ms: 240 },
];

test("a trend goes from the oldest run to the newest, and only focus has a place", () => {
  const shown = trend.series(RUNS, "rest");
  assert.deepEqual(shown.good, [1558.0, null, null, null, 1560.4]);
  assert.deepEqual(shown.error, [0.9, null, null, null, 1.1]);
  assert.deepEqual(shown.bad, [null, 0, null, 0, null]); // a cancelled run is no failure
  assert.deepEqual(trend.series(RUNS, "took").good, [240, null, null, null, 260]);
  assert.deepEqual(trend.series(RUNS, "took").error, [null, null, null, null, null]);
});

test("a trend is told in words", () => {
  assert.equal(trend.summary(RUNS, "rest"), "2 of 4 in focus; at rest 1559.2 µm (median), 1558.0 to 1560.4.");
  assert.equal(trend.summary(RUNS, "took"), "2 of 4 in focus; took 250 ms (median), 240 to 260.");
  assert.equal(trend.summary(RUNS.slice(1, 2), "sigma"), "0 of 1 in focus.");
  assert.equal(trend.summary(RUNS.slice(2, 3), "rest"), "All of these runs were cancelled.");
  assert.equal(trend.median([]), null);
});
