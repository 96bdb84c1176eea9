// Server-sent events over fetch, because EventSource cannot send the token in a header. Comes back by itself, with the
// number of the event it saw last. A hidden tab lets go: connections are few, and STOP needs one.

const SILENT_MS = 25_000; // the gateway speaks every ten seconds
const RETRY_MS = [500, 5000];

/** Split a text that grows into events; `rest` is what is not complete yet. */
export function parse(text) {
  const blocks = text.split("\n\n");
  const rest = blocks.pop();
  const events = [];
  for (const block of blocks) {
    const fields = {};
    for (const line of block.split("\n")) {
      const colon = line.indexOf(": ");
      if (colon > 0) fields[line.slice(0, colon)] = line.slice(colon + 2);
    }
    if (fields.event) events.push({ kind: fields.event, id: fields.id ?? null, data: JSON.parse(fields.data ?? "{}") });
  }
  return { events, rest };
}

/** Follow the stream for ever: `hear(kind, fields)` for each event, and "stream" when it opens or breaks. */
export function follow(open, hear) {
  let lastSeen = null;
  let retry = RETRY_MS[0];
  let current = null;
  let timer = null;

  async function listen() {
    clearTimeout(timer);
    const mine = (current = new AbortController());
    let watchdog;
    const alive = () => {
      clearTimeout(watchdog);
      watchdog = setTimeout(() => mine.abort(), SILENT_MS);
    };
    try {
      alive();
      const reader = (await open(lastSeen, mine.signal)).body.pipeThrough(new TextDecoderStream()).getReader();
      hear("stream", { open: true, reason: "" });
      retry = RETRY_MS[0];
      let text = "";
      for (;;) {
        const { value, done } = await reader.read();
        if (done) break;
        alive();
        const { events, rest } = parse(text + value);
        text = rest;
        for (const event of events) {
          lastSeen = event.id ?? lastSeen;
          hear(event.kind, event.data);
        }
      }
      throw new Error("The page's server has gone.");
    } catch (error) {
      if (current !== mine) return; // another has taken over
      current = null;
      const reason = error.name === "AbortError" ? "The page's server has been silent for too long." : error.message;
      hear("stream", { open: false, reason });
      if (error.status === 401 || document.hidden) return;
      timer = setTimeout(listen, retry);
      retry = Math.min(2 * retry, RETRY_MS[1]);
    } finally {
      clearTimeout(watchdog);
    }
  }

  document.addEventListener("visibilitychange", () => {
    if (document.hidden) {
      clearTimeout(timer);
      const old = current;
      current = null;
      old?.abort();
      hear("stream", { open: false, reason: "This tab was in the background." });
    } else if (!current) listen();
  });
  const restart = () => {
    const old = current;
    current = null;
    old?.abort();
    listen();
  };
  listen();
  return restart;
}
