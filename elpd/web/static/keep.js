// Mode and presets: what the daemon keeps.

import { ask } from "./api.js";
import { $, make, say, show } from "./dom.js";
import { unasked } from "./notices.js";
import { live, mayOperate } from "./store.js";
import { MODES, um } from "./words.js";

export function mountKeep(store, { act }) {
  let wasLive = false;

  async function presets(params, button) {
    const answer = await act("preset", params, button);
    if (answer) list(answer.presets);
  }

  function list(all) {
    $("presets").replaceChildren(
      ...all.map((preset) => {
        const go = make("button", { type: "button", className: "preset-go", title: `Move to ${um(preset.position_um)} µm` }, make("span", { textContent: preset.name }), make("span", { className: "tabular", textContent: `${um(preset.position_um, 1)} µm` }));
        const drop = make("button", { type: "button", className: "plain", textContent: "Delete", ariaLabel: `Delete preset ${preset.name}` });
        go.addEventListener("click", () => presets({ action: "apply", name: preset.name }));
        drop.addEventListener("click", () => presets({ action: "delete", name: preset.name }));
        return make("li", {}, go, drop);
      }),
    );
    const chosen = $("from").value;
    $("from").replaceChildren(make("option", { value: "", textContent: "where it is" }), ...all.map(({ name }) => make("option", { value: name, textContent: name })));
    $("from").value = all.some(({ name }) => name === chosen) ? chosen : "";
    show($("from-label"), all.length > 0);
  }

  $("preset-form").addEventListener("submit", async (event) => {
    event.preventDefault();
    await presets({ action: "save", name: $("preset-name").value.trim() });
    $("preset-name").value = "";
  });
  $("modes").addEventListener("change", (event) => {
    const mode = event.target.value;
    act("mode", mode === "scheduled" ? { mode, period_s: $("period").valueAsNumber } : { mode });
  });
  $("period-form").addEventListener("submit", (event) => {
    event.preventDefault();
    act("mode", { mode: "scheduled", period_s: $("period").valueAsNumber });
  });

  store.listen((state) => {
    const now = live(state);
    if (now && !wasLive) {
      ask("presets").then((answer) => list(answer.presets), unasked);
      ask("mode").then(({ period_s: period }) => period && ($("period").value = period), () => {});
    }
    wasLive = now;
    for (const radio of document.querySelectorAll("[name=mode]")) radio.checked = radio.value === state.mode;
    show($("period-form"), state.mode === "scheduled");
    say($("mode-help"), MODES[state.mode] ?? "");
    const may = mayOperate(state);
    for (const control of document.querySelectorAll(".keep button, .keep input")) control.disabled = !may;
  });
}

/** Recording, and what a thermometer near the lens says. */
export function mountRig(store, { act }) {
  $("record-form").addEventListener("submit", async (event) => {
    event.preventDefault();
    const name = $("record-name").value.trim();
    say($("rig-echo"), "Recording…");
    const answer = await act("record", { seconds: $("record-seconds").valueAsNumber, ...(name ? { name } : {}) });
    say($("rig-echo"), answer ? `${answer.events.toLocaleString()} events in ${answer.path}` : "");
  });
  $("temperature-form").addEventListener("submit", async (event) => {
    event.preventDefault();
    const answer = await act("temperature", { celsius: $("celsius").valueAsNumber });
    if (answer) say($("rig-echo"), answer.offset_um === null ? "No table of temperatures is configured." : `${answer.celsius} °C moves focus by ${um(answer.offset_um)} µm.`);
  });
  store.listen((state) => {
    const may = mayOperate(state) && state.state === "READY";
    for (const control of document.querySelectorAll(".rig-card .forms :is(button, input)")) control.disabled = !may;
  });
}
