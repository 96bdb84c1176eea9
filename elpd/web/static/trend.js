// What the runs say together: one value of each over the runs, oldest first. Pure.

export const MEASURES = {
  rest: { title: "at rest", unit: "µm", digits: 1, of: (run) => run.final_um ?? run.focus_um ?? null },
  sigma: { title: "standard error", unit: "µm", digits: 2, of: (run) => run.sigma_um ?? null },
  took: { title: "took", unit: "ms", digits: 0, of: (run) => run.duration_ms ?? null },
};

export const isGood = (run) => run.outcome === "FOCUSED";
export const isCancelled = (run) => run.outcome === "CANCELLED";

/** Columns for a plot: number, value where in focus, its error, value otherwise; and the runs in that order. */
export function series(runs, measure) {
  const inOrder = [...runs].reverse();
  const value = inOrder.map(MEASURES[measure].of);
  return {
    runs: inOrder,
    number: inOrder.map((_, nth) => nth),
    good: value.map((one, nth) => (isGood(inOrder[nth]) ? one : null)),
    error: inOrder.map((run) => (measure === "rest" && isGood(run) ? (run.sigma_um ?? null) : null)),
    bad: inOrder.map((run) => (isGood(run) || isCancelled(run) ? null : 0)),
  };
}

export function median(values) {
  const known = values.filter((one) => one !== null && one !== undefined && Number.isFinite(one)).sort((a, b) => a - b);
  if (!known.length) return null;
  const middle = known.length >> 1;
  return known.length % 2 ? known[middle] : (known[middle - 1] + known[middle]) / 2;
}

/** The trend in a sentence: what a person who cannot see the plot is told, and everybody else reads below it. */
export function summary(runs, measure) {
  const asked = runs.filter((run) => !isCancelled(run));
  const good = asked.filter(isGood);
  if (!asked.length) return "All of these runs were cancelled.";
  const { title, unit, digits, of } = MEASURES[measure];
  const said = [`${good.length} of ${asked.length} in focus`];
  const values = good.map(of).filter((one) => one !== null);
  const middle = median(values);
  if (middle !== null) said.push(`${title} ${middle.toFixed(digits)} ${unit} (median), ${Math.min(...values).toFixed(digits)} to ${Math.max(...values).toFixed(digits)}`);
  return `${said.join("; ")}.`;
}
