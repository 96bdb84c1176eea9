// Requests to the gateway. The token comes in the address's fragment, which is never sent, and stays in this tab.
//
// A browser keeps six connections to a server at most, over all tabs. So a tab has two commands and one question under
// way at a time; STOP always finds a connection free.

const KEY = "elpd-token";
const TAB = crypto.getRandomValues(new Uint32Array(2)).join("-"); // whose lease it is, among the tabs of one gateway
const MOST_COMMANDS = 2;

export class Refused extends Error {
  constructor(kind, message, status) {
    super(message);
    this.kind = kind;
    this.status = status;
  }
}

/** Take the token out of the address, so that it is in no screenshot, bookmark or history. */
export function readToken() {
  const given = new URLSearchParams(location.hash.slice(1)).get("token");
  if (given) {
    sessionStorage.setItem(KEY, given);
    history.replaceState(null, "", location.pathname);
  }
  return sessionStorage.getItem(KEY);
}

export const keepToken = (token) => sessionStorage.setItem(KEY, token);
const bearer = () => ({ Authorization: `Bearer ${sessionStorage.getItem(KEY) ?? ""}` });

let locked = () => {};
export const onLocked = (listener) => (locked = listener);

let commands = 0;

/** Send a command. Throws `Refused` with the daemon's own sentence. */
export async function command(method, params = {}) {
  if (commands >= MOST_COMMANDS) throw new Refused("Busy", "Two commands are under way already; wait for them or stop.", 0);
  commands += 1;
  try {
    return await post(method, params, {});
  } finally {
    commands -= 1;
  }
}

/** The lease: not counted, so that long commands do not let it end; given back even while the page is closed. */
export const lease = (params) => post("lease", params, { keepalive: true });

/** STOP and cancel: not counted, not queued, sent even while the page is closed. */
export const urgent = (method) => post(method, {}, { keepalive: true, priority: "high" });

async function post(method, params, options) {
  const headers = { ...bearer(), "Content-Type": "application/json", "X-Elpd": "1", "X-Elpd-Tab": TAB };
  const answer = await reach(`api/${method}`, { method: "POST", headers, body: JSON.stringify(params), ...options });
  return answer.json();
}

let questions = Promise.resolve();

/** Ask; one question after the other. `read` turns the answer into what is wanted. */
export function ask(method, query = {}, read = (answer) => answer.json()) {
  const words = new URLSearchParams(Object.entries(query).filter(([, value]) => value !== undefined));
  const asked = questions.then(async () => read(await reach(`api/${method}?${words}`, { headers: bearer() })));
  questions = asked.catch(() => {});
  return asked;
}

/** A picture: {blob, facts}. */
export const picture = (query) =>
  ask("map", query, async (answer) => ({
    facts: JSON.parse(answer.headers.get("X-Elpd-Picture")),
    blob: await answer.blob(),
  }));

/** The stream of events, as it comes. */
export const stream = (lastSeen, signal) =>
  reach("api/events", { headers: { ...bearer(), ...(lastSeen ? { "Last-Event-ID": lastSeen } : {}) }, signal });

async function reach(path, options) {
  let answer;
  try {
    answer = await fetch(path, { ...options, cache: "no-store", credentials: "omit", redirect: "error" });
  } catch (error) {
    if (error.name === "AbortError") throw error;
    throw new Refused("Offline", "The page's server does not answer; is `elpd web` running?", 0);
  }
  if (answer.ok) return answer;
  const body = await answer.json().catch(() => ({}));
  if (answer.status === 401) locked();
  throw new Refused(body.error?.kind ?? "Error", body.error?.message ?? `HTTP ${answer.status}`, answer.status);
}
