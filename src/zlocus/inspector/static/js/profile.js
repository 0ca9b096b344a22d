// Profile: heights along a line on the map, with their standard deviation and the reference, where there is one.

import { asked } from "./api.js";
import { colour, $ } from "./dom.js";
import { exportable } from "./figures.js";
import * as map from "./map.js";
import * as state from "./state.js";

let surface, leaflet, line, dot, first = null, chart = null, last = null, busy = null;

export function make(about, theMap) {
  [surface, leaflet] = [about, theMap];
  line = L.layerGroup().addTo(leaflet);
  $("draw").addEventListener("click", begin);
  exportable($("profile-figure"), () => `${surface.title}_profile`, () => chart, () => ({
    title: "Height along a line", subtitle: surface.title, lines: [{ text: $("profile-text").textContent }],
  }));
  $("along").addEventListener("input", () => along(Number($("along").value)));
}

export function isDrawing() {
  return $("map").classList.contains("drawing");
}

export function begin() {
  first = null;
  $("map").classList.add("drawing");
  $("draw").setAttribute("aria-pressed", "true");
}

export function cancel() {
  const isBegun = first !== null;
  first = null;
  $("map").classList.remove("drawing");
  $("draw").setAttribute("aria-pressed", "false");
  if (isBegun) open(); // the previous line
}

// One end of the line, then the other.
export function point({ lat, lng }) {
  if (!isDrawing()) begin();
  if (!first) {
    first = { lat, lng };
    line.clearLayers();
    L.circleMarker(first, { radius: 5, color: "#e6007a", interactive: false }).addTo(line);
    return;
  }
  state.set({ line: [first.lng, first.lat, lng, lat].map(map.place).join(",") });
  first = null;
  cancel();
  open();
}

// The line that the address names, or none.
export async function open() {
  if (first) return; // a line is being drawn
  const ends = state.numbers("line", 4);
  busy?.abort();
  line.clearLayers();
  $("profile-figure").hidden = !ends;
  $("profile-text").textContent = "";
  if (!ends) return;
  busy = new AbortController();
  const [x0, y0, x1, y1] = ends;
  L.polyline([[y0, x0], [y1, x1]], { color: "#e6007a", weight: 3, interactive: false }).addTo(line);
  dot = L.circleMarker([y0, x0], { radius: 6, color: "#e6007a", fillOpacity: 1, interactive: false });
  try {
    last = await asked("profile", { x0, y0, x1, y1 }, busy.signal);
  } catch (error) {
    if (error.name === "AbortError") return;
    $("profile-figure").hidden = true;
    $("profile-text").textContent = error.message;
    return;
  }
  draw(ends);
}

export function redraw() {
  const ends = state.numbers("line", 4);
  if (ends && last) draw(ends);
}

function draw([x0, y0, x1, y1]) {
  const points = last.distance_m.map((distance, i) => ({
    distance, height: last.height_m[i], sigma: last.sigma_m[i], reference: last.reference_m?.[i] ?? null, terrain: last.terrain_m?.[i] ?? null,
  }));
  const known = points.filter((each) => each.height !== null);
  const hasReference = points.some((each) => each.reference !== null), hasTerrain = points.some((each) => each.terrain !== null);
  chart = Plot.plot({
    width: 520, height: 306, marginLeft: 52, marginBottom: 44, ariaLabel: "Height along the line",
    style: { fontSize: "12px", background: "transparent" },
    x: { label: "distance, m", labelAnchor: "center", labelArrow: "none" },
    y: { label: "height, m", labelArrow: "none", nice: true, zero: false },
    marks: [
      // Missing heights leave a gap.
      Plot.areaY(points, { x: "distance", y1: (d) => low(d), y2: (d) => high(d), fill: colour("accent"), fillOpacity: 0.3 }),
      ...(hasReference ? [Plot.line(points, { x: "distance", y: (d) => d.reference ?? NaN, stroke: colour("warn"), strokeWidth: 1.4, strokeDasharray: "5 3" })] : []),
      ...(hasTerrain ? [Plot.line(points, { x: "distance", y: (d) => d.terrain ?? NaN, stroke: colour("good"), strokeWidth: 1.6, strokeDasharray: "1 3" })] : []),
      Plot.line(points, { x: "distance", y: (d) => d.height ?? NaN, stroke: colour("accent"), strokeWidth: 1.6 }),
      Plot.ruleX(known, Plot.pointerX({ x: "distance", stroke: "currentColor", strokeOpacity: 0.4 })),
      Plot.tip(known, Plot.pointerX({ x: "distance", y: "height", fill: colour("raised"), stroke: colour("line"), title: words })),
    ],
  });
  chart.addEventListener("input", () => {
    if (chart.value) mark(chart.value.distance);
    else dot.remove();
  });
  $("along").max = points.length - 1;
  $("along").value = 0;
  $("along-value").textContent = "";
  $("profile-figure").querySelector(".drawing").replaceChildren(chart);
  const others = [hasReference ? "The dashed brown line is the reference." : "", hasTerrain ? "The dotted green line is the DTM." : ""];
  $("profile-text").textContent = [
    `The line is ${last.length_m.toFixed(1)} m long, from ${map.words(x0, y0)} to ${map.words(x1, y1)}.`,
    `Of ${points.length} places, ${last.spacing_m.toFixed(2)} m apart, ${known.length} have a height.`,
    "The band is one standard deviation to either side.", ...others.filter(Boolean),
  ].join(" ");
}

// The place on the map.
function mark(distance) {
  const [x0, y0, x1, y1] = state.numbers("line", 4), share = distance / Math.max(last.length_m, 1e-9);
  dot.setLatLng([y0 + share * (y1 - y0), x0 + share * (x1 - x0)]).addTo(line);
}

// One place of the line in words, for users without a pointer.
function along(i) {
  const [height, sigma] = [last.height_m[i], last.sigma_m[i]];
  const [reference, terrain] = [last.reference_m?.[i] ?? null, last.terrain_m?.[i] ?? null];
  mark(last.distance_m[i]);
  const text = height === null ? `${last.distance_m[i].toFixed(1)} m along: no height` :
    words({ distance: last.distance_m[i], height, sigma, reference, terrain }).replaceAll("\n", ", ");
  $("along-value").textContent = text;
  $("along").setAttribute("aria-valuetext", text);
}

function low({ height, sigma }) {
  return height === null ? NaN : height - (sigma ?? 0);
}

function high({ height, sigma }) {
  return height === null ? NaN : height + (sigma ?? 0);
}

function words({ distance, height, sigma, reference, terrain }) {
  const lines = [`${distance.toFixed(1)} m along`, `height ${height.toFixed(2)} m`];
  if (sigma !== null) lines.push(`standard deviation ${sigma.toFixed(3)} m`);
  if (reference !== null) lines.push(`reference ${reference.toFixed(2)} m`);
  if (terrain !== null) lines.push(`DTM ${terrain.toFixed(2)} m`);
  return lines.join("\n");
}
