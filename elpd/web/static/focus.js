// The cycle: its button, its phases as they pass, how it ended, and the curve.

import { urgent } from "./api.js";
import { createChart } from "./chart.js";
import { $, facts, make, say, show } from "./dom.js";
import { trouble } from "./notices.js";
import { mayOperate } from "./store.js";
import { PHASES, PHASE_NAMES, ms, outcomeText, phaseText, prose, sigma, um } from "./words.js";

export function mountFocus(store, { act }) {
  const chart = createChart($("plot"), (text) => say($("readout"), text));
  const steps = Object.fromEntries(
    PHASES.map((phase) => {
      const step = make("li", {}, make("i"), make("span", { textContent: PHASE_NAMES[phase] }));
      $("phases").append(step);
      return [phase, step];
    }),
  );
  let drawn = "";

  $("focus").addEventListener("click", () => {
    const preset = $("from").value;
    act("focus", {
      ...($("reference").checked ? { reference: "last" } : {}),
      ...($("dry-run").checked ? { dry_run: true } : {}),
      ...(preset ? { preset } : {}),
    });
  });
  $("cancel").addEventListener("click", () => urgent("cancel").catch((error) => trouble(error.message)));

  store.listen((state) => {
    const running = state.state === "FOCUSING" || Boolean(state.cycle && !state.cycle.result && state.cycle.phase);
    const may = mayOperate(state);
    $("focus").disabled = !may || running || state.fault !== null || state.state !== "READY";
    say($("focus"), running ? "Focusing…" : $("dry-run").checked ? "Try without moving" : "Focus");
    $("focus").dataset.busy = running ? "yes" : "";
    show($("cancel"), running);
    phases(state, steps);
    result(state.cycle?.result ?? null);

    const found = state.cycle?.result?.focus_um ?? null;
    const lens = state.lens.position_um;
    const key = `${state.samples.length}|${found}|${state.samples[0]?.[3]}`;
    if (key !== drawn) {
      drawn = key;
      const drawing = chart.show(state.samples, { focus: found, lens });
      $("plot").dataset.points = chart.points();
      legend({ curve: drawing.ways > 0, before: drawing.ways > 1, crossing: drawing.crossing !== null, focus: found !== null, lens: drawing.ways > 0 && lens !== null });
      if (state.samples.length) say($("curve-summary"), summary(drawing.crossing, found, state.samples.length));
    } else chart.lens(lens);
  });
  $("dry-run").addEventListener("change", () => store.send("", {}));
  return chart;
}

/** Name what is drawn, and nothing else. */
function legend(drawn) {
  show($("no-curve"), !drawn.curve);
  show($("legend"), drawn.curve);
  for (const item of $("legend").children) show(item, drawn[item.dataset.of]);
}

function summary(crossed, found, windows) {
  const parts = [`${windows} windows`];
  if (crossed !== null) parts.push(`ELP crossed zero at ${um(crossed, 1)} µm`);
  if (found !== null) parts.push(`focus measured at ${um(found, 1)} µm`);
  return `${parts.join(" · ")}.`;
}

function phases(state, steps) {
  const { cycle } = state;
  const durations = Object.fromEntries((cycle?.result?.phases ?? []).map((one) => [one.name, one.ms]));
  for (const [phase, step] of Object.entries(steps)) {
    const now = cycle?.phase === phase;
    const done = !now && Boolean(cycle?.seen.includes(phase) || phase in durations);
    step.dataset.is = now ? "now" : done ? "done" : "";
    step.firstChild.style.setProperty("--share", now && cycle.progress !== null ? cycle.progress : now ? 0.5 : 1);
    if (now) step.setAttribute("aria-current", "step");
    else step.removeAttribute("aria-current");
    step.title = phase in durations ? `${phaseText(phase)}: ${ms(durations[phase])}` : phaseText(phase);
  }
  say($("phase-now"), cycle?.phase ? `${phaseText(cycle.phase)}${cycle.progress === null ? "" : ` (${Math.round(100 * cycle.progress)} %)`}` : "");
}

function result(ended) {
  show($("result"), ended !== null);
  if (!ended) return;
  $("result").dataset.good = ended.outcome === "FOCUSED" ? "yes" : ended.outcome === "CANCELLED" ? "" : "no";
  say($("outcome"), outcomeText(ended.outcome));
  show($("found").parentElement, ended.focus_um !== null);
  say($("found"), um(ended.focus_um));
  say($("found-sigma"), sigma(ended.sigma_um));
  say($("reason"), prose(ended.reason));
  const remarks = ended.warnings ?? [];
  if ($("remarks").dataset.key !== JSON.stringify(remarks)) {
    $("remarks").dataset.key = JSON.stringify(remarks);
    $("remarks").replaceChildren(...remarks.map((text) => make("li", { textContent: prose(text) })));
  }
  facts($("result-facts"), resultFacts(ended));
}

export function resultFacts(ended) {
  return [
    ["rests at", ended.final_um === null ? null : `${um(ended.final_um)} µm`],
    ["took", ms(ended.duration_ms)],
    ["stopped after", ended.stop_latency_us === null ? null : `${(ended.stop_latency_us / 1000).toFixed(1)} ms`],
    ["reversals", String(ended.reversals)],
    ["events", ended.events.toLocaleString()],
    ["lost", ended.lost ? ended.lost.toLocaleString() : null],
    ["true error (sim)", ended.truth?.final_error_um === undefined || ended.truth?.final_error_um === null ? null : `${um(ended.truth.final_error_um)} µm`],
  ];
}
