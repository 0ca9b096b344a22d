// The panel of one cell: its values in the surface, its match, and its match with other settings.

import * as accounts from "./accounts.js";
import { asked, Refused } from "./api.js";
import * as curves from "./curves.js";
import { $, digitsFor, element, metres, notice, signed } from "./dom.js";
import { exportable } from "./figures.js";
import * as map from "./map.js";
import * as state from "./state.js";
import * as windows from "./windows.js";

const MAX_LISTED = 100;
const LABELS = { 1: "good", 0: "fair", "-1": "poor" };
// Columns of the table of images, and what they mean.
const HEADS = [
  ["use, image", "Switch an image off to match the cell without it"], ["match", "Label of the match curve with the reference image"],
  ["highest ρ", "Highest correlation with the reference image"], ["ratio", "Highest correlation over that of the second peak"],
  ["peak, m", "Height of the highest correlation"], ["labels", "Sum of the labels at the tie points around"],
  ["mean", "Label of the mean of this and the images above it"], ["σ, m", "Predicted standard deviation of the peak of that mean"],
];
const WAIT_MS = 700;
// While a key or a spinner is held, only the last of many cells is requested.
const REST_MS = 60;
// Options that influence the curves of a cell most; the others follow under "More".
const FIRST = [
  "rho1_high", "ratio_high", "rho1_middle", "ratio_middle", "rho1_low", "ratio_low", "rho1_fair", "ratio_fair", "max_sigma_steps",
  "neighbours", "radius_px", "order", "min_label_share", "max_images",
];
let surface, leaflet, drawn, shown = null, asRun = null, busy = null, resting = null, framed = null, unpacked = [];
let charts = {};

export function make(about, theMap) {
  [surface, leaflet] = [about, theMap];
  drawn = L.layerGroup().addTo(leaflet);
  $("height").addEventListener("input", () => {
    // At most once per frame.
    framed ??= requestAnimationFrame(() => {
      framed = null;
      moved(true);
    });
  });
  $("reset").addEventListener("click", () => asInRun());
  $("options").addEventListener("change", () => changed());
  $("options").addEventListener("submit", (event) => event.preventDefault());
  makeOptions();
  for (const [id, what] of [["ncc", "correlation"], ["sncc", "mean"], ["windows", "windows"], ["loci", "lines"]]) {
    const name = () => `${surface.title}_${what}_${shown?.row}_${shown?.col}`;
    exportable($(`${id}-figure`), name, () => charts[id], () => words(id));
  }
  for (const kind of ["focusin", "pointerover"]) $("options").addEventListener(kind, explain);
  $("others").addEventListener("toggle", () => otherImages());
  $("find").addEventListener("input", () => otherImages());
}

// Title and legend of a figure that is saved without the page.
function words(id) {
  const lines = id === "ncc" ? shown.match.curves.map(({ image }, j) => ({ text: `${j + 1}. ${image}`, colour: curves.lineColour(j) })) : [];
  const below = $(`${id}-figure`).querySelector(":scope > p.aside")?.textContent.replace(/\s+/g, " ").trim();
  if (below) lines.push({ text: below });
  if (id === "windows") lines.push(...accounts.sentences().map((text) => ({ text })));
  if (["windows", "ncc", "sncc"].includes(id)) lines.push({ text: `selected height: ${$("height-value").textContent}` });
  const title = `${$(`${id}-figure`).querySelector("figcaption span").textContent}, reference ${shown.match.reference}`;
  return { title, subtitle: `${surface.title}, row ${shown.row}, column ${shown.col} (${map.words(shown.x, shown.y)})`, lines };
}

function explain(event) {
  const text = event.target.closest("#options label")?.title;
  if (text) $("option-doc").textContent = text;
}

// Open the cell at a ground point.
export function look(x, y) {
  state.set({ cell: `${map.place(x)},${map.place(y)}`, height: null });
  return open();
}

// Open the neighbour of the cell, where there is one.
export function step(down, across) {
  const at = state.numbers("cell", 2);
  if (!at) return;
  const [a, , , , e] = surface.transform, next = [at[0] + across * a, at[1] + down * e];
  if (!map.holds(...next)) return;
  state.set({ cell: next.map(map.place).join(","), height: null });
  soon();
}

function soon() {
  clearTimeout(resting);
  resting = setTimeout(open, REST_MS);
}

// The cell that the address names, or none.
export async function open() {
  const at = state.numbers("cell", 2);
  $("cell-empty").hidden = Boolean(at);
  $("cell-content").hidden = !at;
  busy?.abort();
  drawn.clearLayers();
  if (!at) {
    shown = null;
    accounts.clear();
    if (state.get("cell")) notice(`The link does not name a place: cell=${state.get("cell")}.`);
    return;
  }
  $("changed").hidden = !Object.keys(whatIf()).length;
  if (!map.holds(...at)) {
    $("cell-title").textContent = map.words(...at);
    fail("The point lies outside the surface.");
    return;
  }
  busy = new AbortController();
  const { signal } = busy;
  $("match").setAttribute("aria-busy", "true");
  fillOptions();
  try {
    await load(at, signal);
  } catch (error) {
    if (error.name === "AbortError") return;
    fail(error instanceof Refused ? error.message : "The server does not answer. Is `zlocus inspect` still running?");
  }
}

async function load([x, y], signal) {
  const changes = whatIf();
  let record = await asked("cell", { ...changes, x, y }, signal);
  facts(record);
  while (record.is_pending) {
    $("cell-error").hidden = false;
    $("cell-error").textContent = "The images are being opened. The match curves will follow.";
    await new Promise((done) => setTimeout(done, WAIT_MS));
    if (signal.aborted) return;
    record = await asked("cell", { ...changes, x, y }, signal);
  }
  const isChanged = Object.keys(changes).length > 0;
  if (!isChanged) asRun = record;
  else if (asRun?.row !== record.row || asRun?.col !== record.col) asRun = await asked("cell", { x, y }, signal);
  shown = record;
  facts(record);
  mark(record);
  accounts.show(record);
  if (record.match) {
    $("cell-error").hidden = true;
    $("match").hidden = false;
    match(record.match, isChanged ? asRun.match : null);
    $("match").setAttribute("aria-busy", "false");
  } else {
    noMatch(record.error);
  }
  document.dispatchEvent(new CustomEvent("looked", { detail: record }));
}

// Nothing of the previous cell stays beside an error message.
function fail(text) {
  shown = null;
  accounts.clear();
  for (const id of ["cell-facts", "cell-reasons"]) $(id).replaceChildren();
  noMatch(text);
}

function noMatch(text) {
  charts = {};
  $("cell-error").hidden = false;
  $("cell-error").textContent = text;
  $("match").hidden = true;
  $("match").setAttribute("aria-busy", "false");
}

function facts(record) {
  $("cell-title").textContent = `Cell at row ${record.row}, column ${record.col}`;
  for (const each of document.querySelectorAll(".begun")) {
    each.textContent = record.height_m === null ? "height at the start" : "height of the surface";
  }
  const rows = [
    ["Place", map.words(record.x, record.y, digitsFor(surface.transform[0]))],
    ["Height", record.height_m === null ? "none" : `${metres(record.height_m, digits())} (${surface.height_name})`],
    ["Standard deviation", metres(record.sigma_m, digits() + 1)],
    ["Images used", record.height_m === null ? "–" : String(record.n_images)],
  ];
  if (record.above_terrain_m !== null) rows.push(["Height above the DTM", metres(record.above_terrain_m, digits())]);
  if (record.difference_m !== null) rows.push(["Surface less reference", `${signed(Number(record.difference_m.toFixed(digits())))} m`]);
  const ids = { Height: "cell-height", "Standard deviation": "cell-sigma", "Images used": "cell-images", "Surface less reference": "cell-difference" };
  $("cell-facts").replaceChildren(
    ...rows.flatMap(([name, text]) => [element("dt", {}, name), element("dd", { id: ids[name] ?? null }, text)]),
  );
  // A cell without a height shows only the reasons for that.
  const said = record.height_m === null ? record.reasons.filter(({ fate }) => fate === "none") : record.reasons;
  $("cell-reasons").replaceChildren(...said.map(reason));
}

// Decimals of heights, which are at best precise to a tenth of a cell.
function digits() {
  return digitsFor(surface.transform[0]);
}

function reason({ name, meaning, fate, advice }) {
  const said = [capital(meaning), fate === "none" ? "So there is no height" : "", capital(advice)].filter(Boolean);
  return element("li", {}, element("b", {}, name), ` ${said.map((part) => `${part}.`).join(" ")}`);
}

function capital(text) {
  return text && text[0].toUpperCase() + text.slice(1);
}

// The cell, and the tie points that order its images, on the map.
function mark(record) {
  drawn.clearLayers();
  const [a] = surface.transform;
  const half = a / 2, at = [record.y, record.x], ink = "#e6007a";
  L.rectangle([[record.y - half, record.x - half], [record.y + half, record.x + half]], { color: ink, weight: 2, fill: false, interactive: false }).addTo(drawn);
  L.circleMarker(at, { radius: 11, color: ink, weight: 2, fill: false, interactive: false }).addTo(drawn);
  const around = record.match?.neighbours;
  if (!around) return;
  if (around.by === "tin" && around.points.length === 3) {
    L.polygon(around.points.map((p) => [p.y, p.x]), { color: ink, weight: 1.5, fill: false, interactive: false }).addTo(drawn);
  } else if (around.by === "radius") {
    L.circle(at, { radius: around.radius_m, color: ink, weight: 1.5, dashArray: "5 5", fill: false, interactive: false }).addTo(drawn);
  }
  for (const point of around.points) {
    const sum = point.labels.reduce((one, other) => one + other, 0);
    L.circleMarker([point.y, point.x], { radius: 5, weight: 1.5, color: "#fff", fillColor: windows.inkOf(Math.sign(sum)), fillOpacity: 1 })
      .bindTooltip(`${point.says}<br>${point.labels_say}`).addTo(drawn)
      .getElement().setAttribute("tabindex", "-1");
  }
}

function match(found, before) {
  unpacked = windows.unpack(found);
  const reference = shown.difference_m === null ? null : shown.height_m - shown.difference_m;
  $("match-stop").textContent = `${peak(found)} ${found.says.stop} One step of height is ${metres(found.step_m, digitsFor(found.step_m) + 1)}.`;
  $("match-run").textContent = `${apart(found)}${ofRun(found)}`;
  $("match-order").textContent = `Each image gets a label at every tie point around: good, fair or poor, as it matches the reference image there. The labels come from ${found.says.order}. ${howOrdered()} The blue line is drawn below the last image that is used.`;
  draw("ncc", curves.single(found, reference), key(found, reference));
  draw("sncc", curves.means(found, before, reference), before ? element("p", { class: "aside" }, "dashed in colour: the mean with which the match ends with the options of the run") : null);
  const columns = Math.max(2, Math.floor(($("windows-figure").clientWidth || 500) / 118));
  draw("windows", windows.windows(found, unpacked, columns));
  draw("loci", windows.loci(found, Math.max(2, Math.floor(($("loci-figure").clientWidth || 500) / 200))));
  imageTable(found);
  tieTable(found);
  fillReferences(found);
  $("height").max = found.heights_m.length - 1;
  const asked = state.numbers("height", 1);
  $("height").value = asked ? nearest(found, asked[0]) : windows.middle(found);
  moved(false);
}

function peak(found) {
  if (found.peak_m === null) return "There is no peak.";
  const sigma = found.sigma_m[found.stop.images - 1];
  const precisely = digitsFor(found.step_m) + 1;
  return `The peak lies at ${metres(found.peak_m, precisely)}, ${sigma === null ? "without a predicted standard deviation" : `with a predicted standard deviation of ${metres(sigma, precisely)}`}.`;
}

// Distance of the surface from the peak, and the reason for it.
function apart(found) {
  if (shown.height_m === null || found.peak_m === null) return "";
  const away = shown.height_m - found.peak_m, reasons = shown.reasons.map(({ name }) => name);
  if (Math.abs(away) < 1.5 * found.step_m) return "";
  const [low, high] = [found.heights_m[0], found.heights_m.at(-1)];
  const isAtEnd = Math.min(found.peak_m - low, high - found.peak_m) < 1.5 * found.step_m;
  const why = reasons.includes("PLANE") ? "Its height is that of the plane fitted to the whole segment." :
    reasons.includes("FILLED") ? "Its height was interpolated from the neighbours." :
    "The neighbouring cells, smaller windows or other images led to another height than this cell alone.";
  return `The surface lies ${metres(Math.abs(away))} ${away > 0 ? "above" : "below"} this peak. ${isAtEnd ? "The peak lies at an end of the heights compared, so that it is not reliable. " : ""}${why} `;
}

function howOrdered() {
  const chosen = (name) => state.get(`if.${name}`) ?? surface.options.find((each) => each.name === name)?.value;
  return chosen("order") === "angle" ?
    `Images that help come in the order of their angle to the reference, nearest to ${chosen("best_angle_deg")} degrees first; the others follow.` :
    "Images with the highest sum of labels come first.";
}

// Differences between the run and the match of a single cell.
function ofRun(found) {
  if (surface.method === "gc3-sgm") {
    return "The run matched the pixels of the images (gc3-sgm). The curves are those of the vertical line through the cell.";
  }
  const window = `${found.window} × ${found.window}`;
  const used = shown.height_m === null ? "" : `The run measured the final height with ${shown.n_images} of ${surface.images.length} images, the reference image included. It left out images in which the cell is occluded. `;
  const constraint = surface.method === "mvll" ? "" : " It also applies the semi-global constraint, which makes neighbouring cells agree.";
  const curves_text = ` These curves use windows of ${window} cells. The run also uses smaller windows and grey values.${constraint}`;
  if (surface.selection !== "guided") {
    return `${used}The run compares all images. Order and stop are those that --selection guided would give this cell.${curves_text}`;
  }
  return `${used}The run chooses the images by the same rule, for blocks of cells of the next coarser level.${curves_text}`;
}

function nearest(found, height) {
  return found.heights_m.reduce((best, value, k, all) => (Math.abs(value - height) < Math.abs(all[best] - height) ? k : best), 0);
}

function draw(id, svg, ...below) {
  charts[id] = svg;
  $(`${id}-figure`).querySelector(".drawing").replaceChildren(svg, ...below.filter(Boolean));
}

function key(found, reference) {
  const own = reference === null ? [] : [element("span", {}, element("i", { style: "border-color: var(--warn); border-top-style: dashed" }), `reference, ${metres(reference, digits())}`)];
  return element("div", { class: "key" }, ...own, ...found.curves.map(({ image }, j) =>
    element("span", {}, element("i", { style: `border-color: ${curves.lineColour(j)}; border-top-style: ${curves.dashes(j) ? "dashed" : "solid"}` }), `${j + 1}. ${image}`),
  ));
}

// Show the height of the slider in all figures.
function moved(isAsked) {
  const found = shown?.match;
  if (!found) return;
  const k = Number($("height").value), height = found.heights_m[k];
  const text = metres(height, digitsFor(found.step_m));
  $("height-value").textContent = text;
  $("height").setAttribute("aria-valuetext", text);
  const each = found.curves.map(({ image }, j) => `${image} ${correlation(found.ncc[j][k])}`);
  $("height-text").textContent = `At this height the mean correlation of ${found.stop.images === 1 ? "the first image" : `the first ${found.stop.images} images`} is ${correlation(found.sncc[found.stop.images - 1][k])}. Of each image: ${each.join(", ")}.`;
  curves.mark(charts.ncc, found, k);
  curves.mark(charts.sncc, found, k);
  windows.show(charts.windows, found, unpacked, "moving", k);
  windows.moveLoci(charts.loci, k);
  if (isAsked) state.set({ height: height.toFixed(3) });
}

function correlation(value) {
  return value === null ? "not visible" : value.toFixed(2);
}

export function slide(by) {
  $("height").value = Number($("height").value) + by;
  moved(true);
}

function imageTable(found) {
  const rows = [element("tr", {}, ...HEADS.map(([head, meaning]) => element("th", { scope: "col", title: meaning }, head)))];
  const order = found?.curves.map((curve) => curve.image) ?? [];
  if (found) rows.push(imageRow(found.reference, ["reference image", "", "", "", "", "", ""]));
  order.forEach((name, j) => {
    const [one, mean] = [found.curves[j], found.means[j]];
    const cells = [
      label(one.label, name, "label"), text(one.rho1, 4, "rho1"), text(one.ratio, 3, "ratio", one.rho1 !== null),
      text(one.rho1 === null ? null : one.peak_m, digitsFor(found.step_m), "peak"),
      signed(found.order.images[j].accumulated), label(mean.label, name, "mean"), text(found.sigma_m[j], 3, "sigma"),
    ];
    rows.push(imageRow(`${j + 1}. ${name}`, cells, name, j + 1 === found.stop.images ? "last" : j + 1 > found.stop.images ? "off" : ""));
  });
  const off = new Set(state.all("without"));
  off.forEach((name) => rows.push(imageRow(name, ["switched off", "", "", "", "", "", ""], name, "off")));
  const held = document.activeElement?.getAttribute("aria-label");
  $("images").replaceChildren(element("caption", { class: "hidden" }, "Images in their order"), ...rows);
  if (held?.startsWith("Use ")) [...$("images").querySelectorAll("input")].find((box) => box.getAttribute("aria-label") === held)?.focus();
  const rest = others();
  $("others").hidden = !rest.length;
  $("others").querySelector("summary").textContent = `Not compared: ${rest.length} of ${surface.images.length} images`;
  otherImages();
}

// Images that do not show the cell, or are ranked lower than those that are compared.
function others() {
  const found = shown?.match, known = new Set([found?.reference, ...(found?.curves ?? []).map((curve) => curve.image), ...state.all("without")]);
  return surface.images.filter((name) => !known.has(name));
}

// Those that match the search text, while the list is open.
function otherImages() {
  const names = $("others").open ? others().filter((name) => name.toLowerCase().includes($("find").value.toLowerCase())) : [];
  const rows = names.slice(0, MAX_LISTED).map((name) => imageRow(name, ["not compared"], name, "off"));
  if (names.length > MAX_LISTED) rows.push(element("tr", {}, element("td", {}, `and ${names.length - MAX_LISTED} more`)));
  $("other-images").replaceChildren(...rows);
}

function imageRow(heading, cells, name = heading, kind = "") {
  const isOff = state.all("without").includes(name);
  const box = element("input", { type: "checkbox", "aria-label": `Use ${name}`, onchange: () => switchImage(name, box.checked) });
  box.checked = !isOff;
  return element("tr", { class: kind, "data-image": name }, element("th", { scope: "row" }, element("label", {}, box, heading)), ...cells.map((cell) =>
    cell instanceof Node ? cell : element("td", {}, cell)));
}

function text(value, digits, what, hasPeak = true) {
  return element("td", { "data-value": what }, value === null ? (what === "ratio" && hasPeak ? "∞" : "none") : value.toFixed(digits));
}

function label(value, name, what) {
  return element("td", { class: `label-${value}`, "data-value": what }, LABELS[value]);
}

function tieTable(found) {
  const { points } = found.neighbours, decimals = digitsFor(surface.transform[0]);
  $("ties-say").textContent = found.neighbours.says;
  const caption = element("caption", { class: "hidden" }, "Heights of the tie points around the cell, and how well the images match there");
  const heads = [["away, m", "Distance from the cell"], ["height, m", "Height of the tie point"], ["above, m", "Height above the surface there"],
    ...found.curves.map(({ image }) => [image, `How well ${image} matches the reference image there`])];
  const rows = points.slice(0, 12).map((point) => element("tr", {}, element("th", { scope: "row" }, point.distance_m.toFixed(decimals - 1)),
    element("td", {}, point.height_m.toFixed(decimals)),
    element("td", {}, point.above_surface_m === null ? "–" : signed(point.above_surface_m.toFixed(decimals))),
    ...point.labels.map((value) => element("td", { class: `label-${value}` }, LABELS[value]))));
  if (points.length > rows.length) rows.push(element("tr", {}, element("td", {}, `and ${points.length - rows.length} more`)));
  if (!points.length) rows.push(element("tr", {}, element("td", {}, "none is near enough")));
  $("ties").replaceChildren(caption, element("tr", {}, ...heads.map(([head, meaning]) => element("th", { scope: "col", title: meaning }, head))), ...rows);
}

function switchImage(name, isOn) {
  const off = state.all("without").filter((each) => each !== name);
  state.set({ without: isOn ? off : [...off, name] });
  open();
}

// Settings that differ from the run, as parameters of a request.
function whatIf() {
  const found = Object.fromEntries(state.entries("if."));
  const without = state.all("without");
  return without.length ? { ...found, without } : found;
}

function asInRun() {
  state.set({ without: null, ...Object.fromEntries(state.entries("if.").map(([name]) => [`if.${name}`, null])) });
  open();
}

function makeOptions() {
  const known = Object.fromEntries(surface.options.map((each) => [each.name, each]));
  const others = surface.options.map(({ name }) => name).filter((name) => !FIRST.includes(name));
  const window = { name: "window", value: surface.window.value, choices: surface.window.choices, doc: "Side of the correlation window.", unit: "cells" };
  const reference = { name: "reference", value: "", choices: [""], doc: "Reference image.", unit: "" };
  $("options").append(...[window, reference, ...FIRST.map((name) => known[name])].map(optionRow));
  $("options").append(element("details", { style: "grid-column: 1 / -1" }, element("summary", {}, "More"), ...others.map((name) => optionRow(known[name]))));
}

function optionRow({ name, value, choices, low, high, is_whole, doc, unit }) {
  const input = choices
    ? element("select", { name }, ...choices.map((each) => element("option", { value: each }, each === "" ? "the best" : String(each))))
    : element("input", { type: "number", name, min: low, max: high, step: is_whole ? 1 : "any" });
  input.value = value;
  input.dataset.asRun = String(value);
  const range = choices || low === null || high === null ? "" : ` ${low} to ${high}${unit ? ` ${unit}` : ""}.`;
  return element("label", { title: `${name}: ${doc}${range}` }, element("span", {}, name), input);
}

// Reference images to choose from: those that are compared here.
function fillReferences(found) {
  const select = $("options").querySelector("select[name=reference]"), value = state.get("if.reference") ?? "";
  const names = new Set(["", found.reference, ...found.curves.map(({ image }) => image), value]);
  select.replaceChildren(...[...names].map((name) => element("option", { value: name }, name || "the best")));
  select.value = value;
}

function inputs() {
  return [...$("options").querySelectorAll("input, select")];
}

function fillOptions() {
  const asked = Object.fromEntries(state.entries("if."));
  for (const input of inputs()) {
    input.value = asked[input.name] ?? input.dataset.asRun;
    input.parentElement.classList.toggle("is-changed", input.name in asked);
  }
}

function changed() {
  const bad = inputs().find((input) => !input.checkValidity());
  if (bad) {
    bad.reportValidity();
    return;
  }
  state.set(Object.fromEntries(inputs().map((input) => [`if.${input.name}`, input.value === input.dataset.asRun ? null : input.value])));
  soon();
}

// Draw the figures again after the colours have changed.
export function redraw() {
  if (shown?.match) match(shown.match, $("changed").hidden ? null : asRun?.match);
}
