"""Small pieces of JavaScript that look at the page from inside."""

FRAME = """async (url) => {
  const frame = document.createElement("iframe");
  frame.src = url;
  document.body.append(frame);
  await new Promise((done) => { frame.onload = done; });
  try { return frame.contentDocument !== null; } catch { return false; }
}"""
"""Whether this page can look into a frame with another one."""

SEND = "async ([url, options]) => { try { await fetch(url, options); } catch {} }"

FOCUSED = """() => {
  const at = document.activeElement;
  const ring = (element) => getComputedStyle(element).outlineStyle !== "none";
  const shown = ring(at) || Boolean(at.nextElementSibling && ring(at.nextElementSibling));
  return { id: at.id || at.value || at.className || at.tagName, shown };
}"""
"""What has the keyboard, and whether that can be seen."""

PALE = """() => {
  const linear = (c) => (c / 255 <= 0.04045 ? c / 255 / 12.92 : ((c / 255 + 0.055) / 1.055) ** 2.4);
  const light = ([r, g, b]) => 0.2126 * linear(r) + 0.7152 * linear(g) + 0.0722 * linear(b);
  const numbers = (css) => css.match(/[\\d.]+/g).map(Number);
  const ground = (element) => {
    for (let at = element; at; at = at.parentElement) {
      const colour = numbers(getComputedStyle(at).backgroundColor);
      if (colour.length === 3 || colour[3] === 1) return colour;
    }
    return [255, 255, 255];
  };
  const pale = {};
  const look = (element, colour, text) => {
    const both = [light(numbers(colour)), light(ground(element))].sort((a, b) => b - a);
    const ratio = (both[0] + 0.05) / (both[1] + 0.05);
    if (ratio < 4.5) pale[element.id || text.slice(0, 30)] = ratio.toFixed(2);
  };
  const walk = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  while (walk.nextNode()) {
    const [element, text] = [walk.currentNode.parentElement, walk.currentNode.data.trim()];
    const off = element.closest(":disabled, .stage, noscript, select") || element.previousElementSibling?.disabled;
    if (text && !off && element.checkVisibility()) look(element, getComputedStyle(element).color, text);
  }
  for (const field of document.querySelectorAll("input:enabled[placeholder]"))
    if (field.checkVisibility()) look(field, getComputedStyle(field, "::placeholder").color, field.placeholder);
  return pale;
}"""
"""Texts whose contrast is below 4.5 (WCAG 2, AA), with it; what is disabled is left out, as there."""

MOVING = "document.getAnimations().filter((one) => one.playState === 'running').length"

TOUCHES = """() => {
  window.touches = [];
  addEventListener("touchstart", ({ target, defaultPrevented }) => {
    window.touches.push([target.closest("button, #region").id, defaultPrevented]);
  });
}"""
"""Every touch: where, and whether the page kept it from being a gesture of the browser's."""
