// The picture and the region on it. A map changes when a cycle has made one; frames and events are asked for again and
// again while they are looked at.

import { ask, command, picture } from "./api.js";
import { $, make, save, say, show } from "./dom.js";
import { speak, trouble, unasked } from "./notices.js";
import { regionEditor } from "./region.js";
import { same } from "./roi.js";
import { live, mayOperate } from "./store.js";
import { duration, um } from "./words.js";

const LIVE_MS = 250;
const SLOW_MS = 3000;
const LIVE = new Set(["frame", "events"]);
const FIELDS = ["x", "y", "width", "height"];

export function mountPicture(store) {
  let kind = "auto"; // a frame where there are any, else the map, else what the camera just saw
  let typing = false;
  let shown = null; // the facts of what is shown
  let timer = null;
  let asking = false;
  let again = false;
  let known; // the daemon's region; undefined: not asked yet
  let told; // the region in the status before
  let sent = 0; // changes of this page's; an answer to an older one than the last says nothing of the region
  let overtaken = []; // regions of this page's own that a late status may still tell of
  let named = {};
  let wasLive = false;
  let lastResult = null;
  let wasMade = false;

  const editor = regionEditor($("region"), {
    commit: (box) => setRegion(box),
    changed(box) {
      if (!typing) for (const field of FIELDS) $(`roi-${field}`).value = box ? box[field] : "";
      say($("region-summary"), box ? `Region ${text(box)}` : "Drag on the picture to choose a region; elpd chooses one otherwise.");
    },
  });

  async function refresh() {
    clearTimeout(timer);
    if (asking) {
      again = true;
      return;
    }
    if (!live(store.get()) || document.hidden) return;
    asking = true;
    try {
      const width = Math.round($("stage").clientWidth * Math.min(devicePixelRatio, 2)) || 640;
      const { blob, facts } = await picture({ kind, format: "jpeg", max_width: Math.min(Math.max(width, 16), 8192) });
      await put(blob);
      shown = facts;
      editor.set(editor.get() ?? known ?? null, facts.sensor);
      $("stage").style.aspectRatio = `${facts.sensor.width} / ${facts.sensor.height}`;
      say($("caption"), describe(facts));
      show($("no-picture"), false);
    } catch (error) {
      if (!shown) show($("no-picture"), true);
      if (error.kind !== "Busy") say($(shown ? "caption" : "no-picture"), error.message);
    } finally {
      asking = false;
    }
    const soon = again ? 0 : LIVE.has(kind) || LIVE.has(shown?.kind) ? LIVE_MS : SLOW_MS;
    again = false;
    timer = setTimeout(refresh, soon);
  }

  async function put(blob) {
    const url = URL.createObjectURL(blob);
    const image = $("image");
    const old = image.src;
    image.src = url;
    try {
      await image.decode();
    } finally {
      if (old) URL.revokeObjectURL(old);
    }
    image.alt = "What the sensor sees";
  }

  async function setRegion(box, name) {
    typing = false;
    const mine = ++sent;
    try {
      const answer = await command("roi", { set: box, ...(name ? { name } : {}) });
      if (!name && mine === sent) {
        const used = answer.roi;
        if (used !== null && !same(used, box)) echo(`Cut to the sensor: ${text(used)}.`);
        else echo("");
        speak(used === null ? "elpd chooses the region" : `Region ${text(used)}`);
      }
      takeRegions(answer, mine);
    } catch (error) {
      trouble(error.message);
      editor.set(known ?? null);
    }
  }

  function echo(text) {
    say($("roi-echo"), text);
  }

  function takeRegions(answer, asked) {
    if (asked === sent) {
      overtaken.push(known);
      known = answer.roi;
      editor.set(known);
    }
    named = answer.named;
    const options = Object.keys(named).map((name) => make("option", { value: name, textContent: name }));
    $("roi-named").replaceChildren(make("option", { value: "", textContent: options.length ? "choose…" : "none" }), ...options);
    $("roi-named").disabled = options.length === 0;
  }

  $("kinds").addEventListener("change", (event) => {
    kind = event.target.value;
    again = asking;
    refresh();
  });
  $("download").addEventListener("click", async () => {
    try {
      const { blob, facts } = await picture({ kind, format: "png16" });
      save(blob, `elpd-${facts.kind}-16bit.png`);
    } catch (error) {
      trouble(error.message);
    }
  });
  $("region-form").addEventListener("submit", (event) => {
    event.preventDefault();
    const values = FIELDS.map((field) => $(`roi-${field}`).valueAsNumber);
    if (values.some((value) => !Number.isFinite(value))) echo("Four whole numbers make a region: x, y, width, height.");
    else setRegion(Object.fromEntries(FIELDS.map((field, nth) => [field, Math.round(values[nth])])));
  });
  for (const field of FIELDS) $(`roi-${field}`).addEventListener("input", () => (typing = true));
  $("roi-clear").addEventListener("click", () => setRegion(null));
  $("roi-named").addEventListener("change", (event) => {
    const box = named[event.target.value];
    if (box) setRegion(box);
    event.target.value = "";
  });
  $("roi-save").addEventListener("click", () => {
    const [box, name] = [editor.get(), $("roi-name").value.trim()];
    if (!box) echo("There is no region to save; draw one first.");
    else if (!name) $("roi-name").focus();
    else setRegion(box, name).then(() => ($("roi-name").value = ""));
  });
  document.addEventListener("visibilitychange", refresh);

  store.listen((state) => {
    const now = live(state);
    if (now && !wasLive) {
      const before = sent;
      ask("roi").then((answer) => takeRegions(answer, before), unasked);
      refresh();
    }
    wasLive = now;
    const may = mayOperate(state);
    editor.enable(may);
    for (const control of document.querySelectorAll(".region-form :is(button, input, select)")) control.disabled = !may;
    if (may) $("roi-named").disabled = Object.keys(named).length === 0;
    $("download").disabled = !now || !shown;
    show($("kind-frame"), Boolean(state.status?.camera.has_frames));
    const region = state.status?.roi;
    const news = told === undefined ? sent === 0 : !same(region, told);
    const late = overtaken.some((one) => one !== undefined && same(one, region));
    if (region !== undefined && known !== undefined && same(region, known)) overtaken = [];
    else if (region !== undefined && known !== undefined && news && !late) {
      known = region; // somebody else set it; a status that is late says what it said before
      editor.set(known);
    }
    told = region;
    const result = state.cycle?.result ?? null;
    const mapMade = Boolean(state.cycle?.seen.includes("probe"));
    if ((result && result !== lastResult) || (mapMade && !wasMade)) refresh();
    wasMade = mapMade;
    if (result && result !== lastResult && result.outcome) speak(`${result.outcome.toLowerCase().replaceAll("_", " ")}: ${result.reason}`);
    lastResult = result;
  });
  return { giveUp: () => editor.giveUp() };
}

const text = (box) => `${box.width} × ${box.height} at ${box.x}, ${box.y}`;

const KINDS = { map: "Temporal map", frame: "Frame", events: "Events" };

function describe({ kind, sensor, age_s: age, position_um: position }) {
  const parts = [KINDS[kind] ?? kind, `${sensor.width} × ${sensor.height}`];
  if (position !== null) parts.push(`lens at ${um(position, 1)} µm`);
  if (age >= 1) parts.push(`${duration(age)} old`);
  return parts.join("  ·  ");
}
