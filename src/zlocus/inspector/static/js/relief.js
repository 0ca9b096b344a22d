// The 3-D view: the surface with a layer as its texture. It is broken at jumps, where the heights of neighbouring places
// belong to two surfaces: each goes on level to the middle between the places, and a plain grey wall joins the two.

import * as THREE from "three";
import { ask } from "./api.js";
import { $, colour, element } from "./dom.js";
import { saveCanvas } from "./figures.js";
import * as map from "./map.js";
import * as state from "./state.js";
import { OrbitControls } from "../vendor/three/OrbitControls.js";

const MAX_SIDE = 512, PICTURE_SIDE = 2048;
// Factor of the distance for each key press.
const CLOSER = 0.85;
// Bits of a place: the surface is broken between it and the next place in its row, and in its column.
const TO_RIGHT = 1, TO_BELOW = 2;
const WALL_GREY = 0x9a9a9a;
let surface, renderer, scene, camera, controls, mesh = null, walls = null, span = 0, shows = 0, isPlaced = false;

export function make(about) {
  surface = about;
  $("drape").addEventListener("change", () => {
    state.set({ drape: $("drape").value });
    show();
  });
  $("relief-here").addEventListener("click", show);
  $("exaggeration").addEventListener("input", () => {
    exaggerate();
    state.set({ exaggeration: $("exaggeration").value });
  });
  $("walls").addEventListener("change", () => {
    if (walls) walls.visible = $("walls").checked;
    draw();
  });
  $("export-relief").addEventListener("click", () => {
    draw();
    saveCanvas(renderer.domElement, `${surface.title}_3d`);
  });
}

// Called whenever the list of layers may have changed.
function fillDrapes() {
  const choices = [["map", "layers of the map"], ...map.titles().map(({ name, title }) => [name, title])];
  const usual = map.has("ortho") ? "ortho" : "map", asked = state.get("drape") ?? usual;
  $("drape").replaceChildren(...choices.map(([value, text]) => element("option", { value }, text)));
  $("drape").value = choices.some(([value]) => value === asked) ? asked : usual;
}

function begin() {
  if (renderer) return true;
  try {
    renderer = new THREE.WebGLRenderer({ antialias: true, preserveDrawingBuffer: true });
  } catch {
    $("relief-text").textContent = "This browser cannot show the 3-D view, because it has no WebGL.";
    return false;
  }
  renderer.setPixelRatio(devicePixelRatio);
  scene = new THREE.Scene();
  scene.add(new THREE.AmbientLight(0xffffff, 1.7));
  const sun = new THREE.DirectionalLight(0xffffff, 2);
  sun.position.set(-1, 1.6, -1); // from the north-west
  scene.add(sun);
  camera = new THREE.PerspectiveCamera(45, 1, 0.01, 100);
  controls = new OrbitControls(camera, renderer.domElement);
  controls.listenToKeyEvents($("relief-view"));
  controls.maxPolarAngle = Math.PI / 2;
  controls.addEventListener("change", () => {
    draw();
    if (isPlaced) keepPlace();
  });
  $("relief-view").addEventListener("keydown", nearer);
  $("relief-view").replaceChildren(renderer.domElement);
  new ResizeObserver(fit).observe($("relief-view"));
  return true;
}

// The part of the surface that the map shows.
export async function show() {
  if (!begin()) return;
  const number = ++shows;
  fillDrapes();
  $("exaggeration").value = state.get("exaggeration") ?? $("exaggeration").value;
  const part = map.patch(MAX_SIDE, true);
  if (!part) {
    $("relief-text").textContent = "The map does not show the surface. Move the map to it.";
    return;
  }
  // The hillshade below shows the surface where the texture is transparent.
  const on = $("drape").value === "map" ? map.shown().map(([name, share]) => `${name}:${share}`) : [$("drape").value];
  const names = ["hillshade", ...on];
  const scale = PICTURE_SIDE / Math.max(part.rows, part.cols);
  const size = { height: Math.max(Math.min(Math.round(part.rows * scale), PICTURE_SIDE), 2), width: Math.max(Math.min(Math.round(part.cols * scale), PICTURE_SIDE), 2) };
  try {
    const [answer, texture] = await Promise.all([ask("heights", part), load(map.pictureAddress({ ...part, ...size }, names))]);
    const content = await answer.arrayBuffer(), n = part.height * part.width;
    const heights = new Float32Array(content, 0, n), breaks = new Uint8Array(content, 4 * n, n);
    if (number === shows) build(part, heights, breaks, texture);
  } catch (error) {
    $("relief-text").textContent = error.message || "The surface could not be shown.";
  }
}

function load(address) {
  return new THREE.TextureLoader().loadAsync(address).then((texture) => {
    texture.colorSpace = THREE.SRGBColorSpace;
    texture.anisotropy = renderer.capabilities.getMaxAnisotropy();
    return texture;
  });
}

// The longer side of the part has length 1, and heights have the same scale.
function build(part, heights, breaks, texture) {
  const { height: rows, width: cols } = part;
  const known = heights.filter(Number.isFinite);
  if (!known.length) {
    $("relief-text").textContent = "No cell in the part that the map shows has a height.";
    return;
  }
  const sorted = known.slice().sort();
  const middle = sorted[Math.floor(sorted.length / 2)];
  const step = (part.rows / rows) * surface.transform[0];
  span = Math.max(rows, cols) * step;
  const found = triangles(heights, breaks, rows, cols);
  const scaled = (places) => {
    const all = new Float32Array(places.length);
    for (let i = 0; i < places.length; i += 3) {
      all.set([((places[i] + 0.5 - cols / 2) * step) / span, (places[i + 1] - middle) / span, ((places[i + 2] + 0.5 - rows / 2) * step) / span], i);
    }
    return new THREE.BufferAttribute(all, 3);
  };
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", scaled(found.places));
  geometry.setAttribute("uv", new THREE.BufferAttribute(textured(found.places, rows, cols), 2));
  geometry.setIndex(new THREE.BufferAttribute(new Uint32Array(found.index), 1));
  geometry.computeVertexNormals();
  const upright = new THREE.BufferGeometry();
  upright.setAttribute("position", scaled(found.walls));
  upright.computeVertexNormals();
  remove();
  mesh = new THREE.Mesh(geometry, new THREE.MeshLambertMaterial({ map: texture, side: THREE.DoubleSide }));
  walls = new THREE.Mesh(upright, new THREE.MeshLambertMaterial({ color: WALL_GREY, side: THREE.DoubleSide }));
  walls.visible = $("walls").checked;
  scene.add(mesh, walls);
  fit();
  place();
  exaggerate();
  $("relief-text").textContent = `${rows} × ${cols} places, ${step.toFixed(2)} m apart, from ${sorted[0].toFixed(1)} to ` +
    `${sorted.at(-1).toFixed(1)} m. Drag to turn. Use the wheel, or pinch, to zoom. Cells without a height are holes. Where the ` +
    "height jumps, the surface is broken, and a grey wall stands: no height was measured on it.";
  $("relief-view").dataset.places = String(known.length);
  $("relief-view").dataset.walls = String(found.walls.length / 9);
}

function remove() {
  for (const old of [mesh, walls]) {
    if (!old) continue;
    scene.remove(old);
    old.geometry.dispose();
    old.material.map?.dispose();
    old.material.dispose();
  }
}

function textured(places, rows, cols) {
  const uv = new Float32Array((2 * places.length) / 3);
  for (let i = 0; i < places.length / 3; i++) uv.set([(places[3 * i] + 0.5) / cols, 1 - (places[3 * i + 2] + 0.5) / rows], 2 * i);
  return uv;
}

// Corners (column, height, row) of the surface, its triangles, and the triangles of the walls. A square of four places
// whose sides are not broken is two triangles; any other has a quarter for each place.
function triangles(heights, breaks, rows, cols) {
  const places = [], index = [], upright = [];
  for (let i = 0; i < rows * cols; i++) places.push(i % cols, Number.isFinite(heights[i]) ? heights[i] : 0, Math.floor(i / cols));
  for (let row = 0; row + 1 < rows; row++) {
    for (let col = 0; col + 1 < cols; col++) {
      const a = row * cols + col, b = a + 1, c = a + cols, d = c + 1;
      if (![a, b, c, d].every((i) => Number.isFinite(heights[i]))) continue;
      // Whether the sides above, right, below and left are broken.
      const sides = [breaks[a] & TO_RIGHT, breaks[b] & TO_BELOW, breaks[c] & TO_RIGHT, breaks[a] & TO_BELOW];
      if (sides.some(Boolean)) quarters(row, col, [a, b, d, c].map((i) => heights[i]), sides, places, index, upright);
      else index.push(a, c, b, b, c, d);
    }
  }
  return { places, index, walls: upright };
}

// Quarters of a square with broken sides. z : heights of its places, clockwise from the upper left one; sides : broken
// ones, clockwise from the upper one, the first between places 0 and 1.
function quarters(row, col, z, sides, places, index, upright) {
  const at = [[col, row], [col + 1, row], [col + 1, row + 1], [col, row + 1]], centre = [col + 0.5, row + 0.5];
  const halfway = at.map(([x, y], k) => [(x + at[(k + 1) % 4][0]) / 2, (y + at[(k + 1) % 4][1]) / 2]);
  // The height in the middle is the mean of the places that whole sides join.
  const joined = z.map((_, k) => {
    const group = [k];
    for (let n = k; !sides[n % 4] && group.length < 4; n++) group.push((n + 1) % 4);
    for (let n = k + 3; !sides[n % 4] && group.length < 4 && !group.includes(n % 4); n--) group.push(n % 4);
    return group.reduce((sum, i) => sum + z[i], 0) / group.length;
  });
  const beside = (k, side) => (sides[side] ? z[k] : (z[side] + z[(side + 1) % 4]) / 2);
  z.forEach((height, k) => {
    const before = (k + 3) % 4, first = places.length / 3;
    for (const [[x, y], value] of [[at[k], height], [halfway[k], beside(k, k)], [centre, joined[k]], [halfway[before], beside(k, before)]]) {
      places.push(x, value, y);
    }
    index.push(first, first + 3, first + 2, first, first + 2, first + 1);
    if (!sides[k]) return;
    const other = (k + 1) % 4, [[x, y], [u, v]] = [halfway[k], centre];
    const [one, two, three, four] = [[x, height, y], [u, joined[k], v], [u, joined[other], v], [x, z[other], y]];
    upright.push(...one, ...two, ...three, ...one, ...three, ...four);
  });
}

function place() {
  // The whole part, also in a narrow window.
  const away = Math.max(1, 1.1 / camera.aspect);
  const kept = state.numbers("eye", 6) ?? [0, 0.85 * away, 1.05 * away, 0, 0, 0];
  camera.position.set(...kept.slice(0, 3));
  controls.target.set(...kept.slice(3));
  isPlaced = false;
  controls.update();
  isPlaced = true;
}

function nearer(event) {
  const share = { "+": CLOSER, "=": CLOSER, "-": 1 / CLOSER }[event.key];
  if (!share) return;
  camera.position.sub(controls.target).multiplyScalar(share).add(controls.target);
  controls.update();
  event.preventDefault();
}

function keepPlace() {
  const all = [...camera.position.toArray(), ...controls.target.toArray()];
  state.set({ eye: all.map((value) => value.toFixed(3)).join(",") });
}

function exaggerate() {
  $("exaggeration-value").textContent = $("exaggeration").value;
  if (!mesh) return;
  mesh.scale.y = walls.scale.y = Number($("exaggeration").value);
  draw();
}

function fit() {
  if (!renderer) return;
  const { clientWidth, clientHeight } = $("relief-view");
  if (!clientWidth || !clientHeight) return;
  renderer.setSize(clientWidth, clientHeight);
  camera.aspect = clientWidth / clientHeight;
  camera.updateProjectionMatrix();
  draw();
}

export function draw() {
  if (!renderer || !mesh) return;
  scene.background = new THREE.Color(colour("raised"));
  renderer.render(scene, camera);
}
