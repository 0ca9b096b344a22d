// Match curves: correlation against height, with the important heights marked.

import { colour } from "./dom.js";

// The colours of Okabe and Ito, as in the figures of `zlocus curves`; lighter on a dark page.
const LIGHT = ["#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#8B5A2B", "#7A5195"];
const DARK = ["#4aa8e0", "#ff8a4a", "#33cfa3", "#e39ac6", "#f0b73a", "#8fd0f5", "#c08a58", "#ad85c9"];
const DASHES = ["", "7 4", "2 3"];
const SIZE = { width: 520, height: 266, marginLeft: 42, marginBottom: 44, marginTop: 16, marginRight: 12 };

export function isDark() {
  return document.documentElement.dataset.theme === "dark" ||
    (document.documentElement.dataset.theme !== "light" && matchMedia("(prefers-color-scheme: dark)").matches);
}

export function lineColour(j) {
  const colours = isDark() ? DARK : LIGHT;
  return colours[j % colours.length];
}

export function dashes(j) {
  return DASHES[Math.floor(j / LIGHT.length) % DASHES.length];
}

function points(heights, values, name) {
  return heights.map((height, k) => ({ height, value: values[k], name }));
}

function frame(match, marks, label, reference) {
  const heights = match.heights_m;
  return Plot.plot({
    ...SIZE, ariaLabel: label, style: { fontSize: "12px", background: "transparent" },
    x: { domain: [heights[0], heights.at(-1)], label: "height, m", labelAnchor: "center", labelArrow: "none" },
    y: { domain: [-1, 1.05], label: "correlation", ticks: [-1, -0.5, 0, 0.5, 1], labelArrow: "none" },
    marks: [
      Plot.ruleY([0], { stroke: "currentColor", strokeOpacity: 0.3 }),
      ...(reference > heights[0] && reference < heights.at(-1) ? [Plot.ruleX([reference], { stroke: colour("warn"), strokeDasharray: "2 3", strokeWidth: 1.6 })] : []),
      Plot.ruleX([match.xyz[2]], { stroke: "currentColor", strokeOpacity: 0.45, strokeDasharray: "5 4" }),
      ...marks,
    ],
  });
}

// NCC with each search image, their peaks, and the values at the pointer.
export function single(match, reference) {
  const drawn = match.curves.map((curve, j) => ({ ...curve, j, points: points(match.heights_m, match.ncc[j], curve.image) }));
  const marks = drawn.map((each) =>
    Plot.line(each.points, { x: "height", y: "value", stroke: lineColour(each.j), strokeWidth: 1.5, strokeDasharray: dashes(each.j) }),
  );
  const peaks = drawn.filter((each) => each.rho1 !== null);
  return frame(match, [
    ...marks,
    Plot.dot(peaks, { x: "peak_m", y: "rho1", symbol: "times", stroke: (d) => lineColour(d.j), strokeWidth: 2, r: 5 }),
    tips(drawn.flatMap((each) => each.points)),
  ], "Correlation with each search image against height", reference);
}

// The means of the first 1, 2, ... images from pale to dark; the one with which the match ends is thick.
export function means(match, before, reference) {
  const used = match.stop.images;
  const steps = match.sncc.map((values, m) => ({ m: m + 1, points: points(match.heights_m, values, `mean of ${m + 1}`) }));
  const marks = steps.map((each) => {
    const isEnd = each.m === used;
    const shade = each.m > used ? { strokeOpacity: 0.5, strokeDasharray: "2 4" } : { strokeOpacity: isEnd ? 1 : 0.25 + (0.5 * each.m) / used };
    return Plot.line(each.points, { x: "height", y: "value", stroke: "currentColor", strokeWidth: isEnd ? 2.6 : 1.3, ...shade });
  });
  if (before) {
    const old = points(before.heights_m, before.sncc[before.stop.images - 1], "as in the run");
    marks.push(Plot.line(old, { x: "height", y: "value", stroke: colour("warn"), strokeWidth: 1.8, strokeDasharray: "6 4" }));
  }
  const end = match.means[used - 1];
  const peak = end && end.rho1 !== null ? [Plot.dot([end], { x: "peak_m", y: "rho1", symbol: "times", stroke: "currentColor", strokeWidth: 2.5, r: 7 })] : [];
  return frame(match, [...marks, ...peak, tips(steps.flatMap((each) => each.points))], "Mean correlation against height", reference);
}

function tips(all) {
  const known = all.filter((each) => each.value !== null);
  return Plot.tip(known, Plot.pointer({
    x: "height", y: "value", maxRadius: 30, fill: colour("raised"), stroke: colour("line"),
    title: (d) => `${d.name}\n${d.value.toFixed(3)} at ${d.height.toFixed(2)} m`,
  }));
}

// Mark the selected height as a line on an existing chart.
export function mark(svg, match, k) {
  const scale = svg.scale("x");
  const [low, high] = scale.domain, [left, right] = scale.range;
  const x = left + ((match.heights_m[k] - low) / (high - low)) * (right - left);
  const line = d3.select(svg).selectAll("line.selected-height").data([x]).join("line");
  line.attr("class", "selected-height").attr("x1", x).attr("x2", x).attr("y1", SIZE.marginTop).attr("y2", SIZE.height - SIZE.marginBottom)
    .attr("stroke", colour("accent")).attr("stroke-width", 2).attr("pointer-events", "none");
}

// Costs of a cell by height: all of them as a line, those of the coarser level as an area.
export function costs({ heights_m, cost, known_cost, chosen }) {
  const points = heights_m.map((height, k) => ({ height, cost: cost[k], known: known_cost[k] }));
  return Plot.plot({
    ...SIZE, height: 200, ariaLabel: "Cost against height", style: { fontSize: "12px", background: "transparent" },
    x: { domain: [heights_m[0], heights_m.at(-1)], label: "height, m", labelAnchor: "center", labelArrow: "none" },
    y: { domain: [0, 255], label: "cost", ticks: [0, 50, 100, 150, 200, 250], labelArrow: "none" },
    marks: [
      Plot.areaY(points, { x: "height", y: "known", fill: colour("accent"), fillOpacity: 0.25 }),
      Plot.line(points, { x: "height", y: "cost", stroke: "currentColor", strokeWidth: 1.6 }),
      Plot.ruleX([heights_m[chosen]], { stroke: colour("accent"), strokeWidth: 2 }),
      Plot.tip(points, Plot.pointerX({
        x: "height", y: "cost", fill: colour("raised"), stroke: colour("line"), title: (d) => `cost ${d.cost} at ${d.height.toFixed(2)} m`,
      })),
    ],
  });
}
