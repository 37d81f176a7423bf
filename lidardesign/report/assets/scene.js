"use strict";
// What the 3D view shows: triangles, lines and dots of what is switched on. `view` is the document of view.py.

const SHELL_STEPS = 8; // along each side of a gate's shell, as in drawing.py
const TURN_STEPS = 24; // round an ellipse of origins
const DENSE_RAYS = 100; // more of them are thin and pale, so that what is behind them is seen
const CONE = 25; // numbers per sensor: origin 3, frame 9, field of view 2, gate 2, axes of origins 9

function bytesOf(text) {
  const raw = atob(text);
  const bytes = new Uint8Array(raw.length);
  for (let i = 0; i < raw.length; i++) bytes[i] = raw.charCodeAt(i);
  return bytes.buffer;
}
const floats = (text) => new Float32Array(bytesOf(text));
const indices = (mesh) => (mesh.wide ? new Uint32Array(bytesOf(mesh.faces)) : new Uint16Array(bytesOf(mesh.faces)));

function decodeView(view) {
  const mesh = (one) => ({ vertices: floats(one.vertices), faces: indices(one) });
  view.rest = view.rest.map(mesh);
  view.moving = view.moving.map((one) => ({ ...mesh(one), target: one.target, poses: floats(one.poses) }));
  for (const design of view.designs) {
    design.owner = new Uint16Array(bytesOf(design.owner));
    design.outcome = new Uint8Array(bytesOf(design.outcome));
    for (const name of ["cones", "origin", "direction", "length"]) design[name] = floats(design[name]);
  }
  view.density = view.density ? floats(view.density) : null;
  return view;
}

// Points one after the other, with gaps between lines.
class Path {
  constructor() {
    this.x = [];
    this.y = [];
    this.z = [];
  }
  add(point) {
    this.x.push(point[0]);
    this.y.push(point[1]);
    this.z.push(point[2]);
  }
  line(points) {
    for (const point of points) this.add(point);
    this.add([NaN, NaN, NaN]);
  }
}

// The frustum of one sensor: the unit vector at shares (u, v) of the halves of its field of view.
function coneOf(design, place, sensor) {
  const c = design.cones.subarray(CONE * (place * design.sensors + sensor), CONE * (place * design.sensors + sensor + 1));
  const direction = (u, v) => {
    const h = (u * c[12]) / 2;
    const w = (v * c[13]) / 2;
    const angle = Math.hypot(h, w);
    const ratio = angle === 0 ? 1 : Math.sin(angle) / angle;
    return [0, 1, 2].map((k) => Math.cos(angle) * c[3 + k] + ratio * (h * c[6 + k] + w * c[9 + k]));
  };
  const at = (radius, d) => [0, 1, 2].map((k) => c[k] + radius * d[k]);
  return { direction, at, start: c[14], end: c[15], origin: [c[0], c[1], c[2]], axes: [16, 19, 22].map((k) => c.subarray(k, k + 3)) };
}

function frustumLines(cone, path) {
  const side = Array.from({ length: SHELL_STEPS + 1 }, (_, i) => -1 + (2 * i) / SHELL_STEPS);
  for (const v of [-1, 1]) for (const u of [-1, 1]) path.line([cone.origin, cone.at(cone.end, cone.direction(u, v))]);
  const rim = [...side.map((s) => [s, -1]), ...side.map((s) => [1, s]), ...side.map((s) => [-s, 1]), ...side.map((s) => [-1, -s])];
  const outline = rim.map(([u, v]) => cone.direction(u, v));
  for (const radius of [cone.start, cone.end]) path.line(outline.map((d) => cone.at(radius, d)));
}

function originLines(cone, path) {
  const length = (axis) => Math.hypot(...axis);
  const turn = Array.from({ length: TURN_STEPS + 1 }, (_, i) => (2 * Math.PI * i) / TURN_STEPS);
  for (const [a, b] of [[0, 1], [0, 2], [1, 2]]) {
    const [first, second] = [cone.axes[a], cone.axes[b]];
    if (length(first) === 0 || (length(second) === 0 && b !== 1)) continue;
    path.line(turn.map((t) => [0, 1, 2].map((k) => cone.origin[k] + Math.cos(t) * first[k] + Math.sin(t) * second[k])));
  }
}

// The two curved faces of a gate.
function gateShell(cone, mesh) {
  const row = SHELL_STEPS + 1;
  for (const radius of [cone.start, cone.end]) {
    const first = mesh.x.length;
    for (let v = 0; v < row; v++) {
      for (let u = 0; u < row; u++) mesh.add(cone.at(radius, cone.direction(-1 + (2 * u) / SHELL_STEPS, -1 + (2 * v) / SHELL_STEPS)));
    }
    for (let v = 0; v < SHELL_STEPS; v++) {
      for (let u = 0; u < SHELL_STEPS; u++) {
        const k = first + v * row + u;
        mesh.i.push(k, k + 1);
        mesh.j.push(k + 1, k + row + 1);
        mesh.k.push(k + row, k + row);
      }
    }
  }
}

// All bodies of one role at one frame as columns of a mesh.
function bodyColumns(view, target, frame) {
  const rest = view.rest[target ? 0 : 1];
  const moving = view.moving.filter((one) => one.target === target);
  const parts = [{ vertices: rest.vertices, faces: rest.faces, pose: null }];
  for (const one of moving) parts.push({ vertices: one.vertices, faces: one.faces, pose: one.poses.subarray(12 * frame, 12 * frame + 12) });
  const points = parts.reduce((sum, part) => sum + part.vertices.length / 3, 0);
  const faces = parts.reduce((sum, part) => sum + part.faces.length / 3, 0);
  const columns = { x: new Float32Array(points), y: new Float32Array(points), z: new Float32Array(points) };
  for (const name of "ijk") columns[name] = new Uint32Array(faces);
  let point = 0;
  let face = 0;
  for (const { vertices: v, faces: f, pose: p } of parts) {
    for (let n = 0; n < f.length; n += 3, face++) {
      columns.i[face] = point + f[n];
      columns.j[face] = point + f[n + 1];
      columns.k[face] = point + f[n + 2];
    }
    for (let n = 0; n < v.length; n += 3, point++) {
      const [x, y, z] = [v[n], v[n + 1], v[n + 2]];
      columns.x[point] = p ? p[0] * x + p[1] * y + p[2] * z + p[3] : x;
      columns.y[point] = p ? p[4] * x + p[5] * y + p[6] * z + p[7] : y;
      columns.z[point] = p ? p[8] * x + p[9] * y + p[10] * z + p[11] : z;
    }
  }
  return columns;
}

// Segments of the rays of all designs and sensors that are switched on, by outcome; and how many there are of each.
function rayPaths(view, state) {
  const paths = new Map(view.outcomes.map((one) => [one.code, { lines: new Path(), ends: new Path(), count: 0 }]));
  view.designs.forEach((design, number) => {
    if (!state.designs[number]) return;
    const from = state.place * design.rays;
    const step = (state.place * view.frames + state.frame) * design.rays;
    for (let n = 0; n < design.rays; n++) {
      if (state.sensors[number].has(design.owner[n])) continue;
      const path = paths.get(design.outcome[step + n]);
      const start = design.origin.subarray(3 * (from + n), 3 * (from + n) + 3);
      const d = design.direction.subarray(3 * (from + n), 3 * (from + n) + 3);
      const reach = design.length[step + n];
      const end = [start[0] + reach * d[0], start[1] + reach * d[1], start[2] + reach * d[2]];
      path.lines.line([start, end]);
      path.ends.add(end);
      path.count += 1;
    }
  });
  return paths;
}

function rayItems(view, state, paths) {
  const shown = view.outcomes.filter(({ code }) => state.outcomes[code] !== false && paths.get(code).count).reverse();
  const total = shown.reduce((sum, { code }) => sum + paths.get(code).count, 0);
  const share = Math.min(DENSE_RAYS / total, 1);
  const [width, opacity] = [Math.max(1.4 * Math.sqrt(share), 0.4), 0.3 + 0.45 * share];
  const lines = shown.map(({ code, colour, dash, symbol }) => {
    const { lines: path, count } = paths.get(code);
    return { kind: "lines", path, colour, dash, width, opacity: symbol === null && count > view.many ? view.faint : opacity };
  });
  const marks = shown.filter(({ symbol }) => symbol).map(({ code, colour, symbol }) => ({ kind: "marks", path: paths.get(code).ends, colour, symbol, size: Math.max(Math.sqrt(share), 0.5) }));
  return [...lines, ...marks];
}

function sensorItems(view, state) {
  return view.designs.flatMap((design, number) => {
    const [fields, starts, shells] = [new Path(), new Path(), Object.assign(new Path(), { i: [], j: [], k: [] })];
    for (let sensor = 0; sensor < design.sensors; sensor++) {
      if (!state.designs[number] || state.sensors[number].has(sensor)) continue;
      const cone = coneOf(design, state.place, sensor);
      frustumLines(cone, fields);
      originLines(cone, starts);
      gateShell(cone, shells);
    }
    const look = { colour: design.colour, dash: design.dash, opacity: 1 };
    const items = { gates: { kind: "mesh", columns: shells, colour: design.colour, opacity: 0.2 }, fields: { kind: "lines", path: fields, width: 1.4, ...look }, starts: { kind: "lines", path: starts, width: 2.2, ...look } };
    return Object.entries(items).filter(([layer]) => state.layers[layer] !== false).map(([, item]) => item);
  });
}

function densityItems(view, state) {
  if (!view.density || state.layers.density !== true) return [];
  const path = new Path();
  for (let n = 0; n < view.density.length; n += 3) path.add(view.density.subarray(n, n + 3));
  return [{ kind: "dots", path, colour: "#7b2d8b" }];
}

// Everything that is switched on, in the order in which it is painted, and how many rays there are of each outcome.
function sceneItems(view, state) {
  const paths = rayPaths(view, state);
  const bodies = [["scene", true, "#c9b8a8"], ["occluders", false, "#8b929d"]]
    .filter(([layer]) => state.layers[layer] !== false)
    .map(([, target, colour]) => ({ kind: "mesh", columns: bodyColumns(view, target, state.frame), colour, opacity: 1 }));
  const items = [...bodies, ...sensorItems(view, state), ...rayItems(view, state, paths), ...densityItems(view, state)];
  return { items, counts: new Map([...paths].map(([code, path]) => [code, path.count])) };
}
