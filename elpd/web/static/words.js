// What the page says: numbers as people read them, titles for the stable words of the socket.

const DASH = "–";

export const um = (value, digits = 2) => (value === null || value === undefined ? DASH : value.toFixed(digits));
export const sigma = (value) => (value === null || value === undefined ? "" : `± ${value.toFixed(2)}`);

/** A sentence of the daemon as a person reads it: it writes um where µm is meant. */
export const prose = (text) => String(text ?? "").replaceAll(/(?<=\d\)? )um\b/g, "µm");

export function count(value) {
  if (value === null || value === undefined) return DASH;
  if (value < 1e4) return String(Math.round(value));
  const [scale, letter] = value < 1e6 ? [1e3, "k"] : value < 1e9 ? [1e6, "M"] : [1e9, "G"];
  return `${(value / scale).toPrecision(3)} ${letter}`;
}

export function duration(seconds) {
  if (seconds === null || seconds === undefined) return DASH;
  if (seconds < 60) return `${Math.round(seconds)} s`;
  if (seconds < 3600) return `${Math.round(seconds / 60)} min`;
  if (seconds < 172800) return `${(seconds / 3600).toFixed(1)} h`;
  return `${Math.round(seconds / 86400)} days`;
}

export const ms = (value) => (value === null || value === undefined ? DASH : `${Math.round(value)} ms`);

export const PHASES = ["settle_before", "expose", "choose", "probe", "sweep", "stop", "return", "verify"];
export const PHASE_NAMES = {
  settle_before: "settle", expose: "expose", choose: "choose", probe: "probe", sweep: "sweep",
  stop: "stop", recross: "recross", return: "return", verify: "verify",
};
const PHASE_TEXTS = {
  settle_before: "Waiting until everything rests",
  expose: "Opening the aperture: first events make the map",
  choose: "Choosing a region with texture",
  probe: "Setting out: which way is focus?",
  sweep: "Sweeping towards focus",
  stop: "Stopping",
  recross: "Crossing focus once more",
  return: "Going to the measured position",
  verify: "Checking that the lens is there",
};
export const phaseText = (phase) => PHASE_TEXTS[phase] ?? readable(phase);

const OUTCOMES = {
  FOCUSED: "In focus",
  NO_TEXTURE: "No texture in the region",
  NO_CROSSING: "Focus was not crossed",
  TOO_FEW_EVENTS: "Too few events",
  LOW_CONFIDENCE: "Not sure enough",
  EVENTS_LOST: "Events were lost",
  LENS_DID_NOT_MOVE: "The lens did not move",
  CANCELLED: "Cancelled",
  DEADLINE: "Out of time",
};
export const outcomeText = (outcome) => (outcome ? (OUTCOMES[outcome] ?? readable(outcome)) : "Error");

const ADVICE = [
  [/dark|dim/i, "Too dark"],
  [/flat|texture/i, "No texture"],
  [/flicker|lamp/i, "The light flickers"],
  [/saturat|full|overexpos|clip/i, "Saturated"],
  [/lost|losing|drop|backlog/i, "Events are lost"],
  [/hot/i, "Hot pixels"],
  [/nois/i, "Noisy"],
  [/latency|timer/i, "Slow serial link"],
];

/** A title for a warning's stable word; the sentence that comes with it says what to change. */
export function adviceTitle(code) {
  return ADVICE.find(([pattern]) => pattern.test(code))?.[1] ?? readable(code);
}

export const STATES = {
  STARTING: "Starting", READY: "Ready", FOCUSING: "Focusing", FAULT: "Fault", STOPPING: "Going down",
};

export const MODES = {
  "one-shot": "Focuses when asked, and then rests.",
  continuous: "Watches, and focuses again when the scene has gone out of focus.",
  scheduled: "Focuses again after the time below.",
  manual: "Only moves by hand.",
};

export function readable(word) {
  const text = String(word).replaceAll(/[_-]+/g, " ").toLowerCase();
  return text.charAt(0).toUpperCase() + text.slice(1);
}

/** When a run was, short: the time today, the date before. */
export function moment(iso, now = new Date()) {
  if (!iso) return DASH;
  const at = new Date(iso);
  const clock = { hour: "2-digit", minute: "2-digit", hourCycle: "h23" };
  if (at.toDateString() === now.toDateString()) return at.toLocaleTimeString([], { ...clock, second: "2-digit" });
  return `${at.toLocaleDateString([], { day: "numeric", month: "short" })}, ${at.toLocaleTimeString([], clock)}`;
}
