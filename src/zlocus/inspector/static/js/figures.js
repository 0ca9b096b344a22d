// Figures as files: an SVG as it is, or drawn into a PNG of twice its size.

import { colour, element } from "./dom.js";

const SCALE = 2;

// Give a figure its buttons. svg, name : give the drawing as it is now, if there is one, and the name of its file.
export function exportable(figure, name, svg) {
  const buttons = element("span", {}), title = figure.querySelector("figcaption span").textContent;
  for (const kind of ["SVG", "PNG"]) {
    const save = () => svg() && (kind === "SVG" ? saveSvg(svg(), name()) : savePng(svg(), name()));
    buttons.append(element("button", { type: "button", onclick: save, "aria-label": `${title}, as ${kind}` }, kind));
  }
  figure.querySelector("figcaption").append(buttons);
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

// An SVG that needs no style sheet: colours of the page are written into it.
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
