// The page: opens the view that the address names, and handles keys and buttons.

import * as accounts from "./accounts.js";
import { asked } from "./api.js";
import * as cell from "./cell.js";
import { isDark } from "./curves.js";
import { $, element, notice } from "./dom.js";
import { saveCanvas } from "./figures.js";
import * as map from "./map.js";
import * as profile from "./profile.js";
import * as state from "./state.js";

const LETTERS = "zlocus.letters";
const TABS = ["cell", "profile", "relief"];
const KEYS = [
  ["1 to 9", "switch the layer with this number on or off"],
  ["Arrows, + and −", "move the map and zoom, while it has the focus; the same for the view in three dimensions, which Shift and arrows turn"],
  ["Enter", "open the cell in the middle of the map"],
  ["Shift and arrows", "open the neighbouring cell"],
  ["[ and ]", "move the selected height down and up"],
  ["P", "set one end of a profile, then the other, in the middle of the map"],
  ["Esc", "stop drawing"],
  ["H", "show the whole surface"],
  ["C, F, V", "open cell, profile or 3-D view"],
  ["X", "close them, and show the map alone"],
  ["L", "copy the link of this view"],
  ["D", "switch between light and dark"],
  ["?", "show this list"],
];
const WAIT_MS = 1000, PATIENCE_MS = 5000;
let leaflet, surface, relief = null;

async function start() {
  theme(state.get("theme"));
  surface = await asked("surface");
  document.title = `${surface.title} – zlocus inspect`;
  $("title").textContent = surface.title;
  const [rows, cols] = surface.shape;
  $("subtitle").textContent = `${rows} × ${cols} cells of ${surface.transform[0]} m, ${surface.images.length} images, ${surface.crs}`;
  leaflet = map.make(surface);
  cell.make(surface, leaflet);
  accounts.make(surface, leaflet);
  profile.make(surface, leaflet);
  makeGo();
  makeKeys();
  leaflet.on("click", ({ latlng }) => clicked(latlng));
  TABS.forEach((name) => $(`tab-${name}`).addEventListener("click", () => open(name)));
  $("close").addEventListener("click", close);
  $("tab-cell").parentElement.addEventListener("keydown", moveTab);
  $("link").addEventListener("click", copyLink);
  $("theme").addEventListener("click", changeTheme);
  $("help").addEventListener("click", () => $("keys").showModal());
  $("export-map").addEventListener("click", async () => {
    const canvas = await map.exportMap();
    if (canvas) saveCanvas(canvas, `${surface.title}_map`);
  });
  // Captured before the map, which would move on Shift and arrows.
  addEventListener("keydown", key, true);
  // The middle of the map is marked while the keyboard is used.
  addEventListener("keydown", () => (document.body.dataset.keys = "true"), true);
  $("letters").checked = localStorage.getItem(LETTERS) !== "off";
  $("letters").addEventListener("change", () => localStorage.setItem(LETTERS, $("letters").checked ? "on" : "off"));
  addEventListener("pointerdown", () => delete document.body.dataset.keys, true);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
    theme(state.get("theme"));
    redraw();
  });
  state.onOpened(reopen);
  reopen();
  document.body.dataset.ready = "true";
  watch();
}

function reopen() {
  theme(state.get("theme"));
  map.openView();
  const tab = state.get("tab");
  cell.open();
  profile.open();
  if (TABS.includes(tab)) open(tab, false);
  else if (state.get("cell")) open("cell", false);
  else close();
}

// Poll the server until everything that is prepared in the background is ready.
async function watch() {
  for (;;) {
    let found;
    try {
      found = await asked("state");
    } catch {
      notice("The server does not answer. Is `zlocus inspect` still running?");
      await new Promise((done) => setTimeout(done, PATIENCE_MS));
      continue;
    }
    const failed = ["scene", "reference"].filter((what) => found[what]?.is === "failed").map((what) => found[what].why);
    const what = found.scene.what ? ` (${found.scene.what})` : "";
    const waiting = found.scene.is === "opening" ? [`The images are being opened${what}.`] : [];
    if (found.reference?.is === "opening") waiting.push("The reference is being compared.");
    notice([...failed, ...waiting, ...found.notes].join(" "));
    $("comparison").textContent = found.comparison ?? "";
    $("comparison-part").hidden = !found.comparison;
    if (found.difference && !map.has("difference")) {
      map.addLate(found.difference);
      cell.open();
      profile.open();
    }
    document.body.dataset.scene = found.scene.is;
    if (!waiting.length) return;
    await new Promise((done) => setTimeout(done, WAIT_MS));
  }
}

function clicked(latlng) {
  if (!$("panel").hidden && !$("profile").hidden) profile.point(latlng);
  else inspect(latlng);
}

function inspect({ lat, lng }) {
  open("cell");
  cell.look(lng, lat);
}

// Show one of the tabs beside the map, or with null the map alone.
function select(name) {
  $("panel").hidden = name === null;
  if (name === null) delete document.body.dataset.panel;
  else document.body.dataset.panel = "open";
  for (const each of TABS) {
    $(each).hidden = each !== name;
    $(`tab-${each}`).setAttribute("aria-selected", String(each === name));
    $(`tab-${each}`).tabIndex = each === (name ?? TABS[0]) ? 0 : -1;
  }
}

function close() {
  select(null);
  profile.cancel();
  state.set({ tab: null });
}

async function open(name, isAsked = true) {
  select(name);
  if (isAsked) state.set({ tab: name });
  if (name !== "profile") profile.cancel();
  if (name === "profile" && !state.get("line")) profile.begin();
  if (name === "relief") {
    // The 3-D view is loaded on first use.
    relief ??= import("./relief.js").then((found) => {
      found.make(surface);
      return found;
    });
    try {
      await (await relief).show();
    } catch {
      relief = null;
      $("relief-text").textContent = "The 3-D view could not be loaded. Open it again.";
    }
  }
}

function moveTab(event) {
  const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
  if (!step) return;
  const at = TABS.findIndex((name) => $(`tab-${name}`).tabIndex === 0);
  const next = TABS[(at + step + TABS.length) % TABS.length];
  open(next);
  $(`tab-${next}`).focus();
}

function makeGo() {
  for (const { x, y, what } of surface.cells) $("go").append(element("option", { value: `${x},${y}` }, what));
  $("go").addEventListener("change", () => {
    if (!$("go").value) return;
    const [x, y] = $("go").value.split(",").map(Number);
    leaflet.setView([y, x], Math.max(leaflet.getZoom(), 1));
    open("cell");
    cell.look(x, y);
  });
  $("go").parentElement.hidden = !surface.cells.length;
}

function makeKeys() {
  const rows = KEYS.map(([keys, what]) => element("tr", {}, element("td", {}, element("kbd", {}, keys)), element("td", {}, what)));
  $("keys").querySelector("tbody").append(...rows);
}

function key(event) {
  if (event.ctrlKey || event.metaKey || event.altKey || $("keys").open) return;
  const isTyping = event.target.matches("input:not([type=checkbox], [type=range]), select, textarea");
  const arrows = { ArrowUp: [-1, 0], ArrowDown: [1, 0], ArrowLeft: [0, -1], ArrowRight: [0, 1] };
  // In the 3-D view arrows turn it.
  if (event.target.closest("#relief-view") && arrows[event.key]) return;
  if (event.key.length === 1 && !$("letters").checked) return;
  if (event.shiftKey && arrows[event.key] && !isTyping) cell.step(...arrows[event.key]);
  else if (isTyping) return;
  else if (/^[1-9]$/.test(event.key)) map.toggle(Number(event.key));
  else if (event.key === "Enter" && event.target === $("map")) centre();
  else if (event.key === "[" || event.key === "]") cell.slide(event.key === "]" ? 1 : -1);
  else if (event.key === "Escape") profile.cancel();
  else if (event.key === "?") $("keys").showModal();
  else {
    const action = { c: () => open("cell"), f: () => open("profile"), v: () => open("relief"), x: close, h: map.home, l: copyLink, d: changeTheme, p: profilePoint }[event.key.toLowerCase()];
    if (!action) return;
    action();
  }
  event.preventDefault();
  event.stopPropagation();
}

function centre() {
  clicked(leaflet.getCenter());
}

function profilePoint() {
  if ($("panel").hidden || $("profile").hidden) open("profile");
  profile.point(leaflet.getCenter());
}

async function copyLink() {
  const link = state.link();
  try {
    await navigator.clipboard.writeText(link);
    flash("Copied.");
  } catch {
    prompt("The link of this view:", link);
  }
}

function flash(text) {
  const before = "Copy link";
  $("link").textContent = text;
  setTimeout(() => ($("link").textContent = before), 1200);
}

function theme(name) {
  if (name === "light" || name === "dark") document.documentElement.dataset.theme = name;
  else delete document.documentElement.dataset.theme;
  $("theme").textContent = isDark() ? "Light" : "Dark";
}

function changeTheme() {
  state.set({ theme: isDark() ? "light" : "dark" });
  theme(state.get("theme"));
  redraw();
}

function redraw() {
  cell.redraw();
  accounts.redraw();
  profile.redraw();
  relief?.then((found) => found.draw());
}

start().catch((error) => notice(`The page could not be opened: ${error.message}`));
