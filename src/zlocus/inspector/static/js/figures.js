// Figures as files: SVG, or PNG of twice the size.

import { colour, element } from "./dom.js";

const SCALE = 2;

// Add buttons that save a figure. svg, name, words : functions that return the current drawing, if there is one, the name
// of its file, and its title and legend.
export function exportable(figure, name, svg, words) {
  const buttons = element("span", { class: "save" }, "Save as"), title = figure.querySelector("figcaption span").textContent;
  for (const kind of ["SVG", "PNG"]) {
    const save = () => {
      if (!svg()) return;
      const drawn = captioned(svg(), words());
      if (kind === "SVG") saveSvg(drawn, name());
      else savePng(drawn, name());
    };
    buttons.append(element("button", { type: "button", onclick: save, "aria-label": `${title}, as ${kind}` }, kind));
  }
  figure.querySelector("figcaption").append(buttons);
}

// A drawing with its title above and its key below.
function captioned(svg, { title, subtitle, lines }) {
  const [width, height] = [widthOf(svg), heightOf(svg)], most = Math.floor(width / 6.4);
  const wrapped = lines.flatMap(({ text, colour: ink }) => wrap(text, most).map((part, i) => ({ text: part, ink: i ? null : ink })));
  const whole = d3.create("svg").attr("width", width).attr("height", height + 48 + 17 * wrapped.length + 8)
    .attr("fill", "currentColor").attr("font-size", 12);
  whole.attr("viewBox", `0 0 ${width} ${whole.attr("height")}`);
  whole.append("text").attr("x", 4).attr("y", 16).attr("font-weight", 600).attr("font-size", 13).text(title);
  whole.append("text").attr("x", 4).attr("y", 33).attr("font-size", 11).text(subtitle);
  const copy = svg.cloneNode(true);
  copy.setAttribute("y", 42);
  copy.setAttribute("width", width);
  copy.setAttribute("height", height);
  whole.node().append(copy);
  wrapped.forEach(({ text, ink }, i) => {
    const y = height + 60 + 17 * i;
    if (ink) whole.append("rect").attr("x", 4).attr("y", y - 5).attr("width", 22).attr("height", 3).attr("fill", ink);
    whole.append("text").attr("x", ink ? 32 : 4).attr("y", y).attr("font-size", 11).text(text);
  });
  return whole.node();
}

function wrap(text, most) {
  const lines = [""];
  for (const word of text.split(" ")) {
    if (lines.at(-1).length + word.length > most) lines.push("");
    lines.push(`${lines.pop()} ${word}`.trim());
  }
  return lines;
}

export function saveSvg(svg, name) {
  save(new Blob([textOf(svg)], { type: "image/svg+xml" }), `${name}.svg`);
}

export async function savePng(svg, name) {
  const picture = new Image();
  picture.src = `data:image/svg+xml;charset=utf-8,${encodeURIComponent(textOf(svg))}`;
  await picture.decode();
  const canvas = element("canvas", { width: SCALE * widthOf(svg), height: SCALE * heightOf(svg) });
  canvas.getContext("2d").drawImage(picture, 0, 0, canvas.width, canvas.height);
  saveCanvas(canvas, name);
}

export function saveCanvas(canvas, name) {
  canvas.toBlob((blob) => save(blob, `${name}.png`), "image/png");
}

// An SVG without a style sheet: the colours of the page are written into it.
export function textOf(svg) {
  const copy = svg.cloneNode(true);
  copy.setAttribute("xmlns", "http://www.w3.org/2000/svg");
  copy.setAttribute("width", widthOf(svg));
  copy.setAttribute("height", heightOf(svg));
  copy.style.color = colour("ink");
  copy.style.background = colour("paper");
  copy.style.fontFamily = "system-ui, sans-serif";
  const text = new XMLSerializer().serializeToString(copy);
  return text.replaceAll("var(--plot-background)", colour("paper")).replace(/var\(--([a-z]+)\)/g, (_, name) => colour(name));
}

function save(blob, name) {
  const link = element("a", { href: URL.createObjectURL(blob), download: name });
  document.body.append(link);
  link.click();
  link.remove();
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
}

function widthOf(svg) {
  return Number(svg.getAttribute("width")) || svg.viewBox.baseVal.width;
}

function heightOf(svg) {
  return Number(svg.getAttribute("height")) || svg.viewBox.baseVal.height;
}
