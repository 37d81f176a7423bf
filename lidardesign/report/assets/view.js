"use strict";
// The 3D view's switches, sliders, buttons and camera. It is drawn before the page's other scripts are read.

const SCENE = "view-scene";
const TURN = Math.PI / 12; // of the camera, per press
const PER_PX = 0.008; // of the camera, per pixel of a drag [rad]
const ZOOM = 1.2;
const [SHARP, SHARP_AFTER_MS] = [2, 200]; // dots per pixel of a view at rest, and when it counts as such
const LEVEL = Math.PI / 2 - 0.01;

const find = (selector) => document.querySelector(selector);
const all = (selector) => [...document.querySelectorAll(selector)];
const parsed = (id) => JSON.parse(document.getElementById(id).textContent);

const view = document.getElementById("view-data") ? decodeView(parsed("view-data")) : null;
const state = { place: 0, frame: 0, designs: [], sensors: [], outcomes: {}, layers: {} };
let [counts, items, camera] = [new Map(), [], null];

function readState() {
  for (const input of all("[data-step]")) state[input.dataset.step] = Number(input.value);
  state.designs = all("[data-design]").map((input) => input.checked);
  if (!state.designs.length) state.designs = view.designs.map(() => true);
  state.sensors = view.designs.map(() => new Set());
  for (const input of all("[data-sensor]")) {
    const [design, sensor] = input.dataset.sensor.split(".").map(Number);
    if (!input.checked) state.sensors[design].add(sensor);
  }
  for (const input of all("[data-outcome]")) state.outcomes[input.dataset.outcome] = input.checked;
  for (const input of all("[data-layer]")) state.layers[input.dataset.layer] = input.checked;
}

function tell() {
  for (const output of all("[data-count]")) output.textContent = String(counts.get(Number(output.dataset.count)) ?? 0);
  const where = [];
  for (const input of all("[data-step]")) {
    const label = JSON.parse(input.dataset.labels)[state[input.dataset.step]];
    input.setAttribute("aria-valuetext", label);
    find(`output[for="${input.id}"]`).textContent = label;
    where.push(label);
  }
  const total = [...counts.values()].reduce((sum, count) => sum + count, 0);
  const told = [...where, `${counts.get(0) ?? 0} of ${total} drawn rays return`].join("; ");
  find("#view-status").textContent = told;
}

// Put together what is switched on, and paint it.
function drawScene() {
  readState();
  const drawn = sceneItems(view, state);
  [items, counts] = [drawn.items, drawn.counts];
  tell();
  paintScene();
}

let sharpening = 0;
function paintScene(scale = window.devicePixelRatio) {
  const canvas = find(`#${SCENE} canvas`);
  const { width, height } = canvas.getBoundingClientRect();
  if (!width || !height) return;
  camera ??= firstCamera(view, width, height);
  paint(canvas, view, items, camera, scale, parsed("page-font").family);
  clearTimeout(sharpening);
  if (scale < SHARP) sharpening = setTimeout(() => paintScene(SHARP), SHARP_AFTER_MS);
}

let waiting = null;
function soon(work) {
  if (waiting === null) requestAnimationFrame(() => [waiting, waiting = null][0]());
  // what puts everything together paints it too
  if (waiting !== drawScene) waiting = work;
}
const redraw = () => soon(drawScene);

// A world in a plane is looked at from above, as a map: it turns, moves, and is seen from nearer and farther.
function turnCamera(turn, height) {
  camera.turn += turn;
  if (!view.camera.flat) camera.height = Math.min(Math.max(camera.height + height, -LEVEL), LEVEL);
}

function slideCamera(across, up) {
  const box = document.getElementById(SCENE).getBoundingClientRect();
  const lens = lensOf(camera, box.width, box.height);
  const metres = camera.fit / camera.zoom / lens.focal;
  camera.center = camera.center.map((value, k) => value - metres * (across * lens.right[k] - up * lens.up[k]));
}

function moveCamera(how) {
  const { width, height } = document.getElementById(SCENE).getBoundingClientRect();
  if (how === "reset") camera = firstCamera(view, width, height);
  if (how === "left" || how === "right") turnCamera(how === "left" ? -TURN : TURN, 0);
  if (how === "up" || how === "down") turnCamera(0, how === "up" ? TURN : -TURN);
  if (how === "above") turnCamera(0, Math.PI);
  if (how === "closer" || how === "farther") camera.zoom *= how === "closer" ? ZOOM : 1 / ZOOM;
  soon(paintScene);
}

// Dragging turns; with the right button or Shift, and on a map, it moves. The wheel belongs to the page until a click.
function answerPointer() {
  const box = document.getElementById(SCENE);
  box.addEventListener("contextmenu", (event) => event.preventDefault());
  box.addEventListener("pointerdown", (event) => {
    box.focus({ preventScroll: true });
    box.setPointerCapture(event.pointerId);
  });
  box.addEventListener("pointermove", (event) => {
    if (!box.hasPointerCapture(event.pointerId)) return;
    if (view.camera.flat || event.shiftKey || event.buttons === 2) slideCamera(event.movementX, event.movementY);
    else turnCamera(-PER_PX * event.movementX, PER_PX * event.movementY);
    soon(paintScene);
  });
  box.addEventListener("wheel", (event) => {
    if (document.activeElement !== box) return;
    event.preventDefault();
    moveCamera(event.deltaY < 0 ? "closer" : "farther");
  }, { passive: false });
}

const KEYS = { ArrowLeft: "left", ArrowRight: "right", ArrowUp: "up", ArrowDown: "down", "+": "closer", "-": "farther", Home: "reset" };

function answerSwitches() {
  for (const input of all("[data-step], [data-design], [data-sensor], [data-outcome], [data-layer]")) input.addEventListener("input", redraw);
  for (const button of all("[data-every]")) {
    button.addEventListener("click", () => {
      for (const input of all(`[data-sensor^="${button.dataset.every}."]`)) input.checked = button.dataset.to === "on";
      redraw();
    });
  }
  for (const button of all("[data-camera]")) button.addEventListener("click", () => moveCamera(button.dataset.camera));
  document.getElementById(SCENE).addEventListener("keydown", (event) => {
    const how = KEYS[event.key];
    if (!how || event.ctrlKey || event.altKey || event.metaKey) return;
    event.preventDefault();
    moveCamera(how);
  });
  find("#view-save").addEventListener("click", () => Object.assign(document.createElement("a"), { href: scenePicture(), download: "scene.png" }).click());
}

function scenePicture() {
  paintScene(SHARP);
  return find(`#${SCENE} canvas`).toDataURL();
}

if (view) {
  answerSwitches();
  answerPointer();
  drawScene();
  let width = window.innerWidth;
  window.addEventListener("resize", () => {
    if (width !== window.innerWidth) moveCamera("reset");
    width = window.innerWidth;
  });
  performance.mark("scene");
}
