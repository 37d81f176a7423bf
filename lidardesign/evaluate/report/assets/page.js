"use strict";
// What the page does: draws its figures, answers its switches, and makes itself ready for paper.

const QUIET = { responsive: true, displaylogo: false, displayModeBar: false, plotlyServerURL: "", showTips: false };
const SCENE = "view-scene";
const TURN = Math.PI / 12; // of the camera, per press
const ZOOM = 1.2;
const [PAPER_PX, HALF_PX] = [680, 330]; // what fits on the width of a sheet, once and beside another
const [WIDE, FARTHEST] = [1.3, 1.5]; // the shape of the view that its first camera is for, and how far that may go back

const find = (selector) => document.querySelector(selector);
const all = (selector) => [...document.querySelectorAll(selector)];
const parsed = (id) => JSON.parse(document.getElementById(id).textContent);

const view = document.getElementById("view-data") ? decodeView(parsed("view-data")) : null;
const state = { place: 0, frame: 0, designs: [], sensors: [], outcomes: {}, layers: {} };
let counts = new Map();

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

function drawScene() {
  readState();
  const drawn = sceneTraces(view, state);
  counts = drawn.counts;
  tell();
  const layout = sceneLayout(view, parsed("page-font"));
  // the camera stays where it was moved to
  layout.scene.camera = document.getElementById(SCENE).layout?.scene?.camera ?? view.camera;
  return Plotly.react(SCENE, drawn.traces, layout, QUIET);
}

// A narrow window shows less to the sides: the first view is from farther away.
function stepBack() {
  const box = document.getElementById(SCENE).getBoundingClientRect();
  const scale = Math.min(Math.max(WIDE / (box.width / box.height), 1), FARTHEST);
  for (const name of ["x", "y", "z"]) view.camera.eye[name] *= scale;
}

let waiting = false;
function redraw() {
  if (waiting) return;
  waiting = true;
  requestAnimationFrame(() => {
    waiting = false;
    drawScene();
  });
}

// A world in a plane is looked at from above, as a map: it can be turned, and seen from nearer and farther.
function moveMap(camera, how) {
  const { eye, up } = camera;
  const scale = { closer: 1 / ZOOM, farther: ZOOM }[how] ?? 1;
  const turn = Math.atan2(up.y, up.x) + ({ left: -TURN, right: TURN }[how] ?? 0);
  const moved = { eye: { ...eye, z: scale * eye.z }, up: { x: Math.cos(turn), y: Math.sin(turn), z: 0 } };
  return Plotly.relayout(SCENE, { "scene.camera": { ...camera, ...moved } });
}

function moveCamera(how) {
  const camera = document.getElementById(SCENE).layout.scene.camera;
  if (how === "reset") return Plotly.relayout(SCENE, { "scene.camera": view.camera });
  const { center: c = { x: 0, y: 0, z: 0 }, eye } = camera;
  const [dx, dy, dz] = [eye.x - c.x, eye.y - c.y, eye.z - c.z];
  if (camera.up.z === 0) return moveMap(camera, how);
  let radius = Math.hypot(dx, dy, dz);
  let turn = Math.atan2(dy, dx);
  let height = Math.asin(dz / radius);
  if (how === "left") turn -= TURN;
  if (how === "right") turn += TURN;
  if (how === "up") height = Math.min(height + TURN, Math.PI / 2 - 0.01);
  if (how === "down") height = Math.max(height - TURN, 0.01 - Math.PI / 2);
  if (how === "closer") radius /= ZOOM;
  if (how === "farther") radius *= ZOOM;
  if (how === "above") height = Math.PI / 2 - 0.01;
  const flat = Math.cos(height) * radius;
  const moved = { x: c.x + flat * Math.cos(turn), y: c.y + flat * Math.sin(turn), z: c.z + radius * Math.sin(height) };
  return Plotly.relayout(SCENE, { "scene.camera": { ...camera, eye: moved } });
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
  find("#view-save").addEventListener("click", () => Plotly.downloadImage(SCENE, { format: "png", width: 1600, height: 1000, filename: "scene" }));
}

// Every curve is a line and its band, and is switched in all figures of curves.
function answerCurves() {
  for (const input of all("[data-curve]")) {
    input.addEventListener("input", () => {
      const traces = [2 * Number(input.dataset.curve), 2 * Number(input.dataset.curve) + 1];
      for (const figure of all(".curves")) Plotly.restyle(figure, { visible: input.checked }, traces);
    });
  }
}

const flatFigures = () => all(".js-plotly-plot").filter((figure) => figure.id !== SCENE);
let opened = [];

// Paper takes no drawing context: the 3D view becomes a picture, curves get the sheet's width, all that folds is opened.
function toPaper() {
  opened = all("details:not([open])");
  for (const fold of opened) fold.open = true;
  const scene = view && document.getElementById(SCENE)?._fullLayout?.scene?._scene;
  if (scene && scene.toImage) find("#view-printed").src = scene.toImage("png");
  for (const figure of flatFigures()) Plotly.relayout(figure, { width: figure.closest(".tiles") ? HALF_PX : PAPER_PX, autosize: false });
}

function toScreen() {
  for (const fold of opened) fold.open = false;
  opened = [];
  for (const figure of flatFigures()) Plotly.relayout(figure, { width: null, autosize: true });
}

async function drawAll() {
  if (view) {
    answerSwitches();
    stepBack();
    await drawScene();
    performance.mark("scene");
  }
  for (const data of all("script[data-figure]")) {
    const { data: traces, layout } = JSON.parse(data.textContent);
    await Plotly.newPlot(data.dataset.figure, traces, layout, QUIET);
  }
  answerCurves();
  window.addEventListener("beforeprint", toPaper);
  window.addEventListener("afterprint", toScreen);
  document.documentElement.dataset.drawn = "yes";
  performance.mark("drawn");
}

drawAll();
