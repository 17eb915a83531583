"use strict";
// The panel of edits. Its server solves; this file keeps the list, draws what comes back, and sends the plan.
const known = JSON.parse(document.getElementById("panel-data").textContent);
const edits = {list: [], asked: 0, chosen: null};

// -- the list --------------------------------------------------------------------------------------------------------

function add(what) {
  put(what);
  changed();
}

function put(what) {  // {do, ...arguments}
  const names = new Set([...data.tables.edits.map(([name]) => name), ...edits.list.map((one) => one.name)]);
  let name = "", k = edits.list.length;
  do { k += 1; name = `edit-${k}`; } while (names.has(name));
  const when = new Date().toISOString().replace(/\.\d+Z$/, "Z");
  edits.list.push({name, who: "", when, why: "", ...what});
}

const whyOf = (one) => one.why.trim() || byId("reason").value.trim();
const planWith = (who, why) => JSON.stringify({...known.plan, edits: edits.list.map((one) => ({...one, who, why: why(one)}))}, null, 2) + "\n";
const asPlan = () => planWith(byId("who").value.trim(), whyOf);

function changed() {
  const list = byId("pending");
  list.replaceChildren(...edits.list.map((one, at) => {
    const back = one.do === "remove_edge" ? "Put back" : "Drop";
    const item = element("li"), out = element("button", back, {type: "button", "aria-label": `${back}: ${textOf(one)}`});
    out.addEventListener("click", () => { edits.list.splice(at, 1); changed(); });
    const why = element("input", undefined, {type: "text", maxlength: 2000, placeholder: "reason, if another", "aria-label": `Reason: ${textOf(one)}`});
    why.value = one.why;
    why.addEventListener("input", () => { one.why = why.value; });
    item.append(element("bdi", textOf(one)), " ", why, out);
    return item;
  }));
  byId("no-edits").hidden = edits.list.length > 0;
  for (const box of document.querySelectorAll("#groups input")) box.checked = box.dataset.edges.split(" ").every((k) => edits.list.some((one) => one.do === "remove_edge" && String(one.edge) === k));
  byId("bar").hidden = !edits.list.length && !byId("saved").childNodes.length;
  byId("sum").textContent = sumOf(edits.list);
  for (const id of ["undo", "download", "save"]) byId(id).disabled = !edits.list.length;
  arrange();
  fromHash(false);  // the sentences on what is chosen
  solve();
}

function sumOf(list) {  // "4 closures taken out"
  const counted = new Map();
  for (const one of list) {
    const what = one.do === "remove_edge" ? "taken out" : one.do === "let_in_edge" ? "let in" : "";
    const of = what ? named(data.edges.label, one.edge).replace(/e?s$/, (end) => (end === "es" ? "e" : "")) : "other edit", key = `${of}|${what}`;
    counted.set(key, (counted.get(key) || 0) + 1);
  }
  return [...counted].map(([key, n]) => { const [of, what] = key.split("|"); return `${n} ${of}${n > 1 ? "s" : ""} ${what}`.trim(); }).join(", ") || "No edits";
}

function textOf(one) {
  const {do: what, name, who, when, why, ...rest} = one;
  return [what.replace(/_/g, " "), ...Object.entries(rest).map(([field, value]) => `${field.replace(/_/g, " ")} ${short(JSON.stringify(value))}`)].join(", ");
}

// -- what the edits do -----------------------------------------------------------------------------------------------

async function ask(path, body) {
  const answer = await fetch(path, {method: "POST", headers: {"content-type": "application/json"}, body, credentials: "same-origin", cache: "no-store"})
    .catch(() => { throw new Error("the server has ended: graph_slam view starts it again"); });
  const text = await answer.text();
  let found = null;
  try { found = JSON.parse(text); } catch { /* a line */ }
  if (!answer.ok) throw new Error(found && found.error ? found.error : text.trim() || `status ${answer.status}`);
  return found;
}

const lossText = () => (byId("loss").value && byId("loss").value !== "none" ? `${byId("loss").value}:${byId("scale").value}` : byId("loss").value);

async function solve() {
  const turn = ++edits.asked, effect = byId("effect"), loss = lossText();
  document.body.dataset.solved = "no";
  const quick = edits.list.every((one) => one.do === "remove_edge" || one.do === "let_in_edge");
  if (!edits.list.length && !loss) {
    effect.replaceChildren();
    if (map.moved) await moveTo(null);
    document.body.dataset.solved = turn;
    return;
  }
  const lines = [];
  const numbersOf = (found) => `chi2 ${general(found.chi2[0], 6)} → ${general(found.chi2[1], 6)}; keyframe ${found.most[0]} moves most, by ${found.most[1].toFixed(3)} m; the last pose moves by ${found.final_m.toFixed(3)} m`;
  const show = async (found, title) => {
    if (turn !== edits.asked) return;
    if (edits.quick === numbersOf(found)) lines.pop();  // as solved: one line is enough
    edits.quick = numbersOf(found);
    lines.push(element("p", `${title}: ${edits.quick}`));
    for (const one of found.notes || []) lines.push(element("p", one));
    if (found.changes && found.changes.length) lines.push(changesText(found.changes));
    effect.replaceChildren(...lines);
    await moveTo(asMoved(found));
    await drawGhost();
  };
  edits.quick = "";
  try {
    if (quick) {
      const of = (what) => edits.list.filter((one) => one.do === what).map((one) => one.edge);
      const solved = (first) => ask("/solve", JSON.stringify({without: of("remove_edge"), let_in: of("let_in_edge"), loss, first}));
      let found = await solved(true);
      if (!found.is_solved) {  // far away: the first steps, and then the solution
        await show(found, "After the first steps, being solved");
        lines.pop();
        edits.quick = "";
        if (turn === edits.asked) found = await solved(false);
      }
      if (!found.is_solved) lines.push(element("p", "Not a solution: the solver did not converge. The edges that were let in contradict all else.", {class: "fault"}));
      await show(found, !found.is_solved ? "After the last step, not converged" : loss ? "With this loss" : "Solved, other decisions as they are");
    }
    if (edits.list.length && turn === edits.asked && !loss) await show(await ask("/try", planWith("-", () => "-")), "As it would be saved, all judged again");
    if (loss && edits.list.length && turn === edits.asked) lines.push(element("p", "A loss is a question only: a saved run has the losses of its configuration.", {class: "quiet"}));
  } catch (error) {
    if (turn !== edits.asked) return;
    lines.push(element("p", error.message, {class: "fault"}));
  }
  if (turn !== edits.asked) return;
  effect.replaceChildren(...lines);
  document.body.dataset.solved = turn;
}

function asMoved(found) {
  return {path: found.places.map((axis) => Float64Array.from(axis)), landmarks: new Map(Object.entries(found.landmarks))};
}

function changesText(changes) {
  const out = element("p", `${changes.length} other decisions change: `);
  changes.slice(0, 20).forEach(([edge, before, after], at) => out.append(at ? ", " : "", linkTo("edge", edge, `edge ${edge}`), ` ${before} → ${after}`));
  if (changes.length > 20) out.append(`, and ${changes.length - 20} more`);
  return out;
}

// -- saving ----------------------------------------------------------------------------------------------------------

async function save() {
  const place = byId("saved");
  for (const [id, name, isMissing] of [["who", "Who", !byId("who").value.trim()], ["reason", "Reason", edits.list.some((one) => !whyOf(one))]]) {
    if (!isMissing) continue;
    place.replaceChildren(element("p", `${name} is empty: an edit is kept with who made it, and the reason`, {class: "fault"}));
    return byId(id).focus();
  }
  byId("save").disabled = true;
  place.replaceChildren(element("p", "saving ..."));
  try {
    const found = await ask("/save", asPlan());
    place.replaceChildren(
      element("p", `Saved in ${found.folder}: chi2 ${general(found.chi2[0], 6)} → ${general(found.chi2[1], 6)}, the last pose moved by ${found.final_m.toFixed(4)} m. The run on this page is as it was.`),
      ...(found.verdict ? [element("p", `The saved map: ${found.verdict}`)] : []),
      element("p", `See it: ${found.next}`), element("p", `The same by command, with the plan: ${found.command}`),
      ...found.notes.map((one) => element("p", one)),
      ...found.losses.map((one) => element("p", `lost: ${one}`, {class: "fault"})),
    );
  } catch (error) {
    place.replaceChildren(element("p", `not saved: ${error.message}`, {class: "fault"}));
  }
  byId("save").disabled = !edits.list.length;
}

function download() {
  const link = element("a", undefined, {href: URL.createObjectURL(new Blob([asPlan()], {type: "application/json"})), download: "edits.json"});
  link.click();
  URL.revokeObjectURL(link.href);
}

// -- forms -----------------------------------------------------------------------------------------------------------

const kindOf = (what) => known.kinds.find((one) => one.do === what);
const numbers = (text) => text.split(/[\s,;[\]]+/).filter(Boolean).map(Number);
const READ = {  // by the kind of a field; the server judges what comes
  edge: Number, edges: numbers, pose: numbers, landmark: (text) => text, name: (text) => text,
  keyframe: (text) => (/^\d+$/.test(text) ? Number(text) : text),
};

function drawFields() {
  const {fields, help} = kindOf(byId("kind").value), isEdited = edits.chosen && edits.chosen[0] === "edge" && pendingOf(edits.chosen[1]) >= 0;
  const filled = edits.chosen && !isEdited ? [edits.chosen] : [];
  byId("kind-help").textContent = help;
  byId("fields").replaceChildren(...fields.map(({key, kind, text, is_needed}) => {
    const label = element("label", `${key.replace(/_/g, " ")} `), input = element("input", undefined, {name: key, type: "text", title: text, ...(is_needed ? {required: ""} : {placeholder: "or"})});
    input.dataset.kind = kind;
    const at = filled.findIndex(([of]) => of === kind || (of === "edge" && kind === "edges"));
    if (at >= 0) input.value = filled.splice(at, 1)[0][1];
    if (kind === "keyframe") input.addEventListener("input", () => drawGhost());
    label.append(input, " ");
    return label;
  }));
  if (data.map) drawGhost();
}

function fromFields() {
  const out = {do: byId("kind").value};
  for (const input of byId("fields").querySelectorAll("input")) {
    const text = input.value.trim();
    if (text) out[input.name] = (READ[input.dataset.kind] || Number)(text);
  }
  return out;
}

// -- a closure by dragging: a ring at the second keyframe; where it is dropped is its pose seen from the first ---------

const field = (key) => byId("fields").querySelector(`input[name=${key}]`);

function closureEnds() {
  if (byId("kind").value !== "add_closure" || map.inSpace || !known.headings.length) return null;
  const ends = ["from_keyframe", "to_keyframe"].map((key) => field(key).value.trim());
  return ends.every((text) => /^\d+$/.test(text) && Number(text) < known.headings.length) ? ends.map(Number) : null;
}

async function drawGhost(place) {  // at a place, or where the second keyframe is
  const ends = closureEnds(), plot = byId("map"), shapes = [];
  byId("ghost-hint").hidden = !ends;
  edits.ghost = ends ? place || points().slice(0, 2).map((axis) => axis[ends[1]]) : null;
  if (ends) {
    const [x, y] = edits.ghost, [low, high] = plot.layout.xaxis.range, r = 0.012 * Math.abs(high - low);
    shapes.push({type: "circle", x0: x - r, x1: x + r, y0: y - r, y1: y + r, fillcolor: colours().mark, opacity: 0.7, line: {color: colours().mark, width: 3}});
  }
  if (shapes.length || (plot.layout.shapes || []).length) await Plotly.relayout("map", {shapes});
}

function dragGhost(event) {  // before plotly, for which it would be a pan
  if (!edits.ghost || event.button) return;
  const plot = byId("map"), {xaxis, yaxis} = plot._fullLayout, box = plot.getBoundingClientRect();
  const left = box.left + xaxis._offset, top = box.top + yaxis._offset;
  if (Math.hypot(event.clientX - left - xaxis.l2p(edits.ghost[0]), event.clientY - top - yaxis.l2p(edits.ghost[1])) > 16) return;
  event.preventDefault();
  event.stopPropagation();
  const moved = (to) => drawGhost([xaxis.p2l(to.clientX - left), yaxis.p2l(to.clientY - top)]);
  addEventListener("mousemove", moved);
  addEventListener("mouseup", () => { removeEventListener("mousemove", moved); fillPose(); }, {once: true});
}

function fillPose() {
  const all = points(), [from, to] = closureEnds(), turn = known.headings[from], [dx, dy] = edits.ghost.map((value, axis) => value - all[axis][from]);
  const ahead = Math.cos(turn) * dx + Math.sin(turn) * dy, left = Math.cos(turn) * dy - Math.sin(turn) * dx;
  const old = field("pose").value.trim() ? numbers(field("pose").value)[2] : known.headings[to] - turn;
  field("pose").value = [ahead, left, Math.atan2(Math.sin(old), Math.cos(old))].map((value) => value.toFixed(3)).join(", ");
}

// -- what can be done with what is chosen -----------------------------------------------------------------------------

const isInside = (k) => ["accepted", "not judged", "down-weighted"].includes(data.edges.verdicts[ofEdge(data.edges.verdict, k)]);
const pendingOf = (k) => edits.list.findIndex((one) => one.edge === k && (one.do === "remove_edge" || one.do === "let_in_edge"));
const isOdometry = (k) => ["odometry", "prior"].includes(named(data.edges.label, k));

function drawActions() {
  const place = byId("actions");
  if (!place || !edits.chosen) return;
  const [kind, which] = edits.chosen, buttons = [];
  if (kind === "edge" && !isOdometry(which)) {
    const box = element("input", undefined, {type: "checkbox", id: "is-in"}), label = element("label"), at = pendingOf(which);
    box.checked = at < 0 ? isInside(which) : edits.list[at].do === "let_in_edge";
    box.addEventListener("change", () => toggle(which));
    label.append(box, " in the map");
    buttons.push(label);
  }
  const isSighting = kind === "edge" && named(data.edges.landmark, which) !== "";
  for (const {do: what, fields} of known.kinds) {
    if (!fields.some((one) => one.kind === kind || (isSighting && one.kind === "edges")) || what.endsWith("_edge")) continue;
    const button = element("button", what.replace(/_/g, " "), {type: "button"});
    button.addEventListener("click", () => {
      byId("more").open = true;
      byId("kind").value = what;
      drawFields();
      const rest = [...byId("fields").querySelectorAll("input")].filter((one) => !one.value);
      if (rest.length || fields.some((one) => !one.is_needed)) { (rest[0] || byId("kind")).focus(); byId("new-edit").scrollIntoView({block: "center"}); } else add(fromFields());
    });
    buttons.push(button);
  }
  place.replaceChildren(...buttons);
}

function toggle(k) {
  const at = pendingOf(k);
  if (at >= 0) { edits.list.splice(at, 1); return changed(); }
  add({do: isInside(k) ? "remove_edge" : "let_in_edge", edge: k});
}

function toggleAll(edges, isOut) {
  edits.list = edits.list.filter((one) => !(one.do === "remove_edge" && edges.includes(one.edge)));
  if (!isOut) return changed();
  const names = (edge) => ({do: "remove_edge", edge});
  edges.slice(0, -1).forEach((edge) => put(names(edge)));
  return add(names(edges[edges.length - 1]));
}

// -- what the page calls ---------------------------------------------------------------------------------------------

const panel = {
  start() {
    history.replaceState(null, "", location.pathname + location.hash);  // the token was for once
    byId("who").value = known.who;
    byId("loss").append(element("option", "as in the run", {value: ""}), ...known.losses.map((name) => element("option", name.replace(/_/g, " "), {value: name})));
    byId("scale").value = known.scale;
    byId("kind").append(...known.kinds.map((one) => element("option", one.do.replace(/_/g, " "), {value: one.do})));
    const scaled = () => { byId("scale-label").hidden = !byId("loss").value || byId("loss").value === "none"; };
    scaled();
    drawFields();
    byId("loss").addEventListener("change", () => { scaled(); solve(); });
    byId("scale").addEventListener("change", solve);
    byId("kind").addEventListener("change", drawFields);
    byId("new-edit").addEventListener("submit", (event) => { event.preventDefault(); add(fromFields()); });
    byId("map").addEventListener("mousedown", dragGhost, {capture: true});
    byId("undo").addEventListener("click", () => { edits.list.pop(); byId("saved").replaceChildren(); changed(); });
    byId("download").addEventListener("click", download);
    byId("save-form").addEventListener("submit", (event) => { event.preventDefault(); save(); });
    byId("rows").addEventListener("keydown", (event) => {
      if (event.key !== " " || ledger.chosen < 0 || isOdometry(ledger.chosen)) return;
      event.preventDefault();
      toggle(ledger.chosen);
    });
    if (data.tables.edits.length) {
      byId("applied").append(element("h3", "Edits that the run has"));
      const list = element("ul");
      for (const [name, text, who, when, why] of data.tables.edits) list.append(element("li", `${name}: ${text}, by ${who}, ${when}: ${why}`));
      byId("applied").append(list);
    }
  },
  show(kind, which, body) {
    edits.chosen = [kind, which];
    body.append(element("div", undefined, {class: "actions", id: "actions"}));
    drawFields();
    drawActions();
  },
  groupsHow: "Take a group out: the map shows at once how it is without. To keep that, fill in the reason above the map, and save.",
  group(edges) {
    const box = element("input", undefined, {type: "checkbox"}), label = element("label");
    box.dataset.edges = edges.join(" ");
    box.addEventListener("change", () => { toggleAll(edges, box.checked); if (!isPinned()) byId("map-section").scrollIntoView(); });
    label.append(box, " take out");
    return label;
  },
  changeOf(k) {
    const at = pendingOf(k);
    return at < 0 ? "" : `${edits.list[at].do === "remove_edge" ? "taken out" : "let in"} ${UNSAVED}`;
  },
  decorate(row, k) {
    if (pendingOf(k) >= 0) row.classList.add("edited");
  },
};
