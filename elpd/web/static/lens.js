// The lens by hand: where it is, jog, go to, home.

import { $, say } from "./dom.js";
import { mayOperate } from "./store.js";
import { sigma, um } from "./words.js";

export function mountLens(store, { act }) {
  $("jog").addEventListener("click", (event) => {
    const button = event.target.closest("button");
    if (button) act("jog", { by_um: Number(button.value) });
  });
  $("move-form").addEventListener("submit", (event) => {
    event.preventDefault();
    act("move", { to_um: $("move-to").valueAsNumber });
  });
  $("home").addEventListener("click", () => act("home", {}));

  store.listen((state) => {
    const lens = state.status?.lens;
    const { position_um: position, moving } = state.lens;
    say($("position"), um(position));
    say($("position-sigma"), sigma(state.lens.sigma_um));
    $("position").closest(".lens").dataset.moving = moving ? "yes" : "no";
    say($("lens-state"), lens ? describe(lens, moving) : "");
    const limits = lens?.limits_um ?? null;
    say($("limit-low"), limits ? um(limits[0], 0) : "");
    say($("limit-high"), limits ? `${um(limits[1], 0)} µm` : "");
    mark($("track-lens"), position, limits);
    mark($("track-focus"), state.cycle?.result?.focus_um ?? null, limits);
    if (limits) {
      [$("move-to").min, $("move-to").max] = limits;
      ticks(limits);
    }
    const may = mayOperate(state) && state.state === "READY" && state.fault === null;
    for (const control of document.querySelectorAll(".lens button, .lens input")) control.disabled = !may;
  });
}

function describe(lens, moving) {
  if (!lens.connected) return `${lens.driver}: not connected`;
  return `${lens.driver}  ·  ${moving ? "moving" : moving === null ? "motion unknown" : "at rest"}${lens.referenced === false ? "  ·  not referenced: home it" : ""}`;
}

function mark(line, value, limits) {
  const known = value !== null && value !== undefined && limits !== null && limits[1] > limits[0];
  line.toggleAttribute("hidden", !known);
  if (!known) return;
  const x = (1000 * (value - limits[0])) / (limits[1] - limits[0]);
  for (const end of ["x1", "x2"]) line.setAttribute(end, Math.min(Math.max(x, 0), 1000).toFixed(1));
}

function ticks([low, high]) {
  const key = `${low}|${high}`;
  if ($("ticks").dataset.key === key) return;
  $("ticks").dataset.key = key;
  const step = 10 ** Math.floor(Math.log10(high - low) - 0.3);
  const lines = [];
  for (let value = Math.ceil(low / step) * step; value <= high; value += step) {
    const x = (1000 * (value - low)) / (high - low);
    const line = document.createElementNS("http://www.w3.org/2000/svg", "line");
    for (const [name, at] of Object.entries({ x1: x, x2: x, y1: 26, y2: 30 })) line.setAttribute(name, at);
    lines.push(line);
  }
  $("ticks").replaceChildren(...lines);
}
