// The region of interest on the picture: drawn, dragged, resized with pointer, touch or keys. The SVG's user units are
// sensor pixels. While somebody drags, the box is theirs; when they let go it is sent, and the daemon's answer shown.

import { HANDLES, between, central, clamp, corners, grip, move, resize, same } from "./roi.js";

const REACH_PX = { mouse: 12, pen: 16, touch: 26 };
const HANDLE_PX = 9;
const KEY_STEP_PX = 8;
const KEY_REST_MS = 350;
const CURSORS = { nw: "nwse-resize", se: "nwse-resize", ne: "nesw-resize", sw: "nesw-resize", n: "ns-resize", s: "ns-resize", e: "ew-resize", w: "ew-resize" };
const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };

/** Make `svg` a region editor; `commit(box | null)` is called when a change is complete. */
export function regionEditor(svg, { commit, changed }) {
  const part = (id) => svg.querySelector(`#region-${id}`);
  const handles = Object.fromEntries(
    HANDLES.map((name) => {
      const handle = document.createElementNS("http://www.w3.org/2000/svg", "rect");
      handle.setAttribute("class", "handle");
      part("handles").append(handle);
      return [name, handle];
    }),
  );
  let sensor = { width: 1280, height: 720 };
  let box = null;
  let drag = null;
  let timer = null;
  let enabled = true;

  const scale = () => {
    const seen = svg.getBoundingClientRect();
    return [sensor.width / (seen.width || 1), sensor.height / (seen.height || 1)];
  };
  const point = (event) => {
    const seen = svg.getBoundingClientRect();
    const [sx, sy] = scale();
    return { x: (event.clientX - seen.left) * sx, y: (event.clientY - seen.top) * sy };
  };

  function draw() {
    svg.setAttribute("viewBox", `0 0 ${sensor.width} ${sensor.height}`);
    part("box").toggleAttribute("hidden", !box);
    svg.classList.toggle("has-box", Boolean(box));
    const all = `M0 0H${sensor.width}V${sensor.height}H0Z`;
    part("shade").setAttribute("d", box ? `${all}M${box.x} ${box.y}v${box.height}h${box.width}v${-box.height}Z` : "");
    svg.setAttribute("aria-label", box ? `Region ${box.width} by ${box.height} pixels at ${box.x}, ${box.y}` : "No region: elpd chooses one");
    changed(box);
    if (!box) return;
    for (const [name, value] of Object.entries(box)) part("rect").setAttribute(name, value);
    const [sx, sy] = scale();
    for (const [name, [x, y]] of Object.entries(corners(box))) {
      const [width, height] = [HANDLE_PX * sx, HANDLE_PX * sy];
      const place = { x: x - width / 2, y: y - height / 2, width, height };
      for (const [key, value] of Object.entries(place)) handles[name].setAttribute(key, value);
    }
  }

  function show(next) {
    box = next;
    draw();
  }

  svg.addEventListener("pointerdown", (event) => {
    if (!enabled || event.button !== 0 || drag) return;
    const at = point(event);
    const [sx, sy] = scale();
    const reach = REACH_PX[event.pointerType] ?? REACH_PX.mouse;
    const hold = grip(box, at, reach * sx, reach * sy);
    if (event.pointerType === "touch" && box && !hold) return; // the finger scrolls the page
    svg.setPointerCapture(event.pointerId);
    svg.focus({ preventScroll: true });
    drag = { id: event.pointerId, from: at, before: box, hold };
    event.preventDefault();
  });

  // A finger that holds the region is no gesture of the browser's. touch-action keeps it from scrolling, but Chromium still
  // lets the lift begin a fling, and the next tap, wherever it is, only ends that.
  svg.addEventListener("touchstart", (event) => drag && event.cancelable && event.preventDefault(), { passive: false });

  svg.addEventListener("pointermove", (event) => {
    const at = point(event);
    if (!drag) {
      const [sx, sy] = scale();
      const hold = enabled ? grip(box, at, REACH_PX.mouse * sx, REACH_PX.mouse * sy) : null;
      svg.style.cursor = !enabled ? "default" : hold === "inside" ? "move" : (CURSORS[hold] ?? "crosshair");
      return;
    }
    if (event.pointerId !== drag.id) return;
    const [dx, dy] = [at.x - drag.from.x, at.y - drag.from.y];
    const [sx] = scale();
    if (!drag.moved && Math.hypot(dx, dy) < 3 * sx) return; // a click is no drag
    drag.moved = true;
    if (drag.hold === "inside") show(move(drag.before, dx, dy, sensor));
    else if (drag.hold) show(resize(drag.before, drag.hold, dx, dy, sensor));
    else show(between(drag.from, at, sensor));
  });

  svg.addEventListener("pointerup", (event) => {
    if (!drag || event.pointerId !== drag.id) return;
    const { moved, before } = drag;
    drag = null;
    if (moved && !same(box, before)) commit(box);
  });

  function giveUp() {
    if (!drag) return;
    const { before } = drag;
    drag = null;
    show(before);
  }
  svg.addEventListener("pointercancel", giveUp);

  svg.addEventListener("keydown", (event) => {
    if (!enabled || event.altKey || event.metaKey) return;
    const arrow = ARROWS[event.key];
    let next;
    if (arrow) {
      const step = event.ctrlKey ? 1 : KEY_STEP_PX;
      const [dx, dy] = arrow.map((one) => one * step);
      if (!box) next = central(sensor);
      else next = event.shiftKey ? resize(box, "se", dx, dy, sensor) : move(box, dx, dy, sensor);
    } else if (event.key === "Delete" || event.key === "Backspace") next = null;
    else if (event.key === "Enter" && !box) next = central(sensor);
    else return;
    event.preventDefault();
    show(next);
    clearTimeout(timer);
    timer = setTimeout(() => {
      timer = null;
      commit(box);
    }, KEY_REST_MS);
  });

  new ResizeObserver(draw).observe(svg);
  return {
    /** The daemon's word; waits while somebody is at it. */
    set(next, size) {
      if (size) sensor = size;
      if (!drag && !timer) show(next && clamp(next, sensor));
    },
    enable(on) {
      enabled = on;
      svg.setAttribute("aria-disabled", String(!on));
      if (!on) giveUp();
    },
    giveUp,
    get: () => box,
    sensor: () => sensor,
  };
}
