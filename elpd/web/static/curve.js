// ELP over the lens position: samples into ways (one for each direction of travel), and where a way crosses zero.
// A sample is [position_um, elp, score, t_us].

export const SMOOTHED = 5; // windows, as `elpd demo` draws it

/** Part samples by direction. A turn counts once the lens has gone back further than its typical step. */
export function ways(samples) {
  const moved = [];
  for (const sample of samples) {
    const last = moved.at(-1);
    if (sample[0] !== null && Number.isFinite(sample[0]) && (!last || sample[0] !== last[0])) moved.push(sample);
  }
  if (moved.length < 2) return moved.length ? [moved] : [];
  const step = median(moved.slice(1).map((sample, nth) => Math.abs(sample[0] - moved[nth][0])));
  const found = [];
  let way = [moved[0]];
  let sign = 0;
  let turn = 0; // where in `way` the farthest point lies
  for (const sample of moved.slice(1)) {
    way.push(sample);
    const beyond = sample[0] - way[turn][0];
    if (sign === 0 && Math.abs(beyond) > step / 2) sign = Math.sign(beyond);
    if (sign === 0 || beyond * sign > 0) {
      turn = way.length - 1;
    } else if (-beyond * sign > step) {
      found.push(way.slice(0, turn + 1));
      way = way.slice(turn);
      sign = -sign;
      turn = way.length - 1;
    }
  }
  found.push(way);
  return found.filter((one) => one.length > 1);
}

/** Mean over a few windows, fewer at the ends. */
export function smooth(values, span = SMOOTHED) {
  const half = Math.floor(span / 2);
  return values.map((_, nth) => {
    const part = values.slice(Math.max(0, nth - half), nth + half + 1);
    return part.reduce((sum, value) => sum + value, 0) / part.length;
  });
}

/** Where the smoothed ELP of the last way falls through zero after its peak, or null. */
export function crossing(samples) {
  const way = ways(samples).at(-1);
  if (!way || way.length < 2 * SMOOTHED) return null;
  const values = smooth(way.map((sample) => sample[1]));
  const peak = values.indexOf(Math.max(...values));
  if (values[peak] <= 0) return null;
  for (let nth = peak + 1; nth < values.length; nth += 1) {
    if (values[nth] <= 0) {
      const share = values[nth - 1] / (values[nth - 1] - values[nth]);
      return way[nth - 1][0] + share * (way[nth][0] - way[nth - 1][0]);
    }
  }
  return null;
}

/** One way as columns, by rising position: [positions, smoothed, measured]. */
export function columns(way) {
  const values = smooth(way.map((sample) => sample[1]));
  const rows = way.map((sample, nth) => [sample[0], values[nth], sample[1]]);
  rows.sort((one, other) => one[0] - other[0]);
  const unique = rows.filter((row, nth) => nth === 0 || row[0] !== rows[nth - 1][0]);
  return [0, 1, 2].map((column) => unique.map((row) => row[column]));
}

function median(values) {
  const sorted = [...values].sort((a, b) => a - b);
  return sorted[Math.floor(sorted.length / 2)];
}
