// The 3-D view: the surface with a layer as its texture.

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
let surface, renderer, scene, camera, controls, mesh = null, span = 0, shows = 0, isPlaced = false;

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
    const heights = new Float32Array(await answer.arrayBuffer());
    if (number === shows) build(part, heights, texture);
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
function build(part, heights, texture) {
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
  const places = new Float32Array(3 * rows * cols), uv = new Float32Array(2 * rows * cols);
  for (let i = 0; i < rows * cols; i++) {
    const row = Math.floor(i / cols), col = i % cols, z = heights[i];
    places.set([((col + 0.5 - cols / 2) * step) / span, (Number.isFinite(z) ? z - middle : 0) / span, ((row + 0.5 - rows / 2) * step) / span], 3 * i);
    uv.set([(col + 0.5) / cols, 1 - (row + 0.5) / rows], 2 * i);
  }
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(places, 3));
  geometry.setAttribute("uv", new THREE.BufferAttribute(uv, 2));
  geometry.setIndex(new THREE.BufferAttribute(triangles(heights, rows, cols), 1));
  geometry.computeVertexNormals();
  const material = new THREE.MeshLambertMaterial({ map: texture, side: THREE.DoubleSide });
  if (mesh) {
    scene.remove(mesh);
    mesh.geometry.dispose();
    mesh.material.map.dispose();
    mesh.material.dispose();
  }
  mesh = new THREE.Mesh(geometry, material);
  scene.add(mesh);
  fit();
  place();
  exaggerate();
  const shape = `${rows} x ${cols} places, ${step.toFixed(2)} m apart`;
  $("relief-text").textContent = `${shape}, ${sorted[0].toFixed(1)} to ${sorted.at(-1).toFixed(1)} m. Drag to turn, use the wheel or pinch to zoom. Cells without a height are holes.`;
  $("relief-view").dataset.places = String(known.length);
}

// Two triangles for each square of places that all have a height.
function triangles(heights, rows, cols) {
  const found = [];
  for (let row = 0; row + 1 < rows; row++) {
    for (let col = 0; col + 1 < cols; col++) {
      const a = row * cols + col, b = a + 1, c = a + cols, d = c + 1;
      if ([a, b, c, d].every((i) => Number.isFinite(heights[i]))) found.push(a, c, b, b, c, d);
    }
  }
  return new Uint32Array(found);
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
  mesh.scale.y = Number($("exaggeration").value);
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
