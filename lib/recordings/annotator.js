// The annotator's page: two views of a stereo frame, marks, suggestions, epipolar lines.  lib/recordings/annotator.py keeps
// the marks; this file draws them and sends it messages.  Pixels are (x, y) with integers at pixel centres, so pixel (x, y) covers
// [x - 0.5, x + 0.5]; a view shows image corner coordinates X = x + 0.5 at screen (X - view.x) * view.zoom, in CSS pixels.

const COLOURS = ["#56b4e9", "#ffb000", "#2bd4a0", "#f78ad0", "#f0e442", "#ff7f5e", "#b79cff", "#ffffff"];
const SIDES = ["left", "right"];
const LOUPE = { radius: 78, times: 4, least: 8 };
const SILENT_MS = 4000;
const FARTHEST_CLICK = 4; // CSS pixels; a press that moves farther is a drag

const KEYS = [
  ["click, Enter", "mark the current landmark"],
  ["1 ... 8", "choose a landmark"],
  ["v", "other view"],
  ["arrows", "move the cursor by a screen pixel (Shift: by 20)"],
  ["a", "mark where the robot reports it (Shift: all without a mark)"],
  ["d", "mark where the detector found it (Shift: all without a mark)"],
  ["h", "hidden, or visible again"],
  ["x", "not in this image"],
  ["Delete", "remove the mark"],
  ["u, r", "undo, redo"],
  ["n", "next frame, the most useful first"],
  [", .", "frame before, frame after"],
  ["+ -, wheel", "zoom about the cursor"],
  ["drag", "pan"],
  ["t, 0", "zoom to the tool, whole image"],
  ["c, b", "more contrast, brighter (Shift: less)"],
  ["l", "loupe on or off"],
  ["s", "suggestions on or off"],
  ["?", "this list"],
];

const STYLE = `
.ms-annotator { --line: var(--jp-border-color2, #d0d4da); --ink: var(--jp-ui-font-color1, #1d2126);
  --soft: var(--jp-ui-font-color2, #5c6570); --paper: var(--jp-layout-color1, #fff); --band: var(--jp-layout-color2, #f3f5f7);
  font: 13px/1.45 var(--jp-ui-font-family, system-ui, sans-serif); color: var(--ink); background: var(--paper);
  border: 1px solid var(--line); border-radius: 8px; outline: none; overflow: hidden; position: relative; }
.ms-annotator:focus-within, .ms-annotator:focus { border-color: #0072b2; box-shadow: 0 0 0 2px #0072b255; }
.ms-annotator .bar { display: flex; flex-wrap: wrap; gap: 6px 14px; align-items: center; padding: 7px 12px; background: var(--band); }
.ms-annotator .bar b { font-weight: 600; }
.ms-annotator .gap { flex: 1; }
.ms-annotator button { font: inherit; color: inherit; background: var(--paper); border: 1px solid var(--line); border-radius: 5px;
  padding: 2px 9px; cursor: pointer; }
.ms-annotator button:hover { border-color: #0072b2; }
.ms-annotator kbd { font: 11px ui-monospace, monospace; color: var(--soft); border: 1px solid var(--line); border-radius: 3px;
  padding: 0 4px; margin-left: 3px; background: var(--paper); }
.ms-annotator .views { display: grid; grid-template-columns: 1fr 1fr; gap: 2px; background: #000; }
.ms-annotator .view { position: relative; overflow: hidden; background: #111; cursor: crosshair; touch-action: none; }
.ms-annotator .view canvas { position: absolute; left: 0; top: 0; display: block; }
.ms-annotator .view span { position: absolute; left: 8px; top: 6px; color: #fff; background: #0009; border-radius: 4px;
  padding: 1px 8px; pointer-events: none; }
.ms-annotator .view.active span { background: #0072b2; }
.ms-annotator .chip { display: inline-flex; align-items: center; gap: 5px; }
.ms-annotator .chip i { width: 10px; height: 10px; border-radius: 50%; border: 1px solid #0006; }
.ms-annotator .chip.current { outline: 2px solid #0072b2; outline-offset: 1px; }
.ms-annotator .chip small { color: var(--soft); }
.ms-annotator .strip { display: flex; height: 8px; background: var(--line); cursor: pointer; }
.ms-annotator .strip div { flex: 1; min-width: 0; }
.ms-annotator .state { min-height: 1.45em; padding: 1px 9px; border-radius: 10px; background: #2e7d3222; }
.ms-annotator .state.bad { background: #b42318; color: #fff; font-weight: 600; }
.ms-annotator .help { position: absolute; inset: 44px 12px auto auto; background: var(--paper); border: 1px solid var(--line);
  border-radius: 8px; padding: 10px 16px; box-shadow: 0 8px 30px #0005; z-index: 5; columns: 2; column-gap: 28px; max-width: 92%; }
.ms-annotator .help div { display: flex; align-items: baseline; break-inside: avoid; padding: 1px 0; }
.ms-annotator .help kbd { flex: none; min-width: 74px; text-align: center; margin: 0 8px 0 0; }
.ms-annotator [hidden] { display: none; }`;

function element(tag, className, parent, text) {
  const made = document.createElement(tag);
  if (className) made.className = className;
  if (text !== undefined) made.textContent = text;
  parent?.append(made);
  return made;
}

function render({ model, el }) {
  element("style", "", el, STYLE);
  const root = element("div", "ms-annotator", el);
  root.tabIndex = 0;
  root.setAttribute("role", "application");
  root.setAttribute("aria-label", "Landmark annotator; press ? for its keys");
  const top = element("div", "bar", root);
  const title = element("b", "", top);
  const place = element("span", "", top);
  element("div", "gap", top);
  const state = element("span", "state", top);
  state.setAttribute("role", "status");
  const strip = element("div", "strip", root);
  const grid = element("div", "views", root);
  const bottom = element("div", "bar", root);
  const chips = element("span", "bar", bottom);
  chips.style.padding = 0;
  const legend = element("span", "", bottom, "\u25c7 robot  \u25a1 detector");
  legend.style.color = "var(--soft)";
  element("div", "gap", bottom);
  for (const [text, key] of [["undo", "u"], ["next useful", "n"], ["tool", "t"], ["whole image", "0"], ["keys", "?"]]) {
    const button = element("button", "", bottom, text);
    element("kbd", "", button, key);
    button.onclick = () => { press(key, false); root.focus(); };
  }
  const help = element("div", "help", root);
  help.hidden = true;
  for (const [key, text] of KEYS) element("kbd", "", element("div", "", help)).after(text), (help.lastChild.firstChild.textContent = key);

  let about = null, shown = null; // description of the recording; state of the frame that is shown, from the kernel
  let active = 0, landmark = 0, loupe = true, suggestions = true, contrast = 1, brightness = 1, wanted = null;
  let waiting = new Map(), count = 0, problem = "";
  const views = SIDES.map((side, index) => {
    const box = element("div", "view", grid);
    const view = { side, index, box, x: 0, y: 0, zoom: 0, cursor: null, image: null, width: 0, height: 0, at: null };
    view.picture = element("canvas", "", box);
    view.overlay = element("canvas", "", box);
    element("span", "", box, side);
    return view;
  });

  // --- messages: marks stay in the browser's store until the kernel confirms that they are in the file

  const me = Math.random().toString(36).slice(2); // several pages may show one recording, in one kernel or in several
  const store = (page) => `microstereo.annotator:${about.key}|${page}`;
  function keep() {
    const marks = [...waiting.values()].filter((m) => m.do === "mark").map((m) => m.marks);
    try { marks.length ? localStorage.setItem(store(me), JSON.stringify(marks)) : localStorage.removeItem(store(me)); } catch { /* no store */ }
  }
  function takeOver() { // send the marks that earlier pages could not save
    try {
      for (const name of Object.keys(localStorage).filter((name) => name.startsWith(store("")))) {
        for (const marks of JSON.parse(localStorage.getItem(name))) ask({ do: "mark", marks, frame: marks[0][1] });
        localStorage.removeItem(name); // they are kept under this page's name now
      }
    } catch { /* no store */ }
  }
  function ask(message) {
    const sent = { ...message, id: `${me}.${++count}`, since: Date.now() };
    waiting.set(sent.id, sent);
    if (sent.do === "mark") keep();
    try { model.send(sent); } catch { /* tell() reports it if no answer comes */ }
    tell();
  }
  function tell() {
    const late = [...waiting.values()].filter((m) => Date.now() - m.since > SILENT_MS);
    const unsaved = late.filter((m) => m.do === "mark").length;
    const silent = late.length ? `The kernel does not answer${unsaved ? `; ${unsaved} marks are kept in this browser` : ""}. ` +
      "Restart it and display the annotator again." : "";
    state.className = problem || silent ? "state bad" : "state";
    state.textContent = problem || silent || (waiting.size ? "saving ..." : shown ? `saved in ${shown.file}` : "");
  }
  async function hear(answer, buffers) {
    if (answer.renew) return shown && ask({ do: "show", frame: shown.frame });
    if (!waiting.has(answer.id)) { // the answer to another page of the same annotator, whose changes hold here too
      if (!shown || !answer.complete || waiting.size) return;
      shown = answer.frame === shown.frame ? { ...shown, ...answer } : { ...shown, complete: answer.complete };
      return draw();
    }
    const asked = waiting.get(answer.id);
    waiting.delete(answer.id);
    const writes = ["mark", "undo", "redo"].includes(asked.do);
    if (answer.error) problem = (writes ? "Not saved: " : "") + answer.error;
    else if (writes || !problem.startsWith("Not saved")) problem = ""; // later answers must not hide a refused mark
    if (asked.do === "hello" && answer.landmarks) {
      about = answer;
      takeOver();
      dress();
    }
    if (about) keep();
    tell();
    if (answer.error) return shown && asked.do === "mark" && ask({ do: "show", frame: shown.frame });
    if (buffers?.length) {
      const images = await Promise.all(buffers.map((b) => createImageBitmap(new Blob([b], { type: "image/jpeg" }))));
      if (wanted !== null && answer.frame !== wanted && asked.do === "show") return;
      const fresh = shown?.frame !== answer.frame;
      views.forEach((view, k) => { view.image = images[k]; view.cursor = fresh ? null : view.cursor; if (!view.zoom) whole(view); });
      shown = answer;
      if (fresh) { active = 0; landmark = open(0); }
      wanted = null;
    } else if (shown && answer.frame === shown.frame) {
      if (![...waiting.values()].some((m) => m.do === "mark")) shown = { ...shown, ...answer };
      else shown = { ...shown, lines: answer.lines, complete: answer.complete };
    } else if (shown && (asked.do === "undo" || asked.do === "redo")) return show(answer.frame);
    else if (shown) shown.complete = answer.complete;
    draw();
  }
  const show = (frame) => { wanted = Math.min(Math.max(frame, 0), about.n - 1); ask({ do: "show", frame: wanted }); };

  // --- marks

  /** The first landmark without a mark in a view, or the current one if all have marks. */
  function open(index) {
    const free = shown.marks[index].findIndex((mark) => mark[2] === 0);
    return free < 0 ? landmark : free;
  }
  function mark(changes) {
    if (!changes.length) return;
    const marks = changes.map(([index, k, x, y, v]) => [SIDES[index], shown.frame, k, x, y, v]);
    for (const [index, k, x, y, v] of changes) {
      shown.marks[index][k] = [x, y, v];
      if (!index) shown.lines[k] = null;
    }
    ask({ do: "mark", marks, frame: shown.frame });
    draw();
  }
  function choose(index, k) { // the keyboard's cursor moves to the landmark's mark or suggestion
    [active, landmark] = [index, k];
    if ([shown.marks, shown.robot, shown.detector].some((u) => u[index][k][0] !== null)) views[index].cursor = null;
    draw();
  }
  function advance() {
    if (shown.marks[active].some((one) => one[2] === 0)) choose(active, open(active));
    else if (shown.marks[1 - active].some((one) => one[2] === 0)) choose(1 - active, open(1 - active));
  }
  function put(view, u) {
    const [width, height] = about.size, old = shown.marks[view.index][landmark];
    const x = Math.min(Math.max(u[0], -0.5), width - 0.5), y = Math.min(Math.max(u[1], -0.5), height - 0.5);
    mark([[view.index, landmark, x, y, old[2] === 1 ? 1 : 2]]);
    advance();
  }
  function accept(name, all) {
    const inside = ([x, y]) => x !== null && x >= -0.5 && y >= -0.5 && x <= about.size[0] - 0.5 && y <= about.size[1] - 0.5;
    const which = all ? SIDES.flatMap((_, i) => about.landmarks.map((_, k) => [i, k])).filter(([i, k]) => shown.marks[i][k][2] === 0)
      : [[active, landmark]];
    mark(which.filter(([i, k]) => inside(shown[name][i][k])).map(([i, k]) => [i, k, ...shown[name][i][k], 2]));
    advance();
  }

  // --- views

  function whole(view) {
    view.zoom = Math.min(view.width / about.size[0], view.height / about.size[1]) || 0.4;
    view.x = about.size[0] / 2 - view.width / view.zoom / 2;
    view.y = about.size[1] / 2 - view.height / view.zoom / 2;
  }
  function toTool(view) {
    const known = [shown.marks, shown.robot, shown.detector].map((u) => u[view.index].filter((one) => one[0] !== null));
    const u = known[0].length > 1 ? known[0] : known.find((one) => one.length) || [];
    if (!u.length) return whole(view);
    const low = [0, 1].map((a) => Math.min(...u.map((one) => one[a]))), high = [0, 1].map((a) => Math.max(...u.map((one) => one[a])));
    const size = Math.max(high[0] - low[0], high[1] - low[1], 60) * 1.7;
    view.zoom = Math.min(view.width, view.height) / size;
    view.x = (low[0] + high[0] + 1) / 2 - view.width / view.zoom / 2;
    view.y = (low[1] + high[1] + 1) / 2 - view.height / view.zoom / 2;
  }
  function zoom(view, factor, sx, sy) {
    const next = Math.min(Math.max(view.zoom * factor, 0.05), 64);
    view.x += sx / view.zoom - sx / next;
    view.y += sy / view.zoom - sy / next;
    view.zoom = next;
  }
  const screen = (view, u) => [(u[0] + 0.5 - view.x) * view.zoom, (u[1] + 0.5 - view.y) * view.zoom];
  const pixel = (view, s) => [s[0] / view.zoom + view.x - 0.5, s[1] / view.zoom + view.y - 0.5];
  function cursor(view) {
    if (!view.cursor) {
      const from = [shown.marks, shown.robot, shown.detector].map((u) => u[view.index][landmark]).find((u) => u[0] !== null);
      view.cursor = from ? [from[0], from[1]] : pixel(view, [view.width / 2, view.height / 2]);
    }
    return view.cursor;
  }
  function move(dx, dy) {
    const view = views[active], at = cursor(view);
    view.cursor = [at[0] + dx / view.zoom, at[1] + dy / view.zoom].map((v, a) => Math.min(Math.max(v, -0.5), about.size[a] - 0.5));
    const s = screen(view, view.cursor); // the view follows a cursor that leaves it
    view.x += (Math.min(s[0] - 20, 0) + Math.max(s[0] - view.width + 20, 0)) / view.zoom;
    view.y += (Math.min(s[1] - 20, 0) + Math.max(s[1] - view.height + 20, 0)) / view.zoom;
  }

  // --- drawing

  let asked = false;
  function draw() {
    if (!asked) { asked = true; requestAnimationFrame(() => { asked = false; if (shown) paint(); }); }
  }
  function paint() {
    const dots = about.landmarks.map((_, k) => SIDES.map((_, i) => ["\u2013", "\u25cc", "\u25cf", "\u2205"][[0, 1, 2, -1].indexOf(shown.marks[i][k][2])]).join(" "));
    [...chips.children].forEach((chip, k) => {
      chip.className = k === landmark ? "chip current" : "chip";
      chip.lastChild.textContent = dots[k];
    });
    const done = shown.complete.filter(Boolean).length;
    place.textContent = `frame ${shown.frame} (0 to ${about.n - 1}) \u00b7 ${done} labelled` +
      (shown.usefulness > 0 ? ` \u00b7 detector and robot differ by ${shown.usefulness.toFixed(1)} px` : "");
    [...strip.children].forEach((cell, f) => {
      cell.style.background = f === shown.frame ? "#0072b2" : shown.complete[f] ? "#2e9d5b" : "";
    });
    views.forEach((view) => { view.box.classList.toggle("active", view.index === active); paintImage(view); paintMarks(view); });
    root.dataset.frame = shown.frame;
    root.dataset.landmark = about.landmarks[landmark];
    root.dataset.view = SIDES[active];
  }
  function clear(canvas) {
    const c = canvas.getContext("2d"), ratio = canvas.width / parseFloat(canvas.style.width);
    c.setTransform(1, 0, 0, 1, 0, 0);
    c.clearRect(0, 0, canvas.width, canvas.height);
    c.setTransform(ratio, 0, 0, ratio, 0, 0);
    return c;
  }
  function paintImage(view) {
    const r = view.box.getBoundingClientRect(), scale = window.devicePixelRatio, ratio = Number.isInteger(scale) ? 1 : scale;
    for (const canvas of [view.picture, view.overlay]) { // browsers draw from whole pixels, so the canvases start there
      canvas.style.left = `${Math.round(r.left * ratio) / ratio - r.left}px`;
      canvas.style.top = `${Math.round(r.top * ratio) / ratio - r.top}px`;
    }
    const c = clear(view.picture);
    view.picture.style.filter = `contrast(${contrast}) brightness(${brightness})`;
    c.imageSmoothingEnabled = view.zoom < 3;
    c.imageSmoothingQuality = "high";
    c.drawImage(view.image, -view.x * view.zoom, -view.y * view.zoom, about.size[0] * view.zoom, about.size[1] * view.zoom);
  }
  function stroke(c, colour, width, dash = []) { // a dark outline keeps every colour readable on every image
    c.setLineDash(dash);
    for (const [style, wide] of [["#0008", width + 1.6], [colour, width]]) { c.strokeStyle = style; c.lineWidth = wide; c.stroke(); }
  }
  function path(c, ...parts) {
    c.beginPath();
    for (const part of parts) part.forEach(([x, y], k) => (k ? c.lineTo(x, y) : c.moveTo(x, y)));
  }
  const cross = (s, inner, outer) => [[1, 0], [-1, 0], [0, 1], [0, -1]].map(([dx, dy]) =>
    [[s[0] + inner * dx, s[1] + inner * dy], [s[0] + outer * dx, s[1] + outer * dy]]);
  function paintMarks(view) {
    const c = clear(view.overlay), current = view.index === active;
    c.font = "12px system-ui, sans-serif";
    if (view.index === 1) shown.lines.forEach((line, k) => {
      if (!line) return;
      const s = line.map((u) => screen(view, u)), [a, b] = [s[0], s.at(-1)], far = 1e4 / (Math.hypot(b[0] - a[0], b[1] - a[1]) || 1);
      const along = [(b[0] - a[0]) * far, (b[1] - a[1]) * far];
      path(c, [[a[0] - along[0], a[1] - along[1]], ...s, [b[0] + along[0], b[1] + along[1]]]);
      c.globalAlpha = k === landmark ? 1 : 0.6;
      stroke(c, COLOURS[k], 1.6);
      c.globalAlpha = 1;
    });
    if (suggestions) for (const name of ["detector", "robot"]) shown[name][view.index].forEach((u, k) => {
      if (u[0] === null || shown.marks[view.index][k][2] > 0) return;
      const [x, y] = screen(view, u), r = name === "robot" ? 10 : 7;
      if (name === "robot") path(c, [[x - r, y], [x, y - r], [x + r, y], [x, y + r], [x - r, y]]);
      else path(c, [[x - r + 1, y - r + 1], [x + r - 1, y - r + 1], [x + r - 1, y + r - 1], [x - r + 1, y + r - 1], [x - r + 1, y - r + 1]]);
      stroke(c, COLOURS[k], 1.4);
    });
    shown.marks[view.index].forEach(([x, y, v], k) => {
      if (v <= 0) return;
      const s = screen(view, [x, y]);
      path(c, ...cross(s, 3, 13));
      stroke(c, COLOURS[k], k === landmark && current ? 2.6 : 2, v === 1 ? [3, 2] : []);
      c.setLineDash([]);
      c.lineWidth = 3;
      c.strokeStyle = "#000b";
      const text = about.landmarks[k] + (v === 1 ? " (hidden)" : "");
      c.strokeText(text, s[0] + 11, s[1] - 7);
      c.fillStyle = COLOURS[k];
      c.fillText(text, s[0] + 11, s[1] - 7);
    });
    const absent = about.landmarks.filter((_, k) => shown.marks[view.index][k][2] === -1);
    if (absent.length) { c.fillStyle = "#fff"; c.fillText(`not in this image: ${absent.join(", ")}`, 10, view.height - 10); }
    const at = view.at || (current && root.contains(document.activeElement) ? screen(view, cursor(view)) : null);
    if (!view.at && at) { path(c, ...cross(at, 4, 22)); stroke(c, "#fff", 1); }
    if (at && loupe && (view.at || current)) paintLoupe(c, view, at);
  }
  function paintLoupe(c, view, at) {
    const r = LOUPE.radius, times = Math.max(LOUPE.times * view.zoom, LOUPE.least);
    const left = at[0] > view.width / 2, centre = [left ? r + 8 : view.width - r - 8, r + 8];
    if (Math.hypot(at[0] - centre[0], at[1] - centre[1]) < r + 12) centre[1] = view.height - r - 8;
    const u = pixel(view, at), [X, Y] = [u[0] + 0.5, u[1] + 0.5];
    c.save();
    c.beginPath();
    c.arc(...centre, r, 0, 2 * Math.PI);
    c.clip();
    c.fillStyle = "#111";
    c.fillRect(centre[0] - r, centre[1] - r, 2 * r, 2 * r);
    c.filter = `contrast(${contrast}) brightness(${brightness})`;
    c.imageSmoothingEnabled = false;
    c.drawImage(view.image, centre[0] - X * times, centre[1] - Y * times, about.size[0] * times, about.size[1] * times);
    c.filter = "none";
    shown.marks[view.index].forEach(([x, y, v], k) => {
      if (v <= 0) return;
      path(c, ...cross([centre[0] + (x - u[0]) * times, centre[1] + (y - u[1]) * times], 2, 9));
      stroke(c, COLOURS[k], 1.2);
    });
    path(c, ...cross(centre, 3, r));
    stroke(c, "#fff9", 0.7);
    c.restore();
    c.beginPath();
    c.arc(...centre, r, 0, 2 * Math.PI);
    stroke(c, COLOURS[landmark], 2);
    c.font = "11px ui-monospace, monospace";
    const text = `${u[0].toFixed(1)}, ${u[1].toFixed(1)}`;
    c.lineWidth = 3;
    c.strokeStyle = "#000c";
    c.strokeText(text, centre[0] - 34, centre[1] + r - 12);
    c.fillStyle = "#fff";
    c.fillText(text, centre[0] - 34, centre[1] + r - 12);
  }

  // --- input

  function press(key, shift) {
    const view = views[active], centre = shown && screen(view, cursor(view)), step = shift ? 20 : 1, plain = key.toLowerCase();
    const moves = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
    if (key === "?") help.hidden = !help.hidden;
    else if (key === "Escape") help.hidden = true;
    else if (!shown) return false;
    else if (moves[key]) move(moves[key][0] * step, moves[key][1] * step);
    else if (key === "Enter") put(view, cursor(view));
    else if (key >= "1" && key <= String(about.landmarks.length)) choose(active, Number(key) - 1);
    else if (plain === "v") choose(1 - active, open(1 - active));
    else if (plain === "a" || plain === "d") accept(plain === "a" ? "robot" : "detector", shift);
    else if (plain === "h") {
      const [x, y, v] = shown.marks[active][landmark];
      if (v > 0) mark([[active, landmark, x, y, 3 - v]]);
      else { mark([[active, landmark, ...cursor(view), 1]]); advance(); }
    } else if (plain === "x") { mark([[active, landmark, null, null, -1]]); advance(); }
    else if (key === "Delete" || key === "Backspace") mark([[active, landmark, null, null, 0]]);
    else if (plain === "u") ask({ do: "undo", frame: shown.frame });
    else if (plain === "r") ask({ do: "redo", frame: shown.frame });
    else if (plain === "n") { wanted = null; ask({ do: "next", frame: shown.frame }); }
    else if (key === ",") show((wanted ?? shown.frame) - 1);
    else if (key === ".") show((wanted ?? shown.frame) + 1);
    else if (key === "+" || key === "=") zoom(view, 1.25, ...centre);
    else if (key === "-") zoom(view, 0.8, ...centre);
    else if (key === "0") views.forEach(whole);
    else if (plain === "t") views.forEach(toTool);
    else if (plain === "c") contrast = Math.min(Math.max(contrast * (shift ? 0.8 : 1.25), 0.3), 8);
    else if (plain === "b") brightness = Math.min(Math.max(brightness * (shift ? 0.8 : 1.25), 0.2), 8);
    else if (plain === "l") loupe = !loupe;
    else if (plain === "s") suggestions = !suggestions;
    else return false;
    draw();
    return true;
  }
  root.addEventListener("keydown", (event) => {
    const command = event.ctrlKey || event.metaKey;
    const pressed = event.target.tagName === "BUTTON" && ["Enter", " "].includes(event.key);
    if (event.altKey || (command && event.key.toLowerCase() !== "z") || pressed) return;
    views.forEach((view) => { view.at = null; });
    const used = command ? press(event.shiftKey ? "r" : "u", false) : press(event.key, event.shiftKey);
    const typed = !command && event.key.length === 1; // else the notebook would take it as a shortcut: m, y, i i, ...
    if (used || typed) { event.preventDefault(); event.stopPropagation(); }
  });
  root.addEventListener("focus", draw);
  root.addEventListener("blur", draw);
  for (const view of views) {
    let from = null;
    const at = (event) => { const r = view.overlay.getBoundingClientRect(); return [event.clientX - r.left, event.clientY - r.top]; };
    view.box.addEventListener("pointerdown", (event) => {
      root.focus({ preventScroll: true });
      view.box.setPointerCapture(event.pointerId);
      from = { s: at(event), x: view.x, y: view.y, moved: event.button !== 0 };
      event.preventDefault();
    });
    view.box.addEventListener("pointermove", (event) => {
      const s = at(event);
      view.at = s;
      if (from && Math.hypot(s[0] - from.s[0], s[1] - from.s[1]) > FARTHEST_CLICK) from.moved = true;
      if (from?.moved) { view.x = from.x - (s[0] - from.s[0]) / view.zoom; view.y = from.y - (s[1] - from.s[1]) / view.zoom; }
      draw();
    });
    view.box.addEventListener("pointerup", (event) => {
      if (from && !from.moved && shown) {
        if (active !== view.index) { active = view.index; landmark = open(active); }
        view.cursor = pixel(view, at(event));
        put(view, view.cursor);
      }
      from = null;
    });
    view.box.addEventListener("pointerleave", () => { view.at = null; draw(); });
    view.box.addEventListener("contextmenu", (event) => event.preventDefault());
    view.box.addEventListener("wheel", (event) => {
      zoom(view, Math.exp(-event.deltaY / 400), ...at(event));
      event.preventDefault();
      draw();
    }, { passive: false });
  }
  strip.onclick = (event) => shown && show(Math.floor(about.n * (event.clientX - strip.getBoundingClientRect().left) / strip.clientWidth));

  function dress() {
    title.textContent = about.name;
    about.landmarks.forEach((name, k) => {
      const chip = element("button", "chip", chips);
      element("i", "", chip).style.background = COLOURS[k];
      chip.append(name);
      element("kbd", "", chip, String(k + 1));
      element("small", "", chip);
      chip.onclick = () => { choose(active, k); root.focus(); };
    });
    for (let f = 0; f < about.n; f++) element("div", "", strip);
    measure();
  }
  function measure() {
    if (!about) return;
    for (const view of views) {
      const width = view.box.clientWidth, height = Math.max(Math.round(width * about.size[1] / about.size[0]), 220), ratio = window.devicePixelRatio;
      if (!width) continue;
      const before = view.width, fit = !view.width || Math.abs(view.zoom - Math.min(view.width / about.size[0], view.height / about.size[1])) < 1e-9;
      view.box.style.height = `${height}px`;
      for (const canvas of [view.picture, view.overlay]) {
        canvas.width = Math.round(width * ratio);
        canvas.height = Math.round(height * ratio);
        canvas.style.width = `${canvas.width / ratio}px`;
        canvas.style.height = `${canvas.height / ratio}px`;
      }
      [view.width, view.height] = [width, height];
      if (fit) whole(view);
      else view.zoom *= width / before;
    }
    draw();
  }
  const resized = new ResizeObserver(measure);
  resized.observe(grid);
  model.on("msg:custom", hear);
  const clock = setInterval(tell, 1000);
  ask({ do: "hello" });
  return () => { clearInterval(clock); resized.disconnect(); model.off("msg:custom", hear); };
}

export default { render };
