// The state of the page, kept in the address after the #, so that a link shows the same view.

// Some browsers refuse to change the address more often than this.
const WRITE_MS = 250;
const listeners = [];
let writing = null;
let known; // the part of the address after # when it was last read or written here
let values = read();

export function get(name) {
  return values.get(name);
}

export function all(name) {
  return values.getAll(name);
}

export function entries(prefix) {
  return [...values].filter(([name]) => name.startsWith(prefix)).map(([name, value]) => [name.slice(prefix.length), value]);
}

// Set some values; null removes one, a list sets several of the same name.
export function set(changes) {
  for (const [name, value] of Object.entries(changes)) {
    values.delete(name);
    for (const each of [value].flat()) if (each !== null && each !== undefined) values.append(name, each);
  }
  values.sort(); // the same view has the same link
  writing ??= setTimeout(write, WRITE_MS);
}

// The link of the current view.
export function link() {
  write();
  return location.href;
}

function write() {
  clearTimeout(writing);
  writing = null;
  // The address was changed from outside and its event is still to come: it must not be overwritten.
  if (location.hash !== known) return;
  const text = values.toString();
  history.replaceState(null, "", text ? `#${text}` : "#");
  known = location.hash;
}

export function onOpened(listener) {
  listeners.push(listener);
}

export function numbers(name, count) {
  const parts = (values.get(name) ?? "").split(",");
  const found = parts.map(Number);
  return parts.length === count && parts.every((part) => part.trim()) && found.every(Number.isFinite) ? found : null;
}

addEventListener("hashchange", () => {
  clearTimeout(writing);
  writing = null;
  values = read();
  listeners.forEach((listener) => listener());
});

function read() {
  known = location.hash;
  return new URLSearchParams(location.hash.slice(1));
}
