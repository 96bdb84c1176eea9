// The ledger of runs: newest first, each with its curve; above it what they say together.

import { ask } from "./api.js";
import { createChart } from "./chart.js";
import { $, facts, make, save, say, show } from "./dom.js";
import { resultFacts } from "./focus.js";
import { trouble } from "./notices.js";
import { live } from "./store.js";
import { mountTrend } from "./trend-chart.js";
import { moment, outcomeText, prose, sigma, um } from "./words.js";

const MOST_RUNS = 100;

export function mountRuns(store) {
  let chart = null;
  let chosen = null;
  let opened = null;
  let wasLive = false;
  let lastResult = null;
  const trend = mountTrend(open);

  async function load() {
    try {
      const { runs } = await ask("runs", { limit: MOST_RUNS });
      say($("runs-caption"), runs.length ? "newest first" : "");
      show($("no-runs"), runs.length === 0);
      $("runs").replaceChildren(...runs.map(row));
      trend(runs);
      mark();
    } catch (error) {
      say($("runs-caption"), error.message);
    }
  }

  function row(run) {
    const button = make(
      "button", { type: "button", className: "run" },
      make("i", { className: "light", ariaHidden: "true" }),
      make("span", { className: "run-when", textContent: moment(run.at) }),
      make("span", { className: "run-what", textContent: run.outcome === "FOCUSED" ? `${um(run.focus_um, 1)} µm` : outcomeText(run.outcome) }, ...(run.outcome === "FOCUSED" ? [make("small", { textContent: sigma(run.sigma_um) })] : [])),
      make("span", { className: "run-ms tabular", textContent: run.duration_ms === null ? "" : `${Math.round(run.duration_ms)} ms` }),
    );
    button.dataset.run = run.name;
    button.dataset.good = run.outcome === "FOCUSED" ? "yes" : run.outcome === "CANCELLED" ? "" : "no";
    button.title = run.reason ?? "";
    button.addEventListener("click", () => open(run.name));
    return make("li", {}, button);
  }

  function mark() {
    for (const button of $("runs").querySelectorAll("button")) button.ariaPressed = String(button.dataset.run === chosen);
  }

  async function open(name) {
    chosen = name;
    mark();
    try {
      const run = await ask("run", { name });
      if (chosen !== name) return;
      opened = run;
      show($("run-detail"), true);
      chart ??= createChart($("run-plot"));
      const found = run.result?.focus_um ?? null;
      chart.show(run.samples, { focus: found });
      $("run-plot").ariaLabel = `The curve of run ${name}, ${run.samples.length} windows`;
      $("run-plot").dataset.points = chart.points();
      say($("run-name"), name);
      say($("run-reason"), prose(run.result?.reason ?? run.error?.message));
      facts($("run-facts"), run.result ? resultFacts(run.result) : []);
    } catch (error) {
      trouble(error.message);
    }
  }

  $("run-save").addEventListener("click", () => {
    if (opened) save(new Blob([JSON.stringify(opened, null, 1)], { type: "application/json" }), `${opened.name}.json`);
  });

  store.listen((state) => {
    const now = live(state);
    const result = state.cycle?.result ?? null;
    if ((now && !wasLive) || (result && result !== lastResult && wasLive)) load();
    if (now && result?.run && result !== lastResult) whole(result, state);
    wasLive = now;
    lastResult = result;
  });

  /** A short cycle tells only some of its windows while it runs; its record has them all. */
  async function whole(result, state) {
    try {
      const { samples } = await ask("run", { name: result.run });
      const now = store.get();
      if (now.cycle?.result === result && samples.length > state.samples.length) store.send("curve", { samples });
    } catch {
      // without a record there is only what was told
    }
  }
}
