// What the images show: the ground around the cell at two heights, and the vertical line with its match.

import { colour, digitsFor, element } from "./dom.js";
import { lineColour } from "./curves.js";

const CELL_PX = 4, GAP = 14, HEAD = 34;
const CROP_PX = 180;

// Grey values of every image at every height, unpacked once per cell.
export function unpack(match) {
  return match.images.map(({ patches, side }) => {
    const bytes = Uint8Array.from(atob(patches), (letter) => letter.charCodeAt(0));
    return { side, at: (k) => bytes.subarray(k * side * side, (k + 1) * side * side) };
  });
}

function address({ side, at }, k) {
  const canvas = element("canvas", { width: side, height: side });
  const context = canvas.getContext("2d");
  const picture = context.createImageData(side, side);
  at(k).forEach((value, i) => picture.data.set(value ? [value, value, value, 255] : [0, 0, 0, 0], 4 * i));
  context.putImageData(picture, 0, 0);
  return canvas.toDataURL();
}

// Two rows of patches: at the height of the surface, and at the selected height. The correlation window is outlined.
export function windows(match, unpacked, columns) {
  const size = 25 * CELL_PX;
  const n = match.images.length, across = Math.min(n, columns), blocks = Math.ceil(n / across);
  const width = across * (size + GAP), block = 2 * (size + 18) + HEAD + GAP, height = blocks * block;
  const svg = d3.create("svg").attr("viewBox", [0, 0, width, height]).attr("width", width).attr("height", height)
    .attr("role", "img").attr("aria-label", "The ground in each image at the height of the surface and at the selected height")
    .attr("font-size", 11).attr("fill", "currentColor");
  match.images.forEach((image, i) => {
    const x = (i % across) * (size + GAP), y = Math.floor(i / across) * block;
    const name = i ? `${i}. ${image.image}` : `${image.image} (reference)`;
    heading(svg, x, y + 13, name, i);
    for (const row of [0, 1]) {
      const top = y + 20 + row * (size + 18);
      svg.append("image").attr("class", row ? "moving" : "fixed").attr("data-image", i).attr("x", x).attr("y", top)
        .attr("width", size).attr("height", size).attr("preserveAspectRatio", "none").style("image-rendering", "pixelated");
      outline(svg, x, top, size, unpacked[i].side, match.window);
      svg.append("text").attr("class", row ? "moving-value" : "fixed-value").attr("data-image", i).attr("x", x).attr("y", top + size + 12);
    }
  });
  const drawn = svg.node();
  show(drawn, match, unpacked, "fixed", middle(match));
  return drawn;
}

export function middle(match) {
  return (match.heights_m.length - 1) / 2;
}

export function show(svg, match, unpacked, which, k) {
  d3.select(svg).selectAll(`image.${which}`).each(function () {
    d3.select(this).attr("href", address(unpacked[Number(this.dataset.image)], k));
  });
  d3.select(svg).selectAll(`text.${which}-value`).text(function () {
    const i = Number(this.dataset.image);
    const at = `${match.heights_m[k].toFixed(digitsFor(match.step_m))} m`;
    return i ? `${at}: ${value(match.ncc[i - 1][k])}` : at;
  });
}

function value(ncc) {
  return ncc === null ? "not visible" : `ρ ${ncc.toFixed(2)}`;
}

function outline(svg, x, y, size, side, window) {
  const cell = size / side, from = ((side - window) / 2) * cell;
  svg.append("rect").attr("x", x + from).attr("y", y + from).attr("width", window * cell).attr("height", window * cell)
    .attr("fill", "none").attr("stroke", "#ffd400").attr("stroke-width", 1.5);
}

// The vertical line over a crop of every image: + the surface, x the peak, o the selected height.
export function loci(match, columns) {
  const n = match.images.length, across = Math.min(n, columns), size = CROP_PX;
  const width = across * (size + GAP), block = size + 24 + GAP, height = Math.ceil(n / across) * block;
  const svg = d3.create("svg").attr("viewBox", [0, 0, width, height]).attr("width", width).attr("height", height)
    .attr("role", "img").attr("aria-label", "The vertical line of the cell in each image")
    .attr("font-size", 11).attr("fill", "currentColor");
  match.images.forEach((image, i) => {
    const scale = size / Math.max(image.rows, image.cols);
    const place = svg.append("g").attr("transform", `translate(${(i % across) * (size + GAP)} ${Math.floor(i / across) * block + 20})`);
    heading(place, 0, -7, i ? `${i}. ${image.image}` : `${image.image} (reference)`, i);
    place.append("image").attr("href", image.crop).attr("width", image.cols * scale).attr("height", image.rows * scale)
      .attr("preserveAspectRatio", "none").style("image-rendering", "pixelated");
    const line = image.line.map((xy) => drawn(xy, image, scale));
    if (i) {
      // A light line on a dark one is visible on any ground.
      for (const [stroke, width] of [["#000000", 3.6], ["#ffd400", 1.8]]) {
        place.append("path").attr("d", d3.line().defined((d) => d !== null)(line)).attr("fill", "none")
          .attr("stroke", stroke).attr("stroke-width", width);
      }
    }
    cross(place, line[middle(match)], "M-7 0H7M0 -7V7", "#00d0ff");
    cross(place, along(line, match), "M-5 -5L5 5M-5 5L5 -5", "#ff3030");
    for (const [stroke, width] of [["#000000", 4], ["#ffffff", 2]]) {
      place.append("circle").attr("class", "selected-height").attr("r", 5).attr("fill", "none").attr("stroke", stroke)
        .attr("stroke-width", width).datum(line);
    }
  });
  return svg.node();
}

function drawn([x, y], image, scale) {
  return x === null || y === null ? null : [(x - image.col + 0.5) * scale, (y - image.row + 0.5) * scale];
}

function cross(place, at, path, stroke) {
  if (!at) return;
  for (const [colour, width] of [["#000000", 4], [stroke, 2]]) {
    place.append("path").attr("d", path).attr("transform", `translate(${at})`).attr("stroke", colour).attr("stroke-width", width);
  }
}

// The name of an image, with the colour of its curve below it.
function heading(svg, x, y, name, i) {
  svg.append("text").attr("x", x).attr("y", y).attr("font-weight", 600).text(short(name)).append("title").text(name);
  if (i) svg.append("rect").attr("x", x).attr("y", y + 2).attr("width", 24).attr("height", 3).attr("fill", lineColour(i - 1));
}

// The image point of the peak, which lies between two of the heights.
function along(line, match) {
  if (match.peak_m === null) return null;
  const [low, high] = [match.heights_m[0], match.heights_m.at(-1)];
  const k = ((match.peak_m - low) / (high - low)) * (line.length - 1);
  const [one, other] = [line[Math.floor(k)], line[Math.ceil(k)]];
  return one && other ? one.map((value, i) => value + (k % 1) * (other[i] - value)) : null;
}

export function moveLoci(svg, k) {
  d3.select(svg).selectAll("circle.selected-height").each(function (line) {
    const at = line[k];
    d3.select(this).attr("visibility", at ? null : "hidden").attr("transform", at ? `translate(${at})` : null);
  });
}

function short(name) {
  return name.length > 15 ? `${name.slice(0, 7)}…${name.slice(-7)}` : name;
}

export function inkOf(label) {
  return colour({ 1: "good", 0: "fair", "-1": "poor" }[label]);
}
