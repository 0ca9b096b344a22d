// What became of each image at the cell, and what the matcher weighed there.

import { asked } from "./api.js";
import { costs as costChart } from "./curves.js";
import { $, digitsFor, element } from "./dom.js";
import { exportable } from "./figures.js";
import * as state from "./state.js";

let surface, lines, chart = null, shown = null, weighed = null, busy = null;

export function make(about, leaflet) {
  surface = about;
  lines = L.layerGroup().addTo(leaflet);
  $("matcher").addEventListener("toggle", () => {
    state.set({ weighed: $("matcher").open ? 1 : null });
    weigh();
  });
  const name = () => `${surface.title}_costs_${shown?.row}_${shown?.col}`;
  exportable($("costs-figure"), name, () => chart, () => ({
    title: "Cost of each height for this cell alone", subtitle: `${surface.title}, row ${shown.row}, column ${shown.col}`,
    lines: weighed.says.map((text) => ({ text })),
  }));
}

// The accounts of the images of a cell, and a line on the map to what occludes it.
export function show(record) {
  shown = record;
  lines.clearLayers();
  $("accounts-part").hidden = !record.accounts;
  $("matcher").hidden = !record.accounts;
  if (!record.accounts) return;
  $("accounts-say").textContent = record.accounts_say;
  $("accounts").replaceChildren(...record.accounts.map(({ kind, says }) => element("li", { class: kind.replace(" ", "-") }, says)));
  for (const { occluder } of record.accounts) {
    if (!occluder) continue;
    const ends = [[record.y, record.x], [occluder.y, occluder.x]];
    L.polyline(ends, { color: "#ffffff", weight: 4, opacity: 0.8, interactive: false }).addTo(lines);
    L.polyline(ends, { color: "#0072b2", weight: 2, dashArray: "4 3", interactive: false }).addTo(lines);
    L.circleMarker(ends[1], { radius: 4, color: "#ffffff", weight: 1.5, fillColor: "#0072b2", fillOpacity: 1, interactive: false }).addTo(lines);
  }
  $("matcher").open = Boolean(state.get("weighed"));
  weigh();
}

export function clear() {
  shown = null;
  lines.clearLayers();
  busy?.abort();
  for (const id of ["accounts-part", "matcher"]) $(id).hidden = true;
}

// The sentences of the images, for a figure that is saved.
export function sentences() {
  return [shown.accounts_say, ...shown.accounts.map(({ says }) => says)];
}

// Ask what the matcher weighed, while that part of the panel is open.
async function weigh() {
  busy?.abort();
  if (!shown || !$("matcher").open) return;
  busy = new AbortController();
  const { signal } = busy, { x, y } = shown;
  const waiting = setTimeout(() => ($("matcher-busy").hidden = signal.aborted), 300);
  try {
    const found = await asked("matcher", { x, y }, signal);
    weighed = found;
    draw();
    ended("");
  } catch (error) {
    if (error.name === "AbortError") return;
    ended(error.message);
  } finally {
    clearTimeout(waiting);
  }
}

function ended(error) {
  $("matcher-busy").hidden = true;
  $("matcher-content").hidden = Boolean(error);
  $("matcher-error").hidden = !error;
  $("matcher-error").textContent = error;
}

function draw() {
  $("matcher-says").replaceChildren(...weighed.says.map((text) => element("li", {}, text)));
  chart = costChart(weighed);
  $("costs-figure").querySelector(".drawing").replaceChildren(chart);
  pairTable();
}

export function redraw() {
  if (weighed && !$("matcher-content").hidden) draw();
}

function pairTable() {
  const heads = ["pair of images", "what it says of the chosen height", "says most for, m"];
  const digits = digitsFor(surface.transform[0]);
  const rows = weighed.pairs.map(({ images, says, best_m, evidence }) => {
    const kind = evidence === null ? "off" : "";
    return element("tr", { class: kind }, element("th", { scope: "row" }, images.join(" and ")), element("td", { class: "words" }, says), element("td", {}, best_m === null ? "–" : best_m.toFixed(digits)));
  });
  $("pairs").hidden = !rows.length;
  $("pairs").replaceChildren(element("caption", { class: "hidden" }, "Evidence of the pairs of images"),
    element("tr", {}, ...heads.map((head) => element("th", { scope: "col" }, head))), ...rows);
}
