// What must not be missed: a latched fault, a connection that is away, what a command met, what the person should change.

import { $, make, say, show } from "./dom.js";
import { mayOperate } from "./store.js";
import { adviceTitle, prose, readable } from "./words.js";

const SHOWN_MS = 9000;

/** Tell of a command that failed; stays until it is dismissed if it concerns STOP. */
export function trouble(message, { lasting = false } = {}) {
  const close = make("button", { type: "button", className: "plain", textContent: "Dismiss" });
  const note = make("div", { className: "trouble" }, make("p", { textContent: prose(message) }), close);
  close.addEventListener("click", () => note.remove());
  const old = $("trouble").children;
  while (old.length >= 3) old[0].remove();
  $("trouble").append(note);
  if (!lasting) setTimeout(() => note.remove(), SHOWN_MS);
}

const AWAY = new Set(["Offline", "Unreachable"]);

/** Tell of a question that the page asked by itself. That the daemon is away is told where it belongs; the page asks again. */
export const unasked = (error) => AWAY.has(error.kind) || trouble(error.message);

/** For those who do not see the page. */
export const speak = (text) => say($("spoken"), prose(text));

export function mountNotices(store, { act, unlock }) {
  $("clear").addEventListener("click", () => act("clear", {}, $("clear")));
  $("token-form").addEventListener("submit", (event) => {
    event.preventDefault();
    unlock($("token").value.trim());
    $("token").value = "";
  });

  let wasLocked = false;
  store.listen((state) => {
    show($("locked"), state.locked);
    if (state.locked && !wasLocked) $("token").focus();
    wasLocked = state.locked;

    show($("fault"), state.fault !== null);
    say($("fault-title"), state.fault ? `Fault: ${readable(faultWord(state.fault.kind))}` : "");
    say($("fault-text"), prose(state.fault?.message));
    $("clear").disabled = !mayOperate(state);

    const [title, text] = away(state);
    show($("offline"), Boolean(title) && !state.locked);
    say($("offline-title"), title);
    say($("offline-text"), text);
    advise(state);
  });
}

const faultWord = (kind) => kind.replaceAll(/([a-z])([A-Z])/g, "$1 $2").replace(/ Error$/, "");

function away({ stream, link }) {
  if (!stream.open && stream.reason !== "connecting") return ["The page is cut off", `${stream.reason} Trying again. What is shown is old; STOP is still sent.`];
  if (stream.open && !link.connected && link.reason !== "not asked yet") return ["The daemon is away", `${link.reason}. Trying again.`];
  return ["", ""];
}

/** Warnings of the rig as it is, of the last cycle, and of this tab's own losses. */
function advise(state) {
  const warnings = (state.status?.warnings ?? []).map(({ code, text }) => [adviceTitle(code), text]);
  if (state.dropped > 0) warnings.push(["This page is too slow", `${state.dropped} samples were not shown; close other tabs.`]);
  const lost = state.status?.camera.lost ?? 0;
  if (lost > 0 && !warnings.some(([title]) => title === "Events are lost"))
    warnings.push(["Events are lost", `The camera has lost ${lost} events since the daemon began: a smaller region, less light or fewer events by its biases help.`]);
  const list = $("advice");
  const key = JSON.stringify(warnings);
  show($("warnings"), warnings.length > 0);
  if (list.dataset.key === key) return;
  list.dataset.key = key;
  list.replaceChildren(...warnings.map(([title, text]) => make("li", {}, make("strong", { textContent: title }), make("span", { textContent: prose(text) }))));
}
