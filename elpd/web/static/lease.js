// The lease: this page keeps the rig for itself, with hands on the lens, say. It has to be renewed, so a page that is
// closed, asleep or cut off gives it back without a word. Nothing here ever stands before STOP.

import { lease } from "./api.js";
import { $, say, show } from "./dom.js";
import { trouble } from "./notices.js";
import { keeper, live } from "./store.js";
import { duration } from "./words.js";

const SPAN_S = 15;
const RENEW_MS = 5000;

export function mountLease(store) {
  let timer = null;

  async function take() {
    store.send("lease", { mine: true }); // before the answer: the status that tells of us may come first
    try {
      await lease({ action: "acquire", seconds: SPAN_S });
      timer = setInterval(renew, RENEW_MS);
    } catch (error) {
      lose(error.message);
    }
  }

  async function renew() {
    try {
      await lease({ action: "renew", seconds: SPAN_S });
    } catch (error) {
      if (error.status === 409 && store.get().lease.mine) lose(`The rig is not this page's any more: ${error.message}`);
    }
  }

  async function giveBack() {
    clearInterval(timer);
    await lease({ action: "release" }).catch((error) => trouble(error.message));
    store.send("lease", { mine: false });
  }

  function lose(message) {
    clearInterval(timer);
    store.send("lease", { mine: false });
    trouble(message);
  }

  $("lease").addEventListener("click", () => (store.get().lease.mine ? giveBack() : take()));
  window.addEventListener("pagehide", () => store.get().lease.mine && lease({ action: "release" }).catch(() => {}));

  store.listen((state) => {
    const other = live(state) ? keeper(state) : null;
    const left = state.status ? duration(state.status.lease.until_s) : "";
    const who = other && named(other, state.link);
    say($("lease"), state.lease.mine ? "Give it back" : "Keep the rig");
    $("lease").disabled = !live(state) || state.link.role === "observe" || other !== null;
    say($("lease-state"), state.lease.mine ? "This page has the rig. Others can watch and stop; elpd does nothing by itself." : other ? `${who} has it.` : "Free: whoever may operate it can.");
    show($("held"), other !== null && !state.locked);
    say($("held-title"), other ? `${who} has the rig` : "");
    say($("held-text"), other ? `Only they can move or change anything; STOP works for everybody. It ends by itself in ${left} unless they renew it.` : "");
  });
}

const named = (holder, link) => (holder.pid === link.pid ? "Another page" : `${holder.name || "A program"} (process ${holder.pid})`);
