// Wiring: the store, the stream, the parts, and STOP.

import { Refused, command, keepToken, onLocked, readToken, stream, urgent } from "./api.js";
import { $, facts, say } from "./dom.js";
import { mountFocus } from "./focus.js";
import { mountLease } from "./lease.js";
import { mountKeep, mountRig } from "./keep.js";
import { mountLens } from "./lens.js";
import { mountNotices, speak, trouble } from "./notices.js";
import { mountPicture } from "./picture.js";
import { mountRuns } from "./runs.js";
import { createStore, live, mayMove } from "./store.js";
import { follow } from "./stream.js";
import { STATES, count, duration } from "./words.js";

const store = createStore();

/** Do what was asked for; what is refused is told. Returns the answer, or null. */
async function act(method, params) {
  try {
    return await command(method, params);
  } catch (error) {
    trouble(error instanceof Refused ? error.message : String(error));
    return null;
  }
}

let stopping = 0;

async function stop() {
  stopping += 1;
  const mine = stopping;
  $("stop").dataset.is = "sent";
  say($("stop-text"), "Stopping");
  picturePart.giveUp();
  const began = performance.now();
  try {
    await urgent("stop");
    speak(`Stopped after ${Math.round(performance.now() - began)} milliseconds`);
    settle("done", "Stopped");
  } catch (error) {
    settle("failed", "Not stopped");
    trouble(`STOP did not get through: ${error.message}`, { lasting: true });
  }

  function settle(how, text) {
    if (mine !== stopping) return;
    $("stop").dataset.is = how;
    say($("stop-text"), text);
    setTimeout(() => {
      if (mine !== stopping) return;
      $("stop").dataset.is = "";
      say($("stop-text"), "Stop");
    }, 1600);
  }
}

// Press, not click: the finger's lifting is not waited for. Keyboards click.
$("stop").addEventListener("pointerdown", (event) => event.button === 0 && stop());
$("stop").addEventListener("click", (event) => event.detail === 0 && stop());

// Escape always stops. Space stops while anything may move, whatever has the focus; at rest it does what it always does
// in a field or on a button, and elsewhere it stops as well.
document.addEventListener(
  "keydown",
  (event) => {
    if (event.repeat || event.ctrlKey || event.altKey || event.metaKey) return;
    const used = event.target.closest?.("input, select, textarea, button, a, summary");
    if (event.key === "Escape" || (event.key === " " && (mayMove(store.get()) || !used))) {
      event.preventDefault();
      event.stopPropagation();
      stop();
    }
  },
  true,
);

store.listen((state) => {
  const { status, link } = state;
  say($("state"), state.locked ? "Locked" : live(state) ? (STATES[state.state] ?? "…") : "Unknown");
  $("state").dataset.state = live(state) ? (state.state ?? "") : "";
  const [how, text] = !state.stream.open ? ["off", "offline"] : link.connected ? ["on", link.role === "observe" ? "watching only" : "live"] : ["off", "no daemon"];
  $("link").dataset.link = how;
  say($("link-text"), text);
  document.body.classList.toggle("stale", !live(state));
  if (!status) return;
  const { camera, lens } = status;
  const size = camera.width ? ` ${camera.width}×${camera.height}` : "";
  say($("rig"), `${status.rig === "sim" ? "Simulated rig" : "Rig"}  ·  ${camera.driver}${size}  ·  ${lens.driver}`);
  const slowest = Object.entries(status.latency).map(([stage, { p50_us, p99_us }]) => [`${stage} p50 / p99`, `${ms(p50_us)} / ${ms(p99_us)} ms`]);
  facts($("vitals"), [
    ["events/s", camera.events_per_s === null ? null : count(camera.events_per_s)],
    ["events lost", camera.lost.toLocaleString()],
    ["backlog", camera.backlog || null],
    ["sensor", camera.temperature_c === null ? null : `${camera.temperature_c.toFixed(1)} °C`],
    ["aperture", status.aperture?.driver],
    ...slowest,
    ["cycles", `${status.counters.focused} focused, ${Object.values(status.counters.not_focused ?? {}).reduce((sum, one) => sum + one, 0)} not`],
    ["faults", status.counters.faults || null],
    ["held by", status.lease.holder ? `${status.lease.holder.name || "pid"} ${status.lease.holder.pid}, ${duration(status.lease.until_s)} more` : null],
    ["clients", status.counters.clients || null],
    ["memory", `${Math.round(status.rss_mb)} MB`],
    ["up", duration(status.uptime_s)],
    ["elpd", status.version],
  ]);
});

const ms = (us) => (us / 1000).toFixed(us < 10_000 ? 2 : 0);

const restart = (() => {
  let again = () => {};
  const unlock = (token) => {
    keepToken(token);
    store.send("locked", { locked: false });
    again();
  };
  onLocked(() => store.send("locked", { locked: true }));
  mountNotices(store, { act, unlock });
  return (begin) => (again = begin);
})();

const picturePart = mountPicture(store);
mountFocus(store, { act });
mountLens(store, { act });
mountKeep(store, { act });
mountRig(store, { act });
mountLease(store);
mountRuns(store);

if (readToken()) restart(follow(stream, store.send));
else {
  store.send("locked", { locked: true });
  restart(() => restart(follow(stream, store.send)));
}
window.addEventListener("hashchange", () => readToken() && location.reload());
