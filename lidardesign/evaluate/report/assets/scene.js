"use strict";
// The 3D view: puts together what is switched on and hands it to plotly. `view` is the document of scene_view.py.

const SHELL_STEPS = 8; // along each side of a gate's shell, as in drawing.py
const TURN_STEPS = 24; // round an ellipse of origins
const CONE = 25; // numbers per sensor: origin 3, frame 9, field of view 2, gate 2, axes of origins 9
// Marks at the ends of rays, as lines about a point: plotly's own take far longer until they are first drawn.
const MARK_SHARE = 0.006; // of the scene's extent
const MARKS = {
  plus: [[[-1, 0, 0], [1, 0, 0]], [[0, -1, 0], [0, 1, 0]], [[0, 0, -1], [0, 0, 1]]],
  x: [[[-1, -1, -1], [1, 1, 1]], [[1, -1, -1], [-1, 1, 1]]],
  diamond: [[[1.2, 0, 0], [0, 0, 1.2], [-1.2, 0, 0], [0, 0, -1.2], [1.2, 0, 0]], [[0, 1.2, 0], [0, 0, 1.2], [0, -1.2, 0], [0, 0, -1.2], [0, 1.2, 0]]],
  square: [[[1, 0, 1], [-1, 0, 1], [-1, 0, -1], [1, 0, -1], [1, 0, 1]], [[0, 1, 1], [0, -1, 1], [0, -1, -1], [0, 1, -1], [0, 1, 1]]],
};
const LIGHT_DISTANCE = 1e4; // far away, so that light is parallel

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

function meshTrace(columns, looks) {
  return { type: "mesh3d", x: columns.x, y: columns.y, z: columns.z, i: columns.i, j: columns.j, k: columns.k, hoverinfo: "skip", ...looks };
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

function bodyTraces(view, state) {
  const lighting = { ambient: 0.55, diffuse: 0.7, specular: 0.05, roughness: 0.9 };
  const eye = view.camera.eye;
  const lightposition = { x: LIGHT_DISTANCE * eye.x, y: LIGHT_DISTANCE * eye.y, z: LIGHT_DISTANCE * eye.z };
  return [["scene", true, "#c9b8a8"], ["occluders", false, "#6b7280"]].map(([name, target, color]) => {
    const columns = bodyColumns(view, target, state.frame);
    return meshTrace(columns, { color, lighting, lightposition, visible: state.layers[name] !== false && columns.x.length > 0 });
  });
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

function markLines(ends, symbol, size) {
  const path = new Path();
  for (let n = 0; n < ends.x.length; n++) {
    for (const line of MARKS[symbol]) path.line(line.map((d) => [ends.x[n] + size * d[0], ends.y[n] + size * d[1], ends.z[n] + size * d[2]]));
  }
  return path;
}

function rayTraces(view, state, paths) {
  const traces = [];
  const extent = Math.max(...[0, 1, 2].map((k) => view.bounds[1][k] - view.bounds[0][k]));
  for (const { code, colour, dash, symbol } of view.outcomes) {
    const { lines, ends, count } = paths.get(code);
    const visible = state.outcomes[code] !== false && count > 0;
    const faint = symbol === null && count > view.many;
    const common = { type: "scatter3d", hoverinfo: "skip", visible };
    traces.push({ ...common, mode: "lines", x: lines.x, y: lines.y, z: lines.z, opacity: faint ? view.faint : 0.6, line: { color: colour, width: 1.6, dash } });
    if (symbol) {
      const marks = markLines(ends, symbol, MARK_SHARE * extent);
      traces.push({ ...common, mode: "lines", x: marks.x, y: marks.y, z: marks.z, line: { color: colour, width: 2 } });
    }
  }
  return traces;
}

function sensorTraces(view, state) {
  const traces = [];
  view.designs.forEach((design, number) => {
    const [fields, starts, shells] = [new Path(), new Path(), Object.assign(new Path(), { i: [], j: [], k: [] })];
    for (let sensor = 0; sensor < design.sensors; sensor++) {
      if (!state.designs[number] || state.sensors[number].has(sensor)) continue;
      const cone = coneOf(design, state.place, sensor);
      frustumLines(cone, fields);
      originLines(cone, starts);
      gateShell(cone, shells);
    }
    const line = (path, name, width) => ({
      type: "scatter3d", mode: "lines", hoverinfo: "skip", x: path.x, y: path.y, z: path.z,
      line: { color: design.colour, width, dash: design.dash }, visible: state.layers[name] !== false && path.x.length > 0,
    });
    traces.push(line(fields, "fields", 3), line(starts, "starts", 4));
    traces.push(meshTrace(shells, { color: design.colour, opacity: 0.2, visible: state.layers.gates !== false && shells.x.length > 0 }));
  });
  return traces;
}

function densityTraces(view, state) {
  if (!view.density) return [];
  const path = new Path();
  for (let n = 0; n < view.density.length; n += 3) path.add(view.density.subarray(n, n + 3));
  const marker = { color: "#7b2d8b", size: 2, opacity: 0.55 };
  return [{ type: "scatter3d", mode: "markers", hoverinfo: "skip", x: path.x, y: path.y, z: path.z, marker, visible: state.layers.density === true }];
}

function sceneTraces(view, state) {
  const paths = rayPaths(view, state);
  const traces = [...bodyTraces(view, state), ...sensorTraces(view, state), ...rayTraces(view, state, paths), ...densityTraces(view, state)];
  return { traces, counts: new Map([...paths].map(([code, path]) => [code, path.count])) };
}

function sceneLayout(view, font) {
  const axis = { backgroundcolor: "#f7f8fa", gridcolor: "#dfe3e8", showbackground: true, zeroline: false, showspikes: false };
  const axes = {};
  ["x", "y", "z"].forEach((name, k) => {
    const range = [view.bounds[0][k], view.bounds[1][k]];
    // a world in a plane has no height, and plotly draws no box without one
    if (range[0] === range[1]) range.splice(0, 2, range[0] - 0.01, range[1] + 0.01);
    axes[`${name}axis`] = { ...axis, range, autorange: false, title: { text: `${name} [m]` } };
  });
  const flat = view.camera.up.z === 0;
  if (flat) axes.zaxis.visible = false;
  return {
    font: { ...font, size: 12 },
    paper_bgcolor: "#ffffff",
    margin: { l: 0, r: 0, t: 0, b: 0 },
    showlegend: false,
    scene: { aspectmode: "data", camera: view.camera, dragmode: flat ? "pan" : "orbit", ...axes },
  };
}
