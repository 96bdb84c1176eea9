// What the page knows: messages in, one state out. Pure but for the listeners that it tells.

export function initial() {
  return {
    locked: false,
    stream: { open: false, reason: "connecting" },
    link: { connected: false, reason: "connecting" },
    status: null,
    lens: { position_um: null, sigma_um: null, moving: null },
    state: null,
    mode: null,
    fault: null,
    lease: { mine: false }, // whether this page asked for the rig and was not refused
    cycle: null, // {phase, progress, seen: [phase], result}
    samples: [],
    dropped: 0,
  };
}

const MOST_SAMPLES = 4000;

/** Return the state after one message. Samples are appended in place: a curve may have thousands. */
export function take(state, kind, fields) {
  switch (kind) {
    case "reset":
      return { ...state, cycle: null, samples: [] };
    case "link":
      return { ...state, link: fields, status: fields.connected ? state.status : null };
    case "status":
      return withStatus(state, fields);
    case "phase":
      if (fields.phase === "done" || fields.phase === "idle") return state; // the result says it better
      return withPhase(state, fields);
    case "sample":
      if (state.samples.length < MOST_SAMPLES)
        state.samples.push([fields.position_um, fields.elp, fields.score, fields.t_us]);
      return { ...state, lens: { ...state.lens, position_um: fields.position_um ?? state.lens.position_um } };
    case "position":
      return { ...state, lens: { ...state.lens, position_um: fields.position_um, moving: fields.moving } };
    case "result":
      return { ...state, cycle: { seen: state.cycle?.seen ?? [], phase: null, progress: null, result: fields } };
    case "fault":
      return { ...state, fault: fields.kind === null ? null : fields };
    case "state":
      return { ...state, state: fields.state, mode: fields.mode };
    case "curve":
      return { ...state, samples: fields.samples };
    case "dropped":
      return { ...state, dropped: state.dropped + fields.count };
    case "stream":
      return { ...state, stream: fields };
    case "lease":
      return { ...state, lease: fields };
    case "locked":
      return { ...state, locked: fields.locked };
    default:
      return state; // a newer daemon may tell more
  }
}

function withStatus(state, status) {
  const { position_um, sigma_um, moving } = status.lens;
  const shown = state.cycle ?? (status.last ? { seen: [], phase: null, progress: null, result: status.last } : null);
  return {
    ...state, status, state: status.state, mode: status.mode, fault: status.fault,
    lens: { position_um, sigma_um, moving }, cycle: shown,
  };
}

function withPhase(state, { phase, progress = null }) {
  const running = state.cycle && !state.cycle.result;
  const seen = running ? state.cycle.seen : [];
  return {
    ...state,
    samples: running ? state.samples : [],
    cycle: { seen: seen.includes(phase) ? seen : [...seen, phase], phase, progress, result: null },
  };
}

/** Whether anything may be in motion; what is not known counts as motion. */
export function mayMove(state) {
  return !state.stream.open || !state.link.connected || state.state === "FOCUSING" || state.lens.moving !== false;
}

export const live = (state) => state.stream.open && state.link.connected;

/** Who keeps the rig and is not this page, or null. */
export const keeper = (state) => (state.lease.mine ? null : (state.status?.lease.holder ?? null));

/** Whether this page may change anything: it is heard, its user may, and nobody else keeps the rig. */
export const mayOperate = (state) => live(state) && state.link.role !== "observe" && keeper(state) === null;

/** A store: `send` takes a message, listeners hear of the newest state once a frame. */
export function createStore(schedule = requestAnimationFrame) {
  let state = initial();
  let waiting = false;
  const listeners = new Set();
  return {
    get: () => state,
    send(kind, fields) {
      state = take(state, kind, fields);
      if (!waiting) {
        waiting = true;
        schedule(() => {
          waiting = false;
          for (const listener of listeners) listener(state);
        });
      }
    },
    listen(listener) {
      listeners.add(listener);
      listener(state);
    },
  };
}
