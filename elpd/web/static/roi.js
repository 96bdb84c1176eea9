// Rectangles of sensor pixels: whole numbers, origin top left. Nothing here knows of a screen.

export const HANDLES = ["nw", "n", "ne", "e", "se", "s", "sw", "w"];
export const SMALLEST = 8;

const clip = (value, low, high) => Math.min(Math.max(value, low), high);

/** Cut to the sensor; never smaller than a few pixels, never outside. */
export function clamp(box, sensor) {
  const x = clip(Math.round(box.x), 0, sensor.width - SMALLEST);
  const y = clip(Math.round(box.y), 0, sensor.height - SMALLEST);
  return {
    x,
    y,
    width: clip(Math.round(box.width), SMALLEST, sensor.width - x),
    height: clip(Math.round(box.height), SMALLEST, sensor.height - y),
  };
}

/** Move by so many pixels; the size stays, the sensor's edge stops it. */
export function move(box, dx, dy, sensor) {
  return {
    ...box,
    x: clip(Math.round(box.x + dx), 0, Math.max(0, sensor.width - box.width)),
    y: clip(Math.round(box.y + dy), 0, Math.max(0, sensor.height - box.height)),
  };
}

/** The rectangle between two corners, wherever they lie. */
export function between(from, to, sensor) {
  const inside = (point) => ({ x: clip(point.x, 0, sensor.width), y: clip(point.y, 0, sensor.height) });
  const [a, b] = [inside(from), inside(to)];
  return clamp(
    { x: Math.min(a.x, b.x), y: Math.min(a.y, b.y), width: Math.abs(a.x - b.x), height: Math.abs(a.y - b.y) },
    sensor,
  );
}

/** Drag one handle by so many pixels; the opposite side stays where it is, and is not passed. */
export function resize(box, handle, dx, dy, sensor) {
  let [left, top, right, bottom] = [box.x, box.y, box.x + box.width, box.y + box.height];
  if (handle.includes("w")) left = clip(left + dx, 0, right - SMALLEST);
  if (handle.includes("e")) right = clip(right + dx, left + SMALLEST, sensor.width);
  if (handle.includes("n")) top = clip(top + dy, 0, bottom - SMALLEST);
  if (handle.includes("s")) bottom = clip(bottom + dy, top + SMALLEST, sensor.height);
  return clamp({ x: left, y: top, width: right - left, height: bottom - top }, sensor);
}

/** Where each handle sits. */
export function corners(box) {
  const [cx, cy] = [box.x + box.width / 2, box.y + box.height / 2];
  const [right, bottom] = [box.x + box.width, box.y + box.height];
  return {
    nw: [box.x, box.y], n: [cx, box.y], ne: [right, box.y], e: [right, cy],
    se: [right, bottom], s: [cx, bottom], sw: [box.x, bottom], w: [box.x, cy],
  };
}

/** What a press at a point takes hold of: a handle within reach, the inside, or nothing. */
export function grip(box, point, reachX, reachY) {
  if (!box) return null;
  let best = null;
  for (const [name, [x, y]] of Object.entries(corners(box))) {
    const distance = Math.hypot((point.x - x) / reachX, (point.y - y) / reachY);
    if (distance <= 1 && (best === null || distance < best.distance)) best = { name, distance };
  }
  if (best) return best.name;
  const within = point.x >= box.x && point.x <= box.x + box.width && point.y >= box.y && point.y <= box.y + box.height;
  return within ? "inside" : null;
}

/** In the middle, as large as elpd's own proposals. */
export function central(sensor) {
  const side = Math.round(0.4 * Math.min(sensor.width, sensor.height));
  return { x: Math.round((sensor.width - side) / 2), y: Math.round((sensor.height - side) / 2), width: side, height: side };
}

export const same = (a, b) =>
  a === b || (!!a && !!b && a.x === b.x && a.y === b.y && a.width === b.width && a.height === b.height);
