// Small helpers for the page's elements.

export const $ = (id) => document.getElementById(id);

export function element(name, attributes = {}, ...children) {
  const made = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (value === false || value === null || value === undefined) continue;
    if (key.startsWith("on")) made.addEventListener(key.slice(2), value);
    else made.setAttribute(key, value === true ? "" : value);
  }
  made.append(...children.filter((child) => child !== null && child !== undefined));
  return made;
}

// Show a message above the page; "" hides it.
export function notice(text) {
  $("notice").textContent = text;
  $("notice").hidden = !text;
}

export function colour(name) {
  const probe = element("i", { style: `color: var(--${name})` });
  document.body.append(probe);
  const found = getComputedStyle(probe).color;
  probe.remove();
  return found;
}

export function metres(value, digits = 2) {
  return value === null || value === undefined ? "none" : `${value.toFixed(digits)} m`;
}

// Decimals that show a tenth of a size in m; at least two.
export function digitsFor(size) {
  return Math.max(2, Math.ceil(1 - Math.log10(size) - 1e-9));
}

export function signed(value) {
  return value > 0 ? `+${value}` : String(value).replace("-", "−");
}
