// The map: layers of tiles on the surface's own grid, a pixel being a cell at zoom 0.

import { address } from "./api.js";
import { $, digitsFor, element, notice } from "./dom.js";
import * as state from "./state.js";

const TILE_PX = 256;
const CLOSEST = 6;
// As in the style sheet.
const NARROW = "(max-width: 860px)";
const DEFAULT_LAYERS = { hillshade: 1, height: 0.55 };
// Beside the surface, when the whole of it is shown, px.
const MARGIN_PX = 10;
// Whether the whole surface is shown, so that it is fitted again when the window changes; and whether that is going on.
let isHome = false, isFitting = false;
let surface, map, crs;
const layers = new Map();

const Tiles = L.TileLayer.extend({
  getTileUrl({ x, y }) {
    // The time of the run is in the address, so that the browser keeps no tile of an older surface.
    return `tiles/${this.options.name}/${-this._clampZoom(this._tileZoom)}/${x}/${y}.png?of=${encodeURIComponent(surface.made)}`;
  },
});

export function make(about) {
  surface = about;
  const [a, , c, , e, f] = about.transform;
  crs = L.extend({}, L.CRS.Simple, { transformation: new L.Transformation(1 / a, -c / a, 1 / e, -f / e) });
  map = L.map("map", {
    crs, minZoom: -about.levels - 1, maxZoom: CLOSEST, zoomSnap: 0, zoomDelta: 1, attributionControl: false,
    wheelPxPerZoomLevel: 90, keyboardPanDelta: 120, trackResize: false,
  });
  L.control.scale({ imperial: false, maxWidth: 160 }).addTo(map);
  about.layers.forEach(addLayer);
  // Limit the zoom so that the surface stays visible, in a small window too.
  map.setMinZoom(Math.min(map.getBoundsZoom(bounds()) - 2, 0));
  map.setMaxBounds(bounds().pad(1));
  if (matchMedia(NARROW).matches) $("layers").open = false;
  openView();
  $("no-terrain").hidden = about.has_terrain;
  map.on("moveend", () => {
    if (isFitting) return;
    isHome = false;
    const { lat, lng } = map.getCenter();
    state.set({ at: [place(lng), place(lat), map.getZoom()].join(",") });
    if (document.body.dataset.keys) $("pointer").textContent = words(lng, lat);
  });
  map.on("mousemove", ({ latlng }) => ($("pointer").textContent = words(latlng.lng, latlng.lat)));
  map.on("mouseout move", () => ($("pointer").textContent = ""));
  new ResizeObserver(resized).observe($("map"));
  return map;
}

// The window, or the panel, has another size: the whole surface stays whole, and another place stays in the middle.
function resized() {
  isFitting = true;
  map.invalidateSize({ animate: false });
  isFitting = false;
  if (isHome) home();
}

// A coordinate as links contain it, to a tenth of a cell.
export function place(value) {
  return value.toFixed(digitsFor(surface.transform[0]));
}

export function words(x, y, digits = digitsFor(surface.transform[0]) - 1) {
  const [first, second] = surface.axes;
  return `${first} ${x.toFixed(digits)}, ${second} ${y.toFixed(digits)} m`;
}

// Show the place and the layers that the address names.
export function openView() {
  const at = state.numbers("at", 3);
  if (at && bounds().pad(1).contains([at[1], at[0]])) {
    isHome = false;
    map.setView([at[1], at[0]], at[2], { animate: false });
  } else home();
  const asked = state.get("layers");
  const shown = asked === undefined || asked === null ? DEFAULT_LAYERS : parsed(asked);
  for (const layer of layers.values()) show(layer, shown[layer.name]);
}

function parsed(text) {
  return Object.fromEntries(
    text.split(",").filter(Boolean).map((each) => each.split(":")).map(([name, share]) => [name, clamp(Number(share ?? 1))]),
  );
}

function clamp(share) {
  return Number.isFinite(share) ? Math.min(Math.max(share, 0), 1) : 1;
}

// Slightly smaller than the surface, so that no tile is requested that only touches it.
function inner() {
  const box = bounds(), aside = surface.transform[0] * 1e-3;
  return L.latLngBounds([box.getSouth() + aside, box.getWest() + aside], [box.getNorth() - aside, box.getEast() - aside]);
}

// Whether a ground point lies on the grid.
export function holds(x, y) {
  const box = bounds();
  return x >= box.getWest() && x < box.getEast() && y > box.getSouth() && y <= box.getNorth();
}

// Show the whole surface, as large as the map has room for it.
export function home() {
  const list = $("layers").getBoundingClientRect(), legend = $("legends").getBoundingClientRect(), frame = $("map").getBoundingClientRect();
  // The list of layers stands beside it where the map is wide, and the legend below it where the map is narrow.
  const isWide = !matchMedia(NARROW).matches;
  const aside = isWide && $("layers").open ? frame.right - list.left : 0, below = isWide || !legend.height ? 0 : frame.bottom - legend.top;
  isFitting = true;
  map.fitBounds(extent(), { animate: false, paddingTopLeft: [MARGIN_PX, MARGIN_PX], paddingBottomRight: [aside + MARGIN_PX, below + MARGIN_PX] });
  isFitting = false;
  isHome = true;
  state.set({ at: null });
}

// The box of the cells that have heights.
function extent() {
  const [top, left, bottom, right] = surface.extent, [a, , c, , e, f] = surface.transform;
  return L.latLngBounds([f + bottom * e, c + left * a], [f + top * e, c + right * a]);
}

export function bounds() {
  const [rows, cols] = surface.shape;
  const [a, , c, , e, f] = surface.transform;
  return L.latLngBounds([f + rows * e, c], [f, c + cols * a]);
}

export function addLayer(about) {
  const tiles = new Tiles("", {
    name: about.name, tileSize: TILE_PX, minZoom: -surface.levels - 1, maxZoom: CLOSEST, minNativeZoom: -surface.levels,
    maxNativeZoom: 0, bounds: inner(), noWrap: true, keepBuffer: 3, zIndex: layers.size + 1, className: `layer-${about.name}`,
  });
  const number = layers.size + 1;
  const box = element("input", { type: "checkbox", id: `layer-${about.name}`, onchange: () => changed(layer) });
  const share = element("input", {
    type: "range", min: 0, max: 1, step: 0.05, value: 1, "aria-label": `Opacity of ${about.title}`, oninput: () => changed(layer),
  });
  const legend = legendOf(about);
  const layer = { ...about, drawnLegend: about.legend, tiles, box, share, legend, number };
  layers.set(about.name, layer);
  // The highest layer is at the top of the list.
  $("layer-rows").prepend(
    element("div", { class: "layer" }, element("label", { title: `Key ${number}` }, box, element("span", { class: "number" }, number), about.title), share),
  );
  $("legends").prepend(legend);
  show(layer, undefined);
}

export function has(name) {
  return layers.has(name);
}

// Add a layer that became ready later, as the address names it.
export function addLate(about) {
  addLayer(about);
  const share = parsed(state.get("layers") ?? "")[about.name];
  if (share !== undefined) show(layers.get(about.name), share);
}

function show(layer, share) {
  layer.box.checked = share !== undefined;
  if (share !== undefined) layer.share.value = share;
  layer.share.disabled = !layer.box.checked;
  layer.legend.hidden = !layer.box.checked || !layer.drawnLegend;
  markTop();
  layer.tiles.setOpacity(Number(layer.share.value));
  if (layer.box.checked) layer.tiles.addTo(map);
  else layer.tiles.remove();
}

// Where there is room for one legend only, it is that of the highest layer.
function markTop() {
  const all = [...document.querySelectorAll("#legends .legend")], first = all.find((each) => !each.hidden);
  all.forEach((each) => each.classList.toggle("top", each === first));
}

function changed(layer) {
  show(layer, layer.box.checked ? Number(layer.share.value) : undefined);
  state.set({ layers: shown().map(([name, share]) => `${name}:${share}`).join(",") });
}

export function toggle(number) {
  for (const layer of layers.values()) {
    if (layer.number === number) {
      layer.box.checked = !layer.box.checked;
      changed(layer);
    }
  }
}

// Names and opacities of the layers that are shown, the lowest first.
export function shown() {
  return [...layers.values()].filter((layer) => layer.box.checked).map((layer) => [layer.name, Number(layer.share.value)]);
}

export function titles() {
  return [...layers.values()].map(({ name, title }) => ({ name, title }));
}

function legendOf({ legend }) {
  if (!legend) return element("div", { class: "legend", hidden: true });
  const box = element("div", { class: "legend" }, element("b", {}, legend.title));
  if (legend.kind === "scale") {
    box.append(element("div", { class: "bar", style: `background: linear-gradient(to right, ${legend.gradient})` }));
    box.append(element("div", { class: "ticks" }, ...legend.ticks.map((tick) => element("span", {}, tick))));
  } else {
    const items = legend.items.map(({ colour, meaning }) =>
      element("li", {}, element("span", { class: "swatch", style: `background: ${colour}` }), meaning),
    );
    box.append(element("ul", {}, ...(items.length ? items : ["none here"])));
  }
  return box;
}

// The part of the grid that the map shows, as the server takes it, in a picture of at most `side` pixels a side.
export function patch(side, isInside = false) {
  const view = map.getBounds();
  const [a, , c, , e, f] = surface.transform;
  let [left, right] = [view.getWest(), view.getEast()].map((x) => (x - c) / a);
  let [top, bottom] = [view.getNorth(), view.getSouth()].map((y) => (y - f) / e);
  if (isInside) {
    [left, right] = [Math.max(left, 0), Math.min(right, surface.shape[1])];
    [top, bottom] = [Math.max(top, 0), Math.min(bottom, surface.shape[0])];
    if (right - left < 2 || bottom - top < 2) return null;
  }
  const [rows, cols] = [bottom - top, right - left];
  const scale = Math.min(side / Math.max(rows, cols), isInside ? 1 : Infinity);
  return {
    row: top, col: left, rows, cols, height: Math.max(Math.round(rows * scale), 2), width: Math.max(Math.round(cols * scale), 2),
  };
}

export function pictureAddress(part, names) {
  return address("picture.png", { ...part, layer: names });
}

// The map as a picture: what is shown, and what is drawn on it.
export async function exportMap() {
  notice("");
  const size = map.getSize(), below = legendLines();
  const part = { ...patch(1), height: Math.round(size.y), width: Math.round(size.x) };
  const names = shown().map(([name, share]) => `${name}:${share}`);
  const picture = new Image();
  picture.src = pictureAddress(part, names);
  try {
    await picture.decode();
  } catch {
    notice("The map could not be drawn.");
    return null;
  }
  const canvas = element("canvas", { width: size.x, height: size.y + below.height });
  const context = canvas.getContext("2d");
  context.fillStyle = "white";
  context.fillRect(0, 0, canvas.width, canvas.height);
  context.drawImage(picture, 0, 0);
  const drawn = document.querySelector("#map .leaflet-overlay-pane svg");
  if (drawn) await overlay(context, drawn);
  scaleBar(context, size);
  below.draw(context, size.y);
  return canvas;
}

// Legends of the layers that are shown, one below the other, for a picture.
function legendLines() {
  const all = [...layers.values()].filter((layer) => layer.box.checked && layer.drawnLegend).map((layer) => layer.drawnLegend);
  const heights = all.map((legend) => (legend.kind === "scale" ? 62 : 26 + 20 * legend.items.length));
  const draw = (context, top) => {
    all.forEach((legend, i) => {
      context.fillStyle = "black";
      context.font = "bold 13px system-ui, sans-serif";
      context.fillText(legend.title, 12, top + 20);
      context.font = "12px system-ui, sans-serif";
      if (legend.kind === "scale") drawScale(context, legend, top + 26);
      else drawClasses(context, legend, top + 28);
      top += heights[i];
    });
  };
  return { height: heights.reduce((one, other) => one + other, 0), draw };
}

function drawScale(context, { gradient, ticks }, top) {
  const width = 300, colours = gradient.split(", ");
  const fill = context.createLinearGradient(12, 0, 12 + width, 0);
  colours.forEach((colour, i) => fill.addColorStop(i / (colours.length - 1), colour));
  context.fillStyle = fill;
  context.fillRect(12, top, width, 12);
  context.fillStyle = "black";
  ticks.forEach((tick, i) => context.fillText(tick, 12 + (i / (ticks.length - 1)) * (width - 30), top + 27));
}

function drawClasses(context, { items }, top) {
  items.forEach(({ colour, meaning }, i) => {
    context.fillStyle = colour;
    context.fillRect(12, top + 20 * i, 12, 12);
    context.strokeRect(12, top + 20 * i, 12, 12);
    context.fillStyle = "black";
    context.fillText(meaning, 30, top + 20 * i + 11);
  });
}

async function overlay(context, drawn) {
  const [frame, place] = [$("map").getBoundingClientRect(), drawn.getBoundingClientRect()];
  const image = new Image();
  const copy = drawn.cloneNode(true);
  copy.removeAttribute("style");
  copy.setAttribute("xmlns", "http://www.w3.org/2000/svg");
  image.src = `data:image/svg+xml;charset=utf-8,${encodeURIComponent(new XMLSerializer().serializeToString(copy))}`;
  await image.decode();
  context.drawImage(image, place.left - frame.left, place.top - frame.top, place.width, place.height);
}

function scaleBar(context, size) {
  const line = document.querySelector("#map .leaflet-control-scale-line");
  const width = line.offsetWidth;
  context.fillStyle = "rgb(255 255 255 / 80%)";
  context.fillRect(10, size.y - 34, width + 8, 26);
  context.fillStyle = context.strokeStyle = "black";
  context.lineWidth = 2;
  context.beginPath();
  context.moveTo(14, size.y - 18);
  context.lineTo(14, size.y - 12);
  context.lineTo(14 + width, size.y - 12);
  context.lineTo(14 + width, size.y - 18);
  context.stroke();
  context.font = "13px system-ui, sans-serif";
  context.fillText(line.textContent, 18, size.y - 19);
}
