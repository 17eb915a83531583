"use strict";
// The page of `graph_slam report`. Names come from files and messages: they are shown with textContent, and escaped for
// plotly, which knows some HTML.
const UNKNOWN = -(2 ** 31), SIZES = {f4: 4, f8: 8, i4: 4, u1: 1};
const ARRAYS = {f4: Float32Array, f8: Float64Array, i4: Int32Array, u1: Uint8Array};
const data = JSON.parse(document.getElementById("data").textContent);
const byId = (id) => document.getElementById(id);
const extra = typeof panel === "undefined" ? null : panel;  // of a page that is served
const unpacked = new Map();
let bytes = null;

// -- columns ---------------------------------------------------------------------------------------------------------

async function readColumns() {
  const text = atob(byId("columns").textContent.trim());
  const packed = new Uint8Array(text.length);
  for (let k = 0; k < text.length; k++) packed[k] = text.charCodeAt(k);
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  bytes = new Uint8Array(await new Response(stream).arrayBuffer());
}

function column(one) {
  if (!unpacked.has(one)) unpacked.set(one, unpack(one));
  return unpacked.get(one);
}

function unpack(one) {
  const part = bytes.subarray(one.at, one.at + one.bytes);
  if (one.packed === "s") return one.count ? new TextDecoder().decode(part).split("\0") : [];
  const size = SIZES[one.packed], n = one.count, whole = new Uint8Array(n * size);
  for (let b = 0; b < size; b++) for (let k = 0, at = b * n; k < n; k++, at++) whole[k * size + b] = part[at];
  const values = new ARRAYS[one.packed](whole.buffer);
  if (one.step === 1) return values;
  const out = new Float64Array(n);
  for (let k = 0, sum = 0; k < n; k++) {
    sum = one.sum ? sum + values[k] : values[k];
    out[k] = !one.sum && values[k] === UNKNOWN ? NaN : sum * one.step;
  }
  return out;
}

// -- sentences -------------------------------------------------------------------------------------------------------

function general(value, digits) {
  if (value === 0) return "0";
  const [mantissa, power] = value.toExponential(digits - 1).split("e");
  const exponent = Number(power), short = (text) => (text.includes(".") ? text.replace(/\.?0+$/, "") : text);
  if (exponent >= -4 && exponent < digits) return short(value.toFixed(digits - 1 - exponent));
  return `${short(mantissa)}e${exponent < 0 ? "-" : "+"}${String(Math.abs(exponent)).padStart(2, "0")}`;
}

function formatted(value, spec) {
  if (typeof value === "string" || !spec) return String(value);
  if (!Number.isFinite(value)) return Number.isNaN(value) ? "nan" : value > 0 ? "inf" : "-inf";
  const [, plus, digits, kind] = spec.match(/^(\+?)\.(\d+)([fg])$/);
  const text = kind === "f" ? value.toFixed(Number(digits)) : general(value, Number(digits));
  return plus && value >= 0 ? `+${text}` : text;
}

// An edge is called by its id everywhere. Ids are rows of the columns, but in a map with condensed visits.
const edgeIds = () => (data.edges.ids ? column(data.edges.ids) : Array.from({length: data.edges.count}, (_, k) => k));
let edgeRows = null;
function rowOf(k) {
  if (!data.edges.ids) return k;
  edgeRows = edgeRows || new Map(Array.from(column(data.edges.ids), (id, row) => [id, row]));
  return edgeRows.get(k);
}
const ofEdge = (packed, k) => column(packed)[rowOf(k)];
const named = (coded, k) => coded.names[ofEdge(coded.of, k)];

function valueOf(name, k) {
  const e = data.edges;
  if (name === "edge") return k;
  if (name === "landmark" || name === "source") return named(e[name], k);
  return ofEdge(e.columns[name], k);
}

const filled = (text, k) => text.replace(/(\{\{|\}\})|\{(\w+)(?::([^}]*))?\}/g, (_, brace, name, spec) => (brace ? brace[0] : formatted(valueOf(name, k), spec)));

function explained(k) {
  const group = data.edges.groups[ofEdge(data.edges.group, k)], lines = [];
  for (const [what, text] of group.lines) {
    if (text === "{changes}") for (const one of data.edges.changes[k] || []) lines.push([what, one]);
    else if (text === "{place}") lines.push(...data.edges.condensed[k]);
    else lines.push([what, filled(text, k)]);
  }
  for (const one of data.edges.by_hand[k] || []) lines.push(["by hand", one]);
  return {title: filled(group.title, k), lines};
}

// -- small things ----------------------------------------------------------------------------------------------------

function element(tag, text, attributes = {}) {
  const out = document.createElement(tag);
  if (text !== undefined && text !== null) out.textContent = text;
  for (const [name, value] of Object.entries(attributes)) out.setAttribute(name, value);
  return out;
}

const plain = (text) => String(text).replace(/&/g, "&amp;").replace(/</g, "&lt;").replace(/>/g, "&gt;");
const short = (text) => (text.length > 40 ? `${text.slice(0, 37)}...` : text);
const number = (value) => (value === null || value === undefined ? "-" : Math.abs(value) < 1e-12 ? "0" : Number.isInteger(value) || (Math.abs(value) >= 1e4 && Math.abs(value) < 1e9) ? String(Math.round(value)) : general(value, 4));

function table(id, head, rows, none = "none") {
  const place = byId(id);
  if (!rows || !rows.length) return place.append(element("p", none, {class: "quiet"}));
  const out = element("table"), isNumber = head.map((_, c) => rows.some((row) => typeof row[c] === "number"));
  const top = out.createTHead().insertRow();
  head.forEach((name, c) => top.append(element("th", name, {scope: "col", ...(isNumber[c] ? {class: "number"} : {})})));
  const body = out.createTBody();
  for (const row of rows) {
    const line = body.insertRow();
    row.forEach((value, c) => {
      const cell = line.insertCell();
      if (value instanceof Node) return cell.append(value);
      if (isNumber[c]) cell.className = "number";
      cell.append(element("bdi", isNumber[c] ? number(value) : value));
    });
  }
  place.append(out);
}

function edgeLinks(edges) {
  const out = element("span");
  edges.forEach((k, at) => out.append(at ? ", " : "", linkTo("edge", k, String(k))));
  return out;
}

function linkTo(kind, which, text) {
  const out = element("a", undefined, {href: `#${kind}=${encodeURIComponent(which)}`});
  out.append(element("bdi", text));
  return out;
}

// -- colours ---------------------------------------------------------------------------------------------------------

const dark = matchMedia("(prefers-color-scheme: dark)"), narrow = matchMedia("(max-width: 60rem)");
const PAPER = {map: {width: 680, height: 560}, chart: {width: 680, height: 270}};  // [pixels] of CSS: A4 and Letter
let onPaper = false;
function colours() {
  const d = dark.matches && !onPaper;
  return {
    ...data.colours[d ? "dark" : "light"],
    other: d ? "#2bd9b0" : "#00a884", then: d ? "#ffd24d" : "#9a6700", mark: d ? "#7ee787" : "#116329",
    ink: d ? "#e6e8eb" : "#1f2328", quiet: d ? "#a3abb5" : "#57606a", grid: d ? "#30363d" : "#e6e8eb",
    "not judged": "#9aa0a6", accepted: d ? "#8b9bab" : "#7a8794", "down-weighted": "#56b4e9", "held back": d ? "#b5c94c" : "#6b7a00",
    rejected: d ? "#ff9e64" : "#c04000", "taken out (not saved)": d ? "#4dd0e1" : "#006d8f", "let in (not saved)": d ? "#4dd0e1" : "#006d8f",
  };
}

function layout(more) {
  const c = colours(), axis = {gridcolor: c.grid, zerolinecolor: c.grid, linecolor: c.grid};
  return {
    paper_bgcolor: c.paper, plot_bgcolor: c.paper, font: {color: c.ink, size: 12, family: "system-ui, sans-serif"}, margin: {l: 50, r: 10, t: 10, b: 40},
    legend: {orientation: "h", y: 1.02, yanchor: "bottom"}, modebar: {orientation: "v"}, xaxis: axis, yaxis: axis, ...(onPaper ? PAPER.chart : {}), ...more(axis),
  };
}
const CONFIG = {responsive: true, displaylogo: false, modeBarButtonsToRemove: ["toImage", "sendDataToCloud"]};

// -- the map ---------------------------------------------------------------------------------------------------------

const CAMERA = {eye: {x: 1.2, y: -2.3, z: 1.8}};
const ALONG = ["odometry", "composed"];  // classes of edges along the path
const MOST_SHOWN = 5000, MOST_DRAWN = 20000;  // edges of one class and verdict
const MOST_NAMES = 30;  // of landmarks: the others show theirs where the pointer is
const map = {inSpace: false, points: null, moved: null};  // moved: {path, landmarks} of another solution

const estimate = () => (map.moved ? map.moved.path : data.map.paths.estimate.map(column));

function points() {
  if (map.points) return map.points;
  const path = estimate(), marks = landmarkPlaces(), n = data.map.keyframes;
  map.points = [0, 1, 2].map((axis) => {
    const out = new Float64Array(n + marks[axis].length);
    out.set(path[axis]);
    out.set(marks[axis], n);
    return out;
  });
  return map.points;
}

async function moveTo(moved) {  // another solution, or null: that of the run
  map.moved = moved;
  map.points = null;
  await drawMap(true);
}

const placedNow = (names) => [0, 1, 2].map((axis) => Float64Array.from(names, (name) => (map.moved.landmarks.get(name) || [])[axis] ?? (map.moved.landmarks.has(name) ? 0 : NaN)));

function landmarkPlaces() {  // in the order in which edges name them
  if (map.moved) return placedNow(column(data.edges.landmark_names));
  const names = column(data.map.landmarks.names), at = new Map(names.map((name, k) => [name, k]));
  const places = data.map.landmarks.points.map(column), of = column(data.edges.landmark_names);
  return places.map((axis) => Float64Array.from(of, (name) => (at.has(name) ? axis[at.get(name)] : NaN)));
}

function thinned(axes, every) {
  if (every <= 1) return axes;
  return axes.map((axis) => axis.filter((_, k) => k % every === 0 || k === axis.length - 1));
}

function trace(name, axes, colour, more) {  // edges are many: they are drawn by WebGL, all else as SVG, which begins faster
  const [x, y, z] = axes, kind = map.inSpace ? {type: "scatter3d", z} : {type: more.isMany ? "scattergl" : "scatter"};
  const {isMany, ...rest} = more;
  if (map.inSpace && rest.line) rest.line = {...rest.line, width: 2 * rest.line.width};  // they look thinner there
  return {name, x, y, mode: "lines", line: {color: colour, width: 1.5}, hoverinfo: "skip", ...kind, ...rest};
}

function edgeTraces() {
  const e = data.edges, all = points(), [from, ...others] = e.places.map(column), groups = new Map();
  const label = column(e.label.of), verdict = column(e.verdict);
  for (const [row, k] of edgeIds().entries()) {
    if (from[row] < 0 || !others.some((to) => to[row] >= 0) || ALONG.includes(e.label.names[label[row]])) continue;
    const key = `${e.label.names[label[row]]}, ${changeOf(k) || e.verdicts[verdict[row]]}`;
    if (!groups.has(key)) groups.set(key, []);
    groups.get(key).push(k);
  }
  const out = [];
  for (const [key, edges] of groups) {
    const name = key.split(", ")[1], isIn = name === "accepted" || name === "not judged", isChanged = name.endsWith(UNSAVED), isSighting = key.startsWith("landmarks") || key.startsWith("places"), shown = plain(key.replace(/^landmarks/, "sightings"));
    const every = Math.max(1, Math.ceil(edges.length / MOST_DRAWN)), some = edges.filter((_, k) => k % every === 0);
    if (every > 1) map.notes.push(`one of ${every} edges of "${key}" is drawn (the ledger has all)`);
    const visible = isSighting || (isIn && edges.length > MOST_SHOWN) ? "legendonly" : true;
    const ends = some.flatMap((k) => others.map((to) => [from[rowOf(k)], to[rowOf(k)], k]).filter(([, to]) => to >= 0));
    const axes = all.map((axis) => Float64Array.from(ends.flatMap(([a, b]) => [axis[a], axis[b], NaN])));
    const middle = all.map((axis) => Float64Array.from(ends, ([a, b]) => (axis[a] + axis[b]) / 2));
    const faint = Math.max(0.02, Math.min(0.25, 80 / edges.length));  // many sightings would hide the path
    const colour = isIn && isSighting ? colours().landmarks : isIn ? colours().closures : colours()[name];
    const isFaint = isIn && isSighting, dash = isIn || name === "down-weighted" || name.startsWith("let in") ? "solid" : name === "held back" ? "dot" : "dash";
    const strength = map.moved && !isIn && !isChanged ? 0.3 : 0.9;  // while edits are tried, what is out stands back
    if (isFaint) out.push(trace(shown, [[null], [null], [null]], colour, {visible, legendgroup: key}));  // what the legend shows
    out.push(trace(shown, axes, colour, {visible, isMany: true, opacity: isFaint ? faint : strength, line: {color: colour, dash, width: isChanged ? 3 : isFaint ? 1.5 : 2}, legendgroup: key, showlegend: !isFaint}));
    out.push(trace("", middle, colour, {
      visible, isMany: true, mode: "markers", marker: {color: colour, size: (isIn ? 4 : 7) / (map.inSpace ? 2 : 1), symbol: name.startsWith("taken out") ? "x" : "diamond", opacity: isIn ? (isSighting ? faint : 0.35) : strength}, showlegend: false,
      legendgroup: key, customdata: ends.map(([, , k]) => k), meta: "edge", hovertemplate: `edge %{customdata}: ${plain(key)}<extra></extra>`, hoverinfo: "all",
    }));
  }
  return out;
}

function traces() {
  const c = colours(), paths = data.map.paths, every = data.map.every, out = edgeTraces();
  const names = {odometry: "dead reckoning", truth: "truth", other: "compared run", estimate: map.moved ? "estimate, with the edits" : "estimate"};
  if (map.moved) out.push(trace("estimate of the run", thinned(paths.estimate.map(column), every), c.estimate, {line: {color: c.estimate, width: 1, dash: "dot"}}));
  for (const name of ["odometry", "truth", "other", "estimate"]) {
    if (!paths[name]) continue;
    const step = name === "truth" ? 1 : every, axes = thinned(name === "estimate" ? estimate() : paths[name].map(column), step);
    const isPath = name === "estimate", of = isPath ? thinned([Float64Array.from({length: data.map.keyframes}, (_, k) => k)], step)[0] : null;
    out.push(trace(names[name], axes, c[name], isPath ? {
      meta: "keyframe", customdata: of,
      hovertemplate: "keyframe %{customdata}<extra></extra>", hoverinfo: "all", line: {color: c[name], width: 2},
    } : {line: {color: c[name], width: name === "truth" ? 3 : 1.2}, opacity: map.moved && name === "odometry" ? 0.25 : 1}));
  }
  out.push(trace("", [[], [], []], c["let in (not saved)"], {line: {color: c["let in (not saved)"], width: 7}, opacity: 0.5, showlegend: false, meta: "stretches"}));
  const marks = data.map.landmarks, labels = column(marks.names);
  if (labels.length) {
    const axes = map.moved ? placedNow(labels) : marks.points.map(column), text = labels.map((name) => plain(short(name)));
    if (!map.inSpace && !map.moved) out.push(trace("", [...marks.ellipses.map(column), []], c.landmarks, {line: {color: c.landmarks, width: 1}, legendgroup: "landmarks", showlegend: false}));
    out.push(trace("landmarks", axes, c.landmarks, {
      legendgroup: "landmarks", mode: labels.length > MOST_NAMES ? "markers" : "markers+text", text, textposition: "top center", textfont: {size: 10, color: c.ink}, meta: "landmark",
      marker: {symbol: map.inSpace ? "diamond" : "star", size: map.inSpace ? 3 : 11, color: c.landmarks}, customdata: labels,
      hovertemplate: "landmark %{text}<extra></extra>", hoverinfo: "all",
    }));
  }
  out.push(ends(c));
  out.push(trace("as known then", [[], [], []], c.then, {line: {color: c.then, width: 3}, visible: true, showlegend: false, meta: "then"}));
  out.push(trace("landmarks as known then", [[], [], []], c.then, {mode: "markers", marker: {symbol: map.inSpace ? "diamond" : "star", size: map.inSpace ? 4 : 11, color: c.then}, showlegend: false, meta: "marks then"}));
  out.push(trace("chosen", [[], [], []], c.mark, {mode: "lines+markers", line: {color: c.mark, width: 5}, marker: {color: c.mark, size: map.inSpace ? 7 : 11}, showlegend: false, meta: "chosen"}));
  return out;
}

function ends(c) {  // where the drive starts and ends
  const at = estimate(), n = at[0].length;
  return trace("", at.map((axis) => (n ? [axis[0], axis[n - 1]] : [])), c.ink, {mode: "markers+text", text: ["start", "end"], textposition: "bottom right", textfont: {size: 11, color: c.ink}, marker: {size: map.inSpace ? 4 : 9, color: c.paper, line: {color: c.estimate, width: 2}}, showlegend: false});
}

// What the map shows at first: the estimate, and of the rest what is not far from it.
function box() {
  const {paths, landmarks} = data.map, extent = (arrays, from = -Infinity, to = Infinity) => {
    let low = Infinity, high = -Infinity;
    for (const values of arrays) for (const v of values) if (v >= from && v <= to) { low = Math.min(low, v); high = Math.max(high, v); }
    return [low, high];
  };
  return [0, 1].map((axis) => {
    const own = [estimate()[axis]], [low, high] = extent(own), reach = Math.max(high - low, 1);
    const [a, b] = extent([...own, column(landmarks.points[axis]), ...["odometry", "truth", "other"].filter((one) => paths[one]).map((one) => column(paths[one][axis]))], low - reach, high + reach);
    const margin = Math.max(0.06 * (b - a), 0.2);
    return [a - margin, b + margin];
  });
}

function showStretches(ends) {  // the parts of the drive that a group of closures joins
  const path = estimate(), join = (axis) => ends.flatMap(([first, last]) => [...axis.slice(first, last + 1), NaN]);
  return restyle("stretches", path.map(join));
}

async function drawMap(isSame = false) {  // isSame: as it is zoomed
  map.notes = [];
  if (data.map.every > 1) map.notes.push(`one of ${data.map.every} keyframes is drawn`);
  const several = traces(), image = data.plan && {
    source: data.plan.url, xref: "x", yref: "y", x: data.plan.x, y: data.plan.y, sizex: data.plan.width, sizey: data.plan.height,
    xanchor: "left", yanchor: "bottom", sizing: "stretch", layer: "below", opacity: 0.6,
  };
  const c = colours(), scene = {aspectmode: "data", bgcolor: c.paper, camera: CAMERA};
  for (const axis of ["xaxis", "yaxis", "zaxis"]) scene[axis] = {title: {text: `${axis[0]} [m]`}, gridcolor: c.grid, color: c.ink};
  const [x, y] = box(), clip = ([clipmin, clipmax]) => ({autorangeoptions: {clipmin, clipmax}});
  byId("map-section").style.setProperty("--aspect", Math.min(3, Math.max(0.8, (x[1] - x[0]) / (y[1] - y[0]))));
  const beside = !onPaper && !narrow.matches ? {legend: {x: 1.01, y: 1}} : {};
  const flat = layout((axis) => ({
    ...beside, xaxis: {...axis, ...clip(x), title: {text: "x [m]"}}, yaxis: {...axis, ...clip(y), title: {text: "y [m]"}, scaleanchor: "x", scaleratio: 1},
    dragmode: "pan", hovermode: "closest", images: image ? [image] : [], uirevision: "map",
  }));
  const shape = {...(map.inSpace ? {...layout(() => ({})), scene, uirevision: "space"} : flat), ...(onPaper ? PAPER.map : {})};
  map.isThen = false;
  if (isSame) await Plotly.react("map", several, {...shape, ...zoom()}, {...CONFIG, scrollZoom: true});
  else await newMap(several, shape);
  byId("map-note").textContent = map.notes.join("; ");
  if (map.chosen) mark(...map.chosen);
}

function zoom() {  // as it is, unless the map has moved out of it
  const {xaxis, yaxis, scene} = byId("map").layout;
  if (map.inSpace) return {scene};
  const isFree = xaxis.autorange !== false && !isVisible(estimate());
  const kept = (axis) => ({...axis, range: [...axis.range], autorange: isFree});
  return {xaxis: kept(xaxis), yaxis: kept(yaxis)};
}

function isVisible(axes) {
  const {xaxis, yaxis} = byId("map")._fullLayout;
  return [xaxis, yaxis].every(({range: [low, high]}, at) => axes[at].every((value) => Number.isNaN(value) || (low <= value && value <= high)));
}

function showWhole() {
  if (map.inSpace) return Plotly.relayout("map", {"scene.camera": CAMERA});
  return Plotly.relayout("map", {"xaxis.autorange": true, "yaxis.autorange": true});
}

async function newMap(several, shape) {
  Plotly.purge("map");
  await Plotly.newPlot("map", several, shape, {...CONFIG, scrollZoom: true});
  byId("map").on("plotly_click", ({points: [one]}) => {
    const kind = one.data.meta;
    if (kind === "edge" || kind === "keyframe" || kind === "landmark") go(kind, one.customdata);
  });
}

function restyle(meta, axes) {
  const at = byId("map").data.findIndex((one) => one.meta === meta), [x, y, z] = axes;
  return Plotly.restyle("map", {x: [x], y: [y], ...(map.inSpace ? {z: [z]} : {})}, [at]);
}

function placesOf(kind, which) {
  const all = points(), n = data.map.keyframes;
  if (kind === "keyframe") return [Number(which)];
  if (kind === "landmark") return [n + column(data.edges.landmark_names).indexOf(which)];
  return data.edges.places.map((one) => ofEdge(one, which)).filter((at) => at >= 0 && Number.isFinite(all[0][at]));
}

function mark(kind, which, move = false) {
  map.chosen = [kind, which];
  const at = placesOf(kind, which), all = points(), axes = all.map((axis) => at.map((k) => axis[k]));
  restyle("chosen", axes);
  if (move && !map.inSpace && at.length && !isVisible(axes)) {
    const width = Math.max(...axes[0]) - Math.min(...axes[0]), height = Math.max(...axes[1]) - Math.min(...axes[1]);
    const x = (Math.max(...axes[0]) + Math.min(...axes[0])) / 2, y = (Math.max(...axes[1]) + Math.min(...axes[1])) / 2, r = 2 + 0.6 * Math.max(width, height);
    Plotly.relayout("map", {"xaxis.range": [x - r, x + r], "yaxis.range": [y - r, y + r]});
  }
}

// -- time ------------------------------------------------------------------------------------------------------------

function setTime() {
  const frames = data.drive.frames, at = Number(byId("time").value), now = at >= frames.length;
  const stamps = column(data.map.stamps), frame = frames[at];
  if (now) {
    byId("when").textContent = "now: the estimate after all of it";
    return map.isThen ? Promise.all([restyle("then", [[], [], []]), restyle("marks then", [[], [], []])]) : null;
  }
  map.isThen = true;
  const last = Math.min(frame.keyframes, stamps.length) - 1;
  byId("when").textContent = `as known at keyframe ${last}, ${(stamps[last] - stamps[0]).toFixed(1)} s after the start`;
  return Promise.all([restyle("then", frame.points.map(column)), restyle("marks then", frame.landmarks.map(column))]);
}

// -- why -------------------------------------------------------------------------------------------------------------

function go(kind, which) {
  const hash = `#${kind}=${encodeURIComponent(which)}`;
  if (location.hash === hash) show(kind, which);
  else location.hash = hash;
}

function fromHash(move) {
  const found = location.hash.match(/^#(edge|keyframe|landmark)=(.*)$/);
  if (!found || !data.edges) return;
  let which = found[2];
  try { which = decodeURIComponent(which); } catch { /* as it is */ }
  if (found[1] !== "landmark") {
    if (!/^\d+$/.test(which)) return;
    which = Number(which);
  }
  show(found[1], which, move);
}

function show(kind, which, move = false) {
  const body = byId("why-body");
  body.replaceChildren();
  byId("why-hint").hidden = true;
  const isThere = {
    edge: () => rowOf(which) < data.edges.count, keyframe: () => data.map && which < data.map.keyframes,
    landmark: () => column(data.edges.landmark_names).includes(which),
  };
  if (!isThere[kind]()) return body.append(element("p", `there is no ${kind} ${short(String(which))}${kind === "edge" && data.edges.ids ? " in the map: visits are condensed" : ""}`));
  ({edge: showEdge, keyframe: showKeyframe, landmark: showLandmark})[kind](which, body);
  if (extra) extra.show(kind, which, body);
  if (data.map) mark(kind, which, move);
  if (kind === "edge") choose(which);
}

function showEdge(k, body) {
  const {title, lines} = explained(k), list = element("dl");
  const change = changeOf(k), group = (data.groups || []).find((one) => one.edges.length > 1 && one.edges.includes(k));
  body.append(element("h3", change ? `${title.slice(0, title.length - verdictAndReason(k).length)}${change}` : title));
  if (change) body.append(element("p", `Below is how the run judged it: ${verdictAndReason(k)}.`, {class: "state"}));
  for (const [what, text] of lines) {
    if (change && (what === "now" || what === "what if")) continue;
    list.append(element("dt", what), element("dd", text));
  }
  if (group) list.append(element("dt", "group"), groupText(group));
  body.append(list);
  const also = element("p");
  for (const at of data.edges.places.map((one) => ofEdge(one, k))) {
    if (at < 0) continue;
    if (also.childNodes.length) also.append(", ");
    const isKeyframe = at < data.map.keyframes, name = isKeyframe ? at : column(data.edges.landmark_names)[at - data.map.keyframes];
    also.append(linkTo(isKeyframe ? "keyframe" : "landmark", name, `${isKeyframe ? "keyframe" : "landmark"} ${short(String(name))}`));
  }
  body.append(also);
}

function groupText({edges, most}) {
  const out = element("dd", `one of a group of ${edges.length} that agree with one another. Taken out together, `);
  out.append(...(most ? [linkTo("keyframe", most[0], `keyframe ${most[0]}`), ` moves most, by ${general(most[1], 4)} m. `] : ["nothing else holds the map together. "]));
  out.append(element("a", "The group", {href: "#groups-section"}));
  return out;
}

function edgesAt(place) {
  const ends = data.edges.places.map(column);
  return Array.from(edgeIds()).filter((_, row) => ends.some((one) => one[row] === place));
}

function edgeList(edges, body) {
  const list = element("ul"), e = data.edges;
  for (const k of edges.slice(0, 200)) {
    const item = element("li"), about = named(e.landmark, k);
    item.append(linkTo("edge", k, `edge ${k}`), ` ${[named(e.label, k), short(about)].filter(Boolean).join(" ")}: ${verdictOf(k)}, chi2 ${number(values("chi2")(k))} of ${values("dof")(k)}`);
    list.append(item);
  }
  body.append(list);
  if (edges.length > 200) body.append(element("p", `and ${edges.length - 200} more: filter the ledger`));
}

function showKeyframe(k, body) {
  const stamp = column(data.map.stamps)[k], [x, y, z] = data.map.paths.estimate.map((axis) => column(axis)[k]), edges = edgesAt(k);
  const where = `x ${x.toFixed(3)} m, y ${y.toFixed(3)} m${data.dimensions === 3 ? `, z ${z.toFixed(3)} m` : ""}`;
  body.append(element("h3", `keyframe ${k}: ${edges.length} edges`), element("p", `${stamp.toFixed(3)} s, at ${where}`));
  if (data.edges.ids && !edges.length) body.append(element("p", "It was condensed: what was measured there is in the places around it."));
  edgeList(edges, body);
}

function showLandmark(name, body) {
  const at = column(data.edges.landmark_names).indexOf(name), text = column(data.edges.landmark_lines)[at];
  const [first, ...rest] = text.split("\n");
  body.append(element("h3", first), element("pre", rest.map((line) => line.replace(/(\S) {2,}/g, "$1  ")).join("\n")));
  edgeList(edgesAt(data.map.keyframes + at), body);
}

// -- the ledger ------------------------------------------------------------------------------------------------------

const HEIGHT = 24;
const UNSAVED = "(not saved)";
const changeOf = (k) => (extra ? extra.changeOf(k) : "");  // what an edit makes of an edge: "taken out (not saved)"
const verdictAndReason = (k) => {
  const e = data.edges, reason = e.reasons[ofEdge(e.reason, k)];
  return e.verdicts[ofEdge(e.verdict, k)] + (reason ? `: ${reason}` : "");
};
const verdictOf = (k) => changeOf(k) || verdictAndReason(k);
const HINTS = {  // of verdicts and reasons
  "not judged": "odometry and priors are not judged", accepted: "it is in the map", "down-weighted": "it is in the map, with little weight",
  "held back": "it is not in the map, and is judged again whenever the map changes", rejected: "it is not in the map",
  unlikely: "all else would have to move too far for it", "does not fit": "it was tried, and its error stayed too large",
  outvoted: "more or better measurements say something else",
  "by hand": "a person decided it",
};
const values = (name) => (k) => ofEdge(data.edges.columns[name], k);
const FIELDS = [  // name, value, and what it is
  ["edge", (k) => k, "its id"], ["class", (k) => named(data.edges.label, k), "what kind of measurement it is"],
  ["about", (k) => named(data.edges.landmark, k), "its landmark"], ["input", (k) => named(data.edges.source, k), "where it came from"],
  ["keyframe", values("keyframe"), "the keyframe at which it was judged first"],
  ["verdict", (k) => changeOf(k) || data.edges.verdicts[ofEdge(data.edges.verdict, k)], "whether it is in the map"],
  ["reason", (k) => (changeOf(k) ? "" : data.edges.reasons[ofEdge(data.edges.reason, k)]), "why it is not in the map"],
  ["chi2", values("chi2"), "its squared error in the map of the run, in sigmas"], ["dof", values("dof"), "degrees of freedom: how many numbers it measures"],
  ["judged chi2", values("statistic"), "its chi2 when it was judged"], ["limit", values("threshold"), "up to this judged chi2 it would have been accepted"],
  ["weight %", (k) => (changeOf(k) ? (changeOf(k).startsWith("let in") ? 100 : 0) : values("percent")(k)), "how much of it counts"],
  ["end moves m", values("last_m"), "how far the end of the drive moves without it (if it is out: with it) [m], to first order"],
  ["own moves m", values("end_m"), "how far its own keyframe or landmark moves without it (if it is out: with it) [m], to first order"],
];
const ledger = {order: null, sort: FIELDS.findIndex(([name]) => name === "chi2"), up: false, chosen: -1};  // the worst first

function startLedger() {
  FIELDS.forEach(([name, , hint], at) => {
    const button = element("button", name, {type: "button", title: hint}), cell = element("div", undefined, {role: "columnheader", "aria-sort": "none"});
    button.addEventListener("click", () => sortBy(at));
    cell.append(button);
    byId("head").append(cell);
  });
  const classes = data.edges.label.names;
  byId("filter").value = classes.find((one) => one === "closures") || "";
  byId("filter").addEventListener("input", arrange);
  byId("rows").addEventListener("scroll", () => requestAnimationFrame(drawRows));
  byId("rows").addEventListener("keydown", (event) => {
    const step = {ArrowDown: 1, ArrowUp: -1, PageDown: 20, PageUp: -20}[event.key];
    if (!step || !ledger.order.length) return;
    event.preventDefault();
    const at = ledger.order.indexOf(ledger.chosen);
    ledger.chosen = ledger.order[Math.min(ledger.order.length - 1, Math.max(0, at + step))];  // now: the next key may come before the page has moved
    go("edge", ledger.chosen);
  });
  arrange();
}

function sortBy(at) {
  ledger.up = ledger.sort === at ? !ledger.up : true;
  ledger.sort = at;
  arrange();
}

function arrange() {
  const words = byId("filter").value.toLowerCase().split(/\s+/).filter(Boolean), e = data.edges, kept = [];
  const lower = (names) => names.map((name) => name.toLowerCase());
  const parts = [e.label, e.landmark, e.source].map((one) => [lower(one.names), column(one.of)]);
  parts.push([lower(e.verdicts), column(e.verdict)], [lower(e.reasons), column(e.reason)]);
  const hits = words.map((word) => parts.map(([names, codes]) => [names.map((name) => name.includes(word)), codes]));
  for (const [row, k] of edgeIds().entries()) {
    if (hits.every((of, w) => String(k) === words[w] || changeOf(k).includes(words[w]) || of.some(([has, codes]) => has[codes[row]]))) kept.push(k);
  }
  const of = FIELDS[ledger.sort][1], way = ledger.up ? 1 : -1, isSorted = !ledger.sort && ledger.up;
  const keys = isSorted ? null : new Map(kept.map((k) => [k, of(k)]));
  const isMissing = (value) => Number.isNaN(value);
  if (!isSorted) kept.sort((a, b) => {
    const [p, q] = [keys.get(a), keys.get(b)];
    if (isMissing(p) || isMissing(q)) return isMissing(p) - isMissing(q) || a - b;
    return p < q ? -way : p > q ? way : a - b;
  });
  ledger.order = kept;
  [...byId("head").children].forEach((one, at) => one.setAttribute("aria-sort", at !== ledger.sort ? "none" : ledger.up ? "ascending" : "descending"));
  byId("count").textContent = `${kept.length} of ${e.count} edges`;
  byId("space").style.height = `${kept.length * HEIGHT}px`;
  byId("rows").setAttribute("aria-rowcount", kept.length);
  drawRows();
}

function drawRows() {
  const rows = byId("rows"), first = Math.max(0, Math.floor(rows.scrollTop / HEIGHT) - 5);
  const last = Math.min(ledger.order.length, first + Math.ceil(rows.clientHeight / HEIGHT) + 10);
  const drawn = [];
  for (let at = first; at < last; at++) {
    const k = ledger.order[at], row = element("div", undefined, {class: "row", role: "row", "aria-rowindex": at + 1, "data-edge": k, "aria-selected": k === ledger.chosen});
    row.style.top = `${(at + 1) * HEIGHT}px`;
    for (const [, of] of FIELDS) {
      const value = of(k), cell = element("span", undefined, {role: "gridcell", ...(HINTS[value] ? {title: HINTS[value]} : {})});
      cell.append(element("bdi", typeof value === "number" ? (Number.isNaN(value) ? "-" : number(value)) : value));
      row.append(cell);
    }
    if (extra) extra.decorate(row, k);
    row.addEventListener("click", () => { go("edge", k); if (!isPinned()) byId("why").scrollIntoView({block: "nearest"}); });
    drawn.push(row);
  }
  byId("space").replaceChildren(...drawn);
}

const isPinned = () => getComputedStyle(byId("map-section")).position === "sticky";  // map and Why are always seen

function choose(k) {
  ledger.chosen = k;
  const at = ledger.order.indexOf(k), rows = byId("rows");
  if (at >= 0 && (at * HEIGHT < rows.scrollTop || (at + 2) * HEIGHT > rows.scrollTop + rows.clientHeight)) {
    rows.scrollTop = Math.max(0, (at - 4) * HEIGHT);
  }
  drawRows();
}

// -- charts ----------------------------------------------------------------------------------------------------------

const CHARTS = {
  "chart-verdicts": (id) => {
    const bins = data.charts.bins, middle = bins.slice(1).map((b, k) => (b + bins[k]) / 2), c = colours();
    const bars = Object.entries(data.charts.verdicts).filter(([, of]) => of.some(Boolean)).map(([name, y]) => ({type: "bar", name: plain(name), x: middle, y, marker: {color: c[name]}}));
    const changes = {type: "scatter", mode: "lines", name: "verdicts that changed", x: middle, y: data.charts.changes, line: {color: c.ink, width: 1}};
    return Plotly.newPlot(id, [...bars, changes], layout((axis) => ({barmode: "stack", bargap: 0, xaxis: {...axis, title: {text: "keyframe"}}, yaxis: {...axis, title: {text: "edges"}}})), CONFIG);
  },
  "chart-jumps": (id) => {
    const [x, y] = data.drive.corrections.map(column);
    return Plotly.newPlot(id, [{type: "scattergl", mode: "lines", x, y, line: {color: colours().estimate, width: 1}}],
      layout((axis) => ({xaxis: {...axis, title: {text: "keyframe"}}, yaxis: {...axis, title: {text: "the robot is moved by [m]"}}})), CONFIG);
  },
  "chart-load": (id) => {
    const {keyframes: x, ...of} = data.load, c = colours(), waited = of.backlog.some(Boolean);
    const line = (name, y, colour, axis) => ({type: "scatter", mode: "lines", name, x, y, yaxis: axis, line: {color: colour, width: 1.5}});
    const several = [line("CPU time of a keyframe [ms]", of.cpu_ms, c.estimate, "y"), line("memory [MiB]", of.memory_mib, c.truth, "y2")];
    if (waited) several.push(line("backlog [measurements]", of.backlog, c.ink, "y3"));
    return Plotly.newPlot(id, several, layout((axis) => {
      const right = {...axis, overlaying: "y", side: "right", showgrid: false, rangemode: "tozero", tickmode: "auto"};
      return {
        margin: {l: 55, r: 65, t: 10, b: 40}, xaxis: {...axis, title: {text: "keyframe"}, domain: [0, waited ? 0.9 : 1]},
        yaxis: {...axis, title: {text: "ms"}, rangemode: "tozero"}, yaxis2: {...right, title: {text: "MiB"}},
        ...(waited ? {yaxis3: {...right, anchor: "free", position: 1, title: {text: "backlog"}}} : {}),
      };
    }), CONFIG);
  },
  "chart-nees": (id) => {
    const [x, y] = data.nees.values.map(column), c = colours(), line = (name, value) => ({type: "scatter", mode: "lines", name, x: [0, data.map.keyframes], y: [value, value], line: {color: c.truth, width: 1, dash: "dot"}});
    return Plotly.newPlot(id, [{type: "scattergl", mode: "markers", name: "NEES of poses", x, y, marker: {size: 3, color: c.estimate}}, line("95 % band", data.nees.band[0]), {...line("95 % band", data.nees.band[1]), showlegend: false}],
      layout((axis) => ({xaxis: {...axis, title: {text: "keyframe"}}, yaxis: {...axis, type: "log", title: {text: "NEES"}}})), CONFIG);
  },
};

function histogram(id, one) {
  const x = one.bins.slice(1).map((b, k) => (b + one.bins[k]) / 2), c = colours();
  return Plotly.newPlot(id, [
    {type: "bar", name: "chi2 of edges", x, y: one.found, marker: {color: c.accepted}},
    {type: "scatter", mode: "lines", name: "chi2 distribution", x, y: one.should, line: {color: c.estimate, width: 2}},
  ], layout((axis) => ({bargap: 0, xaxis: {...axis, title: {text: plain(one.name)}}, yaxis: {...axis, title: {text: "edges"}}})), CONFIG);
}

const undrawn = new Map(), drawn = new Map();
function drawWhenSeen(id, draw) {
  undrawn.set(id, draw);
  seen.observe(byId(id));
}
const seen = new IntersectionObserver((entries) => entries.forEach((one) => one.isIntersecting && drawNow(one.target.id)), {rootMargin: "100px"});
function drawNow(id) {
  const draw = undrawn.get(id);
  if (!draw) return;
  undrawn.delete(id);
  drawn.set(id, draw);
  seen.unobserve(byId(id));
  draw(id);
}

async function drawAgain() {  // in other colours, or for paper: Plotly has drawn SVG when its call returns
  for (const [id, draw] of drawn) draw(id);
  if (data.map && data.edges) await drawMap(true);
}

let printing = Promise.resolve();
function print(isOn) {  // the browser prints when the call returns; its end may come while the map is still being drawn
  printing = isOn ? drawFor(true) : printing.then(() => drawFor(false));
}

async function drawFor(isOn) {
  if (isOn) [...undrawn.keys()].forEach(drawNow);
  onPaper = isOn;
  await drawAgain();
  if (!isOn && byId("map").data) await Plotly.Plots.resize("map");
}

function startCharts() {
  if (data.charts) drawWhenSeen("chart-verdicts", CHARTS["chart-verdicts"]);
  if (data.drive && data.drive.corrections[0].count) {
    drawWhenSeen("chart-jumps", CHARTS["chart-jumps"]);
  } else byId("chart-jumps").replaceWith(element("p", "the run folder has no poses as they were published", {class: "quiet"}));
  if (data.drive) table("jumps", ["keyframe", "moved m", "turned deg", "edges judged there"], data.drive.jumps.map(([k, m, deg, edges]) => [linkTo("keyframe", k, String(k)), m, deg, edgeLinks(edges)]));
  if (data.load) { byId("chart-load").hidden = false; drawWhenSeen("chart-load", CHARTS["chart-load"]); }
  if (data.nees) { byId("chart-nees").hidden = false; drawWhenSeen("chart-nees", CHARTS["chart-nees"]); }
  (data.charts ? data.charts.chi2 : []).forEach((one, at) => {
    byId("chi2-plots").append(element("div", undefined, {id: `chi2-${at}`, class: "plot"}));
    drawWhenSeen(`chi2-${at}`, (id) => histogram(id, one));
  });
}

// -- the page --------------------------------------------------------------------------------------------------------

function sentence(text, at) {  // the first begins with the verdict; keyframes are links
  const [, verdict, rest] = at ? [null, "", text] : text.match(/^(.*?)[:.](.*)$/s), out = element("p");
  if (verdict) out.append(element("strong", verdict));
  rest.split(/(keyframe \d+)/).forEach((part, k) => out.append(k % 2 ? linkTo("keyframe", part.slice(9), part) : part));
  return out;
}

function writeVerdict() {
  const [first, ...rest] = (data.sentences || []).map(sentence), place = byId("verdict");
  if (!(data.groups || []).length) return place.append(...(first ? [first, ...rest] : []));
  const steps = element("ol"), look = element("li"), more = element("details");
  look.append("Look at ", element("a", "the groups of closures that are in", {href: "#groups-section"}), ".");
  steps.append(look, element("li", extra ? "Take out one group at a time, and see what that does to the map." : `Take out one group at a time: graph_slam view ${data.run} shows the map without it.`),
    element("li", "Save the map without the group that is wrong."));
  more.append(element("summary", "What else is known"), ...rest);
  place.append(...(first ? [first] : []), element("p", "Some closures contradict others, so some that are in may be wrong. To find them:"), steps, more);
  addEventListener("beforeprint", () => { more.open = true; });
}

function writeText() {
  byId("title").textContent = data.title;
  writeVerdict();
  const notes = [...data.losses.map((one) => `lost: ${one}`), ...data.beware.map((one) => `beware: ${one}`)];
  notes.forEach((one) => byId("notes").append(element("li", one)));
  byId("notes").hidden = !notes.length;
  const t = data.tables;
  table("inputs", ["input", "use", ...t.input_columns, "why", "remedy"], t.inputs);
  table("configuration", ["parameter", "value", "default", "meaning"], t.configuration);
  table("versions", ["what", "mark"], t.versions);
  table("timing", ["what", "value"], t.timing);
  table("classes", ["class", "edges", "numbers", "chi2", "chi2 per number"], t.classes);
  table("noise", ["class, input, part", "degrees of freedom", "chi2 per degree", "repeated errors", "sigmas should be"], t.noise, "the run has no record of what its sigmas should be");
  if (t.edits.length) table("edits", ["edit by hand", "what", "who", "when", "why"], t.edits);
  if (data.waiting.length) table("waiting", ["landmark that waits", "why"], data.waiting);
  byId("chi2-dof").textContent = data.chi2_per_dof === null ? "" : `chi2 per degree of freedom of the whole: ${general(data.chi2_per_dof, 3)}`;
  if (data.scores) { byId("scores-section").hidden = false; byId("scores").textContent = data.scores.join("\n"); }
  if (data.compared) {
    byId("compared-section").hidden = false;
    byId("compared-title").textContent = `Compared with ${data.compared.with}`;
    byId("compared").textContent = data.compared.lines.join("\n");
  }
}

function writeGroups() {
  if (!(data.groups || []).length) return;
  byId("groups-section").hidden = false;
  byId("groups-how").textContent = extra ? extra.groupsHow : `graph_slam view ${data.run} shows the map without a group, and saves it so.`;
  const span = ([first, last]) => (first === last ? String(first) : `${first} to ${last}`);
  table("groups", ["closures", "join keyframes", "with", "chi2 with them", "without", "without them moves most", "by m", ...(extra ? ["what if"] : [])],
    data.groups.map((one) => [edgeLinks(one.edges), span(one.ends[0]), span(one.ends[1]), ...(one.chi2 ? one.chi2 : ["-", "-"]),
      one.most ? linkTo("keyframe", one.most[0], `keyframe ${one.most[0]}`) : "nothing else holds the map together", one.most ? one.most[1] : "-", ...(extra ? [extra.group(one.edges)] : [])]));
  document.querySelectorAll("#groups tbody tr").forEach((row, at) => {
    for (const event of ["mouseenter", "focusin"]) row.addEventListener(event, () => showStretches(data.groups[at].ends));
    for (const event of ["mouseleave", "focusout"]) row.addEventListener(event, () => showStretches([]));
  });
}

function showWorst() {
  byId("why-body").append(element("h3", "Worst edges, by chi2 per degree of freedom"));
  edgeList(data.charts.worst, byId("why-body"));
}

async function start() {
  writeText();
  await readColumns();
  if (data.edges) { writeGroups(); showWorst(); startLedger(); }
  if (data.map && data.edges) {
    map.inSpace = data.dimensions === 3;
    await drawMap();
    const frames = data.drive ? data.drive.frames : [];
    byId("time").max = frames.length;
    byId("time").value = frames.length;
    byId("time").disabled = !frames.length;
    if (frames.length) setTime();
    byId("time").addEventListener("input", setTime);
    byId("whole").addEventListener("click", showWhole);
    byId("view").setAttribute("aria-pressed", map.inSpace);
    byId("view").addEventListener("click", async () => {
      map.inSpace = !map.inSpace;
      byId("view").setAttribute("aria-pressed", map.inSpace);
      await drawMap();
      if (frames.length) setTime();
    });
  } else byId("map-section").hidden = true;
  if (!data.edges) byId("ledger").hidden = true;
  startCharts();
  if (extra) extra.start();
  addEventListener("hashchange", () => fromHash(true));
  for (const one of [dark, narrow]) one.addEventListener("change", drawAgain);
  addEventListener("beforeprint", () => print(true));
  addEventListener("afterprint", () => print(false));
  fromHash(true);
  document.body.dataset.ready = "yes";
}

start().catch((error) => {
  byId("notes").hidden = false;
  byId("notes").append(element("li", `the page could not be drawn: ${error.message}`));
  console.error(error);
});
