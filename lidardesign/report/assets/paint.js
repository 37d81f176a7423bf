"use strict";
// A picture of the scene on a canvas: bodies and gates with a depth for every pixel, then lines, marks and dots that
// they may hide. It needs no WebGL: it stands as soon as the page is read, and is the same on every machine.

const LENS = 1.6; // focal length over the larger side of the picture
const LABELS_PX = 42; // round the first view, for the axes' labels
const NEAR = 0.02; // of the first distance: what is closer to the eye is not drawn
const SLACK = 0.004; // of the first distance: what lies on a surface is not hidden by it
const PIECE_PX = 4; // lines are hidden in pieces of this length
const AT_ONCE = 64; // solid lines per stroke: more make strokes slow
const SHIFT = 0.618; // of the dashes from line to line, so that those of lines from one place make no rings
const [AMBIENT, LAMP] = [0.5, [-0.35, 0.45, 0.82]]; // the lamp is left of, above and behind the eye: right, up, back
const ABOVE = 0.995; // of a direction along an axis, from where it counts as such
const DASHES = { solid: [], dash: [6, 3], dashdot: [7, 3, 2, 3], dot: [2, 2.5], longdash: [10, 4] };
const MARK_PX = 3.6;
const [WIDE_PX, THINNEST] = [600, 0.6]; // narrower pictures have thinner lines and smaller marks
const MARKS = {
  "cross-thin-open": [[[-1, 0], [1, 0]], [[0, -1], [0, 1]]],
  "x-thin-open": [[[-0.9, -0.9], [0.9, 0.9]], [[-0.9, 0.9], [0.9, -0.9]]],
  "diamond-open": [[[0, -1.2], [1.2, 0], [0, 1.2], [-1.2, 0], [0, -1.2]]],
  "square-open": [[[-0.9, -0.9], [0.9, -0.9], [0.9, 0.9], [-0.9, 0.9], [-0.9, -0.9]]],
};
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const corners = ([low, high]) => [0, 1, 2, 3, 4, 5, 6, 7].map((n) => [n & 1 ? high[0] : low[0], n & 2 ? high[1] : low[1], n & 4 ? high[2] : low[2]]);

// How a camera sees: its directions, and what projects a point to the picture [px] and its depth [m].
function lensOf(camera, width, height) {
  const [ct, st, ch, sh] = [Math.cos(camera.turn), Math.sin(camera.turn), Math.cos(camera.height), Math.sin(camera.height)];
  const [right, up, back] = [[-st, ct, 0], [-sh * ct, -sh * st, ch], [ch * ct, ch * st, sh]];
  const focal = LENS * Math.max(width, height);
  const lens = { right, up, back, focal, x: width / 2 + camera.shift[0] * width, y: height / 2 + camera.shift[1] * height, near: NEAR * camera.fit, slack: SLACK * camera.fit };
  lens.seen = (x, y, z) => {
    const d = [x - camera.center[0], y - camera.center[1], z - camera.center[2]];
    const depth = camera.fit / camera.zoom - dot(d, back);
    return [lens.x + (focal * dot(d, right)) / depth, lens.y - (focal * dot(d, up)) / depth, depth];
  };
  return lens;
}

// The first view: so near that the whole box just fits between the labels, in the middle of the picture.
function firstCamera(view, width, height) {
  const [low, high] = view.bounds;
  const size = Math.hypot(...high.map((value, k) => value - low[k])) || 1;
  const camera = { ...view.camera, center: low.map((value, k) => (value + high[k]) / 2), zoom: 1, shift: [0, 0] };
  const extent = () => {
    const { seen } = lensOf(camera, width, height);
    const places = corners(view.bounds).map((point) => seen(...point));
    return [0, 1].map((k) => [Math.min(...places.map((place) => place[k])), Math.max(...places.map((place) => place[k]))]);
  };
  let [near, far] = [0.5 * size, 100 * size];
  for (let step = 0; step < 40; step++) {
    camera.fit = (near + far) / 2;
    const [[left, right], [top, bottom]] = extent();
    if (right - left < width - 2 * LABELS_PX && bottom - top < height - 2 * LABELS_PX) far = camera.fit;
    else near = camera.fit;
  }
  camera.fit = far;
  const [[left, right], [top, bottom]] = extent();
  camera.shift = [0.5 - (left + right) / 2 / width, 0.5 - (top + bottom) / 2 / height];
  return camera;
}

function paint(canvas, view, items, camera, scale, family) {
  const { width, height } = canvas.getBoundingClientRect();
  [canvas.width, canvas.height] = [Math.round(width * scale), Math.round(height * scale)];
  const pen = canvas.getContext("2d");
  const lens = lensOf(camera, canvas.width, canvas.height);
  pen.fillStyle = "#ffffff";
  pen.fillRect(0, 0, canvas.width, canvas.height);
  const labels = paintBox(pen, view.bounds, lens, scale);
  // nothing is read back from a canvas: browsers that guard against fingerprints would give noise
  const image = new ImageData(canvas.width, canvas.height);
  const sheet = { width: image.width, height: image.height, pixels: new Uint32Array(image.data.buffer), nearness: new Float32Array(image.width * image.height) };
  const meshes = items.filter((item) => item.kind === "mesh");
  for (const item of [...meshes.filter((one) => one.opacity === 1), ...meshes.filter((one) => one.opacity < 1)]) paintMesh(sheet, item, lens);
  const layer = Object.assign(document.createElement("canvas"), { width: image.width, height: image.height });
  layer.getContext("2d").putImageData(image, 0, 0);
  pen.drawImage(layer, 0, 0);
  pen.lineJoin = "round";
  const hidden = ([x, y, depth]) => {
    if (x < 0 || y < 0 || x >= sheet.width || y >= sheet.height) return false;
    const nearness = sheet.nearness[Math.floor(y) * sheet.width + Math.floor(x)];
    return nearness > 0 && depth > 1 / nearness + lens.slack;
  };
  const thick = scale * Math.min(Math.max(width / WIDE_PX, THINNEST), 1);
  for (const item of items) {
    if (item.kind === "lines") paintLines(pen, item, lens, hidden, thick);
    if (item.kind === "marks") paintMarks(pen, item, lens, hidden, thick);
    if (item.kind === "dots") paintDots(pen, item, lens, hidden, thick);
  }
  paintLabels(pen, labels, scale, family);
}

// How bright each vertex is, by the mean of the faces round it; which side is the front is not known of every mesh.
function brightness({ x, y, z, i, j, k }, lens) {
  const normals = [0, 1, 2].map(() => new Float32Array(x.length));
  for (let n = 0; n < i.length; n++) {
    const [a, b, c] = [i[n], j[n], k[n]];
    const [ux, uy, uz, vx, vy, vz] = [x[b] - x[a], y[b] - y[a], z[b] - z[a], x[c] - x[a], y[c] - y[a], z[c] - z[a]];
    const [nx, ny, nz] = [uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx];
    for (const point of [a, b, c]) {
      normals[0][point] += nx;
      normals[1][point] += ny;
      normals[2][point] += nz;
    }
  }
  const lamp = [0, 1, 2].map((axis) => LAMP[0] * lens.right[axis] + LAMP[1] * lens.up[axis] + LAMP[2] * lens.back[axis]);
  return normals[0].map((nx, n) => {
    const [ny, nz] = [normals[1][n], normals[2][n]];
    return AMBIENT + ((1 - AMBIENT) * Math.abs(nx * lamp[0] + ny * lamp[1] + nz * lamp[2])) / (Math.hypot(nx, ny, nz) || 1);
  });
}

function paintMesh(sheet, { columns, colour, opacity }, lens) {
  const rgb = [1, 3, 5].map((at) => parseInt(colour.slice(at, at + 2), 16));
  const light = brightness(columns, lens);
  const points = Array.from(columns.x, (x, n) => [...lens.seen(x, columns.y[n], columns.z[n]), light[n]]);
  for (let n = 0; n < columns.i.length; n++) {
    const triangle = [points[columns.i[n]], points[columns.j[n]], points[columns.k[n]]];
    const shown = triangle.every((point) => point[2] > lens.near) ? triangle : nearClipped(triangle, lens);
    for (let last = 2; last < shown.length; last++) fillTriangle(sheet, shown[0], shown[last - 1], shown[last], rgb, opacity);
  }
}

// What is left of a polygon in front of the eye; points are places in the picture, depth and brightness.
function nearClipped(points, lens) {
  const kept = [];
  points.forEach((a, n) => {
    const b = points[(n + 1) % points.length];
    if (a[2] > lens.near) kept.push(a);
    if (a[2] > lens.near !== b[2] > lens.near) kept.push(cut(a, b, lens));
  });
  return kept;
}

// Where a line crosses the nearest depth.
function cut(a, b, lens) {
  const share = (lens.near - a[2]) / (b[2] - a[2]);
  const mixed = (from, to) => from + share * (to - from);
  const flat = (axis, middle) => middle + mixed((a[axis] - middle) * a[2], (b[axis] - middle) * b[2]) / lens.near;
  return [flat(0, lens.x), flat(1, lens.y), lens.near, a.length > 3 ? mixed(a[3], b[3]) : 1];
}

function fillTriangle({ width, height, pixels, nearness }, a, b, c, [red, green, blue], opacity) {
  const area = (b[0] - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (b[1] - a[1]);
  if (!area) return;
  const [left, right] = [Math.max(0, Math.ceil(Math.min(a[0], b[0], c[0]) - 0.5)), Math.min(width - 1, Math.floor(Math.max(a[0], b[0], c[0]) - 0.5))];
  const [top, bottom] = [Math.max(0, Math.ceil(Math.min(a[1], b[1], c[1]) - 0.5)), Math.min(height - 1, Math.floor(Math.max(a[1], b[1], c[1]) - 0.5))];
  const [na, nb, nc] = [1 / a[2], 1 / b[2], 1 / c[2]];
  const [stepB, stepC] = [(c[1] - a[1]) / area, (a[1] - b[1]) / area];
  for (let y = top; y <= bottom; y++) {
    const [dx, dy] = [left + 0.5 - a[0], y + 0.5 - a[1]];
    let shareB = (dx * (c[1] - a[1]) - (c[0] - a[0]) * dy) / area;
    let shareC = ((b[0] - a[0]) * dy - dx * (b[1] - a[1])) / area;
    for (let x = left, at = y * width + left; x <= right; x++, at++, shareB += stepB, shareC += stepC) {
      if (shareB < 0 || shareC < 0 || shareB + shareC > 1) continue;
      const near = na + shareB * (nb - na) + shareC * (nc - na);
      if (near <= nearness[at]) continue;
      const light = a[3] + shareB * (b[3] - a[3]) + shareC * (c[3] - a[3]);
      const under = pixels[at];
      const below = ((1 - opacity) * (under >>> 24)) / 255;
      const [own, rest] = [(opacity * light) / (opacity + below), below / (opacity + below)];
      const mixed = [own * blue + rest * ((under >> 16) & 255), own * green + rest * ((under >> 8) & 255), own * red + rest * (under & 255)];
      pixels[at] = (Math.round(255 * (opacity + below)) << 24) | (mixed[0] << 16) | (mixed[1] << 8) | mixed[2];
      if (opacity === 1) nearness[at] = near;
    }
  }
}

function paintLines(pen, { path, colour, dash, width, opacity }, lens, hidden, scale) {
  Object.assign(pen, { strokeStyle: colour, lineWidth: width * scale, globalAlpha: opacity });
  const dashes = DASHES[dash].map((length) => length * scale);
  const period = dashes.reduce((sum, length) => sum + length, 0);
  pen.setLineDash(dashes);
  pen.beginPath();
  let [before, lines] = [null, 0];
  for (let n = 0; n < path.x.length; n++) {
    const place = Number.isNaN(path.x[n]) ? null : lens.seen(path.x[n], path.y[n], path.z[n]);
    if (before && place) addSegment(pen, before, place, lens, hidden, scale);
    before = place;
    if (!place && (++lines % AT_ONCE === 0 || period)) {
      pen.stroke();
      pen.beginPath();
      pen.lineDashOffset = ((lines * SHIFT) % 1) * period;
    }
  }
  pen.stroke();
  pen.setLineDash([]);
  pen.globalAlpha = 1;
}

// The parts of a line that nothing hides.
function addSegment(pen, a, b, lens, hidden, scale) {
  if (a[2] <= lens.near && b[2] <= lens.near) return;
  if (a[2] <= lens.near) a = cut(a, b, lens);
  if (b[2] <= lens.near) b = cut(b, a, lens);
  const pieces = Math.min(Math.max(Math.ceil(Math.hypot(b[0] - a[0], b[1] - a[1]) / (PIECE_PX * scale)), 1), 400);
  const at = (share) => [a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1]), 1 / ((1 - share) / a[2] + share / b[2])];
  let open = false;
  for (let piece = 0; piece <= pieces; piece++) {
    const shown = piece < pieces && !hidden(at((piece + 0.5) / pieces));
    if (shown === open) continue;
    const [x, y] = at(piece / pieces);
    if (shown) pen.moveTo(x, y);
    else pen.lineTo(x, y);
    open = shown;
  }
}

function paintMarks(pen, { path, colour, symbol, size: share }, lens, hidden, scale) {
  Object.assign(pen, { strokeStyle: colour, lineWidth: 1.2 * scale });
  const size = MARK_PX * share * scale;
  for (let n = 0; n < path.x.length; n++) {
    const [x, y, depth] = lens.seen(path.x[n], path.y[n], path.z[n]);
    if (depth <= lens.near || hidden([x, y, depth])) continue;
    pen.beginPath();
    for (const line of MARKS[symbol]) line.forEach(([dx, dy], corner) => pen[corner ? "lineTo" : "moveTo"](x + size * dx, y + size * dy));
    pen.stroke();
  }
}

function paintDots(pen, { path, colour }, lens, hidden, scale) {
  Object.assign(pen, { fillStyle: colour, globalAlpha: 0.55 });
  for (let n = 0; n < path.x.length; n++) {
    const [x, y, depth] = lens.seen(path.x[n], path.y[n], path.z[n]);
    if (depth > lens.near && !hidden([x, y, depth])) pen.fillRect(x - scale, y - scale, 2 * scale, 2 * scale);
  }
  pen.globalAlpha = 1;
}

// Round numbers along an axis, as far apart as on the others unless it is much shorter.
function ticksOf(low, high, longest) {
  const wanted = Math.max((high - low) / 4, longest / 12);
  const power = 10 ** Math.floor(Math.log10(wanted));
  const step = power * [1, 2, 5, 10].find((factor) => factor * power >= wanted * 0.99);
  const ticks = [];
  for (let n = Math.ceil(low / step - 1e-6); n * step <= high + 1e-6 * step; n++) ticks.push(Number((n * step).toPrecision(6)));
  return ticks;
}

// The three far sides of the box with their grid; what is to be written along its edges comes back.
function paintBox(pen, [low, high], lens, scale) {
  const longest = Math.max(...high.map((value, axis) => value - low[axis]));
  if (!longest) return [];
  const ticks = high.map((value, axis) => (value > low[axis] ? ticksOf(low[axis], value, longest) : []));
  const middle = high.map((value, axis) => (value + low[axis]) / 2);
  const [far, near] = [low.map((value, axis) => (lens.back[axis] >= 0 ? value : high[axis])), high.map((value, axis) => (lens.back[axis] >= 0 ? value : low[axis]))];
  const inFront = (...points) => points.every((point) => lens.seen(...point)[2] > lens.near);
  const line = (points) => points.forEach((point, n) => pen[n ? "lineTo" : "moveTo"](...lens.seen(...point).slice(0, 2)));
  Object.assign(pen, { fillStyle: "#f7f8fa", strokeStyle: "#dfe3e8", lineWidth: scale });
  for (const axis of [0, 1, 2]) {
    const [u, v] = [0, 1, 2].filter((other) => other !== axis);
    const at = (a, b) => Object.assign([...far], { [u]: a, [v]: b });
    const rim = [at(low[u], low[v]), at(high[u], low[v]), at(high[u], high[v]), at(low[u], high[v])];
    // from straight above the walls say nothing
    if (!inFront(...rim) || (axis < 2 && Math.abs(lens.back[2]) > ABOVE)) continue;
    pen.beginPath();
    line([...rim, rim[0]]);
    pen.fill();
    for (const tick of ticks[u]) line([at(tick, low[v]), at(tick, high[v])]);
    for (const tick of ticks[v]) line([at(low[u], tick), at(high[u], tick)]);
    pen.stroke();
  }
  // along the outline of the box: below for x and y, on the left for z
  return [0, 1, 2].flatMap((axis) => {
    if (!ticks[axis].length || Math.abs(lens.back[axis]) > ABOVE) return [];
    const [u, v] = [0, 1, 2].filter((other) => other !== axis);
    const [one, two] = [{ [u]: near[u], [v]: far[v] }, { [u]: far[u], [v]: near[v] }].map((place) => (value) => Object.assign([...far], place, { [axis]: value }));
    const lower = (place) => lens.seen(...place(middle[axis]))[axis === 2 ? 0 : 1] * (axis === 2 ? -1 : 1);
    const edge = lower(one) >= lower(two) ? one : two;
    if (!inFront(edge(low[axis]), edge(high[axis]))) return [];
    const [center, half] = [lens.seen(...middle), lens.seen(...edge(middle[axis]))];
    const away = [half[0] - center[0], half[1] - center[1]].map((value, _, both) => value / (Math.hypot(...both) || 1));
    // text is wider than high
    const beside = Math.abs(away[0]);
    const label = (text, value, gap) => lens.seen(...edge(value)).slice(0, 2).map((place, k) => place + gap * scale * away[k]).concat([text]);
    const [x, y] = lens.seen(...edge(high[axis]));
    // that of z stands on its axis, where there is always room
    const title = axis === 2 ? [x, y - 14 * scale, "z [m]"] : label(`${"xy"[axis]} [m]`, middle[axis], 28 + 22 * beside);
    return [...ticks[axis].map((tick) => label(String(tick), tick, 11 + 6 * beside)), title];
  });
}

// Labels stay inside of the picture; those of places outside of it are not written.
function paintLabels(pen, labels, scale, family) {
  Object.assign(pen, { font: `${12 * scale}px ${family}`, fillStyle: "#1f2933", textAlign: "center", textBaseline: "middle" });
  const { width, height } = pen.canvas;
  for (const [x, y, text] of labels) {
    const [half, line] = [pen.measureText(text).width / 2 + 2 * scale, 8 * scale];
    if (x < 0 || y < 0 || x > width || y > height) continue;
    pen.fillText(text, Math.min(Math.max(x, half), width - half), Math.min(Math.max(y, line), height - line));
  }
}
